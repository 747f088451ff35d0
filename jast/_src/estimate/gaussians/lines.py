"""Lines towards half-spaces of failure, each of which tells a probability by itself.

Line sampling (Koutsourelakis, Pradlwarter and Schueller 2004): along the normal of a half-space a
line fails from some place on, its root, and the tail of a normal number behind it is the
probability of the line; the mean of random lines is that of the system. Several half-spaces share
what fails by weights that sum to one at each point. A root that few runs find may be wrong, and a
line may fail elsewhere, too: one more run, at a random place of each line, corrects what its root
says (a difference estimator, as in `estimate.few_calls`), so that the mean is unbiased whatever the
roots are.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.estimate.gaussians.half_spaces import Planes
from jast._src.estimate.gaussians.moments import FARTHER, INSIDE
from jast._src.normal_space.moments import distances
from jast._src.util.pytrees import index_tree

__all__ = ["MIN_COST", "LineValues", "draw_lines"]

ROOT_RUNS = 3
"""Of a line to find its root: after two the roots of curved boundaries are wrong by some .02 of a
standard deviation, which costs ten times the variance."""
MORE_RUNS = 3
"""Of a line whose root is not known by then to `APART`, at most."""
MIN_COST = ROOT_RUNS + 1
"""Runs of a line at the least: the last one corrects it."""
SHORT = 0.9
"""Part of the way to where a slope leads: a distance that is 0 beyond the root tells nothing."""
BACK = 0.5
"""Standard deviations to step back where a line fails already."""
APART = 1e-2
"""Standard deviations between two runs of which a slope is taken: nearer ones are rounding. A root
that is known to them costs hardly any variance."""
NEAREST = 1e-3
"""Standard deviations to which a root is believed at the best."""
NODES = 32
"""Places of a tail at which the share of a half-space in it is taken."""
PRODUCTS = 2**22
"""Places times half-spaces that are looked at together: 32 megabytes an array."""


class LineValues(NamedTuple):
    """What n lines say, and what they cost."""

    values: np.ndarray
    """[n] independent unbiased estimates of the probability, over that of all half-spaces together;
    invalid episodes count as not failing
    """
    if_invalid_fail: np.ndarray
    """[n] what the invalid ones among their last runs would add if they failed"""
    invalid: int
    """Runs with a number that is not finite"""
    runs: int


class Line(NamedTuple):
    """n lines. On the host."""

    plane: np.ndarray
    """[n] the half-space that each leads to"""
    origin: np.ndarray
    """[n, D] where each crosses the plane through the model's middle"""
    normal: np.ndarray
    """[n, D]"""


def draw_lines(
    rng: np.random.Generator, sim: Simulator, planes: Planes, n: int, dtype: Any
) -> LineValues:
    """The `LineValues` of ``n`` lines towards ``planes``."""
    from scipy.special import log_ndtr  # here: slow to import

    shares = np.exp(planes.log_mass - np.logaddexp.reduce(planes.log_mass))
    k = rng.choice(len(shares), n, p=shares / shares.sum())
    normal, z = planes.normal[k], rng.standard_normal((n, planes.normal.shape[1]))
    line = Line(k, z - (z * normal).sum(axis=1, keepdims=True) * normal, normal)
    invalid = []  # of each run

    def run(place, rows):
        o, g = distances(sim, (line.origin[rows] + place[:, None] * normal[rows]).astype(dtype))
        invalid.extend(np.asarray(o.invalid))
        return np.asarray(o.failure), np.where(np.isnan(g), np.inf, g).min(axis=1)

    root, error = _roots(run, planes.depth[k], planes.rate[k])
    # a place of each of as many equal parts of the tail
    parts = (np.arange(NODES) + rng.random((n, 1))) / NODES
    tail = _share(planes, line, _place_of_tail(log_ndtr(-root)[:, None] + np.log(parts)))
    known = _exp(log_ndtr(-root) - planes.log_mass[k]) * tail.mean(axis=1)
    place, log_q = _places_to_look_at(rng, root, error)
    failing, _ = run(place, np.arange(n))
    weight = _exp(_log_density(place) - log_q - planes.log_mass[k])
    weight *= _share(planes, line, place[:, None])[:, 0]
    wrong = failing.astype(np.float64) - (place > root)
    if_invalid_fail = weight * np.array(invalid[-n:])
    return LineValues(known + weight * wrong, if_invalid_fail, int(sum(invalid)), len(invalid))


def _exp(log):
    """exp, bounded so that cubes are finite."""
    return np.exp(np.minimum(log, 200.0))


