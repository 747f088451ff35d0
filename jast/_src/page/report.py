"""The page of a report of `jast.stress`: for a colleague who has no Python."""

import json
import platform
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.page.document import document, plain, rows, table, text, write
from jast._src.page.episode_data import exact, groups, pictures, short, states_of, trace
from jast._src.stress_testing import report_words
from jast._src.util.checks import check_path, wrong

__all__ = ["write_report"]

# shared by the modes; together they keep a page below 3 MB
NUMBERS = 80_000  # of traces
EXACT = 900_000  # bytes of exact disturbances
PICTURES = 1_000_000  # bytes of pictures
MODES = 16  # cards; further modes are counted

SNIPPET = """\
import jast

# sim = ...  your jast.Simulator
episode = jast.failures.from_json("failure-1.json", sim)  # the button above downloads it
print(episode.failure, episode.length, episode.distance)
"""
OWN = """\
import json
import numpy as np

with open("failure-1.json") as file:  # the button above downloads it
    failure = json.load(file)
x = {a["name"]: np.array(a["values"], a["dtype"]) for a in failure["disturbances"]}
# mine = ...  your simulator, at its start
for t in range(failure["length"]):
    mine.step(**{name or "x": values[t] for name, values in x.items()})
"""


def write_report(
    path: Any,
    report: Any,
    sim: Simulator | None,
    draw: Callable[[Any], str] | None,
    explanations: Sequence[Any],
) -> None:
    """Write the page of ``report`` to the one file ``path``: `jast.stress_testing.Report.html`.

    Args:
        path: of the file.
        report: a `jast.stress_testing.Report`.
        sim: plays the failures again, for their states; without one there are none.
        draw: one state -> an SVG or HTML fragment.
        explanations: of the modes, in their order.
    """
    check_path("Report.html", path)
    if draw is not None and not callable(draw):
        raise ValueError(f"Report.html: draw must be a function of a state, received {draw!r:.80}")
    if isinstance(explanations, str) or not isinstance(explanations, Sequence):
        must = "be a sequence, of one for each mode"
        raise wrong("Report.html", "explanations", must, type(explanations).__name__)
    if draw is not None and sim is None:
        raise ValueError(
            "Report.html: draw needs the simulator, which a report from a file does not hold:"
            " expected html(path, sim, draw=draw)"
        )
    failures = report_words.shown_failures(report, MODES)
    if len(explanations) > len(failures):
        must = f"be at most {len(failures)}, one for each mode shown"
        raise wrong("Report.html", "explanations", must, len(explanations))
    told = [_as_list(one) for one in explanations]
    told += [[]] * (len(failures) - len(told))
    data = {"modes": _data(report, failures, told, sim, draw)}
    body = [
        _head(report, data["modes"]),
        _modes(report, failures, data["modes"], told, sim),
        _work(report),
        _settings(report),
    ]
    write(path, document(_title(report), "\n".join(body), data, "report.js"))


def _as_list(explanation: Any) -> list:
    """One or many; a result of `jast.explain` is a tuple of its own kind, and one."""
    several = explanation if type(explanation) in (list, tuple) else [explanation]
    return [one for one in several if one is not None]


def _data_of_explanations(explanations: list, steps: list[int]) -> dict:
    """What the traces show of explanations: the probability of failing from each step (`risk`), the
    steps at which each disturbance is needed, and the directions of failures (`directions`).
    """
    from jast._src.page.directions import directions
    from jast.explain import Criticality, Eigenfailures, Minimal

    found = {}
    for one in explanations:
        if isinstance(one, Criticality) and len(one.probability) == steps[-1] + 1:
            found["risk"] = short(one.probability[steps])
            found["interval"] = [short(end) for end in one.interval[steps].T]
        if isinstance(one, Eigenfailures):
            found["directions"] = directions(one)
        if isinstance(one, Minimal):
            every = list(range(1, steps[-1] + 1))
            found["needed"] = {
                group["name"]: [t for t in every if any(c[t - 1] == 1 for c in group["columns"])]
                for group in groups(one.needed, every, "x", late=1)
            }
    return found


