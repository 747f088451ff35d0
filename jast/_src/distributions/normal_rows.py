"""The rows of the normal family, of the containers and of one of two classes; those of other
families are in `distrax_rows`. Each serves distrax's class of that name, too.
"""

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from jast._src.distributions import containers, normal, operations, special
from jast._src.distributions.base import tree_map
from jast._src.distributions.family_table import register, register_both
from jast._src.distributions.normal_tails import inside, ndtr, ndtri, standard
from jast._src.distributions.tilted import tilted


def _number_by_number(kind: Any, scale: Callable[[Any], Any]) -> dict[str, Callable[..., Any]]:
    """The functions of a row of numbers that are each scaled by themselves."""
    return dict(
        quantile=lambda d, u: d.loc + scale(d) * ndtri(inside(u)),
        cdf=lambda d, x: ndtr(standard(x - d.loc, scale(d))),
        from_normal=lambda d, z: d.loc + scale(d) * z,
        to_normal=lambda d, x: (x - d.loc) / scale(d),
        tilt=lambda d, m, s: kind(d.loc + scale(d) * m, scale(d) * s),
    )


for kind, name in ((normal.Normal, "scale"), (normal.MultivariateNormalDiag, "scale_diag")):
    register_both(kind, **_number_by_number(kind, attrgetter(name)))


def _cdf_tri(d, x):
    far = jnp.sqrt(jnp.finfo(d.loc.dtype).max)  # an infinite one would make others NaN
    return ndtr(solve_triangular(d.scale_tri, jnp.clip(x - d.loc, -far, far), lower=d.is_lower))


register_both(
    normal.MultivariateNormalTri,
    quantile=lambda d, u: d.loc + d.scale_tri @ ndtri(inside(u)),
    cdf=_cdf_tri,
    from_normal=lambda d, z: d.loc + d.scale_tri @ z,
    to_normal=lambda d, x: solve_triangular(d.scale_tri, x - d.loc, lower=d.is_lower),
    tilt=lambda d, m, s: normal.MultivariateNormalTri(
        d.loc + d.scale_tri @ m, d.scale_tri * s[None, :], is_lower=d.is_lower
    ),
)


# the containers


def _four_ways(of: Callable[..., Any]) -> dict[str, Callable[..., Any]]:
    """The functions of a row between values, the unit interval and normal numbers: ``of`` the verb
    that does it with a part.
    """
    names = "quantile", "cdf", "from_normal", "to_normal"
    return {name: of(getattr(operations, name)) for name in names}


def _summed(d, x):
    inner = operations.log_density(d.distribution, x, "mode")
    return inner.sum(range(inner.ndim - d.reinterpreted_batch_ndims, inner.ndim))


register_both(
    containers.Independent,
    **_four_ways(lambda verb: lambda d, value: verb(d.distribution, value)),
    mode=lambda d: operations.mode(d.distribution),
    log_prob_from_mode=_summed,
    tilt=lambda d, m, s: containers.Independent(
        tilted(d.distribution, m, s), d.reinterpreted_batch_ndims
    ),
    exact=lambda d: operations.has_exact_tails(d.distribution),
)


def _each(verb: Callable[..., Any]) -> Callable[..., Any]:
    return lambda d, *values: tree_map(verb, d.distributions, *values)


register_both(
    containers.Joint,
    **_four_ways(_each),
    mode=_each(operations.mode),
    log_mode=lambda d: operations.sum_parts(_each(operations.log_mode)(d)),
    log_prob_from_mode=lambda d, x: operations.sum_parts(
        tree_map(lambda e, v: operations.log_density(e, v, "mode"), d.distributions, x)
    ),
    tilt=lambda d, m, s: containers.Joint(tree_map(tilted, d.distributions, m, s)),
    exact=lambda d: all(operations.has_exact_tails(e) for e in containers.leaves(d.distributions)),
)


def _either(verb: Callable[..., Any]) -> Callable[..., Any]:
    return lambda d, x: d.select(*(verb(part, x) for part in d.parts))


register(
    special.Where,
    **_four_ways(_either),
    tilt=lambda d, m, s: special.Where(d.pred, *(tilted(part, m, s) for part in d.parts)),
    exact=lambda d: all(operations.has_exact_tails(part) for part in d.parts),
)

register(
    special.Fixed,
    **_four_ways(lambda verb: lambda d, value: ()),
    tilt=lambda d, m, s: d,
)
