"""The doors of `jast.adapters`, on small environments with the interfaces of the libraries."""

import warnings
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checks import compiled
from jax.tree_util import Partial
from scipy import stats

import jast
from jast.adapters import brax, gymnax, jumanji, mjx, pgx
from jast.distributions import Bernoulli, Categorical, Independent, Normal, Uniform
from jast.estimate import monte_carlo

SAMPLES = 20_000


class Params(NamedTuple):
    pole: Any = jnp.array(1.1)
    limit: Any = jnp.array(3.0)

    def replace(self, **new):
        return self._replace(**new)


class Held(NamedTuple):
    """A state with a typed key and a counter of Python, as many have them."""

    x: Any
    key: Any
    time: Any


class Drift:
    """As gymnax has them: x' = pole x + action + own noise, ended at the limit; `step` resets by
    itself, and all that comes out of it is stopped.
    """

    def __init__(self, noise=0.0):
        self.noise = noise

    def reset(self, key, params):
        state = Held(self.noise * jax.random.normal(key, (1,)), jax.random.split(key)[0], 0)
        return state.x, state

    def step_env(self, key, state, action, params):
        assert jnp.issubdtype(state.key.dtype, jax.dtypes.prng_key)
        x = params.pole * state.x + action + self.noise * jax.random.normal(key, (1,))
        after = Held(x, jax.random.split(state.key)[0], state.time + 1)
        after = after._replace(x=jax.lax.stop_gradient(x))
        return jax.lax.stop_gradient(x), after, -jnp.abs(x[0]), jnp.abs(x[0]) > params.limit, {}

    def step(self, key, state, action, params):
        raise AssertionError("it starts anew by itself")


def steer(gain, seen):
    return -gain * seen


def distance(now):
    return 3.0 - jnp.abs(now.state.x[0])


def drift(env=None, gain=0.6, horizon=10, limit=3.0, **settings):
    settings = dict(distance=distance) | settings
    params, policy = Params(jnp.array(1.1), jnp.array(limit)), Partial(steer, jnp.array(gain))
    return gymnax(env or Drift(), params, policy, horizon=horizon, **settings)


def within(found, p):
    """A count is binomial: |z| < 4.5 but once in 150,000."""
    assert abs(found.failing - p * SAMPLES) < 4.5 * np.sqrt(p * (1 - p) * SAMPLES)


LAST = dict(failure=lambda now: (now.time == 10) & (now.state.x[0] > 1.0))
NOISES = {
    "observation": (0.6, lambda sd: dict(observation=Normal(jnp.zeros(1), sd))),
    "action": (1.0, lambda sd: dict(action=Independent(Normal(jnp.zeros(1), sd), 1))),
    "force": (1.1, lambda sd: dict(force=(Normal(0.0, sd), pushed))),
    "of a function": (0.6, lambda sd: dict(observation=lambda now: Normal(now.state.x * 0, sd))),
    "by a function": (1.0, lambda sd: dict(action=(Normal(0.0, sd), lambda a, x: a + x))),
}


def pushed(state, x):
    return state._replace(x=state.x + x)


@pytest.mark.slow
@pytest.mark.parametrize("kind", NOISES)
def test_the_probability_is_that_of_the_closed_loop(kind, key):
    """Of ten steps with the pole 1.1 - .6, whose end is normal; a force is let pass by the pole and
    seen by the policy no sooner than in the next step.
    """
    gain, make = NOISES[kind]
    sim = jast.check(drift(limit=99.0, **make(1.0), **LAST))
    sd = gain * np.sqrt(np.sum(0.25 ** np.arange(10.0)))
    within(monte_carlo(key, sim, SAMPLES), stats.norm.sf(1.0 / sd))


@pytest.mark.slow
@pytest.mark.parametrize("wide", [False, True], ids=["float32", "float64"])
def test_an_episode_is_that_of_a_loop_in_numpy(wide):
    with jax.enable_x64(wide):
        sd = jnp.full(1, 0.5)
        sim = jast.check(drift(observation=Normal(sd * 0, sd), action=Normal(sd * 0, sd)))
        episode = jast.rollout(jax.random.key(0), sim)
        states = jax.device_get(jast.replay(sim, episode).states)
        rows = jax.device_get(episode.disturbances)
    x, total, close = 0.0, 0.0, dict(rtol=1e-13, atol=1e-13) if wide else dict(rtol=1e-5, atol=1e-6)
    assert states.state.x.dtype == states.total.dtype == (np.float64 if wide else np.float32)
    for t in range(int(episode.length)):
        x = 1.1 * x - 0.6 * (x + rows["observation"][t, 0]) + rows["action"][t, 0]
        total -= abs(x)
        np.testing.assert_allclose(states.state.x[t + 1], [x], **close)
        np.testing.assert_allclose(states.total[t + 1], total, **close)
    assert states.time[int(episode.length)] == episode.length


