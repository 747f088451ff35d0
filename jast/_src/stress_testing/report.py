"""What `jast.stress` says: one screen, or a page to hand on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.failures import Failures
from jast._src.core.nominal import Nominal
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PathLike
from jast._src.estimate.estimate import Estimate
from jast._src.search.refine.modes import Modes
from jast._src.stress_testing.report_words import advice, verdict_rows, work_rows
from jast._src.util import display

__all__ = ["Report", "Tried"]


@display.printable()
class Tried(NamedTuple):
    """One piece of the work.

    Example:
        >>> from jast.stress_testing import Tried
        >>> tried = [Tried("nominal", 10000, 1, -24.3), Tried("gradients", 9720, 63, -10.8)]
        >>> max(tried, key=lambda part: part.best).name
        'gradients'
    """

    name: str
    evaluations: int
    failing: int
    """Failures that it brought in."""
    best: float
    """log p relative to the mode of the likeliest of them; -inf without one."""


@display.result_class("episodes")
class Report(NamedTuple):
    """The outcome of `jast.stress`.

    Example:
        >>> import jax, jast
        >>> report = jast.stress(jax.random.key(0), jast.simulators.walk1d(), 2000)
        >>> report.episodes == sum(report.spent.values()), len(report.modes) > 0
        (True, True)
    """

    nominal: Nominal
    """The system as it is: undisturbed, and under plain draws."""
    failures: Failures
    """By falling log p relative to the mode, which is their reward; all replay."""
    modes: Modes
    """The ways to fail, the likeliest first."""
    probability: Estimate | None
    """None where the work was interrupted before."""
    residual: float
    """Of the likeliest failure, how far it is from a local optimum: the slope of log p along the
    boundary of failure as a share of its whole slope; NaN where the distance has no gradient."""
    late: float
    """log p that the likeliest failure gained in the last tenth of its refinement."""
    tried: tuple[Tried, ...]
    """`Tried`: what was done, in order."""
    episodes: int
    """Evaluations in all; one with its gradient counts for more."""
    invalid: int
    settings: dict[str, Any]
    sim: Simulator | None = None
    """The simulator, which plays failures again; None in a report from a file, as a file holds no
    functions."""

    @property
    def spent(self) -> dict[str, int]:
        """Evaluations by the name of what they were spent on."""
        spent = {}
        for part in self.tried:
            spent[part.name] = spent.get(part.name, 0) + part.evaluations
        return spent

    def __str__(self) -> str:
        lines = [*(f"{name:<13}{text}" for name, text in verdict_rows(self)), ""]
        if self.modes:
            lines += [str(self.modes), ""]
        lines += [*_work_lines(self), "", advice(self)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from jast._src.page.notebook import cell

        return cell(self)

    def html(
        self,
        path: PathLike,
        sim: Simulator | None = None,
        *,
        draw: Callable[..., str] | None = None,
        explanations: Sequence[Any] = (),
    ) -> None:
        """Write the report as one HTML file that needs no network and no Python, below 3 MB.

        It has the verdict, the probability and whether to believe it, a card for each of the first
        16 modes with its trace and a slider through its steps, what was tried, settings and
        versions, and the exact disturbances to copy. All words are escaped.

        Args:
            path: of the file; an existing one is replaced only once the new one is complete.
            sim: plays the failures again, for their states; default: the report's own. Without
                one (a report from `jast.load`) the page shows disturbances alone.
            draw: one state -> an SVG or HTML fragment, which the page shows as it is, at the step
                of the slider. Its state is a pytree of NumPy arrays. Where it has an argument
                ``past``, that is the states before, [t, ...]: for the trail of what moves.
            explanations: for the card of each mode, in their order: a result of `jast.explain`,
                anything else whose ``str`` says something of it, a list of such things, or None.
                `jast.explain.criticality` and the directions of `jast.explain.eigenfailures` are
                drawn, too, and what `jast.explain.minimal` needs is marked.

        Raises:
            ValueError: for ``draw`` without a simulator, a ``draw`` that returns no text or too
                long a one, and more explanations than cards.
        """
        from jast._src.page.report import write_report

        sim = self.sim if sim is None else sim
        write_report(path, self, sim, draw, explanations)


def _work_lines(r):
    """What was tried, each name once."""
    lines = [
        f"{'tried':<22} {'calls':>5} {'evaluations':>12} {'failing':>9} {'best log p rel.':>16}"
    ]
    for name, calls, evaluations, failing, best in work_rows(r):
        text = "-" if best == -np.inf else f"{best:.4f}"
        lines.append(f"{name:<22} {calls:5d} {evaluations:12d} {failing:9d} {text:>16}")
    lines.append(f"{'in all':<28} {r.episodes:12d}")
    return lines