class Roots(NamedTuple):
    """What is known of the roots of n lines: places along them, [n] each."""

    place: np.ndarray
    """Where they are looked at next"""
    base: np.ndarray
    """Where the last distance was seen that tells something; NaN before"""
    left: np.ndarray
    """That distance"""
    slope: np.ndarray
    safe: np.ndarray
    """The farthest that is known to be safe"""
    failed: np.ndarray
    """The nearest that is known to fail"""
    root: np.ndarray
    error: np.ndarray
    """How far the last step went to get there"""


def _roots(run, depth, rate):
    """Where lines begin to fail [n], and how well that is known [n]."""
    no = np.full(len(depth), np.nan)
    anywhere = np.full(len(depth), np.inf)
    known = Roots(INSIDE * depth, no, no, rate, -anywhere, anywhere, depth, anywhere)
    rows = np.arange(len(depth))
    for i in range(ROOT_RUNS + MORE_RUNS):
        if i >= ROOT_RUNS:
            rows = np.flatnonzero(known.error > APART)
        if len(rows):
            new = _nearer(index_tree(known, rows), *run(known.place[rows], rows))
            known = Roots(*map(_put, known, [rows] * len(new), new))
    return known.root, np.maximum(known.error, NEAREST)


def _put(a, rows, new):
    """``a`` with ``new`` values at these ``rows``."""
    a = a.copy()
    a[rows] = new
    return a


def _nearer(known, failing, g):
    """The `Roots` with one more run of each line: by the secant rule, within what is known to be
    safe and to fail.
    """
    place, base, left, slope, safe, failed, *_ = known
    safe = np.where(failing, safe, np.maximum(safe, place))
    failed = np.where(failing, np.minimum(failed, place), failed)
    tells = np.isfinite(g) & ~(failing & (g >= 0))  # where it fails 0 or inf tell nothing
    with np.errstate(invalid="ignore", divide="ignore"):
        secant = (left - g) / (place - base)
    slope = np.where(tells & (np.abs(place - base) > APART) & (secant > 0), secant, slope)
    base, left = np.where(tells, place, base), np.where(tells, g, left)
    step = np.clip(left / slope, -FARTHER, FARTHER)
    root = base + step
    lost = ~((root > safe) & (root < failed))
    middle = np.where(np.isfinite(failed), failed - BACK, safe + NEAREST)
    both = np.isfinite(safe) & np.isfinite(failed)
    middle[both] = (safe[both] + failed[both]) / 2
    root = np.where(lost, middle, root)
    error = np.minimum(np.abs(root - place), np.maximum(np.abs(root - safe), np.abs(failed - root)))
    next_place = np.where(lost, root, base + np.where(step > 0, SHORT, 1.0) * step)
    return Roots(next_place, base, left, slope, safe, failed, root, error)


def _places_to_look_at(rng, root, error):
    """A place of each line [n], and the log of the density that it was drawn from: half of them
    next to the root, within its ``error``, a quarter in the tail behind it, and one before it.
    """
    from scipy.special import log_ndtr  # here: slow to import

    n, kind = len(root), rng.random(len(root))
    near = root + error * rng.standard_normal(n)
    tail = _place_of_tail(log_ndtr(-root) + np.log(rng.random(n)))
    before = root - np.abs(rng.standard_normal(n))
    place = np.select([kind < 0.5, kind < 0.75], [near, tail], before)
    log_near = _log_density((place - root) / error) - np.log(error)
    log_tail = _log_density(place) - log_ndtr(-root)
    log_before = _log_density(place - root) + math.log(2)
    log_side = np.where(place > root, log_tail, log_before)
    return place, np.logaddexp(math.log(0.5) + log_near, math.log(0.25) + log_side)


def _log_density(x):
    """Of a normal number."""
    return -0.5 * x**2 - 0.5 * math.log(2 * math.pi)


def _place_of_tail(log_p):
    """What a normal number is above with a probability of this log."""
    from scipy.special import ndtri_exp  # here: slow to import

    return -ndtri_exp(log_p)


def _share(planes, line, place):
    """[n, m] the part of what fails at m places of each line that its own half-space counts: as
    likely as the place is under the model moved to that half-space, and not to another.
    """
    n, most = len(place), max(PRODUCTS // (place.shape[1] * len(planes.depth)), 1)
    if n > most:
        parts = [np.s_[i : i + most] for i in range(0, n, most)]
        return np.concatenate([_share(planes, index_tree(line, i), place[i]) for i in parts])
    along = planes.normal[line.plane] @ planes.normal.T
    reach = (line.origin @ planes.normal.T)[:, None] + place[..., None] * along[:, None]
    log_of = planes.depth * (reach - planes.depth)
    own = np.take_along_axis(log_of, line.plane[:, None, None], axis=2)[..., 0]
    return np.exp(own - np.logaddexp.reduce(log_of, axis=2))
