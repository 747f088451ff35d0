"""The one contract: a simulated system as a pytree of pure functions."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import update_wrapper
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jast._src.core.typing import Disturbance, Evaluate, Init, IsTerminal, Observe, Start, Step
from jast._src.distributions.containers import accepted
from jast._src.util import display
from jast._src.util.checks import truth_value, wrong
from jast._src.util.pytrees import as_partial, traceable, with_strong_types
from jast.distributions import Fixed

__all__ = [
    "Simulator",
    "first_state",
    "fixed",
    "never",
    "next_state",
    "ravel",
    "require_simulator",
    "translating",
]


def fixed():
    """p(x0) of a system with one start: draws the empty x0, ``()``."""
    return Fixed()


def never(state):
    """``is_terminal`` of a system that only failures and the horizon end."""
    return jnp.zeros((), bool)


def ravel(state):
    """The numbers of a state as one float vector: the default ``observe``."""
    leaves = [jnp.ravel(jnp.asarray(leaf)) for leaf in jax.tree.leaves(state)]
    floats = [a.dtype for a in leaves if jnp.issubdtype(a.dtype, jnp.floating)]
    dtype = jnp.result_type(*floats) if floats else jnp.zeros(()).dtype
    return jnp.concatenate([a.astype(dtype) for a in leaves]) if leaves else jnp.zeros((0,), dtype)


class Translating:
    """A function whose distributions of scipy.stats or NumPyro are jast's; equal where it is."""

    def __init__(self, function):
        update_wrapper(self, function, updated=())

    def __call__(self, *args, **settings):
        return accepted(self.__wrapped__(*args, **settings))

    def __eq__(self, other):
        return isinstance(other, Translating) and self.__wrapped__ == other.__wrapped__

    def __hash__(self):
        return hash(self.__wrapped__)


def translating(f):
    """The `Translating` function of ``f`` as a Partial with the arguments that ``f`` binds."""
    f = as_partial(f)
    return Partial(Translating(f.func), *f.args, **f.keywords)


@display.printable()
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Simulator:
    """A system under test in its environment, as pure functions of pytrees; itself a pytree.

    All randomness is the disturbances (x0, x1, ..., xT), each with its density, so an episode is
    its disturbances. The functions are wrapped in `jax.tree_util.Partial`: arguments bound by a
    ``Partial`` are traced, so simulators that differ only in them share one compiled program, and
    `jax.vmap` over a batch of them is a parameter sweep. Plain functions and lambdas are static, by
    identity: define them once. So are functions among the leaves of such an argument, as the
    activation of a network of equinox.

    Three things end an episode, in this order: a failure, then ``is_terminal``, then the horizon.
    The miss distance of an episode is the least over s0..sT. In an ``episodic`` system it is that
    of the last state, and only there does the failure event count.

    `jast.check` says whether the functions fit together.

    Raises:
        ValueError: for a horizon below 1 or a field that is no function.

    Example:
        >>> import jax.numpy as jnp
        >>> import jast
        >>> from jast import distributions as D
        >>> sim = jast.Simulator(
        ...     init=lambda x0: jnp.zeros(()),
        ...     step=lambda s, x: 0.9 * s + x,
        ...     disturbance=lambda s: D.Normal(jnp.zeros(()), 1.0),
        ...     evaluate=lambda s: (jnp.abs(s) > 5.0, jnp.maximum(5.0 - jnp.abs(s), 0.0)),
        ...     horizon=20,
        ... )
        >>> jast.check(sim).horizon
        20
    """

    init: Init
    """x0 -> state: the state that the initial disturbance puts the system in (x0 is ``()`` with the
    default ``start``).
    """
    step: Step
    """(state, x) -> state: one deterministic transition; same shapes and dtypes as its input."""
    disturbance: Disturbance
    """state -> Distribution p(x | state): scalar ``log_prob``; x is an array or a pytree of arrays.
    """
    evaluate: Evaluate
    """state -> (failure event: bool scalar, miss distance: float scalar, smaller is nearer to a
    failure). A third value, float, is log p that only the system knows, on top of what
    ``disturbance`` says: of the last disturbance, or of the whole episode where ``episodic``.
    """
    horizon: int = field(metadata=dict(static=True))
    """Greatest number of steps of an episode, at least 1; static."""
    start: Start = fixed
    """() -> Distribution p(x0)."""
    is_terminal: IsTerminal = never
    """state -> bool: ends the episode before the horizon without being a failure."""
    observe: Observe = ravel
    """state -> float vector, at most 64 numbers for a policy: what policies and networks see."""
    episodic: bool = field(default=False, metadata=dict(static=True))
    """``evaluate`` means something only at the end of an episode; static."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if f.metadata.get("static"):
                continue
            if callable(value):
                value = traceable(as_partial(value))
                if f.name in ("disturbance", "start") and type(value.func) is not Translating:
                    value = translating(value)
                object.__setattr__(self, f.name, value)
            elif value is None or isinstance(value, str | int | float | tuple | list | dict):
                raise ValueError(f"Simulator: {f.name} must be a function, received {value!r}")
        if isinstance(self.horizon, np.integer):
            object.__setattr__(self, "horizon", int(self.horizon))
        if isinstance(self.horizon, bool) or not isinstance(self.horizon, int) or self.horizon < 1:
            raise wrong("Simulator", "horizon", "be an int of at least 1", f"{self.horizon!r}")
        truth_value("Simulator", episodic=self.episodic)


# each is traced once, for all programs with the system in them


@jax.jit
def first_state(sim: Simulator, x0: Any) -> Any:
    """The state that ``x0`` puts the system in."""
    return with_strong_types(sim.init(x0))


@jax.jit
def next_state(sim: Simulator, state: Any, x: Any) -> Any:
    """The state that disturbance ``x`` leads to."""
    return with_strong_types(sim.step(state, x))


def require_simulator(function: str, sim: Any) -> None:
    """ValueError, with what to do, unless ``sim``, an argument of ``function``, is a simulator."""
    if isinstance(sim, Simulator):
        return
    advice = ""
    if callable(sim):
        advice = (
            ". Call it where it makes one; of a function of the disturbances of an episode,"
            " jast.blackbox.from_python makes one, of one in JAX that is negative where it fails"
            " jast.simulators.limit_state"
        )
    raise wrong(function, "sim", "be a jast.Simulator", f"{type(sim).__name__}{advice}")
