"""From what a user gives to a `Plan`: modes, checks, and errors that name what is wrong."""

import math
from numbers import Real

import jax
import jax.numpy as jnp

from jast._src.core.rewards import as_pytree
from jast._src.cross_entropy.gaussian import as_gaussian
from jast._src.cross_entropy.iterate import Plan, Settings
from jast._src.cross_entropy.mixture import Mixture, as_mixture
from jast._src.cross_entropy.schedules import counts
from jast._src.cross_entropy.surrogates import KERNELS, RADIAL, SURROGATES, WARPS
from jast._src.runtime._jax import is_traced
from jast._src.util.checks import one_of, real_number, truth_value, whole_number, wrong

__all__ = ["MODES", "check_objective", "make_plan"]

PLAIN = dict(elitism=(False, True))  # of `ce_method`; a line as in `MIXTURE`
SURROGATE = PLAIN | dict(  # of `ce_surrogate`; "thesis" is the published code
    memory=(3, 3),
    best=(0, 10),
    evaluated=(0.0, 0.1),
    current=(False, True),
    warp=("raw", "rank"),
    frame=("initial", "window"),
    optimism=(0.0, 1.0),
    selection=("elites", "dimension"),
    surrogate=("gaussian process", "gaussian process"),
    kernel=("squared exponential", "squared exponential"),
    basis=("gaussian", "gaussian"),
    degree=(2, 2),
    alpha=(1.0, 1.0),
)
MIXTURE = SURROGATE | dict(
    components=(None, 2), start=("searches", "elites"), regularisation=(0.0, 0.0)
)
"""Setting -> (its value in mode "thesis", in mode "default")."""
MODES = {
    method: {
        mode: {name: values[i] for name, values in table.items()}
        for i, mode in enumerate(("thesis", "default"))
    }
    for method, table in dict(ce_method=PLAIN, ce_surrogate=SURROGATE, ce_mixture=MIXTURE).items()
}
"""What each method does where the user does not say; no ``components``: as many as elites."""


def make_plan(
    method, proposal, *, samples, elites, iterations, schedule, mode, ratchet=False, **given
):
    """``(Plan, Settings, proposal)`` of ``method``; ``given``: settings of `MODES`, None where the
    mode's serves. Raises ValueError, as the methods say.
    """
    one_of(method, "mode", mode, sorted(MODES[method]))
    if unknown := sorted(set(given) - set(MODES[method][mode])):
        raise ValueError(
            f"{method}: expected settings among {sorted(MODES[method][mode])}, received"
            f" {', '.join(unknown)}"
        )
    chosen = {
        name: value if given.get(name) is None else given[name]
        for name, value in MODES[method][mode].items()
    }
    if given.get("basis") is not None and given.get("surrogate") is None:
        chosen["surrogate"] = "radial basis"  # as in the thesis's call
    sizes = counts(schedule, samples, iterations)
    mean_size = max(1, round(sum(sizes) / len(sizes)))
    sizes = tuple(n for n in sizes if n)  # an iteration without evaluations teaches nothing
    elites = whole_number(method, "elites", elites, 1)
    if elites > max(sizes):
        must = f"be at most the number of samples in an iteration, {max(sizes)}"
        raise wrong(method, "elites", must, elites)
    kept = [min(elites, n) for n in sizes]
    if ratchet:
        kept = [min(kept[: i + 1]) for i in range(len(kept))]
    for name, allowed in dict(
        surrogate=SURROGATES,
        kernel=KERNELS,
        basis=RADIAL,
        warp=WARPS,
        frame=("initial", "window"),
        start=("elites", "searches"),
    ).items():
        if name in chosen:
            one_of(method, name, chosen[name], allowed)
    current = chosen.get("current", False)
    truth_value(method, elitism=chosen["elitism"], current=current, ratchet=ratchet)
    positive = (lambda v: 0 < v < math.inf), "above 0"
    other = (lambda v: 0 <= v < math.inf), "of at least 0"
    numbers = (
        real_number(method, "alpha", chosen.get("alpha", 1.0), *positive),
        real_number(method, "optimism", chosen.get("optimism", 0.0), *other),
        real_number(method, "regularisation", chosen.get("regularisation", 0.0), *other),
    )
    if method == "ce_mixture":
        proposal = _first_mixture(
            method, proposal, max(kept), chosen["components"], given.get("components")
        )
        chosen["components"] = len(proposal.weights)
    else:
        proposal = as_gaussian(proposal)
    mean = jax.tree.leaves(proposal)[-2]
    if method != "ce_method":
        chosen |= _surrogate_plan(method, chosen, max(sizes), mean_size, kept, mean.shape[-1])
    settings = Settings(*(value.astype(mean.dtype) for value in numbers))
    static = {name: value for name, value in chosen.items() if name in Plan._fields}
    return Plan(method, sizes, tuple(kept), **static), settings, proposal