@pytest.mark.slow
def test_what_terminates_is_a_failure_and_is_not_reset():
    sim = drift(action=Normal(jnp.zeros(1), 1.0), gain=1.1)
    rows = {"action": jnp.zeros((5, 1)).at[2].set(3.5)}
    episode = jast.replay(sim, rows)
    assert episode.failure
    assert episode.length == 3
    assert episode.distance == -0.5
    blind = drift(action=Normal(jnp.zeros(1), 1.0), gain=1.1, limit=4.0, distance=None)
    assert jast.replay(blind, rows).distance == 1.0
    other = dict(failure=lambda now: now.total < -100.0)
    episode = jast.replay(drift(action=Normal(jnp.zeros(1), 1.0), gain=1.1, **other), rows)
    assert not episode.failure and episode.length == 3


def test_gradients_go_through_what_the_environment_stops():
    """d x_3 / d a_t = pole ** (2 - t) of a policy that does nothing."""
    sim = drift(action=Normal(jnp.zeros(1), 1.0), gain=0.0, horizon=3)

    def last(actions):
        return jast.replay(sim, {"action": actions}).states.state.x[3, 0]

    slopes = jax.grad(last)(jnp.zeros((3, 1)))
    np.testing.assert_allclose(slopes[:, 0], [1.21, 1.1, 1.0], rtol=1e-6)


@pytest.mark.slow
def test_parameters_are_drawn_once_an_episode(key):
    """x_1 is a uniform pole times a start near 1; and by a pair, by which the limit goes, too."""
    start = (Normal(0.0, 1e-3), lambda state, x: state._replace(x=state.x * 0 + 1.0 + x))
    common = dict(gain=0.0, force=start, failure=lambda now: now.state.x[0] > 1.4)
    with pytest.raises(ValueError, match="gymnax: parameters: .*received 9.8"):
        drift(parameters={"pole": 9.8})
    with pytest.raises(ValueError, match="names must be fields of Params, received 'poles'"):
        jast.check(drift(parameters={"poles": Uniform(1.0, 1.5)}, **common))
    sim = jast.check(drift(parameters={"pole": Uniform(1.0, 1.5)}, **common))
    within(monte_carlo(key, sim, SAMPLES), 0.2)
    changed = lambda params, x: params._replace(pole=x)
    pair = jast.check(drift(parameters=(Uniform(1.0, 1.5), changed), **common))
    within(monte_carlo(key, pair, SAMPLES), 0.2)
    assert set(jast.rollout(key, sim).x0) == {"parameters"}


@pytest.mark.slow
def test_failures_are_seeds_where_only_seeds_are_drawn(key):
    """The start is the normal number of the episode's key; a fixed seed is one start."""
    above = dict(failure=lambda now: now.state.x[0] > 1.0)
    sim = jast.check(drift(Drift(1.0), seed="episode", horizon=1, gain=1.1, **above))
    p = 1 - stats.norm.cdf(1.0) ** 2  # the start, or the noise of the only step
    found = monte_carlo(key, sim, SAMPLES)
    within(found, p)
    episode = jast.search.monte_carlo(key, sim, episodes=100).failures[0]
    again = jast.replay(drift(Drift(1.0), seed=int(episode.x0["seed"]), **(above | ANY)), NONE)
    start = jast.replay(sim, episode).states.state.x[0]
    assert start == again.states.state.x[0]


ANY = dict(force=(Normal(0.0, 1.0), lambda state, x: state))
NONE = {"force": jnp.zeros(1)}


