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
_THESIS = (
    dict(elitism=False, memory=3, best=0, evaluated=0.0, current=False, warp="raw", frame="initial", optimism=0.0, selection="elites", regularisation=0.0)
    | _MODEL
)
_DEFAULT = (
    dict(elitism=True, memory=3, best=10, evaluated=0.1, current=True, warp="rank", frame="window", optimism=1.0, selection="dimension", regularisation=1e-6)
    | _MODEL
)
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
    if unknown := sorted(set(chosen) - set(MODES[method][mode])):
        raise ValueError(f"{method}: no setting {', '.join(unknown)}; there are {sorted(MODES[method][mode])}")
    chosen = {name: value if chosen.get(name) is None else chosen[name] for name, value in MODES[method][mode].items()}
    sizes = tuple(n for n in counts(schedule, samples, iterations) if n)  # an iteration without evaluations teaches nothing
    elites = _whole(method, "elites", elites, 1)
    if elites > max(sizes):
        raise ValueError(f"{method}: elites must be at most the samples of an iteration, {max(sizes)}, received {elites}")
    kept = [min(elites, n) for n in sizes]
    if ratchet:
        kept = [min(kept[: i + 1]) for i in range(len(kept))]
    real = dict(alpha=alpha) | {name: chosen.pop(name, 0.0) for name in ("optimism", "regularisation")}
    settings = Settings(**{name: _number(method, name, value) for name, value in real.items()})
    for name, allowed in dict(surrogate=SURROGATES, kernel=KERNELS, warp=WARPS, frame=("initial", "window"), start=("elites", "searches")).items():
        if name in chosen and chosen[name] not in allowed:
            raise ValueError(f"{method}: {name} must be one of {list(allowed)}, received {chosen[name]!r}")
    proposal = _start(method, proposal, max(kept), components)
    d = jax.tree.leaves(proposal)[1].shape[-1]
    if method != "ce_method":
        share = chosen["evaluated"]
        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share <= 0.5:
            raise ValueError(f"{method}: evaluated must be a share from 0 to 0.5, received {share!r}")
        chosen["evaluated"] = min(-int(-share * max(sizes) // 1), max(kept), max(sizes) // 2)  # rounded up
        chosen["memory"], chosen["best"] = _whole(method, "memory", chosen["memory"], 1), _whole(method, "best", chosen["best"], 0)
        chosen["optimistic"] = isinstance(settings.optimism, jax.core.Tracer) or bool(settings.optimism != 0)
        shares = _selection(method, chosen.pop("selection"), sizes, kept, d)
        chosen["chosen"] = tuple(max(1, round(share * Plan._field_defaults["factor"] * n)) for share, n in zip(shares, sizes, strict=True))
        if chosen["surrogate"] != "gaussian process":
            chosen["kernel"] = ""
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


def _selection(method, given, sizes, kept, d):
    """The share of judged samples that are elites, in each iteration: a number, that of the evaluated ones, or at most one in d.

    One in d, as a share of s shrinks a Gaussian of d dimensions by about s^(1/d) a side: by half the samples, ten dimensions would take ten iterations to halve.
    """
    if given in ("elites", "dimension"):
        return [min(e / n, 1.0 if given == "elites" else 1 / d) for n, e in zip(sizes, kept, strict=True)]
    if isinstance(given, bool) or not isinstance(given, int | float) or not 0 < given <= 1:
        raise ValueError(f'{method}: selection must be "elites", "dimension", or a share above 0, at most 1, received {given!r}')
    return [given] * len(sizes)


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


def _number(method, name, value):
    """``value``, if it is traced or a number: above 0 (alpha), or of at least 0."""
    good = isinstance(value, jax.core.Tracer) or (
        not isinstance(value, str | bool) and jnp.shape(value) == () and (value > 0 if name == "alpha" else value >= 0) and value < jnp.inf
    )
    if not good:
        raise ValueError(f"{method}: {name} must be a number {'above' if name == 'alpha' else 'of at least'} 0, received {value!r}")
    return value
