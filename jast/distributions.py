"""Distributions of disturbances: the usual families, and what stress testing needs beside them.

A disturbance model returns any object with ``sample(seed=key)``, ``log_prob(x)`` and, where it
exists, ``mode()``: those made here are light; distrax's are accepted wherever a distribution is,
and each of its names is found here, too (``jast.distributions.Transformed``): it is loaded then.
Frozen distributions of scipy.stats are taken as those of the same law here, where there is one, and
NumPyro's likewise or by their own quantile functions.

What a search and a proposal ask of a distribution (`quantile`, `cdf`, `from_normal`, `to_normal`,
`mode`, `tilted`) stands in a table, one row a family: `register` adds a user's own.
"""

import importlib
import sys
from typing import Any

from jast._src.distributions.base import Distribution, is_distribution
from jast._src.distributions.containers import Independent, Joint
from jast._src.distributions.continuous import Beta, Gamma, Laplace, Logistic, Uniform
from jast._src.distributions.counts import Binomial, Geometric, Poisson, TiltedCounts
from jast._src.distributions.discrete import Bernoulli, Categorical
from jast._src.distributions.family_table import register
from jast._src.distributions.normal import MultivariateNormalDiag, MultivariateNormalTri, Normal
from jast._src.distributions.normal_tails import float_dtype, fraction, phi
from jast._src.distributions.numerically_inverted import MixtureSameFamily, StudentT
from jast._src.distributions.operations import (
    cdf,
    event_like,
    from_normal,
    has_cdf,
    has_exact_tails,
    has_mode,
    has_quantile,
    log_density,
    log_mode,
    mode,
    quantile,
    sample,
    sum_parts,
    to_normal,
)
from jast._src.distributions.skewed import Exponential, Gumbel, LogNormal, TruncatedNormal, Weibull
from jast._src.distributions.special import (
    Deterministic,
    Fixed,
    Seeds,
    Tent,
    Where,
    seeds,
    tent,
    where,
)
from jast._src.distributions.tilted import Tilted, tilted, untiltable

__all__ = [
    "Bernoulli",
    "Beta",
    "Binomial",
    "Categorical",
    "Deterministic",
    "Distribution",
    "Exponential",
    "Fixed",
    "Gamma",
    "Geometric",
    "Gumbel",
    "Independent",
    "Joint",
    "Laplace",
    "LogNormal",
    "Logistic",
    "MixtureSameFamily",
    "MultivariateNormalDiag",
    "MultivariateNormalTri",
    "Normal",
    "Poisson",
    "Seeds",
    "StudentT",
    "Tent",
    "Tilted",
    "TiltedCounts",
    "Transformed",  # noqa: F822  (distrax's, by __getattr__)
    "TruncatedNormal",
    "Uniform",
    "Weibull",
    "Where",
    "cdf",
    "event_like",
    "float_dtype",
    "fraction",
    "from_normal",
    "has_cdf",
    "has_exact_tails",
    "has_mode",
    "has_quantile",
    "is_distribution",
    "log_density",
    "log_mode",
    "mode",
    "phi",
    "quantile",
    "register",
    "sample",
    "seeds",
    "sum_parts",
    "tent",
    "tilted",
    "to_normal",
    "untiltable",
    "where",
]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    """distrax's ``name``."""
    if not name.startswith("_"):
        distrax = importlib.import_module("jast._src.distributions.distrax_loader").distrax
        if hasattr(distrax, name):
            setattr(sys.modules[__name__], name, getattr(distrax, name))
            return getattr(distrax, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
