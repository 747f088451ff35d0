"""Ways of a population to rare failures, each a chain of few calls of one program
(`estimate.population.particle_moves`): down the levels of the miss distance, from wide noise to the
model's own, and on below it, to the likeliest failures.

The first is subset simulation (Au and Beck 2001; with these moves Papaioannou, Betz, Zwirglmaier
and Straub 2015), the second a sequential Monte Carlo sampler whose temperature is the width of the
noise (Del Moral, Doucet and Jasra 2006). They share nothing but the program: the first knows
failures by their distance alone, the second asks of an episode only whether it failed.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import counter_key, numpy_generator
from jast._src.core.simulator import Simulator
from jast._src.estimate.host_populations import next_level
from jast._src.estimate.population.particle_moves import (
    AFTER,
    DIFFERENCE,
    SMALL,
    WINDOW,
    allocate_particles,
    draw_particles,
    initial_steering,
    move_particles,
    record_crossings,
)
from jast._src.estimate.proposal_search.mixture_draws import resample
from jast._src.normal_space.transform import dimension, smooth_numbers
from jast._src.runtime.device import BLOCK, on_cpu

__all__ = [
    "DESCENTS",
    "SETTINGS",
    "Descent",
    "Settings",
    "by_distance",
    "by_width",
    "cool_failures",
    "population_size",
]

BISECTIONS = 40
"""Halvings of the step to a narrower width: to the last digits of a float32."""


@dataclass(frozen=True)
class Settings:
    """All numbers of the ways down; `python -m benchmarks.populations` prints what each costs."""

    particles: int = 8192
    """Points of a population on a CPU."""
    accelerated_particles: int = 2**18
    """Points of one on an accelerator: an H100 moves 8192 of the ``drone`` of
    `benchmarks.closed_loops` in 2.4 ms, 2^17 in 3.0 and 2^18 in 4.8."""
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
    kinds_cooling_together: tuple[tuple[int, int], ...] = (SMALL, WINDOW), (DIFFERENCE, SMALL)
    """Of failures that are cooled together, at one width after the other. With 300,000 evaluations
    those of the ship are 4 nats likelier than without differences and 1 less likely than without
    windows, which the cart-pole needs: without them it loses 2."""
    level_share: float = 0.2
    """Share of the points that a level keeps."""
    effective_share: float = 0.5
    """Share of effective points that a narrower width leaves."""
    widths: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
    """Of the noise, in which failures are looked for."""
    failing_share: float = 0.1
    """Share of the points that fails at the first width."""
    min_log_probability: float = -690.0
    """Log probability below which a population gives up: that of the least double."""
    max_variance: float = 0.25
    """Relative variance above which a population from wide noise gives up: it witnesses nothing."""
    max_numbers: int = 2**26
    """Numbers that a population holds at most; of longer episodes it has fewer points."""
    final_width: float = 0.05
    """Width to which failures are cooled: the likeliest are then a twentieth of a standard
    deviation away."""
    cooling_steps: int = 40
    """Widths on the way there."""
    cooled_failures: int = 128
    """Failures that are cooled, as many as are simulated side by side: few of them with many moves
    each get farther than many."""


SETTINGS = Settings()


class Descent(NamedTuple):
    """What one population came to. On the host."""

    points: np.ndarray
    """[m, D] failures, nearly as p(z | failure) has them; empty where none was reached"""
    used: np.ndarray
    """[m] int32: how many of the numbers decided each"""
    distance: np.ndarray
    """[m] miss distances"""
    family: np.ndarray
    """[m] int64: which of its first points each descends from"""
    log_mean: np.ndarray
    """Log of the estimate; -inf where no failure was reached"""
    variance: np.ndarray
    """Of the estimate over its square, by the genealogy of the points"""
    plain: np.ndarray
    """[3] of the model's own draws: those that fail, that are invalid, and all"""
    levels: np.ndarray
    """Miss distances of the levels, or widths, in their order"""
    evaluations: np.ndarray
    invalid: np.ndarray
    size: np.ndarray
    """Points that it has"""