def _surrogate_plan(method, chosen, most, each, kept, d):
    """The static settings of a surrogate, as `Plan` has them; ``most``, ``each``: the evaluations
    of the largest and of the mean iteration.
    """
    share = chosen["evaluated"]
    if isinstance(share, bool) or not isinstance(share, Real) or not 0 <= share <= 0.5:
        raise ValueError(f"{method}: evaluated must be a share from 0 to 0.5, received {share!r}")
    judged = 10 * each
    # a covariance needs more than d points; up to five dimensions the published numbers
    fewest, elites = min(2 * d, judged), max(10, 2 * d)
    return dict(
        evaluated=min(math.ceil(round(float(share) * most, 9)), max(kept), most // 2),
        memory=whole_number(method, "memory", chosen["memory"], 1),
        best=whole_number(method, "best", chosen["best"], 0),
        optimistic=is_traced(chosen["optimism"]) or bool(chosen["optimism"] != 0),
        judged=judged,
        sub=(10 * elites, elites, 2),
        chosen=tuple(
            max(fewest, round(s * judged))
            for s in _elite_shares(method, chosen["selection"], each, kept, d)
        ),
        detail={
            "gaussian process": chosen["kernel"],
            "linear": 1,
            "polynomial": whole_number(method, "degree", chosen["degree"], 1),
            "radial basis": chosen["basis"],
        }[chosen["surrogate"]],
    )


def check_objective(method, objective, d, dtype):
    """``objective`` as a pytree, once it is a function [d] -> scalar that JAX can trace."""
    if not callable(objective):
        raise wrong(method, "objective", f"be a function x [{d}] -> scalar", f"{objective!r}")
    objective = as_pytree(objective)
    try:
        out = jax.eval_shape(objective, jax.ShapeDtypeStruct((d,), dtype))
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        raise ValueError(
            f"{method}: objective must be written in JAX; for any other program use start, ask and"
            f" tell. It raised: {error}"
        ) from error
    if (
        not isinstance(out, jax.ShapeDtypeStruct)
        or out.shape != ()
        or out.dtype == bool
        or jnp.issubdtype(out.dtype, jnp.complexfloating)
    ):
        raise wrong(method, "objective", f"return one real number for x of shape ({d},)", out)
    return objective


def _elite_shares(method, given, each, kept, d):
    """The share of judged samples that are elites, in each iteration: a number, that of the
    evaluated ones, or at most one in d (`_surrogate_plan` takes 2 d at least).

    One in d, as a share s shrinks a Gaussian of d dimensions by about s^(1/d) a side: with half of
    the samples, ten dimensions would halve in ten iterations.
    """
    if given in ("elites", "dimension"):
        return [min(e / each, 1.0 if given == "elites" else 1 / d) for e in kept]
    if isinstance(given, bool) or not isinstance(given, Real) or not 0 < given <= 1:
        must = 'be "elites", "dimension", or a share above 0 and at most 1'
        raise wrong(method, "selection", must, f"{given!r}")
    return [given] * len(kept)


def _first_mixture(method, proposal, elites, components, asked):
    """The first `Mixture`: that given, or of ``components`` equal ones."""
    if isinstance(proposal, Mixture):
        proposal = as_mixture(proposal)
        k = len(proposal.weights)
        if asked not in (None, k):
            raise wrong(method, "components", f"be as many as in the proposal, {k}", f"{asked!r}")
    else:
        g = as_gaussian(proposal)
        k = min(components or elites, elites)
        if asked is not None:
            k = whole_number(method, "components", asked, 1)
        d = g.mean.size
        proposal = Mixture(
            jnp.full((k,), 1 / k, g.mean.dtype),
            jnp.broadcast_to(g.mean[None], (k, d)),
            jnp.broadcast_to(g.covariance[None], (k, d, d)),
        )
    if k > elites:
        must = f"be at most the number of elites, {elites}, since each starts at one of them"
        raise wrong(method, "components", must, k)
    return proposal
