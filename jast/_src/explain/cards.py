"""What is worth saying of every failure mode, for the page of a report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax

from jast._src.core.simulator import Simulator
from jast._src.core.typing import PRNGKey
from jast._src.estimate.tilts.tilts import Tilts
from jast._src.explain.criticality import Criticality, criticality
from jast._src.explain.eigenfailures import Eigenfailures, eigenfailures
from jast._src.explain.minimal import MIN_HOSTED_BUDGET, Minimal, minimal
from jast._src.runtime.host_errors import runs_on_host
from jast._src.search.refine.modes import Mode
from jast._src.stress_testing.report import Report
from jast._src.util import checks

__all__ = ["cards"]

MODES = 4  # that are explained, at most
CONTINUATIONS = 20  # of a state, below which nothing is told


def cards(
    key: PRNGKey, sim: Simulator, modes: Sequence[Mode] | Report, budget: int = 20_000
) -> list[list[Minimal | Criticality | Eigenfailures]]:
    """`minimal` and `criticality` of the likeliest failure of each of the first four ``modes``; of
    those of a report also `eigenfailures`, where its estimate drew enough failures, and a black box
    need not play them again.

    ``report.html(path, explanations=jast.explain.cards(key, sim, report))`` puts them on the page.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        modes: a report of `jast.stress`, or modes as of `jast.search.modes`.
        budget: evaluations in all, nearly; a small one leaves `criticality` out.

    Returns:
        For each mode what was found, in their order.

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
    checks.check_random_key(name, key)
    budget = checks.whole_number(name, "budget", budget, 1)
    p: Any = getattr(modes, "probability", None)
    chosen: Any = getattr(modes, "modes", modes)
    if not isinstance(chosen, Sequence) or not all(isinstance(m, Mode) for m in chosen):
        must = "be a report of jast.stress, or what jast.search.modes returned"
        raise checks.wrong(name, "modes", must, type(modes).__name__)
    chosen = list(chosen)[:MODES]
    # tilts are told by playing their draws again
    again = runs_on_host(sim) and isinstance(getattr(p and p.draws, "source", None), Tilts)
    out: list[list[Minimal | Criticality | Eigenfailures]] = []
    for i, mode in enumerate(chosen):
        each = budget // len(chosen)
        found: list[Minimal | Criticality | Eigenfailures] = [
            minimal(sim, mode.failure, budget=max(each // 2, MIN_HOSTED_BUDGET))
        ]
        draws = min(each // 2 // (int(mode.failure.length) + 1), 1000)
        if draws >= CONTINUATIONS:
            own = jax.random.fold_in(key, i)
            found.append(criticality(own, sim, mode.failure, draws=draws))
        if p is not None and p.draws is not None and not again:
            try:
                found.append(eigenfailures(key, sim, modes, i))
            except ValueError:  # too few failures of this mode
                pass
        out.append(found)
    return out
