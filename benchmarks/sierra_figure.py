"""Figure 2.1 of R. J. Moss's thesis: sierra in several of its settings. ``python -m
benchmarks.cross_entropy --sierra PATH`` draws it.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jast import cross_entropy as ce
from jast._src.plot import style

__all__ = ["sierra"]

SIDE = 15.0  # the picture reaches from -15 to 15, as the figure
POINTS = 161  # of a side
LEVELS = 24  # of colour
PUBLISHED = tuple((sharpness, decay) for decay in (1.0, 0.0) for sharpness in (0.5, 2.0, 6.0))


def sierra(settings=PUBLISHED, axes=None, **others):
    """A panel for each pair (sharpness eta, decay), and the list of their Axes. The brighter, the
    lower; each panel has its own scale, from 0 to the least value, which its title says.

    ``axes``: to draw in; None: a new figure. ``others``: further settings of
    `jast.cross_entropy.sierra`, of all panels.
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
            f = ce.sierra(sharpness=eta, decay=decay, **others)
            value = np.asarray(jax.vmap(f)(plane), float).reshape(POINTS, POINTS)
            levels = np.linspace(value.min(), 0, LEVELS + 1)
            ax.contourf(line, line, value, levels, cmap="cividis_r")
            ax.set_title(rf"$\eta$ = {eta:g}, decay {decay:g}" + f"\nleast {value.min():.4f}")
            ax.set_aspect("equal")
            ax.grid(False)
    return axes