class _ParticlePopulation:
    """A population on its way: the particles, the family of each, and the counts."""

    def __init__(self, key, sim, n, moves, capacity, settings=SETTINGS):
        self.key, self.calls = key, 0
        self.sim, self.settings = sim, settings
        self.n, self.moves = n, moves
        self.rng = numpy_generator(key, 1)
        self.particles, self.steering = allocate_particles(sim, capacity), initial_steering()
        self.evaluations = self.invalid = 0
        self.log_mean, self.family = 0.0, np.arange(n)
        # else the distance is known at the end of an episode, and nothing comes after it
        self.watched = not sim.episodic and sim.horizon > 1
        self.plain, self.levels = (0, 0, 0), []
        self.wide = np.ones(dimension(sim), bool)  # the numbers that a width is of

    def next_key(self):
        self.calls += 1
        return counter_key(self.key, 2, self.calls)

    def draw(self, width):
        """Begin with independent points of this width; returns which of them fail."""
        key = self.next_key()
        self.particles, invalid = draw_particles(
            self.sim, self.particles, key, self.n, width=width, wide=self.wide
        )
        self.evaluations += self.n
        self.invalid += invalid
        failing = self.score() == -np.inf
        if width == 1:
            self.plain = int(failing.sum()), invalid, self.n
        return failing

    def keep_first(self, failing, n):
        """Leave only the first ``n`` independent points, in full blocks; which of them fail."""
        self.n = int(max(min(n, self.n) // BLOCK * BLOCK, BLOCK))
        self.family = np.arange(self.n)
        return failing[: self.n]

    def score(self):
        return np.asarray(self.particles.score)[: self.n]

    def multiply(self, log_w):
        """Multiply the estimate by the mean of these weights; after the last it is complete."""
        top = log_w.max()
        self.log_mean += top + math.log(np.exp(log_w - top).mean())

    def resample_and_move(self, log_w, level, **width):
        """Go on from points chosen by weight (systematic resampling)."""
        rows = resample(log_w, self.n, self.rng.random())
        self.family = self.family[rows]
        kinds = self.settings.kinds_by_width
        if level > -np.inf and self.watched:
            kinds = self.settings.kinds_by_distance
            # what is chosen more than once is simulated once
            chosen, rows = np.unique(rows, return_inverse=True)
            key = self.next_key()
            self.particles = record_crossings(self.sim, self.particles, key, chosen, level)
            self.evaluations += len(chosen)
        self.particles, self.steering, invalid = move_particles(
            self.sim,
            self.particles,
            self.next_key(),
            rows,
            self.steering,
            moves=self.moves,
            level=level,
            kinds=kinds,
            wide=self.wide,
            **width,
        )
        self.evaluations += self.moves * self.n
        self.invalid += invalid

    def variance(self, log_w):
        """Relative variance of the estimate whose last weights are these: what families of a common
        ancestor carry (Lee and Whiteley 2018, eq. 5). Their factor n / (n - 1) stands for the first
        draws alone: systematic resampling adds no noise of its own, as multinomial would.
        """
        w = np.exp(log_w - log_w.max())
        same_family = (np.bincount(self.family, w, self.n) ** 2).sum() / w.sum() ** 2
        return max(1 - self.n / (self.n - 1) * (1 - same_family), 0.0)

    def without_failures(self):
        """The `Descent` that reached no failure."""
        dtype, none = self.particles.z.dtype, np.zeros(0)
        points, used = np.zeros((0, dimension(self.sim)), dtype), none.astype(np.int32)
        family = none.astype(np.int64)
        return self._result(points, used, none.astype(dtype), family, -math.inf, math.nan)

    def with_failures(self, log_w, before=None):
        """The `Descent` whose last weights, of failures, are these; ``before``: see
        `move_particles`.
        """
        self.multiply(log_w)
        variance = self.variance(log_w)
        self.resample_and_move(log_w, -np.inf, before=before)
        p = jax.device_get(self.particles)
        points, used, distance = (a[: self.n] for a in (p.z, p.used, p.distance))
        return self._result(points, used, distance, self.family, self.log_mean, variance)

    def _result(self, points, used, distance, family, log_mean, variance):
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


def population_size(sim: Simulator, particles: int | None = None) -> int:
    """Points of a population of ``sim``: as many as are asked for, or serve the device, if they
    fit.
    """
    if particles is None:
        particles = SETTINGS.particles if on_cpu() else SETTINGS.accelerated_particles
    most = SETTINGS.max_numbers // max(dimension(sim), 1)
    return max(min(particles, most) // BLOCK * BLOCK, BLOCK)


def by_distance(
    key: jax.Array, sim: Simulator, n: int, moves: int, capacity: int, settings: Settings = SETTINGS
) -> Descent:
    """Down the levels of the miss distance: each is the sample quantile of the scores, until
    failures are as many. ``n`` points in ``capacity`` places, a size of the compiled program.
    """
    population = _ParticlePopulation(key, sim, n, moves, capacity, settings)
    population.draw(1.0)
    level = math.inf
    while True:
        score = population.score()
        enough = np.mean(score == -np.inf) >= settings.level_share
        level = -math.inf if enough else next_level(score, level, settings.level_share)
        if level is None or (not enough and population.log_mean < settings.min_log_probability):
            return population.without_failures()
        log_w = _indicator_log_weights(score <= level)
        if level == -math.inf:
            return population.with_failures(log_w)
        population.multiply(log_w)
        population.levels.append(level)
        population.resample_and_move(log_w, level)


def by_width(
    key: jax.Array,
    sim: Simulator,
    n: int,
    moves: int,
    capacity: int,
    settings: Settings = SETTINGS,
    max_evaluations: float = math.inf,
) -> Descent:
    """From the least width of the noise at which failures are frequent to the model's own, each
    step as far as leaves enough effective points; moves among failures only. Of the ``n`` points
    as many go on as cost ``max_evaluations``, nearly: in long episodes the way has many widths.
    """
    population = _ParticlePopulation(key, sim, n, moves, capacity, settings)
    width, failing = _find_width(population, settings)
    levels = population.levels
    levels.append(width)
    if width > 1:
        steps = _expected_steps(int(population.wide.sum()), width, settings)
        failing = population.keep_first(failing, max_evaluations / (moves * steps))
    if failing.sum() < 2:
        return population.without_failures()
    log_w = _indicator_log_weights(failing)
    before = None
    while width > 1:
        population.multiply(log_w)
        population.resample_and_move(log_w, -np.inf, width=width, before=before)
        p = population.particles
        square, used = (np.asarray(a)[: population.n] for a in (p.square, p.used))
        square = square.astype(np.float64)
        used = np.concatenate([[0], np.cumsum(population.wide)])[used].astype(np.float64)
        before, width = width, _next_width(square, used, width, settings.effective_share)
        log_w = _log_density_ratio(square, used, before, width)
        levels.append(width)
        gone = population.log_mean < settings.min_log_probability
        if gone or population.variance(log_w) > settings.max_variance:
            return population.without_failures()
    return population.with_failures(log_w, before=before)


def _find_width(population, settings):
    """The least width at which failures are frequent, or else where they are least rare; and which
    of its points, drawn, fail. Choices and counts stay as the model has them where failures are
    frequent all the same: the way back is shorter, and leads through fewer regimes.
    """
    everything, smooth = population.wide, smooth_numbers(population.sim)
    mixed, tried = smooth.any() and not smooth.all(), []
    for width in settings.widths:
        for population.wide in [smooth, everything] if mixed and width > 1 else [everything]:
            failing = population.draw(width)
            tried.append((failing.mean(), width, population.wide))
            if failing.mean() >= settings.failing_share:
                return width, failing
    best = max(tried, key=lambda one: one[0])
    _, width, population.wide = best
    return width, failing if best is tried[-1] else population.draw(width)


def _expected_steps(d, width, settings):
    """How many widths lie between this one and 1 where ``d`` numbers are used: the weights of the
    step from w to (1 - a) w have a relative variance of some exp(2 d a^2) - 1.
    """
    return math.log(width) * math.sqrt(2 * d / -math.log(settings.effective_share)) + 1


def cool_failures(
    key: jax.Array, sim: Simulator, points: np.ndarray, evaluations: int, replace: bool
) -> tuple[np.ndarray, int]:
    """The failures ``points`` [m, D] cooled to the likeliest, for so many ``evaluations``, nearly,
    and how many they were.

    Without ``replace`` no point takes another's place, so no mode is lost, however little of the
    probability it has. With it those of high density replace the others at each width, as in every
    population, and moves are spent where failures are likeliest: soon all lie in few modes, and
    their differences along these.
    """
    m, rng, rows = len(points), numpy_generator(key, 6), np.arange(len(points))
    particles = allocate_particles(sim, population_size(sim))
    z = np.zeros(particles.z.shape, particles.z.dtype)
    z[:m] = points
    # all of them fail, and only a failure takes the place of one
    particles = particles._replace(z=jax.device_put(z))
    moves = max(evaluations // (m * SETTINGS.cooling_steps), 2)
    widths = np.geomspace(1.0, SETTINGS.final_width, SETTINGS.cooling_steps).tolist()
    by_turns = SETTINGS.kinds_cooling_together if replace else (SETTINGS.kinds_by_width,)
    steering = {kinds: initial_steering() for kinds in by_turns}
    for i, width in enumerate(widths):
        if replace and i:
            square = np.asarray(particles.square)[:m].astype(np.float64)
            used, last = np.asarray(particles.used)[:m], widths[i - 1]
            # as far on the way to this width as leaves enough effective points
            near = _next_width(square, used, last, SETTINGS.effective_share, width)
            rows = resample(_log_density_ratio(square, used, last, near), m, rng.random())
        kinds = by_turns[i % len(by_turns)]
        particles, steering[kinds], _ = move_particles(
            sim,
            particles,
            counter_key(key, 3, i),
            rows,
            steering[kinds],
            moves=moves,
            level=-np.inf,
            width=width,
            kinds=kinds,
        )
    return np.asarray(particles.z)[:m], moves * len(widths) * m


DESCENTS = {"distance": by_distance, "width": by_width}
"""The ways down, which know nothing of each other."""


def _indicator_log_weights(chosen):
    """Log weights of 1 where ``chosen``, else of 0."""
    return np.where(chosen, 0.0, -np.inf)


def _log_density_ratio(square, used, before, width):
    """log of N(0, width^2 I) over N(0, before^2 I), of points whose ``used`` numbers have these
    sums of ``square``.
    """
    return used * math.log(before / width) - 0.5 * square * (1 / width**2 - 1 / before**2)


def _next_width(square, used, width, effective_share, floor=1.0):
    """The least width, from ``floor`` on, whose weights leave this share of effective points."""

    def enough(new):
        w = _log_density_ratio(square, used, width, new)
        w = np.exp(w - w.max())
        return w.sum() ** 2 >= effective_share * len(w) * (w**2).sum()

    if enough(floor):
        return floor
    low, high = floor, width
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high
