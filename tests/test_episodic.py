"""Systems that are judged at the end of an episode: evaluated once for each, and what searches do
with the best of them.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import TOLD, mark_long
from trees import FERRY, grown, problem

import jast
from jast._src.core.counter_prng import tree_keys
from jast._src.core.policy import nominal_policy
from jast._src.search.tree import layout as T
from jast._src.search.tree import run
from jast.distributions import Independent, Normal
from jast.search import forest, mcts


class Host:
    """Sums the disturbances of an episode in NumPy, counts the episodes, and would answer nonsense
    before the end of one.
    """

    def __init__(self, horizon=4):
        self.horizon, self.episodes, self.early = horizon, 0, 0

    def __call__(self, begun, t, rows):
        lead = np.broadcast_shapes(begun.shape, t.shape, rows.shape[:-1])
        begun, t = np.broadcast_to(begun, lead), np.broadcast_to(t, lead)
        self.episodes += int(begun.sum())
        self.early += int((begun & (t < self.horizon)).sum())
        total = np.broadcast_to(np.asarray(rows).sum(-1), lead)
        return total > 3, np.where(begun, 3 - total, np.nan).astype(rows.dtype)


def counted(horizon=4, **fields):
    """A walk that fails above 3 at its end, and its `Host`."""
    host = Host(horizon)

    def evaluate(s):
        begun, t, rows = s
        shapes = jax.ShapeDtypeStruct((), bool), jax.ShapeDtypeStruct((), rows.dtype)
        return jax.pure_callback(
            lambda *a: host(*map(np.asarray, a)), shapes, begun, t, rows, vmap_method="expand_dims"
        )

    init = lambda x0: (jnp.ones((), bool), jnp.int32(0), jnp.zeros(horizon))
    step = lambda s, x: (s[0], s[1] + 1, s[2].at[s[1]].set(x))
    return (
        jast.Simulator(
            init,
            step,
            lambda s: Normal(jnp.zeros(()), 1.0),
            evaluate,
            horizon,
            episodic=True,
            observe=lambda s: s[2],
            **fields,
        ),
        host,
    )


def since(host):
    jax.effects_barrier()
    n, host.episodes = host.episodes, 0
    assert host.early == 0
    return n


@pytest.mark.slow
def test_an_episode_is_evaluated_once_at_its_end(key):
    sim, host = counted()
    jast.check(sim)
    since(host)
    e = jast.rollout(key, sim)
    assert since(host) == 2  # drawn, and played back exactly
    np.testing.assert_allclose(e.distance, 3 - e.disturbances.sum(), rtol=1e-6)
    jast.replay(sim, e)
    assert since(host) == 1
    jax.vmap(lambda k: jast.rollout(k, sim))(jax.random.split(key, 10))
    assert since(host) == 10
    jast.nominal(key, sim, episodes=300)
    assert since(host) == 300 + 2
    jast.estimate.importance(key, sim, nominal_policy(sim), samples=50)
    assert 50 <= since(host) <= 50 + 256


@pytest.mark.long
@pytest.mark.parametrize("record", [False, True])
def test_searches_evaluate_each_episode_once_and_replay_what_they_keep(key, record):
    sim, host = counted()
    replays = lambda r: r.failures.size + 1
    r = jast.search.monte_carlo(key, sim, episodes=500, top=8, record=record, **TOLD)
    assert r.episodes == 500 and since(host) == 500 + replays(r)
    r = jast.search.cem(key, sim, samples=40, elites=8, iterations=3, top=8, record=record, **TOLD)
    assert r.episodes == 120 and since(host) == 120 + replays(r)
    r = mcts(key, sim, trees=3, simulations=60, top=8, record=record, lanes=2, threads=1, **TOLD)
    fresh = r.episodes if r.trials is None else r.trials.ran.sum()
    # the last group is filled up with a fourth tree
    assert r.episodes == 180 and fresh + replays(r) <= since(host) <= 4 * 60 + replays(r) + 9
    assert record == (r.trials is not None)


@pytest.mark.long
def test_a_random_start_and_an_early_end_are_evaluated_once_too(key):
    host = Host(4)
    ends = lambda s: (s[1] == 3) & (s[2][0] > 0)

    def evaluate(s):
        shapes = jax.ShapeDtypeStruct((), bool), jax.ShapeDtypeStruct((), s[2].dtype)
        late = jnp.where(ends(s), 4, s[1])
        return jax.pure_callback(
            lambda *a: host(*map(np.asarray, a)),
            shapes,
            s[0],
            late,
            s[2],
            vmap_method="expand_dims",
        )

    init = lambda x0: (jnp.ones((), bool), jnp.int32(0), jnp.zeros(4).at[3].set(x0))
    step = lambda s, x: (s[0], s[1] + 1, s[2].at[s[1]].set(x + jnp.where(s[1] == 3, s[2][3], 0)))
    normal = lambda s=None: Normal(jnp.zeros(()), 1.0)
    sim = jast.Simulator(
        init,
        step,
        normal,
        evaluate,
        4,
        start=normal,
        is_terminal=ends,
        episodic=True,
        observe=lambda s: s[2],
    )
    r = jast.search.monte_carlo(key, sim, episodes=200, top=4, record=True, **TOLD)
    assert since(host) == 200 + r.failures.size + 1
    assert set(r.failures.episodes.length) <= {3, 4} and 200 * 3 < r.steps < 200 * 4
    r = forest(key, sim, trees=4, prunes=2, simulations=50, top=4, record=True, **TOLD)
    # a few more candidates are replayed
    assert 0 <= since(host) - r.trials.ran.sum() - r.failures.size - 1 <= 8
    for e in map(r.failures.episode, range(r.failures.size)):
        total = e.disturbances[: e.length].sum() + e.x0
        np.testing.assert_allclose(e.distance, 3 - total, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("limit", [1e9, 1.0, -1.0], ids=["never", "sometimes", "at the start"])
@pytest.mark.parametrize("search", mark_long(["monte_carlo", "mcts", "forest"], "mcts"))
def test_one_start_and_an_end(key, search, limit):
    """Ended never, early, or at once: each search has the episodes that it says, and their ends are
    those of replays.
    """
    step, normal = lambda s, x: (s[0] + x, s[1] + 1), lambda s: Normal(jnp.zeros(()), 1.0)
    init = lambda x0: (jnp.zeros(()), jnp.int32(0))
    sim = jast.Simulator(
        init,
        step,
        normal,
        lambda s: (s[0] >= 1, 1 - s[0]),
        6,
        is_terminal=lambda s: s[0] > limit,
        episodic=True,
    )
    sizes = dict(
        monte_carlo=dict(episodes=60),
        mcts=dict(trees=2, simulations=30),
        forest=dict(trees=2, prunes=1, simulations=30),
    )[search]
    r = getattr(jast.search, search)(key, sim, record=True, **TOLD, **sizes)
    ended = limit < 0
    assert r.episodes == (2 if ended and search != "monte_carlo" else 60)
    assert (r.steps == 0) == ended
    assert r.trials.failure.any() == (not ended)
    distance = 1 - r.best.disturbances[: r.best.length].sum()
    np.testing.assert_allclose(r.best.distance, distance, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(r.best_reward_per_tree.max(), r.best.reward, rtol=1e-5)
    assert (r.failures.episodes.distance <= 0).all() and (limit > 1 or r.best.length <= 6)


# --- trials
# ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "search", mark_long(["monte_carlo", "cem", "mcts", "forest"], "cem", "mcts")
)
def test_trials_are_the_episodes(key, search):
    """Of the ferry: their best is the result's best, their failures are counted, and their numbers
    belong together.
    """
    actions, reward = (
        jast.actions.uniform(0.0, 1.0),
        jast.rewards.standard(event_bonus=30.0, density="mode"),
    )
    sizes = dict(
        monte_carlo=dict(episodes=600),
        cem=dict(samples=50, elites=10, iterations=6, trees=2),
        mcts=dict(trees=3, simulations=200),
    )
    sizes["forest"] = dict(trees=3, prunes=4, simulations=50, follow=True)
    r = getattr(jast.search, search)(
        key, FERRY, actions=actions, reward=reward, record=True, **sizes[search]
    )
    t = r.trials
    assert (
        t.reward.shape
        == t.failure.shape
        == (r.episodes // len(r.best_reward_per_tree), len(r.best_reward_per_tree))
    )
    best = np.where(t.failure.any(), np.where(t.failure, t.reward, -np.inf), t.reward).max()
    np.testing.assert_allclose(best, r.best.reward, rtol=1e-5)
    at = np.unravel_index(
        np.argmax(np.where(t.failure == r.best.failure, t.reward, -np.inf)), t.reward.shape
    )
    np.testing.assert_allclose(
        [t.distance[at], t.log_prob[at]], [r.best.distance, r.best.log_prob], rtol=1e-4, atol=1e-4
    )
    assert t.failure.sum() <= r.failures.seen and (t.failure <= t.ran).all()
    if search in ("monte_carlo", "cem"):
        assert t.ran.all() and t.failure.sum() == r.failures.seen
    # a miss of the ferry earns its log p (less that of the modes) and less its distance
    miss = t.ran & ~t.failure
    assert np.corrcoef(t.reward[miss], t.log_prob[miss] - t.distance[miss])[0, 1] > 0.99


@pytest.mark.slow
def test_without_record_there_are_no_trials(key):
    assert jast.search.monte_carlo(key, FERRY, episodes=100).trials is None


# --- following and feeding the best
# ----------------------------------------------------------------------------


def needle(half=0.05):
    """Eight steps of two normals; fails only where one of the steps lies in a small box that
    nothing points to.
    """

    def evaluate(rows):
        gap = jnp.min(jnp.max(jnp.abs(rows - 0.5), axis=1))
        return gap < half, jnp.where(gap < half, -500.0 - jnp.sum(rows), 300.0)

    step = lambda s, x: jnp.roll(s, -1, axis=0).at[-1].set(x)
    normal = lambda s: Independent(Normal(jnp.zeros(2), 1.0), 1)
    return jast.Simulator(
        lambda x0: jnp.full((8, 2), 9.0),
        step,
        normal,
        evaluate,
        8,
        episodic=True,
        observe=lambda s: s[-1],
    )


@pytest.mark.long
def test_following_finds_many_failures_where_nothing_points_to_the_first():
    """Against the same search that does not follow: more trees that make much of what they
    found.
    """
    sim, of = (
        needle(0.03),
        dict(
            trees=24,
            simulations=800,
            reward=jast.rewards.episodic(1.0),
            record=True,
            exploration=100.0,
            mode="episodic",
        ),
    )
    plain, follows = (
        mcts(jax.random.key(0), sim, follow=follow, **of).trials.failure.sum(0)
        for follow in (False, True)
    )
    assert (follows > 100).sum() >= (plain > 100).sum() + 5


def episodes_of(sim, keys, simulations, memoize, **choices):
    tree, *_ = grown(
        sim,
        keys,
        1,
        simulations,
        memoize,
        widening=(2.0, 0.5),
        reward=jast.rewards.episodic(1.0),
        actions=jast.actions.samples(),
        **choices,
    )
    p = problem(sim, simulations, jast.rewards.episodic(1.0), jast.actions.samples(), **choices)
    n, lanes = tree.log.shape
    i, lane = np.divmod(np.arange(n * lanes, dtype=np.int32), lanes)
    found = run._rebuild(p, tree, jnp.asarray(lane, jnp.int32), jnp.asarray(i, jnp.int32), memoize)
    return tree, jax.tree.map(
        lambda a: np.asarray(a).reshape(n, lanes, *a.shape[1:]), found.disturbances
    )


@pytest.mark.slow
@pytest.mark.parametrize("memoize", mark_long(["node", "root", "none"], "root", "none"))
def test_rebuilt_episodes_are_those_of_the_search_whatever_is_kept(key, memoize):
    sim, keys = needle(), tree_keys(jax.random.key(3), 2)
    tree, x = episodes_of(sim, keys, 400, memoize, follow=True, feed=True, urgent=True)
    assert (np.asarray(tree.lead.source) > 0).all()
    fresh = (np.asarray(tree.outcome) & T.FRESH) > 0
    rewards = jax.vmap(
        jax.vmap(lambda d: jast.replay(sim, d, reward=jast.rewards.episodic(1.0)).reward)
    )(jnp.asarray(x))
    np.testing.assert_allclose(
        np.asarray(tree.log)[fresh], np.asarray(rewards)[fresh], rtol=1e-5, atol=1e-3
    )


@pytest.mark.slow
def test_after_a_failure_its_path_grows_step_by_step():
    """Until the next better one: the episodes after it have one step after the other in common with
    it.
    """
    sim, keys = needle(), tree_keys(jax.random.key(3), 4)
    tree, x = episodes_of(sim, keys, 400, "node", follow=True)
    log, failing = np.asarray(tree.log), (np.asarray(tree.outcome) & T.FAILURE) > 0
    leads = 0
    for lane in range(4):
        best, common = failing[:, lane].argmax(), None
        for i in range(best + 1, 400):
            same = (x[i, lane] == x[best, lane]).all(-1)
            now = 8 if same.all() else same.argmin()
            assert common is None or common == 8 or now == common + 1
            common, leads = (
                now if common is None or common < 8 else 8,
                leads + (common is not None and common < 8),
            )
            if failing[i, lane] and log[i, lane] > log[best, lane]:
                best, common = i, None
    assert leads > 10


@pytest.mark.slow
def test_a_value_head_cannot_follow(key):
    with pytest.raises(ValueError, match="forest: follow must be False with a value head"):
        forest(key, FERRY, trees=2, prunes=1, simulations=5, heads="value", follow=True)
    with pytest.raises(ValueError, match="mcts: urgent must be True or False, received 1"):
        mcts(key, FERRY, simulations=5, urgent=1)


# --- reward
# ----------------------------------------------------------------------------


def test_equation_3_2_as_printed_and_made_monotone(key):
    with pytest.warns(UserWarning, match="below a miss"):
        printed = jast.rewards.episodic(100.0, mode="thesis")
    safe = jast.rewards.episodic(100.0)
    sim = jast.simulators.landing(b=0.2)
    for k in jax.random.split(key, 20):
        e = jast.rollout(k, sim, reward=printed)
        e = jax.device_get(e)
        distance = e.distance
        np.testing.assert_allclose(
            e.reward, (e.log_prob - distance) * (100.0 if e.failure else 1.0), rtol=1e-5
        )
        np.testing.assert_allclose(
            jast.replay(sim, e, reward=safe).reward,
            e.log_prob - distance + 99 * max(-float(distance), 0) * e.failure,
            rtol=1e-5,
        )
    # a mild failure, d = -50 at log p = -237, against a miss of d = 400: as printed the miss is
    # better
    numbers = lambda r, d, event: float(
        r(jnp.float32(-237.0), jnp.asarray(event), jnp.float32(d), True)
    )
    assert (
        numbers(printed, -50.0, True)
        == -18700.0
        < numbers(printed, 400.0, False)
        == -637.0
        < numbers(safe, -50.0, True)
    )
    with pytest.raises(ValueError, match="rewards.episodic: mode must be"):
        jast.rewards.episodic(mode="printed")


@pytest.mark.slow
def test_a_reward_of_whole_episodes_in_a_tree_is_that_of_its_replay(key):
    with pytest.warns(UserWarning):
        printed = jast.rewards.episodic(10.0, mode="thesis")
    r = mcts(key, needle(), trees=2, simulations=100, reward=printed, mode="thesis")
    np.testing.assert_allclose(r.best_reward_per_tree.max(), r.best.reward, rtol=1e-5)
