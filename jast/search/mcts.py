"""Monte Carlo tree search with progressive widening, from one root: the paper's MCTS-SA, the classic of adaptive stress testing."""

from jast import rewards
from jast.search.forest import SAMPLES
from jast.search.trees import grow_trees, settled

__all__ = ["MODES", "mcts"]

MODES = {"default": dict(widening=(1.0, 0.5), spread=True, focus=None), "paper": dict(widening=(0.5, 0.6), spread=False, focus=1.0)}


def mcts(
    key, sim, *, trees=1, simulations=9000, reward=rewards.STANDARD, actions=SAMPLES, exploration=10.0, mode="default", widening=None, spread=None, focus=None,
    memoize="auto", top=64, threads=None, lanes=None, available=None, progress=False, callback=None,
):  # fmt: skip
    """Grow ``trees`` independent trees of ``simulations`` from their first root: `SearchResult`. The reward is maximised.

    `jast.search.forest` without its action pruning, with its settings and errors; ``mode="paper"`` is the published MCTS-SA, ``"default"`` has ``widening``
    (1, 0.5).
    """
    return grow_trees(
        "mcts", key, sim, settled("mcts", MODES, mode, widening, spread, focus, actions), trees=trees, prunes=1, simulations=simulations,
        reward=reward, actions=actions, exploration=exploration, memoize=memoize, top=top, threads=threads, lanes=lanes, available=available,
        progress=progress, callback=callback,
    )  # fmt: skip
