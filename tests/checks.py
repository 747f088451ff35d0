"""What holds in each result of a search, in estimates and in trainings; how many programs were
compiled.
"""

import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jast
from jast._src.core import failures as F

ROOT = Path(__file__).parents[1]


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


def whole_training(train, path):
    """An uninterrupted training with its checkpoint at ``path``, and the rows that the callback
    got. ``train(number_of_the_key, **settings)`` gives a policy.
    """
    rows = []
    tell = lambda done, total, so_far: rows.append((done, total, so_far))
    return train(3, checkpoint=path, callback=tell), rows, path


def check_rows(policy, rows):
    """The callback got the rows of the history, one more at each call."""
    assert len(rows) == len(policy.history.episodes) >= 10
    assert all(done <= total for done, total, _ in rows)
    assert rows[-1][0] == rows[-1][1] >= policy.steps
    assert (np.diff(policy.history.episodes) >= 0).all()
    for n, (*_, so_far) in enumerate(rows):
        np.testing.assert_array_equal(so_far.episodes, policy.history.episodes[: n + 1])
        np.testing.assert_array_equal(so_far.failing_share, policy.history.failing_share[: n + 1])


def check_key_decides(train, policy, equal):
    """The key of `whole_training` gives its ``policy`` again; another one gives another."""
    again = train(3)
    equal(again.learned, policy.learned)
    equal(again.history, policy.history)
    other = train(4).learned
    assert not np.array_equal(*(jax.tree.leaves(p.actor)[0] for p in (other, again.learned)))


def check_training_goes_on(train, policy, path, equal):
    """A training that is interrupted goes on from its checkpoint to the bits of ``policy``."""
    seen = []

    def stop(done, total, so_far):
        seen.append(done)
        if len(seen) == 4:
            raise KeyboardInterrupt

    part = train(3, checkpoint=path, callback=stop)
    assert len(part.history.episodes) == 4  # what is there is handed out
    rest = train(3, checkpoint=path)
    equal(rest.learned, policy.learned)
    equal(rest.history, policy.history)


def weighted_episodes(key, sim, policy, n):
    """Log importance weights (-inf where it did not fail), x0 and the last state of ``n`` episodes
    of ``policy``.
    """

    def one(key):
        e = jast.rollout(key, sim, policy)
        steps = jax.vmap(lambda s, t, x: policy.disturbance(s, t).log_prob(x))(
            jax.tree.map(lambda a: a[:-1], e.states),
            jnp.arange(sim.horizon, dtype=jnp.int32),
            e.disturbances,
        )
        log_q = policy.start().log_prob(e.x0) + jnp.sum(
            jnp.where(jnp.arange(sim.horizon, dtype=jnp.int32) < e.length, steps, 0)
        )
        return (
            jnp.where(e.failure, e.log_prob - log_q, -jnp.inf),
            e.x0,
            jax.tree.leaves(e.states)[-1][e.length],
        )

    return jax.jit(jax.vmap(one))(jax.random.split(key, n))


def python(*arguments, cwd):
    """What a Python program prints that runs with this jast in the folder ``cwd``."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": path, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


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
