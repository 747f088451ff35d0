"""Real-valued parameters of the simulators, as arrays that are traced."""

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["positive"]


def positive(function, **values):
    """Scalar float arrays of one dtype; ValueError naming ``function`` and the argument unless positive (not looked at while traced)."""
    arrays = {name: jnp.asarray(value) for name, value in values.items()}
    floats = [a.dtype for a in arrays.values() if jnp.issubdtype(a.dtype, jnp.floating)]
    dtype = jnp.result_type(*floats) if floats else jnp.zeros(()).dtype
    for name, a in arrays.items():
        if a.shape != () or not (isinstance(a, jax.core.Tracer) or np.asarray(a) > 0):
            raise ValueError(f"{function}: {name} must be a positive number, received {values[name]!r}")
    return [a.astype(dtype) for a in arrays.values()]
