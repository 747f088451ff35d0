"""Ways of a population to rare failures, each a chain of few calls of one program
(`jast.estimate.particles`): down the levels of the miss distance, from wide noise to the model's
own, and on below it, to the likeliest failures.

The first is subset simulation (Au and Beck 2001; with these moves Papaioannou, Betz, Zwirglmaier
and Straub 2015), the second a sequential Monte Carlo sampler whose temperature is the width of the
noise (Del Moral, Doucet and Jasra 2006). They share nothing but the program: the first knows
failures by their distance alone, the second asks of an episode only whether it failed.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from jast.counter import counter_key, numpy_generator
from jast.estimate.batches import resampled
from jast.estimate.particles import (
    AFTER,
    LANES,
    SMALL,
    WINDOW,
    begun,
    blank,
    fresh,
    moved,
    when_reached,
)
from jast.limit_state import dimension
from jast.simulator import Simulator

__all__ = ["WAYS", "Descent", "Settings", "by_distance", "by_width", "cooled"]


@dataclass(frozen=True)
class Settings:
    """All numbers of the ways down; `python -m benchmarks.populations` prints what each costs."""

    particles: int = 8192
    """Points of a population."""
    moves_by_distance: int = 5
    """Moves of a point between two levels: with half as many the variance of the toy is 2.9 times
    as great at equal cost, with twice as many 1.5 times."""
    moves_by_width: int = 10
    """Of a point between two widths: half as many make the variance of the breaker 5.6 times as
    great, and its estimate a quarter too low."""
    kinds_by_distance: tuple[int, int] = SMALL, AFTER
    """Of the moves between two levels of a distance that is known at each step."""
    kinds_by_width: tuple[int, int] = SMALL, WINDOW
    """Of all other moves; without windows the variance of the breaker is 9 times as great."""
    quantile: float = 0.2
    """Share of the points that a level keeps."""
    effective: float = 0.5
    """Share of effective points that a narrower width leaves."""
    widths: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
    """Of the noise, in which failures are looked for."""
    failing: float = 0.1
    """Share of the points that fails at the first width."""
    least: float = -690.0
    """Log probability below which a population gives up: that of the least double."""
    scattered: float = 0.25
    """Relative variance above which a population from wide noise gives up: it witnesses nothing."""
    numbers: int = 2**26
    """Numbers that a population holds at most; of longer episodes it has fewer points."""
    coldest: float = 0.05
    """Width to which failures are cooled: the likeliest are then a twentieth of a standard
    deviation away."""
    coolings: int = 40
    """Widths on the way there."""
    cooled: int = 128
    """Failures that are cooled, as many as are simulated side by side: few of them with many moves
    each get farther than many."""


SETTINGS = Settings()


class Descent(NamedTuple):
    """What one population came to. On the host."""

    points: Any
    """[m, D] failures, nearly as p(z | failure) has them; empty where none was reached"""
    used: Any
    """[m] int32: how many of the numbers decided each"""
    distance: Any
    """[m] miss distances"""
    family: Any
    """[m] int64: which of its first points each descends from"""
    log_mean: Any
    """Log of the estimate; -inf where no failure was reached"""
    variance: Any
    """Of the estimate over its square, by the genealogy of the points"""
    plain: Any
    """[3] of the model's own draws: those that fail, that are invalid, and all"""
    levels: Any
    """Miss distances of the levels, or widths, in their order"""
    evaluations: Any
    invalid: Any
    size: Any
    """Points that it has"""


