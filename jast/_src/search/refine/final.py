"""The end of a search: its failures, pulled to where they are likeliest (`jast.search.refine`)."""

import contextvars
from functools import partial
from typing import Any

import jax
import numpy as np

from jast._src.core.episode import replay
from jast._src.core.failures import collect, identity, merge
from jast._src.core.rewards import Lexicographic, likelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.runtime.host_errors import runs_on_host
from jast._src.runtime.jax_settings import run_in_thread
from jast._src.search.refine.refine import refine
from jast._src.search.result import SearchResult
from jast._src.util import checks
from jast._src.util.pytrees import index_tree

__all__ = ["REFINED", "SHARE", "default_share", "refine_failures", "with_refine_share"]

SHARE = 0.1  # evaluations of the refinement by default, as a share of the episodes; a convention
MIN_BUDGET = 100  # evaluations below which there is no refinement: `refine` takes no fewer
MAX_HOSTED = 16  # failures of a system on the host that are refined: each has to run once more
ADDRESS = 0x656E6421  # folded into the search's key, far from the numbers of trees
REFINED = -2  # the tree that refined failures are said to be of


def default_share(sim: Simulator, reward: Any) -> float:
    """The share of a search that maximises ``reward``: `SHARE` where that ranks failures as
    `jast.search.refine` does, a `Lexicographic` one (unless its log p is raw though there are
    modes), else 0.
    """
    same = isinstance(reward, Lexicographic) and reward.density == signature_of(sim).density
    return SHARE if same else 0.0


def with_refine_share(
    function: str,
    refine: float | None,
    sim: Simulator,
    settings: dict | None,
    share: float,
) -> dict | None:
    """The ``settings`` of a search with ``refine``, the share that its refinement has.

    Args:
        function: the search's name, for messages.
        refine: what was asked for. None: ``share``, or 0 where disturbances have no quantile
            function.
        sim: the simulator.
        settings: None where the search is traced.
        share: that of the search by itself.

    Raises:
        ValueError: for a share that is negative or not finite, and for one above 0 in a traced
            search or of disturbances without a quantile function.
    """
    signature = signature_of(sim)
    lacking = signature.start.lacking or signature.disturbance.lacking
    if refine is None:
        share = 0.0 if lacking else share
    else:
        expected = "of at least 0, a share of the episodes"
        share = checks.number(function, "refine", refine, lambda v: 0 <= v < np.inf, expected)
        if share and settings is None:
            must = "be 0 inside of jax.jit and jax.vmap"
            raise checks.wrong(function, "refine", must, f"{refine!r}")
        if share and lacking:
            must = f"be 0, since {lacking} has no quantile function"
            raise checks.wrong(function, "refine", must, f"{refine!r}")
    return None if settings is None else settings | dict(refine=share)


def refine_failures(
    key: jax.Array, sim: Simulator, reward: Any, found: SearchResult, top: int
) -> SearchResult:
    """``found`` with its failures refined, by the share in its settings (`with_refine_share`), and
    with what came of that among them; as it is where there is nothing to refine, where that would
    be fewer than 100 evaluations, and where the search is traced or was interrupted.
    """
    settings = found.settings
    if settings is None or "interrupted" in settings or not len(found.failures):
        return found
    budget = int(settings.get("refine", 0) * found.episodes)
    if budget < MIN_BUDGET:
        return found
    work = partial(_refined, jax.random.fold_in(key, ADDRESS), sim, reward, found, top, budget)
    try:
        # in the context of this thread: a checkpoint keeps what the refinement asks
        return run_in_thread(contextvars.copy_context().run, work) if runs_on_host(sim) else work()
    except KeyboardInterrupt:
        note = f"while refining, after all {found.episodes} episodes"
        return found._replace(settings=settings | dict(interrupted=note))


def _refined(
    key: jax.Array, sim: Simulator, reward: Any, found: SearchResult, top: int, budget: int
) -> SearchResult:
    archive = found.failures
    first = archive[:MAX_HOSTED] if runs_on_host(sim) else archive
    given = collect(sim, likelihood(sim), first.episodes, top=len(first))
    # none where all are on a knife edge, or the density at the mode is infinite
    given = given[: int(np.isfinite(given.episodes.reward).sum())]
    if not len(given):
        return found
    refined = refine(key, sim, given, budget=budget)
    before = dict(given=len(given), likeliest=float(given.best.reward))
    refined = refined._replace(
        settings=refined.settings | before | dict(density=signature_of(sim).density)
    )
    known = {identity(e) for e in archive}
    rows = [i for i, e in enumerate(refined.failures) if identity(e) not in known]
    best = found.best
    if rows:
        new = index_tree(refined.failures.episodes, np.array(rows))
        where = np.full(len(rows), REFINED), np.array(rows)
        archive = merge(archive, collect(sim, reward, new, *where, seen=0, top=top), top=top)
        if not best.failure or archive.best.reward > best.reward:
            best = jax.device_get(replay(sim, archive.best, reward=reward))
    return found._replace(best=best, failures=archive, refined=refined)
