"""CMA-ES (the package cma, of the extra `benchmark`), asked and told: one driver for all tables."""

from collections.abc import Callable

import numpy as np

__all__ = ["Stop", "cma_es"]


class Stop(Exception):
    """Raised by a function that is being searched: that is enough."""


def cma_es(
    rng: np.random.Generator,
    evaluate: Callable[[np.ndarray], np.ndarray],
    mean: np.ndarray,
    sd: np.ndarray,
    again: Callable[[], np.ndarray],
    **options,
) -> None:
    """Search until ``evaluate`` raises `Stop`: from ``mean`` first, and from ``again()`` whenever
    the search has converged.

    Args:
        rng: all randomness.
        evaluate: points [n, D] -> values [n], smaller is better.
        mean: [D], where it starts.
        sd: [D], how wide.
        again: where it starts anew.
        options: of the package, such as ``popsize``; its default is 4 + 3 ln D.
    """
    import cma

    options = {
        "CMA_stds": list(sd),
        "verbose": -9,
        "verb_log": 0,
        "seed": np.nan,
        "randn": lambda *shape: rng.standard_normal(shape),
    } | options
    start = mean
    try:
        while True:
            es = cma.CMAEvolutionStrategy(start, 1.0, options)
            while not es.stop():
                points = es.ask()
                es.tell(points, list(evaluate(np.array(points))))
            start = again()
    except Stop:
        return
