"""Frozen distributions of scipy.stats, and those of NumPyro, as disturbances. Each becomes that of
jast with the same law; where there is none, NumPyro's own serve by their quantile functions, as JAX
can trace them. Neither library is imported.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jast._src.core.typing import PRNGKey
from jast._src.distributions import (
    continuous,
    counts,
    discrete,
    normal,
    numerically_inverted,
    skewed,
)
from jast._src.distributions.base import Wrapped
from jast._src.distributions.operations import no_quantile
from jast._src.runtime._jax import is_traced
from jast._src.util.checks import wrong

__all__ = ["translate"]


def translate(d: Any, independent: Callable[[Any, int], Any]) -> Any:
    """``d`` as a distribution of jast where it is one of scipy.stats or of NumPyro, else itself.

    Args:
        d: anything.
        independent: makes jast's `Independent`, of a distribution of NumPyro and a number of axes.

    Raises:
        ValueError: for one of scipy.stats that jast has no family for.
    """
    if type(d).__module__.startswith("scipy.stats."):
        return _of_scipy(d)
    theirs = [c.__name__ for c in type(d).__mro__ if c.__module__.partition(".")[0] == "numpyro"]
    if "Distribution" not in theirs:
        return d
    if theirs[0] == "Independent":
        return independent(d.base_dist, d.reinterpreted_batch_ndims)
    return OF_NUMPYRO.get(theirs[0], NumPyro)(d)


class NumPyro(Wrapped):
    """A distribution of NumPyro that jast has no family for."""

    @property
    def name(self) -> str:
        return type(self._distribution).__name__

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return self._distribution.sample(key, (n,))

    def quantile(self, u: Any) -> Any:
        try:
            return self._distribution.icdf(u)
        except NotImplementedError:
            raise no_quantile(self._distribution) from None

    def cdf(self, value: Any) -> Any:
        return self._distribution.cdf(value)


def _of_scipy(d: Any) -> Any:
    name = getattr(getattr(d, "dist", None), "name", type(d).__name__)
    if name not in OF_SCIPY:
        raise ValueError(
            f"scipy.stats.{name} has no counterpart that JAX can trace: expected one of"
            f" jast.distributions, or of scipy.stats one of {', '.join(OF_SCIPY)}"
        )
    shapes = [s.strip() for s in (d.dist.shapes or "").split(",") if s.strip()]
    given = {"loc": 0.0, "scale": 1.0} | dict(zip([*shapes, "loc", "scale"], d.args)) | d.kwds
    for parameter in ("loc", "scale") if name == "beta" else ("loc",) if name in AT_0 else ():
        fixed = 0.0 if parameter == "loc" else 1.0
        if is_traced(given[parameter]) or np.any(given[parameter] != fixed):
            received = f"{given[parameter]}: move or stretch its value in step"
            raise wrong(f"scipy.stats.{name}", parameter, f"be {fixed:g} here", received)
    # plain numbers stay plain: tables serve them
    values = map(given.get, (*shapes, "loc", "scale"))
    return OF_SCIPY[name](*(v if np.ndim(v) == 0 else jnp.asarray(v) for v in values))


OF_SCIPY: dict[str, Callable[..., Any]] = {
    "bernoulli": lambda p, loc, scale: discrete.Bernoulli(probs=p),
    "beta": lambda a, b, loc, scale: continuous.Beta(a, b),
    "binom": lambda n, p, loc, scale: counts.Binomial(n, p),
    "chi2": lambda df, loc, scale: continuous.Gamma(df / 2, 0.5 / scale),
    "expon": lambda loc, scale: skewed.Exponential(1 / scale),
    "gamma": lambda a, loc, scale: continuous.Gamma(a, 1 / scale),
    "gumbel_r": skewed.Gumbel,
    "laplace": continuous.Laplace,
    "logistic": continuous.Logistic,
    "lognorm": lambda s, loc, scale: skewed.LogNormal(jnp.log(scale), s),
    "norm": normal.Normal,
    "poisson": lambda mu, loc, scale: counts.Poisson(mu),
    "t": numerically_inverted.StudentT,
    "truncnorm": lambda a, b, loc, scale: skewed.TruncatedNormal(
        loc, scale, loc + a * scale, loc + b * scale
    ),
    "uniform": lambda loc, scale: continuous.Uniform(loc, loc + scale),
    "weibull_min": lambda c, loc, scale: skewed.Weibull(c, scale),
}
"""Name -> jast's, of the shape parameters, loc and scale."""
AT_0 = ("bernoulli", "beta", "binom", "chi2", "expon", "gamma", "lognorm", "poisson", "weibull_min")
"""Those whose support begins at 0."""


def _of(family: Callable[..., Any], *names: str) -> Callable[[Any], Any]:
    return lambda d: family(*(getattr(d, name) for name in names))


OF_NUMPYRO: dict[str, Callable[[Any], Any]] = {
    "BernoulliLogits": lambda d: discrete.Bernoulli(logits=d.logits),
    "BernoulliProbs": lambda d: discrete.Bernoulli(probs=d.probs),
    "Beta": _of(continuous.Beta, "concentration1", "concentration0"),
    "BinomialProbs": _of(counts.Binomial, "total_count", "probs"),
    "CategoricalLogits": lambda d: discrete.Categorical(logits=d.logits),
    "CategoricalProbs": lambda d: discrete.Categorical(probs=d.probs),
    "Exponential": _of(skewed.Exponential, "rate"),
    "Gamma": _of(continuous.Gamma, "concentration", "rate"),
    "GeometricProbs": _of(counts.Geometric, "probs"),
    "Gumbel": _of(skewed.Gumbel, "loc", "scale"),
    "Laplace": _of(continuous.Laplace, "loc", "scale"),
    "LogNormal": _of(skewed.LogNormal, "loc", "scale"),
    "Logistic": _of(continuous.Logistic, "loc", "scale"),
    "MultivariateNormal": _of(normal.MultivariateNormalTri, "loc", "scale_tril"),
    "Normal": _of(normal.Normal, "loc", "scale"),
    "Poisson": _of(counts.Poisson, "rate"),
    "StudentT": _of(numerically_inverted.StudentT, "df", "loc", "scale"),
    "Uniform": _of(continuous.Uniform, "low", "high"),
    "Weibull": _of(skewed.Weibull, "concentration", "scale"),
}
"""Name -> jast's."""
