"""Black boxes in this process: the same answers as the system in JAX, exact counts, and every way
in which a system can go wrong.
"""

import os
import re
import sys
import time

import blackboxes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from systems import TOLD

import jast
from jast import blackbox
from jast._src.blackbox import answers, readings, worker
from jast._src.blackbox.rows import Spec
from jast._src.core.rewards import STANDARD
from jast._src.estimate.tilts.exploration import numbers_of_episodes
from jast._src.runtime.host_errors import GROUPS, Log, hosts_of, new_incidents
from jast.distributions import Categorical, Independent, Joint, MultivariateNormalDiag, Normal
from jast.incidents import incidents

NORMAL = Normal(0.0, 1.0)


def box(system, horizon=2, disturbance=NORMAL, **settings):
    return blackbox.from_python(system, horizon=horizon, disturbance=disturbance, **settings)


def ends(sim, rows):
    """Event and distance of episodes whose disturbances are ``rows`` [n, horizon, ...], in one
    batch.
    """
    rows = jnp.asarray(rows, jnp.zeros(()).dtype)
    n = len(rows)
    return jax.device_get(
        jax.vmap(sim.evaluate)(
            blackbox.Record(jnp.ones(n, bool), jnp.full(n, rows.shape[1], jnp.int32), (), rows)
        )
    )


def in_jax(horizon=4, **fields):
    """`blackboxes.Walk`."""
    evaluate = lambda s: (s >= 4.0, jnp.maximum(4.0 - s, 0.0))
    return jast.Simulator(
        lambda x0: jnp.zeros(()), lambda s, x: s + x, lambda s: NORMAL, evaluate, horizon, **fields
    )


class Looks(blackboxes.Walk):
    def observe(self):
        return np.arange(135.0) + self.s


@pytest.mark.slow
def test_episodes_are_those_of_the_system_in_jax_and_counted_once(key):
    sim = box(blackboxes.walk, 4)
    ours, theirs = (
        jast.search.monte_carlo(key, s, episodes=1500, top=3, reward=STANDARD)
        for s in (sim, in_jax(episodic=True))
    )
    assert ours.failing_share == theirs.failing_share > 0
    assert ours.first_failure == theirs.first_failure
    np.testing.assert_array_equal(
        ours.failures.episodes.disturbances, theirs.failures.episodes.disturbances
    )
    np.testing.assert_allclose(ours.best.reward, theirs.best.reward, rtol=1e-6)
    n = blackbox.calls(sim)
    # the best one and three failures are replayed, for which nothing runs, but one that is made
    # twice, to see whether it fails again
    assert n.rows == n.episodes + n.known and n.known >= 3
    assert n.episodes == ours.episodes + 1 and n.transitions == 4 * n.episodes
    assert n.calls < 40
    assert n.seconds > 0
    assert "ms an outcome" in str(n)
    assert incidents(sim) == ()


def test_objects_are_those_of_the_system_in_jax():
    sim = box(blackboxes.Walk, 5, episodic=False)
    theirs = in_jax(
        5, is_terminal=lambda s: s < -4.0, observe=lambda s: jnp.stack([s, jnp.ones_like(s)])
    )
    for x in ([1, 1, -1, 1, 1], [1.5, 1.5, 1.5, 0, 0], [-3, -2, 9, 9, 9]):
        a, b = (jast.replay(s, jnp.array(x, jnp.zeros(()).dtype)) for s in (sim, theirs))
        n = int(a.length)
        assert (n, a.failure, a.log_prob) == (b.length, b.failure, b.log_prob)
        np.testing.assert_allclose(a.distance, b.distance)
        np.testing.assert_allclose(
            *(jax.vmap(s.observe)(e.states)[: n + 1] for s, e in ((sim, a), (theirs, b)))
        )
    assert incidents(sim) == ()


