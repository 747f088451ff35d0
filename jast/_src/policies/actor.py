"""The network that acts, in latent normal numbers: x = Q(Phi(z)), z ~ N(0, I) under the model,
whatever the units and the family of p. It gives a mixture of normal distributions of z, by what is
observed of a state.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from jast import distributions as D
from jast._src.core.signature import ask, signature_of
from jast._src.core.simulator import Simulator
from jast._src.distributions.flat_rows import split
from jast._src.heads.heads import Moments
from jast._src.heads.networks import dense
from jast._src.util.pytrees import count_numbers

__all__ = [
    "Networks",
    "Normalisation",
    "count_latents",
    "entropy_term",
    "init_parameters",
    "latent_mixture",
    "make_networks",
    "network_inputs",
    "parameter_shapes",
    "sample_latents",
]

UNIFORM_WEIGHT = 0.2
"""Part of the mixture's weights that is spread evenly: a component without weight would learn no
more.
"""


LOG_2PI = math.log(2 * math.pi)  # of the normal density


def log_normal(z: jax.Array, mean: jax.Array, deviation: jax.Array) -> jax.Array:
    """log N(z; mean, deviation^2) [] of ``z`` [n]."""
    return -0.5 * jnp.sum(((z - mean) / deviation) ** 2 + LOG_2PI) - jnp.sum(jnp.log(deviation))


def count_latents(sim: Simulator, function: str) -> tuple[int, int]:
    """``(n, n0)``: how many numbers x and x0 have. n0 is 0 where the start is fixed, or is not of
    floats with quantiles; it is then drawn from its own distribution.

    ValueError of ``function``, naming ``disturbance``, where x is not of floats or has no quantile
    function with an inverse.
    """
    like = signature_of(sim)
    if not _floats(like.x):
        kinds = ", ".join(f"{s.dtype}{list(s.shape)}" for s in jax.tree.leaves(like.x)) or "nothing"
        raise ValueError(f"{function}: disturbance: expected floats, received {kinds}")
    start, step = ask(sim, lambda start, state, dist: (D.untiltable(start), D.untiltable(dist)))
    if step is not None:
        raise ValueError(f"{function}: disturbance: {step}")
    tilted = _floats(like.x0) and start is None
    return count_numbers(like.x), count_numbers(like.x0) if tilted else 0


def _floats(like: Any) -> bool:
    return all(jnp.issubdtype(s.dtype, jnp.floating) for s in jax.tree.leaves(like))


class Normalisation(NamedTuple):
    """What the numbers that go into and out of the networks are divided by."""

    inputs: Moments
    """Of the observation."""
    unit: jax.Array
    """float32: how far an episode typically approaches failure; times lambda, the unit of the
    critics.
    """


Networks = tuple[Callable, Callable]  # ``apply`` of the actor and of the critic


def make_networks(n: int, hidden: tuple[int, ...], components: int) -> tuple[Networks, Networks]:
    """``(init, init)`` and ``(apply, apply)`` of the actor and the critic, for ``n`` latents."""
    actor = dense(hidden, (components, 2 * n + 1), "relu", True)
    return tuple(zip(actor, dense(hidden, (), "relu", True), strict=True))


def parameter_shapes(init: Callable, inputs: int) -> Any:
    """The shapes of the parameters that ``init`` makes for a network of so many ``inputs``."""
    return jax.eval_shape(init, jax.random.key(0), jnp.zeros((inputs,), jnp.float32))


def init_parameters(key: jax.Array, shapes: Sequence[Any]) -> list[Any]:
    """Parameters of networks of these ``shapes``, uniform in +-1/sqrt(fan-in) as those of
    `make_head`, by one call of the generator: one for each array takes long to compile.
    """

    def fan_in(layer: dict) -> dict:
        return dict.fromkeys(layer, layer["kernel"].shape[0])

    networks = [params["params"] for params in shapes]
    fans = [{name: fan_in(layer) for name, layer in network.items()} for network in networks]
    drawn = jax.random.uniform(key, (count_numbers(networks),), jnp.float32, -1, 1)
    scaled = jax.tree.map(lambda a, fan: a / math.sqrt(fan), split(drawn, networks), fans)
    return [{"params": params} for params in scaled]


def network_inputs(
    normalisation: Normalisation, horizon: int, observation: jax.Array, t: Any, potential: jax.Array
) -> jax.Array:
    """[m + 2]: the normalised observation [m], the fraction of the horizon that has passed (the
    best policy depends on the time left), and the miss distance as it shapes the reward, at whose
    kinks the value of a state has its own.
    """
    passed = jnp.asarray(t).astype(jnp.float32) / horizon
    seen = normalisation.inputs.normalise(observation)
    more = jnp.stack([passed - 0.5, potential / normalisation.unit])
    return jnp.concatenate([seen, more])


def latent_mixture(apply: Callable, actor: Any, inputs: jax.Array) -> tuple[jax.Array, ...]:
    """The policy, a mixture of the latents: its log weights [K], means and deviations [K, n]; a
    deviation is from e^-2 to e^2.
    """
    out = apply(actor, inputs)
    components, n = out.shape[0], (out.shape[1] - 1) // 2
    weights = (1 - UNIFORM_WEIGHT) * jax.nn.softmax(out[:, 0]) + UNIFORM_WEIGHT / components
    means = out[:, 1 : n + 1] + _initial_means(components, n)
    return jnp.log(weights), means, jnp.exp(2 * jnp.tanh(out[:, n + 1 :] / 2))


def _initial_means(k: int, n: int) -> jax.Array:
    """[k, n]: means of an untrained policy, on opposite sides, so that each component goes its own
    way.
    """
    side = np.random.default_rng(0).choice([-1.0, 1.0], size=(1, n))
    if k == 1:
        return jnp.zeros((1, n), jnp.float32)
    return jnp.asarray(np.linspace(-1, 1, k)[:, None] * side, jnp.float32)


def sample_latents(mixture: tuple[jax.Array, ...], noise: jax.Array) -> jax.Array:
    """Latents [n] of a `latent_mixture`, by n + 1 standard normal numbers."""
    log_w, mean, deviation = mixture
    k = jnp.sum(ndtr(noise[-1]) > jnp.cumsum(jnp.exp(log_w))[:-1], dtype=jnp.int32)
    return mean[k] + deviation[k] * noise[:-1]


def entropy_term(
    z: jax.Array, log_w: jax.Array, mean: jax.Array, deviation: jax.Array
) -> jax.Array:
    """log pi(z | s) less the log density of N(0, I) at its mode: measured so, an episode that ends
    early neither gains nor loses.
    """
    log_pi = jax.nn.logsumexp(log_w + jax.vmap(log_normal, (None, 0, 0))(z, mean, deviation))
    return log_pi + 0.5 * z.shape[0] * LOG_2PI
