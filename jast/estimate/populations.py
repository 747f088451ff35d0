"""Populations that find failures: down the levels of the miss distance (subset simulation, Au and
Beck 2001), or from wider noise inwards.

The Markov moves are those of conditional sampling in the space of normal numbers (Papaioannou,
Betz, Zwirglmaier and Straub 2015), with the size of the moves adapted. One population serves as an
estimator of its own; as an explorer it may be kept out of the failures that a proposal covers
already.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from jast.counter import numpy_generator
from jast.estimate import markov_tilts
from jast.estimate.batches import log_ratio
from jast.estimate.design_points import explained
from jast.estimate.markov_tilts import Tilts, of_the_model, shape
from jast.judge import judged
from jast.limit_state import dimension, normal_numbers
from jast.markov import WIDTHS, proposed

__all__ = ["cool", "edges", "explore", "settled"]

QUANTILE, ACCEPTANCE, LAST = 0.25, 0.4, 5
FAILING, COLD, COOLING, DRAWS = 0.1, 0.25, 60, 4
FALLING = 0.95
"""Of the squares of their norms, what failures have left that fall."""
RESTING, TRIES, HALVES = (0.5, 0.25), 4, 6


class Explored(NamedTuple):
    """What one population came to. On the host."""

    points: Any
    """[n, D] failing points, drawn nearly from p(z | failure); empty where none was reached"""
    used: Any
    """[n] int32 numbers that each one used"""
    log_mean: float
    """Log of the product of the levels' shares: the estimate; -inf where no failure was reached"""
    levels: tuple
    """The miss distances of the levels, or the widths of the noise, falling"""
    evaluations: int
    invalid: int
    complete: bool = True
    """False where it was ended by ``most`` evaluations"""

    @property
    def reached(self):
        """Whether failures were."""
        return len(self.points) > 0


class Population(NamedTuple):
    z: Any
    score: Any
    used: Any
    invalid: Any


class Chain:
    """A population on its way: the moves, their size and the counts, which all explorers share.

    Random numbers and moves are NumPy's: only the system runs on the device.
    """

    def __init__(self, key, sim, size, covered=None):
        self.rng, self.sim, self.size, self.covered = numpy_generator(key), sim, size, covered
        self.scale, self.accepted, self.evaluations, self.invalid = 0.7, math.nan, 0, 0
        self.dtype, self.dimension = normal_numbers(sim), dimension(sim)
        if covered is not None and isinstance(covered[0], Tilts):
            self.dimension = markov_tilts.dimension(shape(sim), sim.horizon)

    def noise(self):
        return self.rng.standard_normal((self.size, self.dimension)).astype(self.dtype)

    def draw(self, width):
        """A new population N(0, width^2 I)."""
        return self.judge(float(width) * self.noise())

    def judge(self, z):
        """The population of these points."""
        return self.count(_judge(self.sim, z, self.covered))

    def move(self, people, rows, level, width, times):
        """``people[rows]`` after Markov moves that keep N(0, width^2 I) given score <= level."""
        for _ in range(times):
            before = only(people, rows)
            new = _judge(
                self.sim, proposed(before.z, self.noise(), self.scale, float(width)), self.covered
            )
            good = new.score <= level
            self.count(new)
            people = _either(good, new, before)
            self.accepted = float(good.mean())
            self.scale = float(
                np.clip(self.scale * math.exp(self.accepted - ACCEPTANCE), 0.02, 1.0)
            )
            rows = np.arange(self.size)
        return people

    def rest(self, people, times):
        """Failures ``people`` without the numbers that they do not need, which come to 0: some are
        tried together, ``times`` over, as delta debugging does (Zeller and Hildebrandt 2002).
        """
        none = True
        for i in range(times):
            some = self.rng.random(people.z.shape) < RESTING[i % len(RESTING)]
            new = self.judge(np.where(some, 0, people.z).astype(self.dtype))
            good = (new.score == -math.inf) & (new.z != people.z).any(axis=1)
            people, none = _either(good, new, people), none and not good.any()
            if none and i + 1 == TRIES:  # they need them all
                break
        return people

    def count(self, people):
        self.evaluations += self.size
        self.invalid += int(people.invalid.sum())
        return people

    def end(self, people, log_mean, levels):
        if people is None:
            return Explored(
                np.zeros((0, self.dimension)),
                np.zeros(0, np.int32),
                -math.inf,
                tuple(levels),
                self.evaluations,
                self.invalid,
            )
        return Explored(
            np.asarray(people.z),
            np.asarray(people.used),
            log_mean,
            tuple(levels),
            self.evaluations,
            self.invalid,
        )


