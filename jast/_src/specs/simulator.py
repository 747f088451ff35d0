"""under: a simulator whose failure is the violation of a formula."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jast._src.core.contract import contract
from jast._src.core.episode import Episode
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.specs import monitor
from jast._src.specs.formulas import Formula, checked_formula, predicates
from jast._src.specs.robustness import fits, margins, spacing
from jast._src.util.checks import wrong
from jast._src.util.pytrees import as_partial, index_tree

__all__ = ["Monitored", "goes_on", "trace_of", "under"]


class Monitored(NamedTuple):
    """State of a system under a formula.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> sim = specs.under(jast.simulators.walk1d(), specs.always(low))
        >>> states = jast.replay(sim, jnp.ones(30)).states
        >>> states.state[:3].tolist(), float(states.robustness[2])
        ([0.0, 1.0, 2.0], 3.0)
    """

    state: Any
    """The system's own."""
    samples: jax.Array
    """int32: samples of the trace so far."""
    memory: tuple[monitor.Memory, ...]
    """`specs.monitor.Memory` of each window."""
    robustness: jax.Array
    """The greatest robustness that the trace can still reach; at its end, its robustness. Infinite
    while nothing is decided.
    """
    goes_on: jax.Array
    """bool: the trace goes on. False at the horizon, and where ``is_terminal`` ended it."""
    told: tuple[jax.Array, ...] = ()
    """``(log p,)`` of the trace so far, where the system's ``evaluate`` tells log p; else ``()``.
    """


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Watch:
    """What the functions of the simulator share."""

    sim: Simulator
    formula: Formula
    samples: Partial | None
    dt: float = field(metadata=dict(static=True))
    total: int = field(metadata=dict(static=True))


def under(
    sim: Simulator,
    formula: Formula,
    dt: float = 1.0,
    *,
    samples: Callable[[Any], Any] | None = None,
) -> Simulator:
    """``sim`` under a specification: a failure is an episode whose trace violates ``formula``, and
    the miss distance is the robustness.

    The trace is the states s_0, s_1, .., dt seconds apart. A monitor in the state (`Monitored`)
    knows the greatest robustness that the trace can still come to. An episode ends, failing, at the
    first moment at which that is below 0: no continuation satisfies the formula, if its predicates
    may come to anything. Else it goes on to the system's own end, where the trace ends and windows
    are clipped (`jast.specs.robustness`; where ``is_terminal`` ends it before a window began,
    ``always`` holds there and ``eventually`` does not). The miss distance is the robustness of the
    whole trace, 0 for a failure.

    Where the bound is finite from the first state on, as for ``always`` of a predicate, it is the
    miss distance of each state: it never rises, so its least over the states is the last. Otherwise
    (``eventually``, for one) the simulator is ``episodic``: judged at its end, which still is the
    first moment of certainty. Either way a state tells all that matters, so trees may keep and
    return to it. A step costs O(r log r) for a formula whose outermost windows contain what looks r
    samples ahead, and 1 where that is a predicate.

    Args:
        sim: `jast.Simulator`. Its own failure event and miss distance play no part.
        formula: `Formula` of ``sim``'s states (or of what ``samples`` makes of one).
        dt: seconds of a step; with ``samples``, seconds between samples. Static.
        samples: state -> pytree of arrays [k, ...]: the k samples of the step that led to this
            state, in order, the last of them at the state; for a step that holds more than one. At
            the start its last row counts. None: the state itself.

    Returns:
        `jast.Simulator`, with the horizon, start, disturbances and ``observe`` of ``sim``.

    Raises:
        ValueError: naming the sub-formula, for a window beyond the horizon or that holds no sample,
            and for a predicate that raises, as over a field that the state lacks, or that returns
            no float scalar. A NaN from a predicate makes an episode invalid, as any other NaN.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> sim = specs.under(jast.simulators.walk1d(), specs.always(low))
        >>> bool(jast.replay(sim, jnp.ones(30)).failure)
        True
    """
    checked_formula("under", "formula", formula)
    if samples is not None and not callable(samples):
        raise ValueError(f"under: samples must be a function of the state, received {samples!r}")
    contract("under", sim)
    samples = samples if samples is None else as_partial(samples)
    state, dt = signature_of(sim).state, spacing("under", dt)
    rows = jax.eval_shape(partial(_samples_of, samples), state)
    sizes = {a.shape[0] if a.ndim else 0 for a in jax.tree.leaves(rows)}
    if len(sizes) != 1 or 0 in sizes:
        must = "return arrays [k, ...] with one k of at least 1"
        raise wrong("under", "samples", must, jax.tree.map(lambda a: a.shape, rows))
    total = sim.horizon * sizes.pop() + 1
    fits("under", formula, total, dt)
    watch = _Watch(sim=sim, formula=formula, samples=samples, dt=dt, total=total)
    shapes = jax.eval_shape(lambda s: margins("under", formula, _samples_of(samples, s)), state)
    watched = dict(
        init=Partial(_init, watch),
        step=Partial(_step, watch),
        disturbance=Partial(_of_the_system, sim.disturbance),
        horizon=sim.horizon,
        start=sim.start,
        observe=Partial(_of_the_system, sim.observe),
    )
    if _open_at_first(watch, shapes[0].dtype):
        end = Partial(_over, watch)
        return Simulator(evaluate=_evaluate, is_terminal=end, episodic=True, **watched)
    evaluate, end = Partial(_evaluate_step, watch), Partial(_of_the_system, sim.is_terminal)
    return Simulator(evaluate=evaluate, is_terminal=end, **watched)


