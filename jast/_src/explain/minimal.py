"""minimal: the fewest and smallest disturbances of a failure that still make it fail."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.episode import Episode, replay
from jast._src.core.simulator import Simulator
from jast._src.explain.put_back import find_needed, shrink
from jast._src.normal_space import episode_point, transform
from jast._src.runtime.host_errors import runs_on_host
from jast._src.runtime.progress_bar import Watch
from jast._src.util import display
from jast._src.util.checks import number, whole_number
from jast._src.util.pytrees import index_tree

__all__ = ["MIN_HOSTED_BUDGET", "Minimal", "minimal"]

BUDGET = 5000  # evaluations by default
HOSTED_BUDGET = 500  # of a black box: two or three orders of an episode of some ten numbers
MIN_HOSTED_BUDGET = 10  # runs of a black box: fewer than it takes to see that the episode fails
LAST = 3  # runs of a black box that are kept for the answer: its episode is played and replayed
PRINTED = 12  # needed disturbances, and runs of steps


@display.printable()
class Minimal(NamedTuple):
    """What a failure needs.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.walk1d()
        >>> failure = jast.replay(sim, jnp.full(30, 0.01).at[3].set(12.0))
        >>> found = jast.explain.minimal(sim, failure, orders=2)
        >>> [part[0] for part in found.parts], bool(found.episode.failure)  # step 4 alone
        ([4], True)
    """

    needed: Any
    """bool, like the disturbances [horizon, ...]: those that are not at their mode."""
    needed_start: Any
    """bool, like x0."""
    episode: Episode
    """Fails with these alone, and with its states; the others are at the mode."""
    parts: tuple[Any, ...]
    """(step, name, value, normal number) of each that is needed, by step; step 0 is x0. The normal
    number tells how unlikely a value is: 0 at the mode, about 1 a standard deviation from there.
    """
    numbers: int
    """How many numbers the disturbances of the given episode have."""
    evaluations: int
    complete: bool = True
    """False where the budget was used up: then fewer may be needed, and smaller ones."""
    untried: tuple[int, ...] = ()
    """Places in ``parts`` of those without which nothing was tried, as the budget was used up: they
    may be needed or not."""

    def __str__(self) -> str:
        untried = [self.parts[i] for i in self.untried]
        tried = [part for i, part in enumerate(self.parts) if i not in self.untried]
        lines = [_count(tried, self.numbers, "needed"), *_lines(tried)]
        if untried:
            lines += [_count(untried, self.numbers, "perhaps needed, not tried"), *_lines(untried)]
        if not self.complete:
            lines.append(f"the budget was used up: {self.evaluations} evaluations")
        return "\n".join(lines)


def minimal(
    sim: Simulator,
    episode: Episode,
    *,
    orders: int = 8,
    slack: float = 0.1,
    budget: int | None = None,
    progress: bool = False,
) -> Minimal:
    """Which disturbances of a failure are needed, and how large must they be?

    Disturbances are put back to the mode of their distribution for as long as the system still
    fails, the small ones first, in several orders; of what is left the fewest are kept, none of
    which can be spared. These are then shrunk towards the mode, together and one by one. Everything
    is verified by simulation, so this holds for systems without gradients and for black boxes. (A
    greedy search, as in delta debugging, Zeller and Hildebrandt 2002: there may be a smaller set
    that no order leads to.)

    Args:
        sim: the simulator; its disturbances have quantile functions.
        episode: one failure, an `jast.Episode`.
        orders: in how many orders disturbances are tried, at least 1; the first is by size, the
            others are shuffled.
        slack: the share by which disturbances may grow in place of those that are put back, 0 or
            more: of a failure that was pulled to where it is likeliest none could be spared.
        budget: evaluations, at which the work ends with what it has by then. About 70 for each
            needed disturbance and order. Default: 5000; 500 of a black box, whose runs are never
            more than the budget, at least 10. The small ones are tried first, and what was not
            tried by then stays: ``untried`` says which, and ``complete`` whether all was done.
        progress: whether there is a bar.

    Returns:
        `Minimal`.

    Raises:
        ValueError: for bad arguments, and where ``episode`` is not one failure of this simulator.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.walk1d()
        >>> failure = jast.replay(sim, jnp.full(30, 0.01).at[3].set(12.0))
        >>> int(jast.explain.minimal(sim, failure, orders=2).needed.sum())
        1
    """
    name = "minimal"
    orders, hosted = whole_number(name, "orders", orders, 1), runs_on_host(sim)
    if budget is None:
        budget = HOSTED_BUDGET if hosted else BUDGET
    budget = whole_number(name, "budget", budget, MIN_HOSTED_BUDGET if hosted else 1)
    if hosted:
        budget -= LAST
    slack = number(name, "slack", slack, lambda v: 0 <= v < np.inf, "0 or more")
    g = episode_point.failing_point(name, sim, episode, most=budget)
    if (farther := g._replace(v=(1 + slack) * g.v)).evaluate(farther.v[None]).failure[0]:
        g = farther
    with Watch(name, budget, "sim", progress, None) as g.evaluate.watch:
        kept, tried = find_needed(g, orders, budget)
        v = shrink(g, np.where(kept, g.v, 0.0), budget)
    e = transform.played(g.sim, v[None])
    e = jax.device_get(replay(sim, index_tree(e._replace(states=None), 0)))
    kept &= episode_point.number_steps(sim) <= int(e.length)
    x0, needed = episode_point.like_disturbances(sim, kept)
    return Minimal(
        needed=needed,
        needed_start=x0,
        episode=e,
        parts=_parts(sim, e, v, kept),
        numbers=int(g.outcome.used[0]),
        evaluations=g.evaluate.spent,
        complete=g.evaluate.spent < budget,
        untried=tuple(np.flatnonzero(~tried[kept]).tolist()),
    )


def _parts(sim: Simulator, e: Episode, v: np.ndarray, kept: np.ndarray) -> tuple:
    each = [np.asarray(a).reshape(len(a), -1) for a in jax.tree.leaves(e.disturbances)]
    first = [np.asarray(a).reshape(-1) for a in jax.tree.leaves(e.x0)]
    values = np.concatenate([*first, np.concatenate(each, axis=1).reshape(-1)])
    steps, called = episode_point.number_steps(sim), episode_point.number_names(sim)
    return tuple(
        (int(steps[i]), called[i], float(values[i]), float(v[i])) for i in np.flatnonzero(kept)
    )


def _count(parts: list, numbers: int, needed: str) -> str:
    """ "3 of 50 disturbances are needed: steps 4 to 6" """
    steps = _steps_in_words(sorted({step for step, *_ in parts}))
    are = "is" if len(parts) == 1 else "are"
    return f"{len(parts)} of {numbers} disturbances {are} {needed}: {steps}"


def _lines(parts: list) -> list[str]:
    lines = [
        f"  step {step:4d}  {name:<12} {value:12.5g}   {z:+.2f} sd from the mode"
        for step, name, value, z in parts[:PRINTED]
    ]
    return lines + ([f"  ... {len(parts) - PRINTED} more"] if len(parts) > PRINTED else [])


def _steps_in_words(steps: list) -> str:
    """ "steps 4 to 6, 9" """
    runs: list[list[int]] = []
    for step in steps:
        if runs and step == runs[-1][1] + 1:
            runs[-1][1] = step
        else:
            runs.append([step, step])
    text = ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in runs[:PRINTED])
    more = ", ..." if len(runs) > PRINTED else ""
    return f"step{'s' if len(steps) != 1 else ''} {text}{more}" if steps else "none"
