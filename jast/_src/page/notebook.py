"""A report of `jast.stress` as the output of a notebook's cell."""

from base64 import b64encode
from typing import Any

from jast._src.page.document import text
from jast._src.stress_testing import report_words
from jast._src.util.display import html_table

__all__ = ["cell"]


def cell(report: Any) -> str:
    """HTML without styles or scripts of its own: what was found, the probability with its interval
    and whether to believe it, and the first four modes, each with a picture where matplotlib is.
    """
    told = report_words.belief(report.probability)
    reasons = "".join(f"<li>{text(reason)}</li>" for reason in told.reasons)
    facts = dict(report_words.fact_rows(report))
    parts = [
        f"<h3>{text(report_words.headline(report)[0])}</h3>",
        f"<p>Probability of failure: <b>{text(told.value)}</b> {text(told.more)}<br>",
        f"{text(told.badge)}</p><ul>{reasons}</ul>{html_table('', facts)}",
    ]
    shown = report_words.shown_failures(report)
    for i, (failure, picture) in enumerate(zip(shown, _pictures(report, len(shown)), strict=True)):
        of_mode = report_words.mode_facts(report, i, failure)
        words = " &middot; ".join(text(f"{name} {value}") for name, value in of_mode)
        parts.append(f"<p><b>Mode {i + 1}</b> {words}</p>{picture}")
    return "".join([*parts, f"<p>{text(report_words.advice(report))}</p>"])


def _pictures(report: Any, n: int) -> list[str]:
    """An image of each of the ``n`` failures that are shown."""
    try:
        from jast._src.plot.report import pictures

        files = pictures(report)
    except ImportError:  # matplotlib, which is an extra
        return [""] * n
    return [f'<img src="data:image/png;base64,{b64encode(f).decode()}">' for f in files]
