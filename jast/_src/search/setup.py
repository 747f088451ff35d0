"""A search's reward and actions as it takes them: checked, with the scales that they were not
told, and named for the result.
"""

from dataclasses import is_dataclass, replace
from typing import Any

import jax

from jast._src.core import actions as choices
from jast._src.core import rewards
from jast._src.core.contract import ACTIONS, contract
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.runtime._jax import is_traced, is_tracing
from jast._src.search.calibration import Calibration, calibrate
from jast._src.util.checks import check_random_key
from jast._src.util.display import call_settings
from jast._src.util.pytrees import fields_of

__all__ = ["default_actions", "prepare"]


def default_actions(function: str, sim: Simulator) -> choices.Wide | choices.Samples:
    """`jast.actions.wide` where a disturbance has a quantile function, else `samples`; ValueError
    where the simulator breaks its contract.
    """
    contract(function, sim)
    return choices.wide() if signature_of(sim).disturbance.quantile else choices.samples()


def prepare(
    function: str,
    key: jax.Array,
    sim: Simulator,
    reward: Any,
    actions: Any,
    *,
    widen: str = "always",
    **settings: Any,
) -> tuple[Any, Any, dict | None, Calibration | None]:
    """What a search by the name ``function`` starts with, of its arguments and other ``settings``:
    the reward, a pytree, the actions, the settings with names and seed (None if traced), and the
    episodes that gave the scales (None where all were given); ``widen`` of
    `search.calibration.calibrate`. ValueError unless `contract` holds.
    """
    check_random_key(function, key)
    contract(function, sim, actions)
    reward = rewards.lexicographic() if reward is None else reward
    reward, actions, calibration = _scaled(sim, reward, actions, widen)
    reward = rewards.as_pytree(reward)
    if is_traced(key, sim, reward, actions, settings) or is_tracing():
        return reward, actions, None, calibration
    func = getattr(reward, "func", reward)
    name = getattr(func, "__name__", None) or f"rewards.{type(func).__name__.lower()}"
    settings = call_settings(function, key, **settings) | dict(
        reward=name,
        reward_settings=_settings(reward),
        actions=ACTIONS.get(type(actions), type(actions).__name__),
        action_settings=_settings(actions),
    )
    return reward, actions, settings, calibration


def _scaled(
    sim: Simulator, reward: Any, actions: Any, widen: str
) -> tuple[Any, Any, Calibration | None]:
    """Reward and actions with the scales that they lack, and the episodes that gave these."""
    bare = isinstance(reward, rewards.Lexicographic) and not reward.scaled
    wide = isinstance(actions, choices.Wide) and actions.width is None
    if not (bare or wide):
        return reward, actions, None
    signature, widen = signature_of(sim), widen if wide else "never"
    given = getattr(reward, "density", None) if bare else "raw"
    density = given or signature.density
    calibration = calibrate(sim, density, widen)
    tally, traced = calibration.tally, is_traced(calibration[:4])
    if not traced and given is None and 2 * int(tally.invalid) > int(tally.episodes):
        # a mode of infinite density, as a family of the user's own may have
        density, calibration = "raw", calibrate(sim, "raw", widen)
    near, rare, likely, width, *_ = calibration
    if not traced:
        near, rare, likely, width = (float(v) for v in (near, rare, likely, width))
    if bare:
        reward = replace(
            reward,
            near=near if reward.near is None else reward.near,
            rare=rare if reward.rare is None else reward.rare,
            likely=likely if reward.rare is None and density == "raw" else reward.likely,
            density=density,
        )
    return reward, replace(actions, width=width) if wide else actions, calibration


def _settings(part: Any) -> dict[str, Any]:
    """The numbers and texts of a reward or of actions, as JSON can hold them."""
    if is_dataclass(part):
        given = fields_of(part)
    else:
        args = getattr(part, "args", ())
        given = dict(getattr(part, "keywords", {})) | ({"args": args} if args else {})
    return {name: _plain(value) for name, value in given.items()}


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    return value.tolist() if hasattr(value, "tolist") else repr(value)
