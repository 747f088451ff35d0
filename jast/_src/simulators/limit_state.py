"""Limit states: the static problems of structural reliability, P(g(x) <= 0) for x ~ N(0, I_d), as
simulators of one step.

Known truths: hyperplane g = 5 - x.e, abs(e) = 1, any d: Phi(-5) = 2.8665157188e-7; four branches (p
= 7, k = 3, d = 2), g = min of k + .1 (x1 - x2)^2 -+ (x1 + x2) / sqrt 2 and +-(x1 - x2) + p / sqrt
2: 2.2227950662e-3; g = max(3.5 - x1, 3.5 - x2): Phi(-3.5)^2 = 5.4116288413e-8.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array
from jast._src.util.checks import wrong
from jast._src.util.pytrees import as_partial
from jast.distributions import MultivariateNormalDiag

__all__ = ["limit_state"]


def limit_state(g: Callable[[Any], Array], dimension: int) -> Simulator:
    """A limit state function as an episodic `Simulator` of one step, x ~ N(0, I) [dimension]: a
    failure where g(x) <= 0, miss distance max(g(x), 0).

    ``observe`` shows the first 64 coordinates.

    Args:
        g: [dimension] -> float scalar. A plain function is static by identity; what a
            `jax.tree_util.Partial` binds is traced.
        dimension: of x.

    Raises:
        ValueError: for a dimension below 1, and a ``g`` that is no function or does not return a
            float scalar.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.limit_state(lambda x: 3.0 - x[0] - x[1], 2)
        >>> bool(jast.replay(sim, jnp.array([[2.0, 2.0]])).failure)
        True
    """
    if isinstance(dimension, bool) or not isinstance(dimension, int) or dimension < 1:
        raise wrong("limit_state", "dimension", "be an int of at least 1", f"{dimension!r}")
    if not callable(g):
        raise ValueError(f"limit_state: g must be a function, received {g!r}")
    g = as_partial(g)
    origin = jnp.zeros((dimension,))
    try:
        value = jax.eval_shape(lambda: g(origin))
        received = f"{value.dtype}{list(value.shape)}"
    except AttributeError:
        received = repr(value)
    except Exception as e:
        raise ValueError(
            f"limit_state: g raised {type(e).__name__} on a vector of {dimension} numbers: {e}"
        ) from e
    if received not in (f"{d}[]" for d in ("float16", "bfloat16", "float32", "float64")):
        raise ValueError(f"limit_state: g must return a float scalar, received {received}")
    return Simulator(
        init=Partial(_init, origin),
        step=_step,
        disturbance=_disturbance,
        evaluate=Partial(_evaluate, g),
        horizon=1,
        observe=_observe,
        episodic=True,
    )


def _init(origin, x0):
    return origin


def _step(s, x):
    return x


def _disturbance(s):
    return MultivariateNormalDiag(jnp.zeros_like(s), jnp.ones_like(s))


def _evaluate(g, s):
    value = g(s)
    return value <= 0, jnp.maximum(value, 0)


def _observe(s):
    return s[:64]
