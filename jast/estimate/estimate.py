"""The answer of every estimator: a probability, how sure it is, and whether to believe it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from jast import results
from jast.estimate import diagnostics
from jast.estimate.sums import skewness
from jast.intervals import checked_level, chernoff, clopper_pearson, jeffreys, log_normal

__all__ = ["Estimate", "doubtful", "estimate", "guarantee", "of_counts"]

INVALID, COUNTED = 0.01, 10
"""Part of an estimate that invalid episodes may add; failures from which a count is believed."""


@results.result_class("samples")
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
    interval: tuple[Any, ...]
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
    modes: Any
    """[K] the part of the estimate that each component or failure mode carries, of sum 1"""
    reliable: bool
    """No known reason against it"""
    warnings: tuple[Any, ...]
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
    history: Any = None
    """How that was found, a text a line"""
    settings: dict[str, Any] | None = None
    """What was asked for: ``method`` and numbers"""
    mode_intervals: Any = None
    """[K, 2] intervals of the probability of each of ``modes``"""
    draws: Any = None
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
        rows, low, high = [], *self.interval
        if (known := guarantee(self)) is not None:
            rows.append(("probability", " ".join(known)))
        if not math.isnan(self.log_mean):
            value = f"{self.mean:.4g}" if self.mean > 1e-300 else f"10^{self.log10_mean:.4f}"
            value += f"   {self.level:.4g} interval [{low:.4g}, {high:.4g}]"
            if known is None:
                rows.append(("probability", value))
            elif doubtful(self):
                rows.append(("doubtful", f"{value}, not to be believed"))
            rows.append(
                ("relative SE", f"{100 * self.relative_error:.3g} %   log10 {self.log10_mean:.4f}")
            )
        elif known is None:
            known = f"below {high:.4g} at {self.level:.4g}" if high < 1 else "nothing is known"
            rows.append(("probability", f"no failure seen: {known}"))
        if self.chernoff is not None:
            rows.append(
                (
                    "upper bounds",
                    (
                        f"{self.chernoff:.4g} (Chernoff)   {self.jeffreys:.4g} (Jeffreys)  "
                        f" one-sided {self.level:.4g}"
                    ),
                )
            )
        rows.append(
            (
                "failures",
                f"{self.failing} of {self.samples} episodes   {self.episodes} evaluations",
            )
        )
        if self.chernoff is None and self.failing and not math.isnan(self.max_share):
            rows.append(
                (
                    "weights",
                    (
                        f"ESS {self.ess:.4g}{_tail(self.k_hat)}   greatest share"
                        f" {100 * self.max_share:.2g} %"
                    ),
                )
            )
        if self.modes is not None and len(self.modes) > 1 and self.failing:
            rows.append(
                (
                    "modes",
                    "  ".join(f"{100 * v:.1f} %" for v in self.modes[:12])
                    + (" ..." if len(self.modes) > 12 else ""),
                )
            )
        if self.invalid:
            rows.append(("invalid", f"{self.invalid}"))
        if self.unseen is not None and self.unseen > self.interval[1]:
            rows.append(("unseen", f"below {self.unseen:.2g}, by draws of the model"))
        head = [] if self.reliable else ["UNRELIABLE: " + f"\n{'':12}".join(self.warnings)]
        tail = [f"{'remark':<14} {text}" for text in self.warnings] if self.reliable else []
        return "\n".join(
            [
                *head,
                f"{'method':<14} {self.method}",
                *(f"{name:<14} {text}" for name, text in rows),
                *tail,
            ]
        )


def guarantee(p: Estimate) -> tuple[str, str] | None:
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


def doubtful(p: Estimate) -> bool:
    """Whether ``p`` has a number of its own to say behind its `guarantee`; plain counts have none
    but these.
    """
    return guarantee(p) is not None and p.chernoff is None and not math.isnan(p.log_mean)


ROUGH = 0.05
"""Relative standard error above which 10 % more or less lies within a 95 % interval."""


def or_rough(found: Estimate) -> Estimate:
    """The `Estimate` that is UNRELIABLE where nothing is wrong with it but its standard error."""
    if not (found.reliable and found.relative_error > ROUGH):
        return found
    enough = found.episodes * (found.relative_error / ROUGH) ** 2
    text = (
        f"relative standard error {found.relative_error:.2g}, above {ROUGH}: the interval is too"
        f" wide for an answer, and some {enough:.1g} evaluations would narrow it to that"
    )
    return found._replace(reliable=False, warnings=(text, *found.warnings))


def estimate(
    method,
    sums,
    *,
    level=0.95,
    reasons=(),
    notes=(),
    evaluations=None,
    groups=None,
    proposal=None,
    history=None,
    control=0,
    plain=(0, 0, 0),
):
    """The `Estimate` of `jast.estimate.sums.Sums`; ``reasons`` speak against it from outside,
    ``notes`` are remarks.

    ``groups``: lists of components that are one failure mode (default: each by itself).
    ``control``: episodes that were the model's own draws. ``plain``: (failing, invalid, episodes)
    of such draws beside those of ``sums``.
    """
    level = checked_level(method, level)
    n, seen = sums.samples, sums.first > 0
    found = list(reasons)
    if sums.undefined:
        found.append(f"{sums.undefined} failing episodes have a weight that is NaN or infinite")
    found += _if_invalid_failed(sums)
    log_mean = sums.top + math.log(sums.first / n) if seen else math.nan
    above = math.exp(min(log_mean, 700.0)) if log_mean > 0 else 0.0
    log_mean = min(log_mean, 0.0)  # a mean of weights exceeds 1 by chance; min keeps a NaN
    # eq. 14 over the square of the mean; n - 1 for an unbiased variance
    relative = (
        math.sqrt(max(n * sums.second / sums.first**2 - 1, 0) / (n - 1))
        if seen and n > 1
        else math.nan
    )
    ess = sums.first**2 / sums.second if seen else 0.0
    k_hat = diagnostics.pareto_k(sums.tail, n, sums.failures)
    share = math.exp(sums.tail[0] - sums.top) / sums.first if seen else math.nan
    found += (
        diagnostics.reasons(sums.failures, ess, k_hat, share) if seen else ["no failure was seen"]
    )
    modes = mode_intervals = None
    if seen:
        groups = [[i] for i in range(len(sums.by_component))] if groups is None else groups
        modes, sizes = diagnostics.by_mode(sums, groups)
        mode_intervals = _of_modes(log_mean, modes, sizes, n, level)
        found += diagnostics.thin_modes(modes, sizes, relative)
    mean = math.exp(log_mean) if seen else math.nan
    if above > 1 + 4 * above * relative:
        found.append(f"the estimate is {above:.4g}, above 1: a density does not fit its samples")
    plain = tuple(a + b for a, b in zip(sums.plain, plain, strict=True))
    return Estimate(
        method=method,
        log_mean=log_mean,
        mean=mean,
        standard_error=mean * relative,
        relative_error=relative,
        interval=log_normal(log_mean, relative, level, skewness(sums)) if seen else (0.0, 1.0),
        level=level,
        ess=ess,
        k_hat=k_hat,
        max_share=share,
        failing=sums.failures,
        samples=n,
        episodes=n if evaluations is None else evaluations,
        steps=sums.steps,
        invalid=sums.invalid,
        modes=modes,
        reliable=not found,
        warnings=(*found, *_remarks(sums), *notes),
        unseen=-math.log1p(-level) / control if control else None,
        proposal=proposal,
        history=history,
        mode_intervals=mode_intervals,
        draws=sums.draws,
        plain=plain if plain[-1] else None,
    )


def of_counts(
    method, sums, *, level=0.95, reasons=(), notes=(), evaluations=None, proposal=None, history=None
):
    """The `Estimate` of episodes of the model itself: exact interval and upper bounds."""
    level = checked_level(method, level)
    n, k = sums.samples, sums.failures
    mean = k / n if k else math.nan
    found = [
        *reasons,
        *(() if k else (f"no failure in {n} episodes: only the upper bounds are known",)),
        *((f"{k} failures are too few: only the interval is known",) if 0 < k < COUNTED else ()),
    ]
    found += _if_invalid_failed(sums._replace(first=float(k), invalid_first=float(sums.invalid)))
    relative = math.sqrt((1 - mean) / k) if k else math.nan
    return Estimate(
        method=method,
        log_mean=math.log(mean) if k else math.nan,
        mean=mean,
        standard_error=mean * relative,
        relative_error=relative,
        interval=clopper_pearson(k, n, level),
        level=level,
        ess=float(k),
        k_hat=math.nan,
        max_share=1 / k if k else math.nan,
        failing=k,
        samples=n,
        episodes=n if evaluations is None else evaluations,
        steps=sums.steps,
        invalid=sums.invalid,
        modes=np.ones(1) if k else None,
        reliable=not found,
        warnings=(*found, *_remarks(sums), *notes),
        chernoff=chernoff(k, n, level),
        jeffreys=jeffreys(k, n, level),
        proposal=proposal,
        history=history,
        mode_intervals=np.array([clopper_pearson(k, n, level)]) if k else None,
        draws=sums.draws,
        plain=(k, sums.invalid, n) if n else None,
    )


def _of_modes(log_mean, modes, sizes, n, level):
    """[K, 2] intervals of parts of the estimate, by their shares and effective sample sizes."""
    out = []
    for v, size in zip(modes, sizes, strict=True):
        relative = math.sqrt(max(n / size - 1, 0) / max(n - 1, 1)) if size > 0 else math.inf
        out.append(log_normal(log_mean + math.log(v), relative, level) if size > 0 else (0.0, 1.0))
    return np.array(out)


def _tail(k_hat):
    return "" if math.isnan(k_hat) else f"   k-hat {k_hat:.2f}"


def _if_invalid_failed(sums):
    """Texts: where the episodes without a finite number would matter if they were failures."""
    if not sums.invalid_first > INVALID * sums.first:
        return []
    share = (
        f"{sums.invalid_first / sums.first:.2g} times the estimate"
        if sums.first > 0
        else "all of it"
    )
    return [
        f"{sums.invalid} episodes are invalid (a number that is not finite): if they failed, they"
        f" would add {share}"
    ]


def _remarks(sums):
    if not sums.invalid:
        return ()
    return (
        (
            f"{sums.invalid} of {sums.samples} episodes are invalid (a number that is not finite)"
            " and count as not failing"
        ),
    )
