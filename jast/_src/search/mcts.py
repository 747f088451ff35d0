"""Monte Carlo tree search with progressive widening, from one root: the paper's MCTS-SA, the
classic of adaptive stress testing.
"""

from __future__ import annotations

import inspect
from typing import Any

from jast._src.core.simulator import Simulator
from jast._src.core.typing import PRNGKey
from jast._src.search.forest import MODES as FOREST_MODES
from jast._src.search.forest import forest
from jast._src.search.result import SearchResult
from jast._src.search.tree.forest_run import grow_trees

__all__ = ["MODES", "mcts"]

MODES = FOREST_MODES | dict(default=FOREST_MODES["default"] | dict(widening=(1.0, 0.5)))
"""Those of `forest`; a single root has half as many children by default."""


def mcts(key: PRNGKey, sim: Simulator, **settings: Any) -> SearchResult:
    """Grow independent trees from their first root: `jast.search.forest` without its action
    pruning. The reward is maximised.

    Args:
        key, sim: as for `forest`.
        trees: how many; each is a search of its own.
        simulations: of each tree.
        reward, actions, exploration, widening, spread, focus, follow, feed, urgent: as for
            `forest`.
        mode: "default" has ``widening`` (1, 0.5); "code" (earlier: "paper") is the published
            MCTS-SA, and so is "text"; "thesis" the modified search of Moss's thesis for systems
            that are evaluated at the end of an episode (Algorithms 7 to 11); "episodic" is what
            works better there.
        memoize, refine, top, record, keep_trees, threads, lanes, available: as for `forest`.
        progress, callback, checkpoint, executor, devices: as for `forest`.

    Returns:
        `SearchResult`.

    Raises:
        ValueError: as `forest`.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> result = jast.search.mcts(jax.random.key(0), sim, simulations=500)
        >>> bool(result.best.failure)
        True
    """
    for name in settings.keys() - DEFAULTS.keys():
        raise TypeError(f"mcts() got an unexpected keyword argument {name!r}")
    return grow_trees("mcts", MODES, key=key, sim=sim, prunes=1, **DEFAULTS | settings)


def _signature() -> inspect.Signature:
    """That of `jast.search.forest` without what needs several roots."""
    whole = inspect.signature(forest)
    own = dict(whole.parameters)
    for name in ("prunes", "heads", "head_settings"):
        del own[name]
    for name, default in dict(trees=1, simulations=9000).items():
        own[name] = own[name].replace(default=default)
    return whole.replace(parameters=list(own.values()))


mcts.__signature__ = _signature()
DEFAULTS = {
    name: parameter.default
    for name, parameter in mcts.__signature__.parameters.items()
    if parameter.default is not parameter.empty
}
