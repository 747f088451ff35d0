"""Real-valued parameters of the simulators, as arrays that are traced."""

import jax.numpy as jnp
import numpy as np

from jast._src.runtime._jax import is_traced

__all__ = ["positive"]


def positive(function, **values):
    """Scalar float arrays of one dtype; ValueError naming ``function`` and the argument unless
    positive and finite (not looked at while traced).
    """
    for name, value in values.items():
        if not (value.shape == () if is_traced(value) else _is_positive(value)):
            raise ValueError(f"{function}: {name} must be a positive number, received {value!r}")
    arrays = [jnp.asarray(value) for value in values.values()]
    floats = [a.dtype for a in arrays if jnp.issubdtype(a.dtype, jnp.floating)]
    dtype = jnp.result_type(*floats) if floats else jnp.zeros(()).dtype
    return [a.astype(dtype) for a in arrays]


def _is_positive(value):
    try:
        a = np.asarray(value)
    except ValueError:  # rows of different lengths
        return False
    return (
        a.shape == ()
        and (jnp.issubdtype(a.dtype, jnp.floating) or jnp.issubdtype(a.dtype, jnp.integer))
        and bool(0 < a < np.inf)
    )
