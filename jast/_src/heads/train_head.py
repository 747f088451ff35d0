"""Training heads on the statistics of finished trees: Adam over minibatches of this round's samples
and of those kept from earlier ones, in one program.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.typing import ArrayTree
from jast._src.heads.networks import adam, adam_step
from jast._src.heads.samples import Samples

__all__ = ["HeadState", "Lesson", "init_head", "train_head"]


class HeadState(NamedTuple):
    """A head in training."""

    params: ArrayTree
    optimiser: ArrayTree
    """Adam's state."""
    kept: Samples | None
    """The latest samples, up to the capacity."""


class Lesson(NamedTuple):
    """What one round of training came to.

    Example:
        >>> import jax, jast
        >>> few = jast.heads.settings(round=2, hidden=(8,), steps=(5, 5), bins=4)
        >>> found = jast.search.forest(
        ...     jax.random.key(0), jast.simulators.walk1d(), trees=4, prunes=1, simulations=50,
        ...     heads="rollout", actions=jast.actions.wide(2.0), head_settings=few, refine=0,
        ... )
        >>> [lesson["policy"].steps for lesson in found.lessons]  # of two rounds
        [5, 5]
    """

    loss: float = float("nan")
    """Mean over the last tenth of the steps."""
    steps: int = 0
    samples: int = 0
    """Of this round; ``dropped`` ones are not among them."""
    dropped: int = 0
    rejected: bool = False
    """The loss or a parameter was not finite: the parameters from before are kept."""


def init_head(params: Any) -> HeadState:
    """The `HeadState` of a head that has learned nothing."""
    return HeadState(params, adam().init(params), None)


def squared(out, target):
    """Mean squared error; of a policy head, over the probabilities, as published."""
    return jnp.mean((out - target) ** 2)


def cross_entropy(logits, target):
    return -jnp.mean(jnp.sum(target * jax.nn.log_softmax(logits, axis=-1), axis=-1))


def squared_shares(logits, target):
    return squared(jax.nn.softmax(logits, axis=-1), target)


LOSSES = {"squared": squared, "cross_entropy": cross_entropy, "squared_shares": squared_shares}


def train_head(key, head, apply, moments, samples, *, loss, rate, batch, steps, capacity):
    """Train a head on ``samples`` and those kept: (`HeadState`, `Lesson`).

    ``moments``: of the inputs and the target, which normalise them. ``steps`` minibatches of
    ``batch``; None: one pass. ``capacity``: samples that are kept for the next rounds; 0: none, and
    each round has but its own.
    """
    data, kept = samples, None
    if capacity:
        old = head.kept or Samples(*(column[:0] for column in samples[:3]))
        columns = (np.concatenate(pair) for pair in zip(old[:3], samples[:3], strict=True))
        data = kept = Samples(*(column[-capacity:] for column in columns))
    size = len(data.seen)
    if size == 0 or steps == 0:
        return head._replace(kept=kept), Lesson(dropped=samples.dropped)
    steps = -(-size // batch) if steps is None else steps
    room = capacity or 1 << (size - 1).bit_length()  # few shapes, few programs
    padded = jax.tree.map(
        lambda a: np.concatenate([a, np.zeros((room - size, *a.shape[1:]), a.dtype)]),
        tuple(data[:3]),
    )
    params, optimiser, last = _fit(
        key, head.params, head.optimiser, apply, moments, padded, size, steps, rate, loss, batch
    )
    last = float(last)
    finite = all(bool(jnp.all(jnp.isfinite(a))) for a in (last, *jax.tree.leaves(params)))
    lesson = Lesson(last, steps, len(samples.seen), samples.dropped, rejected=not finite)
    head = HeadState(params, optimiser, kept) if finite else head._replace(kept=kept)
    return head, lesson


@functools.partial(jax.jit, static_argnames=("loss", "batch"))
def _fit(key, params, optimiser, apply, moments, data, size, steps, rate, loss, batch):
    seen, x, target = data
    inputs, targets = moments
    rows = jnp.concatenate([seen, x], axis=1)
    rows, target = jax.vmap(inputs.normalise)(rows), jax.vmap(targets.normalise)(target)
    number = jnp.arange(rows.shape[0], dtype=jnp.int32)
    coins = jax.random.uniform(key, number.shape)
    order = jnp.argsort(jnp.where(number < size, coins, 2.0)).astype(jnp.int32)

    def mean_loss(params, rows, target):
        return jnp.mean(jax.vmap(lambda r, t: LOSSES[loss](apply(params, r), t))(rows, target))

    def step(i, carry):
        params, optimiser, total = carry
        # a pass over all samples in their shuffled order, then the next; the size is a number, not
        # a shape
        at = order[(i * batch + jnp.arange(batch, dtype=jnp.int32)) % size]
        value, gradient = jax.value_and_grad(mean_loss)(params, rows[at], target[at])
        params, optimiser = adam_step(params, optimiser, gradient, rate)
        late = i >= steps - (steps + 9) // 10
        return params, optimiser, total + jnp.where(late, value, 0).astype(total.dtype)

    first = params, optimiser, jnp.zeros((), jnp.float32)
    params, optimiser, total = lax.fori_loop(0, steps, step, first)
    return params, optimiser, total / ((steps + 9) // 10)
