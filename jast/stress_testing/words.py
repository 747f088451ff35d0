"""What a report says, in words: its text, its page and its picture say the same."""

from typing import Any, NamedTuple

import numpy as np

__all__ = ["Belief", "advice", "belief", "headline", "mode_facts", "verdict", "work"]


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


def headline(r: Any) -> tuple[str, str]:
    """What was found in one or two sentences, and whether that is "good" or "bad"."""
    quiet, n = r.nominal.undisturbed, len(r.modes)
    if quiet is not None and bool(quiet.failure):
        return "The system fails without any disturbance.", "bad"
    if not len(r.failures):
        return f"No failure was found in {r.episodes:,} evaluations.", "good"
    e, ways = r.failures.best, f"{n} way{'s' * (n != 1)} to fail" if n else "A failure"
    steps = int(e.length)
    words = (
        f"{ways} found. The likeliest takes {steps} step{'s' * (steps != 1)} and has log p"
        f" {float(e.reward):.2f} relative to the mode of the disturbances."
    )
    return words, "bad"


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
        words = f"failures that nothing led to: below {p.unseen:.3g} at {p.level:.0%}"
        facts.append(("unseen", words))
    if p.reliable:
        facts += [("remark", words) for words in p.warnings]
        return Belief(value, more, "reliable: no known reason against it", "good", (), facts)
    if blank:
        badge, mood = "an upper bound is all that is known", "unknown"
    else:
        badge, mood = "UNRELIABLE: do not believe it", "bad"
    return Belief(value, more, badge, mood, tuple(p.warnings), facts)


def mode_facts(r: Any, i: int, failure: Any) -> list[tuple[str, Any]]:
    """(name, value) of the likeliest failure of mode ``i``, from 0."""
    facts = [
        ("log p relative to the mode", f"{float(failure.reward):.4f}"),
        ("log p", f"{float(failure.log_prob):.4f}"),
        ("miss distance", f"{float(failure.distance):.5g}"),
        ("steps", int(failure.length)),
    ]
    if i < len(r.modes):
        share = r.modes[i].share
        words = "not known" if np.isnan(share) else f"{100 * share:.1f} %"
        facts += [("members", r.modes[i].members), ("share", words)]
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
    p = r.probability
    if p is None:
        rows.append(("probability", "not estimated"))
    elif np.isnan(p.log_mean):
        bound = f"below {p.interval[1]:.3g} at {p.level:.0%}"
        rows.append(("probability", f"no failure in {p.samples} draws of the model: {bound}"))
    elif not p.reliable:
        rows.append(("probability", f"UNRELIABLE: {p.warnings[0]}"))
        rows.append(("", f"{p.mean:.4g}, which must not be believed"))
    else:
        low, high = p.interval
        rows.append(("probability", f"{p.mean:.4g}   {p.level:.0%} [{low:.4g}, {high:.4g}]"))
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
