"""The network that acts: a mixture of normal distributions of the latents, from what is seen of a
state; how networks begin, and how they descend.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from jast.heads.networks import dense
from jast.policies.latent import LOG_2PI, log_normal

__all__ = ["Net", "act", "adam", "descend", "draw", "drawn", "entropy_term", "network", "see"]


EVEN = 0.2
"""Share of the policy's mixture that all components have alike."""


class Net(NamedTuple):
    """What goes in and out of the networks."""

    inputs: Any
    """`jast.heads.Moments` of the observation."""
    unit: Any
    """float32: the distance that an episode comes nearer by, about; times lambda what the critics
    answer in.
    """


def network(n: int, hidden: tuple[int, ...], components: int) -> tuple:
    """The actor's ``(init, apply)``, for ``n`` latents."""
    return dense(hidden, (components, 2 * n + 1), "relu", True)


def drawn(key: jax.Array, shapes: Sequence[Any]) -> list:
    """Networks' parameters, uniform in +-1/sqrt(fan-in) as `make_head` has them, in one draw: one
    for each array is much to compile.
    """
    leaves, structure = jax.tree.flatten([params["params"] for params in shapes])
    fan_in = lambda layer: dict.fromkeys(layer, layer["kernel"].shape[0])
    fans = jax.tree.leaves(
        [{name: fan_in(layer) for name, layer in params["params"].items()} for params in shapes]
    )
    ends = list(itertools.accumulate(math.prod(s.shape) for s in leaves))
    flat = jax.random.uniform(key, (ends[-1],), jnp.float32, -1, 1)
    drawn = [
        flat[b - math.prod(s.shape) : b].reshape(s.shape) / math.sqrt(fan)
        for s, fan, b in zip(leaves, fans, ends, strict=True)
    ]
    return [{"params": params} for params in structure.unflatten(drawn)]


def see(net: Net, horizon: int, seen: jax.Array, t: Any, potential: jax.Array) -> jax.Array:
    """[m + 2]: the actor's inputs, the observation in its moments, the share of the horizon that is
    gone (the best policy depends on the time left), and the miss distance as it shapes the reward:
    the value of a state has its kinks.
    """
    gone = jnp.asarray(t).astype(jnp.float32) / horizon
    return jnp.concatenate(
        [net.inputs.normalise(seen), jnp.stack([gone - 0.5, potential / net.unit])]
    )


def act(apply: Callable, actor: Any, inputs: jax.Array) -> tuple[jax.Array, ...]:
    """The policy: a mixture of the latents, its log weights [K], means and deviations [K, n]; a
    deviation is from e^-2 to e^2.
    """
    out = apply(actor, inputs)
    n = (out.shape[1] - 1) // 2
    # no component may die out: it would learn no more, and never come to see its own way
    weights = (1 - EVEN) * jax.nn.softmax(out[:, 0]) + EVEN / out.shape[0]
    return (
        jnp.log(weights),
        out[:, 1 : n + 1] + _apart(out.shape[0], n),
        jnp.exp(2 * jnp.tanh(out[:, n + 1 :] / 2)),
    )


def _apart(k: int, n: int) -> jax.Array:
    """[k, n]: where the components are before anything was learned, on opposite sides, so that each
    goes its own way.
    """
    side = np.random.default_rng(0).choice([-1.0, 1.0], size=(1, n))
    if k == 1:
        return jnp.zeros((1, n), jnp.float32)
    return jnp.asarray(np.linspace(-1, 1, k)[:, None] * side, jnp.float32)


def draw(mixture: tuple[jax.Array, ...], noise: jax.Array) -> jax.Array:
    """Latents [n] of a mixture of `act`, by n + 1 standard normal numbers."""
    log_w, mean, deviation = mixture
    k = jnp.sum(ndtr(noise[-1]) > jnp.cumsum(jnp.exp(log_w))[:-1], dtype=jnp.int32)
    return mean[k] + deviation[k] * noise[:-1]


def entropy_term(
    z: jax.Array, log_w: jax.Array, mean: jax.Array, deviation: jax.Array
) -> jax.Array:
    """log pi(z | s) less the log density of N(0, I) at its mode: so measured, an episode that ends
    early neither gains nor loses.
    """
    log_pi = jax.nn.logsumexp(log_w + jax.vmap(log_normal, (None, 0, 0))(z, mean, deviation))
    return log_pi + 0.5 * z.shape[0] * LOG_2PI


def adam() -> Any:
    import optax  # here: it takes a while, and only learning needs it

    return optax.scale_by_adam()


def descend(gradient: Any, optimiser: Any, params: Any, rate: Any) -> tuple[Any, Any]:
    """One step of Adam: ``(params, optimiser)``."""
    with jax.numpy_dtype_promotion("standard"):  # optax asks for it
        step, optimiser = adam().update(gradient, optimiser)
    return jax.tree.map(lambda p, u: p - jnp.asarray(rate, p.dtype) * u, params, step), optimiser
