"""The models of the category: run on published inputs, or a `Simulator` under a requirement."""

from __future__ import annotations

import math
from functools import cache
from types import ModuleType
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array
from jast._src.simulators.arch import cars, transmission
from jast._src.simulators.arch.specifications import named
from jast._src.specs.robustness import reach
from jast._src.util.checks import one_of, whole_number, wrong
from jast.distributions import Independent, Uniform
from jast.specs import Formula, under

__all__ = [
    "Driving",
    "automatic_transmission",
    "begun",
    "chasing_cars",
    "ends",
    "nothing",
    "samples_of",
    "simulate",
]

MODELS = {"chasing cars": cars, "automatic transmission": transmission}


class Driving(NamedTuple):
    """State of a model that inputs drive, segment by segment."""

    now: Any
    """`Cars` or `Transmission`"""
    samples: Any
    """[k, ...]: during the last step, the last of them now"""
    step: Array
    """int32"""


def chasing_cars(
    requirement: str | Formula = "CC1", segments: int = 20, disturbance: Any = None
) -> Simulator:
    """Five cars on a line (`simulators.arch.cars` has the equations and
    published results) under a requirement.

    A step is 100 / ``segments`` seconds in which throttle and brake are constant: instance 2 of the
    category has 20 segments. Samples are 0.05 s apart. A failure violates the requirement; the miss
    distance is the robustness in metres (`jast.specs.under`). What comes after the requirement's
    last window decides nothing: an episode ends there.

    Args:
        requirement: a name in `SPECIFICATIONS` ("CC1", .. "CC5", "CC4-20", "CCx"), or a formula of
            `Cars`.
        segments: steps of an episode; a divisor of 2000.
        disturbance: p(throttle, brake) [2], a distribution of `jast.distributions`; what is outside
            of [0, 1] is clipped. None: uniform, so that log p of all episodes of a length is the
            same.

    Returns:
        `jast.Simulator`.

    Raises:
        ValueError: for an unknown name and a number of segments that does not divide the samples.

    Example:
        >>> import jast
        >>> jast.simulators.arch.chasing_cars("CC1", segments=5).horizon
        5
    """
    return _driven("chasing_cars", cars, "CC", requirement, segments, disturbance)


def automatic_transmission(
    requirement: str | Formula = "AT1", segments: int = 10, disturbance: Any = None
) -> Simulator:
    """A car with an automatic transmission (`simulators.arch.transmission` has the equations
    and published results) under a requirement.

    A step is 50 / ``segments`` seconds in which throttle and brake are constant: instance 2 of the
    category has 10 segments. Samples are 0.02 s apart. A failure violates the requirement; the miss
    distance is the robustness, in the unit of the requirement: mph, rpm or gears
    (`jast.specs.under`). What comes after the requirement's last window decides nothing: an episode
    ends there.

    Args:
        requirement: a name in `SPECIFICATIONS` ("AT1", "AT2", "AT51" .. "AT54", "AT6a", "AT6b",
            "AT6c", "AT6abc"), or a formula of `Transmission`.
        segments: steps of an episode; a divisor of 2500.
        disturbance: p(throttle, brake) [2], a distribution of `jast.distributions`; what is outside
            of [0, 100] and [0, 325] is clipped. None: uniform, so that log p of all episodes of a
            length is the same.

    Returns:
        `jast.Simulator`.

    Raises:
        ValueError: for an unknown name and a number of segments that does not divide the samples.

    Example:
        >>> import jast
        >>> jast.simulators.arch.automatic_transmission("AT1", segments=5).horizon
        5
    """
    return _driven("automatic_transmission", transmission, "AT", requirement, segments, disturbance)


def simulate(
    model: str,
    times: Array,
    inputs: Array,
    interpolation: Literal["step", "linear"] = "step",
) -> tuple[Any, float]:
    """A model's trace under given inputs, such as published ones.

    Args:
        model: "chasing cars" or "automatic transmission".
        times: [n] seconds, rising from 0.
        inputs: [n, 2]: throttle and brake at these times, in their ranges: [0, 1] both; [0, 100]
            and [0, 325] of the transmission.
        interpolation: "step": each holds up to the next time, and the last to the end; "linear":
            straight between times, and the last holds to the end.

    Returns:
        (`Cars` [2001, ...], 0.05) or (`Transmission` [2501], 0.02): samples of 100 or 50 s, and the
        seconds between them.

    Raises:
        ValueError: for another model, times that do not rise from 0, inputs out of their range or
            of another shape, another interpolation.

    Example:
        >>> import numpy as np, jast
        >>> trace, dt = jast.simulators.arch.simulate(
        ...     "chasing cars", np.array([0.0]), np.array([[1.0, 0.0]])
        ... )
        >>> dt
        0.05
    """
    one_of("simulate", "model", model, MODELS)
    of = MODELS[model]
    times, inputs = np.asarray(times, np.float64), np.asarray(inputs, np.float64)
    rising = times.ndim == 1 and len(times) and times[0] == 0 and np.isfinite(times).all()
    if not (rising and (np.diff(times) > 0).all()):
        raise ValueError(f"simulate: times must rise from 0, received {times}")
    if inputs.shape != (len(times), len(of.INPUTS)):
        raise wrong("simulate", "inputs", f"have the shape {(len(times), 2)}", inputs.shape)
    for (name, low, high), column in zip(of.INPUTS, inputs.T, strict=True):
        if not ((low <= column) & (column <= high)).all():
            raise ValueError(f"simulate: inputs: {name} must be in [{low:g}, {high:g}]")
    one_of("simulate", "interpolation", interpolation, ("step", "linear"))
    driven = _means(times, inputs, interpolation, of.DT, round(of.DURATION / of.DT))
    start = of.start()
    _, after = _drive(of)(start, jnp.asarray(driven, jnp.zeros(()).dtype))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, after), of.DT