def explore(key, sim, size, *, covered=None, least=-math.inf, most=10**9):
    """Subset simulation: take a population of ``size`` points down the levels of the miss distance
    to the failures of ``sim``: `Explored`.

    ``covered``: (`Latent` or `Tilts` q, log threshold): points with log q - log p above it are left
    out, so that the population looks for failures that q does not draw, and the estimate is of
    those alone. Points are what q has them to be.
    It gives up below the log probability ``least``, where it would take more than ``most``
    evaluations, or where no level falls further.
    """
    chain = Chain(key, sim, size, covered)
    people = chain.draw(1.0)
    log_mean, level, levels = 0.0, math.inf, []
    while True:
        score = np.asarray(people.score)
        share = np.mean(score == -np.inf)
        if share >= QUANTILE:
            level = -math.inf
        elif log_mean < least:
            return chain.end(None, log_mean, levels)
        elif chain.evaluations + size * (1 + LAST) > most:
            return chain.end(None, log_mean, levels)._replace(complete=False)
        else:
            level = _next(score, level)
            if level is None and share == 0:
                return chain.end(None, log_mean, levels)
            level = -math.inf if level is None else level
        log_mean += math.log(np.mean(score <= level))
        elites = np.flatnonzero(score <= level)
        # each elite as often as any other, or once more
        rows = elites[(np.arange(size) + len(levels)) % len(elites)]
        if level == -math.inf:
            return chain.end(chain.move(people, rows, level, 1.0, LAST), log_mean, levels)
        people = chain.move(people, rows, level, 1.0, 1)
        levels.append(level)


def widened(key, sim, n, *, covered=None):
    """Failures under wider noise N(0, s^2 I), at the first width s of `WIDTHS` at which a share of
    ``FAILING`` of some ``n`` draws fails, or at the last: (`Population` [m] of them, s, the
    `Chain`). ``covered`` as in `explore`.
    """
    chain = Chain(key, sim, -(-n // DRAWS), covered)
    for width in WIDTHS:
        drawn = [chain.draw(width) for _ in range(DRAWS)]
        people = Population(*map(np.concatenate, zip(*drawn, strict=True)))
        failing = np.flatnonzero(people.score == -np.inf)
        if len(failing) >= FAILING * len(people.z) or width == WIDTHS[-1]:
            return only(people, failing), width, chain


def edges(key, sim, n):
    """The last safe and the first failing points, [m, D] each, on the ways from 0 to the failures
    that `widened` comes to, by halves; and evaluations.
    """
    people, _, chain = widened(key, sim, n)
    outside, inside = np.zeros_like(people.z), people.z
    for _ in range(HALVES if len(inside) else 0):
        half = ((outside + inside) / 2).astype(inside.dtype)
        fails = judged(sim, half).failure[:, None]
        outside, inside = np.where(fails, outside, half), np.where(fails, half, inside)
    return outside, inside, chain.evaluations + HALVES * len(inside)


def cool(key, sim, chains, *, covered=None, known=None, rests=0):
    """Failing points of small norm, one a chain, found without a miss distance that could mislead:
    `Explored`.

    Under wider noise N(0, s^2 I) failures are frequent (`widened`). ``chains`` of these failures go
    on, each by Markov moves that keep N(0, s^2 I) given failure, while s falls to ``COLD``. As no
    chain replaces another one, no failure mode is lost on the way, however little of the
    probability it has. ``known`` [m, D]: design points, from failures that these do not explain
    chains start first. ``rests``: tries at the end to do without some of the numbers. ``covered``
    as in `explore`.
    """
    people, width, chain = widened(key, sim, DRAWS * chains, covered=covered)
    if not len(people.z):
        return chain.end(None, -math.inf, (width,))
    if known is not None and len(known):
        people = only(people, np.argsort(explained(people.z, known), kind="stable"))
    people = only(people, np.arange(chains) % len(people.z))
    widths = np.geomspace(width, COLD, COOLING)
    for width in widths:
        people = chain.move(people, np.arange(chains), -math.inf, width, 1)
    return chain.end(chain.rest(people, rests), math.nan, widths)


def settled(key, sim, points, moves, *, covered=None, most=0):
    """Failures as the model has them: ``points`` [n, D], failures, after so many Markov moves that
    keep p(x | failure): (`Population`, the `Chain`). Where their norms fall, they are still on the
    way, and as many moves follow, for at most ``most`` evaluations. ``covered`` as in `explore`.
    """
    chain, rows = Chain(key, sim, len(points), covered), np.arange(len(points))
    people = chain.judge(np.asarray(points, chain.dtype))
    norm = (people.z**2).sum()
    while True:
        people = chain.move(people, rows, -math.inf, 1.0, moves)
        before, norm = norm, (people.z**2).sum()
        if norm > FALLING * before or chain.evaluations + moves * len(points) > most:
            return people, chain


def _either(good, new, before):
    """The population ``new`` where ``good`` [n], else ``before``."""
    at = lambda a: good.reshape(-1, *(1,) * (a.ndim - 1))
    return Population(*(np.where(at(a), a, b) for a, b in zip(new, before, strict=True)))


def only(people, rows):
    """The `Population` of ``rows``."""
    return Population(*(a[rows] for a in people))


def _next(score, last):
    """The next level: the sample quantile of the scores, below the last one; None where there is
    none above the failures.
    """
    level = np.sort(score)[math.ceil(QUANTILE * len(score)) - 1]
    if level < last:
        return float(level)
    below = score[(score < last) & (score > -np.inf)]
    return float(below.max()) if below.size else None


def _judge(sim, z, covered):
    if covered is None:
        o = judged(sim, z)
        return Population(z, o.score, o.used, o.invalid)
    q, threshold = covered
    if isinstance(q, Tilts):
        o, log_q, _ = of_the_model(sim, q, z)
    else:
        o = judged(sim, z)
        log_q = log_ratio(q, z, o.used)
    score = np.where(log_q > float(threshold), np.inf, o.score)
    return Population(z, score, o.used, o.invalid)
