"""The course of a training on the host: a look at the model and around it, then stretch by stretch,
watched, kept and interrupted.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast.archive import arrays_of, named
from jast.checkpoints import Checkpoint
from jast.policies.exploring import Count, Training, settle
from jast.policies.failure_policy import FAILING_SHARE, History, history, row
from jast.policies.settings import Plan
from jast.watch import Watch, terminable

__all__ = ["learn", "look"]

REACH, WIDEN, FAR = 8.0, 3.0, 30.0
"""How far away from the model, in deviations, the episodes of the exploration are in all their
latents together: as far as a failure of probability 1e-15; how wide the starts are; both more where
the miss distance is more of its deviations away from 0, and then as wide as this at the most (a
third of it).
"""
MARGIN, RAISE, FAILING, RAISED = 1.5, 1.5, 0.2, (0.2, 0.75)
"""Lambda: times what a unit of distance costs by estimate; then raised by a factor, while too few
fail, in this part of the training.
"""
Run = Callable[[Training, int], tuple[Training, Count]]
"""So many steps of all lanes."""


def look(
    training: Training,
    run: Run,
    plan: Plan,
    horizon: int,
    scale: float | None,
    widen: float | None,
) -> tuple[Training, np.ndarray]:
    """``(Training, its first row of the history)`` once the model and what is around it were looked
    at; ``scale``, ``widen``: None to set them by what is seen.
    """
    training, count = run(training, plan.nominal)
    n = max(float(count.whole), 1.0)
    mean, square = float(count.nearest) / n, float(count.squares) / n
    deviation = math.sqrt(max(square - mean**2, 0)) if math.isfinite(square) else 0.0
    varies = mean > 0 and deviation > 3e-3 * mean  # beyond the rounding of sums
    far = min(mean / deviation, FAR) if varies else 0.0
    widen = max(WIDEN, far / 3) if widen is None else widen
    training = training._replace(
        widen=jnp.float32(widen), reach=jnp.float32(max(REACH, far) / math.sqrt(horizon + 1))
    )
    training, more = run(training, plan.around)
    training = settle(training, horizon)
    if scale is None:
        # were d normal under p and linear in z, d = 0 would cost E[d]^2 / (2 Var[d]) of
        # log-likelihood, and the last unit of distance E[d] / Var[d]
        scale = MARGIN * mean / deviation**2 if varies else REACH**2 / float(training.net.unit)
    training = training._replace(scale=jnp.float32(scale))
    return training, row(
        np.zeros((0, len(History._fields))),
        training,
        jax.tree.map(lambda a, b: a + b, *jax.device_get((count, more))),
    )


def learn(
    function: str,
    first: Callable[[], tuple[Training, np.ndarray]],
    run: Run,
    plan: Plan,
    *,
    auto_scale: bool,
    progress: bool,
    callback: Callable[..., Any] | None,
    store: Checkpoint | None,
    like: Training,
) -> tuple[Training, np.ndarray]:
    """``(Training, rows)`` after all stretches; ``first()``: those before. ``store`` keeps them
    after each stretch, and they go on from what it holds; ``like``: a training's shapes.
    """
    training, rows = _kept(store, like) or first()
    kept, lanes = (training, rows), training.lanes.t.shape[0]
    watch = Watch(
        function,
        plan.total * lanes,
        "step",
        progress,
        callback,
        done=int(training.at) * lanes,
    )
    try:
        with terminable():
            while (left := plan.total - int(kept[0].at)) > 0:
                training, count = run(kept[0], min(left, plan.stretch))
                rows = row(kept[1], training, jax.device_get(count))
                gone = 1 - (left - plan.stretch) / plan.learning
                few = rows[-1, FAILING_SHARE] < FAILING
                if auto_scale and RAISED[0] < gone < RAISED[1] and few:
                    training = training._replace(scale=training.scale * jnp.float32(RAISE))
                # at once: an interruption finds all of a stretch or nothing
                kept = training, rows
                if store is not None:
                    store.replace({}, named(dict(training=training, rows=rows)))
                failing, log_p = rows[-1, FAILING_SHARE : FAILING_SHARE + 2]
                watch.reach(
                    int(training.at) * lanes, failing=f"{failing:.1%}", log_p=f"{log_p:.4g}"
                )
                watch.tell(lambda rows=rows: history(rows[1:]))
    except KeyboardInterrupt:
        if len(kept[1]) < 2:
            raise
    finally:
        watch.close()
    return kept


def _kept(store: Checkpoint | None, like: Training) -> tuple[Training, np.ndarray] | None:
    """``(Training, rows)`` that a checkpoint holds; None where there is none."""
    state = None if store is None else store.state()
    if state is None:
        return None
    leaves, (rows,) = (arrays_of(state[1], name) for name in ("training", "rows"))
    return jax.tree.structure(like).unflatten(map(jnp.asarray, leaves)), rows
