"""Running work in a thread of its own, with the settings of JAX of the one that it is
started from.
"""

import concurrent.futures
import contextlib

import jax


def handed_on():
    """A context manager's maker: in another thread it sets what ``with`` statements have set in
    this one, which JAX keeps for each thread apart.
    """
    config = jax.config
    settings = (
        (jax.enable_x64, config.jax_enable_x64),
        (jax.default_device, config.jax_default_device),
        (jax.default_matmul_precision, config.jax_default_matmul_precision),
        (jax.numpy_dtype_promotion, config.jax_numpy_dtype_promotion),
        (jax.numpy_rank_promotion, config.jax_numpy_rank_promotion),
        (jax.debug_nans, config.jax_debug_nans),
    )

    @contextlib.contextmanager
    def surroundings():
        with contextlib.ExitStack() as stack:
            for setting, value in settings:
                stack.enter_context(setting(value))
            yield

    return surroundings


def apart(function, *args):
    """``function(*args)`` in another thread. A KeyboardInterrupt meets this one, which waits for
    it: not a callback in the middle of a program of XLA's.
    """
    surroundings = handed_on()

    def run():
        with surroundings():
            return function(*args)

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        return pool.submit(run).result()
