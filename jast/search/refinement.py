"""refine: from failures to the likeliest failures near them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import _checks, results
from jast.counter import generator
from jast.episode import Episode, replay
from jast.failures import Failures, collect, empty
from jast.incidents import hosted
from jast.limit_state import check, episodes, normal_of
from jast.results import asked
from jast.search import moves as M
from jast.simulator import Simulator

__all__ = ["Refined", "refine"]

POINTS, DIFFERENCES, GRADIENT = 16, 64, 4
"""Failures that are pulled side by side; differences of a point in a round; evaluations that a
gradient of distance and log p is counted as.
"""
LOOK, LIKE, STILL, ENOUGH = 10, 0.02, 1e-6, 30
"""Rounds between two looks at the points; those nearer to one another than this share of their way
from the anchor go on as one; the work ends where no cost falls by more than this share of it; the
budget gives each point at least so many rounds.
"""
LIFTS = 0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2


@results.result("episodes")
class Refined(NamedTuple):
    """Failures, pulled to where they are likeliest."""

    failures: Failures
    """By falling log p relative to the mode, which is their reward; all replay."""
    origin: np.ndarray
    """[n] int: which of the failures given each comes from."""
    residual: np.ndarray
    """[n] float: how far from a local optimum: the slope of log p along the boundary of failure, as
    a share of its whole slope; NaN where the miss distance has no gradient."""
    gain: np.ndarray
    """[n] float: log p gained."""
    late: np.ndarray
    """[n] float: log p gained in the last tenth of the work."""
    episodes: int
    """Evaluations: episodes simulated; one with its gradient counts as 4."""
    invalid: int
    settings: dict

    def __str__(self):
        n = len(self.failures)
        if not n:
            return f"refine: no failure to pull, {self.episodes} evaluations"
        lines = [f"refine: {n} failure{'s' * (n > 1)}, {self.episodes} evaluations"]
        lines.append(f"{'rank':>4} {'log p rel.':>11} {'gained':>9} {'lately':>9} {'residual':>9}")
        for i in range(min(n, 10)):
            residual = "-" if np.isnan(self.residual[i]) else f"{self.residual[i]:.1e}"
            lines.append(
                f"{i + 1:4d} {float(self.failures.episodes.reward[i]):11.4f} {self.gain[i]:9.4f}"
                f" {self.late[i]:9.1e} {residual:>9}"
            )
        return "\n".join(lines)


def refine(
    key: jax.Array,
    sim: Simulator,
    failures: Failures | Episode,
    *,
    budget: int = 10_000,
    gradients: bool = True,
) -> Refined:
    """Pull failures to local maxima of log p among the failures.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        failures: an archive (`jast.failures`), or a batch of failing episodes.
        budget: evaluations, at least 100.
        gradients: differentiate through the simulator; a system on the host, and one whose miss
            distance is flat, has its slopes told from differences.

    Returns:
        `Refined`: at most 16 of the failures, the likeliest and those farthest from one another,
        each moved as far as the budget goes; those that meet are one. log p counts relative to the
        mode wherever the distributions have modes. A failure that nothing betters comes back as it
        was, and one that does not replay is left out.

    Raises:
        ValueError: for a budget below 100, failures that do not fit the simulator, and disturbances
            without a quantile function, as those of unknown density, which have no likeliest.
    """
    name = "refine"
    _checks.random_key(name, key)
    budget = _checks.whole(name, "budget", budget, 100)
    check(name, sim)
    gradients = bool(gradients) and not hosted(sim)
    settings = asked(name, key, budget=budget, gradients=int(gradients))
    given = failures.episodes if isinstance(failures, Failures) else failures
    if not np.ndim(given.length):
        given = jax.tree.map(lambda a: np.asarray(a)[None], given)
    given = jax.device_get(given._replace(states=None))
    rng, home, z = generator(key), M.anchor(sim), normal_of(sim, given)
    cost = M.SIZE + (GRADIENT if gradients else min(DIFFERENCES, len(home)))
    rows = spread(z, np.asarray(given.reward), max(1, min(POINTS, budget // (ENOUGH * cost))))
    points, spent = _started(sim, home, z[rows])
    work = _Work(rng, sim, home, points, rows, gradients, cost)
    work.run(budget - spent)
    return work.result(given, settings, spent)


def spread(z: np.ndarray, value: np.ndarray, n: int) -> np.ndarray:
    """At most ``n`` rows of ``z`` [m, D]: the one of the highest ``value`` [m], then by turns the
    farthest from those and the next by value.
    """
    left = list(np.argsort(-value, kind="stable"))
    unit = z / np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-12)
    kept = [left.pop(0)] if left else []
    while left and len(kept) < n:
        nearest = (unit[left] @ unit[kept].T).max(axis=1)
        kept.append(left.pop(0 if len(kept) % 4 == 3 else int(np.argmin(nearest))))
    return np.array(kept, np.int64)


def _started(sim: Simulator, home: jax.Array, z: np.ndarray) -> tuple[M.Point, int]:
    """The `Point` of each of ``z`` [n, D], lifted from the anchor as little as makes it fail, on
    the host; cost inf where nothing does. And the evaluations.
    """
    lifted = np.asarray(home) + (z - np.asarray(home)) * (1 + np.array(LIFTS))[:, None, None]
    n, d = z.shape
    points, verdict = jax.device_get(M.begun(sim, jnp.asarray(lifted.reshape(-1, d), z.dtype)))
    fails = verdict.failure.reshape(len(LIFTS), n)
    first = np.argmax(fails, axis=0) * n + np.arange(n)
    points = jax.tree.map(lambda a: a[first], points)
    return points._replace(cost=np.where(fails.any(axis=0), points.cost, np.inf)), len(lifted) * n


class _Work:
    """Points on their way, those of one place put together, and what they cost."""

    def __init__(self, rng, sim, home, points, rows, gradients, cost):
        alive = np.isfinite(points.cost)
        self.rng, self.sim, self.home, self.gradients = rng, sim, home, gradients
        self.points, self.origin = jax.tree.map(lambda a: a[alive], points), rows[alive]
        self.first, self.cost = self.points.cost.copy(), cost
        self.spent, self.invalid, self.log = 0, 0, []

    def run(self, budget):
        self.log.append((0, self.points.cost))
        while len(self.origin):
            before = self.points.cost.sum()
            size = 1 << (len(self.origin) - 1).bit_length()
            for _ in range(LOOK):
                if self.spent + size * self.cost > budget:
                    return
                self._round(size)
            self.log.append((self.spent, self.points.cost))
            still = before - self.points.cost.sum() <= STILL * abs(before)
            if still and self.points.turn.min() >= 4 * LOOK:
                return
            self._merge()

    def _round(self, size):
        rows = np.arange(size) % len(self.origin)
        points = jax.tree.map(lambda a: jnp.asarray(a[rows]), self.points)
        d, real = len(self.home), points.z.dtype
        part = min(DIFFERENCES, d)
        first = part * int(self.points.turn[0])
        uniform = lambda *shape: jnp.asarray(self.rng.random(shape), real)
        noise = M.Noise(
            jnp.asarray(self.rng.standard_normal((size, M.WALKS, d)), real),
            uniform(size, M.REMOVALS, d),
            uniform(size, M.REMOVALS) ** 2,
            jnp.asarray(10.0 ** -self.rng.integers(0, 5, (size, M.REMOVALS)), real),
            jnp.asarray(np.tile((first + np.arange(part)) % d, (size, 1)), jnp.int32),
            jnp.asarray(self._shifts(size), jnp.int32),
        )
        points, invalid = M.round_of(self.sim, self.home, points, noise, self.gradients)
        n = len(self.origin)
        self.points = jax.tree.map(lambda a: np.asarray(a)[:n], points)
        self.invalid += int(invalid)
        self.spent += size * self.cost

    def _shifts(self, size):
        far = self.rng.integers(2, max(3, self.sim.horizon // 3), (size, 1))
        return np.concatenate([np.ones_like(far), -np.ones_like(far), far, -far], axis=1)

    def _merge(self):
        """Of points of one place the cheapest goes on."""
        z = self.points.z - np.asarray(self.home)
        kept = []
        for i in np.argsort(self.points.cost, kind="stable"):
            near = [np.linalg.norm(z[i] - z[j]) <= LIKE * np.linalg.norm(z[j]) for j in kept]
            if not any(near):
                kept.append(i)
        kept = np.sort(kept)
        self.points = jax.tree.map(lambda a: a[kept], self.points)
        self.origin, self.first = self.origin[kept], self.first[kept]
        self.log = [(at, cost[kept]) for at, cost in self.log]

    def result(self, given, settings, spent):
        n = len(self.origin)
        residual = np.full(n, np.nan)
        if self.gradients and n:
            residual = np.asarray(M.residuals(self.sim, self.home, self.points), np.float64)
        late = [cost for at, cost in self.log if at <= 0.9 * self.spent][-1] - self.points.cost
        reward, kept = M.likelihood(self.sim), []
        z, home = self.points.z, np.asarray(self.home)
        for i in range(n):
            tries = home + (z[i] - home) * (1 + np.array(LIFTS))[:, None]
            tries = jax.device_get(episodes(self.sim, jnp.asarray(tries, z.dtype)))
            own = jax.tree.map(lambda a, i=i: a[self.origin[i]], given)
            tries = [jax.tree.map(lambda a, k=k: a[k], tries) for k in range(len(LIFTS))]
            for e in [*tries, own._replace(states=None)]:
                if bool(replay(self.sim, e, reward=reward).failure):
                    kept.append((i, e))
                    break
        if kept:
            stacked = jax.tree.map(lambda *a: np.stack(a), *(e for _, e in kept))
            which = np.array([i for i, _ in kept])
            found = collect(self.sim, reward, stacked, simulation=which, top=len(which))
            i = found.simulation
        else:
            found, i = empty(self.sim), np.zeros(0, np.int64)
        return Refined(
            found,
            self.origin[i],
            residual[i],
            (self.first - self.points.cost)[i].astype(np.float64),
            late[i].astype(np.float64),
            spent + self.spent,
            self.invalid,
            settings,
        )
