"""The settings of a tree search: its named modes, what the user gave in their place, and the
`Problem` that they make.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from jast._src.runtime._jax import is_traced
from jast._src.search.tree.action_choice import Choice
from jast._src.search.tree.layout import Problem, Settings, widths

__all__ = ["PLAIN", "mode_settings", "problem_of"]

SWITCHES = ("spread", "follow", "feed", "urgent")
"""The settings of a mode beside ``widening`` and ``focus``."""
PLAIN = dict(spread=False, focus=1.0, follow=False, feed=False, urgent=False)
"""The settings of a mode that adds nothing to the published search."""


def mode_settings(
    method: str, modes: Mapping[str, dict], mode: str, actions: Any, **given: Any
) -> dict[str, Any]:
    """The settings of a mode, checked.

    Args:
        method: the search, for messages.
        modes: name of a mode -> its settings.
        mode: which one.
        actions: of `jast.actions`, which say how near to the mode a ``focus`` of None draws; it
            stays None with actions of None.
        **given: settings by name that take the place of the mode's own, where they are not None.

    Returns:
        The settings by name, and ``mode``.

    Raises:
        ValueError: for an unknown mode, or a setting out of range.
    """
    if mode not in modes:
        raise ValueError(f"{method}: mode must be one of {sorted(modes)}, received {mode!r}")
    chosen = modes[mode] | {name: value for name, value in given.items() if value is not None}
    if chosen["focus"] is None and actions is not None:
        chosen["focus"] = getattr(actions, "focus", 1.0)
    widening, focus = chosen["widening"], chosen["focus"]
    pair = isinstance(widening, tuple | list) and len(widening) == 2
    if not pair or not (is_traced(*widening) or (widening[0] > 0 and 0 <= widening[1] <= 1)):
        raise ValueError(
            f"{method}: widening must be a pair (k, alpha) with k > 0 and 0 <= alpha <= 1,"
            f" received {widening!r}"
        )
    if focus is not None and not is_traced(focus) and not focus > 0:
        raise ValueError(f"{method}: focus must be above 0, received {focus!r}")
    for name in SWITCHES:
        if not isinstance(chosen[name], bool):
            raise ValueError(f"{method}: {name} must be True or False, received {chosen[name]!r}")
    return dict(mode=mode) | chosen


def problem_of(
    sim: Any, reward: Any, actions: Any, chosen: Mapping[str, Any], exploration: Any, total: int
) -> Problem:
    """The `Problem` of trees of ``total`` simulations by ``chosen`` (`mode_settings`)."""
    focus = chosen["focus"]
    choice = Choice(
        actions,
        jnp.asarray(focus, jnp.float32),
        focused=is_traced(focus) or focus != 1,
        **{name: chosen[name] for name in SWITCHES},
    )
    settings = Settings(jnp.asarray(exploration, jnp.float32), widths(total, *chosen["widening"]))
    return Problem(*jax.tree.map(jnp.asarray, (sim, reward, choice)), settings)