class _Population:
    """A population on its way: the particles, the family of each, and the counts."""

    def __init__(self, key, sim, n, moves, capacity, settings=SETTINGS):
        self.sim, self.n, self.moves, self.settings = sim, n, moves, settings
        self.rng, self.key, self.calls = numpy_generator(key, 1), key, 0
        self.particles, self.steering = blank(sim, capacity), begun()
        self.evaluations, self.invalid = 0, 0
        self.log_mean, self.family = 0.0, np.arange(n)
        # else the distance is known at the end of an episode, and nothing comes after it
        self.watched = not sim.episodic and sim.horizon > 1
        self.plain, self.levels = (0, 0, 0), []

    def next_key(self):
        self.calls += 1
        return counter_key(self.key, 2, self.calls)

    def draw(self, width):
        """Begin with independent points of this width; returns which of them fail."""
        self.particles, invalid = fresh(
            self.sim, self.particles, self.next_key(), self.n, width=width
        )
        self.evaluations, self.invalid = self.evaluations + self.n, self.invalid + invalid
        failing = self.score() == -np.inf
        if width == 1:
            self.plain = int(failing.sum()), invalid, self.n
        return failing

    def first(self, failing, n):
        """Leave only the first ``n`` independent points, in whole blocks; which of them fail."""
        self.n = int(max(min(n, self.n) // LANES * LANES, LANES))
        self.family = np.arange(self.n)
        return failing[: self.n]

    def score(self):
        return np.asarray(self.particles.score)[: self.n]

    def weigh(self, log_w):
        """The estimate with one more factor, the mean weight; which is all where it is the last."""
        top = log_w.max()
        self.log_mean += top + math.log(np.exp(log_w - top).mean())

    def move(self, log_w, level, **width):
        """Go on from points chosen by weight (systematic resampling)."""
        rows = resampled(log_w, self.n, self.rng.random())
        self.family = self.family[rows]
        kinds = self.settings.kinds_by_width
        if level > -np.inf and self.watched:
            kinds = self.settings.kinds_by_distance
            # what is chosen more than once is simulated once
            chosen, rows = np.unique(rows, return_inverse=True)
            self.particles = when_reached(self.sim, self.particles, self.next_key(), chosen, level)
            self.evaluations += len(chosen)
        self.particles, self.steering, invalid = moved(
            self.sim,
            self.particles,
            self.next_key(),
            rows,
            self.steering,
            moves=self.moves,
            level=level,
            kinds=kinds,
            **width,
        )
        self.evaluations, self.invalid = (
            self.evaluations + self.moves * self.n,
            self.invalid + invalid,
        )

    def variance(self, log_w):
        """Relative variance of the estimate whose last weights are these: what families of a common
        ancestor carry (Lee and Whiteley 2018, eq. 5). Their factor n / (n - 1) stands for the first
        draws alone: systematic resampling adds no noise of its own, as multinomial would.
        """
        w = np.exp(log_w - log_w.max())
        together = (np.bincount(self.family, w, self.n) ** 2).sum() / w.sum() ** 2
        return max(1 - self.n / (self.n - 1) * (1 - together), 0.0)

    def lost(self):
        """The `Descent` that reached no failure."""
        p, d = self.particles, dimension(self.sim)
        none = np.zeros((0, d), p.z.dtype), np.zeros(0, np.int32), np.zeros(0, p.z.dtype)
        return self._end(*none, np.zeros(0, np.int64), -math.inf, math.nan)

    def arrived(self, log_w, before=None):
        """The `Descent` whose last weights, of failures, are these; ``before``: see `moved`."""
        self.weigh(log_w)
        variance = self.variance(log_w)
        self.move(log_w, -np.inf, before=before)
        p = jax.device_get(self.particles)
        own = (a[: self.n] for a in (p.z, p.used, p.distance))
        return self._end(*own, self.family, self.log_mean, variance)

    def _end(self, points, used, distance, family, log_mean, variance):
        return Descent(
            points=points,
            used=used,
            distance=distance,
            family=family,
            log_mean=np.float64(log_mean),
            variance=np.float64(variance),
            plain=np.array(self.plain, np.int64),
            levels=np.array(self.levels, np.float64),
            evaluations=np.int64(self.evaluations),
            invalid=np.int64(self.invalid),
            size=np.int64(self.n),
        )


def size(sim: Simulator, particles: int, settings: Settings = SETTINGS) -> int:
    """Points of a population of ``sim``: as many as are asked for, if they fit."""
    return max(min(particles, settings.numbers // max(dimension(sim), 1)) // 128 * 128, 128)


def by_distance(
    key: jax.Array,
    sim: Simulator,
    n: int,
    moves: int,
    capacity: int,
    settings: Settings = SETTINGS,
) -> Descent:
    """Down the levels of the miss distance: each is the sample quantile of the scores, until
    failures are as many. ``n`` points in ``capacity`` places, a size of the compiled program.
    """
    s = _Population(key, sim, n, moves, capacity, settings)
    s.draw(1.0)
    level = math.inf
    while True:
        score = s.score()
        if np.mean(score == -np.inf) >= settings.quantile:
            return s.arrived(_where(score == -np.inf))
        level = _next(score, level, settings.quantile)
        if level is None or s.log_mean < settings.least:
            return s.lost()
        log_w = _where(score <= level)
        if level == -math.inf:
            return s.arrived(log_w)
        s.weigh(log_w)
        s.levels.append(level)
        s.move(log_w, level)


def by_width(
    key: jax.Array,
    sim: Simulator,
    n: int,
    moves: int,
    capacity: int,
    settings: Settings = SETTINGS,
    most: float = math.inf,
) -> Descent:
    """From the least width of the noise at which failures are frequent to the model's own, each
    step as far as leaves enough effective points; moves among failures only. Of the ``n`` points
    as many go on as cost ``most`` evaluations, nearly: in long episodes the way has many widths.
    """
    s = _Population(key, sim, n, moves, capacity, settings)
    width, failing = _wide(s, settings)
    s.levels.append(width)
    if width > 1:
        failing = s.first(failing, most / (moves * _widths(dimension(sim), width, settings)))
    if failing.sum() < 2:
        return s.lost()
    log_w = _where(failing)
    while width > 1:
        s.weigh(log_w)
        before = s.levels[-2] if len(s.levels) > 1 else width
        s.move(log_w, -np.inf, width=width, before=before)
        square, used = (np.asarray(a, np.float64)[: s.n] for a in s.particles[3:1:-1])
        width = _narrower(square, used, width, settings.effective)
        log_w = _ratio(square, used, s.levels[-1], width)
        s.levels.append(width)
        if s.log_mean < settings.least or s.variance(log_w) > settings.scattered:
            return s.lost()
    return s.arrived(log_w, before=s.levels[-2] if len(s.levels) > 1 else None)


def _wide(s, settings):
    """The least width at which failures are frequent, or else where they are least rare; and which
    of its points, drawn, fail.
    """
    shares = []
    for width in settings.widths:
        failing = s.draw(width)
        shares.append(failing.mean())
        if shares[-1] >= settings.failing:
            return width, failing
    best = settings.widths[int(np.argmax(shares))]
    return best, failing if best == width else s.draw(best)


def _widths(d, width, settings):
    """How many widths lie between this one and 1 where ``d`` numbers are used: the weights of the
    step from w to (1 - a) w have a relative variance of some exp(2 d a^2) - 1.
    """
    return math.log(width) * math.sqrt(2 * d / -math.log(settings.effective)) + 1


def cooled(
    key: jax.Array,
    sim: Simulator,
    points: np.ndarray,
    evaluations: int,
    together: bool,
    settings: Settings = SETTINGS,
) -> tuple[np.ndarray, int]:
    """The failures ``points`` [m, D] cooled to the likeliest, for so many ``evaluations``, nearly,
    and how many they were.

    Where not ``together`` no point replaces another, so no mode is lost, however little of the
    probability it has. Else those of high density replace the others at each width, as in every
    population, and moves are spent where failures are likeliest.
    """
    m, rng, rows, steering = len(points), numpy_generator(key, 6), np.arange(len(points)), begun()
    particles = blank(sim, size(sim, settings.particles, settings))
    z = np.zeros(particles.z.shape, particles.z.dtype)
    z[:m] = points
    # all of them fail, and only a failure takes the place of one
    particles = particles._replace(z=jax.device_put(z))
    moves = max(evaluations // (m * settings.coolings), 2)
    widths = np.geomspace(1.0, settings.coldest, settings.coolings).tolist()
    for i, width in enumerate(widths):
        if together and i:
            square = np.asarray(particles.square)[:m].astype(np.float64)
            used, last = np.asarray(particles.used)[:m], widths[i - 1]
            # as far on the way to this width as leaves enough effective points
            near = _narrower(square, used, last, settings.effective, width)
            rows = resampled(_ratio(square, used, last, near), m, rng.random())
        particles, steering, _ = moved(
            sim,
            particles,
            counter_key(key, 3, i),
            rows,
            steering,
            moves=moves,
            level=-np.inf,
            width=width,
        )
    return np.asarray(particles.z)[:m], moves * len(widths) * m


WAYS = {"distance": by_distance, "width": by_width}


def _where(chosen):
    """Log weights of 1 where ``chosen``, else of 0."""
    return np.where(chosen, 0.0, -np.inf)


def _next(score, last, quantile):
    """The next level: the sample quantile of the scores, below the last one; -inf where only
    failures are; None where nothing is.
    """
    level = np.partition(score, k := math.ceil(quantile * len(score)) - 1)[k]
    if level < last:
        return float(level)
    below = score[score < last]
    return float(below.max()) if below.size else None


def _ratio(square, used, before, width):
    """log of N(0, width^2 I) over N(0, before^2 I), of points whose ``used`` numbers have these
    sums of ``square``.
    """
    return used * math.log(before / width) - 0.5 * square * (1 / width**2 - 1 / before**2)


def _narrower(square, used, width, least, floor=1.0):
    """The least width, from ``floor`` on, whose weights leave a share of ``least`` effective
    points.
    """

    def enough(new):
        w = _ratio(square, used, width, new)
        w = np.exp(w - w.max())
        return w.sum() ** 2 >= least * len(w) * (w**2).sum()

    if enough(floor):
        return floor
    low, high = floor, width
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high
