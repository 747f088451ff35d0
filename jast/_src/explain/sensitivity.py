"""sensitivity: how the probability of failure moves with the parameters of the disturbances."""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.episode import replay
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PRNGKey
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.gaussians.mixture_fit import effective_sample_size
from jast._src.estimate.population.failure_sample import Sample
from jast._src.estimate.redraw import is_proposal_of, redraw
from jast._src.explain.estimate_draws import UNRELIABLE, normalised
from jast._src.normal_space import transform
from jast._src.util import checks, display
from jast._src.util.intervals import checked_level
from jast._src.util.leaf_names import entry_places
from jast._src.util.pytrees import index_tree

__all__ = ["Sensitivity", "sensitivity"]

LANES = 1024  # draws at a time
RELIABLE = 100  # effective failures, below which the answer is UNRELIABLE


@display.printable()
class Sensitivity(NamedTuple):
    """Derivatives of the log probability of failure.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing(b=0.5)
        >>> estimate = jast.estimate.failure_probability(jax.random.key(0), sim, 6000)
        >>> rows = jast.explain.sensitivity(sim, estimate, samples=2000).rows
        >>> all(low < slope < high for name, value, slope, error, (low, high) in rows)
        True
    """

    rows: tuple[Any, ...]
    """(name, value, derivative of log P, standard error, (low, high)) of each parameter. Times the
    value it is the elasticity: per cent of P for one per cent of the parameter."""
    level: float
    ess: float
    """Effective number of failures behind them."""
    reliable: bool
    """Whether the estimate is, and there are 100 effective failures or more."""
    evaluations: int

    def __str__(self) -> str:
        lines = [] if self.reliable else [UNRELIABLE]
        lines.append(
            f"{'parameter':<28} {'value':>10} {'d log P':>11} {'elasticity':>11}"
            f"   {self.level:.0%} interval of d log P"
        )
        for name, value, slope, _, (low, high) in self.rows:
            lines.append(
                f"{name:<28} {value:10.4g} {slope:11.4g} {slope * value:11.4g}"
                f"   [{low:.4g}, {high:.4g}]"
            )
        return "\n".join(lines)


