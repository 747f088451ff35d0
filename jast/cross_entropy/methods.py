"""The cross-entropy method and its variants with a surrogate (R. J. Moss's thesis, chapter 2), for
objectives in JAX, and as ask and tell for any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jast._checks import random_key
from jast.cross_entropy import loop
from jast.cross_entropy.settle import MODES, checked, settled

if TYPE_CHECKING:
    import chex

    from jast.cross_entropy.gaussian import Gaussian
    from jast.cross_entropy.mixture import Mixture
    from jast.cross_entropy.result import CEResult
    from jast.typing import Objective, Schedule

__all__ = ["Search", "ask", "ce_method", "ce_mixture", "ce_surrogate", "finish", "start", "tell"]


def ce_method(
    key: chex.PRNGKey,
    objective: Objective,
    proposal: Gaussian | Mixture,
    *,
    samples: int = 10,
    elites: int = 5,
    iterations: int = 10,
    schedule: Schedule | Sequence[int] | None = None,
    mode: Literal["default", "thesis"] = "default",
    ratchet: bool = False,
    elitism: bool | None = None,
) -> CEResult:
    """Minimise ``objective`` (x [d] -> scalar) by the cross-entropy method: `CEResult`. Algorithm 1
    of the thesis.

    Each of ``iterations`` draws ``samples`` points from the proposal, evaluates them, and refits
    the proposal by maximum likelihood to the best of them, the ``elites``. ``proposal``: a
    `Gaussian` (`jast.cross_entropy.normal`), a pair (mean [d], covariance), or a distribution with
    ``mean()`` and ``covariance()``. Where the elites have no covariance that is positive definite
    (as when they are at most d), the proposal stays.

    ``schedule``: None, the same number in each iteration; of `jast.cross_entropy.schedules`; or the
    numbers, of which zeros are left out. ``mode="thesis"`` takes the elites from the last batch
    only, ``"default"`` from all that were evaluated (``elitism``). ``ratchet``: once a batch is
    smaller than the elites, they stay as few, as in the published code. Counts and names are
    static, the key, the proposal and what a `jax.tree_util.Partial` binds to the objective are
    traced: `jax.vmap` runs hundreds of seeds and proposals in one program. With an uneven schedule
    the objective is also called on rows that pad a batch; they are neither kept nor counted. An
    evaluation that is NaN or infinite is kept in the history, counted in ``invalid``, never an
    elite.

    Raises ValueError for a proposal that is no proper distribution, elites above the samples,
    counts below 1, and an objective that is not written in JAX (see `start`) or not a number.
    """
    more = dict(ratchet=ratchet, elitism=elitism)
    return _run(
        "ce_method", key, objective, proposal, samples, elites, iterations, schedule, mode, more
    )


def ce_surrogate(
    key: chex.PRNGKey,
    objective: Objective,
    proposal: Gaussian | Mixture,
    *,
    samples: int = 10,
    elites: int = 5,
    iterations: int = 10,
    schedule: Schedule | Sequence[int] | None = None,
    mode: Literal["default", "thesis"] = "default",
    **settings,
) -> CEResult:
    """Minimise ``objective`` by the cross-entropy method with a surrogate: `CEResult`. Algorithms 2
    to 4 of the thesis; see `ce_method` for what is common.

    A cheap model of the objective is fitted in every iteration. The proposal is refitted to the
    elites that were evaluated, to the best part of ten times as many samples that only the model
    judged, and to the best points of short cross-entropy searches on the model, one around each
    true elite.

    ``settings``, beside ``ratchet`` and ``elitism`` (each with the value of `MODES` [method][mode]
    where it is not given):

    - ``surrogate``: "gaussian process" (with a ``kernel``: "squared exponential", "matern12",
      "matern32", "matern52"), "linear", "polynomial" (of ``degree``, by default 2) or "radial
      basis" around the points it is fitted to.
    - ``basis``: of the distance r in the ``frame``: "gaussian", exp(-r^2 / 2 d); "linear", r;
      "squared", r^2; "multiquadratic", sqrt(r^2 + 1). Given alone, as in the thesis's printed call
      ``ce_surrogate(f, M; basis=:squared)``, it chooses "radial basis".
    - ``memory``, ``best``: it is fitted to the evaluations of so many of the last iterations, and
      so many of the best before them.
    - ``warp``: to values "raw", "standard" (mean 0, variance 1), or "rank" (normal scores, which no
      increasing function of the objective alters).
    - ``frame``: in coordinates whitened by those points ("window"), or in the scale of the initial
      proposal ("initial").
    - ``selection``: the share of the judged samples that are elites; "elites": as among the
      evaluated ones, "dimension": but at most one in d.
    - ``optimism``: the searches minimise the mean less so many standard deviations of the model;
      traced. Only a Gaussian process has any.
    - ``current``, ``alpha``: they start with the covariance of the current proposal, or else of the
      initial one, over alpha, which is traced.
    - ``evaluated``: the share of each batch, rounded up, that is spent on their best points in the
      iteration after; at most a half.

    ``mode="thesis"`` is the published code: raw values, three iterations, elites of the last batch,
    no search result evaluated, initial covariance; its likelihood is maximised on a grid here.
    ``mode="default"`` is tuned on sierra and checked on others (docs/figures.md).
    """
    return _run(
        "ce_surrogate",
        key,
        objective,
        proposal,
        samples,
        elites,
        iterations,
        schedule,
        mode,
        settings,
    )


def ce_mixture(
    key: chex.PRNGKey,
    objective: Objective,
    proposal: Gaussian | Mixture,
    *,
    samples: int = 10,
    elites: int = 5,
    iterations: int = 10,
    schedule: Schedule | Sequence[int] | None = None,
    mode: Literal["default", "thesis"] = "default",
    **settings,
) -> CEResult:
    """Minimise ``objective`` by the cross-entropy method with a surrogate and a mixture for its
    proposal: `CEResult`. Algorithm 5; see `ce_surrogate`.

    The `Mixture` is fitted by ten iterations of expectation maximisation. ``proposal`` may also be
    one. ``settings``, beside those of `ce_surrogate`:

    - ``components``: how many; 2, and in mode "thesis" as many as elites.
    - ``start``: each begins as a Gaussian around a true elite ("elites"), or as the proposal with
      which the search around it ended ("searches", the thesis).
    - ``regularisation``: added to the diagonals of their covariances; traced.
    """
    return _run(
        "ce_mixture",
        key,
        objective,
        proposal,
        samples,
        elites,
        iterations,
        schedule,
        mode,
        settings,
    )


def _run(method, key, objective, proposal, samples, elites, iterations, schedule, mode, more):
    random_key(method, key)
    plan, settings, proposal = settled(
        method,
        proposal,
        samples=samples,
        elites=elites,
        iterations=iterations,
        schedule=schedule,
        mode=mode,
        **more,
    )
    leaf = jax.tree.leaves(proposal)[1]
    return loop.run(
        key, plan, settings, checked(method, objective, leaf.shape[-1], leaf.dtype), proposal
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Search:
    """A cross-entropy method between two batches, for an objective that is evaluated outside; see
    `start`.
    """

    state: loop.State
    settings: Any
    plan: Any = field(metadata=dict(static=True))

    @property
    def done(self) -> bool:
        """Whether the budget is spent."""
        return int(self.state.k) >= len(self.plan.counts)


def start(
    key: chex.PRNGKey,
    proposal: Gaussian | Mixture,
    method: Literal["ce_method", "ce_surrogate", "ce_mixture"] = "ce_surrogate",
    *,
    samples: int = 10,
    elites: int = 5,
    iterations: int = 10,
    schedule: Schedule | Sequence[int] | None = None,
    mode: Literal["default", "thesis"] = "default",
    **settings,
) -> Search:
    """A `Search` with the settings of `ce_method`, `ce_surrogate` or `ce_mixture`, for an objective
    that need not be written in JAX::

        search = start(key, proposal, samples=10, iterations=10)
        while not search.done:
            x = ask(search)  # [m, d], exactly as many as are to be evaluated
            search = tell(search, x, [program(row) for row in x])
        result = finish(search)

    It takes exactly the budget of evaluations, and the same steps as those functions with the same
    key. A search is a pytree that can be pickled: keep it to go on later.
    """
    if method not in list(MODES):
        raise ValueError(f"start: method must be one of {list(MODES)}, received {method!r}")
    random_key("start", key)
    plan, real, proposal = settled(
        method,
        proposal,
        samples=samples,
        elites=elites,
        iterations=iterations,
        schedule=schedule,
        mode=mode,
        **settings,
    )
    return Search(_begin(key, plan, proposal), real, plan)


def ask(search: Search) -> np.ndarray | chex.Array:
    """The next points to evaluate, [m, d]; the same until they are told. ValueError where the
    search is done.
    """
    return _ask(search.plan, search.state)[: _count("ask", search)]


def tell(search: Search, x: chex.Array, values: chex.Array | Sequence[float]) -> Search:
    """The `Search` after the objective's ``values`` [m] at ``x`` [m, d]: those that `ask` gave, or
    what was evaluated in their place (clipped to bounds, say).

    A value may be NaN or infinite where an evaluation failed. ValueError for other shapes, and
    where the search is done.
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
    return Search(
        _tell(search.plan, search.settings, search.state, x, values), search.settings, search.plan
    )


def finish(search: Search) -> CEResult:
    """The `CEResult` of what was told so far; what was not has value inf in its history."""
    return _finish(search.plan, search.state)


def _count(caller, search):
    """How many points the next batch has."""
    if search.done:
        raise ValueError(
            f"{caller}: the search is done, all {sum(search.plan.counts)} evaluations are spent"
        )
    return search.plan.counts[int(search.state.k)]


_begin, _ask, _tell, _finish = (
    partial(jax.jit, static_argnums=i)(f)
    for f, i in ((loop.begin, 1), (loop.ask, 0), (loop.tell, 0), (loop.finish, 0))
)
