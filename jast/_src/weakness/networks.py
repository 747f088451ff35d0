"""The two networks of adversarial weakness recognition and their training: an autoencoder of the
inputs, an adversary that tells failures by their codes.

R. J. Moss, "Algorithms for Efficient Validation of Black-Box Systems", Stanford 2021, chapter 4.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jast._src.heads.networks import adam, adam_step

__all__ = [
    "adversary",
    "autoencoder",
    "codes_of",
    "default_widths",
    "fit_adversary",
    "fit_autoencoder",
    "logits",
]

ADVERSARY = (128, 64)  # widths, of chapter 4
LEAK = 0.01  # of the autoencoder's leaky ReLU; Flux's default, which the published code takes


class Network(NamedTuple):
    """Pure functions of one Flax module, the same object whenever one of the same sizes is asked
    for: programs that hold it are not compiled again.
    """

    init: Callable[..., Any]
    """``init(key) -> params``: weights uniform as Glorot's, biases zero, float32"""
    apply: Callable[..., Any]
    """``apply(params, x [..., inputs])``: of the autoencoder the reconstruction [..., inputs], of
    the adversary the logits [...]
    """
    encode: Callable[..., Any]
    """``encode(params, x [..., inputs])``: the code [..., hidden[-1]]; not of the adversary"""
    decode: Callable[..., Any]
    """``decode(params, code [..., hidden[-1]])``: [..., inputs]; not of the adversary"""


def default_widths(inputs):
    """The autoencoder's layers for so many numbers: half of them, at most 392, and a quarter, at
    most 64. The thesis's (392, 64) for its 784 pixels.
    """
    return max(1, min(392, inputs // 2)), max(1, min(64, inputs // 4))


@functools.cache
def autoencoder(inputs, hidden):
    """The `Network` of chapter 4, "Dataset Autoencoder": dense layers of ``hidden`` widths, the
    same backwards, leaky ReLU after every one, also the last.
    """
    return _network(_modules()[0](inputs, hidden), inputs)


@functools.cache
def adversary(inputs):
    """The `Network` of chapter 4, "Adversarial Failure Classifier": inputs-128-64-1, ReLU between;
    its logits, whose sigmoid is the score.
    """
    return _network(_modules()[1](ADVERSARY), inputs)


def _network(module, inputs):
    return Network(
        # one program, not one a layer
        init=jax.jit(lambda key: module.init(key, jnp.zeros(inputs, jnp.float32))),
        apply=Partial(module.apply),
        encode=functools.partial(module.apply, method="encode"),
        decode=functools.partial(module.apply, method="decode"),
    )


def fit_autoencoder(key, rows, hidden, *, epochs=20, batch=1000, rate=1e-3):
    """Train an autoencoder on ``rows`` [n, d] float32, by Adam on the mean squared error, shuffled
    each epoch: (params, losses [epochs]). `codes_of` has the codes.

    Minibatches of ``batch``, at most n; the last of an epoch may be smaller.
    """
    network = autoencoder(rows.shape[1], hidden)
    first, then = jax.random.split(key)
    n = len(rows)
    data = rows, rows, np.arange(n, dtype=np.int32), n
    how = dict(epochs=epochs, rate=rate, loss=_squared, batch=min(batch, n))
    return _fit(then, network.init(first), data, network.apply, **how)


@functools.partial(jax.jit, static_argnames="hidden")
def codes_of(params, rows, hidden):
    """The codes [n, hidden[-1]] of ``rows`` [n, d] by an autoencoder that `fit_autoencoder`
    trained.
    """
    return autoencoder(rows.shape[1], hidden).encode(params, rows)


def fit_adversary(key, params, codes, failed, number, size, *, epochs=20, batch=1, rate=3e-5):
    """Train an adversary further on the first ``size`` of ``number`` [room] int32, rows of
    ``codes`` [m, d] that may repeat: (params, losses [epochs]).

    ``failed`` [m] float32: the targets, of the binary cross-entropy. ``size`` is a number, not a
    shape: other sizes in the same room compile nothing.
    """
    data = codes, failed, number, size
    how = dict(epochs=epochs, rate=rate, loss=_entropy, batch=batch)
    return _fit(key, params, data, adversary(codes.shape[1]).apply, **how)


@jax.jit
def logits(params, codes):
    """The adversary's logits [n] of ``codes`` [n, d]."""
    return adversary(codes.shape[1]).apply(params, codes)


def _squared(out, target):
    return jnp.mean((out - target) ** 2, axis=-1)


def _entropy(logit, target):
    return jax.nn.softplus(logit) - target * logit


@functools.partial(jax.jit, static_argnames=("epochs", "loss", "batch"))
def _fit(key, params, data, apply, *, epochs, rate, loss, batch):
    """``epochs`` passes in minibatches over ``data`` (rows, targets, number, size), the first
    ``size`` of the rows' ``number``, by Adam that starts anew: (params, mean loss of each epoch).
    """
    rows, targets, number, size = data
    place = jnp.arange(len(number), dtype=jnp.int32)
    size = jnp.asarray(size, jnp.int32)
    steps = (size + batch - 1) // batch

    def mean_loss(params, at, weight):
        return jnp.sum(weight * loss(apply(params, rows[at]), targets[at])) / jnp.sum(weight)

    def step(i, carry, order):
        params, state, total = carry
        now = i * batch + jnp.arange(batch, dtype=jnp.int32)
        weight = (now < size).astype(jnp.float32)  # the last batch may be smaller
        at = order[jnp.minimum(now, size - 1)]
        value, gradient = jax.value_and_grad(mean_loss)(params, at, weight)
        params, state = adam_step(params, state, gradient, rate)
        return params, state, total + value * jnp.sum(weight)

    def epoch(carry, key):
        drawn = jax.random.uniform(key, place.shape, jnp.float32)
        order = number[jnp.argsort(jnp.where(place < size, drawn, 2.0))]
        params, state, total = lax.fori_loop(
            0, steps, functools.partial(step, order=order), (*carry, jnp.zeros((), jnp.float32))
        )
        return (params, state), total / size.astype(jnp.float32)

    start = params, adam().init(params)
    (params, _), losses = lax.scan(epoch, start, jax.random.split(key, epochs))
    return params, losses


@functools.cache
def _modules():
    import flax.linen as nn  # here: it takes a while

    dense = functools.partial(
        nn.Dense, kernel_init=nn.initializers.glorot_uniform(), param_dtype=jnp.float32
    )

    class Autoencoder(nn.Module):
        inputs: int
        hidden: tuple

        def setup(self):
            self.encoder = [dense(width) for width in self.hidden]
            self.decoder = [dense(width) for width in (*self.hidden[-2::-1], self.inputs)]

        def encode(self, x):
            for layer in self.encoder:
                x = nn.leaky_relu(layer(x), LEAK)
            return x

        def __call__(self, x):
            return self.decode(self.encode(x))

        def decode(self, x):
            for layer in self.decoder:
                x = nn.leaky_relu(layer(x), LEAK)
            return x

    class Adversary(nn.Module):
        hidden: tuple

        @nn.compact
        def __call__(self, x):
            for width in self.hidden:
                x = nn.relu(dense(width)(x))
            return dense(1)(x)[..., 0]

    return Autoencoder, Adversary
