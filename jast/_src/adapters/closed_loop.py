"""A policy in the loop with an environment, as a `Simulator`: what all doors have in common.

A door gives a system: a pytree with ``reset(key) -> Outcome``, ``step(key, state, action, push) ->
Outcome``, which calls ``push`` on what a force acts on, and ``subject``, which the ``parameters``
that are drawn once an episode change.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.adapters.noise import Random, add, model_of, random, replaced
from jast._src.adapters.state_arrays import as_numbers, free_to_move, in_dtypes_of, with_keys
from jast._src.core.contract import OBSERVED
from jast._src.core.simulator import Simulator, fixed, ravel
from jast._src.core.typing import Array, DistributionLike, Numeric
from jast._src.util.checks import wrong
from jast._src.util.pytrees import as_partial

__all__ = ["Change", "Instant", "Judgement", "Noise", "Outcome", "check_environment", "simulator"]

Change: TypeAlias = tuple[Any, Callable[..., Any]]
"""A distribution and what a draw of it does: (it, draw) -> it."""
Noise: TypeAlias = "DistributionLike | Change"
Judgement: TypeAlias = "Callable[[Instant], Array]"


class Instant(NamedTuple):
    """An environment after a step: the state of the simulators of `jast.adapters`.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast.adapters import Instant
        >>> distance = lambda now: 0.2 - jnp.abs(now.observation[1])  # of a pole's angle
        >>> round(float(distance(Instant((), jnp.array([0.0, 0.15]), 1.0, 5.0, False, 5, 0))), 2)
        0.05
    """

    state: Any
    """The environment's own; typed keys in it as their numbers"""
    observation: Any
    """What it shows, before the noise"""
    reward: Array
    """Of the last step, the sum over agents; 0 at the start"""
    total: Array
    """The sum of the rewards so far"""
    terminated: Array
    """bool: the environment says that it has ended"""
    time: Array
    """int32: steps so far"""
    seed: Array
    """uint32: of the environment's own key"""
    parameters: Any = ()
    """What was drawn for the episode"""


class Outcome(NamedTuple):
    """What an environment answers."""

    state: Any
    observation: Any
    reward: Numeric | Mapping[Any, Numeric]
    terminated: Array | bool


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Loop:
    """What is bound to the functions of the simulator: traced, but for ``drawn``."""

    system: Any
    policy: Partial
    noise: dict[str, Random]
    parameters: Random | None
    failure: Partial | None
    distance: Partial | None
    observe: Partial | None
    seed: np.uint32
    name: str = field(metadata=dict(static=True))
    """Of the door"""
    drawn: str = field(metadata=dict(static=True))
    """What a seed is drawn for: an "episode", each "step", or nothing"""


def simulator(
    name: str,
    system: Any,
    *,
    policy: Any,
    horizon: int,
    observation: Any = None,
    action: Any = None,
    force: Any = None,
    parameters: Any = None,
    seed: Any = None,
    failure: Any = None,
    distance: Any = None,
    observe: Any = None,
) -> Simulator:
    """The `Simulator` of the door ``name``; arguments as `jast.adapters.gymnax` explains them.
    ``seed=None``: of an environment that draws nothing.
    """
    functions = dict(policy=policy, failure=failure, distance=distance, observe=observe)
    for argument, value in functions.items():
        if not (callable(value) or value is None and argument != "policy"):
            raise ValueError(f"{name}: {argument} must be a function, received {value!r}")
        if not isinstance(value, Partial) and not _has_hash(value):
            raise ValueError(
                f"{name}: {argument} holds arrays, received {type(value).__name__}: bind them,"
                " jax.tree_util.Partial(function, arrays); of Equinox by eqx.partition"
            )
    given = dict(observation=observation, action=action, force=force)
    noise = {
        place: random(name, place, value, adds=place != "force")
        for place, value in given.items()
        if value is not None
    }
    if parameters is not None:
        named = replaced if isinstance(parameters, dict) else None  # fields, as params of gymnax
        parameters = random(name, "parameters", parameters, named)
    drawn = seed if seed in ("episode", "step") else ""
    if not (noise or parameters or drawn):
        raise ValueError(
            f"{name}: nothing is random: give observation=, action=, force= or parameters="
            + ("" if seed is None else ', or seed="episode"')
        )
    if not drawn and seed is not None and (type(seed) is not int or not 0 <= seed < 2**32):
        must = 'be a whole number from 0 to 2**32 - 1, "episode" or "step"'
        raise wrong(name, "seed", must, f"{seed!r}")
    number = np.uint32(0 if drawn or seed is None else seed)
    functions = {k: v if v is None else as_partial(v) for k, v in functions.items()}
    loop = _Loop(
        system=system,
        noise=noise,
        parameters=parameters,
        seed=number,
        name=name,
        drawn=drawn,
        **functions,
    )
    loop = free_to_move(loop)
    return Simulator(
        init=Partial(_init, loop),
        step=Partial(_step, loop),
        disturbance=Partial(_disturbance, loop),
        evaluate=Partial(_evaluate, loop),
        horizon=horizon,
        start=Partial(_start, loop) if parameters or drawn else fixed,
        is_terminal=_terminated,
        observe=Partial(_observe, loop),
    )