@pytest.mark.slow
def test_seeds_of_a_step_are_disturbances(key):
    sim = jast.check(drift(Drift(1.0), seed="step", horizon=1, gain=1.1, **LAST))
    episode = jast.rollout(key, sim)
    noise = jax.random.normal(jax.random.key(episode.disturbances["seed"][0]), (1,))
    np.testing.assert_array_equal(jast.replay(sim, episode).states.state.x[1], noise)
    fixed = [jast.replay(drift(Drift(1.0), seed=s, **ANY), NONE).states.state.x for s in (1, 1, 2)]
    np.testing.assert_array_equal(fixed[0], fixed[1])
    assert np.all(np.asarray(fixed[0][:2]) != np.asarray(fixed[2][:2]))


def test_other_numbers_compile_nothing(key):
    make = lambda gain, sd, seed: drift(
        ENV, gain=gain, seed=seed, observation=Normal(jnp.zeros(1), sd)
    )
    jast.rollout(key, make(0.6, jnp.array(1.0), 0))
    sim = make(0.7, jnp.array(2.0), 1)
    with compiled() as programs:
        jast.rollout(key, sim)
    assert not programs


ENV = Drift()


def test_arrays_that_were_put_on_the_device_compile_nothing(key):
    put = jax.device_put(jnp.array([2.0])[0], jax.devices()[0])  # as mjx.put_model does
    assert put.committed
    sim = body(put, force=Normal(jnp.zeros(1), 1.0))
    monte_carlo(key, body(force=Normal(jnp.zeros(1), 1.0)), 100)
    with compiled() as programs:
        monte_carlo(key, sim, 100)
    assert not programs


def test_what_breaks_is_invalid(key):
    """A NaN in the state, one step in two."""
    flip = (
        Bernoulli(probs=0.5),
        lambda state, x: state._replace(x=jnp.where(x == 1, jnp.nan, state.x)),
    )
    found = monte_carlo(key, drift(force=flip, horizon=1), SAMPLES)
    assert found.failing == 0
    assert abs(found.invalid - 0.5 * SAMPLES) < 4.5 * np.sqrt(0.25 * SAMPLES)


class Picture(Drift):
    def step_env(self, key, state, action, params):
        _, *rest = super().step_env(key, state, action, params)
        return jnp.zeros((9, 9)), *rest

    def reset(self, key, params):
        return jnp.zeros((9, 9)), super().reset(key, params)[1]


@pytest.mark.slow
def test_what_is_observed(key):
    noise = dict(action=Normal(jnp.zeros(1), 1.0))
    state = jast.replay(drift(**noise), {"action": jnp.ones((1, 1))}).states
    last = jax.tree.map(lambda a: a[1], state)
    np.testing.assert_array_equal(drift(**noise).observe(last), [1.0])
    blind = dict(policy=lambda seen: jnp.zeros(1), horizon=3, distance=distance, **noise)
    sim = jast.check(gymnax(Picture(), Params(), **blind))  # 81 numbers
    np.testing.assert_array_equal(sim.observe(last._replace(observation=jnp.zeros(81))), [1.0])
    told = gymnax(Picture(), Params(), observe=lambda now: now.state.x, **blind)
    np.testing.assert_array_equal(told.observe(last), [1.0])


class Team:
    """As JaxMARL has them: no params, and two agents by name; x' = x + action of each."""

    max_steps = 99

    def reset(self, key):
        return self._seen(zero := jnp.zeros(2)), zero

    def step_env(self, key, state, action):
        state = state + jnp.stack([action["a"], action["b"]])
        over = jnp.max(jnp.abs(state)) > 99.0
        each = {"a": state[0], "b": 2 * state[1]}
        return self._seen(state), state, each, {"a": over, "b": over, "__all__": over}, {}

    def _seen(self, state):
        return {"a": state[:1], "b": state[1:]}


def team(**settings):
    settings = dict(horizon=10) | settings
    return gymnax(Team(), None, lambda seen: {k: -0.5 * v[0] for k, v in seen.items()}, **settings)


@pytest.mark.slow
def test_several_agents_without_params(key):
    """Each is .5 x - .5 noise; the first of two ends above 1."""
    noise = {"a": Normal(jnp.zeros(1), 1.0), "b": Independent(Normal(jnp.zeros(1), 1.0), 1)}
    ends = dict(failure=lambda now: (now.time == 10) & (jnp.max(now.state) > 1.0))
    sim = jast.check(team(observation=noise, **ends))
    p = stats.norm.cdf(1.0 / (0.5 * np.sqrt(np.sum(0.25 ** np.arange(10.0)))))
    within(monte_carlo(key, sim, SAMPLES), 1 - p**2)
    rows = {"observation": {"a": jnp.array([[-2.0]]), "b": jnp.array([[-6.0]])}}
    np.testing.assert_array_equal(jast.replay(sim, rows).states.reward[1], 1.0 + 2 * 3.0)


