"""How much memory a search may take, so that one that does not fit says so before it starts."""

import os
import warnings
from typing import Any

from jast._src.core.signature import signature_of
from jast._src.runtime.device import on_cpu
from jast._src.runtime.memory import available, readable, require
from jast._src.search.tree.layout import Problem, most_lanes, pages_of
from jast._src.search.tree.run import Plan, bytes_per_tree

__all__ = ["LANES", "fit", "require_rewards"]

# in one thread: enough to fill vector units, few enough to stay near the processor
LANES = 128


def fit(
    method: str,
    problem: Problem,
    plan: Plan,
    trees: int,
    threads: int | None,
    lanes: int | None,
    free: int | None,
    auto: bool,
) -> tuple[Plan, int, int]:
    """A plan that fits into memory.

    Args:
        method: the search, for messages.
        problem: what the trees are about.
        plan: with a memoization, which ``auto`` may change.
        trees: that are to grow at once.
        threads: that they grow in, or None for as many as there are processors.
        lanes: trees side by side in a thread, or None for what is fast.
        free: bytes that the trees in flight may take, or None for those that are free now.
        auto: whether states may be kept at roots only, where those of all nodes do not fit.

    Returns:
        The plan with its memoization settled, threads, and lanes.

    Raises:
        ValueError: if it does not fit, with the numbers.
    """
    host = on_cpu()
    if threads is None:
        threads = max(1, min(_cores(), trees // 8)) if host else 1
    given, free = lanes, available() if free is None else free
    if lanes is None:
        rounds = -(-trees // (threads * LANES))
        lanes = -(-trees // (threads * rounds)) if host else trees
    lanes = min(lanes, trees, most_lanes(pages_of(problem, plan.prunes * plan.simulations)))
    threads = min(threads, -(-trees // lanes))
    either = auto and not (plan.edges or plan.branches)
    for memoize in ["node", "root"] if either else [plan.memoize]:
        plan = plan._replace(memoize=memoize)
        one = bytes_per_tree(problem, plan)
        within = lanes if free is None else int(0.8 * free // (one * threads))
        if within >= (lanes if given else min(lanes, 8)):
            break
    if within < 1 or (given and within < lanes):
        asked = f"{lanes} trees in each of {threads} threads take {readable(one * lanes * threads)}"
        shape = (
            f"{readable(one)} a tree of {plan.prunes} x {plan.simulations} simulations,"
            f" memoize={plan.memoize!r}"
        )
        raise ValueError(
            f"{method}: {asked} ({shape}), {readable(free)} are free; use fewer lanes, threads or"
            " simulations"
        )
    if auto and plan.memoize == "root":
        warnings.warn(
            f"{method}: states at every node do not fit into memory, so they are kept at the roots"
            ' alone: memoize="root"',
            stacklevel=4,
        )
    return plan, threads, max(1, min(lanes, within))


def require_rewards(method: str, sim: Any, simulations: int, record: bool) -> None:
    """ValueError where what is kept of all ``simulations`` does not fit, with the numbers."""
    real = signature_of(sim).dtype.itemsize
    # rewards and outcomes as harvested and joined, and the rewards of those that ran
    row = 3 * real + 2 + (4 * real if record else 0)
    require(method, simulations * row, f"the rewards of {simulations} simulations", "use fewer")


def _cores() -> int:
    known = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1
