"""What a report says, in words: its text, its page and its picture say the same."""

import math
from typing import Any, NamedTuple

import numpy as np

from jast.estimate.estimate import doubtful, guarantee

__all__ = [
    "Belief",
    "about",
    "advice",
    "belief",
    "headline",
    "mode_facts",
    "runs",
    "verdict",
    "work",
]


BELIEVE = "UNRELIABLE: believe plain draws only"


class Belief(NamedTuple):
    """A probability, and whether to believe it."""

    value: str
    more: str
    badge: str
    """In one line: "" where nothing is to be said"""
    mood: str
    """Of the badge: "good", "bad", or "unknown" where an upper bound is all"""
    reasons: tuple
    """Why not to believe it"""
    facts: list
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
    e, ways = r.failures.best, f"in {n} way{'s' * (n != 1)}" if n else "now and then"
    steps, known = int(e.length), f" and has log p {float(e.reward):.2f}"
    if quiet is not None:
        rare = about(-float(e.reward) / math.log(10))
        known = f", by disturbances that are {rare} times less likely than the likeliest ones"
    often = ", ".join(["", *filter(None, [_often(r.probability)])])
    words = f"The system fails {ways}{often}. The likeliest failure takes {steps} step"
    return f"{words}{'s' * (steps != 1)}{known}.", "bad"


def _often(p: Any) -> str:
    """In one of how many runs it fails, as far as is known; "" where nothing is."""
    if p is None:
        return ""
    if p.reliable and not np.isnan(p.log_mean):
        return f"in about {runs(p.log10_mean)}"
    high = p.interval[1] if p.plain is None else p.guaranteed[1]
    surely = np.isnan(p.log_mean) or p.plain is not None  # a doubtful interval is no bound
    return f"in at most {runs(math.log10(high))}" if surely and 0 < high < 1 else ""


def runs(log10_p: float) -> str:
    """A probability as a share of the runs."""
    p = 10**log10_p
    return f"{100 * p:.2g} % of the runs" if p > 0.1 else f"one of {about(-log10_p)} runs"


def about(log10: float) -> str:
    """The number of this decimal logarithm, to two digits; a power of ten from 10^9 on."""
    if log10 >= 9:
        return f"10^{log10:.0f}"
    number = float(f"{10**log10:.2g}")
    return f"{number:,.0f}" if number >= 10 else f"{number:g}"


def belief(p: Any) -> Belief:
    """The probability ``p``, an `Estimate` or None, its interval, and whether to believe it."""
    if p is None:
        return Belief("not estimated", "", "", "unknown", (), [])
    low, high = p.interval
    blank = bool(np.isnan(p.log_mean))
    if blank:
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
        return Belief(value, more, "reliable: no known reason against it", "good", (), facts)
    known = guarantee(p)
    if blank and (known is None or not p.plain[0]):
        badge, mood = "an upper bound is all that is known", "unknown"
    else:
        badge = "UNRELIABLE: do not believe it" if known is None else BELIEVE
        mood = "bad"
    if doubtful(p):
        facts.insert(0, ("doubtful", f"{value}, {more}, not to be believed"))
    value, more = known or (value, more)
    return Belief(value, more, badge, mood, tuple(p.warnings), facts, known is None and not blank)


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


def work(r: Any) -> list[tuple[str, int, int, int, float]]:
    """What was tried, each name once: (name, calls, evaluations, failing, best log p relative to
    the mode, -inf without a failure).
    """
    rows = []
    for name, evaluations in r.spent.items():
        parts = [part for part in r.tried if part.name == name]
        failing, best = sum(part.failing for part in parts), max(part.best for part in parts)
        rows.append((name, len(parts), evaluations, failing, best))
    return rows


def verdict(r: Any) -> list[tuple[str, str]]:
    """Rows of a name and a text; a row without a name goes on with the one before."""
    quiet = r.nominal.undisturbed
    if quiet is None:
        alone = "not defined: a disturbance has neither a mode nor a median"
    else:
        outcome = "FAILS" if bool(quiet.failure) else "no failure"
        alone = f"{outcome}, distance {float(quiet.distance):.4g}, {int(quiet.length)} steps"
    rows = [("undisturbed", alone)]
    rows.append(("plain draws", f"{r.nominal.failing} of {r.nominal.episodes} fail"))
    rows += _probability(r.probability)
    if len(r.failures):
        e = r.failures.best
        text = f"log p {float(e.reward):.4f} relative to the mode, {int(e.length)} steps"
        if np.isfinite(r.residual) and r.residual < 0.05:
            text += f"; locally likeliest, residual {r.residual:.1e}"
        elif np.isfinite(r.late):
            text += f"; its refinement last gained {r.late:.1e}"
        rows.append(("likeliest", text))
    else:
        rows.append(("likeliest", "no failure was found"))
    if r.invalid:
        rows.append(("invalid", f"{r.invalid} episodes gave numbers that are not finite"))
    if "interrupted" in r.settings:
        rows.append(("interrupted", r.settings["interrupted"]))
    return rows


def _probability(p):
    """The rows of the probability ``p``."""
    if p is None:
        return [("probability", "not estimated")]
    known, blank, (low, high) = guarantee(p), bool(np.isnan(p.log_mean)), p.interval
    value = f"{p.mean:.4g}   {p.level:.0%} [{low:.4g}, {high:.4g}]"
    if known is None and blank:
        bound = f"below {high:.3g} at {p.level:.0%}"
        return [("probability", f"no failure in {p.samples} draws of the model: {bound}")]
    if p.reliable:
        return [("probability", value)]
    rows = [] if blank else [("probability", f"UNRELIABLE: {p.warnings[0]}")]
    if known is None:
        return [*rows, ("", f"{p.mean:.4g}, which must not be believed")]
    rows.append(("" if rows else "probability", " ".join(known)))
    return [*rows, *([("doubtful", f"{value}, not to be believed")] if doubtful(p) else [])]


def advice(r: Any) -> str:
    """What a user would do next."""
    if r.nominal.undisturbed is not None and bool(r.nominal.undisturbed.failure):
        return "next: repair the system, which fails without any disturbance"
    if not len(r.failures):
        return "next: a larger budget; a miss distance that falls on the way to a failure"
    words = ["next: jast.replay(sim, report.failures[0]) for its states"]
    if r.probability is not None and not r.probability.reliable:
        words.append("a larger budget, or jast.estimate.subset_simulation, for the probability")
    return "; ".join(words)