class State(NamedTuple):
    pipeline_state: Any
    obs: Any
    reward: Any
    done: Any
    info: dict

    def replace(self, **new):
        return self._replace(**new)


class Cart:
    """As brax has them: q' = pole q + action; `done` is a float. The time is over after 8 steps."""

    pole = 1.1

    def reset(self, key):
        zero = jnp.zeros(())
        start = 0.01 * jax.random.normal(key, (1,))
        return State({"q": start}, start, 0.0, zero, {"truncation": zero, "rng": key, "steps": 0})

    def step(self, state, action):
        q = self.pole * state.pipeline_state["q"] + action
        steps = state.info["steps"] + 1
        over = jnp.where(steps >= 8, 1.0, 0.0)
        fell = jnp.where(jnp.abs(q[0]) > 9.0, 1.0, 0.0)
        rng = jax.random.split(state.info["rng"])[0]
        info = {"truncation": over * (1 - fell), "rng": rng, "steps": steps}
        return State({"q": q}, q, 1.0, jnp.maximum(over, fell), info)


class AutoResetWrapper:
    def __init__(self, env):
        self.env, self.reset, self.step = env, env.reset, env.step


class Episodes(AutoResetWrapper):
    pass


def cart(env=None, **settings):
    settings = dict(action=Normal(jnp.zeros(1), 1.0)) | settings
    return brax(env or Cart(), Partial(steer, jnp.array(0.6)), horizon=10, **settings)


@pytest.mark.slow
def test_brax_to_its_end(key):
    """Ten steps, though the time is over after eight; and by the closed loop's own numbers."""
    ending = dict(failure=lambda now: (now.time == 10) & (now.observation[0] > 1.0))
    sim = jast.check(cart(seed="episode", distance=lambda now: 1 - now.observation[0], **ending))
    sd = np.sqrt(np.sum(0.25 ** np.arange(10.0)))
    within(monte_carlo(key, sim, SAMPLES), stats.norm.sf(1.0 / sd))
    failing = jast.replay(cart(), {"action": jnp.full((2, 1), 10.0)})
    assert failing.failure and failing.length == 1


@pytest.mark.slow
def test_brax_by_parameters_and_a_force(key):
    def heavier(env, x):
        env.pole = x
        return env

    env = Cart()
    double = lambda state, x: state.replace(pipeline_state={"q": x + 0 * state.pipeline_state["q"]})
    sim = brax(
        env,
        lambda seen: 0 * seen,
        horizon=1,
        parameters=(Uniform(1.0, 1.5), heavier),
        force=(Normal(2.0, 1e-6), double),
        failure=lambda now: now.observation[0] > 2.8,
    )
    within(monte_carlo(key, jast.check(sim), SAMPLES), 0.2)
    assert env.pole == 1.1


class Shown(NamedTuple):
    x: Any
    action_mask: Any


class TimeStep(NamedTuple):
    observation: Any
    reward: Any
    discount: Any
    step_type: Any

    def last(self):
        return self.step_type == 2


class Couple:
    """As jumanji has them: x' = x + action, with rewards of two agents. The time is over after
    eight steps; beyond 9, it terminates.
    """

    def reset(self, key):
        state = {"x": jnp.zeros(1), "steps": 0, "key": key}
        return state, self._timestep(state, 1.0, 0)

    def step(self, state, action):
        state = state | {"x": state["x"] + action, "steps": state["steps"] + 1}
        fell = jnp.abs(state["x"][0]) > 9.0
        last = fell | (state["steps"] >= 8)
        return state, self._timestep(state, jnp.where(fell, 0.0, 1.0), jnp.where(last, 2, 1))

    def _timestep(self, state, discount, kind):
        seen = Shown(state["x"], jnp.ones(2, bool))
        return TimeStep(seen, jnp.array([1.0, 2.0]), jnp.full(2, discount), jnp.int8(kind))


def couple(env=None, **settings):
    settings = dict(action=Normal(jnp.zeros(1), 1.0)) | settings
    return jumanji(env or Couple(), lambda seen: -0.5 * seen.x, horizon=10, **settings)