@pytest.mark.slow
def test_an_object_is_judged_at_every_state_unless_said_otherwise(key):
    leaves = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: NORMAL,
        lambda s: (jnp.abs(s) >= 4.0, jnp.maximum(4.0 - jnp.abs(s), 0.0)),
        8,
    )
    sim = box(blackboxes.Leaves, 8)
    now, theirs, at_the_end = (
        jast.nominal(key, s, episodes=500)
        for s in (sim, leaves, box(blackboxes.Leaves, 8, episodic=True))
    )
    assert not sim.episodic and now.failing == theirs.failing > at_the_end.failing
    np.testing.assert_allclose(now.mean_distance, theirs.mean_distance, rtol=1e-5)
    assert box(blackboxes.walk).episodic  # a function answers for a whole episode
    assert not box(lambda: blackboxes.Leaves()).episodic


@pytest.mark.slow
def test_check_says_where_failures_on_the_way_are_lost():
    sim = box(blackboxes.Leaves, 8, episodic=True)
    with pytest.warns(
        UserWarning, match=r"from_python: in (\d+) of 16 episodes is_event\(\)"
    ) as said:
        assert jast.check(sim) is sim
    lost = int(str(said[0].message).split()[2])
    before = blackbox.calls(sim)
    host = next(hosts_of(sim))
    # the first comes back, the last at the end; the others stay near, or are away at their end
    rows = np.zeros((6, 8))
    rows[5, -2:] = 5, -5
    rows[:5, :3] = [[5, -5, 0], [1, 5, 1], [1, 1, 1], [5, -5, 5], [4, -8, 0]]
    assert host.lost([], [rows]) == 2
    after = blackbox.calls(sim)
    assert (after.episodes - before.episodes, after.transitions - before.transitions) == (6, 48)
    assert 0 < lost <= 16
    # one that remembers loses nothing, one that cannot be asked before the end is not compared
    for system in (blackboxes.Left, blackboxes.Delivered):
        assert jast.check(box(system, 8, episodic=True)).episodic


class Continued(blackboxes.Walk):
    """Its ``initialize`` does not bring it back to its start."""

    def initialize(self, *x0):
        if not hasattr(self, "s"):
            super().initialize(*x0)


@pytest.mark.parametrize("episodic", [None, True])
def test_check_says_where_an_object_does_not_start_anew(episodic):
    with pytest.raises(ValueError, match="initialize brings an object back to its start"):
        jast.check(box(Continued, 5, episodic=episodic))
    assert jast.check(box(blackboxes.Walk, 5, episodic=episodic))


class Windy(blackboxes.Walk):
    """The wind of the last step of an episode blows in the next one."""

    wind = 0.0

    def transition(self, x):
        super().transition(x + self.wind)
        self.wind = 0.1 * float(x)

    def miss_distance(self):
        return 4.0 - self.s


class Shared(Windy):
    """Has its wind in common with all others."""

    winds = [0.0]

    def transition(self, x):
        super(Windy, self).transition(x + self.winds[0])
        self.winds[0] += 0.01


class Worn(Windy):
    """Wears out after so many steps."""

    steps = 0

    def transition(self, x):
        self.steps += 1
        super(Windy, self).transition(x * (1 if self.steps < 40 else 2))


@pytest.mark.parametrize("episodic", [None, True])
def test_check_says_what_carries_over_into_the_next_episode(episodic):
    sim, step = box(Windy, 5, episodic=episodic), 5 if episodic else 1
    words = f"initialize: does not reset everything: at step {step} distance is .*, and .* where"
    with pytest.raises(ValueError, match=words):
        jast.check(sim)
    assert blackbox.calls(sim).episodes == 9 + 4
    with pytest.raises(ValueError, match=f"^not deterministic: at step {step} distance is"):
        jast.check(box(Shared, 5, episodic=episodic))
    with pytest.raises(ValueError, match="KeyError"):  # what raises is not compared
        jast.check(box(Raises, 5, episodic=episodic))


def test_check_sees_what_only_many_episodes_show():
    with pytest.raises(ValueError, match="initialize: does not reset everything: at step 5"):
        jast.check(box(Worn, 5, episodic=True))


class Constant(blackboxes.Walk):
    def miss_distance(self):
        return 1.0


class Reversed(blackboxes.Walk):
    def is_event(self):
        return self.s > 1.0

    def miss_distance(self):
        return self.s - 1.0


