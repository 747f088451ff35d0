"""Running work in a thread of its own, with the settings of JAX of the one that it is
started from.
"""

import concurrent.futures
import contextlib
from collections.abc import Iterator
from typing import Any

import jax

from jast._src.runtime._jax import briefly, is_brief

__all__ = ["run_in_thread", "current_settings", "jax_settings"]

SETTINGS = {
    "jax_enable_x64": jax.enable_x64,
    "jax_default_device": jax.default_device,
    "jax_default_matmul_precision": jax.default_matmul_precision,
    "jax_numpy_dtype_promotion": jax.numpy_dtype_promotion,
    "jax_numpy_rank_promotion": jax.numpy_rank_promotion,
    "jax_debug_nans": jax.debug_nans,
    "brief": briefly,
}
"""What ``with`` statements set, which JAX, and Python, keep for each thread apart."""


def current_settings() -> dict[str, Any]:
    """`SETTINGS` as they are in this thread."""
    of_jax = {name: getattr(jax.config, name) for name in SETTINGS if name != "brief"}
    return of_jax | {"brief": is_brief()}


@contextlib.contextmanager
def jax_settings(values: dict[str, Any]) -> Iterator[None]:
    """A context in which the settings have these ``values``."""
    with contextlib.ExitStack() as stack:
        for name, value in values.items():
            stack.enter_context(SETTINGS[name](value))
        yield


def run_in_thread(function, *args):
    """``function(*args)`` in another thread. A KeyboardInterrupt meets this one, which waits for
    it: not a callback in the middle of a program of XLA's.
    """
    now = current_settings()

    def run():
        with jax_settings(now):
            return function(*args)

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        return pool.submit(run).result()
