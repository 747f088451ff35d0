"""refine: from failures to the likeliest failures near them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.episode import Episode, replay, stacked
from jast._src.core.failures import Failures, collect, empty
from jast._src.core.rewards import likelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PathLike, PRNGKey
from jast._src.normal_space.mode_coordinates import centred
from jast._src.normal_space.transform import check, normal_of, played, unit
from jast._src.runtime.checkpoints import keep_answers, open_checkpoint
from jast._src.runtime.host_errors import runs_on_host
from jast._src.search.refine.candidates import SIZE, Point, draw_noise
from jast._src.search.refine.connectivity import distinct_points
from jast._src.search.refine.round import first_points, residuals, round_of
from jast._src.util import checks, display
from jast._src.util.display import call_settings
from jast._src.util.pytrees import count_numbers, index_tree

__all__ = ["GRADIENT", "Refined", "first_failing_lift", "lift", "refine"]

POINTS = 16  # failures that are pulled side by side
DIFFERENCES = 64  # differences of a point in a round
GRADIENT = 4  # evaluations that a gradient of distance and log p is counted as
LOOK = 5  # rounds between two looks at the points
SAME_PLACE = 0.02  # points nearer to one another than this share of their norm go on as one
SMALL_GAIN = 1e-6
"""Share of its cost, less than which a point gained in `PATIENCE` looks once it has arrived."""
PATIENCE = 6  # looks without gain before a point has converged
STARTING = 0.5  # share of the budget in which further failures are started with
MIN_ROUNDS = 15  # rounds that a further failure must still get: fewer do not bring it near its end
ALIKE = 0.7  # in the rest, of points with at least this cosine only the likeliest goes on
LIFTS = np.array([0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2])
"""How much farther out a point may be taken that is on the knife edge, where one program says that
it fails and another one that it does not: the least that makes it fail."""


@display.result_class("episodes")
class Refined(NamedTuple):
    """Failures, pulled to where they are likeliest.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(key, sim, episodes=500, refine=0).failures
        >>> refined = jast.search.refine(key, sim, found, budget=2000)
        >>> bool((refined.gain >= 0).all()), len(refined.origin) == len(refined.failures)
        (True, True)
    """

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
    settings: dict[str, Any]

    def __str__(self) -> str:
        n = len(self.failures)
        if not n:
            return f"refine: there was no failure to refine; {self.episodes} evaluations"
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
    key: PRNGKey,
    sim: Simulator,
    failures: Failures | Episode,
    *,
    budget: int = 10_000,
    gradients: bool = True,
    checkpoint: PathLike | None = None,
) -> Refined:
    """Pull failures to local maxima of log p among the failures.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        failures: an archive (`jast.failures`), or a batch of failing episodes.
        budget: evaluations, at least 100; a black box never runs more often.
        gradients: differentiate through the simulator; a system on the host, and one whose miss
            distance is flat, has its slopes told from differences.
        checkpoint: a folder that keeps what the system answered. The same call then goes on where
            it was stopped, to the same result.

    Returns:
        `Refined`: the likeliest failures near those given, which are started with 16 at a time, the
        likeliest and those farthest from one another first, for as long as the budget lasts; those
        that meet are one. log p counts relative to the mode wherever the distributions have modes.
        A failure that nothing betters comes back as it was, and one that does not replay is left
        out.

    Raises:
        ValueError: for a budget below 100, failures that do not fit the simulator, and disturbances
            without a quantile function, as those of unknown density, which have no likeliest.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(key, sim, episodes=500, refine=0).failures
        >>> refined = jast.search.refine(key, sim, found, budget=2000)
        >>> abs(float(refined.failures.best.disturbances.sum())) < 10.01  # nothing is wasted
        True
    """
    name = "refine"
    checks.check_random_key(name, key)
    budget = checks.whole_number(name, "budget", budget, 100)
    check(name, sim)
    gradients = bool(gradients) and not runs_on_host(sim)
    settings = call_settings(name, key, budget=budget, gradients=int(gradients))
    given = failures.episodes if isinstance(failures, Failures) else failures
    words = "an archive of jast.failures or a batch of failing episodes"
    checks.instance(name, "failures", given, Episode, words)
    if not np.ndim(given.length):
        given = jax.tree.map(lambda a: np.asarray(a)[None], given)
    given = jax.device_get(given._replace(states=None))
    about = dict(sim=sim, failures=given, budget=budget, gradients=gradients)
    with open_checkpoint(name, checkpoint, key, **about) as store, keep_answers(store):
        work = _Refinement(numpy_generator(key), sim, given, gradients)
        work.run(budget)
        return work.result(settings)


def lift(points: np.ndarray) -> np.ndarray:
    """The ``points`` [n, D] by each of `LIFTS` farther from the origin: [L, n, D]."""
    return points * (1 + LIFTS.astype(points.dtype))[:, None, None]


def first_failing_lift(failure: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Which of ``n`` points fail [m], by the failures of all rows of `lift`, and the row [m] of the
    least lift of each that does.
    """
    failure = failure.reshape(-1, n)
    points = np.flatnonzero(failure.any(axis=0))
    return points, np.argmax(failure[:, points], axis=0) * n + points