@pytest.mark.parametrize(
    "of, constant, reverse",
    [
        ("states", Constant, Reversed),
        ("episodes", lambda x: (False, 1.0), lambda x: (x.sum() > 1.0, x.sum() - 1.0)),
    ],
)
def test_check_says_what_is_wrong_with_the_distances(of, constant, reverse):
    with pytest.warns(UserWarning, match=f"check: the miss distance is 1 in all [0-9]* {of} "):
        jast.check(box(constant, 5))
    with pytest.warns(UserWarning, match=f"{of} that fail is greater than .* sign wrong"):
        jast.check(box(reverse, 5))


class Raises(blackboxes.Walk):
    def transition(self, x):
        raise KeyError("a")


class Mute(blackboxes.Walk):
    """Knows no distance."""

    def miss_distance(self):
        return None


@pytest.mark.parametrize(
    "system, words",
    [
        (Mute, "init: 1 x .*received None.*\n  so state leaf .distance is NaN at the start, .*"),
        (
            Raises,
            "step: 9 x raised KeyError: 'a' .*\n  so state leaf .distance is NaN after 1 steps",
        ),
    ],
)
def test_check_says_what_an_object_raised(system, words):
    with pytest.raises(ValueError, match=words):
        jast.check(box(system, 2))


def test_what_is_observed_may_be_chosen_from_more():
    sim = jast.check(box(Looks, 3, observe=lambda s: s.seen[5:7]))
    assert sim.observe(sim.step(sim.init(()), jnp.ones(()))).tolist() == [6, 7]


def test_observations_of_an_environment_that_are_no_numbers_are_left_out():
    class Env:
        def reset(self, seed):
            return {"speed": 1.0}, {}

        def step(self, action):
            return {"speed": 2.0}, 0.0, False, False, {}

    system = blackbox.gymnasium_system(Env, lambda now: now.observation["speed"])
    sim = jast.check(box(system, 2))
    assert sim.init(()).seen.shape == (0,) and sim.observe(sim.init(())).shape == (2,)


@pytest.mark.slow
def test_a_tree_counts_what_the_host_runs(key):
    sim = box(blackboxes.walk, 3)
    found = jast.search.mcts(key, sim, simulations=60)
    assert (
        found.episodes - 10
        < blackbox.calls(sim).episodes
        <= found.episodes + 1 + len(found.failures.counts)
    )  # the outcome of an ended node is kept
    assert incidents(sim) == ()


def test_an_object_is_moved_on_and_a_lost_one_repeats_its_history():
    sim = box(blackboxes.Walk, 4, episodic=False)
    count = lambda: blackbox.calls(sim)[2:4]
    state = sim.init(())
    for _ in range(3):
        before, state = state, sim.step(state, jnp.ones(()))
    assert count() == (1, 3) and state.distance == 1
    # another child of the last but one
    assert sim.step(before, jnp.ones(())).distance == 1 and count() == (2, 6)
    end = sim.step(state, jnp.ones(()))
    assert end.event and count() == (2, 7)
    # an ended state is not asked for
    assert sim.step(end, jnp.ones(())) is not None and count() == (2, 7)


def test_one_call_under_any_number_of_vmaps(equal):
    sim = box(blackboxes.shifted, 2, start=lambda: NORMAL)
    x0, rows = jnp.arange(3.0), jnp.arange(8.0).reshape(4, 2) / 8
    one = lambda x0, x: sim.evaluate(sim.step(sim.step(sim.init(x0), x[0]), x[1]))
    event, distance = jax.vmap(jax.vmap(one, (None, 0)), (0, None))(x0, rows)
    assert blackbox.calls(sim)[:3] == (1, 12, 12)
    np.testing.assert_allclose(
        distance, np.maximum(4 - x0[:, None] - rows.sum(1)[None], 0), rtol=1e-6
    )
    nothing = jax.tree.map(jnp.zeros_like, sim.init(x0[0]))
    equal(sim.evaluate(nothing), (jnp.zeros((), bool), jnp.zeros(())))
    assert np.isnan(sim.evaluate(sim.init(x0[0]))[1])  # no end of an episode
    assert blackbox.calls(sim).rows == 12


