"""Populations that find failures: down the levels of the miss distance (subset simulation, Au and
Beck 2001), or from wider noise inwards.

The Markov moves are those of conditional sampling in the space of normal numbers (Papaioannou,
Betz, Zwirglmaier and Straub 2015), with the size of the moves adapted. One population serves as an
estimator of its own; as an explorer it may be kept out of the failures that a proposal covers
already.
"""

import math
from typing import NamedTuple

import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.estimate.gaussians.design_points import explained
from jast._src.estimate.proposal_search.mixture_draws import log_ratio
from jast._src.estimate.tilts import tilts
from jast._src.estimate.tilts.tilts import Tilts, shape, simulate_points
from jast._src.normal_space.evaluate_points import evaluate_points
from jast._src.normal_space.pcn import WIDTHS, proposed
from jast._src.normal_space.transform import dimension, normal_numbers
from jast._src.util.pytrees import index_tree

__all__ = [
    "FINAL_MOVES",
    "LEVEL_SHARE",
    "Explored",
    "bracket_boundary",
    "cool",
    "draw_wide",
    "equilibrate",
    "explore",
    "next_level",
    "wide_enough",
]

LEVEL_SHARE = 0.25
"""Share of a population that a level keeps. A convention; .1 to .3 serve alike."""
FINAL_MOVES = 5
"""Moves among failures at the end, which part the copies of one failure."""
FIRST_SCALE = 0.7
"""Size of the first move; it is steered from there."""
SCALE_BOUNDS = 0.02, 1.0
"""Least and greatest size of a move: 1 is an independent draw."""
TARGET_ACCEPTANCE = 0.4
"""Share of the moves that are taken, to which their size is steered."""
FAILING_SHARE = 0.1
"""Share of the draws under wide noise that fail where it is wide enough."""
DRAWS_PER_POINT = 4
"""Draws of wide noise for each point that is cooled, so that several fail."""
FINAL_WIDTH = 0.25
"""Width to which noise is cooled: failures are then a quarter of a standard deviation from the
likeliest near to them."""
COOLING_STEPS = 60
"""Widths on the way there, with a move at each."""
STATIONARY_NORM_RATIO = 0.95
"""Failures still drift towards the origin where the sum of their squares fell below this share."""
ZEROED_SHARES = 0.5, 0.25
"""Share of the numbers that are set to 0 together, in turn: half of them, or fewer where many are
needed."""
FUTILE_TRIES = 4
"""Tries without any success after which all numbers count as needed."""
BISECTIONS = 6
"""Halvings of the way from the origin to a failure: the boundary is known to a 64th of it."""


class Explored(NamedTuple):
    """What one population came to. On the host."""

    points: np.ndarray
    """[n, D] failing points, drawn nearly from p(z | failure); empty where none was reached"""
    used: np.ndarray
    """[n] int32 numbers that each one used"""
    log_mean: float
    """Log of the product of the levels' shares: the estimate; -inf where no failure was reached"""
    levels: np.ndarray
    """The miss distances of the levels, or the widths of the noise, falling"""
    evaluations: int
    invalid: int
    plain: np.ndarray
    """[3] its first draws, which are the model's own: those that fail and are not covered, the
    invalid ones, and all; 0 where it began elsewhere
    """
    complete: bool = True
    """False where it was ended by its greatest number of evaluations"""

    @property
    def reached(self) -> bool:
        """Whether failures were."""
        return len(self.points) > 0


class Population(NamedTuple):
    """Points and what their episodes came to. On the host."""

    z: np.ndarray
    """[n, D]"""
    score: np.ndarray
    """[n] miss distance; -inf for a failure, inf for what is invalid or covered already"""
    used: np.ndarray
    """[n] int32: how many of the numbers decided the episode"""
    invalid: np.ndarray
    """[n] bool"""