@pytest.mark.slow
def test_jumanji_to_its_end(key):
    """Ten steps of x' = .5 x + noise, though the time is over after eight."""
    ending = dict(failure=lambda now: (now.time == 10) & (now.observation.x[0] > 1.0))
    sim = jast.check(couple(distance=lambda now: 1 - now.observation.x[0], **ending))
    within(monte_carlo(key, sim, SAMPLES), stats.norm.sf(1.0 / np.sqrt(np.sum(0.25 ** np.r_[:10]))))
    failing = jast.replay(couple(), {"action": jnp.array([[1.0], [10.0], [0.0]])})
    assert failing.failure and failing.length == 2
    np.testing.assert_array_equal(failing.states.total[:3], [0.0, 3.0, 6.0])


class Position(NamedTuple):
    observation: Any
    legal_action_mask: Any
    current_player: Any
    rewards: Any
    terminated: Any
    truncated: Any = False


class Nim:
    """As pgx has them: one to three are taken of five, and who takes the last has lost. The key
    decides who begins.
    """

    num_players = 2

    def init(self, key):
        begins = jax.random.bernoulli(key).astype(int)
        return Position(jnp.int32(5), jnp.ones(3, bool), begins, jnp.zeros(2), False)

    def step(self, state, action, key):
        left, mover = state.observation - action - 1, state.current_player
        over = left <= 0
        rewards = jnp.where(over, jnp.where(jnp.arange(2) == mover, -1.0, 1.0), 0.0)
        return Position(left, jnp.arange(3) < left, 1 - mover, rewards, over)


def against_chance(env, first, horizon, **settings):
    """A policy that makes the moves of player 0 against one who makes any legal move."""
    other = lambda now: Categorical(probs=now.observation.legal_action_mask.astype(float))
    filled = lambda action, draw: jnp.where(action < 0, draw, action)
    policy = lambda seen: jnp.where(seen.current_player == 0, first(seen), -1)
    return pgx(env, policy, horizon=horizon, action=(other, filled), **settings)


@pytest.mark.slow
def test_pgx_is_its_game_tree(key):
    """Who takes one with 1, 2, 3, 4 left loses 1, 0, 1/2, 1/3, and 1/2 with 5; second, (1/3 + 1/2 +
    0) / 3.
    """
    one = lambda seen: 0
    sim = jast.check(against_chance(Nim(), one, 5, seed="episode"))
    within(monte_carlo(key, sim, SAMPLES), (1 / 2 + 5 / 18) / 2)
    begins = lambda seed: Nim().init(jax.random.key(seed)).current_player
    seed = next(seed for seed in range(20) if begins(seed) == 0)
    game = lambda env, *takes: jast.replay(
        against_chance(env, one, 5, seed=seed), {"action": jnp.array(takes)}
    )
    assert game(Nim(), 0, 2, 0).failure and game(Nim(), 0, 2, 0).length == 3
    won = game(Nim(), 0, 1, 0, 0)
    assert won.length == 4
    assert not won.failure
    assert won.states.reward[4] == 1.0
    alone = type("Alone", (Nim,), {"num_players": 1})()
    assert game(alone, 0, 1, 0, 0).failure  # of one, whatever its reward


class Data(NamedTuple):
    qpos: Any = jnp.array([0.1])
    qvel: Any = jnp.zeros(1)
    act: Any = jnp.zeros(0)
    qacc_warmstart: Any = jnp.zeros(1)
    time: Any = jnp.zeros(())
    ctrl: Any = jnp.zeros(1)
    qfrc_applied: Any = jnp.zeros(1)

    def replace(self, **new):
        return self._replace(**new)


def moved(mass, data):
    """As `mujoco.mjx.step`: a body on a line."""
    qacc = (data.ctrl + data.qfrc_applied) / mass
    qvel = data.qvel + 0.1 * qacc
    return data.replace(
        qpos=data.qpos + 0.1 * qvel, qvel=qvel, qacc_warmstart=qacc, time=data.time + 0.1
    )


def held(seen):
    return -3.0 * seen[:1] - 2.0 * seen[1:]


def short_of_half(now):
    return 0.5 - now.state.qpos[0]


def body(mass=2.0, **settings):
    settings = dict(horizon=6, distance=short_of_half, step=moved) | settings
    return mjx(jnp.asarray(mass, float), Data(), held, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [1, 3])