def test_what_goes_wrong_is_counted_with_an_example():
    sim = box(blackboxes.troubled)
    event, distance = ends(sim, [[9, 0], [1, 0], [5, 0], [6, 0], [7, 0], [1, 1], [8, 0]])
    np.testing.assert_array_equal(distance, [9, np.nan, np.nan, np.nan, np.nan, np.nan, 8])
    assert not event.any()
    found = {i.kind: i for i in incidents(sim)}
    assert sorted(i.kind for i in incidents(sim)) == [
        "NaN",
        "raised",
        "wrong answer",
        "wrong answer",
    ]
    assert found["raised"].count == 2
    assert found["raised"].disturbances.tolist() == [1, 0]
    assert found["raised"].x0 == ()
    assert found["raised"].message.startswith(
        "raised ZeroDivisionError: float division by zero (blackboxes.py:"
    )
    assert (
        str(found["NaN"])
        == "1 x NaN: distance is nan; return a finite number for every input; an episode without"
        " one does not count as a failure and has reward -inf"
    )
    before = incidents(sim)
    ends(sim, [[1, 2]])
    assert [(i.kind, i.count) for i in new_incidents(before, incidents(sim))] == [("raised", 1)]


@pytest.mark.slow
def test_a_search_goes_on_without_the_invalid_episodes(key):
    sim = box(blackboxes.Fragile, 3, episodic=False)
    found = jast.search.monte_carlo(key, sim, episodes=128, top=2)
    (only,) = incidents(sim)
    assert 0 < found.invalid < 128
    assert found.failing_share == 0
    assert only.count >= found.invalid
    assert (
        only.message == "raised RuntimeError: beyond 2"
        f" (blackboxes.py:{blackboxes.Fragile.transition.__code__.co_firstlineno + 3})"
    )
    assert len(only.disturbances) <= 3 and only.disturbances.sum() > 2


@pytest.mark.slow
def test_another_outcome_of_the_same_disturbances_is_seen(key):
    sim = box(blackboxes.Forgetful, 3)
    found = jast.search.cem(key, sim, samples=32, iterations=2, **TOLD)
    assert found.episodes == 64 and {i.kind for i in incidents(sim)} == {"not deterministic"}
    for episodic in (True, False):
        with pytest.raises(ValueError, match="differs between two runs"):
            jast.check(box(blackboxes.Forgetful, 3, episodic=episodic))


@pytest.mark.parametrize("answer", [str, lambda x: None, lambda x: np.array([x, x])])
def test_wrong_answers_are_one_whatever_they_are(answer):
    sim = box(lambda x: (False, answer(x[0])))
    with pytest.raises(ValueError, match="evaluate: 9 x wrong answer: distance must be one number"):
        jast.check(sim)
    assert [i.count for i in incidents(sim)] == [9]


def test_the_log_groups_and_is_bounded():
    log = Log()
    for kind, message in [
        ("raised", "raised E: at 0.25 of 3"),
        ("raised", "raised E: at -1.5e-07 of 3"),
        ("raised", "raised E: at 0.25 of 4"),
    ]:
        log.add(kind, message, lambda: ((), 0))
    assert [i.count for i in log.all()] == [2, 1]
    log = Log()
    for i in range(GROUPS + 20):
        log.add("raised", f"raised {i}", lambda i=i: ((), i))
    log.add("raised", "raised 3", lambda: pytest.fail("an example is made once"))
    found = log.all()
    assert len(found) == GROUPS + 1
    assert found[3].count == 2
    assert found[3].disturbances == 3
    assert found[-1].kind == "other" and found[-1].count == 20
    assert incidents(jast.simulators.walk1d()) == ()


def test_an_outcome_has_no_gradient():
    for sim in (box(blackboxes.walk), box(blackboxes.Walk, episodic=False)):
        slope = jax.grad(lambda x, sim=sim: jast.replay(sim, x).distance)(jnp.ones(2))
        assert np.isnan(slope).all()


@pytest.mark.long
def test_a_failure_probability():
    sim = box(blackboxes.branches, 1, MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2)))
    found = jast.estimate.failure_probability(jax.random.key(0), sim, 5000)
    assert abs(np.log(found.mean / 2.2227950662e-3)) < 0.25
    assert found.interval[0] < 2.2227950662e-3 < found.interval[1]
    assert abs(blackbox.calls(sim).episodes - 5000) < 500


