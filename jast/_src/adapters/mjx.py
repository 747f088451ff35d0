"""A model of MuJoCo in JAX, known by its positions and velocities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.adapters import closed_loop
from jast._src.adapters.closed_loop import Instant
from jast._src.adapters.noise import add
from jast._src.adapters.state_arrays import refuse_warp
from jast._src.core.simulator import Simulator
from jast._src.util.checks import whole_number, wrong
from jast._src.util.pytrees import as_partial

__all__ = ["mjx"]


class _Body(NamedTuple):
    """The numbers on which the next step depends: of the fields of a Data alone."""

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    qacc_warmstart: jax.Array
    """Where the solver starts"""
    time: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Physics:
    subject: Any
    """The model"""
    data: Any
    sense: Partial
    advance: Callable[[Any, Any], Any] = field(metadata=dict(static=True))
    substeps: int = field(metadata=dict(static=True))

    def reset(self, key: Any) -> closed_loop.Outcome:
        return self._outcome(self.data)

    def step(self, key: Any, state: Any, action: Any, push: Callable) -> closed_loop.Outcome:
        ctrl = jnp.asarray(action, self.data.ctrl.dtype).reshape(self.data.ctrl.shape)
        data = push(self.data.replace(ctrl=ctrl, **state._asdict()))
        data = jax.lax.fori_loop(
            0, self.substeps, lambda _, data: self.advance(self.subject, data), data
        )
        return self._outcome(data)

    def _outcome(self, data: Any) -> closed_loop.Outcome:
        body = _Body(*(getattr(data, name) for name in _Body._fields))
        return closed_loop.Outcome(body, self.sense(data), 0.0, False)


def mjx(
    model: Any,
    data: Any,
    controller: Callable[[Any], Any],
    *,
    horizon: int,
    distance: closed_loop.Judgement,
    failure: closed_loop.Judgement | None = None,
    observation: closed_loop.Noise | None = None,
    action: closed_loop.Noise | None = None,
    force: closed_loop.Noise | None = None,
    parameters: closed_loop.Change | None = None,
    sense: Callable[[Any], Any] | None = None,
    substeps: int = 1,
    step: Callable[[Any, Any], Any] | None = None,
    observe: closed_loop.Judgement | None = None,
) -> Simulator:
    """A controller of a model of MuJoCo, in ``mujoco.mjx``.

    Of the data, a state keeps what the next step depends on: ``qpos``, ``qvel``, ``act``,
    ``qacc_warmstart`` and ``time``. All else is that of ``data`` in each step. Arguments that are
    not explained here are those of `gymnax`, with the same meaning.

    Args:
        model: of ``mjx.put_model``; traced, so that others of its shape do not compile again.
        data: of ``mjx.make_data`` or ``mjx.put_data``: the start.
        controller: observation -> ``ctrl``.
        horizon: steps of an episode, of ``substeps`` each.
        distance: `Instant` -> float, from ``now.state.qpos``, ``now.state.qvel`` or
            ``now.observation``.
        failure: `Instant` -> bool. Default: the distance is 0 or less.
        observation, action: noise on what the controller sees and on ``ctrl``, as in `gymnax`.
        force: a distribution of the shape of ``qvel``, added to ``qfrc_applied`` in each step; or a
            pair (distribution, function (data, draw) -> data), such as one of ``xfrc_applied``.
        parameters: a pair (distribution, function (model, draw) -> model), drawn once an episode.
        sense: data -> observation. Default: ``qpos`` and ``qvel`` in one vector. What MuJoCo
            derives, such as ``sensordata``, is that of before the step.
        substeps: steps of the physics in each step, under one ``ctrl`` and one force.
        step: (model, data) -> data. Default: ``mujoco.mjx.step``.
        observe: `Instant` -> float vector, 64 numbers at most.

    Returns:
        `Simulator`, whose states are `Instant`.

    Raises:
        ValueError: for an argument of another kind, and where nothing is random.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> from typing import Any, NamedTuple
        >>> from jast.distributions import Normal
        >>> class Data(NamedTuple):  # as mjx has them
        ...     qpos: Any = jnp.zeros(1)
        ...     qvel: Any = jnp.zeros(1)
        ...     act: Any = jnp.zeros(0)
        ...     qacc_warmstart: Any = jnp.zeros(1)
        ...     time: Any = 0.0
        ...     ctrl: Any = jnp.zeros(1)
        ...     qfrc_applied: Any = jnp.zeros(1)
        ...     replace = lambda self, **new: self._replace(**new)
        >>> def step(mass, data):
        ...     qvel = data.qvel + 0.1 * (data.ctrl + data.qfrc_applied) / mass
        ...     return data.replace(qpos=data.qpos + 0.1 * qvel, qvel=qvel)
        >>> sim = jast.adapters.mjx(
        ...     jnp.array(2.0),
        ...     Data(),
        ...     controller=lambda seen: -3.0 * seen[:1] - 2.0 * seen[1:],
        ...     horizon=50,
        ...     force=Normal(jnp.zeros(1), 1.0),
        ...     distance=lambda now: 1.0 - jnp.abs(now.state.qpos[0]),
        ...     step=step,
        ... )
        >>> jast.rollout(jax.random.key(0), jast.check(sim)).disturbances["force"].shape
        (50, 1)
    """
    refuse_warp("mjx", model, 'mjx.put_model(model, impl="jax")')
    if step is None:
        from mujoco.mjx import step
    functions = dict(controller=controller, distance=distance, sense=sense or _joints, step=step)
    for name, value in functions.items():
        if not callable(value):
            raise ValueError(f"mjx: {name} must be a function, received {value!r}")
    lacking = [name for name in (*_Body._fields, "ctrl", "replace") if not hasattr(data, name)]
    if lacking:
        must = "be that of mjx.make_data or mjx.put_data"
        raise wrong("mjx", "data", must, f"{type(data).__name__} without {', '.join(lacking)}")
    if not (force is None or isinstance(force, tuple)):
        force = force, _push
    physics = _Physics(
        subject=model,
        data=data,
        sense=as_partial(functions["sense"]),
        advance=step,
        substeps=whole_number("mjx", "substeps", substeps),
    )
    return closed_loop.simulator(
        "mjx",
        physics,
        policy=controller,
        horizon=horizon,
        observation=observation,
        action=action,
        force=force,
        parameters=parameters,
        failure=Partial(_reached, as_partial(distance)) if failure is None else failure,
        distance=distance,
        observe=observe,
    )


def _push(data: Any, draw: Any) -> Any:
    return data.replace(qfrc_applied=add("mjx: force", data.qfrc_applied, draw))


def _reached(distance: Partial, now: Instant) -> jax.Array:
    return jnp.asarray(distance(now)) <= 0


def _joints(data: Any) -> jax.Array:
    return jnp.concatenate([data.qpos, data.qvel])