def test_mjx_is_that_of_a_loop_in_numpy(substeps, key):
    sim = jast.check(body(force=Normal(jnp.zeros(1), 1.0), substeps=substeps))
    episode = jast.rollout(key, sim)
    states = jast.replay(sim, episode).states
    q, v = 0.1, 0.0
    for t, push in enumerate(episode.disturbances["force"][: int(episode.length), 0]):
        ctrl = -3.0 * q - 2.0 * v
        for _ in range(substeps):
            v += 0.1 * (ctrl + push) / 2.0
            q += 0.1 * v
        np.testing.assert_allclose(states.observation[t + 1], [q, v], rtol=1e-4, atol=1e-5)
    assert not episode.failure


@pytest.mark.slow
def test_mjx_fails_at_its_distance_and_by_its_parameters(key):
    """One step of a force of 50: qpos = .1 + .01 (50 - .3) / mass."""
    light = (Uniform(1.0, 2.0), lambda mass, x: x)
    push = (Normal(50.0, 1e-6), lambda data, x: data.replace(qfrc_applied=x[None]))
    sim = jast.check(body(horizon=1, parameters=light, force=push))
    within(monte_carlo(key, sim, SAMPLES), 0.497 / 0.4 - 1)
    seen = body(sense=lambda data: jnp.concatenate([data.qpos, data.qacc_warmstart]), force=push)
    state = jast.replay(seen, {"force": jnp.array([50.0])}).states
    np.testing.assert_allclose(state.observation[1, 1], (50.0 - 0.3) / 2.0, rtol=1e-5)


WRONG = {
    "gymnax: env must be .*received Cart$": lambda: gymnax(Cart(), None, len, horizon=1),
    "give the environment that it wraps": lambda: gymnax(Wrapped(), None, len, horizon=1),
    "horizon must be below params.max_steps_in_episode, which is 10": lambda: gymnax(
        Drift(), Timed(), len, horizon=10
    ),
    "horizon must be below env.max_steps, which is 99": lambda: team(horizon=99),
    "horizon must be below params.max_timesteps, which is 7": lambda: gymnax(
        Drift(), Crafted(), len, horizon=8
    ),
    "brax: the physics are those of Warp, .*config_overrides": lambda: cart(Warped()),
    "gymnax: policy must be a function, received 1": lambda: gymnax(Drift(), 0, 1, horizon=1),
    'nothing is random: .*, or seed="episode"': drift,
    "mjx: nothing is random: give .*parameters=$": body,
    "gymnax: seed must be a whole number": lambda: drift(seed=-1, **NOISES["action"][1](1.0)),
    "gymnax: force must be a pair": lambda: drift(force=Normal(0.0, 1.0)),
    "gymnax: action must be a distribution, or a pair": lambda: drift(action=0.1),
    "AutoResetWrapper of Cart; brax.envs.get_env": lambda: cart(AutoResetWrapper(Cart())),
    "brax: env must be an environment with reset": lambda: cart(1.0),
    "jumanji: env must be .*received AutoResetWrapper of Couple$": lambda: couple(
        AutoResetWrapper(Couple())
    ),
    "pgx: env must be an environment with init.key. .*received Couple$": lambda: pgx(
        Couple(), len, horizon=1
    ),
    "received Episodes of AutoResetWrapper of Cart": lambda: cart(
        Episodes(AutoResetWrapper(Cart()))
    ),
    "brax: seed .*step.state, action. has no key": lambda: cart(seed="step"),
    "mjx: data must be .* without qpos": lambda: mjx(
        1.0, (), len, horizon=1, distance=len, step=len
    ),
    "mjx: distance must be a function": lambda: body(distance=1.0),
    "mjx: controller must be a function": lambda: mjx(
        1.0, (), 1, horizon=1, distance=len, step=len
    ),
    "mjx: sense must be a function": lambda: body(sense=1.0),
    "mjx: substeps must be a whole number of at least 1": lambda: body(substeps=0),
    "gymnax: policy holds arrays, received Weights: .*eqx.partition": lambda: gymnax(
        Drift(), Params(), Weights(), horizon=1, **NOISES["action"][1](1.0)
    ),
    r"leaf \[?.*state.* has dtype float32, expected int32": lambda: jast.check(
        gymnax(Whole(), Params(), lambda seen: seen * 0.6, horizon=3, **ANY)
    ),
    r"^step: raised ValueError: gymnax: observation must be a distribution of shape \(1,\), such as"
    r" Normal\(jnp.zeros\(\(1,\)\), 0.1\), .*; received one of shape \(\)": lambda: jast.check(
        drift(observation=Normal(0.0, 1.0))
    ),
    r"gymnax: action must be .* of shape \(1,\), .*received one of shape \(3,\)": lambda: (
        jast.check(drift(action=Normal(jnp.zeros(3), 1.0)))
    ),
    r"gymnax: action must be a pair .*noise cannot be added to int32\[1\]": lambda: jast.check(
        gymnax(Drift(), Params(), lambda seen: seen.astype(int), horizon=3, action=Normal(0.0, 1.0))
    ),
    r"gymnax: observation must be .* of the structure PyTreeDef": lambda: jast.check(
        drift(observation={"seen": Normal(jnp.zeros(1), 1.0)})
    ),
    r"mjx: force must be a distribution of shape \(1,\), .* received one of shape \(3,\)": lambda: (
        jast.check(body(force=Normal(jnp.zeros(3), 1.0)))
    ),
}