def test_the_nominal_system():
    found = jast.nominal(jax.random.key(0), sim := box(blackboxes.walk, 4), episodes=500)
    assert not found.undisturbed.failure
    assert found.undisturbed.distance == 4
    assert 0 < found.failing < 50
    assert blackbox.calls(sim).episodes in (501, 502)


def test_an_object_runs_no_nominal_episode_in_vain():
    """Of 15 steps: 30 episodes, and the undisturbed one, which is begun and played."""
    sim = box(blackboxes.Walk, 15, episodic=False)
    jast.nominal(jax.random.key(0), sim, episodes=30)
    assert blackbox.calls(sim).episodes <= 30 + 2


def test_recorded_episodes_of_an_object_are_played_once_each(key):
    """As the numbers that tilts play them by."""
    sim = box(blackboxes.Walk, 4, episodic=False)
    episodes = jax.vmap(lambda k: jast.rollout(k, sim))(jax.random.split(key, 3))
    before = blackbox.calls(sim).rows
    z = numbers_of_episodes(sim, episodes._replace(states=None))
    assert z.shape == (3, 4) and blackbox.calls(sim).rows - before <= 3 * (1 + 4)
    x = np.where(np.arange(4) < np.asarray(episodes.length)[:, None], episodes.disturbances, 0)
    np.testing.assert_allclose(z, x, rtol=1e-5, atol=1e-6)