def _data(
    report: Any, failures: list[Episode], explanations: list[list], sim: Any, draw: Any
) -> list[dict]:
    quiet, n, left, found = report.nominal.undisturbed, max(len(failures), 1), EXACT, []
    for number, episode in enumerate(failures, 1):
        card = trace(sim, episode, quiet, NUMBERS // n)
        card["name"] = f"failure-{number}"
        card |= _data_of_explanations(explanations[number - 1], card["steps"])
        values = json.dumps(plain(exact(episode)))
        size = len(values) + values.count('"')
        card["exact"] = values if size <= left else None
        left -= size if size <= left else 0
        if draw is not None:
            states = states_of(sim, episode)
            card["pictures"] = pictures("Report.html", draw, states, card["steps"], PICTURES // n)
        found.append(card)
    return found


def _title(report: Any) -> str:
    words = "can fail" if len(report.failures) else "no failure was found"
    if report.nominal.undisturbed is not None and bool(report.nominal.undisturbed.failure):
        words = "fails undisturbed"
    return f"jast: {words}"


def _head(report: Any, modes: list[dict]) -> str:
    """The verdict on one screen."""
    words, mood = report_words.headline(report)
    return (
        f'<header><p class="kind">jast: adaptive stress test</p><h1 class="{mood}">{text(words)}'
        f"</h1>{_how(modes[0]) if modes else ''}</header>\n<main>\n<section id=verdict>"
        f"{_probability(report.probability)}"
        f"{rows(report_words.fact_rows(report))}"
        f"<p class=advice>{text(report_words.advice(report))}</p></section>"
    )


def _how(mode: dict) -> str:
    """How a failure ends: the three numbers of the state that are then farthest from what they are
    undisturbed, as a share of where they have been.
    """
    found = []
    for group, calm in zip(mode.get("states", ()), mode.get("quiet", ())):
        for place, column, other in zip(group["entries"], group["columns"], calm):
            (end, quiet), seen = (column[-1], other[-1]), np.array([*column, *other])
            share = abs(end - quiet) / max(np.ptp(seen), 1e-300)
            if np.isfinite(seen).all() and share > 0.1:
                words = f"{group['name']}{place} is {end:.4g} (undisturbed {quiet:.4g})"
                found.append((share, words))
    found.sort(key=lambda one: -one[0])
    words = ", ".join(words for _, words in found[:3])
    return f"<p class=how>When it fails so, {text(words)}.</p>" if words else ""


def _probability(p: Any) -> str:
    """The probability, its interval, and whether to believe it."""
    b = report_words.belief(p)
    if p is None:
        return f"<div id=probability><h2>Probability of failure</h2><p>{b.value}</p></div>"
    reasons = "".join(f"<li>{text(words)}</li>" for words in b.reasons)
    if b.mood == "good":
        badge = f"<p class='badge good'>{b.badge}</p>"
    else:
        look = "'badge bad'" if b.mood == "bad" else "badge"
        badge = f"<div class={look}>{b.badge}<ul>{reasons}</ul></div>"
    return (
        "<div id=probability><h2>Probability of failure</h2>"
        f"<p class='value{' doubt' * b.doubt}'>{text(b.value)}</p>"
        f"<p>{text(b.more)}</p>{badge}{rows(b.facts)}</div>"
    )


def _modes(
    report: Any, failures: list[Episode], data: list[dict], explanations: list[list], sim: Any
) -> str:
    if not failures:
        return "<section id=modes><h2>Failure modes</h2><p>none</p></section>"
    cards = []
    for i, episode in enumerate(failures):
        facts = report_words.mode_facts(report, i, episode)
        cards.append(_card(i + 1, facts, data[i], explanations[i]))
    more = len(report.modes) - len(failures)
    notes = [f"{more} more modes are not shown."] * (more > 0)
    if sim is None:
        notes.append("Without its simulator a report has no states: the disturbances are shown.")
    words = "".join(f"<p class=note>{text(note)}</p>" for note in notes)
    return f"<section id=modes><h2>Failure modes</h2>{words}{''.join(cards)}</section>"


def _card(number: int, facts: list, data: dict, explanations: list) -> str:
    """One mode; the script fills the elements that have a class and no words."""
    words = "".join(f"<pre>{text(one)}</pre>" for one in explanations)
    held = "<p>Too many for this page: they are in the saved report.</p>"
    if data["exact"] is not None:
        held = (
            "<p><button class=copy>Copy JSON</button> <button class=download>Download"
            f" failure-{number}.json</button></p><pre class=json></pre>"
        )
    return (
        f'<article class=card id="mode-{number}" data-mode="{number - 1}">'
        f"<h3>Mode {number}</h3>{rows(facts, 'facts wide')}"
        f"<div class=player><label>step <output class=step></output> <input type=range min=0"
        f' max="{len(data["steps"]) - 1}" value="{len(data["steps"]) - 1}" class=slider'
        f' aria-label="step of mode {number}"></label> <button class=play>Play</button></div>'
        "<div class=stage><div class=picture hidden></div><div class=numbers></div></div>"
        "<div class=traces></div>"
        f'<div class="explanation"{"" if words else " hidden"}><h4>Explanation</h4>{words}</div>'
        f"<details><summary>Exact disturbances</summary>{held}</details></article>"
    )


def _work(report: Any) -> str:
    tried = report_words.work_rows(report)
    lines = [(*row, "" if best == -np.inf else best) for *row, best in tried]
    head = ("tried", "calls", "evaluations", "failing", "best log p relative to the mode")
    return f"<section id=tried><h2>What was tried</h2>{table(head, lines)}</section>"


def _code(name: str, words: str) -> str:
    return (
        f"<div class=code><p>{text(name)} <button class=copy>Copy</button></p>"
        f"<pre>{text(words)}</pre></div>"
    )


def _settings(report: Any) -> str:
    from jast import __version__

    versions = [
        ("jast", __version__),
        ("jax", jax.__version__),
        ("numpy", np.__version__),
        ("python", platform.python_version()),
        ("page written with", "float64" if jax.config.jax_enable_x64 else "float32"),
    ]
    asked = [
        (k, v if isinstance(v, str) else json.dumps(v, default=str))
        for k, v in report.settings.items()
    ]
    return (
        "<section id=replay><h2>Replay failure 1</h2>"
        f"{_code('With jast', SNIPPET)}{_code('In a simulator of your own', OWN)}</section>"
        f"<section id=settings><h2>Settings and versions</h2>{rows([*asked, *versions])}"
        f"<details><summary>The report as text</summary><pre>{text(report)}</pre></details>"
        "</section>\n</main>"
    )