HOSTED_LIFTS = 2  # lifts of each point that are tried at the end where each is a run of a black box


class _Track:
    """One point on its way."""

    def __init__(self, point: Point, origin: int, spent: int):
        self.point, self.origin = point, origin
        self.first = float(point.cost)
        self.log = [(spent, self.first)]

    def arrived(self) -> bool:
        """Whether the last looks gained nothing to speak of."""
        if len(self.log) <= PATIENCE:
            return False
        before = self.log[-1 - PATIENCE][1]
        return before - self.log[-1][1] <= SMALL_GAIN * abs(before)


class _Refinement:
    """Points on their way, those that have arrived, failures yet to be tried, and the cost."""

    def __init__(self, rng, sim, given, gradients):
        self.rng, self.sim, self.given, self.gradients = rng, sim, given, gradients
        self.hosted = runs_on_host(sim)
        self.of_modes, self.first = centred(sim), count_numbers(signature_of(sim).x0)
        self.v = normal_of(self.of_modes, given)
        self.value = np.asarray(given.reward, np.float64)
        self.left = list(np.argsort(-self.value, kind="stable"))
        self.seen = np.zeros((0, self.v.shape[1]))
        self.live, self.arrived, self.done = [], [], []
        self.cost = SIZE + (GRADIENT if gradients else min(DIFFERENCES, self.v.shape[1]))
        self.spent = self.invalid = self.turn = 0

    def run(self, budget):
        narrowed = False
        while True:
            if self.spent < STARTING * budget or not self.live + self.arrived:
                self._start_more(budget)
            elif not narrowed:
                self._narrow()
                narrowed = True
            if not self.live:
                return
            for _ in range(LOOK):
                if self.spent + len(self.live) * self.cost > budget - self._at_the_end():
                    return
                self._round()
            for track in self.live:
                track.log.append((self.spent, float(track.point.cost)))
            going, _ = self._distinct(distance=SAME_PLACE)
            self.arrived = [t for t in self.arrived if t in going]
            self.live = [t for t in self.live if t in going]
            self.arrived += [t for t in self.live if t.arrived()]
            self.live = [t for t in self.live if not t.arrived()]

    def _at_the_end(self):
        """Runs of a black box that `result` may take."""
        return HOSTED_LIFTS * len(self.live + self.arrived + self.done) if self.hosted else 0

    def _distinct(self, **same):
        """The tracks that are not the same as a likelier one (`distinct_points`), the likeliest
        first, and the others.
        """
        tracks = sorted(self.arrived + self.live, key=lambda t: t.point.cost)
        rows = distinct_points(np.stack([t.point.v for t in tracks]), **same)
        chosen = [tracks[i] for i in rows]
        return chosen, [t for t in self.arrived + self.live if t not in chosen]

    def _start_more(self, budget):
        """Start with further failures where there is room: as many as get `MIN_ROUNDS`."""
        worth = (budget - self.spent) // (MIN_ROUNDS * self.cost)
        room = 1 << (max(1, min(POINTS, worth)).bit_length() - 1)
        if 2 * len(self.live) > room or (worth < 1 and self.arrived + self.live):
            return
        rows, lifts = self._next(room - len(self.live)), [slice(None)]
        if self.hosted:  # a black box runs farther out only where it must
            lifts = [slice(i, i + 1) for i in range(len(LIFTS))]
        for some in lifts:
            if rows:
                rows = self._start_at(rows, lift(self.v[rows])[some])

    def _start_at(self, rows, lifted):
        """Start where the least of the lifts, [L, n, D] of ``rows``, fails; returns the rows of
        which none does.
        """
        points, failure = first_points(self.of_modes, lifted.reshape(-1, self.v.shape[1]))
        self.spent += len(failure)
        started, places = first_failing_lift(failure, len(rows))
        for k, place in zip(started, places, strict=True):
            point = Point(*(a[place] for a in points))
            self.live.append(_Track(point, int(rows[k]), self.spent))
        return [row for k, row in enumerate(rows) if k not in started]

    def _next(self, n):
        """At most ``n`` of the failures not yet tried: the likeliest; then by turns the likeliest
        for how far it points away from all that were tried and found, the farthest, and the next.
        """
        found = [t.point.v for t in self.live + self.arrived]
        seen = unit(np.concatenate([self.seen, np.reshape(found, (-1, self.v.shape[1]))]))
        ways, rows = unit(self.v), []
        best = self.value.max(initial=-np.inf)
        scale = max(-self.value.max(initial=-1.0), 1.0)
        worth = np.exp(-2 * (best - self.value) / scale)
        while self.left and len(rows) < n:
            i, turn = 0, len(self.seen) % 4
            if len(seen) and turn != 3:
                apart = 1 - (ways[self.left] @ seen.T).max(axis=1)
                i = int(np.argmax(apart * worth[self.left] if turn == 1 else apart))
            row = self.left.pop(i)
            rows.append(row)
            self.seen = np.concatenate([self.seen, self.v[row : row + 1]])
            seen = np.concatenate([seen, ways[row : row + 1]])
        return rows

    def _round(self):
        size, points = len(self.live), _stacked(self.live)
        k = min(DIFFERENCES, self.v.shape[1])
        part = None if self.gradients else (k * self.turn + np.arange(k)) % self.v.shape[1]
        noise = draw_noise(self.rng, points.v, self.sim.horizon)
        points, invalid = round_of(self.of_modes, self.first, points, noise, part)
        for i, track in enumerate(self.live):
            track.point = Point(*(a[i] for a in points))
        self.invalid += invalid
        self.turn += 1
        self.spent += size * self.cost

    def _narrow(self):
        """Points that are like a likelier one end here: what is left of the budget is for those.
        One that had arrived goes on, as it may have been unlucky.
        """
        going, self.done = self._distinct(cosine=ALIKE)
        for t in going:
            t.log = t.log[-1:] if t in self.arrived else t.log
        self.live, self.arrived = going[:POINTS], going[POINTS:]

    def result(self, settings):
        tracks = self.arrived + self.live + self.done
        n = len(tracks)
        costs = np.array([float(t.point.cost) for t in tracks])
        gain = np.array([t.first for t in tracks]) - costs
        before = [[c for at, c in t.log if at <= 0.9 * self.spent] or [t.log[0][1]] for t in tracks]
        late = np.array([c[-1] for c in before]) - costs
        origin, residual = np.array([t.origin for t in tracks], np.int64), np.full(n, np.nan)
        reward, failing = likelihood(self.sim), {}
        if n:
            points = _stacked(tracks)
            if self.gradients:
                residual = residuals(points).astype(np.float64)
            lifted = lift(points.v.astype(np.float64))[: HOSTED_LIFTS if self.hosted else None]
            tries = played(self.of_modes, lifted.reshape(-1, self.v.shape[1]))
        for i in range(n):
            own = index_tree(self.given, origin[i])
            each = range(i, len(tries.length), n)
            lifts = (index_tree(tries, k) for k in each)
            for e in (*lifts, own):
                # compiled programs may differ on a knife edge: what the replay says counts
                e = replay(self.sim, e, reward=reward)._replace(states=None)
                if bool(e.failure):
                    failing[i] = jax.device_get(e)
                    break
        found, i = empty(self.sim), np.zeros(0, np.int64)
        if failing:
            which = np.array(list(failing))
            each = stacked(failing.values())
            found = collect(self.sim, reward, each, simulation=which, top=len(which))
            i = found.simulation
        told = (a[i] for a in (origin, residual, gain, late))
        return Refined(found, *told, self.spent, self.invalid, settings)


def _stacked(tracks):
    """The `Point` of all ``tracks``."""
    return Point(*(np.stack(a) for a in zip(*(t.point for t in tracks), strict=True)))
