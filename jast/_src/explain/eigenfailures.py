"""eigenfailures: the few directions in which the failures of a mode differ from the model."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PRNGKey
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.gaussians.mixture_fit import effective_sample_size
from jast._src.explain.episodes import gather_episodes
from jast._src.explain.estimate_draws import UNRELIABLE, failing_draws, free_undecided, normalised
from jast._src.normal_space import transform
from jast._src.normal_space.episode_point import number_names, number_steps, turned_in_time
from jast._src.search.refine.modes import pointing
from jast._src.util import checks, display
from jast._src.util.pytrees import index_tree

__all__ = ["Eigenfailures", "eigenfailures"]

KEPT = 4096  # failing draws that are looked at, at most
FAILURES = 20  # effective ones, below which there is no answer
RELIABLE = 100  # and below which it is UNRELIABLE
BEYOND = 3.0
"""t of the bounds of Davidson and Szarek (2001): of n draws of the model all deviations lie within
1 -+ (sqrt(D) + t) / sqrt(n), but with the probability 2 exp(-t^2 / 2); at most, seldom in truth.
"""
PRINTED = 4  # numbers of a direction


@display.printable()
class Eigenfailures(NamedTuple):
    """K directions in the space of the N normal numbers, the one that differs most first.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing(b=0.5)
        >>> estimate = jast.estimate.failure_probability(key, sim, 6000)
        >>> found = jast.explain.eigenfailures(key, sim, estimate)
        >>> found.directions.shape[1] == len(found.names) == len(found.mean)
        True
    """

    directions: np.ndarray
    """[K, N] of norm 1; the failures lie on the positive side"""
    variances: np.ndarray
    """[K] of the failures along each; the model's is 1"""
    shifts: np.ndarray
    """[K] mean of the failures along each, in standard deviations of the model, whose mean is 0"""
    nats: np.ndarray
    """[K] by how much each tells the failures from the model: the Kullback-Leibler divergence of a
    normal distribution of this mean and variance from the standard one"""
    mean: np.ndarray
    """[N] the mean failure"""
    names: tuple[str, ...]
    """[N] what each number is called"""
    steps: np.ndarray
    """[N] int: the step that each belongs to, from 1, in failures that all end at step ``end``; 0
    is the start"""
    end: int
    middle: Episode
    """The replay of the mean failure, without states"""
    minus: Episode
    """[K] replays of it less one standard deviation of the failures along each direction"""
    plus: Episode
    """[K] the same, one standard deviation further"""
    chance: tuple[float, float]
    """Variances between which those of as many draws of the model would lie"""
    ess: float
    """Effective number of failures behind it"""
    reliable: bool
    """Whether the estimate is, where there is one, and there are 100 effective failures or more"""
    evaluations: int

    def __str__(self) -> str:
        low, high = self.chance
        lines = [] if self.reliable else [UNRELIABLE]
        lines.append(
            f"{self.ess:.0f} effective failures, all to end at step {self.end}; by chance variances"
            f" lie between {low:.2f} and {high:.2f}; the mean failure: {_outcome(self.middle)}"
        )
        lines.append(
            f"{'':>2} {'nats':>7} {'variance':>8} {'shift':>6} {'at -1':>24} {'at +1':>24}"
        )
        for k, direction in enumerate(self.directions):
            at = [_outcome(index_tree(e, k)) for e in (self.minus, self.plus)]
            lines.append(
                f"{k + 1:2d} {self.nats[k]:7.3f} {self.variances[k]:8.3f} {self.shifts[k]:6.2f}"
                f" {at[0]:>24} {at[1]:>24}"
            )
            first = np.argsort(-np.abs(direction), kind="stable")[:PRINTED]
            parts = (f"{self.names[i]} {direction[i]:+.2f} at {self.steps[i]}" for i in first)
            lines.append(f"   {', '.join(parts)}")
        return "\n".join([*lines, *["nothing differs beyond chance"] * (not len(self.directions))])