def sensitivity(
    sim: Simulator,
    estimate: Estimate,
    *,
    key: PRNGKey | None = None,
    samples: int = 16_384,
    level: float = 0.95,
) -> Sensitivity:
    """Which parameter of the disturbances does the probability of failure depend on most?

    The derivative of log P to a parameter of p(x | s) or p(x0) is the mean of the derivative of
    log p over the failures (the score function or likelihood ratio method; Rubinstein and Shapiro
    1993). The failures are drawn from the estimate's proposal and weighted. What a disturbance does
    once it is drawn is held, so this tells nothing of parameters of ``step`` or ``evaluate``: for
    those compare two estimates.

    Args:
        sim: the simulator. Its parameters are the floating-point numbers that are bound in
            ``disturbance`` and ``start`` by a `jax.tree_util.Partial`.
        estimate: of `jast.estimate.failure_probability`, of this simulator.
        key: of the draws; `jax.random.key(0)` by default.
        samples: episodes drawn from its proposal, at least 1024.
        level: of the intervals (of the delta method).

    Returns:
        `Sensitivity`.

    Raises:
        ValueError: where no parameter is bound, the estimate has no proposal for this simulator, or
            none of the draws fails.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing(b=0.5)
        >>> estimate = jast.estimate.failure_probability(jax.random.key(0), sim, 6000)
        >>> found = jast.explain.sensitivity(sim, estimate, samples=2000)
        >>> len(found.rows) > 0
        True
    """
    name = "sensitivity"
    key = jax.random.key(0) if key is None else key
    checks.check_random_key(name, key)
    samples = checks.whole_number(name, "samples", samples, LANES)
    level = checked_level(name, level)
    transform.check(name, sim)
    q = getattr(estimate, "proposal", None)
    if not is_proposal_of(sim, q):
        must = "be one by failure_probability that holds a proposal for this simulator"
        raise checks.wrong(
            name, "estimate", must, getattr(estimate, "method", type(estimate).__name__)
        )
    called, values = _parameters(sim)
    if not called:
        raise ValueError(
            f"{name}: sim: disturbance or start must be a jax.tree_util.Partial(function,"
            " parameter), received functions without parameters"
        )
    logs, scores = [], []
    if isinstance(q, Sample):  # as many of its failures as are worth independent ones, or Gaussians
        source = estimate.draws.source  # "model", whose failures are independent already
        q = q if isinstance(source, str) else source
        samples = LANES if isinstance(q, Sample) else samples
    for i in range(-(-samples // LANES)):
        own = jax.random.fold_in(key, i)
        n = min(LANES, len(q.points)) if isinstance(q, Sample) else LANES
        z, o, log_w = redraw(own, sim, q, n)
        rows = np.flatnonzero(np.asarray(o.failure) & np.isfinite(log_w))
        if len(rows):
            # all lanes, so that there is one program
            each = np.asarray(_scores(sim, np.resize(np.asarray(z)[rows], np.shape(z))), np.float64)
            logs.append(np.asarray(log_w, np.float64)[rows])
            scores.append(each[: len(rows)])
    if not logs:
        raise ValueError(
            f"{name}: estimate: none of {samples} draws of its proposal fails; expected one that"
            " draws failures"
        )
    log_w, s = np.concatenate(logs), np.concatenate(scores)
    w = normalised(log_w)
    slope = w @ s
    error = np.sqrt((w**2) @ (s - slope) ** 2)
    half = NormalDist().inv_cdf(0.5 + level / 2) * error
    ess = float(effective_sample_size(log_w))
    rows = zip(called, values, slope, error, slope - half, slope + half, strict=True)
    return Sensitivity(
        rows=tuple(
            (n, float(v), float(d), float(e), (float(a), float(b))) for n, v, d, e, a, b in rows
        ),
        level=level,
        ess=ess,
        reliable=bool(estimate.reliable and ess >= RELIABLE),
        evaluations=-(-samples // LANES) * LANES + len(s),
    )


def _split(sim: Simulator) -> tuple[list, list, Any]:
    """Paths and leaves of what is bound in the disturbance and the start, and the structure."""
    bound = dict(disturbance=sim.disturbance, start=sim.start)
    pairs, treedef = jax.tree_util.tree_flatten_with_path(bound)
    return [path for path, _ in pairs], [jnp.asarray(leaf) for _, leaf in pairs], treedef


def _parameters(sim: Simulator) -> tuple[list, np.ndarray]:
    """Names and values [k] of the floating-point numbers among them."""
    paths, leaves, _ = _split(sim)
    called, values = [], []
    for path, leaf in zip(paths, leaves, strict=True):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            root = str(getattr(path[0], "key", path[0]))
            # a Partial holds its arguments, then those by name
            rest = jax.tree_util.keystr(path[2:]) or jax.tree_util.keystr(path[1:])
            called += [root + rest + place for place in entry_places(leaf.shape)]
            values += np.ravel(leaf).astype(float).tolist()
    return called, np.asarray(values)


@jax.jit
def _scores(sim: Simulator, z: jax.Array) -> jax.Array:
    """[n, k]: derivatives of log p of the episodes of ``z`` [n, D], their disturbances held."""
    _, leaves, treedef = _split(sim)
    moving = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]

    def log_p(parameters, e):
        given = iter(parameters)
        own = [next(given) if m else leaf for m, leaf in zip(moving, leaves, strict=True)]
        return replay(replace(sim, **treedef.unflatten(own)), e).log_prob

    def one(z):
        e = jax.lax.stop_gradient(transform.episodes(sim, z[None]))
        e = index_tree(e._replace(states=None), 0)
        slopes = jax.grad(log_p)([a for a, m in zip(leaves, moving, strict=True) if m], e)
        return jnp.concatenate([a.reshape(-1) for a in slopes])

    return jax.vmap(one)(z)
