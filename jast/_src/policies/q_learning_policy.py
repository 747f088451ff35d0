"""q_learning: a failure policy by Q-learning on a discretised state (Watkins and Dayan 1992), the
learner that Lipkis and Agogino (NASA) name beside soft actor-critic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array, Callback, PathLike, PRNGKey
from jast._src.policies import q_learning_training
from jast._src.policies.failure_policy import FailurePolicy
from jast._src.policies.settings import Asked, is_auto
from jast._src.policies.train_policy import Method, train_policy
from jast._src.policies.training_state import explore
from jast._src.runtime.memory import require
from jast._src.util.checks import whole_number, wrong

__all__ = ["q_learning"]

EXPLORED = 100_000  # transitions of the exploration that the ranges are taken of; a convention


def q_learning(
    key: PRNGKey,
    sim: Simulator,
    *,
    episodes: int = 25_000,
    cells: int | Sequence[int] = 50,
    cell: Callable[[Array, Array], Array] | None = None,
    ranges: Sequence[Sequence[float]] | Array | Literal["auto"] = "auto",
    values: int = 13,
    reach: float = 3.0,
    scale: float | Literal["auto"] = "auto",
    widen: float | Literal["auto"] = "auto",
    epsilon: float = 0.3,
    lanes: int = 16,
    learning_rate: float = 1.0,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
) -> FailurePolicy:
    """Teach a policy to make ``sim`` fail in the likeliest way, by Q-learning in a table: the
    `FailurePolicy` that `jast.policies.sac` hands out.

    A row of the table is a cell of what ``observe(state)`` shows at a step, a column a value of the
    disturbance's latents z. The return of an episode is log p relative to the mode, -|z|^2 / 2 a
    step, less lambda times the last miss distance, undiscounted: so the table learns the likeliest
    way to fail from each cell. The policy's ``disturbance`` is N(z*, 1) in the latents, z* the best
    column, so `jast.rollout` plays it and importance sampling may draw from it.

    A cell must be small beside what a step moves the state by, in the numbers that decide: else its
    value is that of the luckiest state in it (docs/figures.md). So a state of more than two or
    three numbers needs a ``cell`` of your own, or `sac`.

    Args:
        key: of `jax.random`; consumed.
        sim: with a disturbance of floats that has a quantile function and its inverse.
        episodes: in all, of full length; where they end early there are more of them. At least 4 a
            lane.
        cells: of the grid, for each number that ``observe`` shows, [m], or one count for all; every
            step of the horizon has a grid of its own. With ``cell``: how many it tells apart.
        cell: function of what is observed, [m] float32, and of the step, int32, to the number of
            its cell, from 0 to ``cells`` - 1; beyond that, the nearest. None: the grid.
        ranges: of the grid, [m, 2], the least and the greatest of each number observed; what is
            beyond belongs to the last cell. "auto": what the exploration before the learning saw.
        values: of each latent, at least 2, evenly from -``reach`` to ``reach``; the table has
            ``values`` to the power of the latents columns.
        reach: in standard deviations, above 0.
        scale: lambda, as for `sac`.
        widen: as for `sac`.
        epsilon: share of the actions that are any of the table, 0 to 1.
        lanes: episodes side by side, each step of which is learned from.
        learning_rate: above 0 and at most 1; falls to a twentieth. A system that is deterministic
            given its disturbances, as all are here, can take 1.
        progress: whether there is a bar.
        callback: called some twenty times as ``callback(done, total, history)``, with the steps of
            all lanes and the `History` so far.
        checkpoint: a folder in which the training is kept as often, and from which a call with the
            same arguments goes on to the same bits.

    Returns:
        `FailurePolicy`; its ``history.alpha`` is 0 and ``critic_loss`` the mean square of the
        table's errors. Its start is a mixture fitted to p(x0) exp(V(s0)), V the best of a row. A
        KeyboardInterrupt ends the training after its last whole chunk and gives what was learned
        by then (it is raised again where there is none). `jast.save` does not take it.

    Raises:
        ValueError: for settings out of range, a table that does not fit into memory, a ``cell``
            that does not return one whole number, a simulator that breaks its contract, a
            disturbance that is not of floats or cannot be tilted (named), and a checkpoint of
            another training.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d(form="one-sided")
        >>> policy = jast.policies.q_learning(jax.random.key(0), sim, episodes=500, cells=20)
        >>> jast.rollout(jax.random.key(1), sim, policy).disturbances.shape
        (10,)
    """
    asked = Asked("q_learning", key, sim)
    episodes, lanes = asked.counts(episodes=episodes, lanes=lanes)
    values = whole_number("q_learning", "values", values, 2)
    plan = asked.plan(episodes, lanes)
    rates = q_learning_training.Rates(
        learning_rate=asked.number(
            "learning_rate", learning_rate, lambda v: 0 < v <= 1, "above 0 and at most 1"
        ),
        epsilon=asked.number("epsilon", epsilon, lambda v: 0 <= v <= 1, "of 0 to 1"),
        total=float(plan.total),
    )
    reach = asked.positive("reach", reach)
    n, ranges = asked.n, _ranges(ranges, asked.m)
    cell, rows = _cells(cells, cell, asked.m, sim.horizon)
    kept = f"a table of {rows} cells and {values}^{n} values of the disturbance"
    require("q_learning", 8 * rows * values**n, kept, "use fewer cells or values")
    config = asked.config(lanes=lanes, capacity=max(EXPLORED, lanes))
    actor = q_learning_training.greedy_actor(cell, sim.horizon)
    traced = jax.tree.map(jnp.float32, rates)
    actions = q_learning_training.action_grid(n, values, reach)
    method = Method(
        actor=actor,
        begin=lambda key: q_learning_training.begin_table_training(key, sim, config, rows, actions),
        explore=lambda key, *args: explore(key, sim, config, actor, *args),
        learn=lambda key, *args: q_learning_training.train(key, sim, config, cell, traced, *args),
        learned=lambda training: (training.learner.actor, (), jnp.zeros(())),
        start_value=q_learning_training.start_value(cell, sim.horizon),
        explored=lambda training: q_learning_training.set_ranges(training, ranges),
    )
    course = dict(scale=scale, widen=widen, progress=progress, callback=callback)
    about = dict(rates=rates, cell=cell, rows=rows, ranges=ranges, values=values, reach=reach)
    return train_policy(key, asked, method, config, plan, checkpoint=checkpoint, **course, **about)


def _ranges(ranges: Any, m: int) -> np.ndarray | None:
    """[m, 2], or None for "auto"."""
    if is_auto(ranges):
        return None
    try:
        known = np.asarray(ranges, np.float64)
        good = known.shape == (m, 2) and np.all(np.isfinite(known))
        good = good and np.all(known[:, 0] < known[:, 1])
    except (TypeError, ValueError):
        good = False
    if not good:
        must = f'be "auto" or [{m}, 2], the least and the greatest of each number observed'
        raise wrong("q_learning", "ranges", must, f"{ranges!r}")
    return known


def _cells(
    cells: int | Sequence[int], cell: Callable | None, m: int, horizon: int
) -> tuple[Callable[..., jax.Array], int]:
    """The function of a cell, and how many there are."""
    if cell is None:
        several = isinstance(cells, Sequence) and not isinstance(cells, str)
        each = tuple(
            whole_number("q_learning", "cells", c) for c in (cells if several else [cells] * m)
        )
        if len(each) != m:
            must = f"be a whole number or {m} of them, one for each number observed"
            raise wrong("q_learning", "cells", must, f"{cells!r}")
        return q_learning_training.grid_cell(each), horizon * math.prod(each)
    cells = whole_number("q_learning", "cells", cells)
    like = jax.eval_shape(cell, *(jax.ShapeDtypeStruct(*s) for s in (((m,), "f4"), ((), "i4"))))
    if not (getattr(like, "shape", None) == () and jnp.issubdtype(like.dtype, np.integer)):
        raise wrong("q_learning", "cell", "return one whole number, the number of a cell", like)
    return q_learning_training.user_cell(cell, cells), cells