def test_seeds_are_the_disturbance_of_a_system_of_unknown_density():
    sim = blackbox.from_python(lambda seeds: (False, float(seeds[1])), horizon=2)
    episode = jast.rollout(jax.random.key(0), sim)
    assert episode.disturbances.dtype == jnp.uint32 and episode.log_prob == 0
    np.testing.assert_allclose(episode.distance, episode.disturbances[1], rtol=1e-6)
    seen = sim.observe(jax.tree.map(lambda a: a[-1], episode.states))
    np.testing.assert_allclose(seen, [1, float(episode.disturbances[1]) / 2**32], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("episodic", [False, True])
@pytest.mark.parametrize(
    "system, likelihood",
    [
        (blackboxes.Sampled, None),
        (blackboxes.Sampled, "log_prob"),
        (blackboxes.Likely, "prob"),
        (blackboxes.Evaluated, None),
    ],
)
def test_what_a_system_says_of_its_seeds_is_their_likelihood(key, system, likelihood, episodic):
    sim = box(system, 4, None, likelihood=likelihood, episodic=episodic)
    episode = jast.rollout(key, sim)
    steps = [blackboxes.Sampled().drawn(s) for s in episode.disturbances[: int(episode.length)]]
    truth = jax.device_get(jast.replay(in_jax(), jnp.asarray(np.append(steps, [0] * 4)[:4])))
    np.testing.assert_allclose(episode.log_prob, scipy.stats.norm.logpdf(steps).sum(), rtol=1e-5)
    assert episode.failure == truth.failure and np.isfinite(episode.distance)
    again = jast.replay(sim, episode.disturbances)
    assert again.log_prob == episode.log_prob and again.reward == episode.reward


@pytest.mark.slow
def test_failures_by_seeds_are_ranked_by_what_the_system_says(key):
    """The likeliest of 400 episodes comes first; without a word from the system all are alike."""
    found = jast.search.monte_carlo(key, box(blackboxes.Sampled, 4, None), episodes=400, top=5)
    log_p = np.asarray(found.failures.episodes.log_prob)
    assert len(log_p) == 5
    assert (np.diff(log_p) <= 0).all()
    assert found.best.log_prob == log_p[0] < -4
    silent = jast.search.monte_carlo(
        key, box(lambda s: (s[0] % 2 == 0, 1.0), 4, None), episodes=100, top=5
    )
    assert (np.asarray(silent.failures.episodes.log_prob) == 0).all()


@pytest.mark.slow
def test_a_requirement_keeps_what_the_system_says(key):
    sim = box(blackboxes.Sampled, 4, None)
    plain = jast.rollout(key, sim)
    for formula in (
        jast.specs.always(jast.specs.predicate(lambda s: 99 - s.seen[0]), 0, 4),
        jast.specs.eventually(jast.specs.predicate(lambda s: 99 + s.seen[0]), 2, 4),
    ):
        under = jast.replay(jast.specs.under(sim, formula), plain.disturbances)
        np.testing.assert_allclose(under.log_prob, plain.log_prob, rtol=1e-6)


@pytest.mark.slow
def test_a_likelihood_that_is_none_makes_an_episode_invalid(key):
    functions = (
        (lambda x: (3.0, True, 1.0), "prob", 0.0, np.log(3.0)),
        (lambda x: (0.0, True, 1.0), "prob", 0.0, -np.inf),
        (lambda x: (-1.0, True, 1.0), "prob", "gives -1.0 as p", None),
        (lambda x: (np.nan, True, 1.0), "log_prob", "gives nan as log p", None),
        (lambda x: ("one", True, 1.0), "log_prob", "must give log p, one number", None),
        (lambda x: (True, 1.0), "log_prob", r"expected \(p, event, distance\)", None),
    )
    for function, likelihood, said, log_p in functions:
        sim = box(function, 2, None, likelihood=likelihood)
        episode = jast.rollout(key, sim)
        assert np.isinf(episode.distance) == (log_p is None)
        if log_p is None:
            assert re.search(said, incidents(sim)[0].message)
        else:
            np.testing.assert_allclose(episode.log_prob, log_p, rtol=1e-6)


def test_disturbances_may_be_trees_that_depend_on_the_past():
    def disturbance(state):
        last = state.disturbances["gust"][state.t - 1]
        return Joint(
            {
                "gust": Independent(Normal(0.5 * last, 1.0), 1),
                "hit": Categorical(probs=jnp.array([0.5, 0.5])),
            }
        )

    run = lambda x: (bool(x["hit"].all()), float(x["gust"].sum()))
    with pytest.raises(ValueError, match="from_python: disturbance: .*; give like="):
        box(run, 3, disturbance)
    sim = box(run, 3, disturbance, like={"gust": jnp.zeros(2), "hit": jnp.int32(0)})
    episode = jast.rollout(jax.random.key(1), sim)
    assert episode.failure == episode.disturbances["hit"].all()
    np.testing.assert_allclose(episode.distance, episode.disturbances["gust"].sum(), rtol=1e-5)
    # a vector that needs no like
    sim = box(
        lambda x: (False, float(x[-1, 0])),
        3,
        lambda s: MultivariateNormalDiag(
            jnp.zeros(2) + s.t.astype(jnp.zeros(()).dtype), jnp.ones(2)
        ),
    )
    assert sim.init(()).disturbances.shape == (3, 2)


PROGRAM = """
import json, sys
task = json.load(sys.stdin)
x = task["disturbances"]
if x[0] == 1: sys.exit("no good")
print("a line before")
answer = {"event": task["x0"] is not None, "distance": sum(x)}
print("no answer" if x[0] == 2 else json.dumps(answer))
"""


def test_an_external_program():
    sim = box(blackbox.program([sys.executable, "-S", "-E", "-c", PROGRAM]))
    event, distance = ends(sim, [[3, 0.5], [1, 0], [2, 0]])
    np.testing.assert_array_equal(distance, [3.5, np.nan, np.nan])
    assert not event.any()
    raised, answered = sorted(incidents(sim))
    assert "exit status 1: no good" in raised.message
    assert answered.kind == "wrong answer"
    assert "received 'no answer'" in answered.message


@pytest.mark.skipif(os.name != "posix", reason="a shell of POSIX")
def test_a_program_is_not_waited_for_beyond_its_end():
    """A child keeps its outputs, of which a pipe holds a tenth."""
    much = "import sys; [f.write('x' * 10**6 + '\\n') for f in (sys.stdout, sys.stderr)]"
    answer = """echo '{"event": false, "distance": 2.5}'"""
    text = f'sleep 30 & {sys.executable} -c "{much}"; {answer}'
    started = time.monotonic()
    assert blackbox.program(["sh", "-c", text])(np.zeros(2)) == (False, 2.5)
    assert time.monotonic() - started < 20


def test_a_program_may_be_slow_to_read():
    """Of 10,000 numbers, more than a pipe holds."""
    text = "import json, sys, time; time.sleep(0.3); x = json.load(sys.stdin)['disturbances'];"
    text += "print(json.dumps(dict(event=False, distance=len(x))))"
    assert blackbox.program([sys.executable, "-c", text])(np.ones(10_000)) == (False, 10_000)


def test_a_gymnasium_environment():
    gymnasium = pytest.importorskip("gymnasium")
    make = lambda: gymnasium.make("CartPole-v1").unwrapped
    upright = lambda now: 0.2095 - abs(float(now.observation[2]))
    system = blackbox.gymnasium_system(
        make,
        upright,
        agent=lambda seen: int(seen[2] + 0.5 * seen[3] > 0),
        apply=lambda a, x: a if x < 1 else 1 - a,
    )
    sim = box(system, 25, start=jast.distributions.seeds(), episodic=False)
    one = jast.replay(sim, jnp.full(25, 2.0), x0=jnp.uint32(3))  # it always does the opposite
    assert one.failure
    assert 5 < one.length < 25
    assert one.distance < 0
    env = make()
    seen, _ = env.reset(seed=3)
    for n in range(1, 26):  # noqa: B007
        seen, _, over, _, _ = env.step(int(seen[2] + 0.5 * seen[3] <= 0))
        if over:
            break
    assert n == one.length
    np.testing.assert_allclose(one.states.seen[one.length], seen, rtol=1e-6)
    assert not jast.replay(sim, jnp.zeros(25), x0=jnp.uint32(3)).failure and incidents(sim) == ()
    # the disturbance is the action
    whole = blackbox.gymnasium_system(make, upright, apply=lambda a, x: int(x > 0))
    whole = box(whole, 25, episodic=True)
    assert ends(whole, np.ones((1, 25)))[0].all() and incidents(whole) == ()


class Mute(blackboxes.Walk):
    is_event = None


class Waits(blackboxes.Walk):
    def observe(self):
        return "nothing"


@pytest.mark.parametrize(
    "system, settings, message",
    [
        (
            3,
            {},
            "from_python: system must be a function of the disturbances, or a class, received 3",
        ),
        (blackboxes.Walk(), {}, "give its class"),
        (Mute, {}, "Mute lacks is_event"),
        (lambda: Mute(), {}, "Mute lacks is_event"),
        (lambda: 1 / 0, {}, "raised ZeroDivisionError"),
        (Waits, {}, "observe must return a vector of numbers, received 'nothing'"),
        (Looks, {}, r"observe returns 135 numbers, .* pass observe=, .* lambda s: s.seen\[:64\]"),
        (
            blackboxes.walk,
            {"start": lambda: NORMAL},
            r"function of \(disturbances, x0\), since start is random, received walk",
        ),
        (blackboxes.walk, {"episodic": False}, "episodic=False needs a class"),
        (blackboxes.walk, {"episodic": 1}, "episodic must be True, False or None"),
        (blackboxes.walk, {"likelihood": "p"}, 'likelihood must be "log_prob", "prob" or None'),
        (blackboxes.walk, {"horizon": 0}, "from_python: horizon"),
        (blackboxes.walk, {"workers": -1}, "from_python: workers"),
        (
            blackboxes.walk,
            {"time_limit": 0.0, "workers": 1},
            "from_python: time_limit must be a number of seconds above 0",
        ),
        (blackboxes.walk, {"time_limit": 1.0}, "time_limit needs workers of at least 1"),
        (blackboxes.walk, {"disturbance": 3.0}, "disturbance must be a distribution"),
        (
            blackboxes.walk,
            {"disturbance": lambda s: 3.0},
            "disturbance: TypeError: expected a distribution, received 3.0",
        ),
        (blackboxes.walk, {"start": 3.0}, "start must be a distribution"),
        (blackboxes.walk, {"observe": 3.0}, "observe must be a function"),
    ],
)
def test_bad_input_is_named(system, settings, message):
    with pytest.raises(ValueError, match=message):
        box(system, **{"horizon": 2, **settings})


def test_bad_programs_and_environments_are_named():
    for command, message in (
        ("no-such-program -x", "'no-such-program' was not found"),
        ([], "must name a program"),
        (__file__, "was not found or is not executable"),
    ):
        with pytest.raises(ValueError, match=message):
            blackbox.program(command)
    with pytest.raises(ValueError, match="folder must be a directory"):
        blackbox.program("true", folder="/no/such/folder")
    for settings, message in (
        (dict(agent=len), "needs apply"),
        (dict(seed=-1), "seed must be"),
        (dict(event=3), "event must be a function"),
    ):
        with pytest.raises(ValueError, match=f"gymnasium_system: .*{message}"):
            blackbox.gymnasium_system(len, len, **settings)
    with pytest.raises(ValueError, match="calls: sim must be"):
        blackbox.calls(jast.simulators.walk1d())


class Counted(blackboxes.Walk):
    made = 0

    def __init__(self):
        type(self).made += 1


def test_objects_serve_many_episodes(monkeypatch):
    """One for each history that goes on, and those that ended are used again."""
    for episodic, most in ((True, 1), (False, 4)):
        Counted.made = 0
        spec = Spec(False, episodic, 3, (), False, None)
        runner = worker.Runner(Counted, spec)
        runner.configure(0, 0)
        rows = np.random.default_rng(0).normal(size=(4, 3))
        for _ in range(3):
            for t in range(3 if episodic else 0, 4):
                reply = runner(np.full(4, t), [], [rows])
        assert Counted.made == most
        assert reply.problems == []
        assert runner.kept == {}
        np.testing.assert_allclose(reply.distance, 4 - rows.sum(1))
    # no more are kept than there is room for: of the lost ones the histories are repeated
    monkeypatch.setattr(worker, "KEPT", 2)
    runner = worker.Runner(Counted, spec)
    runner.configure(0, 0)
    runner(np.full(4, 1), [], [rows])
    assert (runner.count, len(runner.kept), len(runner.spare)) == (2, 2, 1)
    reply = runner(np.full(4, 2), [], [rows])
    assert (reply.episodes, reply.transitions) == (4, 8)  # 0 and 1 push out 2 and 3
    np.testing.assert_allclose(reply.distance, np.maximum(4 - rows[:, :2].sum(1), 0))


@pytest.mark.slow
def test_an_example_ends_where_it_went_wrong(key):
    sim = box(blackboxes.Fragile, 6)
    jast.search.monte_carlo(key, sim, episodes=64, top=2)
    (only,) = incidents(sim)
    sums = np.cumsum(only.disturbances)
    assert len(sums) < 6 and sums[-1] > 2 >= sums[:-1].max(initial=0)


@pytest.mark.skipif(jax.config.jax_enable_x64, reason="the number is one in float64")
def test_a_distance_beyond_the_precision_is_no_number():
    class Far(blackboxes.Walk):
        def is_event(self):
            return self.s > 0

        def miss_distance(self):
            return 1e300 if self.s > 0 else 0.0

    sim = box(Far, 3)
    state = sim.step(sim.init(()), jnp.ones(()))
    assert not state.event
    assert state.terminal
    assert np.isnan(state.distance)
    (only,) = incidents(sim)
    assert (only.kind, only.message) == ("NaN", "distance is 1e+300, too large for float32")
    assert only.disturbances.tolist() == [1]


def test_the_memory_of_outcomes_is_bounded(monkeypatch):
    monkeypatch.setattr(answers, "HELD", 2 * answers.ENTRY)
    outcome = [0.0]
    sim = box(lambda x: (bool(x[0] > 5), outcome[0]))
    ends(sim, [[1, 0], [2, 0], [3, 0], [9, 0]])  # the first is forgotten; failures have their own
    held = sim.evaluate.func.host.answers
    assert (len(held.failing), len(held.others)) == (1, 2)
    outcome[0] = 1.0
    ends(sim, [[1, 0]])
    assert incidents(sim) == ()
    ends(sim, [[3, 0], [9, 0]])
    (only,) = incidents(sim)
    assert only.count == 2 and only.message.endswith("gave two distances")


def test_a_folder_beside_the_package_is_the_users_own():
    """Its path begins with the package's, as that of jast_models beside jast does."""
    path = f"{os.path.dirname(jast.__file__)}_models/system.py"
    code = compile("\n\ndef step():\n    return 1 / 0\n", path, "exec")
    exec(code, names := {})
    with pytest.raises(ZeroDivisionError) as raised:
        names["step"]()
    assert readings.line_of(raised.value) == " (system.py:4)"
