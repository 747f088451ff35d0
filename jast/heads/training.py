"""Training heads on the statistics of finished trees: Adam over minibatches of this round's samples
and of those kept from earlier ones, in one program.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast.heads.samples import Samples

__all__ = ["Lesson", "learn", "learner"]


class Learner(NamedTuple):
    """A head in training."""

    params: Any
    optimiser: Any
    """Adam's state."""
    kept: Samples
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

    loss: float
    """Mean over the last tenth of the steps."""
    steps: int
    samples: int
    """Of this round; ``dropped`` ones are not among them."""
    dropped: int
    rejected: bool
    """The loss or a parameter was not finite: the parameters from before are kept."""


def learner(params):
    """A `Learner` that has seen nothing."""
    return Learner(params, adam().init(params), None)


def adam():
    import optax  # here: it takes a while, and only searches with heads need it

    return optax.scale_by_adam()


def squared(out, target):
    """Mean squared error; of a policy head, over the probabilities, as published."""
    return jnp.mean((out - target) ** 2)


def cross_entropy(logits, target):
    return -jnp.mean(jnp.sum(target * jax.nn.log_softmax(logits, axis=-1), axis=-1))


def squared_shares(logits, target):
    return squared(jax.nn.softmax(logits, axis=-1), target)


LOSSES = {"squared": squared, "cross_entropy": cross_entropy, "squared_shares": squared_shares}


def keep(kept, new, capacity):
    """The latest ``capacity`` samples."""
    columns = (
        new[:3]
        if kept is None
        else (np.concatenate([a, b]) for a, b in zip(kept[:3], new[:3], strict=True))
    )
    return Samples(*(c[-capacity:] for c in columns))


def learn(key, learner, apply, normalise, samples, *, loss, rate, batch, steps, capacity):
    """Train a head on ``samples`` and those kept: (`Learner`, `Lesson`).

    ``normalise``: the moments (inputs, target) that its numbers pass through. ``steps`` minibatches
    of ``batch``; None: one pass. ``capacity``: samples that are kept for the next rounds; 0: none,
    and each round has but its own.
    """
    kept = keep(learner.kept, samples, capacity) if capacity else samples
    size = len(kept.seen)
    if size == 0 or steps == 0:
        return learner._replace(kept=kept if capacity else None), Lesson(
            float("nan"), 0, 0, samples.dropped, False
        )
    steps = -(-size // batch) if steps is None else steps
    room = capacity or 1 << (size - 1).bit_length()  # few shapes, few programs
    data = jax.tree.map(
        lambda a: np.concatenate([a, np.zeros((room - size, *a.shape[1:]), a.dtype)]),
        tuple(kept[:3]),
    )
    params, optimiser, last = _fit(
        key,
        learner.params,
        learner.optimiser,
        apply,
        normalise,
        data,
        size,
        steps,
        rate,
        loss,
        batch,
    )
    last = float(last)
    finite = bool(np.isfinite(last)) and all(
        bool(jnp.all(jnp.isfinite(a))) for a in jax.tree.leaves(params)
    )
    lesson = Lesson(last, steps, len(samples.seen), samples.dropped, not finite)
    kept = kept if capacity else None
    return (Learner(params, optimiser, kept) if finite else learner._replace(kept=kept)), lesson


@functools.partial(jax.jit, static_argnames=("loss", "batch"))
def _fit(key, params, optimiser, apply, normalise, data, size, steps, rate, loss, batch):
    seen, x, target = data
    inputs, targets = normalise
    rows = jnp.concatenate([seen, x], axis=1)
    rows, target = jax.vmap(inputs.normalise)(rows), jax.vmap(targets.normalise)(target)
    number = jnp.arange(rows.shape[0], dtype=jnp.int32)
    order = jnp.argsort(
        jnp.where(number < size, jax.random.uniform(key, number.shape), 2.0)
    ).astype(jnp.int32)

    def mean_loss(params, rows, target):
        return jnp.mean(jax.vmap(lambda r, t: LOSSES[loss](apply(params, r), t))(rows, target))

    def step(i, carry):
        params, optimiser, total = carry
        # a pass over all samples in their shuffled order, then the next; the size is a number, not
        # a shape
        at = order[(i * batch + jnp.arange(batch, dtype=jnp.int32)) % size]
        value, gradient = jax.value_and_grad(mean_loss)(params, rows[at], target[at])
        with jax.numpy_dtype_promotion("standard"):  # optax asks for it
            update, optimiser = adam().update(gradient, optimiser)
        params = jax.tree.map(lambda p, u: p - jnp.asarray(rate, p.dtype) * u, params, update)
        late = i >= steps - (steps + 9) // 10
        return params, optimiser, total + jnp.where(late, value, 0).astype(total.dtype)

    params, optimiser, total = lax.fori_loop(
        0, steps, step, (params, optimiser, jnp.zeros((), jnp.float32))
    )
    return params, optimiser, total / ((steps + 9) // 10)