def eigenfailures(
    key: PRNGKey, sim: Simulator, failures: Any, mode: int = 0, *, directions: int = 3
) -> Eigenfailures:
    """In which few directions do the failures of a mode differ from the model?

    The failures are taken as points of the independent normal numbers behind their disturbances,
    moved in time so that all end with the last of them. There the model has the mean 0 and the
    variance 1 in every direction. The directions are
    principal components of the failures: eigenvectors of their covariance whose eigenvalue lies
    beyond those of as many draws of the model, small ones too, as what a failure needs varies less:
    these are the best few to tell failures from the model (El Masri, Morio and Simatos, 2024). What
    they leave of the mean is a direction of its own, where it is more than chance leaves. The mean
    failure is played again, and with one standard deviation more and less along each direction.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        failures: a report of `jast.stress`, whose estimate's failing draws are used, where it kept
            them, and else its failures; an `Estimate` of `jast.estimate.failure_probability` from
            5000 episodes on; or failures that all count the same: those of
            `jast.estimate.failure_samples`, an archive, an `jast.Episode` with a leading axis.
            Archives of searches hold the likeliest failures, which differ less than others do.
        mode: of a report, the failure mode, from 0: those failures whose direction is nearest to
            that of its likeliest one. Others are taken as one mode.
        directions: K at most.

    Returns:
        `Eigenfailures`. Its ``evaluations`` are 1 + 2 K episodes, one for each mode where there are
        several, one for each failure that comes without an estimate, and, where the estimate was
        made by tilts, those of the chunks that are drawn again.

    Raises:
        ValueError: for fewer than 20 effective failures, a mode that there is not, an estimate as
            `indices` refuses it, and episodes that do not fail or are of another simulator.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.landing(b=0.5)
        >>> estimate = jast.estimate.failure_probability(key, sim, 6000)
        >>> found = jast.explain.eigenfailures(key, sim, estimate)
        >>> bool(found.plus.failure[0])
        True
    """
    name = "eigenfailures"
    checks.check_random_key(name, key)
    mode = checks.whole_number(name, "mode", mode, 0)
    directions = checks.whole_number(name, "directions", directions)
    transform.check(name, sim)
    z, log_w, length, good, spent = _points(name, sim, failures)
    ways = [] if isinstance(failures, Estimate) else getattr(failures, "modes", None) or []
    if mode >= max(len(ways), 1):
        raise ValueError(f"{name}: mode must be below {max(len(ways), 1)}, received {mode}")
    if len(ways) > 1:
        rows = _modes_of(sim, z, length, ways) == mode
        z, log_w, length, spent = z[rows], log_w[rows], length[rows], spent + len(ways)
    ess = float(effective_sample_size(log_w)) if len(z) else 0.0
    if ess < FAILURES:
        must = f"be at least {FAILURES} effective ones of the mode"
        raise checks.wrong(name, "failures", must, f"{ess:.3g}")
    z = free_undecided(sim, z, length, numpy_generator(key)).astype(np.float64)
    # as late as the last of them: what was behind the end comes first
    last = int(length.max())
    z = turned_in_time(sim, z, last - length[:, None], last)
    mean, variances, vectors, chance = components(z, normalised(log_w), ess)
    shifts = vectors @ mean
    nats = (variances - 1 - np.log(np.maximum(variances, 1e-300)) + shifts**2) / 2
    order = np.argsort(-nats, kind="stable")[:directions]
    vectors = vectors[order] * np.where(shifts[order] < 0, -1, 1)[:, None]
    moves = np.sqrt(variances[order])[:, None] * vectors
    played = transform.played(sim, np.concatenate([mean[None], mean - moves, mean + moves]))
    k = len(order)
    middle, minus, plus = (
        index_tree(played, rows) for rows in (0, slice(1, k + 1), slice(k + 1, None))
    )
    return Eigenfailures(
        directions=vectors,
        variances=variances[order],
        shifts=np.abs(shifts[order]),
        nats=nats[order],
        mean=mean,
        names=tuple(number_names(sim)),
        steps=number_steps(sim),
        end=last,
        middle=middle,
        minus=minus,
        plus=plus,
        chance=chance,
        ess=ess,
        reliable=good and ess >= RELIABLE,
        evaluations=spent + 2 * k + 1,
    )


def components(
    z: np.ndarray, w: np.ndarray, ess: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[float, float]]:
    """Where points ``z`` [m, D] with weights ``w`` [m] of sum 1, worth ``ess`` equal ones, differ
    from the standard normal distribution: (mean [D], variances [K], directions [K, D], the
    variances of chance).
    """
    mean, d = w @ z, z.shape[1]
    away = (z - mean) * np.sqrt(w / (1 - 1 / ess))[:, None]
    scales, vectors = np.linalg.svd(away, full_matrices=False)[1:]
    gap = (math.sqrt(d) + BEYOND) / math.sqrt(ess)
    low, high = max(1 - gap, 0.0) ** 2, (1 + gap) ** 2
    told = (scales**2 < low) | (scales**2 > high)
    vectors, variances = vectors[told], scales[told] ** 2
    # the rest of the mean has its own error and, to first order, that of these directions
    rest = mean - (vectors @ mean) @ vectors
    error = 1 + ((vectors @ mean) ** 2 * variances / (1 - variances) ** 2).sum()
    if (size := np.linalg.norm(rest)) > gap * math.sqrt(error):
        vectors = np.concatenate([vectors, rest[None] / size])
    return mean, ((away @ vectors.T) ** 2).sum(axis=0), vectors, (low, high)


def _points(
    name: str, sim: Simulator, given: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool, int]:
    """(points [m, D], log weights [m], steps [m], whether an estimate is reliable, evaluations)."""
    p = given if isinstance(given, Estimate) else getattr(given, "probability", None)
    held = isinstance(p, Estimate) and p.draws is not None and p.draws.failure.any()
    if p is given or held:
        z, log_w, length, spent = failing_draws(name, sim, p, KEPT)
        return z, log_w, length, bool(p.reliable), spent
    e = gather_episodes(name, "failures", sim, given)
    if not e.failure.all():
        raise ValueError(
            f"{name}: failures must all fail, received {np.count_nonzero(~e.failure)} episodes of"
            f" {len(e.failure)} that do not"
        )
    return transform.normal_of(sim, e), np.zeros(len(e.length)), e.length, True, len(e.length)


def _modes_of(sim: Simulator, z: np.ndarray, length: np.ndarray, ways: Any) -> np.ndarray:
    """The mode of each of the points ``z`` [m, D], by direction: [m]."""
    known = np.arange(z.shape[1]) < transform.used_numbers(sim, length)[:, None]
    heads = gather_episodes("eigenfailures", "failures", sim, ways)
    ends = transform.normal_of(sim, heads), heads.length
    return pointing(sim, np.where(known, z, 0), length, *ends)


def _outcome(e: Episode) -> str:
    return f"{'fails' if e.failure else 'does not fail'}, {int(e.length)} steps"
