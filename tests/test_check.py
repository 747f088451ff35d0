import dataclasses
import random
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jax.tree_util import Partial
from systems import line

import jast
from jast import actions
from jast import distributions as D
from jast._src.core import nominal
from jast._src.core.contract import contract
from jast._src.util.intervals import clopper_pearson
from jast.simulators import ferry, landing, limit_state, walk1d


class Bare:
    """A distribution of the user's own."""

    def __init__(self, log_prob):
        self._log_prob = log_prob

    def sample(self, seed):
        return jax.random.normal(seed)

    def log_prob(self, x):
        return self._log_prob(x)


def explode(*args):
    raise RuntimeError("no such file")


SHAPES = {  # found by tracing
    "start raises": (
        dict(start=explode),
        r"start: raised RuntimeError \(test_check.py:\d+\): no such file",
    ),
    "start is no distribution": (
        dict(start=lambda: jnp.zeros(2)),
        r"start: expected a distribution \(with sample and log_prob\), received float..\[2\]",
    ),
    "init raises": (dict(init=lambda x0: x0["missing"]), r"init: raised TypeError"),
    "init of text": (
        dict(init=lambda x0: dict(a=jnp.zeros(()), name="walk")),
        r"init: leaf \['name'\] is str 'walk', expected an array",
    ),
    "init of a key": (
        dict(init=lambda x0: jax.random.key(0)),
        r"init: leaf .* is key<fry>\[\], expected an array.* draw it in disturbance or start.*"
        r" hold jax.random.key_data\(key\)",
    ),
    "disturbance raises": (dict(disturbance=explode), r"disturbance: raised RuntimeError"),
    "disturbance is a number": (
        dict(disturbance=lambda s: s),
        r"disturbance: expected a distribution .*received float..\[\]",
    ),
    "disturbance is None": (
        dict(disturbance=lambda s: None),
        r"disturbance: expected a distribution .*received NoneType",
    ),
    "log_prob is a vector": (
        dict(disturbance=lambda s: D.Normal(jnp.zeros(3), jnp.ones(3))),
        r"disturbance: log_prob has shape \(3,\), expected \(\); wrap it in .*Independent\(d, 1\)",
    ),
    "start log_prob is a matrix": (
        dict(start=lambda: D.Normal(jnp.zeros((2, 3)), jnp.ones((2, 3)))),
        r"start: log_prob has shape \(2, 3\), expected \(\); wrap it in .*Independent\(d, 2\)",
    ),
    "log_prob is a whole number": (
        dict(disturbance=lambda s: Bare(lambda x: jnp.int32(0))),
        r"disturbance: log_prob has dtype int32, expected a float",
    ),
    "log_prob raises": (
        dict(disturbance=lambda s: Bare(explode)),
        r"disturbance: log_prob: raised RuntimeError",
    ),
    "evaluate raises": (dict(evaluate=explode), r"evaluate: raised RuntimeError"),
    "evaluate is no pair": (
        dict(evaluate=lambda s: s >= 5),
        r"evaluate: expected a pair \(event, distance\), or .*, received bool\[\]",
    ),
    "evaluate has four": (dict(evaluate=lambda s: (s >= 5, s, s, s)), r"expected a pair"),
    "log p is no float": (
        dict(evaluate=lambda s: (s >= 5, s, s >= 5)),
        r"evaluate: log p has dtype bool",
    ),
    "event is a vector": (
        dict(evaluate=lambda s: (jnp.stack([s, s]) >= 5, s)),
        r"evaluate: event has shape \(2,\), expected \(\)",
    ),
    "event is a float": (
        dict(evaluate=lambda s: (s, s)),
        r"evaluate: event has dtype float.., expected bool",
    ),
    "event is None": (
        dict(evaluate=lambda s: (None, s)),
        r"evaluate: event: received NoneType None, expected a bool scalar",
    ),
    "distance is a vector": (
        dict(evaluate=lambda s: (s >= 5, jnp.stack([s, s]))),
        r"evaluate: distance has shape \(2,\), expected \(\)",
    ),
    "distance is a whole number": (
        dict(evaluate=lambda s: (s >= 5, jnp.int32(1))),
        r"evaluate: distance has dtype int32, expected a float",
    ),
    "log_prob is None": (
        dict(disturbance=lambda s: Bare(lambda x: None)),
        r"disturbance: log_prob: received NoneType None, expected a float scalar",
    ),
    "observe is a list": (
        dict(observe=lambda s: [s, s]),
        r"observe: returns list .*, expected a float vector",
    ),
    "is_terminal is a float": (
        dict(is_terminal=lambda s: s),
        r"is_terminal has dtype float.., expected bool",
    ),
    "is_terminal is a vector": (
        dict(is_terminal=lambda s: jnp.stack([s, s]) > 1),
        r"is_terminal has shape \(2,\)",
    ),
    "is_terminal branches": (
        dict(is_terminal=lambda s: True if s > 3 else False),
        r"is_terminal: raised TracerBool.* \(test_check.py:\d+\): .* write jnp.where",
    ),
    "disturbance is a dict": (
        dict(disturbance=lambda s: {"gust": D.Normal(0.0, 1.0)}),
        r"disturbance: expected a distribution .*received dict.*; .* with jast.distributions.Joint",
    ),
    "observe is a scalar": (
        dict(observe=lambda s: s),
        r"observe: returns float..\[\], expected a float vector",
    ),
    "observe is whole numbers": (
        dict(observe=lambda s: jnp.zeros(3, jnp.int32)),
        r"observe: returns int32\[3\], expected a float vector",
    ),
    "step raises": (dict(step=explode), r"step: raised RuntimeError"),
    "step grows": (
        dict(
            init=lambda x0: dict(path=jnp.zeros(1)),
            step=lambda s, x: dict(path=jnp.append(s["path"], x)),
            evaluate=lambda s: (False, 0.0),
        ),
        r"step: state leaf \['path'\] has shape \(2,\), expected \(1,\)",
    ),
    "step changes the dtype": (
        dict(step=lambda s, x: (s + x).astype(jnp.float16)),
        r"step: state leaf .* has dtype float16, expected float",
    ),
    "init forgets the point": (
        dict(
            init=lambda x0: dict(at=0),
            step=lambda s, x: dict(at=x),
            evaluate=lambda s: (False, 0.0),
        ),
        r"step: state leaf \['at'\] has dtype float.*; init returns whole numbers in leaf \['at'\]",
    ),
    "distance of whole numbers": (
        dict(init=lambda x0: jnp.array(3), evaluate=lambda s: (s < 1, s - 1)),
        r"evaluate: distance has dtype int.*, expected a float; init returns whole numbers",
    ),
    "step changes the structure": (
        dict(step=lambda s, x: (s, x)),
        r"step: state has structure .*, expected",
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes(name):
    changes, match = SHAPES[name]
    sim = line(**changes)
    with pytest.raises(ValueError, match=match):
        jast.check(sim)
    traced = lambda b: contract("f", line(**changes), observed=64) and b
    for function in (traced, jax.jit(traced)):  # where a search is traced, too
        with pytest.raises(ValueError, match=match):
            function(1.0)


def test_a_long_observation_is_an_error_where_it_is_looked_at(key):
    sim = line(observe=lambda s: jnp.zeros(200))
    assert jast.check(sim) is sim
    with pytest.raises(ValueError, match="200 numbers, of which sac takes at most 64; pass"):
        jast.policies.sac(key, sim)


NUMBERS = {  # found by running
    "log_prob is NaN": (
        dict(disturbance=lambda s: D.Normal(0.0, jnp.asarray(jnp.nan))),
        r"disturbance: log_prob is not finite in 32 of 32 .* at step 1",
    ),
    "log_prob is NaN later": (
        dict(disturbance=lambda s: Bare(lambda x: jnp.where(s == 0, 0.0, jnp.nan))),
        r"disturbance: log_prob is not .* at step 2",
    ),
    "start log_prob is -inf": (
        dict(start=lambda: Bare(lambda x: jnp.asarray(-jnp.inf))),
        r"start: log_prob is not finite in 32 of 32 of its own samples",
    ),
    "sample is outside of the support": (
        dict(disturbance=lambda s: D.where(s > 9, Shifted(), Shifted())),
        r"disturbance: log_prob is not finite",
    ),
    "init is NaN": (
        dict(
            init=lambda x0: dict(x=jnp.asarray(jnp.nan)),
            step=lambda s, x: s,
            evaluate=lambda s: (False, 1.0),
        ),
        r"init: state leaf \['x'\] is NaN",
    ),
    "step is NaN": (dict(step=lambda s, x: s / s), r"step: state leaf .* is NaN after 1 steps"),
    "distance is NaN": (
        dict(evaluate=lambda s: (s >= 5, s * jnp.nan)),
        r"evaluate: distance is not finite after 0 steps",
    ),
    "distance is NaN undisturbed": (
        dict(evaluate=lambda s: (s >= 5, jnp.log(s * 0 + 1) / s)),
        r"evaluate: distance is not finite after 0 steps",
    ),
    "init is random": (
        dict(init=lambda x0: jnp.asarray(np.random.rand())),
        r"init: leaf \(the whole\) differs between two runs",
    ),
    "step is random": (
        dict(step=lambda s, x: s + x + random.random()),
        r"step: leaf \(the whole\) differs between two runs on the same input",
    ),
    "evaluate is random": (
        dict(evaluate=lambda s: (s >= 5, 5 - s + random.random())),
        r"evaluate: leaf \[1\] differs between two runs",
    ),
}


class Shifted(D.Uniform):
    """Draws from where its density is zero."""

    def __init__(self):
        super().__init__(0.0, 1.0)

    def sample(self, *, seed, sample_shape=()):
        return super().sample(seed=seed, sample_shape=sample_shape) + 7


@pytest.mark.slow
@pytest.mark.parametrize("name", NUMBERS)
def test_numbers(name):
    changes, match = NUMBERS[name]
    sim = contract("f", line(**changes))
    with pytest.raises(ValueError, match=match):
        jast.check(sim)


def test_the_cause_is_kept():
    with pytest.raises(ValueError) as error:
        jast.check(line(step=explode))
    assert isinstance(error.value.__cause__, RuntimeError)


def test_what_is_no_simulator():
    for bad in (3, None, lambda: 0, walk1d):
        with pytest.raises(ValueError, match="check: sim must be a jast.Simulator, received"):
            jast.check(bad)
    key = jax.random.key(0)
    for name, call in dict(
        stress=jast.stress,
        nominal=jast.nominal,
        rollout=jast.rollout,
        failure_probability=jast.estimate.failure_probability,
        subset_simulation=jast.estimate.subset_simulation,
        mcts=jast.search.mcts,
        cem=jast.search.cem,
        gradient=jast.search.gradient,
        go_explore=jast.search.go_explore,
        ppo=jast.policies.ppo,
    ).items():
        with pytest.raises(ValueError, match=f"{name}: sim must .* jast.blackbox.from_python"):
            call(key, lambda x: x)
    with pytest.raises(ValueError, match="step must be a function, received None"):
        line(step=None)
    broken = dataclasses.replace(walk1d())
    object.__setattr__(broken, "evaluate", 5)
    with pytest.raises(ValueError, match="evaluate: expected a function, received 5"):
        jast.check(broken)


GOOD = dict(
    ferry=ferry,
    walk=walk1d,
    landing=landing,
    limit=lambda: limit_state(lambda x: 5 - x.sum(), 100),
    weak=lambda: line(init=lambda x0: 0.0),
    seeds=lambda: line(
        disturbance=lambda s: D.seeds(),
        step=lambda s, x: s + jax.random.normal(jax.random.key(x), dtype=s.dtype),
    ),
    nan_after_the_end=lambda: line(
        init=lambda x0: jnp.asarray(4.9),
        step=lambda s, x: jnp.where(s >= 5, jnp.nan, s + jnp.abs(x)),
    ),
)


@pytest.mark.slow
@pytest.mark.parametrize("name", GOOD)
def test_good_simulators_pass(name):
    sim = GOOD[name]()
    assert jast.check(sim) is sim and jast.check(sim, actions.samples()) is sim
    assert jax.jit(lambda s: jast.check(s) and 1)(sim) == 1  # traced: shapes only
    jax.vmap(lambda b: jast.check(walk1d(threshold=b)) and b)(jnp.asarray([1.0, 2.0]))


# actions


@pytest.mark.slow
def test_actions():
    assert jast.check(ferry(), actions.uniform(0.0, 1.0))
    assert jast.check(ferry(), actions.quantiles())
    with pytest.raises(
        ValueError, match=r"actions\.uniform: .* \d+% of 64 draws .* the box \[2.*, 9"
    ):
        jast.check(ferry(), actions.uniform(2.0, 9.0))
    with pytest.raises(
        ValueError, match=r"actions\.uniform: expected disturbances inside the support"
    ):
        jast.check(ferry(), actions.uniform(-4.0, 5.0))
    assert jast.check(ferry(), actions.uniform(-0.2, 1.2))  # a little wider does no harm


@pytest.mark.parametrize("function", [jast.check, partial(contract, "f")])
def test_action_shapes(function):
    with pytest.raises(
        ValueError, match=r"actions\.uniform: low has shape \(3,\), expected .* \(\)"
    ):
        function(walk1d(), actions.uniform(jnp.zeros(3), 1.0))
    with pytest.raises(ValueError, match=r"actions\.uniform: high has shape \(2,\).*\(5,\)"):
        function(limit_state(lambda x: x.sum(), 5), actions.uniform(0.0, jnp.ones(2)))
    lacking = line(disturbance=lambda s: D.VonMises(jnp.asarray(2.0), jnp.asarray(1.0)))
    with pytest.raises(ValueError, match=r"actions\.quantiles: .*VonMises has no quantile"):
        function(lacking, actions.quantiles())
    started = line(start=lambda: D.VonMises(jnp.asarray(2.0), jnp.asarray(1.0)))
    with pytest.raises(ValueError, match=r"actions\.quantiles: .*VonMises has no quantile"):
        function(started, actions.quantiles())
    with pytest.raises(
        ValueError, match="actions: expected one of jast.actions, received 'uniform'"
    ):
        function(walk1d(), "uniform")


# nominal


@pytest.mark.parametrize(
    "k, n",
    [
        (0, 10),
        (10, 10),
        (3, 10),
        (1, 100_000),
        (10_870, 100_000),
        (99_999, 100_000),
        (40, 1_000_000_000),
    ],
)
@pytest.mark.parametrize("level", [0.95, 0.9, 0.999])
def test_clopper_pearson_is_scipys(k, n, level):
    low, high = clopper_pearson(k, n, level)
    tail = (1 - level) / 2
    assert low == pytest.approx(
        0 if k == 0 else scipy.stats.beta.ppf(tail, k, n - k + 1), rel=1e-6, abs=0
    )
    assert high == pytest.approx(
        1 if k == n else scipy.stats.beta.ppf(1 - tail, k + 1, n - k), rel=1e-6
    )


@pytest.mark.parametrize(
    "bad, match",
    [
        ((1, 0), "n must be"),
        ((5, 4), "k must be"),
        ((-1, 4), "k must be"),
        ((1, 4, 1.0), "level must"),
        ((0.5, 4), "k must"),
    ],
)
def test_clopper_pearson_names_what_is_wrong(bad, match):
    with pytest.raises(ValueError, match=f"clopper_pearson: {match}"):
        clopper_pearson(*bad)


def test_nominal_is_a_loop_of_rollouts(key):
    n = 1100  # more than one chunk, and not a multiple of it
    found = jast.nominal(key, walk1d(), episodes=n)
    episodes = jax.vmap(lambda i: jast.rollout(jax.random.fold_in(key, i), walk1d()))(jnp.arange(n))
    assert (found.failing, found.episodes, found.invalid) == (int(episodes.failure.sum()), n, 0)
    assert found.mean_distance == pytest.approx(float(episodes.distance.mean()), rel=1e-4)
    assert found.interval == clopper_pearson(found.failing, n) and found.rate == found.failing / n
    assert float(found.undisturbed.distance) == 10 and int(found.undisturbed.length) == 30
    text = str(found)
    assert "no failure" in text
    assert f"{found.failing} of {n}" in text
    assert len(text.splitlines()) < 8


def test_nominal_interrupted_is_the_nominal_of_what_was_done(key, equal, monkeypatch):
    """And the units in which it is done change nothing."""
    whole = jast.nominal(key, walk1d(), episodes=2100)
    seed = jax.random.key_data(key).tolist()
    assert whole.settings == dict(method="nominal", episodes=2100, seed=seed)
    monkeypatch.setattr(nominal, "UNITS", 1)  # of two chunks or three, else of one
    equal(jast.nominal(key, walk1d(), episodes=2100)[:-1], whole[:-1])
    of_two = jast.nominal(key, walk1d(), episodes=2048)
    monkeypatch.undo()
    real = nominal._unit

    def interrupted(stop_at):
        def unit(job, number, context):
            if number == stop_at:
                raise KeyboardInterrupt
            return real(job, number, context)

        monkeypatch.setattr(nominal, "_unit", unit)
        return jast.nominal(key, walk1d(), episodes=2100)

    part = interrupted(2)
    assert part.settings == whole.settings | dict(interrupted="after 2048 of 2100 episodes")
    equal(part[:-1], of_two[:-1])
    assert str(part).endswith("interrupted    after 2048 of 2100 episodes")
    with pytest.raises(KeyboardInterrupt):
        interrupted(0)


def test_nominal_says_when_the_system_fails_undisturbed(key):
    with pytest.warns(UserWarning, match="fails undisturbed"):
        found = jast.nominal(key, line(step=lambda s, x: s + 1), episodes=10)
    assert found.failing == 10
    assert found.interval[1] == 1
    assert "FAILS" in str(found)


def test_nominal_counts_invalid_episodes(key):
    sim = line(step=lambda s, x: jnp.where(x > 1, jnp.nan, s), horizon=1)
    with pytest.warns(UserWarning, match="of 2000 nominal episodes are invalid"):
        found = jast.nominal(key, sim, episodes=2000)
    share = scipy.stats.norm.sf(1)
    assert abs(found.invalid / 2000 - share) < 4 * np.sqrt(share / 2000)
    assert found.mean_distance == pytest.approx(5)
    assert found.failing == 0
    with pytest.warns(UserWarning, match="of 5 nominal"):
        found = jast.nominal(key, line(step=lambda s, x: s * jnp.nan), episodes=5)
    assert np.isnan(found.mean_distance) and np.isnan(found.rate) and found.interval == (0, 1)
    assert "5, all: nothing is known" in str(found)


def test_nominal_of_seeds_has_no_undisturbed_episode(key):
    found = jast.nominal(key, GOOD["seeds"](), episodes=100)
    assert found.undisturbed is None and "not defined" in str(found)


@pytest.mark.parametrize("episodes", [0, -1, 1.5, True])
def test_nominal_wants_episodes(key, episodes):
    with pytest.raises(ValueError, match="nominal: episodes must be a whole number"):
        jast.nominal(key, walk1d(), episodes=episodes)


def test_nominal_checks_the_simulator(key):
    with pytest.raises(ValueError, match="evaluate: expected a pair"):
        jast.nominal(key, line(evaluate=lambda s: s), episodes=10)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # it observes nothing
        jast.nominal(key, line(observe=lambda s: jnp.zeros(200)), episodes=10)


def test_a_second_instance_does_not_recompile(key):
    traces = []

    def step(drift, s, x):
        traces.append(1)
        return s + x + drift

    base = line()
    make = lambda drift: dataclasses.replace(base, step=Partial(step, jnp.asarray(drift)))
    for use in (
        lambda s: jast.rollout(key, s),
        lambda s: jast.replay(s, jnp.zeros((3,))),
        lambda s: jast.nominal(key, s, episodes=20),
    ):
        use(make(0.1))
        first = len(traces)
        use(make(0.2))
        extra = len(traces) - first
        assert extra <= 2, "only contract's shape check may trace again"


def test_a_host_callback_that_raises():
    def step(s, x):
        return jax.pure_callback(
            explode, jax.ShapeDtypeStruct((), s.dtype), s, x, vmap_method="sequential"
        )

    with pytest.raises(ValueError, match="raised.*"):
        jast.check(line(step=step))


@pytest.mark.slow
def test_no_key_is_used_twice(key):
    with jax.debug_key_reuse(True):
        sim = ferry(adversary=(16.5, 0.0))
        jast.check(sim, actions.uniform(0.0, 1.0))
        keys = jax.random.split(key, 2)
        assert jast.rollout(keys[0], sim).length == 21
        assert jast.nominal(keys[1], sim, episodes=10).episodes == 10


@pytest.mark.parametrize(
    "parts",
    [
        dict(evaluate=lambda s: (s > 6, 1.0)),
        dict(init=lambda x0: 0.0, evaluate=lambda s: (s > 6, 6.0 - s)),
        dict(
            init=lambda x0: (0.0, 0.0),
            step=lambda s, x: (0.9 * s[0] + x, s[1] + 1.0),
            evaluate=lambda s: (s[0] > 6, 1.0),
        ),
    ],
)
def test_numbers_of_python_are_numbers(parts, key):
    sim = dataclasses.replace(line(), **parts)
    assert jast.check(sim) is sim
    assert jast.estimate.failure_probability(key, sim, 5000).episodes == 5000


@pytest.mark.parametrize("name", ["init", "step"])
def test_a_forgotten_return_is_named(name):
    with pytest.raises(ValueError, match=f"{name}: returned None: is a return missing"):
        jast.check(dataclasses.replace(line(), **{name: lambda *given: None}))


def test_a_start_that_was_not_given_is_named():
    sim = dataclasses.replace(line(), init=lambda x0: x0 + 0.0)
    with pytest.raises(ValueError, match=r"init: raised TypeError.*as start is not given"):
        jast.check(sim)


def boxed(**functions):
    """A walk whose state is a dictionary."""
    given = dict(
        init=lambda x0: {"at": jnp.zeros(())},
        step=lambda s, x: {"at": 0.5 * s["at"] + 0.3 * x},
        disturbance=lambda s: D.Normal(0.0, 1.0),
        evaluate=lambda s: (s["at"] > 3, jnp.maximum(3 - s["at"], 0.0)),
        horizon=8,
    )
    return jast.Simulator(**(given | functions))


def far(s):
    s["at"] = 2 * s["at"]
    return s["at"] > 3, jnp.maximum(3 - s["at"], 0.0)


def emptied(s):
    s.pop("at")
    return D.Normal(0.0, 1.0)


@pytest.mark.parametrize(("name", "function"), [("evaluate", far), ("disturbance", emptied)])
def test_functions_leave_the_state_as_it_is(key, name, function):
    sim = boxed(**{name: function})
    for call in (jast.check, lambda sim: jast.nominal(key, sim, episodes=10)):
        with pytest.raises(ValueError, match=f"^{name}: changes the state"):
            call(sim)


def test_a_step_may_change_its_own_state():
    def step(s, x):
        s["at"] = 0.5 * s["at"] + 0.3 * x
        return s

    shared = {"at": jnp.zeros(())}
    sim = jast.check(boxed(step=step, init=lambda x0: shared))
    x = jnp.full(8, 2.0)
    states = [jast.replay(a, x).states["at"] for a in (sim, boxed())]
    np.testing.assert_array_equal(*states)
    assert shared == {"at": 0.0}


@jax.tree_util.register_pytree_node_class
class Copied:
    """A pytree that makes its array anew whenever it is made."""

    def __init__(self, at):
        self.at = jnp.array(at) if isinstance(at, jax.Array) else at

    def tree_flatten(self):
        return (self.at,), None

    @classmethod
    def tree_unflatten(cls, _, children):
        return cls(*children)


def test_a_state_that_is_copied_is_not_changed():
    jast.check(
        boxed(
            init=lambda x0: Copied(jnp.zeros(())),
            step=lambda s, x: Copied(0.5 * s.at + 0.3 * x),
            evaluate=lambda s: (s.at > 3, jnp.maximum(3 - s.at, 0.0)),
        )
    )


def test_a_function_of_too_many_arguments_is_named_with_its_line():
    def step(s, x, key):
        return s

    line = step.__code__.co_firstlineno
    for given in (step, Partial(step)):
        with pytest.raises(ValueError, match=rf"^step: raised TypeError \(test_check.py:{line}\):"):
            jast.check(boxed(step=given))


def test_a_step_may_empty_its_own_state():
    jast.check(boxed(step=lambda s, x: {"at": 0.5 * s.pop("at") + 0.3 * x}))


def test_both_versions_leave_the_state_as_it_is():
    with pytest.raises(ValueError, match="^evaluate: changes the state"):
        jast.explain.regression(boxed(evaluate=far), boxed())


def test_a_state_without_numbers():
    """It is of no use, and no error."""
    sim = jast.Simulator(
        init=lambda x0: (),
        step=lambda s, x: (),
        disturbance=lambda s: D.Normal(0.0, 1.0),
        evaluate=lambda s: (False, 1.0),
        horizon=3,
    )
    with pytest.warns(UserWarning, match="no disturbance changes a number of the state"):
        jast.check(sim)
