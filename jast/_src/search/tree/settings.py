"""The settings of a tree search: how it draws its actions (independently, as published, or spread
out and partly near the mode of the disturbance), its named modes, what the user gave in their
place, and the `Problem` that they make.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from jast import distributions as D
from jast._src.core.counter_prng import coin
from jast._src.core.typing import Actions
from jast._src.distributions.flat_rows import unflat
from jast._src.runtime._jax import is_traced
from jast._src.search.tree.layout import Problem, Settings, widths
from jast._src.util.checks import one_of, truth_value, wrong
from jast._src.util.pytrees import count_numbers, select

__all__ = ["PLAIN", "mode_settings", "problem_of"]

SWITCHES = ("spread", "follow", "feed", "urgent")  # those of a mode beside widening and focus
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
    one_of(method, "mode", mode, modes)
    chosen = modes[mode] | {name: value for name, value in given.items() if value is not None}
    if chosen["focus"] is None and actions is not None:
        chosen["focus"] = getattr(actions, "focus", 1.0)
    widening, focus = chosen["widening"], chosen["focus"]
    pair = isinstance(widening, tuple | list) and len(widening) == 2
    if not pair or not (is_traced(*widening) or (widening[0] > 0 and 0 <= widening[1] <= 1)):
        must = "be a pair (k, alpha) with k > 0 and 0 <= alpha <= 1"
        raise wrong(method, "widening", must, f"{widening!r}")
    if focus is not None and not is_traced(focus) and not focus > 0:
        raise ValueError(f"{method}: focus must be above 0, received {focus!r}")
    truth_value(method, **{name: chosen[name] for name in SWITCHES})
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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Choice:
    """A search's `jast.actions` and how it draws them.

    ``spread``: the children of a node are points of a low-discrepancy sequence (the additive
    recurrence with the generalised golden ratio, shifted at random for each node) where the actions
    are points of a cube, so that a few children cover it. ``focus``: every second child is ``mode +
    focus (x - mode)``, with the mode of the disturbance: below 1 likelier and in finer steps, above
    1 in the tails; so are half of the rollout steps of half of the trees, because there it helps on
    some systems and hurts on others. Off where the disturbance has no mode or is all integers.

    ``follow``: as soon as an episode is the best of its tree, the next simulations put its
    disturbances into the tree, one a simulation, so that it can be varied from any of its steps.
    ``feed``: with half of the steps to go, a rollout takes what the best episode took there (thesis
    Algorithm 9). ``urgent``: a child that was never visited comes before all others (thesis
    Algorithm 10); else it has Q = 0 (MCFS-AP eq. 3).
    """

    actions: Actions
    focus: jax.Array
    spread: bool = field(default=True, metadata=dict(static=True))
    focused: bool = field(default=True, metadata=dict(static=True))
    follow: bool = field(default=False, metadata=dict(static=True))
    feed: bool = field(default=False, metadata=dict(static=True))
    urgent: bool = field(default=False, metadata=dict(static=True))

    def child(self, key, slot, dist, start=False):
        """The action of a node's child by the node's key and the child's place among its siblings;
        ``start``: it is an x0.
        """
        kinds = 2 if self._can_focus(dist) else 1
        places = hasattr(self.actions, "place")
        if places and start:  # seeds have no quantile function
            places = self.actions.places_start and D.has_quantile(dist)
        if self.spread and places:
            x = self.actions.place(_point(key, slot // kinds, D.event_like(dist)), dist)
        else:
            x = self._drawn(jax.random.fold_in(key, slot), dist, start)
        return self._near(slot % 2 == 1, x, dist, start) if kinds == 2 else x

    def roll(self, key, tree_key, dist, start=False):
        """An action of a rollout, by its own key and its tree's."""
        x = self._drawn(key, dist, start)
        if not self._can_focus(dist):
            return x
        return self._near(coin(key) & coin(tree_key), x, dist, start)

    def _drawn(self, key, dist, start):
        return (self.actions.draw_start if start else self.actions.draw)(key, dist)

    def _can_focus(self, dist):
        leaves = jax.tree.leaves(D.event_like(dist))
        floats = [jnp.issubdtype(s.dtype, jnp.floating) for s in leaves]
        return self.focused and any(floats) and D.has_mode(dist)

    def _near(self, pred, x, dist, start):
        return select(pred, self.actions.near(x, dist, self.focus, start), x)


def _point(key, index, event):
    """The point of a node's sequence with this number, in the unit cube of ``event``'s shape: R_d,
    x_n = frac(shift + n / phi_d^j), j = 1 .. d.
    """
    dimension = count_numbers(event)
    phi = 2.0
    for _ in range(60):  # the positive root of phi^(d + 1) = phi + 1
        phi = (1 + phi) ** (1 / (dimension + 1))
    # steps in 32-bit fixed point: exact for any number of children
    steps = jnp.asarray(
        [int(phi ** -(j + 1) * 2**32) & 0xFFFFFFFF for j in range(dimension)], jnp.uint32
    )
    words = jax.random.bits(key, (dimension,), jnp.uint32) + steps * index.astype(jnp.uint32)
    return jax.tree.map(lambda a: a * jnp.asarray(2.0**-24, a.dtype), unflat(words >> 8, event))
