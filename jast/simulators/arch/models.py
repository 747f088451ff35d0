"""The models of the category: run on published inputs, or a `Simulator` under a requirement."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._checks import whole
from jast.distributions import Independent, Uniform
from jast.simulator import Simulator
from jast.simulators.arch import cars
from jast.simulators.arch.specifications import SPECIFICATIONS
from jast.specs import Formula, under

__all__ = ["chasing_cars", "simulate"]


class Driving(NamedTuple):
    """State of `chasing_cars`."""

    cars: cars.Cars
    """Now"""
    samples: cars.Cars
    """[k, ...]: during the last step, the last of them now"""
    step: Any
    """int32"""


def chasing_cars(
    requirement: str | Formula = "CC1", segments: int = 20, disturbance: Any = None
) -> Simulator:
    """Five cars on a line (`jast.simulators.arch.cars` has the equations and
    published results) under a requirement.

    A step is 100 / ``segments`` seconds in which throttle and brake are constant: instance 2 of the
    category has 20 segments. Samples are 0.05 s apart. A failure violates the requirement; the miss
    distance is the robustness in metres (`jast.specs.under`).

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
    """
    segments = whole("chasing_cars", "segments", segments)
    total = round(cars.DURATION / cars.DT)
    if total % segments:
        raise ValueError(
            f"chasing_cars: segments must divide {total}, the samples of a run, received {segments}"
        )
    formula = requirement
    if not isinstance(formula, Formula):
        names = [name for name in SPECIFICATIONS if name.startswith("CC")]
        if formula not in names:
            raise ValueError(
                f"chasing_cars: requirement must be a formula or one of {names}, received"
                f" {requirement!r}"
            )
        formula = SPECIFICATIONS[formula]
    each = total // segments
    uniform = Independent(Uniform(jnp.zeros(2), jnp.ones(2)), 1)
    given = uniform if disturbance is None else disturbance
    driving = Simulator(
        init=partial(_init, each),
        step=_step,
        disturbance=lambda state: given,
        evaluate=_nothing,
        horizon=segments,
        observe=_observe,
    )
    return under(driving, formula, cars.DT, samples=_samples)


def simulate(
    model: str, times: Any, inputs: Any, interpolation: str = "step"
) -> tuple[cars.Cars, float]:
    """A model's trace under given inputs, such as published ones.

    Args:
        model: "chasing cars".
        times: [n] seconds, rising from 0.
        inputs: [n, 2]: throttle and brake at these times, in [0, 1].
        interpolation: "step": each holds up to the next time, and the last to the end; "linear":
            straight between times, and the last holds to the end.

    Returns:
        (`Cars` [2001, ...], 0.05): samples of 100 s, and the seconds between them.

    Raises:
        ValueError: for another model, times that do not rise from 0, inputs out of their range or
            of another shape, another interpolation.
    """
    if model != "chasing cars":
        raise ValueError(f'simulate: model must be "chasing cars", received {model!r}')
    times, inputs = np.asarray(times, np.float64), np.asarray(inputs, np.float64)
    rising = times.ndim == 1 and len(times) and times[0] == 0 and np.isfinite(times).all()
    if not (rising and (np.diff(times) > 0).all()):
        raise ValueError(f"simulate: times must rise from 0, received {times}")
    if inputs.shape != (len(times), len(cars.INPUTS)):
        raise ValueError(
            f"simulate: inputs must have the shape {(len(times), 2)}, received {inputs.shape}"
        )
    for (name, low, high), column in zip(cars.INPUTS, inputs.T, strict=True):
        if not ((low <= column) & (column <= high)).all():
            raise ValueError(f"simulate: inputs: {name} must be in [{low:g}, {high:g}]")
    if interpolation not in ("step", "linear"):
        raise ValueError(
            f'simulate: interpolation must be "step" or "linear", received {interpolation!r}'
        )
    driven = _means(times, inputs, interpolation, round(cars.DURATION / cars.DT))
    start = cars.parked()
    _, after = jax.jit(cars.drive)(start, jnp.asarray(driven, start.first.dtype))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, after), cars.DT


def _means(times: np.ndarray, inputs: np.ndarray, interpolation: str, total: int) -> np.ndarray:
    """The mean of a signal over each sample's time, [total, inputs]: by its integral."""
    edges = cars.DT * np.arange(total + 1)
    knots = np.append(times, max(edges[-1], times[-1]) + 1)
    left = inputs
    right = inputs if interpolation == "step" else np.append(inputs[1:], inputs[-1:], axis=0)
    parts = (left + right) / 2 * np.diff(knots)[:, None]
    whole_parts = np.concatenate([np.zeros((1, inputs.shape[1])), np.cumsum(parts, axis=0)])
    k = np.clip(np.searchsorted(knots, edges, side="right") - 1, 0, len(times) - 1)
    into = (edges - knots[k])[:, None]
    slope = (right - left) / np.diff(knots)[:, None]
    integral = whole_parts[k] + left[k] * into + slope[k] * into**2 / 2
    return np.diff(integral, axis=0) / cars.DT


def _init(each: int, x0: Any) -> Driving:
    start = cars.parked()
    samples = jax.tree.map(lambda a: jnp.broadcast_to(a, (each, *a.shape)), start)
    return Driving(start, samples, jnp.zeros((), jnp.int32))


def _step(state: Driving, x: Any) -> Driving:
    each = state.samples.first.shape[0]
    inputs = jnp.broadcast_to(jnp.clip(x, 0, 1).astype(state.cars.first.dtype), (each, 2))
    return Driving(*cars.drive(state.cars, inputs), state.step + 1)


def _samples(state: Driving) -> cars.Cars:
    return state.samples


def _nothing(state: Driving) -> tuple[Any, Any]:
    return jnp.zeros((), bool), jnp.zeros_like(state.cars.first)


def _observe(state: Driving) -> Any:
    now = state.cars
    dtype = now.first.dtype
    parts = now.gaps, now.speeds, now.modes.astype(dtype), state.step.astype(dtype)[None]
    return jnp.concatenate(parts)
