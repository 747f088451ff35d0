"""Points drawn from a mixture of Gaussians, and their densities. Only the system runs on the
device, in one program whatever the number of points.
"""

from functools import partial

import jax
import numpy as np

from jast._src.core.counter_prng import counter_key, numpy_generator
from jast._src.core.simulator import Simulator
from jast._src.distributions import fine_draws
from jast._src.estimate.gaussians.mixture_fit import log_sum, with_log_shares
from jast._src.normal_space import transform
from jast._src.normal_space.evaluate_points import evaluate_points, lanes_of

__all__ = [
    "component_numbers",
    "draw_mixture",
    "log_ratio",
    "numbers_of_chunk",
    "plain_chunk",
    "plain_parts",
    "random_numbers",
    "resample",
    "rows_of",
]


COMPONENTS = 2  # address of the numbers of an estimate that choose components
NORMALS = 3  # address of its normal numbers


def log_ratio(q: transform.Latent, z: np.ndarray, used: np.ndarray) -> np.ndarray:
    """log q - log p [n] of points ``z`` [n, D] over their first ``used`` numbers."""
    return log_sum(log_joint(q, z, used)) if len(z) else np.zeros(0)


def log_joint(q, z, used):
    """log of weight_k q_k over p [n, K]."""
    z = np.asarray(z, q.means.dtype)
    return transform.log_ratios(q, z, np.asarray(used)) + np.asarray(q.log_weights, np.float64)


def draw_mixture(
    sim: Simulator, q: transform.Latent, u: np.ndarray, e: np.ndarray
) -> tuple[np.ndarray, transform.Outcomes, np.ndarray, np.ndarray]:
    """Episodes of ``q`` by uniform numbers ``u`` [n] and normal ones ``e`` [n, D]: z, `Outcomes`,
    log p - log q, log shares of the components [n, K]. On the host.
    """
    z = transform.place(q, u, e)
    o = evaluate_points(sim, z)
    log_q, shares = with_log_shares(log_joint(q, z, o.used))
    return z, o, -log_q, shares


def random_numbers(key, n, d, dtype):
    """Uniform [n] and normal [n, d] numbers for `draw_mixture`; ``key``: of JAX, or a NumPy
    generator.
    """
    rng = numpy_generator(key)
    return rng.random(n).astype(dtype), rng.standard_normal((n, d)).astype(dtype)


def numbers_of_chunk(key, i, n, q):
    """The `random_numbers` of the first ``n`` draws of chunk ``i`` of an estimate by ``q``."""
    d, dtype = q.means.shape[1], q.means.dtype
    e = numpy_generator(key, NORMALS, i).standard_normal((n, d)).astype(dtype)
    return component_numbers(key, i, n, dtype), e


def component_numbers(key, i, n, dtype):
    """The uniform numbers that choose the components of the first ``n`` draws of chunk ``i``."""
    return numpy_generator(key, COMPONENTS, i).random(n).astype(dtype)


def plain_chunk(key, i, n, sim):
    """The first ``n`` points [n, D] of chunk ``i`` of the model itself."""
    return np.concatenate([np.asarray(z) for z in plain_parts(key, i, n, sim)])[:n]


def plain_parts(key, i, n, sim):
    """The same in parts [`rows_of`, D] on the device, of which the last has more than are asked
    for.
    """
    d, dtype, m = transform.dimension(sim), transform.normal_numbers(sim), rows_of(sim)
    for j in range(-(-n // m)):
        yield _normals(counter_key(key, NORMALS, i, j), m, d, dtype)


@partial(jax.jit, static_argnums=(1, 2, 3))
def _normals(key, n, d, dtype):
    return fine_draws.normal(key, (n, d), dtype)


def rows_of(sim):
    """Points that are drawn, and judged, by one call of a program."""
    return lanes_of(transform.dimension(sim))


def resample(log_w: np.ndarray, size: int, shift: float) -> np.ndarray:
    """Rows [size], each as often as its weight asks, to within one, by the comb of ``shift`` in
    [0, 1) (systematic resampling, Carpenter, Clifford and Fearnhead 1999). On the host.
    """
    w = np.exp(log_w - log_w.max())
    at = (np.arange(size) + shift) / size
    return np.searchsorted(np.cumsum(w) / w.sum(), at).clip(max=len(w) - 1)