def check_environment(
    name: str, env: Any, start: str, step: str, *, seed: Any, hint: str = ""
) -> None:
    """Refuses an ``env`` without methods of these signatures or with a wrapper that starts anew by
    itself, and a seed a step where ``step`` takes no key.
    """
    layer, kinds = env, []
    while layer is not None:
        kinds.append(type(layer).__name__)
        fields = getattr(layer, "__dict__", {})
        layer = fields.get("env", fields.get("_env"))
    again = any("AutoReset" in kind for kind in kinds)
    if again or not all(callable(getattr(env, it.split("(")[0], None)) for it in (start, step)):
        raise ValueError(
            f"{name}: env must be an environment with {start} and {step}, and without a wrapper"
            f" that starts anew by itself, received {' of '.join(kinds)}" + (hint if again else "")
        )
    if seed == "step" and "key" not in step:
        raise ValueError(f'{name}: seed must be a whole number or "episode": {step} has no key')


def _has_hash(value: Any) -> bool:
    try:
        hash(value)
    except TypeError:
        return False
    return True


def _start(loop: _Loop) -> Any:
    parts = {} if loop.parameters is None else {"parameters": model_of(loop.parameters)}
    seeded = {"seed": D.seeds()} if loop.drawn else {}
    return D.Joint(parts | seeded)


def _init(loop: _Loop, x0: Any) -> Instant:
    drawn = x0 or {}
    seed = drawn.get("seed", jnp.asarray(loop.seed))
    parameters = drawn.get("parameters", ())
    first = _of(loop, parameters).reset(jax.random.key(seed))
    zero = jnp.zeros(())
    return Instant(
        state=as_numbers(first.state),
        observation=as_numbers(first.observation),
        reward=zero,
        total=zero,
        terminated=jnp.asarray(first.terminated, bool),
        time=jnp.int32(0),
        seed=seed,
        parameters=parameters,
    )


def _step(loop: _Loop, now: Instant, x: Any) -> Instant:
    def changed(place: str, it: Any) -> Any:
        if place not in loop.noise:
            return it
        if (apply := loop.noise[place].apply) is None:
            return add(f"{loop.name}: {place}", it, x[place])
        return apply(it, x[place])

    action = changed("action", loop.policy(changed("observation", now.observation)))
    own = jax.random.fold_in(jax.random.key(now.seed), now.time + 1)
    key = jax.random.key(x["seed"]) if loop.drawn == "step" else own
    system = _of(loop, now.parameters)
    after = system.step(key, with_keys(now.state), action, lambda it: changed("force", it))
    rewards = [jnp.sum(jnp.asarray(a)) for a in jax.tree.leaves(after.reward)]
    reward = jnp.asarray(sum(rewards), now.reward.dtype)
    return now._replace(
        state=in_dtypes_of(as_numbers(after.state), now.state),
        observation=in_dtypes_of(as_numbers(after.observation), now.observation),
        reward=reward,
        total=now.total + reward,
        terminated=jnp.asarray(after.terminated, bool),
        time=now.time + 1,
    )


def _of(loop: _Loop, parameters: Any) -> Any:
    """The system of an episode with the ``parameters`` that were drawn for it."""
    if loop.parameters is None:
        return loop.system
    subject = loop.parameters.apply(copy.copy(loop.system.subject), parameters)
    return replace(loop.system, subject=subject)


def _disturbance(loop: _Loop, now: Instant) -> Any:
    parts = {place: model_of(random, now) for place, random in loop.noise.items()}
    if loop.drawn == "step":
        parts["seed"] = D.seeds()
    # where all is decided at the start: a disturbance of no numbers
    return D.Joint(parts) if parts else D.Independent(D.Normal(jnp.zeros(0), 1.0), 1)


def _evaluate(loop: _Loop, now: Instant) -> tuple[jax.Array, jax.Array]:
    distance = None if loop.distance is None else jnp.asarray(loop.distance(now))
    failure = now.terminated if loop.failure is None else jnp.asarray(loop.failure(now))
    if distance is None:
        distance = jnp.where(failure, 0.0, 1.0)
    floats = [a for a in jax.tree.leaves(now) if jnp.issubdtype(a.dtype, jnp.floating)]
    broken = jnp.any(jnp.stack([jnp.any(jnp.isnan(a)) for a in floats]))
    return failure, jnp.where(broken, jnp.nan, distance)


def _terminated(now: Instant) -> jax.Array:
    return now.terminated


def _observe(loop: _Loop, now: Instant) -> jax.Array:
    """The observation; how many steps there were where it has more numbers than a network sees."""
    if loop.observe is not None:
        return loop.observe(now)
    seen = ravel(now.observation)
    return seen if 0 < seen.size <= OBSERVED else ravel(now.time)