class Weights:
    """Equal by its arrays, as a module of Equinox is."""

    __hash__ = None

    def __call__(self, seen):
        return seen


class Whole(Drift):
    """Starts at 0, and goes on in floats."""

    def reset(self, key, params):
        seen, state = super().reset(key, params)
        return seen, state._replace(x=jnp.zeros(1, int))

    def step_env(self, key, state, action, params):
        return super().step_env(key, state._replace(x=state.x.astype(float)), action, params)


class Timed(NamedTuple):
    max_steps_in_episode: int = 10


class Crafted(NamedTuple):
    max_timesteps: int = 7


class Warped(Cart):
    mjx_model = SimpleNamespace(impl=SimpleNamespace(value="warp"))


class Wrapped:
    def __getattr__(self, name):
        return getattr(Drift(), name)


@pytest.mark.slow
@pytest.mark.parametrize("message", WRONG)
def test_what_is_refused(message):
    with pytest.raises(ValueError, match=message):
        WRONG[message]()


SYSTEMS = "needs the extra `systems`, or jumanji and pgx"


def library(*names):
    """The modules."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return [pytest.importorskip(name, reason=SYSTEMS) for name in names]


@pytest.fixture
def theirs():
    """Their own warnings and promotions, of dtypes and of ranks, are not ours."""
    with warnings.catch_warnings(), jax.numpy_dtype_promotion("standard"):
        with jax.numpy_rank_promotion("allow"):
            warnings.simplefilter("ignore")
            yield


@pytest.mark.long
def test_an_episode_of_gymnax_is_its_own_loop(key, theirs):
    """Of the cart and its pole, with the noise seen; and the gradients are not zero."""
    (theirs,) = library("gymnax")
    env, params = theirs.make("CartPole-v1")
    gains = jnp.array([0.1, 0.2, 1.0, 0.5])
    act = lambda seen: jnp.where(seen @ gains > 0.0, 1.0, 0.0)
    noise = Normal(jnp.zeros(4), 0.3)
    sim = jast.check(gymnax(env, params, act, horizon=60, observation=noise))
    episode = jast.rollout(key, sim)
    states = jast.replay(sim, episode).states
    seen, state = env.reset(jax.random.key(0), params)
    step = jax.jit(env.step_env)
    for t in range(int(episode.length)):
        action = act(seen + episode.disturbances["observation"][t])
        seen, state, _, done, _ = step(key, state, action, params)
        np.testing.assert_allclose(states.observation[t + 1], seen, rtol=1e-5, atol=1e-6)
    assert episode.failure == done

    def angle(push):
        pushed = gymnax(env, params, act, horizon=5, force=(Normal(0.0, 1.0), nudged))
        return jast.replay(pushed, {"force": jnp.full(5, push)}).states.state.theta[5]

    nudged = lambda state, x: state.replace(theta_dot=state.theta_dot + 0.01 * x)
    assert jax.grad(angle)(0.0) > 0.0


@pytest.mark.long
def test_an_episode_of_brax_is_its_own_loop(key, theirs):
    envs = library("brax.envs")[0]
    env = envs.get_environment("inverted_pendulum", backend="spring")
    gains = jnp.array([0.2, 3.0, 0.3, 0.6])
    act = lambda seen: jnp.clip(seen @ gains, -1.0, 1.0)[None]
    sim = brax(env, act, horizon=10, action=Normal(jnp.zeros(1), 0.2), seed=7)
    episode = jast.rollout(key, sim)
    states = jast.replay(sim, episode).states
    state, step = env.reset(jax.random.key(7)), jax.jit(env.step)
    for t in range(int(episode.length)):
        state = step(state, act(state.obs) + episode.disturbances["action"][t])
        np.testing.assert_allclose(states.observation[t + 1], state.obs, rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="brax: env .*AutoResetWrapper of EpisodeWrapper"):
        brax(envs.create("inverted_pendulum"), act, horizon=10, action=Normal(jnp.zeros(1), 0.2))


@pytest.mark.long
def test_an_episode_of_jumanji_is_its_own_loop(key, theirs):
    """Of the snake, which goes where it may and slips one time in ten."""
    (theirs,) = library("jumanji")
    env = theirs.make("Snake-v1")
    act = lambda seen: jnp.argmax(seen.action_mask)
    slipped = lambda action, slips: jnp.where(slips == 1, (action + 1) % 4, action)
    sim = jast.check(
        jumanji(env, act, horizon=60, action=(Bernoulli(probs=0.1), slipped), seed="episode")
    )
    episode = jast.search.monte_carlo(key, sim, episodes=20).failures[0]
    states = jast.replay(sim, episode).states
    (state, now), step = env.reset(jax.random.key(episode.x0["seed"])), jax.jit(env.step)
    for t in range(int(episode.length)):
        state, now = step(state, slipped(act(now.observation), episode.disturbances["action"][t]))
        np.testing.assert_array_equal(states.observation.grid[t + 1], now.observation.grid)
    assert now.last() and episode.failure
    wrapped = library("jumanji.wrappers")[0].AutoResetWrapper(env)
    with pytest.raises(ValueError, match="jumanji: env .*AutoResetWrapper of Snake"):
        jumanji(wrapped, act, horizon=60, seed="episode")


LINES = [(0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6)]


def loses(board, mover):
    """The probability that player 0 loses at noughts and crosses, who takes the first free place
    while player 1 takes any.
    """
    if any(all(board[i] == 1 - mover for i in line) for line in LINES):
        return float(mover == 0)
    free = [i for i in range(9) if board[i] is None]
    places = free[:1] if mover == 0 else free
    after = [loses((*board[:i], mover, *board[i + 1 :]), 1 - mover) for i in places]
    return np.mean(after) if after else 0.0


@pytest.mark.long
@pytest.mark.parametrize("begins", [0, 1])
def test_pgx_is_the_tree_of_noughts_and_crosses(begins, key, theirs):
    (theirs,) = library("pgx")
    env = theirs.make("tic_tac_toe")
    first = lambda seen: jnp.argmax(seen.legal_action_mask)
    starts = lambda seed: env.init(jax.random.key(seed)).current_player
    seed = next(seed for seed in range(20) if starts(seed) == begins)
    sim = jast.check(against_chance(env, first, 9, seed=seed))
    within(monte_carlo(key, sim, SAMPLES), loses((None,) * 9, begins))


BODY = """
<mujoco><option timestep="0.02"/><worldbody>
  <geom type="plane" size="5 5 .1"/>
  <body pos="0 0 .3"><freejoint/><geom type="sphere" size=".1" mass="1"/></body>
</worldbody></mujoco>
"""


@pytest.mark.long
def test_an_episode_of_mjx_is_that_of_whole_data(key, theirs):
    """A ball that falls on the ground, so that the solver's start matters, under a force."""
    mujoco, theirs = library("mujoco", "mujoco.mjx")
    model = theirs.put_model(mujoco.MjModel.from_xml_string(BODY))
    data = theirs.make_data(model)
    held = dict(controller=lambda seen: jnp.zeros(0), distance=lambda now: now.state.qpos[2] + 1)
    force = Normal(jnp.zeros(6), jnp.full(6, 0.5))
    sim = jast.check(mjx(model, data, horizon=30, force=force, **held))
    episode = jast.rollout(key, sim)
    states, step = jast.replay(sim, episode).states.state, jax.jit(theirs.step)
    for t in range(30):
        data = step(model, data.replace(qfrc_applied=episode.disturbances["force"][t]))
        np.testing.assert_allclose(states.qpos[t + 1], data.qpos, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(states.qvel[t + 1], data.qvel, rtol=1e-3, atol=1e-4)
    assert data.qpos[2] < 0.15