class PopulationSampler:
    """What draws and moves one population: random numbers, the size of the moves and the counts.

    Random numbers and moves are NumPy's: only the system runs on the device. ``covered`` as in
    `explore`.
    """

    def __init__(self, rng, sim, size, covered=None):
        self.rng, self.sim = rng, sim
        self.size, self.covered = size, covered
        self.scale, self.accepted = FIRST_SCALE, math.nan
        self.evaluations = self.invalid = 0
        self.plain = np.zeros(3, int)
        self.dtype, self.dimension = normal_numbers(sim), dimension(sim)
        if covered is not None and isinstance(covered[0], Tilts):
            self.dimension = tilts.dimension(shape(sim), sim.horizon)

    def noise(self):
        """Normal numbers [size, D]."""
        return self.rng.standard_normal((self.size, self.dimension)).astype(self.dtype)

    def draw(self, width):
        """A new population N(0, width^2 I)."""
        return self.simulate(float(width) * self.noise())

    def simulate(self, z):
        """The population of the points ``z`` [size, D]."""
        q, threshold = self.covered or (None, math.inf)
        if isinstance(q, Tilts):
            o, log_q, _ = simulate_points(self.sim, q, z)
        else:
            o = evaluate_points(self.sim, z)
            log_q = -math.inf if q is None else log_ratio(q, z, o.used)
        score = np.where(log_q > float(threshold), np.inf, o.score)
        self.evaluations += self.size
        self.invalid += int(o.invalid.sum())
        return Population(z, score, o.used, o.invalid)

    def move(self, population, level, width, moves):
        """A population after Markov moves that keep N(0, width^2 I) given a score of at most
        ``level``.
        """
        for _ in range(moves):
            new = self.simulate(proposed(population.z, self.noise(), self.scale, float(width)))
            taken = new.score <= level
            population = _replaced(population, new, taken)
            self.accepted = float(taken.mean())
            steered = self.scale * math.exp(self.accepted - TARGET_ACCEPTANCE)
            self.scale = float(np.clip(steered, *SCALE_BOUNDS))
        return population

    def zero_unneeded(self, population, rounds):
        """Failures without the numbers that they do not need, which come to 0: some are tried
        together, so many ``rounds``, as delta debugging does (Zeller and Hildebrandt 2002).
        """
        needs_all = True
        for i in range(rounds):
            some = self.rng.random(population.z.shape) < ZEROED_SHARES[i % len(ZEROED_SHARES)]
            new = self.simulate(np.where(some, 0, population.z).astype(self.dtype))
            good = (new.score == -math.inf) & (new.z != population.z).any(axis=1)
            population = _replaced(population, new, good)
            needs_all = needs_all and not good.any()
            if needs_all and i + 1 == FUTILE_TRIES:
                break
        return population

    def result(self, failures, log_mean, levels):
        """What it came to, with no ``failures`` where it reached none: `Explored`."""
        return Explored(
            points=failures.z,
            used=failures.used,
            log_mean=log_mean,
            levels=np.asarray(levels, np.float64),
            evaluations=self.evaluations,
            invalid=self.invalid,
            plain=self.plain,
        )


def explore(
    key,
    sim,
    size,
    *,
    covered=None,
    min_log_probability=-math.inf,
    max_evaluations=10**9,
    final_moves=FINAL_MOVES,
    patience=0,
):
    """Subset simulation: take a population of ``size`` points down the levels of the miss distance
    to the failures of ``sim``: `Explored`.

    ``covered``: (`Latent` or `Tilts` q, log threshold): points with log q - log p above it are left
    out, so that the population looks for failures that q does not draw, and the estimate is of
    those alone. Points are what q has them to be.
    It stops below ``min_log_probability``, where it would take more than ``max_evaluations``, and
    where no level falls further, after ``patience`` moves at the last one. ``final_moves`` among
    failures part their copies; without any there are no copies.
    """
    sampler = PopulationSampler(numpy_generator(key), sim, size, covered)
    population = sampler.draw(1.0)
    failing = int((population.score == -math.inf).sum())
    sampler.plain = np.array([failing, int(population.invalid.sum()), size])
    level, levels, waited = math.inf, [], 0
    log_mean, complete = 0.0, True
    while True:
        score = population.score
        if np.mean(score == -np.inf) < LEVEL_SHARE:
            if log_mean < min_log_probability:
                break
            complete = sampler.evaluations + size * (1 + final_moves) <= max_evaluations
            if not complete:
                break
        lower = next_level(score, level, LEVEL_SHARE)
        if lower is None:
            if waited == patience or level == math.inf:
                break
            population, waited = sampler.move(population, level, 1.0, 1), waited + 1
            continue
        level, waited = lower, 0
        log_mean += math.log(np.mean(score <= level))
        elites = np.flatnonzero(score <= level)
        if level == -math.inf and not final_moves:
            return sampler.result(index_tree(population, elites), log_mean, levels)
        # each elite as often as any other, or once more
        population = index_tree(population, elites[(np.arange(size) + len(levels)) % len(elites)])
        if level == -math.inf:
            failures = sampler.move(population, level, 1.0, final_moves)
            return sampler.result(failures, log_mean, levels)
        population = sampler.move(population, level, 1.0, 1)
        levels.append(level)
    found = sampler.result(index_tree(population, slice(0)), -math.inf, levels)
    return found._replace(complete=complete)


def next_level(score, last, share):
    """The next level of a population: the sample quantile of its scores, below the ``last``; -inf
    where only failures are below it, None where nothing is.
    """
    k = math.ceil(share * len(score)) - 1
    level = np.partition(score, k)[k]
    if level < last:
        return float(level)
    below = score[score < last]
    return float(below.max()) if below.size else None


