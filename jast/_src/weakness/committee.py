"""A committee of small classifiers, each trained without a part of the inputs: what those left out
think of every input, in one program.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.heads.networks import adam, adam_step

__all__ = ["failure_gradient", "fit", "folds", "held_out_probability"]

HIDDEN = 32  # units of a member's one hidden layer; a convention
BATCH = 256  # inputs of a step, fewer where there are few inputs; a convention
RATE = 3e-3  # of Adam, falling to 0; a convention
LEAST_STEPS = 300  # of Adam, however few the inputs; a convention
MOST_STEPS = 1500  # however many: time
ROWS = 1024  # inputs judged at once: all logits of many classes would not fit into memory


class Committee(NamedTuple):
    """Weights of M networks, d inputs, ReLU, k classes."""

    first: np.ndarray
    """[d, M, h] float32"""
    first_bias: np.ndarray
    """[M, h]"""
    second: np.ndarray
    """[M, h, k]"""
    second_bias: np.ndarray
    """[M, k]"""


def folds(rng, n, parts=5, repeats=4):
    """[parts * repeats, n] bool: the inputs that each member may learn from; every one leaves out
    its own part, so that each input is left out ``repeats`` times.
    """
    rows = []
    for _ in range(repeats):
        part = rng.permutation(n) % parts
        rows += [part != i for i in range(parts)]
    return np.asarray(rows)


def fit(rng, x, targets, weights, classes, passes):
    """Train a `Committee` on ``x`` [n, d] float32 with ``targets`` [n] int and ``weights`` [M, n]
    by Adam.

    All members see the same minibatches, so that their first layers are one matrix product.
    ``passes``: over the inputs, within 300 to 1500 steps.
    """
    members, (n, d) = len(weights), x.shape
    # few inputs: small batches, so that they are not passed over too often
    batch = min(BATCH, max(n // 8, min(n, 16)))
    steps = max(LEAST_STEPS, min(passes * n // batch, MOST_STEPS))
    epochs = -(-steps // (n // batch))
    order = np.concatenate(
        [rng.permutation(n)[: n // batch * batch].reshape(-1, batch) for _ in range(epochs)]
    )[:steps].astype(np.int32)
    first = rng.standard_normal((d, members, HIDDEN), np.float32)
    second = rng.standard_normal((members, HIDDEN, classes), np.float32)
    start = Committee(
        first=first * np.float32(np.sqrt(2 / d)),
        first_bias=np.zeros((members, HIDDEN), np.float32),
        second=second * np.float32(np.sqrt(1 / HIDDEN)),
        second_bias=np.zeros((members, classes), np.float32),
    )
    return _fit(start, x, targets.astype(np.int32), weights.astype(np.float32), order)


def held_out_probability(committee, x, labels, learn):
    """[n]: the mean probability that members who have not learned from an input (``learn`` [M, n]
    bool) give to its label.
    """
    each = np.exp(np.asarray(_label_log_probs(committee, x, labels.astype(np.int32))))
    out = ~np.asarray(learn).T
    return np.sum(each * out, axis=1) / out.sum(1)


@jax.jit
def _label_log_probs(committee, x, labels):
    """[n, M]"""

    def one(row):
        with jax.numpy_rank_promotion("allow"):
            return jax.nn.log_softmax(logits(committee, row[0]))[:, row[1]]

    return jax.lax.map(one, (x, labels), batch_size=ROWS)


def logits(committee, x):
    """[..., M, k] of ``x`` [..., d]."""
    hidden = jax.nn.relu(jnp.einsum("...d,dmh->...mh", x, committee.first) + committee.first_bias)
    return jnp.einsum("...mh,mhk->...mk", hidden, committee.second) + committee.second_bias


@jax.jit
def failure_gradient(committee, x, labels):
    """[m, d]: the gradient at each row of ``x`` of the log odds that its label is not what the
    committee says.
    """

    def odds(x, label):
        each = jax.nn.log_softmax(logits(committee, x))
        # sums over the members are their mean, but for a constant that both have
        own = jnp.arange(each.shape[1], dtype=label.dtype) == label
        others = jnp.where(own, -jnp.inf, each)
        return jax.nn.logsumexp(others) - jax.nn.logsumexp(each[:, label])

    with jax.numpy_rank_promotion("allow"):
        return jax.vmap(jax.grad(odds))(x, labels)


@jax.jit
def _fit(start, x, targets, weights, order):
    steps, batch = order.shape

    def loss(committee, rows):
        out = jax.nn.log_softmax(logits(committee, x[rows]))
        said = jnp.take_along_axis(out, targets[rows][:, None, None], axis=2)[..., 0]
        return -jnp.sum(weights[:, rows].T * said) / batch

    def step(carry, at):
        i, rows = at
        slope = jax.grad(loss)(carry[0], rows)
        return adam_step(*carry, slope, RATE * (1 - i / steps)), None

    rounds = jnp.arange(steps, dtype=jnp.int32), order
    with jax.numpy_rank_promotion("allow"):  # optax asks for it
        return jax.lax.scan(step, (start, adam().init(start)), rounds)[0][0]
