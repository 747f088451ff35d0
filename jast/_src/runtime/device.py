"""What the device that programs run on asks of their shapes."""

import contextlib
import time

import jax

__all__ = ["BLOCK", "block_size", "on_cpu", "read_clock", "where_few_points_run"]

BLOCK = 128
"""Episodes that a core of a CPU runs side by side: their numbers then stay in its caches."""


def on_cpu() -> bool:
    """Whether programs run on a CPU, where their arguments do not say otherwise; else on an
    accelerator.
    """
    device = jax.config.jax_default_device
    return getattr(device, "platform", device or jax.default_backend()) == "cpu"


def block_size(n: int) -> int:
    """How many of ``n`` episodes run side by side: a `BLOCK` of them on a CPU, and all on an
    accelerator, which has a thread for each.
    """
    return min(BLOCK, n) if on_cpu() else n


def read_clock() -> float:
    """The seconds that work is measured in: of this process on a CPU, where others may run beside
    it; on an accelerator those of the clock on the wall.
    """
    return time.process_time() if on_cpu() else time.perf_counter()


def where_few_points_run() -> contextlib.AbstractContextManager:
    """A context in which programs run on the CPU of the machine, if JAX was not told to do without
    it: a hundred points that move often are not faster on an accelerator, which starts a kernel for
    each operation of each step.
    """
    if on_cpu():
        return contextlib.nullcontext()
    try:
        return jax.default_device(jax.devices("cpu")[0])
    except RuntimeError:  # JAX_PLATFORMS names the accelerator alone
        return contextlib.nullcontext()
