"""Markov chains on the failures, side by side at several widths of the noise.

A chain of width w moves over the normal numbers z of the disturbances and keeps N(0, w^2 I) given
failure, by the proposal of Cotter, Roberts, Stuart and White 2013. Wide ones go from failure mode
to failure mode, narrow ones are near the likeliest failure of theirs, and neighbours exchange their
points (parallel tempering, Geyer 1991; Earl and Deem 2005). There is no drift by the gradient: the
density of z is Gaussian, and the proposal has that drift already, exactly.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import tree_keys
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Callback, PathLike, PRNGKey
from jast._src.normal_space.pcn import WIDTHS
from jast._src.normal_space.transform import check, dimension, normal_numbers
from jast._src.runtime.host_errors import runs_on_host
from jast._src.search.best_episodes import BestEpisodes, standard_reward
from jast._src.search.chain_moves import Chains, Points, draw_wider, move_chains, no_points
from jast._src.search.driver import Log, require_counts, require_host, run
from jast._src.search.lanes import Tally
from jast._src.search.refine.final import SHARE, with_refine_share
from jast._src.search.result import SearchResult
from jast._src.util import checks
from jast._src.util.display import call_settings
from jast._src.util.pytrees import index_tree

__all__ = ["chain"]

LANES = 64  # chains of all widths: few, as what they need is many moves
MOMENTS = 100  # of the history, about
FAILING_SHARE = 0.1  # the widest noise is the first of `WIDTHS` of which so many draws fail
WIDEST_WITHOUT = 3.0  # the widest noise where nothing fails
MIN_LEVELS = 4  # widths of the chains, at least
MAX_LEVELS = 16  # widths of the chains, at most
FIRST_SCALE = 0.5  # of the moves, before it adapts


class State(NamedTuple):
    """The best so far, draws of ever wider noise, and the chains that began at the failing ones."""

    best: BestEpisodes
    draws: tuple[Points, ...]
    """Of each of `WIDTHS`; empty before it was drawn."""
    chains: Chains
    widths: np.ndarray
    """[L] of the chains; 0 before they begin."""


def chain(
    key: PRNGKey,
    sim: Simulator,
    *,
    episodes: int = 100_000,
    narrowest: float = 0.25,
    refine: float | None = None,
    top: int = 64,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
) -> SearchResult:
    """Find likely failures of many kinds by Markov chains that never leave the failures.

    First, failures are looked for with ever wider noise. From those that are found chains go on, at
    widths from that one to ``narrowest`` times the model's; each move is an episode, taken where it
    fails. Chains that have no failure to begin with take moves of lesser miss distance until they
    have one.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        episodes: moves of all chains, and the draws before.
        narrowest: width of the narrowest noise, above 0 and below 1. The narrower, the nearer to
            the likeliest failures, and the smaller the moves.
        refine: evaluations of `jast.search.refine` at the end, on top of the episodes, as a share
            of these; 0 for none. Default: 0.1.
        top: distinct failures kept.
        progress: show a bar.
        callback: called as ``callback(done, total, None)``, in episodes.
        checkpoint: a folder that keeps what the chains came to now and then. The same call then
            goes on where it was stopped, to the same result.

    Returns:
        `SearchResult`: the likeliest of all failures that a chain was offered. Their reward is that
        of `jast.rewards.standard` with the density relative to the mode (raw, where there is none).
        ``settings`` has the ``widths`` and for each the share of moves taken (``accepted``) and of
        exchanges with the next (``swapped``): where these are nearly 0 the narrow chains know of no
        failure mode that the wide ones found since. KeyboardInterrupt ends the search with what it
        has.

    Raises:
        ValueError: for a count below 1, ``narrowest`` or ``refine`` outside its range, disturbances
            without a quantile function, a simulator whose functions do not fit together, and inside
            of a transformation of JAX.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> result = jast.search.chain(jax.random.key(0), sim, episodes=2000, refine=0)
        >>> bool(result.best.failure)
        True
    """
    name = "chain"
    episodes, top = require_counts(name, episodes=episodes, top=top)
    expected = "above 0 and below 1"
    narrowest = checks.number(name, "narrowest", narrowest, lambda v: 0 < v < 1, expected)
    require_host(name, key, sim)
    check(name, sim)
    given = dict(episodes=episodes, narrowest=narrowest)
    settings = with_refine_share(name, refine, sim, call_settings(name, key, **given), SHARE)
    search = _Search(key, sim, episodes, narrowest, top)
    lanes = search.levels * search.chains
    stretch = lanes if runs_on_host(sim) else lanes * max(1, episodes // (lanes * MOMENTS))
    draws = [lanes * (i + 1) for i in range(len(WIDTHS))]
    ends = [*draws, *range(draws[-1] + stretch, episodes, stretch)]
    ends = [*(end for end in ends if end < episodes), episodes]
    watched = dict(progress=progress, callback=callback, checkpoint=checkpoint)
    return run(key, search, ends, settings, **watched)


class _Search:
    """A `search.driver.Search`."""

    def __init__(self, key: jax.Array, sim: Simulator, episodes: int, narrowest: float, top: int):
        self.sim, self.reward, self.top = sim, standard_reward(sim), top
        self.key, self.narrowest = tree_keys(key, 1)[0], narrowest
        lanes = max(2 * MIN_LEVELS, min(LANES, 1 << (episodes // 16).bit_length()))
        # the logarithms of neighbouring widths differ by 2 / sqrt(D), so that they exchange points
        ratios = math.log(WIDEST_WITHOUT / narrowest) * math.sqrt(dimension(sim)) / 2
        self.levels = min(max(math.ceil(ratios) + 1, MIN_LEVELS), MAX_LEVELS, lanes // 2)
        self.chains = lanes // self.levels

    def init(self) -> State:
        d, real, levels = dimension(self.sim), normal_numbers(self.sim), self.levels
        draws, zero = (no_points(0, d, real),) * len(WIDTHS), np.zeros(levels, real)
        chains = Chains(no_points(levels, d, real), zero, zero, zero[1:])
        return State(BestEpisodes.none(self.sim, max(self.top, 64)), draws, chains, zero)

    def step(self, state: State, begin: int, end: int) -> tuple[State, Tally, jax.Array, None]:
        """Draw noise of the next width, or move the chains."""
        best, draws, chains, widths = state
        common, ends = (self.key, self.sim, self.reward), (np.int32(begin), np.int32(end))
        lanes = self.levels * self.chains
        drawn = draws[: begin // lanes]  # while there are no chains
        if not widths[0] and not self._enough(drawn):
            width = np.asarray(WIDTHS[len(drawn)], widths.dtype)
            (best, points), tally = draw_wider(*common, lanes, best, *ends, width)
            draws = (*drawn, points, *draws[len(drawn) + 1 :])
        else:
            if not widths[0]:
                chains, widths = self.first_chains(drawn)
            (best, chains), tally = move_chains(*common, best, chains, widths, *ends)
        return State(best, draws, chains, widths), tally, best.reward(), None

    def _enough(self, draws: tuple[Points, ...]) -> bool:
        failing = bool(draws) and np.mean(draws[-1].failing) >= FAILING_SHARE
        return failing or len(draws) == len(WIDTHS)

    def first_chains(self, draws: tuple[Points, ...]) -> tuple[Chains, np.ndarray]:
        """The chains and their widths: of the failures at the width that has most of them, up to
        the first that has enough; else of the nearest draws.
        """
        shares = [float(np.mean(points.failing)) for points in draws]
        i = int(np.argmax(shares)) if max(shares) > 0 else WIDTHS.index(WIDEST_WITHOUT)
        points = jax.device_get(draws[i])
        rank = np.where(points.failing, -np.inf, points.distance)
        order = np.argsort(rank, kind="stable")
        usable = int(points.failing.sum()) or len(order)
        # those of one width differ as far as there are enough
        level, column = np.indices((self.levels, self.chains))
        rows = order[(level + self.levels * column) % usable]
        widths = np.geomspace(max(WIDTHS[i], 1.0), self.narrowest, self.levels)
        real = points.z.dtype
        zero, scale = np.zeros(self.levels, real), np.full(self.levels, FIRST_SCALE, real)
        chains = Chains(index_tree(points, rows), scale, zero, zero[1:])
        return chains, widths.astype(real)

    def result(self, state: State, log: Log, settings: dict[str, Any]) -> SearchResult:
        chains = state.chains
        if state.widths[0]:
            shares = dict(widths=state.widths, accepted=chains.accepted, swapped=chains.swapped)
            shares = {k: np.round(np.asarray(a, float), 4).tolist() for k, a in shares.items()}
            settings = settings | shares
        return state.best.result(self, log, settings)
