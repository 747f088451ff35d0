"""What the cross-entropy methods return, and how runs are judged that know the optimum."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jast._src.core.typing import Array
from jast._src.cross_entropy.gaussian import Gaussian
from jast._src.cross_entropy.mixture import Mixture
from jast._src.util import display
from jast._src.util.checks import wrong

__all__ = ["CEResult", "History", "Scores", "scores", "standard_error"]


@display.printable()
class History(NamedTuple):
    """How it went. K iterations with ``n`` true evaluations in all; those of iteration k stand
    together, in order.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> found = ce.ce_method(jax.random.key(0), ce.paraboloid, ce.normal(jnp.ones(2), 4.0))
        >>> best = found.history.best_value
        >>> best.shape, bool((best[1:] <= best[:-1]).all())  # after each iteration
        ((10,), True)
    """

    x: Array
    """[n, d]: every point that was truly evaluated, in order"""
    value: Array
    """[n]: the objective there, NaN or infinite where it was"""
    iteration: Array
    """[n] int: from 0"""
    best_x: Array
    """[K, d]: the best point so far, after each iteration; NaN while there is none"""
    best_value: Array
    """[K]; inf while no value was finite"""
    proposals: Gaussian | Mixture
    """With a leading axis [K + 1]: that of each iteration, and the last"""
    model_x: Array
    """[K, m, d]: the points that the surrogate judged in each iteration; [K, 0, d] without one"""


@display.result_class("best_value", batches=True)
class CEResult(NamedTuple):
    """The outcome. With a leading axis everywhere after `jax.vmap`.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> found = ce.ce_method(jax.random.key(0), ce.paraboloid, ce.normal(jnp.ones(2), 4.0))
        >>> found.best_x.shape, bool(found.best_value < 0.1), found.episodes
        ((2,), True, 100)
    """

    proposal: Gaussian | Mixture
    """The last one"""
    best_x: Array
    """[d]: the point of the least finite value"""
    best_value: Array
    """That value: b_v"""
    history: History
    invalid: Array
    """int: evaluations that gave NaN or infinity; none of them was an elite"""

    @property
    def episodes(self) -> int:
        """Evaluations of the objective, of one run."""
        return np.shape(self.history.value)[-1]

    def __str__(self) -> str:
        value = np.asarray(self.best_value)
        bad = int(np.sum(self.invalid))
        note = f"\n{bad} evaluations gave NaN or infinity; they are never elites" if bad else ""
        if value.ndim == 0:
            done = ~np.isnan(self.history.x).any(axis=1)  # of a search that is not at its end
            evaluations = np.cumsum(np.bincount(self.history.iteration[done]))
            best = np.asarray(self.history.best_value), np.asarray(self.history.best_x)
            rows = zip(evaluations, *best, strict=False)
            table = "\n".join(
                f"{i:9d} {evaluations:11d} {b:14.6g}   {_point(x)}"
                for i, (evaluations, b, x) in enumerate(rows, 1)
            )
            return f"iteration evaluations  best value   at\n{table}{note}"
        found = value[np.isfinite(value)]
        if found.size < value.size:
            note += (
                f"\n{value.size - found.size} runs found no finite value and are left out of the"
                " mean"
            )
        mean = f"{found.mean() if found.size else np.inf:.6g}" + (
            f" +- {found.std(ddof=1) / np.sqrt(found.size):.2g}" if found.size > 1 else ""
        )
        return (
            f"{value.size} runs of {self.episodes} evaluations: best value {mean} (mean and its"
            f" standard error), the best of them {value.min():.6g}{note}"
        )


def _point(x):
    shown = ", ".join(f"{v:.4g}" for v in x[:6])
    return f"({shown}{', ...' if x.size > 6 else ''})"


@display.printable()
class Scores(NamedTuple):
    """Of several runs, the means over them; distances are Euclidean, from the best point to the
    optimum.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> run = lambda key: ce.ce_method(key, ce.paraboloid, ce.normal(jnp.ones(2), 4.0))
        >>> told = ce.scores(jax.vmap(run)(jax.random.split(jax.random.key(0), 5)), jnp.zeros(2))
        >>> bool((told.rms_distance >= told.mean_distance).all())
        True
    """

    best_value: Array
    """b_v"""
    standard_error: Array
    """Of ``best_value``"""
    mean_distance: Array
    rms_distance: Array
    """Root of the mean squared distance"""
    frobenius: Array
    """sqrt(50) times ``rms_distance``: the size of the 2 x 50 matrix of errors of 50 runs, which
    the thesis's b_d most likely is
    """


def scores(result: CEResult, optimum: Array | None) -> Scores:
    """How good a batch of runs is after each iteration. On the host.

    Args:
        result: a `CEResult` with a leading axis [runs].
        optimum: [d]: where the objective is least.

    Returns:
        `Scores`: arrays [K], the last of which is the outcome.

    Raises:
        ValueError: for a result of one run, and an optimum of another dimension.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> run = lambda key: ce.ce_method(key, ce.paraboloid, ce.normal(jnp.ones(2), 4.0))
        >>> runs = jax.vmap(run)(jax.random.split(jax.random.key(0), 5))
        >>> len(ce.scores(runs, jnp.zeros(2)).best_value)
        10
    """
    x = np.asarray(result.history.best_x, float)
    value = np.asarray(result.history.best_value, float)
    if x.ndim != 3:
        must = "be a batch of runs, its history.best_x [runs, iterations, d]"
        raise wrong("scores", "result", must, x.shape)
    optimum = np.asarray(optimum, float)
    if optimum.shape != x.shape[2:]:
        raise ValueError(f"scores: optimum must be [{x.shape[2]}], received shape {optimum.shape}")
    distance = np.sqrt(np.sum((x - optimum) ** 2, axis=2))
    rms = np.sqrt(np.mean(distance**2, axis=0))
    error = standard_error(value)
    return Scores(value.mean(axis=0), error, distance.mean(axis=0), rms, np.sqrt(50) * rms)


def standard_error(rows):
    """[K]: of the mean over the runs of ``rows`` [runs, K]; NaN for one run."""
    if len(rows) == 1:
        return np.full(rows.shape[1], np.nan)
    return rows.std(axis=0, ddof=1) / np.sqrt(len(rows))
