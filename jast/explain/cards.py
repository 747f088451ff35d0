"""What is worth saying of every failure mode, for the page of a report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax

from jast import _checks
from jast.explain.criticality import Criticality, criticality
from jast.explain.minimal import Minimal, minimal
from jast.search.failure_modes import Mode
from jast.simulator import Simulator

if TYPE_CHECKING:
    import chex

__all__ = ["cards"]

MODES, LEAST = 4, 20
"""Modes that are explained at most; continuations of a state below which nothing is told."""


def cards(
    key: chex.PRNGKey, sim: Simulator, modes: Sequence[Mode], budget: int = 20_000
) -> list[list[Minimal | Criticality]]:
    """`minimal` and `criticality` of the likeliest failure of each of the first four ``modes``.

    ``report.html(path, explanations=jast.explain.cards(key, sim, report.modes))`` puts them on the
    page.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        modes: as of `jast.stress` or `jast.search.modes`.
        budget: evaluations in all, nearly; a small one leaves `criticality` out.

    Returns:
        For each mode what was found, in the order of ``modes``.

    Raises:
        ValueError: as `minimal`.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.walk1d()
        >>> found = jast.search.gradient(key, sim, starts=4, refine=0)
        >>> ways = jast.search.modes(sim, found.failures)
        >>> len(jast.explain.cards(key, sim, ways, budget=2000)) == len(ways)
        True
    """
    name = "cards"
    _checks.random_key(name, key)
    budget = _checks.whole(name, "budget", budget, 1)
    chosen: list[Any] = list(modes)[:MODES]
    out: list[list[Minimal | Criticality]] = []
    for i, mode in enumerate(chosen):
        each = budget // len(chosen)
        found: list[Minimal | Criticality] = [minimal(sim, mode.failure, budget=each // 2)]
        draws = min(each // 2 // (int(mode.failure.length) + 1), 1000)
        if draws >= LEAST:
            own = jax.random.fold_in(key, i)
            found.append(criticality(own, sim, mode.failure, draws=draws))
        out.append(found)
    return out
