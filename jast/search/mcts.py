"""Monte Carlo tree search with progressive widening, from one root: the paper's MCTS-SA, the classic of adaptive stress testing."""

from jast import rewards
from jast.search.forest import SAMPLES, _widening, search

__all__ = ["WIDENING", "mcts"]

WIDENING = {"default": (1.0, 0.5), "paper": (0.5, 0.6)}


def mcts(
    key, sim, *, trees=1, simulations=9000, reward=rewards.STANDARD, actions=SAMPLES, exploration=10.0, widening=None, mode="default", memoize="auto", top=64,
    threads=None, lanes=None, available=None, progress=False, callback=None,
):  # fmt: skip
    """Grow ``trees`` independent trees of ``simulations`` from their first root: `SearchResult`. The reward is maximised.

    `jast.search.forest` without its action pruning, and with all its settings; ``mode="paper"`` has the published widening (0.5, 0.6) of MCTS-SA, ``"default"``
    (1, 0.5). Raises ValueError as `jast.search.forest` does.
    """
    return search(
        "mcts", key, sim, trees=trees, prunes=1, simulations=simulations, reward=reward, actions=actions, exploration=exploration,
        widening=_widening("mcts", mode, widening, WIDENING), mode=mode, memoize=memoize, top=top, threads=threads, lanes=lanes, available=available,
        progress=progress, callback=callback,
    )  # fmt: skip
