"""What a report says, in words: its text, its page and its picture say the same."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.nominal import describe_undisturbed
from jast._src.estimate.estimate import guaranteed_words, is_doubtful
from jast._src.runtime.host_errors import incidents, runs_on_host

__all__ = [
    "advice",
    "belief",
    "fact_rows",
    "headline",
    "mode_facts",
    "shown_failures",
    "verdict_rows",
    "work_rows",
]

UNRELIABLE_BADGE = "UNRELIABLE: believe plain draws only"
MAX_RESIDUAL = 0.05  # residual below which a failure is called locally likeliest; a convention

SHOWN_INCIDENTS = 3  # kinds of what went wrong in a black box that are shown
DRAWN_MODES = 4  # modes whose failure a picture or a notebook's cell shows: as many as fit


class Belief(NamedTuple):
    """A probability, and whether to believe it."""

    value: str
    more: str = ""
    badge: str = ""
    """In one line: "" where nothing is to be said"""
    mood: str = "unknown"
    """Of the badge: "good", "bad", or "unknown" where an upper bound is all"""
    reasons: tuple[str, ...] = ()
    """Why not to believe it"""
    facts: Sequence[tuple[str, str]] = ()
    """(name, words)"""
    doubt: bool = False
    """Whether ``value`` itself is what must not be believed"""


def headline(r: Any) -> tuple[str, str]:
    """What was found in one or two sentences, and whether that is "good" or "bad"."""
    quiet, n = r.nominal.undisturbed, len(r.modes)
    if quiet is not None and bool(quiet.failure):
        return "The system fails without any disturbance.", "bad"
    if not len(r.failures):
        return f"No failure was found in {r.episodes:,} evaluations.", "good"
    e = r.failures.best
    ways = f"in {n} way{'s' * (n != 1)}" if n else "now and then"
    frequency = _frequency_words(r.probability)
    steps, density = int(e.length), f" and has log p {float(e.reward):.2f}"
    if quiet is not None:
        rare = two_digits(-float(e.reward) / math.log(10))
        density = f", by disturbances that are {rare} times less likely than the likeliest ones"
    words = f"The system fails {ways}{', ' * bool(frequency)}{frequency}."
    return f"{words} The likeliest failure takes {steps} step{'s' * (steps != 1)}{density}.", "bad"


def _frequency_words(p: Any) -> str:
    """In one of how many runs it fails, as far as is known; "" where nothing is."""
    if p is None:
        return ""
    if p.reliable and not np.isnan(p.log_mean):
        return f"in about {share_of_runs(p.log10_mean)}"
    high = p.interval[1] if p.plain is None else p.guaranteed[1]
    surely = np.isnan(p.log_mean) or p.plain is not None  # a doubtful interval is no bound
    return f"in at most {share_of_runs(math.log10(high))}" if surely and 0 < high < 1 else ""


def share_of_runs(log10_p: float) -> str:
    """A probability as a share of the runs."""
    p = 10**log10_p
    return f"{100 * p:.2g} % of the runs" if p > 0.1 else f"one of {two_digits(-log10_p)} runs"


def two_digits(log10: float) -> str:
    """The number of this decimal logarithm, to two digits; a power of ten from 10^9 on."""
    if log10 >= 9:
        return f"10^{log10:.0f}"
    number = float(f"{10**log10:.2g}")
    return f"{number:,.0f}" if number >= 10 else f"{number:g}"


def belief(p: Any) -> Belief:
    """The probability ``p``, an `Estimate` or None, its interval, and whether to believe it."""
    if p is None:
        return Belief("not estimated")
    low, high = p.interval
    unseen = bool(np.isnan(p.log_mean))
    if unseen:
        value = f"below {high:.3g}"
        more = f"no failure in {p.samples:,} draws of the model; at {p.level:.0%}"
    else:
        value = f"{p.mean:.4g}" if p.mean > 1e-300 else f"10^{p.log10_mean:.2f}"
        more = f"{p.level:.0%} interval {low:.4g} to {high:.4g}"
    facts = [("method", p.method), ("evaluations", f"{p.episodes:,}")]
    if not np.isnan(p.relative_error):
        facts.append(("relative standard error", f"{100 * p.relative_error:.3g} %"))
    if p.unseen is not None:
        words = (
            f"below {p.unseen:.3g} at {p.level:.0%}: failures that nothing led to. No method"
            " vouches for what it never met, so this is all that plain draws rule out; more of them"
            " lower it. It is no doubt about the failures that were found"
        )
        facts.append(("unseen", words))
    if p.reliable:
        facts += [("remark", words) for words in p.warnings]
        return Belief(value, more, "reliable: no known reason against it", "good", facts=facts)
    guaranteed = guaranteed_words(p)
    if unseen and (guaranteed is None or not p.plain[0]):
        badge, mood = "an upper bound is all that is known", "unknown"
    else:
        badge = "UNRELIABLE: do not believe it" if guaranteed is None else UNRELIABLE_BADGE
        mood = "bad"
    if is_doubtful(p):
        facts.insert(0, ("doubtful", f"{value}, {more}, not to be believed"))
    value, more = guaranteed or (value, more)
    return Belief(
        value=value,
        more=more,
        badge=badge,
        mood=mood,
        reasons=tuple(p.warnings),
        facts=facts,
        doubt=guaranteed is None and not unseen,
    )


def mode_facts(r: Any, i: int, failure: Any) -> list[tuple[str, Any]]:
    """(name, value) of the likeliest failure of mode ``i``, from 0."""
    facts = [
        ("log p relative to the mode", f"{float(failure.reward):.4f}"),
        ("log p", f"{float(failure.log_prob):.4f}"),
        ("miss distance", f"{float(failure.distance):.5g}"),
        ("steps", int(failure.length)),
    ]
    if i < len(r.modes):
        mode = r.modes[i]
        words = "not known" if np.isnan(mode.share) else mode.share_words
        facts += [("members", mode.members), ("share", words)]
    return facts


def work_rows(r: Any) -> list[tuple[str, int, int, int, float]]:
    """What was tried, each name once: (name, calls, evaluations, failing, best log p relative to
    the mode, -inf without a failure).
    """
    rows = []
    for name, evaluations in r.spent.items():
        calls = [part for part in r.tried if part.name == name]
        failing, best = sum(part.failing for part in calls), max(part.best for part in calls)
        rows.append((name, len(calls), evaluations, failing, best))
    return rows


def verdict_rows(r: Any) -> list[tuple[str, str]]:
    """Rows of a name and a text; a row without a name goes on with the one before."""
    plain = f"{r.nominal.failing} of {r.nominal.episodes} fail"
    undisturbed = describe_undisturbed(r.nominal.undisturbed)
    rows = [("undisturbed", undisturbed), ("plain draws", plain)]
    rows += _probability_rows(r.probability)
    text = "no failure was found"
    if len(r.failures):
        e = r.failures.best
        text = f"log p {float(e.reward):.4f} relative to the mode, {int(e.length)} steps"
        if np.isfinite(r.residual) and r.residual < MAX_RESIDUAL:
            text += f"; locally likeliest, residual {r.residual:.1e}"
        elif np.isfinite(r.late):
            text += f"; its refinement last gained {r.late:.1e}"
    rows.append(("likeliest", text))
    # of a black box: their disturbances are in jast.incidents.incidents
    wrong = () if r.sim is None else incidents(r.sim)
    if r.invalid and not wrong:  # which count runs; here are those answered from memory, too
        rows.append(("invalid", f"{r.invalid} episodes gave numbers that are not finite"))
    rows += [("went wrong", str(incident)) for incident in wrong[:SHOWN_INCIDENTS]]
    if "interrupted" in r.settings:
        rows.append(("interrupted", r.settings["interrupted"]))
    return rows


def fact_rows(r: Any) -> list[tuple[str, str]]:
    """The rows of `verdict_rows` without those of the probability, which pages and pictures show by
    itself, and the number of evaluations.
    """
    of_probability = "", "probability", "doubtful"
    rows = [(name, words) for name, words in verdict_rows(r) if name not in of_probability]
    return [*rows, ("evaluations", f"{r.episodes:,}")]


def shown_failures(r: Any, most: int = DRAWN_MODES) -> list[Any]:
    """The likeliest failure of each of the first ``most`` modes; where there are no modes, the best
    failure, if there is one.
    """
    return [mode.failure for mode in r.modes[:most]] or list(r.failures[:1])


def _probability_rows(p):
    """The rows of the probability ``p``."""
    if p is None:
        return [("probability", "not estimated")]
    guaranteed, unseen, (low, high) = guaranteed_words(p), bool(np.isnan(p.log_mean)), p.interval
    value = f"{p.mean:.4g}   {p.level:.0%} [{low:.4g}, {high:.4g}]"
    if guaranteed is None and unseen:
        bound = f"below {high:.3g} at {p.level:.0%}"
        return [("probability", f"no failure in {p.samples} draws of the model: {bound}")]
    if p.reliable:
        return [("probability", value)]
    rows = [] if unseen else [("probability", f"UNRELIABLE: {p.warnings[0]}")]
    if guaranteed is None:
        return [*rows, ("", f"{p.mean:.4g}, which must not be believed")]
    rows.append(("" if rows else "probability", " ".join(guaranteed)))
    return [*rows, *([("doubtful", f"{value}, not to be believed")] if is_doubtful(p) else [])]


def advice(r: Any) -> str:
    """What a user would do next."""
    if r.nominal.undisturbed is not None and bool(r.nominal.undisturbed.failure):
        return "next: repair the system, which fails without any disturbance"
    if not len(r.failures):
        if not r.invalid:
            return "next: a larger budget; a miss distance that falls on the way to a failure"
        return (
            f"next: mend what makes {r.invalid:,} episodes invalid, which may be the failures: a"
            " number of them is not finite"
        )
    words = ["next: jast.replay(sim, report.failures[0]) for its states"]
    if r.probability is not None and not r.probability.reliable:
        hosted = r.sim is not None and runs_on_host(r.sim)  # some ten thousand runs are too dear
        other = "" if hosted else ", or jast.estimate.subset_simulation,"
        words.append(f"a larger budget{other} for the probability")
    return "; ".join(words)