@cache
def _drive(model: ModuleType) -> Any:
    return jax.jit(model.drive)


def _means(
    times: np.ndarray, inputs: np.ndarray, interpolation: str, dt: float, total: int
) -> np.ndarray:
    """The mean of a signal over each sample's time, [total, inputs]: by its integral."""
    edges = dt * np.arange(total + 1)
    knots = np.append(times, max(edges[-1], times[-1]) + 1)
    left = inputs
    right = inputs if interpolation == "step" else np.append(inputs[1:], inputs[-1:], axis=0)
    parts = (left + right) / 2 * np.diff(knots)[:, None]
    whole_parts = np.concatenate([np.zeros((1, inputs.shape[1])), np.cumsum(parts, axis=0)])
    k = np.clip(np.searchsorted(knots, edges, side="right") - 1, 0, len(times) - 1)
    into = (edges - knots[k])[:, None]
    slope = (right - left) / np.diff(knots)[:, None]
    integral = whole_parts[k] + left[k] * into + slope[k] * into**2 / 2
    return np.diff(integral, axis=0) / dt


def _driven(
    function: str,
    model: ModuleType,
    prefix: str,
    requirement: str | Formula,
    segments: int,
    disturbance: Any,
) -> Simulator:
    """A model under a requirement."""
    segments, total = whole_number(function, "segments", segments), round(model.DURATION / model.DT)
    if total % segments:
        raise wrong(function, "segments", f"divide {total}, the samples of a run", segments)
    formula = named(function, prefix, requirement)
    each = total // segments
    needed = min(reach(formula, model.DT), total)
    functions = _functions(model, each, math.ceil(needed / each))
    if disturbance is not None:
        functions = functions | dict(disturbance=lambda state: disturbance)
    return under(Simulator(**functions, horizon=segments), formula, model.DT, samples=samples_of)


@cache
def _functions(model: ModuleType, each: int, needed: int) -> dict[str, Any]:
    """The functions of a simulator whose steps are ``each`` samples of a model, ``needed`` of them:
    the same objects for the same numbers, so that nothing compiles anew.
    """

    def real(a: Any) -> Any:
        return jnp.asarray(a, jnp.zeros(()).dtype)

    def init(x0: Any) -> Driving:
        return begun(model.start(), each)

    def ranges() -> list[Any]:
        return [real([i[side] for i in model.INPUTS]) for side in (1, 2)]

    def disturbance(state: Driving) -> Any:
        return Independent(Uniform(*ranges()), 1)

    def step(state: Driving, x: Any) -> Driving:
        inputs = jnp.broadcast_to(real(jnp.clip(x, *ranges())), (each, 2))
        return Driving(*model.drive(state.now, inputs), state.step + 1)

    def observe(state: Driving) -> Any:
        parts = *model.observe(state.now), state.step[None]
        return jnp.concatenate([real(part) for part in parts])

    return dict(
        init=init,
        step=step,
        disturbance=disturbance,
        evaluate=nothing,
        is_terminal=ends(needed),
        observe=observe,
    )


def begun(now: Any, each: int) -> Driving:
    """The state at 0 s, of a system whose steps are ``each`` samples."""
    samples = jax.tree.map(lambda a: jnp.broadcast_to(a, (each, *a.shape)), now)
    return Driving(now, samples, jnp.zeros((), jnp.int32))


@cache
def ends(needed: int) -> Any:
    """``is_terminal`` after ``needed`` steps; the same object for the same number."""
    return lambda state: state.step >= needed


def samples_of(state: Driving) -> Any:
    """Those during the step that led to a state, for `jast.specs.under`."""
    return state.samples


def nothing(state: Driving) -> tuple[Any, Any]:
    """``evaluate`` of a system whose requirement judges it."""
    return jnp.zeros((), bool), jnp.zeros(())
