"""The `Estimate` that a search by populations ends with, and what speaks against it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from jast._src.estimate.estimate import (
    UNCONFIRMED,
    Estimate,
    estimate_from_counts,
    estimate_from_mean,
    flag_imprecise,
)
from jast._src.estimate.importance_sampling import chunks
from jast._src.estimate.monte_carlo import lanes_of_points, simulate_points
from jast._src.estimate.population.failure_sample import (
    MAX_FAILURES,
    independent_draws,
    sample_from,
)
from jast._src.estimate.population.search import (
    MAX_DISAGREEMENT,
    Answer,
    Kind,
    PopulationSearch,
    contradictions,
    pool_answers,
)
from jast._src.estimate.redraw import sample_of_draws
from jast._src.estimate.weight_sums import empty_sums
from jast._src.estimate.weighted_draws import with_source
from jast._src.runtime.progress_bar import Watch
from jast._src.util.intervals import log_normal

__all__ = ["estimate_from_plain_draws", "estimate_from_populations"]


def estimate_from_populations(
    search: PopulationSearch,
    name: str,
    kinds: Sequence[Kind],
    level: float,
    by_weights: Estimate | None = None,
) -> Estimate:
    """The `Estimate` of all populations of ``kinds``; or that of importance sampling,
    ``by_weights``, which these check.
    """
    plain = tuple(map(int, search.plain))
    sample = sample_from(search.runs[kinds[0]])
    method = f"{name}: populations " + " and ".join(dict.fromkeys(map(str, kinds)))
    if by_weights is None:
        answer, reasons = _agreed_answer(search, kinds)
        found = _estimate_from_answer(search, kinds, level, answer, sample)
    else:
        found, method = by_weights, f"{method}, then importance sampling"
        answer = Answer(found.log_mean, found.relative_error)
        reasons = _check_by_populations(search, kinds, answer)
    interrupted = [search.interrupted] if search.interrupted else []
    reasons = [*search.reasons, *interrupted, *reasons, *contradictions(answer, plain)]
    found = found._replace(
        method=method,
        episodes=search.spent,
        invalid=search.invalid,
        reliable=not reasons,
        warnings=(*reasons, *found.warnings),
        history=tuple(search.history),
        proposal=sample,
        plain=plain,
    )
    return flag_imprecise(found)


def estimate_from_plain_draws(search: PopulationSearch, name: str, level: float) -> Estimate:
    """The `Estimate` of the model's own draws, for which the rest of the budget is spent."""
    failing, invalid, drawn = map(int, search.plain)
    n, total = search.budget - search.spent, empty_sums(drawn)
    lanes = lanes_of_points(search.sim)
    if n > 0 and not search.interrupted:
        watch = Watch(name, n, "episode", False, None)
        shared = search.key, search.sim, lanes, n
        placement = search.placement._replace(name="plain")
        try:
            total, notes, reasons = chunks(simulate_points, shared, lanes, watch, placement)
            search.reasons += reasons
            search.spent += total.samples
            search.interrupted = " ".join(notes)
        except KeyboardInterrupt:
            search.note_interruption()
    search.plain += total.failures, total.invalid, total.samples
    search.history.append(f"plain draws: {search.plain[0]} of {search.plain[2]} fail")
    total = total._replace(
        samples=drawn + total.samples,
        failures=failing + total.failures,
        invalid=invalid + total.invalid,
    )
    found = estimate_from_counts(
        f"{name}: plain draws",
        total,
        level=level,
        reasons=search.reasons,
        notes=(search.interrupted,) if search.interrupted else (),
        evaluations=search.spent,
        history=tuple(search.history),
    )
    draws = with_source(found.draws, search.key, lanes, "model")
    failing = sample_of_draws(search.sim, draws, MAX_FAILURES) if draws.failure.any() else None
    return found._replace(draws=draws, proposal=failing)


def _agreed_answer(search, kinds):
    """The `Answer` of ``kinds`` and why it must not be believed: pooled where two agree, else of
    the first.
    """
    answers = [search.answer(k) for k in kinds]
    if len(answers) == 1:
        return answers[0], [
            f"{UNCONFIRMED} populations {kinds[0]}, are all that tells the probability"
        ]
    apart = answers[0].apart(answers[1])
    said = " and ".join(f"{a} {k}" for k, a in zip(kinds, answers, strict=True))
    search.history.append(f"{said}: {apart:.1f} standard errors apart")
    if apart > MAX_DISAGREEMENT:
        return answers[0], [f"{UNCONFIRMED} the ways do not agree, {said}"]
    return pool_answers(answers), []


def _check_by_populations(search, kinds, exact):
    """Why the `Answer` of importance sampling must not be believed. Its proposal covers failures of
    both ways, so that one that says much less has seldom met what the other did; one that says
    more, or both together where they agree, has met what it does not draw.
    """
    answers = [search.answer(k) for k in kinds]
    said = " and ".join(f"{a} {k}" for k, a in zip(kinds, answers, strict=True))
    apart = " and ".join(f"{a.apart(exact):.1f}" for a in answers)
    search.history.append(f"populations, {said}: {apart} standard errors apart from it")
    near = [a.apart(exact) <= MAX_DISAGREEMENT for a in answers]
    if search.agree(kinds):
        answers.append(pool_answers(answers))
    more = [a for a in answers if a.log_mean > exact.log_mean]
    if any(near) and all(a.apart(exact) <= MAX_DISAGREEMENT for a in more):
        return []
    return [f"importance sampling, {exact}, against populations, {said}"]


def _estimate_from_answer(search, kinds, level, answer, sample):
    """The `Estimate` of an `Answer` of populations, which left this ``sample``."""
    runs = [r for k in kinds for r in search.runs[k]]
    log_mean, relative = min(answer.log_mean, 0.0), answer.relative
    worth = relative**-2 if relative > 0 else math.inf
    return estimate_from_mean(
        "",
        log_mean,
        relative,
        level,
        log_normal(log_mean, relative, level),
        ess=worth,
        failing=sum(len(r.points) for r in runs),
        samples=sum(int(r.size) for r in runs),
        episodes=search.spent,
        invalid=search.invalid,
        reliable=True,
        warnings=(),
        draws=independent_draws(
            search.key, search.sim, sample, log_mean, int(min(worth, MAX_FAILURES))
        ),
    )
