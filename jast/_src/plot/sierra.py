"""Sierra for several of its settings: figure 2.1 of Moss's thesis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.cross_entropy.objectives import sierra as objective
from jast._src.plot import style
from jast._src.plot.style import Axes

__all__ = ["sierra"]

SIDE = 15.0  # the picture reaches from -15 to 15, as the figure
POINTS = 161  # of a side
LEVELS = 24  # of colour
PUBLISHED = tuple((sharpness, decay) for decay in (1.0, 0.0) for sharpness in (0.5, 2.0, 6.0))
"""The panels of figure 2.1."""


def sierra(
    settings: Any = PUBLISHED, axes: Sequence[Axes] | None = None, **others: Any
) -> list[Axes]:
    """Sierra (`jast.cross_entropy.sierra`) on [-15, 15] x [-15, 15], a panel for each pair of
    settings: figure 2.1 of the thesis. The brighter, the lower; each panel has its own scale, from
    0 to the least value, which its title says.

    Args:
        settings: pairs (``sharpness`` eta, ``decay``). Default: the six of the figure, eta .5, 2
            and 6 with decay 1, then with decay 0.
        axes: Axes to draw in, at least one for each pair; None: a new figure, three panels a row.
        others: further settings of `jast.cross_entropy.sierra`, of all panels, as ``spacing=3.0``.

    Raises:
        ValueError: for settings that are no pairs, those that sierra refuses, and too few axes.

    Example:
        >>> import jast
        >>> len(jast.plot.sierra([(6.0, 1.0)]))
        1
    """
    try:
        pairs = [(float(eta), float(decay)) for eta, decay in settings]
    except (TypeError, ValueError):
        pairs = []
    if not pairs:
        raise style.wrong("sierra", "settings", "be pairs (sharpness, decay)", f"{settings!r}")
    line = np.linspace(-SIDE, SIDE, POINTS)
    plane = jnp.asarray(np.stack(np.meshgrid(line, line), -1).reshape(-1, 2))
    columns = min(3, len(pairs))
    size = (3.1 * columns, 3.2 * -(-len(pairs) // columns))
    shared, count = dict(sharey=True, layout="compressed"), len(pairs)
    with style.panels("sierra", axes, size, count, "pair of settings", columns, **shared) as axes:
        for ax, (eta, decay) in zip(axes, pairs, strict=True):
            f = objective(sharpness=eta, decay=decay, **others)
            value = np.asarray(jax.vmap(f)(plane), float).reshape(POINTS, POINTS)
            levels = np.linspace(value.min(), 0, LEVELS + 1)
            ax.contourf(line, line, value, levels, cmap="cividis_r")
            ax.set_title(rf"$\eta$ = {eta:g}, decay {decay:g}" + f"\nleast {value.min():.4f}")
            ax.set_aspect("equal")
            ax.grid(False)
    return axes
