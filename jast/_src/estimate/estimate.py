"""The answer of every estimator: a probability, how sure it is, and whether to believe it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.estimate import diagnostics
from jast._src.estimate.weight_sums import Sums, mode_shares, moments
from jast._src.estimate.weighted_draws import Draws
from jast._src.util import display
from jast._src.util.intervals import chernoff, clopper_pearson, jeffreys, log_normal

__all__ = [
    "MAX_INVALID_SHARE",
    "MAX_RELATIVE_ERROR",
    "UNCONFIRMED",
    "Estimate",
    "estimate_from_counts",
    "estimate_from_mean",
    "estimate_from_weights",
    "flag_imprecise",
    "guaranteed_words",
    "invalid_warnings",
    "is_doubtful",
    "times_too_few",
]

MAX_INVALID_SHARE = 0.01
"""Part of an estimate that invalid episodes may add if they failed. A convention."""
MIN_COUNTED_FAILURES = 10
"""Failures from which on a count is believed: its relative standard error is then below a third."""
MAX_RELATIVE_ERROR = 0.05
"""Relative standard error above which 10 % more or less lies within a 95 % interval."""
IMPRECISE = "relative standard error"
"""How the warning begins of an `Estimate` that nothing is wrong with but that."""
UNCONFIRMED = "not confirmed:"
"""How the warning begins of an `Estimate` that no second way agrees with."""
MAX_LISTED_MODES = 12
"""Modes that are printed: a line of the screen."""


@display.result_class("samples")
class Estimate(NamedTuple):
    """A failure probability. Python numbers and NumPy arrays; where it must not be believed,
    ``print`` says UNRELIABLE and why before any number, and then first what plain draws guarantee.

    Good diagnostics are necessary, not sufficient: a proposal that never reaches a failure mode
    gives weights that look perfect.

    Example:
        >>> import jax, jast
        >>> counted = jast.estimate.monte_carlo(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> counted.mean == counted.failing / counted.samples, counted.reliable
        (True, True)
    """

    method: str
    log_mean: float
    """Natural logarithm of the estimate; NaN where no failure was seen, as 0 is not known to be the
    answer
    """
    mean: float
    """The estimate; NaN likewise, 0 where it is below the least double"""
    standard_error: float
    """Of the mean"""
    relative_error: float
    """standard_error / mean, also where both are below the least double"""
    interval: tuple[float, float]
    """(low, high) at ``level``: log-normal (above 0, skewed as the estimate is), with ``high``
    corrected for the skewness of the weights; of plain counts Clopper and Pearson's
    """
    level: float
    ess: float
    """Effective sample size of the failing episodes, (sum w)^2 / sum w^2"""
    k_hat: float
    """Pareto shape of the greatest weights: `jast.estimate.pareto_k`"""
    max_share: float
    """Greatest weight over the sum of all"""
    failing: int
    """Failing episodes among ``samples``; ``failures_seen`` is another name"""
    samples: int
    """Episodes that the estimate is the mean of"""
    episodes: int
    """Episodes simulated in all, the search for a proposal included; ``evaluations`` is another
    name
    """
    steps: int
    """Simulator steps of ``samples``"""
    invalid: int
    """Episodes in which the simulator returned a number that is not finite; they count as not
    failing
    """
    modes: np.ndarray | None
    """[K] the part of the estimate that each component or failure mode carries, of sum 1"""
    reliable: bool
    """No known reason against it"""
    warnings: tuple[str, ...]
    """Texts: the reasons why not, then remarks"""
    chernoff: float | None = None
    """Of plain counts: upper bound at one-sided ``level`` (the paper's eq. 17)"""
    jeffreys: float | None = None
    """Of plain counts: upper bound at one-sided ``level`` by Jeffreys' prior (eq. 18)"""
    unseen: float | None = None
    """Where a share of the draws was the model's own: the upper bound, at one-sided ``level``, on
    the probability of failures that nothing led to and none of these draws met: -log(1 - level) / n
    """
    proposal: Any = None
    """What it was drawn from, where the method found it: for `jast.estimate.failure_samples`"""
    history: tuple[str, ...] | None = None
    """How that was found, a text a line"""
    settings: dict[str, Any] | None = None
    """What was asked for: ``method`` and numbers"""
    mode_intervals: np.ndarray | None = None
    """[K, 2] intervals of the probability of each of ``modes``"""
    draws: Draws | None = None
    """`jast.estimate.Draws`: the weighted draws, for `jast.estimate.exceedance`, `failure_times`
    and `events`; None where there are none
    """
    plain: tuple[int, int, int] | None = None
    """(failing, invalid, episodes) of the model's own draws, which know nothing of a proposal; None
    where there were none
    """

    @property
    def failures_seen(self) -> int:
        """The same as ``failing``."""
        return self.failing

    @property
    def evaluations(self) -> int:
        """The same as ``episodes``."""
        return self.episodes

    @property
    def log10_mean(self) -> float:
        """Decimal logarithm of the estimate."""
        return self.log_mean / math.log(10)

    @property
    def guaranteed(self) -> tuple[float, float] | None:
        """Clopper and Pearson's interval of ``plain`` at ``level``: no proposal can make it wrong.
        Its upper end is that of invalid episodes that all fail. None without plain draws.
        """
        if self.plain is None:
            return None
        failing, invalid, n = self.plain
        low, high = clopper_pearson(failing, n, self.level)
        return low, clopper_pearson(failing + invalid, n, self.level)[1] if invalid else high

    def __str__(self) -> str:
        rows = [*self._probability_rows()]
        if self.chernoff is not None:
            bounds = f"{self.chernoff:.4g} (Chernoff)   {self.jeffreys:.4g} (Jeffreys)  "
            given = ", if no invalid episode fails" if self.invalid else ""
            rows.append(("upper bounds", f"{bounds} one-sided {self.level:.4g}{given}"))
        counts = f"{self.failing} of {self.samples} episodes   {self.episodes} evaluations"
        rows.append(("failures", counts))
        if self.chernoff is None and self.failing and not math.isnan(self.max_share):
            k_hat = "" if math.isnan(self.k_hat) else f"   k-hat {self.k_hat:.2f}"
            share = f"greatest share {100 * self.max_share:.2g} %"
            rows.append(("weights", f"ESS {self.ess:.4g}{k_hat}   {share}"))
        if self.modes is not None and len(self.modes) > 1 and self.failing:
            text = "  ".join(f"{100 * v:.1f} %" for v in self.modes[:MAX_LISTED_MODES])
            rows.append(("modes", text + " ..." * (len(self.modes) > MAX_LISTED_MODES)))
        if self.invalid:
            rows.append(("invalid", f"{self.invalid}"))
        if self.unseen is not None and self.unseen > self.interval[1]:
            rows.append(("unseen", f"below {self.unseen:.2g}, by draws of the model"))
        head = [] if self.reliable else ["UNRELIABLE: " + f"\n{'':12}".join(self.warnings)]
        rows = [("method", self.method), *rows]
        if self.reliable:
            rows += [("remark", text) for text in self.warnings]
        return "\n".join([*head, *(f"{name:<14} {text}" for name, text in rows)])

    def _probability_rows(self) -> Iterator[tuple[str, str]]:
        """What is printed of the probability; first what plain draws guarantee."""
        (low, high), guaranteed = self.interval, guaranteed_words(self)
        if guaranteed is not None:
            yield "probability", " ".join(guaranteed)
        if not math.isnan(self.log_mean):
            value = f"{self.mean:.4g}" if self.mean > 1e-300 else f"10^{self.log10_mean:.4f}"
            value += f"   {self.level:.4g} interval [{low:.4g}, {high:.4g}]"
            if guaranteed is None:
                yield "probability", value
            elif is_doubtful(self):
                yield "doubtful", f"{value}, not to be believed"
            percent = f"{100 * self.relative_error:.3g} %"
            yield "relative SE", f"{percent}   log10 {self.log10_mean:.4f}"
        elif guaranteed is None:
            bound = f"below {high:.4g} at {self.level:.4g}" if high < 1 else "nothing is known"
            yield "probability", f"no failure seen: {bound}"


def guaranteed_words(p: Estimate) -> tuple[str, str] | None:
    """In words, the interval that plain draws guarantee, and its level and counts: what to say
    first of ``p``. None where it is reliable, and without plain draws.
    """
    if p.reliable or p.plain is None:
        return None
    (k, invalid, n), (low, high) = p.plain, p.guaranteed
    counts = f"at {p.level:.4g}: {k} of {n} plain draws fail"
    if invalid:
        counts += f", and {invalid} are invalid"
    return f"between {low:.3g} and {high:.3g}", counts


def is_doubtful(p: Estimate) -> bool:
    """Whether ``p`` has a number of its own to say behind its `guaranteed_words`; plain counts have
    none but these.
    """
    return guaranteed_words(p) is not None and p.chernoff is None and not math.isnan(p.log_mean)


def times_too_few(found: Estimate) -> float:
    """How many times as many evaluations bring an `Estimate` of which nothing is wrong but its
    standard error to `MAX_RELATIVE_ERROR`: 1 at least; inf where nothing confirms it, so that this
    is not known, and 1 for every other one.
    """
    first = "".join(found.warnings[:1])
    if first.startswith(UNCONFIRMED):
        return math.inf
    # an interrupted one of plain draws is reliable, with a warning
    imprecise = first.startswith(IMPRECISE) or found.reliable and not first
    return max((found.relative_error / MAX_RELATIVE_ERROR) ** 2, 1.0) if imprecise else 1.0


def flag_imprecise(found: Estimate) -> Estimate:
    """The `Estimate` that is UNRELIABLE where nothing is wrong with it but its standard error."""
    if not (found.reliable and found.relative_error > MAX_RELATIVE_ERROR):
        return found
    enough = found.episodes * (found.relative_error / MAX_RELATIVE_ERROR) ** 2
    if math.isfinite(enough):  # rounded up: not what was spent already
        digit = 10 ** (math.floor(math.log10(enough)) - 1)
        enough = digit * math.ceil(enough / digit)
    text = (
        f"{IMPRECISE} {found.relative_error:.3g}, above {MAX_RELATIVE_ERROR}: the"
        " interval is too wide for an answer, and it takes at least"
        f" {enough:.2g} evaluations to narrow it to that"
    )
    return found._replace(reliable=False, warnings=(text, *found.warnings))


def estimate_from_mean(
    method: str,
    log_mean: float,
    relative: float,
    level: float,
    interval: tuple[float, float],
    *,
    mean: float | None = None,
    **about: Any,
) -> Estimate:
    """The `Estimate` of this mean, NaN where no failure was seen, with its ``relative`` standard
    error; ``mean``: where it is known more exactly than its logarithm; ``about``: its other fields,
    of which those about weights have defaults.
    """
    mean = math.exp(log_mean) if mean is None else mean
    defaults = dict(k_hat=math.nan, max_share=math.nan, modes=None, steps=0)
    return Estimate(
        method=method,
        log_mean=log_mean,
        mean=mean,
        standard_error=mean * relative,
        relative_error=relative,
        interval=interval,
        level=level,
        **defaults | about,
    )


def estimate_from_weights(
    method: str,
    sums: Sums,
    *,
    level: float = 0.95,
    reasons: Sequence[str] = (),
    notes: Sequence[str] = (),
    evaluations: int | None = None,
    groups: Sequence[Sequence[int]] | None = None,
    control: int = 0,
    plain: tuple[int, int, int] = (0, 0, 0),
    min_ess: int | None = diagnostics.MIN_ESS,
    **about: Any,
) -> Estimate:
    """The `Estimate` of `estimate.weight_sums.Sums`; ``reasons`` are more texts for which it is
    UNRELIABLE, ``notes`` are remarks, ``about`` further fields.

    ``evaluations``: episodes in all (default: those of ``sums``). ``groups``: lists of components
    that are one failure mode (default: each by itself). ``control``: episodes that were the model's
    own draws. ``plain``: (failing, invalid, episodes) of such draws beside those of ``sums``.
    ``min_ess``: effective draws, of fewer than which it is UNRELIABLE; None: the weights are not
    judged.
    """
    n = sums.samples
    plain = tuple(a + b for a, b in zip(sums.plain, plain, strict=True))
    found = list(reasons)
    if sums.undefined:
        found.append(f"{sums.undefined} failing episodes have a weight that is NaN or infinite")
    found += invalid_warnings(sums.invalid, sums.invalid_first, sums.first)
    about |= dict(
        unseen=-math.log1p(-level) / control if control else None,
        plain=plain if plain[-1] else None,
    )
    log_mean = relative = math.nan
    interval, ess = (0.0, 1.0), 0.0
    if not sums.first > 0:
        found.append("no failure was seen")
    else:
        m = moments(sums)  # eq. 14 over the square of the mean; n - 1 for an unbiased variance
        relative = float(m.relative) if n > 1 else math.nan
        # a mean of weights exceeds 1 by chance
        above, log_mean = math.exp(min(m.log_mean, 700.0)), min(float(m.log_mean), 0.0)
        interval = log_normal(log_mean, relative, level, float(m.skewness))
        ess = float(sums.first**2 / sums.second)
        k_hat = diagnostics.pareto_k(sums.tail, n, sums.failures)
        share = math.exp(sums.tail[0] - sums.top) / sums.first
        groups = [[i] for i in range(len(sums.by_component))] if groups is None else groups
        modes, sizes = mode_shares(sums, groups)
        if min_ess is not None:
            found += diagnostics.weight_warnings(sums.failures, ess, k_hat, share, min_ess)
            found += diagnostics.mode_warnings(modes, sizes, relative)
        if above > 1 + 4 * above * relative:
            found.append(
                f"the estimate is {above:.4g}, above 1: a density does not fit its samples"
            )
        mode_intervals = _mode_intervals(log_mean, modes, sizes, n, level)
        about |= dict(k_hat=k_hat, max_share=share, modes=modes, mode_intervals=mode_intervals)
    about |= dict(ess=ess) | _fields_of_sums(sums, evaluations, found, notes)
    return estimate_from_mean(method, log_mean, relative, level, interval, **about)


def estimate_from_counts(
    method: str,
    sums: Sums,
    *,
    level: float = 0.95,
    reasons: Sequence[str] = (),
    notes: Sequence[str] = (),
    evaluations: int | None = None,
    **about: Any,
) -> Estimate:
    """The `Estimate` of episodes of the model itself: exact interval and upper bounds. Arguments as
    of `estimate_from_weights`.
    """
    n, k = sums.samples, sums.failures
    mean, found = k / n if k else math.nan, list(reasons)
    if k == 0:
        found.append(f"no failure in {n} episodes: only the upper bounds are known")
    elif k < MIN_COUNTED_FAILURES:
        found.append(f"{k} failures are too few: only the interval is known")
    found += invalid_warnings(sums.invalid, sums.invalid, k)
    interval = clopper_pearson(k, n, level)
    return estimate_from_mean(
        method,
        math.log(mean),
        math.sqrt((1 - mean) / k) if k else math.nan,
        level,
        interval,
        mean=mean,
        ess=float(k),
        max_share=1 / k if k else math.nan,
        modes=np.ones(1) if k else None,
        chernoff=chernoff(k, n, level),
        jeffreys=jeffreys(k, n, level),
        mode_intervals=np.array([interval]) if k else None,
        plain=(k, sums.invalid, n),
        **_fields_of_sums(sums, evaluations, found, notes),
        **about,
    )


def _fields_of_sums(sums, evaluations, reasons, notes):
    """What every `Estimate` of `Sums` holds: their counts, the ``reasons`` against it, remarks."""
    invalid = "episodes are invalid (a number that is not finite) and count as not failing"
    remarks = [f"{sums.invalid} of {sums.samples} {invalid}"] if sums.invalid else []
    return dict(
        failing=sums.failures,
        samples=sums.samples,
        episodes=sums.samples if evaluations is None else evaluations,
        steps=sums.steps,
        invalid=sums.invalid,
        reliable=not reasons,
        warnings=(*reasons, *remarks, *notes),
        draws=sums.draws,
    )


def _mode_intervals(log_mean, modes, sizes, n, level):
    """[K, 2] intervals of parts of the estimate, by their shares and effective sample sizes."""

    def interval(share, size):
        if not size > 0:
            return 0.0, 1.0
        relative = math.sqrt(max(n / size - 1, 0) / max(n - 1, 1))
        return log_normal(log_mean + math.log(share), relative, level)

    return np.array([interval(*mode) for mode in zip(modes, sizes, strict=True)])


def invalid_warnings(invalid: int, weight: float, failing_weight: float) -> list[str]:
    """Texts: where so many ``invalid`` episodes would matter if they were failures, by their
    ``weight`` beside that of those that fail.
    """
    if not weight > MAX_INVALID_SHARE * failing_weight:
        return []
    share = f"{weight / failing_weight:.2g} times the estimate" if failing_weight else "all of it"
    return [
        f"{invalid} episodes are invalid (a number that is not finite): if they failed, they"
        f" would add {share}"
    ]
