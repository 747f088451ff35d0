"""Monte Carlo tree search with progressive widening, from one root: the paper's MCTS-SA, the
classic of adaptive stress testing.
"""

from jast.search.tree.grow import grow_trees
from jast.search.tree.settings import PLAIN, settled

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
    key,
    sim,
    *,
    trees=1,
    simulations=9000,
    reward=None,
    actions=None,
    exploration=None,
    mode="default",
    widening=None,
    spread=None,
    focus=None,
    follow=None,
    feed=None,
    urgent=None,
    memoize="auto",
    refine=None,
    top=64,
    record=False,
    keep_trees=False,
    threads=None,
    lanes=None,
    available=None,
    progress=False,
    callback=None,
    checkpoint=None,
    executor=None,
    devices=None,
):
    """Grow ``trees`` independent trees of ``simulations`` from their first root: `SearchResult`.
    The reward is maximised.

    `jast.search.forest` without its action pruning, with its settings and errors.
    ``mode="default"`` has ``widening`` (1, 0.5), ``"paper"`` is the published MCTS-SA, ``"thesis"``
    the modified search of Moss's thesis for systems that are evaluated at the end of an episode
    (Algorithms 7 to 11), and ``"episodic"`` what works better there.
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
