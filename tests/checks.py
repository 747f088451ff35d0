"""What holds in each result of a search and in estimates; how many programs were compiled."""

from contextlib import contextmanager

import jax
import numpy as np

import jast
from jast import failures as F


def honest(result, sim, reward):
    """What holds in every result."""
    archive, history = result.failures, result.history
    assert archive.seen == history.failures[-1] == round(result.failing_share * result.episodes)
    assert archive.episodes.failure.all() and archive.counts.sum() <= archive.seen
    assert (np.diff(archive.episodes.reward) <= 0).all()
    assert len({F.identity(archive.episode(i)) for i in range(archive.size)}) == archive.size
    assert (result.first_failure is None) == (archive.seen == 0)
    failing = result.failing_per_tree
    assert failing.any() == (archive.seen > 0) and result.failing_trees == failing.mean()
    assert result.failing == archive.seen
    assert np.isfinite(result.roots.visits).all() and np.isfinite(result.roots.q).all()
    if archive.size:
        assert float(result.best.reward) == archive.episodes.reward[0]
        np.testing.assert_allclose(
            result.best_reward_per_tree[failing].max(),
            result.best.reward,
            rtol=1e-4,
        )
        assert 1 <= result.first_failure <= result.episodes
    if archive.seen == 0:
        assert not result.best.failure
        best = result.best_reward_per_tree[np.isfinite(result.best_reward_per_tree)]
        assert not best.size or np.isclose(best.max(), result.best.reward, rtol=1e-4)
    replays(result.best, sim, reward)


def archive_replays(sim, result, reward, equal):
    """Every archived failure fails again with the very same numbers, the best comes first; how many
    there are.
    """
    f = result.failures
    for i in range(f.size):
        again = jax.device_get(jast.replay(sim, f.episode(i), reward=reward)._replace(states=None))
        equal(again, f.episode(i))
        assert again.failure
    assert list(f.episodes.reward) == sorted(f.episodes.reward, reverse=True)
    assert f.seen == round(result.failing_share * result.episodes)
    if f.size:
        assert result.best.reward == f.episodes.reward[0] and result.best.failure
    return f.size


def reward_of(result):
    """The lexicographic reward of a search, of the scales that its result states."""
    assert result.settings["reward"] == "rewards.lexicographic"
    return jast.rewards.lexicographic(**result.settings["reward_settings"])


def replays(episode, sim, reward):
    again = jax.device_get(jast.replay(sim, episode, reward=reward))
    for name in ("log_prob", "distance", "failure", "length", "reward"):
        a, b = np.asarray(getattr(again, name)), np.asarray(getattr(episode, name))
        assert a.dtype == b.dtype and a.tobytes() == b.tobytes(), name


def same(a, b):
    """Whether two results are of the same trees, to the bit."""
    np.testing.assert_array_equal(a.best_reward_per_tree, b.best_reward_per_tree)
    np.testing.assert_array_equal(a.history.best_reward, b.history.best_reward)
    np.testing.assert_array_equal(a.history.failures, b.history.failures)
    np.testing.assert_array_equal(a.roots.visits, b.roots.visits)
    np.testing.assert_array_equal(a.roots.q, b.roots.q)
    assert (a.episodes, a.first_failure, a.failing_share, a.invalid) == (
        b.episodes,
        b.first_failure,
        b.failing_share,
        b.invalid,
    )
    np.testing.assert_array_equal(a.failures.episodes.reward, b.failures.episodes.reward)
    np.testing.assert_array_equal(a.failures.counts, b.failures.counts)
    assert a.failures.seen == b.failures.seen


def check_estimate(found, truth, precision=0.05, budget=np.inf):
    """Within 4 of its standard errors, which are small; believed; and no more evaluations than were
    granted.
    """
    assert abs(found.log_mean - np.log(truth)) < 4 * found.relative_error, str(found)
    assert found.relative_error < precision, str(found)
    assert found.reliable, str(found)
    assert found.evaluations <= budget, str(found)


@contextmanager
def compiled():
    """A list that grows by each program that is compiled meanwhile."""
    heard = []

    def listen(event, seconds, **about):
        if event == "/jax/core/compile/backend_compile_duration":
            heard.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield heard
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
