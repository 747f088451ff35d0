"""The `Estimate` that a search by populations ends with, and what speaks against it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jast.estimate.agreement import APART, Answer, Kind, against, pooled
from jast.estimate.draws import drawn_by
from jast.estimate.estimate import Estimate, of_counts, or_rough
from jast.estimate.importance_sampling import chunks
from jast.estimate.plain import lanes_of_points, of_points
from jast.estimate.population_search import Search
from jast.estimate.sample import KEPT, independent, sample_of
from jast.estimate.sums import nothing
from jast.intervals import log_normal
from jast.watch import Watch

__all__ = ["of_plain_draws", "of_populations"]


def of_populations(
    s: Search, name: str, kinds: Sequence[Kind], level: float, weighted: Estimate | None = None
) -> Estimate:
    """The `Estimate` of all populations of ``kinds``; or that of importance sampling, ``weighted``,
    which these check.
    """
    reasons = [*s.reasons, *([s.interrupted] if s.interrupted else [])]
    exact, reason = _agreed(s, kinds)
    if weighted is not None:
        populations, exact = exact, Answer(weighted.log_mean, weighted.relative_error)
        if exact.apart(populations) > APART:
            reasons.append(f"importance sampling, {exact}, against populations, {populations}")
    reasons += [*reason, *against(exact, tuple(map(int, s.plain)))]
    sample = sample_of(s.runs[kinds[0]])
    found = _of_answer(s, kinds, level, exact, sample) if weighted is None else weighted
    method = f"{name}: populations " + " and ".join(dict.fromkeys(map(str, kinds)))
    found = found._replace(
        method=method + (", then importance sampling" if weighted is not None else ""),
        episodes=s.spent,
        invalid=s.invalid,
        reliable=not reasons,
        warnings=(*reasons, *found.warnings),
        history=tuple(s.history),
        proposal=sample,
        plain=tuple(map(int, s.plain)),
    )
    return or_rough(found)


def of_plain_draws(s: Search, name: str, level: float) -> Estimate:
    """The `Estimate` of the model's own draws, for which the rest of the budget is spent."""
    failing, invalid, drawn = map(int, s.plain)
    n, lanes, total = s.budget - s.spent, lanes_of_points(s.sim), nothing(drawn)
    if n > 0 and not s.interrupted:
        watch, ways = Watch(name, n, "episode", False, None), s.ways._replace(name="plain")
        try:
            total, notes, lost = chunks(of_points, (s.key, s.sim, lanes, n), lanes, watch, ways)
            s.reasons += lost
            s.spent, s.interrupted = s.spent + total.samples, " ".join(notes)
        except KeyboardInterrupt:
            s.interrupt()
    s.plain += total.failures, total.invalid, total.samples
    s.history.append(f"plain draws: {s.plain[0]} of {s.plain[2]} fail")
    total = total._replace(
        samples=drawn + total.samples,
        failures=failing + total.failures,
        invalid=invalid + total.invalid,
    )
    found = of_counts(
        f"{name}: plain draws",
        total,
        level=level,
        reasons=s.reasons,
        notes=(s.interrupted,) if s.interrupted else (),
        evaluations=s.spent,
        history=tuple(s.history),
    )
    return found._replace(draws=drawn_by(found.draws, s.key, lanes, "model"))


def _agreed(s, kinds):
    """The `Answer` of ``kinds`` and why it must not be believed: pooled where two agree, else of
    the first.
    """
    answers = [s.answer(k) for k in kinds]
    if len(answers) == 1:
        return answers[0], [
            f"populations {kinds[0]}, are all that tells the probability, and none checks them"
        ]
    apart = answers[0].apart(answers[1])
    said = " and ".join(f"{a} {k}" for k, a in zip(kinds, answers, strict=True))
    s.history.append(f"{said}: {apart:.1f} standard errors apart")
    if apart > APART:
        return answers[0], [f"the ways do not agree: {said}"]
    return pooled(answers), []


def _of_answer(s, kinds, level, exact, sample):
    """The `Estimate` of an `Answer` of populations, which left this ``sample``."""
    runs = [r for k in kinds for r in s.runs[k]]
    log_mean = min(exact.log_mean, 0.0)
    mean, worth = math.exp(log_mean), exact.relative**-2 if exact.relative > 0 else math.inf
    return Estimate(
        method="",
        log_mean=log_mean,
        mean=mean,
        standard_error=mean * exact.relative,
        relative_error=exact.relative,
        interval=log_normal(log_mean, exact.relative, level),
        level=level,
        ess=worth,
        k_hat=math.nan,
        max_share=math.nan,
        failing=sum(len(r.points) for r in runs),
        samples=sum(int(r.size) for r in runs),
        episodes=s.spent,
        steps=0,
        invalid=s.invalid,
        modes=None,
        reliable=True,
        warnings=(),
        draws=independent(s.key, s.sim, sample, log_mean, int(min(worth, KEPT))),
    )
