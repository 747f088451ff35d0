"""How many evaluations a call is given, by what they cost: the rate of a system is measured, and
the budget that follows from it is named, so that the same call can be made again.
"""

import math
import time
from typing import Any

import jax
import numpy as np

from jast import limit_state as latent
from jast.counter import numpy_generator
from jast.estimate.population import episodes_a_second
from jast.incidents import runs_on_host
from jast.judge import judged
from jast.simulator import Simulator

__all__ = ["CHEAP", "DEAR", "SECONDS", "budget_of", "cheap"]

SECONDS = 8.0
"""CPU seconds of simulation that a call takes by default; the rest of ten is compilation."""
CHEAP = 300_000
"""Evaluations from which populations answer sooner than a proposal that is found with few."""
MOST = 2**25
"""Evaluations by default at most: static problems of few numbers are then answered within 3 % down
to 1e-9, in seconds."""
DEAR = 100_000
"""Evaluations by default of a system that does not simulate `CHEAP` in `SECONDS`."""


def cheap(sim: Simulator, budget: int) -> bool:
    """Whether so many evaluations of a system are spent by populations."""
    return budget >= CHEAP and not runs_on_host(sim)


def budget_of(
    name: str, key: jax.Array, sim: Simulator, seconds: float | None, least: int, dear: int = DEAR
) -> int:
    """Evaluations for the ``seconds`` of a call (None: as many as a cheap system simulates in
    `SECONDS`, ``dear`` of others), at least ``least``.

    They are 2^k or 3 2^k, so that two calls on one machine mostly agree.

    Raises:
        ValueError: for ``seconds`` that are not a number above 0.
    """
    if seconds is None:
        if runs_on_host(sim):
            return dear
        budget = min(_rounded(SECONDS * episodes_a_second(key, sim)), MOST)
        return budget if budget >= CHEAP else dear
    real = isinstance(seconds, int | float | np.number) and not isinstance(seconds, bool)
    if not real or not 0 < float(seconds) < math.inf:
        raise ValueError(f"{name}: seconds must be a number above 0, received {seconds!r}")
    rate = _rate_on_host(key, sim) if runs_on_host(sim) else episodes_a_second(key, sim)
    return max(_rounded(float(seconds) * rate), least)


def given(name: str, budget: Any, seconds: Any) -> None:
    """ValueError where both are given."""
    if budget is not None and seconds is not None:
        raise ValueError(
            f"{name}: give budget or seconds, received budget={budget!r} and seconds={seconds!r}"
        )


def _rounded(evaluations: float) -> int:
    power = 2 ** int(math.log2(max(evaluations, 2)))
    return power * 3 // 2 if evaluations >= 1.5 * power else power


def _rate_on_host(key: jax.Array, sim: Simulator) -> float:
    """Episodes a second of a system that is not in JAX, by as many as take a fifth of one."""
    n, rng = 1, numpy_generator(key, 6)
    while True:
        z = rng.standard_normal((n, latent.dimension(sim))).astype(latent.normal_numbers(sim))
        begun = time.perf_counter()
        judged(sim, z)
        spent = time.perf_counter() - begun
        if spent > 0.2 or n >= 1024:
            return n / max(spent, 1e-9)
        n *= 4
