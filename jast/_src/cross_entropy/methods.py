"""The cross-entropy method and its variants with a surrogate (R. J. Moss's thesis, chapter 2), for
objectives in JAX, and as ask and tell for any other.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.typing import Array, DistributionLike, Numeric, Objective, PRNGKey, Schedule
from jast._src.cross_entropy import iterate
from jast._src.cross_entropy.gaussian import Gaussian
from jast._src.cross_entropy.mixture import Mixture
from jast._src.cross_entropy.plan import MODES, check_objective, make_plan
from jast._src.cross_entropy.result import CEResult
from jast._src.util.checks import check_random_key, one_of

Proposal: TypeAlias = "Gaussian | Mixture | tuple[Array, Numeric] | DistributionLike"

__all__ = ["Search", "ask", "ce_method", "ce_mixture", "ce_surrogate", "finish", "start", "tell"]


def ce_method(
    key: PRNGKey,
    objective: Objective,
    proposal: Proposal,
    *,
    samples: int = 10,
    elites: int = 5,
    iterations: int = 10,
    schedule: Schedule | Sequence[int] | None = None,
    mode: Literal["default", "thesis"] = "default",
    ratchet: bool = False,
    elitism: bool | None = None,
) -> CEResult:
    """Minimise ``objective`` by the cross-entropy method: `CEResult`. Algorithm 1 of R. J. Moss's
    thesis.

    Each iteration draws a batch of points from the proposal, evaluates them, and refits the
    proposal by maximum likelihood to the best of them, the elites. Where the elites have no
    positive definite covariance (as when there are at most d of them), the proposal stays as it is.
    With an uneven schedule the objective is also called on rows that pad a batch; they are neither
    kept nor counted. An evaluation that is NaN or infinite is kept in the history, counted in
    ``invalid``, and never an elite.

    Counts and names are static. The key, the proposal and what a `jax.tree_util.Partial` binds to
    the objective are traced, so `jax.vmap` runs hundreds of seeds and proposals in one program.

    Args:
        key: consumed.
        objective: a function in JAX of x [d] that returns one number.
        proposal: what the first batch is drawn from: a `Gaussian` (see `normal`), a pair (mean [d],
            covariance), or a distribution with ``mean()`` and ``covariance()``.
        samples: points in a batch.
        elites: how many of the best points refit the proposal.
        iterations: how many batches there are.
        schedule: None for batches of equal size, a function from `jast.cross_entropy.schedules`, or
            the sizes themselves, of which zeros are left out.
        mode: "thesis" takes the elites from the last batch only, "default" from every point
            evaluated so far.
        ratchet: once a batch is smaller than ``elites``, later batches have no more elites than it
            had, as in the published code.
        elitism: overrides the mode: True takes the elites from every point evaluated so far.

    Raises:
        ValueError: for a proposal that is no proper distribution, more elites than samples, a count
            below 1, and an objective that is not written in JAX (use `start` for those) or does not
            return one number.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> wide = ce.normal(jnp.zeros(2), 9.0)
        >>> bowl = lambda x: jnp.sum((x - 1.0) ** 2)
        >>> found = ce.ce_method(jax.random.key(0), bowl, wide, iterations=5)
        >>> found.best_x.shape, bool(found.best_value < 1.0)
        ((2,), True)
    """
    return _run("ce_method", **locals())


def ce_surrogate(
    key: PRNGKey, objective: Objective, proposal: Proposal, **settings: Any
) -> CEResult:
    """Minimise ``objective`` by the cross-entropy method with a surrogate: `CEResult`. Algorithms 2
    to 4 of R. J. Moss's thesis.

    Every iteration fits a cheap model of the objective. The proposal is refitted to three kinds of
    points: the elites that were evaluated, the best of ten times as many samples that only the
    model judged, and the best points of short cross-entropy searches on the model, one around each
    true elite.

    A setting that is None has the value of the mode. ``mode="thesis"`` is the published code: raw
    values, a memory of three iterations, elites of the last batch, no search result evaluated, the
    initial covariance. Its likelihood is maximised on a grid here. ``mode="default"`` is tuned on
    `sierra` and checked on other functions (docs/figures.md).

    Args:
        key, objective, proposal, samples, elites, iterations, schedule: as for `ce_method`.
        mode: "default" or "thesis".
        surrogate: the model: "gaussian process", "linear", "polynomial", or "radial basis" around
            the points that it is fitted to.
        kernel: of the Gaussian process: "squared exponential", "matern12", "matern32" or
            "matern52".
        degree: of the polynomial; 2 by default.
        basis: radial function of the distance r in the ``frame``: "gaussian", exp(-r^2 / 2 d);
            "linear", r; "squared", r^2; "multiquadratic", sqrt(r^2 + 1). Given alone, as in the
            thesis's printed call ``ce_surrogate(f, M; basis=:squared)``, it chooses the surrogate
            "radial basis".
        memory: the model is fitted to the evaluations of this many of the last iterations.
        best: and to this many of the best evaluations before them.
        warp: the values that it is fitted to: "raw", "standard" (mean 0, variance 1), or "rank"
            (normal scores, which no increasing function of the objective alters).
        frame: its coordinates: "window", whitened by the points that it is fitted to, or "initial",
            on the scale of the initial proposal.
        selection: the share of the judged samples that become elites; "elites" for the same share
            as among the evaluated points, "dimension" for that share but at most one in d.
        optimism: the searches minimise the model's mean less this many of its standard deviations;
            traced. Only a Gaussian process has any.
        current: whether the searches start with the covariance of the current proposal; else with
            the initial one over ``alpha``.
        alpha: see ``current``; traced.
        evaluated: the share of each batch, rounded up, that is spent in the next iteration on the
            best points of the searches; at most a half.
        ratchet, elitism: as for `ce_method`.

    Raises:
        ValueError: as `ce_method`, and for a setting that is out of range.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> wide = ce.normal(jnp.zeros(2), 9.0)
        >>> bowl = lambda x: jnp.sum((x - 1.0) ** 2)
        >>> found = ce.ce_surrogate(jax.random.key(0), bowl, wide, iterations=3)
        >>> bool(found.best_value < 1.0)
        True
    """
    return _run("ce_surrogate", key=key, objective=objective, proposal=proposal, **settings)


def ce_mixture(key: PRNGKey, objective: Objective, proposal: Proposal, **settings: Any) -> CEResult:
    """Minimise ``objective`` by the cross-entropy method with a surrogate and a mixture for its
    proposal: `CEResult`. Algorithm 5 of R. J. Moss's thesis.

    The `Mixture` is fitted by ten iterations of expectation maximisation.

    Args:
        key, objective, samples, elites, iterations, schedule, mode: as for `ce_method`.
        proposal: as for `ce_method`, or a `Mixture`.
        surrogate, kernel, degree, basis, memory, best, warp, frame, selection: as for
            `ce_surrogate`.
        optimism, current, alpha, evaluated, ratchet, elitism: as for `ce_surrogate`.
        components: how many the mixture has: 2, and in mode "thesis" as many as elites.
        start: each component begins as a Gaussian around a true elite ("elites"), or as the
            proposal with which the search around that elite ended ("searches", the thesis).
        regularisation: added to the diagonals of the components' covariances; traced.

    Raises:
        ValueError: as `ce_surrogate`, and for more components than elites.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> wide = ce.normal(jnp.zeros(2), 9.0)
        >>> bowl = lambda x: jnp.sum((x - 1.0) ** 2)
        >>> found = ce.ce_mixture(jax.random.key(0), bowl, wide, iterations=3)
        >>> found.proposal.weights.shape
        (2,)
    """
    return _run("ce_mixture", key=key, objective=objective, proposal=proposal, **settings)


def _run(
    method: str, *, key: PRNGKey, objective: Objective, proposal: Proposal, **settings: Any
) -> CEResult:
    check_random_key(method, key)
    plan, real, proposal = make_plan(method, proposal, **DEFAULTS | settings)
    mean = jax.tree.leaves(proposal)[-2]
    objective = check_objective(method, objective, mean.shape[-1], mean.dtype)
    return iterate.run(plan, real, key, objective, proposal)


DEFAULTS = dict(ce_method.__kwdefaults__)


def _signature(method: str) -> inspect.Signature:
    """That of `ce_method` with the settings of ``method``, None where they are those of its
    mode.
    """
    whole = inspect.signature(ce_method)
    own = dict(whole.parameters)
    for name, value in MODES[method]["default"].items():
        kind = "float | str" if name == "selection" else type(value).__name__
        setting = inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=f"{kind} | None"
        )
        own.setdefault(name, setting)
    return whole.replace(parameters=list(own.values()))


ce_surrogate.__signature__ = _signature("ce_surrogate")
ce_mixture.__signature__ = _signature("ce_mixture")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Search:
    """A cross-entropy method between two batches, for an objective that is evaluated outside; see
    `start`.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> search = ce.start(jax.random.key(0), ce.normal(jnp.zeros(2), 9.0), iterations=1)
        >>> x = ce.ask(search)
        >>> search.done, ce.tell(search, x, (x**2).sum(1)).done
        (False, True)
    """

    state: iterate.State
    settings: iterate.Settings
    plan: iterate.Plan = field(metadata=dict(static=True))

    @property
    def done(self) -> bool:
        """Whether the budget is spent."""
        return int(self.state.k) >= len(self.plan.counts)


def start(
    key: PRNGKey,
    proposal: Proposal,
    method: Literal["ce_method", "ce_surrogate", "ce_mixture"] = "ce_surrogate",
    **settings: Any,
) -> Search:
    """A `Search` for an objective that need not be written in JAX.

    It spends exactly the budget of evaluations, and takes the same steps as `ce_method`,
    `ce_surrogate` or `ce_mixture` with the same key. A search is a pytree that can be pickled: keep
    it to go on later.

    Args:
        key: consumed.
        proposal: as for `ce_method`.
        method: the function whose steps it takes: "ce_method", "ce_surrogate" or "ce_mixture".
        settings: the keywords of that function, such as ``samples`` or ``components``.

    Raises:
        ValueError: for an unknown method or setting, and as the function does.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> search = ce.start(jax.random.key(0), ce.normal(jnp.zeros(2), 9.0), iterations=3)
        >>> while not search.done:
        ...     x = ce.ask(search)  # [m, d], exactly as many as are to be evaluated
        ...     search = ce.tell(search, x, [float(row @ row) for row in x])
        >>> ce.finish(search).history.value.shape
        (30,)
    """
    one_of("start", "method", method, MODES)
    check_random_key("start", key)
    plan, real, proposal = make_plan(method, proposal, **DEFAULTS | settings)
    return Search(iterate.begin(plan, key, proposal), real, plan)


def ask(search: Search) -> np.ndarray | Array:
    """The next points to evaluate, [m, d]; the same until their values are told.

    Args:
        search: of `start` or `tell`.

    Raises:
        ValueError: where the search is done.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> search = ce.start(jax.random.key(0), ce.normal(jnp.zeros(2), 9.0), samples=4, elites=2)
        >>> ce.ask(search).shape
        (4, 2)
    """
    return iterate.ask(search.plan, search.state)[: _count("ask", search)]


def tell(search: Search, x: Array, values: Array | Sequence[float]) -> Search:
    """The `Search` after the objective's values at some points.

    Args:
        search: what `ask` was given.
        x: [m, d]: the points that `ask` gave, or those evaluated in their place (clipped to bounds,
            say).
        values: [m]; NaN or infinite where an evaluation failed.

    Raises:
        ValueError: for other shapes, and where the search is done.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> search = ce.start(jax.random.key(0), ce.normal(jnp.zeros(2), 9.0), iterations=1)
        >>> x = ce.ask(search)
        >>> ce.tell(search, x, (x**2).sum(1)).done
        True
    """
    shape, dtype = (_count("tell", search), search.state.x.shape[1]), search.state.x.dtype
    try:
        with np.errstate(over="ignore"):
            x, values = (np.asarray(a).astype(dtype, casting="same_kind") for a in (x, values))
    except (TypeError, ValueError) as error:
        raise ValueError(f"tell: x and values must be arrays of real numbers: {error}") from None
    if x.shape != shape or values.shape != shape[:1]:
        raise ValueError(
            f"tell: expected x of shape {shape} and values of shape {shape[:1]}, received {x.shape}"
            f" and {values.shape}"
        )
    if not np.isfinite(x).all():
        raise ValueError("tell: x must be finite")
    pad = max(search.plan.counts) - len(x)
    x, values = (jnp.asarray(np.pad(a, [(0, pad)] + [(0, 0)] * (a.ndim - 1))) for a in (x, values))
    state = iterate.tell(search.plan, search.settings, search.state, x, values)
    return replace(search, state=state)


def finish(search: Search) -> CEResult:
    """The `CEResult` of what was told so far; what was not told has value inf in its history.

    Args:
        search: of `start` or `tell`.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> search = ce.start(jax.random.key(0), ce.normal(jnp.zeros(2), 9.0), iterations=1)
        >>> x = ce.ask(search)
        >>> result = ce.finish(ce.tell(search, x, (x**2).sum(1)))
        >>> bool(result.best_value == (x**2).sum(1).min())
        True
    """
    return iterate.finish(search.plan, search.state)


def _count(caller, search):
    """How many points the next batch has."""
    if search.done:
        raise ValueError(
            f"{caller}: the search is over: all {sum(search.plan.counts)} evaluations are spent"
        )
    return search.plan.counts[int(search.state.k)]
