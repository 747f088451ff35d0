"""What is known of a simulator before it runs: shapes, dtypes, and what its distributions offer.

Whoever needs to know asks `signature_of`, at any place and as often as it likes: JAX keeps the
answer.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast import distributions as D
from jast._src.core.simulator import Simulator, first_state

__all__ = ["Offer", "Signature", "ask", "per_simulator", "signature_of"]

_static = dict(metadata=dict(static=True))


@dataclass(frozen=True)
class Offer:
    """What a distribution offers beside draws and densities."""

    kind: str
    """Name of its class."""
    mode: bool
    """`jast.distributions.mode` is defined."""
    lacking: str
    """Name of the class, of the first part in a joint, that has no quantile function; "" where
    `jast.distributions.quantile` is defined.
    """
    families: frozenset[str] = frozenset()
    """Names of the families of its parts; of a user's own, with the module."""

    @property
    def mode_is_median(self) -> bool:
        """It is known to be: the mode is the normal number 0, whatever the parameters."""
        return self.families <= MEDIAN_MODES

    @property
    def closed(self) -> bool:
        """Whether its quantile is known to be a function that costs no more than a draw."""
        return self.quantile and self.families <= CLOSED

    @property
    def quantile(self) -> bool:
        """Whether `jast.distributions.quantile` is defined."""
        return not self.lacking


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Signature:
    """See `signature_of`. A pytree of the `jax.ShapeDtypeStruct` of x0, x and state."""

    x0: Any
    """Of the initial disturbance: ``()`` with one start."""
    x: Any
    """Of the disturbance of a step."""
    state: Any
    dtype: np.dtype = field(**_static)
    """The float dtype in which an episode's numbers are summed: the widest of the disturbance's log
    density and the distance.
    """
    start: Offer = field(**_static)
    """What p(x0) offers."""
    disturbance: Offer = field(**_static)
    """What p(x | s) offers."""
    observation: tuple[int, ...] | None = field(**_static)
    """Shape of what ``observe`` returns; None where it does not return an array."""

    @property
    def random_start(self) -> bool:
        """Whether x0 is a choice: ``start`` is not `core.simulator.fixed`."""
        return bool(jax.tree.leaves(self.x0))

    @property
    def closed(self) -> bool:
        """Whether x0 and x are quantiles that cost no more than draws."""
        return self.start.closed and self.disturbance.closed

    @property
    def has_mode(self) -> bool:
        """Whether x0 and x have modes (or medians): there is an undisturbed episode."""
        return self.start.mode and self.disturbance.mode

    @property
    def density(self) -> str:
        """What log p counts in, free of units where it can be: "mode" (less its value at the mode)
        where x0 and x have modes, else "raw".
        """
        return "mode" if self.has_mode else "raw"


def signature_of(sim: Simulator) -> Signature:
    """The `Signature` of ``sim``: each of its functions but ``step`` and ``is_terminal`` is traced
    once, at a state that ``init`` makes; none is run.

    It depends on the functions and on the shapes and dtypes of their parameters alone, by which
    `jax.eval_shape` keeps it, also inside `jax.jit` and `jax.vmap`; that takes it two milliseconds,
    so the object keeps it, too, for each width of floats. No tracer is held. What ``start``,
    ``init``, ``disturbance`` and ``evaluate`` raise passes through.
    """
    kept = vars(sim).setdefault("_signatures", {})
    if (wide := jax.config.jax_enable_x64) not in kept:
        kept[wide] = jax.eval_shape(_traced_signature, sim)
    return kept[wide]


def ask(sim: Simulator, question: Callable[[Any, Any, Any], Any]) -> Any:
    """What ``question(p(x0), state, p(x | state))`` returns while all is traced: values of Python,
    for what `Signature` does not say of distributions. What it raises passes through.
    """
    found = []

    def traced() -> None:
        start, _, state, dist = _first_state(sim)
        found.append(question(start, state, dist))

    jax.eval_shape(traced)
    return found[0]


def per_simulator(question: Callable[..., Any]) -> Callable[[Simulator], Any]:
    """``question(sim, p(x0), state, p(x | state))``, a function of a module whose answer has a
    hash, as a function of a simulator. It is traced once for each kind of simulator, as
    `signature_of`.
    """

    def traced(sim: Simulator) -> _Answer:
        start, _, state, dist = _first_state(sim)
        return _Answer(question(sim, start, state, dist))

    return functools.wraps(question)(lambda sim: jax.eval_shape(traced, sim).value)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Answer:
    value: Any = field(**_static)


def _first_state(sim: Simulator) -> tuple[Any, Any, Any, Any]:
    start = sim.start()
    x0 = D.sample(start, jax.random.key(0))
    state = first_state(sim, x0)
    return start, x0, state, sim.disturbance(state)


def _traced_signature(sim: Simulator) -> Signature:
    # traced: what is static travels in the structure of the result, so that it is kept with it
    start, x0, state, dist = _first_state(sim)
    x = D.sample(dist, jax.random.key(0))
    numbers = dist.log_prob(x), sim.evaluate(state)[1]
    return Signature(
        x0=x0,
        x=x,
        state=state,
        dtype=jnp.result_type(*(jnp.asarray(a).dtype for a in numbers)),
        start=_offer(start),
        disturbance=_offer(dist),
        observation=_observation(sim, state),
    )


def _offer(dist: Any) -> Offer:
    lacking = "" if _can(D.has_quantile, dist) else _without_quantile(dist)
    mode = _can(D.has_mode, dist)
    return Offer(type(dist).__name__, mode=mode, lacking=lacking, families=_families(dist))


MEDIAN_MODES = {"Laplace", "Logistic", "MultivariateNormalDiag", "MultivariateNormalTri", "Normal"}
"""Families, of jast and distrax, whose mode is their median."""
CLOSED = (MEDIAN_MODES - {"Logistic"}) | {
    "Bernoulli",
    "Categorical",
    "Exponential",
    "Fixed",
    "Geometric",
    "Gumbel",
    "LogNormal",
    "TruncatedNormal",
    "Uniform",
    "Weibull",
}
"""Families whose quantiles at counter normals take 1.3 to 4 times less CPU time than draws with
JAX's keys, in episodes of 50 steps; those of the others take 2 to 20 times more."""


def _parts(dist: Any) -> list[Any]:
    """Of a joint distribution."""
    return jax.tree.leaves(getattr(dist, "distributions", []), is_leaf=D.is_distribution)


def _families(dist: Any) -> frozenset[str]:
    if hasattr(dist, "distributions"):
        return frozenset().union(*map(_families, _parts(dist)))
    if isinstance(dist, D.Independent):
        return _families(dist.distribution)
    kind = type(dist)
    ours = kind.__module__.split(".")[0] in ("jast", "distrax")
    return frozenset({kind.__name__ if ours else f"{kind.__module__}.{kind.__name__}"})


def _can(question: Callable[[Any], bool], dist: Any) -> bool:
    try:
        return question(dist)
    except Exception:  # of a user's distribution: what it cannot do without one, it does not offer
        return False


def _without_quantile(dist: Any) -> str:
    for part in _parts(dist):
        if not _can(D.has_quantile, part):
            return _without_quantile(part)
    if hasattr(dist, "distribution"):
        return _without_quantile(dist.distribution)
    return type(dist).__name__


def _observation(sim: Simulator, state: Any) -> tuple[int, ...] | None:
    try:
        return jnp.asarray(sim.observe(state)).shape
    except Exception:  # most searches look at no observation; `jast.check` says what is wrong
        return None
