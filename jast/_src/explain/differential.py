"""differential: where one version of a system fails and another does not."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core.contract import contract
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator, first_state, next_state
from jast._src.core.typing import Array, PRNGKey
from jast._src.runtime._jax import quick
from jast._src.stress_testing.report import Report
from jast._src.util.pytrees import select, with_strong_types

__all__ = ["differential", "regression"]

LEAST_QUIET = 1e-3  # miss distance where both fail, at least: it is no failure


class Side(NamedTuple):
    """One of two systems."""

    state: Any
    failed: Array
    over: Array


class Both(NamedTuple):
    """The state of two systems under the same disturbances."""

    a: Side
    b: Side
    nearest: Array
    """Miss distance of b so far"""
    t: Array
    """int32: steps"""


def differential(
    key: PRNGKey, sim_a: Simulator, sim_b: Simulator, budget: int = 200_000, **settings: Any
) -> Report:
    """Which disturbances make version b fail, and not version a; and how probable is that?

    `jast.stress` on `regression` ``(sim_a, sim_b)``. ``report.failures`` are likeliest first; their
    disturbances replay in both simulators (`jast.replay`). ``report.probability`` is that of a
    regression.

    Args:
        key: consumed.
        sim_a: the former version.
        sim_b: the new one, of disturbances with the same shapes.
        budget: evaluations, each of both systems.
        **settings: as of `jast.stress`.

    Returns:
        `Report`.

    Raises:
        ValueError: as `regression` and `jast.stress`.

    Example:
        >>> import jax, jast
        >>> old, new = jast.simulators.walk1d(threshold=10.0), jast.simulators.walk1d(threshold=8.0)
        >>> report = jast.explain.differential(jax.random.key(0), old, new, 1000)
        >>> bool(report.failures.best.failure)
        True
    """
    from jast.stress_testing import stress

    return stress(key, _regression("differential", sim_a, sim_b), budget, **settings)


def regression(sim_a: Simulator, sim_b: Simulator) -> Simulator:
    """Both systems under the same disturbances, as one simulator that fails where ``sim_b`` fails
    and ``sim_a`` comes to its end without a failure.

    The disturbances are those of b's model for as long as b runs, and then of a's. An episode ends
    when b has come to its end without a failure, or a has failed, or both are over. The miss
    distance is that of b; where both fail it is that of b's start (of the undisturbed episode, if b
    is episodic), as no number tells how far a is from not failing.

    Args:
        sim_a: the former version.
        sim_b: the new one.

    Returns:
        An episodic `jast.Simulator`.

    Raises:
        ValueError: where the disturbances of the two, or of their starts, differ in shape, and for
            what is no simulator.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> old, new = jast.simulators.walk1d(threshold=10.0), jast.simulators.walk1d(threshold=8.0)
        >>> both = jast.explain.regression(old, new)
        >>> there, back = jnp.ones(9), -jnp.ones(9)  # only the new version fails at 9
        >>> bool(jast.replay(both, jnp.concatenate([there, back, jnp.zeros(12)])).failure)
        True
    """
    return _regression("regression", sim_a, sim_b)


def _regression(caller, sim_a, sim_b):
    for sim in (sim_a, sim_b):
        contract(caller, sim)
    a, b = signature_of(sim_a), signature_of(sim_b)
    for part, one, other in (("disturbance", a.x, b.x), ("start", a.x0, b.x0)):
        if _shapes(one) != _shapes(other):
            raise ValueError(
                f"{caller}: {part} of sim_a and sim_b must have the same shapes, received"
                f" {_shapes(one)} and {_shapes(other)}"
            )
    return Simulator(
        init=Partial(_init, sim_a, sim_b),
        step=Partial(_step, sim_a, sim_b),
        disturbance=Partial(_disturbance, sim_a, sim_b),
        evaluate=Partial(_evaluate, _quiet(sim_b)),
        horizon=max(sim_a.horizon, sim_b.horizon),
        start=sim_b.start,
        is_terminal=_is_terminal,
        observe=Partial(_observe, sim_a, sim_b),
        episodic=True,
    )


def _shapes(like):
    return jax.tree.map(lambda s: (s.shape, str(s.dtype)), like)


def _arrived(sim, state, t):
    """One system at ``state`` after ``t`` steps: (`Side`, miss distance)."""
    event, distance, *_ = sim.evaluate(state)
    over = sim.is_terminal(state) | (t >= sim.horizon)
    if sim.episodic:
        event, distance = event & over, jnp.where(over, distance, jnp.inf)
    return Side(state, event, event | over), distance


def _init(sim_a, sim_b, x0):
    t = jnp.zeros((), jnp.int32)
    sides = (_arrived(sim, first_state(sim, x0), t) for sim in (sim_a, sim_b))
    (a, _), (b, distance) = sides
    return Both(a, b, with_strong_types(distance), t)


def _moved(sim, side, x, t):
    """``side`` a step later: (`Side`, miss distance). One that is over stays where it is."""
    state = select(side.over, side.state, next_state(sim, side.state, x))
    after, distance = _arrived(sim, state, t)
    return select(side.over, side, after), distance


def _step(sim_a, sim_b, state, x):
    t = state.t + 1
    a, _ = _moved(sim_a, state.a, x, t)
    b, distance = _moved(sim_b, state.b, x, t)
    nearest = jnp.where(state.b.over, state.nearest, jnp.minimum(state.nearest, distance))
    return Both(a, b, nearest, t)


def _disturbance(sim_a, sim_b, state):
    of_a, of_b = sim_a.disturbance(state.a.state), sim_b.disturbance(state.b.state)
    return D.where(state.b.over, of_a, of_b)


def _is_terminal(state):
    a, b = state.a, state.b
    return a.failed | (b.over & ~b.failed) | (a.over & b.over)


def _evaluate(quiet, state):
    event = state.b.failed & state.a.over & ~state.a.failed
    both = state.b.failed & ~event
    return event, jnp.where(both, quiet.astype(state.nearest.dtype), state.nearest)


@quick
def _quiet(sim):
    """The miss distance of the start at its mode; of an episodic system, that of the undisturbed
    episode (of one of seed 0 where there is no mode).
    """

    def likely(dist):
        return D.mode(dist) if calm else D.sample(dist, jax.random.key(0))

    def move(_, state):
        after = next_state(sim, state, likely(sim.disturbance(state)))
        return select(sim.is_terminal(state), state, after)

    calm = signature_of(sim).has_mode
    state = first_state(sim, likely(sim.start()))
    steps = sim.horizon if sim.episodic else 0
    distance = sim.evaluate(jax.lax.fori_loop(0, steps, move, state))[1]
    return jnp.maximum(jnp.abs(distance), LEAST_QUIET)


def _observe(sim_a, sim_b, state):
    return jnp.concatenate([sim_a.observe(state.a.state), sim_b.observe(state.b.state)])
