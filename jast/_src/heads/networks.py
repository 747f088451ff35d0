"""Heads: what a search asks of a network, and the Flax network that jast makes where the user
brings none.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.core.typing import PRNGKey
from jast._src.util.checks import one_of

__all__ = ["ACTIVATIONS", "Head", "adam", "adam_step", "dense", "make_head"]

ACTIVATIONS = {
    "gelu": lambda x: jax.nn.gelu(x, approximate=False),
    "relu": jax.nn.relu,
    "tanh": jnp.tanh,
    "silu": jax.nn.silu,
}


class Head(NamedTuple):
    """A network: ``apply(params, x)`` of one input x [n] float32. Any pair of the kind will do, of
    any framework.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> linear = jast.heads.Head({"w": jnp.ones(2)}, lambda params, x: params["w"] @ x)
        >>> heads = jast.heads.Heads(value=linear)  # a network of one's own
        >>> float(heads.value.apply(heads.value.params, jnp.array([1.0, 2.0])))
        3.0
    """

    params: Any
    """A pytree of arrays: what training changes."""
    apply: Callable[..., Any]
    """A policy head returns logits [d, bins] for x the n numbers that ``observe`` gives; a value
    head a scalar for those n and the d of the disturbance.
    """


def make_head(
    key: PRNGKey,
    inputs: int,
    outputs: Sequence[int] = (),
    *,
    hidden: Sequence[int] = (32, 32),
    activation: Literal["gelu", "relu", "silu", "tanh"] = "relu",
    first_activation: bool = True,
) -> Head:
    """A dense Flax network.

    Weights and biases start uniform in +-1/sqrt(fan-in).

    Args:
        key: consumed.
        inputs: numbers that it sees.
        outputs: shape of what it returns: ``()`` for a value head, ``(d, bins)`` for a
            rollout-policy head for a disturbance of d numbers.
        hidden: widths of the layers; the published networks have ``(64, 124, 64)``.
        activation: after each hidden layer.
        first_activation: whether there is one after the first layer; the published networks have
            none.

    Returns:
        ``(params, apply)``, a `Head`.

    Raises:
        ValueError: for sizes below 1, and unknown activations.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> params, apply = jast.heads.make_head(jax.random.key(0), 3, (2, 10))
        >>> apply(params, jnp.zeros(3)).shape
        (2, 10)
    """
    sizes = (inputs, *hidden, *outputs)
    if not hidden or any(isinstance(n, bool) or not isinstance(n, int) or n < 1 for n in sizes):
        raise ValueError(
            "make_head: inputs, hidden and outputs must be integers of at least 1, received"
            f" {inputs!r}, {hidden!r} and {outputs!r}"
        )
    one_of("make_head", "activation", activation, ACTIVATIONS)
    init, apply = dense(tuple(hidden), tuple(outputs), activation, first_activation)
    return Head(init(key, jnp.zeros((inputs,), jnp.float32)), apply)


# one function for networks of one shape: a program that holds it is not compiled again for the next
@functools.cache
def dense(hidden, outputs, activation, first_activation):
    import flax.linen as nn  # here: it takes a while, and only searches with heads need it

    class Dense(nn.Module):
        hidden: tuple
        outputs: tuple
        activation: str
        first_activation: bool

        @nn.compact
        def __call__(self, x):
            for i, width in enumerate((*self.hidden, math.prod(self.outputs))):
                # both from one range: variance 1 / (3 fan-in), as a uniform of +-1/sqrt(fan-in) has
                bound = 1 / math.sqrt(x.shape[-1])
                x = nn.Dense(
                    width,
                    kernel_init=nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform"),
                    bias_init=functools.partial(jax.random.uniform, minval=-bound, maxval=bound),
                    param_dtype=jnp.float32,
                )(x)
                if i < len(self.hidden) and (i > 0 or self.first_activation):
                    x = ACTIVATIONS[self.activation](x)
            return x.reshape(self.outputs)

    network = Dense(hidden, outputs, activation, first_activation)
    return network.init, Partial(network.apply)


def adam() -> Any:
    """Adam without its learning rate, of optax."""
    import optax  # here: it takes a while, and only learning needs it

    return optax.scale_by_adam()


def adam_step(params: Any, optimiser: Any, gradient: Any, rate: Any) -> tuple[Any, Any]:
    """One step of `adam`, whose state is ``optimiser``, at the learning ``rate``: ``(params,
    optimiser)``.
    """
    with jax.numpy_dtype_promotion("standard"):  # optax asks for it
        update, optimiser = adam().update(gradient, optimiser)
    params = jax.tree.map(lambda p, u: p - jnp.asarray(rate, p.dtype) * u, params, update)
    return params, optimiser
