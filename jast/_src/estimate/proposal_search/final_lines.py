"""The estimate by half-spaces: lines towards their boundaries and draws beyond them, half of what
is left each, where a line tells more than the draws that it costs.

Draws confirm what the lines say, which know only where half-spaces are, and tell what these do not:
when and how the system fails.
"""

import math
from typing import NamedTuple

import numpy as np

from jast._src.estimate import diagnostics
from jast._src.estimate.estimate import Estimate, invalid_warnings
from jast._src.estimate.gaussians.family import GaussianFamily
from jast._src.estimate.gaussians.lines import MIN_COST, draw_lines
from jast._src.estimate.population.search import MAX_DISAGREEMENT, Answer
from jast._src.estimate.proposal_search.search_state import SearchState
from jast._src.util.intervals import log_normal

__all__ = ["Lines", "add_lines", "draw_half_by_lines"]

FIRST_LINES = 12
"""Lines that tell whether more are worth it: a fiftieth of 2000 evaluations. A convention."""
TINY = np.finfo(float).tiny
MAX_SPREAD = 0.5
"""Relative standard deviation of lines up to which a hundred of them tell their mean: if they are
log-normal, 3 % of it lies beyond the greatest of a hundred, and with a deviation of 2 it is 14 %.
Of 90 calls on 30 closed loops (``python -m benchmarks.random_loops --budget 3000 --loops 0 30
--keys 3``), 17 have lines that vary more; two of these would be believed, at .52 and .56 of the
truth."""
MAX_ERROR = 1 / math.sqrt(diagnostics.MIN_MODE_ESS)
"""Relative standard error above which lines and draws together are not believed: that of as many
effective draws as draws alone need."""
MAX_SHARE = diagnostics.MAX_SHARE_OF_ERROR * MAX_ERROR
"""Part of all lines that one may carry: as of draws."""


class Lines(NamedTuple):
    """What lines say."""

    log_scale: float
    values: np.ndarray
    """[n] independent unbiased estimates of the probability, over exp(``log_scale``)"""
    weight: float
    """Of their mean beside that of draws, by the variances of the first of them and of batches"""
    invalid: int = 0
    """Runs with a number that is not finite"""
    if_invalid_fail: float = 0.0
    """What invalid runs would add to the sum of ``values`` if they failed"""

    @property
    def answer(self) -> Answer:
        """Their mean, which is above 0, and its error as if one more line had said twice as much or
        nothing: n equal ones do not exclude that one of n differs.
        """
        mean, n = float(self.values.mean()), len(self.values)
        error = float(self.values.std(ddof=1)) / math.sqrt(n) / mean
        return Answer(self.log_scale + math.log(mean), math.hypot(error, 1 / n))

    @property
    def alike(self) -> bool:
        """Whether they vary so little that they need no draws to be believed."""
        return float(self.values.std(ddof=1)) <= MAX_SPREAD * float(self.values.mean())

    @property
    def skewness(self) -> float:
        """Of the mean."""
        apart = self.values - self.values.mean()
        third, second = float((apart**3).mean()), float((apart**2).mean())
        return third / second**1.5 / math.sqrt(len(apart)) if second > 0 else 0.0


def draw_half_by_lines(f: GaussianFamily, state: SearchState) -> tuple[SearchState, Lines | None]:
    """The state after half of what is left, about; with None and after a few lines, where a line
    tells less than the draws that it costs.
    """
    left = f.budget - state.spent
    if state.planes is None or left < 3 * FIRST_LINES * MIN_COST or not 0 < state.efficiency < 1:
        return state, None
    about = f.context.rng, f.sim, state.planes
    values, if_invalid_fail, invalid, runs = draw_lines(*about, FIRST_LINES, f.dtype)
    mean, spread = float(values.mean()), float(values.var(ddof=1))
    of_line = runs / FIRST_LINES * spread / mean**2 if mean > 0 else math.inf
    of_draw = 1 / state.efficiency - 1
    text = f"lines: an evaluation has a relative variance of {of_line:.3g}, of draws {of_draw:.3g}"
    state = state.note(text, runs)
    f.context.keep(f, state)
    if of_line >= of_draw or spread > MAX_SPREAD**2 * mean**2:
        return state, None
    if (rest := (left // 2 - runs) * FIRST_LINES // runs) > 0:
        more = draw_lines(*about, rest, f.dtype)
        values = np.concatenate([values, more.values])
        if_invalid_fail = np.concatenate([if_invalid_fail, more.if_invalid_fail])
        invalid, runs = invalid + more.invalid, runs + more.runs
        state = state.note(f"lines: {rest} more", more.runs)
        f.context.keep(f, state)
    weight = runs * of_draw / (runs * of_draw + (left - runs) * of_line)
    scale = float(np.logaddexp.reduce(state.planes.log_mass))
    return state, Lines(scale, values, weight, invalid, float(if_invalid_fail.sum()))


def add_lines(found: Estimate, lines: Lines) -> Estimate:
    """The `Estimate` that was ``found`` by draws with what ``lines`` say; UNRELIABLE where the two
    do not agree. What it says of weights and modes is of the draws.
    """
    found = found._replace(invalid=found.invalid + lines.invalid)
    if math.isnan(found.log_mean) or not lines.values.mean() > 0:
        reason = "lines to the boundary and draws do not both tell a probability above 0"
        return found._replace(reliable=False, warnings=(reason, *found.warnings))
    draws, answer = Answer(found.log_mean, found.relative_error), lines.answer
    ratio = math.exp(min(answer.log_mean - draws.log_mean, 700.0))
    parts = np.array([lines.weight * ratio, 1 - lines.weight])
    log_mean = min(draws.log_mean + math.log(max(parts.sum(), TINY)), 0.0)
    errors = parts * [answer.relative, draws.relative] / parts.sum()
    relative = float(np.hypot(*errors))
    interval = log_normal(
        log_mean, relative, found.level, lines.skewness * (errors[0] / relative) ** 3
    )
    reasons = _reasons(draws, lines, relative)
    one = found.modes is not None and len(found.modes) == 1
    return found._replace(
        log_mean=log_mean,
        mean=math.exp(log_mean),
        standard_error=math.exp(log_mean) * relative,
        relative_error=relative,
        interval=interval,
        mode_intervals=np.array([interval]) if one else _moved(found, log_mean),
        reliable=found.reliable and not reasons,
        warnings=(*reasons, *found.warnings),
    )


def _moved(found, log_mean):
    """The intervals of its modes about parts of another mean."""
    scale = math.exp(log_mean - found.log_mean)
    return None if found.mode_intervals is None else np.minimum(scale * found.mode_intervals, 1.0)


def _reasons(draws, lines, relative):
    """Why draws and lines together must not be believed."""
    total = float(lines.values.sum())
    reasons = invalid_warnings(lines.invalid, lines.if_invalid_fail, total)
    share = np.abs(lines.values).max() / total
    if draws.apart(lines.answer) > MAX_DISAGREEMENT:
        reasons.append(
            f"lines to the boundary say {lines.answer}, draws {draws}: one of them misses a part of"
            " what fails"
        )
    if relative > MAX_ERROR:
        reasons.append(f"relative standard error {relative:.0%}, above {MAX_ERROR:.0%}")
    if share > MAX_SHARE:
        reasons.append(f"one line carries {share:.0%} of all, above {MAX_SHARE:.0%}")
    return reasons
