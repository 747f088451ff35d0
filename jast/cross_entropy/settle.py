"""From what a user gives to a `Plan`: modes, checks, and errors that name what is wrong."""

import jax
import jax.numpy as jnp

from jast.cross_entropy.gaussian import as_gaussian
from jast.cross_entropy.gaussian_process import KERNELS
from jast.cross_entropy.loop import Plan, Settings
from jast.cross_entropy.mixture import Mixture
from jast.cross_entropy.schedules import counts
from jast.cross_entropy.surrogates import SURROGATES, WARPS
from jast.rewards import as_pytree

__all__ = ["MODES", "checked", "settled"]

_MODEL = dict(surrogate="gaussian process", kernel="squared exponential")
_THESIS = dict(elitism=False, memory=3, best=0, evaluated=0.0, current=False, warp="raw", frame="initial", regularisation=0.0) | _MODEL
_DEFAULT = dict(elitism=True, memory=3, best=10, evaluated=0.1, current=True, warp="rank", frame="window", regularisation=1e-6) | _MODEL
MODES = {
    "ce_method": {"thesis": dict(elitism=False), "default": dict(elitism=True)},
    "ce_surrogate": {"thesis": _THESIS, "default": _DEFAULT},
    "ce_mixture": {"thesis": _THESIS | dict(start="searches"), "default": _DEFAULT | dict(start="elites")},
}
"""What each method does where the user does not say."""


def settled(method, proposal, *, samples, elites, iterations, schedule, mode, ratchet=False, components=None, alpha=1.0, **chosen):
    """``(Plan, Settings, proposal)`` of ``method``; ``chosen``: the settings of `MODES`, None where the mode's serves."""
    if mode not in MODES[method]:
        raise ValueError(f"{method}: mode must be one of {sorted(MODES[method])}, received {mode!r}")
    chosen = {name: chosen.pop(name) if chosen.get(name) is not None else value for name, value in MODES[method][mode].items()}
    sizes = tuple(n for n in counts(schedule, samples, iterations) if n)  # an iteration without evaluations teaches nothing
    elites = _whole(method, "elites", elites, 1)
    if elites > max(sizes):
        raise ValueError(f"{method}: elites must be at most the samples of an iteration, {max(sizes)}, received {elites}")
    kept = [min(elites, n) for n in sizes]
    if ratchet:
        kept = [min(kept[: i + 1]) for i in range(len(kept))]
    settings = Settings(*(_positive(method, name, value) for name, value in dict(alpha=alpha, regularisation=chosen.pop("regularisation", 0.0)).items()))
    for name, allowed in dict(surrogate=SURROGATES, kernel=KERNELS, warp=WARPS, frame=("initial", "window"), start=("elites", "searches")).items():
        if name in chosen and chosen[name] not in allowed:
            raise ValueError(f"{method}: {name} must be one of {list(allowed)}, received {chosen[name]!r}")
    if method != "ce_method":
        share = chosen["evaluated"]
        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share <= 0.5:
            raise ValueError(f"{method}: evaluated must be a share from 0 to 0.5, received {share!r}")
        chosen["evaluated"] = min(-int(-share * max(sizes) // 1), max(kept), max(sizes) // 2)  # rounded up
        chosen["memory"], chosen["best"] = _whole(method, "memory", chosen["memory"], 1), _whole(method, "best", chosen["best"], 0)
        if chosen["surrogate"] != "gaussian process":
            chosen["kernel"] = ""
    proposal = _start(method, proposal, max(kept), components)
    if method == "ce_mixture":
        chosen["components"] = len(proposal.weights)
    plan = Plan(method, sizes, tuple(kept), **chosen)
    dtype = jax.tree.leaves(proposal)[0].dtype
    return plan, jax.tree.map(lambda v: jnp.asarray(v).astype(dtype), settings), proposal


def checked(method, objective, d, dtype):
    """``objective`` as a pytree, once it is a function [d] -> scalar that JAX can trace."""
    if not callable(objective):
        raise ValueError(f"{method}: objective must be a function x [{d}] -> scalar, received {objective!r}")
    objective = as_pytree(objective)
    try:
        out = jax.eval_shape(objective, jax.ShapeDtypeStruct((d,), dtype))
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        raise ValueError(f"{method}: objective must be written in JAX; for any other program use start, ask and tell. It raised: {error}") from error
    leaves = jax.tree.leaves(out)
    if len(leaves) != 1 or leaves[0].shape != () or leaves[0].dtype == bool or jnp.issubdtype(leaves[0].dtype, jnp.complexfloating):
        raise ValueError(f"{method}: objective must return one real number for x of shape ({d},), it returns {out}")
    return objective


def _start(method, proposal, elites, components):
    """The first proposal; of a mixture, ``components`` equal ones where one is given."""
    if method != "ce_mixture":
        return as_gaussian(proposal)
    if isinstance(proposal, Mixture):
        k = len(proposal.weights)
        if components not in (None, k):
            raise ValueError(f"{method}: components must be those of the proposal, {k}, received {components!r}")
    else:
        g, k = as_gaussian(proposal), elites if components is None else _whole(method, "components", components, 1)
        d = g.mean.size
        proposal = Mixture(jnp.full((k,), 1 / k, g.mean.dtype), jnp.broadcast_to(g.mean[None], (k, d)), jnp.broadcast_to(g.covariance[None], (k, d, d)))
    if k > elites:
        raise ValueError(f"{method}: components must be at most the elites, {elites}, as each begins at one, received {k}")
    return proposal


def _whole(method, name, value, least):
    if isinstance(value, bool) or not hasattr(value, "__index__") or int(value) < least:
        raise ValueError(f"{method}: {name} must be a whole number of at least {least}, received {value!r}")
    return int(value)


def _positive(method, name, value):
    low = 0 if name == "regularisation" else None
    if not isinstance(value, jax.core.Tracer):
        if jnp.shape(value) != () or isinstance(value, str) or not (value >= 0 if low == 0 else value > 0):
            raise ValueError(f"{method}: {name} must be a number {'of at least' if low == 0 else 'above'} 0, received {value!r}")
    return value