def trace_of(episode: Episode, samples: Callable[[Any], Any] | None = None) -> Any:
    """The trace of an episode of a system `under` a formula, for `jast.specs.parts`.

    Args:
        episode: one `jast.Episode` with its states, as `jast.replay` returns it.
        samples: as for `under`.

    Returns:
        The system's states, a pytree of arrays [n, ...] up to the episode's end. Where that was the
        first moment of certainty, the trace is a beginning: `parts` wants to know (`goes_on`).

    Raises:
        ValueError: for an episode without states, or of another system.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> sim = specs.under(jast.simulators.walk1d(), specs.always(low))
        >>> print(specs.trace_of(jast.replay(sim, jnp.ones(30))))
        [0. 1. 2. 3. 4. 5. 6.]
    """
    _monitored("trace_of", episode)
    n = int(episode.length) + 1
    states = jax.tree.map(lambda a: np.asarray(a)[:n], episode.states.state)
    if samples is None:
        return states
    rows = jax.tree.map(np.asarray, jax.vmap(samples)(states))
    return jax.tree.map(
        lambda a: np.concatenate([a[0, -1:], a[1:].reshape(-1, *a.shape[2:])]), rows
    )


def goes_on(episode: Episode) -> bool:
    """Whether an episode of a system `under` a formula ended with its trace open, because a
    violation was certain: what `jast.specs.parts` and `robustness` call ``goes_on``. False where
    the trace ended by itself, at the horizon or by ``is_terminal``.

    Args:
        episode: as for `trace_of`.

    Raises:
        ValueError: as `trace_of`.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import specs
        >>> low = specs.predicate(lambda s: 5.0 - s, "s < 5")
        >>> sim = specs.under(jast.simulators.walk1d(), specs.always(low))
        >>> specs.goes_on(jast.replay(sim, jnp.ones(30)))  # ended at 6, long before the horizon
        True
    """
    return bool(np.asarray(_monitored("goes_on", episode).goes_on)[int(episode.length)])


def _monitored(function: str, episode: Any) -> Monitored:
    states = getattr(episode, "states", None)
    if not isinstance(states, Monitored):
        raise ValueError(
            f"{function}: episode must be a jast.replay of a simulator of jast.specs.under,"
            f" received {type(episode).__name__} with states {type(states)}"
        )
    return states


def _init(watch: _Watch, x0: Any) -> Monitored:
    state = watch.sim.init(x0)
    rows = index_tree(_samples_of(watch.samples, state), np.s_[-1:])
    given = margins("under", watch.formula, rows)
    memory = monitor.begin(watch.formula, watch.dt, watch.total, given[0].dtype)
    start = jnp.zeros((), jnp.int32)
    return _observed_to(watch, state, start, memory, given, _log_p_of_evaluate(watch, state))


def _step(watch: _Watch, s: Monitored, x: Any) -> Monitored:
    state = watch.sim.step(s.state, x)
    given = margins("under", watch.formula, _samples_of(watch.samples, state))
    told = tuple(a + b for a, b in zip(s.told, _log_p_of_evaluate(watch, state), strict=True))
    return _observed_to(watch, state, s.samples, s.memory, given, told)


def _log_p_of_evaluate(watch: _Watch, state: Any) -> tuple[jax.Array, ...]:
    """What the system's ``evaluate`` tells of log p; an episodic one is not asked."""
    told = () if watch.sim.episodic else watch.sim.evaluate(state)[2:]
    return tuple(jnp.asarray(p) for p in told)


def _observed_to(
    watch: _Watch, state: Any, samples: Any, memory: Any, given: Any, told: Any
) -> Monitored:
    after = samples + len(given[0])
    unknown = (after < watch.total) & ~jnp.asarray(watch.sim.is_terminal(state))
    memory, bound = monitor.push(
        watch.formula, memory, given, samples, unknown, watch.dt, watch.total
    )
    return Monitored(
        state=state, samples=after, memory=memory, robustness=bound, goes_on=unknown, told=told
    )


def _samples_of(samples: Callable[[Any], Any] | None, state: Any) -> Any:
    if samples is None:
        return jax.tree.map(lambda a: jnp.asarray(a)[None], state)
    return samples(state)


def _of_the_system(function: Callable[[Any], Any], s: Monitored) -> Any:
    """What the system's own function says of the system's own state."""
    return function(s.state)


def _evaluate_step(watch: _Watch, s: Monitored) -> tuple[jax.Array, ...]:
    return (*_evaluate(s)[:2], *_log_p_of_evaluate(watch, s.state))


def _evaluate(s: Monitored) -> tuple[jax.Array, ...]:
    # infinite only where all is open yet, or was at an early end: finite, and sums of it are, too
    most = float(jnp.finfo(s.robustness.dtype).max) ** 0.5
    return s.robustness < 0, jnp.clip(s.robustness, 0, most), *s.told


def _over(watch: _Watch, s: Monitored) -> Any:
    return (s.robustness < 0) | watch.sim.is_terminal(s.state)


def _open_at_first(watch: _Watch, dtype: Any) -> bool:
    """Whether the bound may be infinite after the first sample."""
    given = tuple(jnp.zeros(1, dtype) for _ in predicates(watch.formula))
    memory = monitor.begin(watch.formula, watch.dt, watch.total, dtype)

    with jax.ensure_compile_time_eval():
        start, unknown = jnp.zeros((), jnp.int32), jnp.ones((), bool)
        _, bound = monitor.push(watch.formula, memory, given, start, unknown, watch.dt, watch.total)
        return bool(jnp.isinf(bound))
