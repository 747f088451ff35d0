"""Monte Carlo tree search with progressive widening, from one root: the paper's MCTS-SA, the
classic of adaptive stress testing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from jast.search.tree.grow import grow_trees
from jast.search.tree.settings import PLAIN, settled

if TYPE_CHECKING:
    import chex
    import jax

    from jast.search.result import SearchResult
    from jast.simulator import Simulator
    from jast.typing import Actions, Callback, Executor, PathLike, Reward

__all__ = ["MODES", "mcts"]

MODES = {
    "default": PLAIN | dict(widening=(1.0, 0.5), spread=True, focus=None),
    "code": PLAIN | dict(widening=(0.5, 0.6)),
    "paper": PLAIN | dict(widening=(0.5, 0.6)),
    "thesis": PLAIN | dict(widening=(10.0, 0.3), feed=True, urgent=True),
    "episodic": (
        PLAIN | dict(widening=(2.0, 0.5), spread=True, focus=None, follow=True, urgent=True)
    ),
}


def mcts(
    key: chex.PRNGKey,
    sim: Simulator,
    *,
    trees: int = 1,
    simulations: int = 9000,
    reward: Reward | None = None,
    actions: Actions | None = None,
    exploration: float | None = None,
    mode: Literal["default", "code", "paper", "thesis", "episodic"] = "default",
    widening: tuple[float, float] | None = None,
    spread: bool | None = None,
    focus: float | None = None,
    follow: bool | None = None,
    feed: bool | None = None,
    urgent: bool | None = None,
    memoize: Literal["auto", "node", "root", "none"] = "auto",
    refine: float | None = None,
    top: int = 64,
    record: bool = False,
    keep_trees: bool = False,
    threads: int | None = None,
    lanes: int | None = None,
    available: int | None = None,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> SearchResult:
    """Grow independent trees from their first root: `jast.search.forest` without its action
    pruning. The reward is maximised.

    Args:
        key, sim: as for `forest`.
        trees: how many; each is a search of its own.
        simulations: of each tree.
        reward, actions, exploration, widening, spread, focus, follow, feed, urgent: as for
            `forest`.
        mode: "default" has ``widening`` (1, 0.5); "code" (earlier: "paper") is the published
            MCTS-SA; "thesis" the modified search of Moss's thesis for systems that are evaluated at
            the end of an episode (Algorithms 7 to 11); "episodic" is what works better there.
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
    given = dict(
        widening=widening, spread=spread, focus=focus, follow=follow, feed=feed, urgent=urgent
    )
    return grow_trees(
        "mcts",
        key,
        sim,
        settled("mcts", MODES, mode, actions, **given),
        trees=trees,
        prunes=1,
        simulations=simulations,
        reward=reward,
        actions=actions,
        exploration=exploration,
        memoize=memoize,
        refine=refine,
        top=top,
        record=record,
        keep_trees=keep_trees,
        threads=threads,
        lanes=lanes,
        available=available,
        progress=progress,
        callback=callback,
        checkpoint=checkpoint,
        executor=executor,
        devices=devices,
    )
