"""The selectors by name."""

from __future__ import annotations

import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.util.checks import whole_number
from jast._src.weakness.default_selector import default
from jast._src.weakness.selector_contract import Selector, Step
from jast._src.weakness.thesis_selector import thesis

__all__ = ["NAMES", "default", "random", "thesis"]


def random(*, batch: int | None = None) -> Selector:
    """Inputs in random order: the baseline, whose failure rate is unbiased.

    Args:
        batch: inputs at once. Default: a tenth of those not yet run, at least 10.

    Example:
        >>> import jast
        >>> jast.weakness.random(batch=5).settings
        {'batch': 5}
    """
    batch = batch if batch is None else whole_number("random", "batch", batch)

    def step(key, data, memory, seen, ask):
        free = np.flatnonzero(~seen.tried)
        size = max(10, len(free) // 10) if batch is None else batch
        chosen = numpy_generator(key).permutation(free)[:size]
        now = ask(chosen)
        rate = now.failed.sum() / max(len(now.order), 1)
        return Step(memory, np.full(data.size, 0.5), chosen, rate * (~now.tried).sum())

    return Selector("random", {"batch": batch}, lambda key, data: {}, step)


NAMES = {"default": default, "random": random, "thesis": thesis}