def draw_wide_failures(key, sim, n, *, covered=None):
    """Failures under wider noise N(0, s^2 I), at the first width s of `WIDTHS` at which a share of
    `FAILING_SHARE` of some ``n`` draws fails, or at the last: (`Population` [m] of them, s, what
    drew them). ``covered`` as in `explore`.
    """
    sampler = PopulationSampler(numpy_generator(key), sim, -(-n // DRAWS_PER_POINT), covered)
    for width in WIDTHS:
        drawn = [sampler.draw(width) for _ in range(DRAWS_PER_POINT)]
        population = Population(*map(np.concatenate, zip(*drawn, strict=True)))
        failing = np.flatnonzero(population.score == -np.inf)
        if len(failing) >= FAILING_SHARE * len(population.z):
            break
    return index_tree(population, failing), width, sampler


def wide_enough(log_mean):
    """The width of noise under which a half-space with the probability of ``log_mean`` has
    `FAILING_SHARE` of the draws. One of a tenth of that probability has nearly as many: .067 for
    2e-4, .086 for 1e-8.
    """
    from scipy.special import ndtri, ndtri_exp  # here: slow to import

    return max(float(ndtri_exp(min(log_mean, 0.0)) / ndtri(FAILING_SHARE)), 1.0)


def draw_wide(rng, sim, n, width, *, moves=0, covered=None):
    """The failures among ``n`` draws of noise of this ``width``: `Population` [m]. ``covered`` as
    in `explore`.

    With ``moves``, the failures that they walk to: each makes so many Markov moves, which are taken
    where the miss distance does not grow. As none replaces another one, a region of failures is
    found that most points are far from.
    """
    sampler = PopulationSampler(rng, sim, n, covered)
    population = sampler.draw(width)
    for _ in range(moves):
        population = sampler.move(population, population.score, width, 1)
    return index_tree(population, population.score == -np.inf)


def bracket_boundary(key, sim, n):
    """The last safe and the first failing points, [m, D] each, on the ways from 0 to the failures
    that `draw_wide_failures` comes to, by bisection; and evaluations.
    """
    failures, _, sampler = draw_wide_failures(key, sim, n)
    safe, failing = np.zeros_like(failures.z), failures.z
    for _ in range(BISECTIONS if len(failing) else 0):
        half = ((safe + failing) / 2).astype(failing.dtype)
        fails = evaluate_points(sim, half).failure[:, None]
        safe, failing = np.where(fails, safe, half), np.where(fails, half, failing)
    return safe, failing, sampler.evaluations + BISECTIONS * len(failing)


def cool(key, sim, size, *, covered=None, design_points=None, zeroing_rounds=0):
    """So many failing points of small norm, found without a miss distance that could mislead:
    `Explored`.

    Under wider noise N(0, s^2 I) failures are frequent (`draw_wide_failures`). ``size`` of these go
    on, each by Markov moves that keep N(0, s^2 I) given failure, while s falls to `FINAL_WIDTH`. As
    none replaces another one, no failure mode is lost on the way, however little of the probability
    it has. Failures that the ``design_points`` [m, D] do not explain go first. In the last
    ``zeroing_rounds`` they do without some of their numbers. ``covered`` as in `explore`.
    """
    failures, width, sampler = draw_wide_failures(key, sim, DRAWS_PER_POINT * size, covered=covered)
    if not len(failures.z):
        return sampler.result(failures, -math.inf, (width,))
    if design_points is not None and len(design_points):
        failures = index_tree(
            failures, np.argsort(explained(failures.z, design_points), kind="stable")
        )
    failures = index_tree(failures, np.arange(size) % len(failures.z))
    widths = np.geomspace(width, FINAL_WIDTH, COOLING_STEPS)
    for width in widths:
        failures = sampler.move(failures, -math.inf, width, 1)
    failures = sampler.zero_unneeded(failures, zeroing_rounds)
    return sampler.result(failures, math.nan, widths)


def equilibrate(key, sim, points, moves, *, covered=None, max_evaluations=0):
    """Failures as the model has them: ``points`` [n, D], failures, after so many Markov moves that
    keep p(x | failure): (`Population`, the `PopulationSampler`). Where their norms fall, they are
    still on the way, and as many moves follow, for at most ``max_evaluations``. ``covered`` as in
    `explore`.
    """
    n = len(points)
    sampler = PopulationSampler(numpy_generator(key), sim, n, covered)
    failures = sampler.simulate(np.asarray(points, sampler.dtype))
    norm = (failures.z**2).sum()
    while True:
        failures = sampler.move(failures, -math.inf, 1.0, moves)
        before, norm = norm, (failures.z**2).sum()
        stationary = norm > STATIONARY_NORM_RATIO * before
        if stationary or sampler.evaluations + moves * n > max_evaluations:
            return failures, sampler


def _replaced(population, new, where):
    """The ``population`` with the ``new`` one's points ``where`` [n] these are better."""

    def choose(a, b):
        return np.where(where.reshape(-1, *(1,) * (a.ndim - 1)), b, a)

    return Population(*map(choose, population, new))
