"""Markov chains on the failures, side by side at several widths of the noise.

A chain of width w moves over the normal numbers z of the disturbances and keeps N(0, w^2 I) given
failure, by the proposal of Cotter, Roberts, Stuart and White 2013. Wide ones go from failure mode
to failure mode, narrow ones are near the likeliest failure of theirs, and neighbours exchange their
points (parallel tempering, Geyer 1991; Earl and Deem 2005). There is no drift by the gradient: the
density of z is Gaussian, and the proposal has that drift already, exactly.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jast import _checks
from jast._jax import is_traced, is_tracing
from jast.counter import tree_keys
from jast.incidents import incidents, new_incidents, runs_on_host
from jast.limit_state import check, dimension, normal_numbers
from jast.markov import WIDTHS
from jast.results import call_settings
from jast.search import kept as K
from jast.search import lockstep as E
from jast.search import tempering as T
from jast.search.ending import SHARE, ended, planned
from jast.search.result import SearchResult
from jast.simulator import Simulator

if TYPE_CHECKING:
    import chex

    from jast.typing import Callback

__all__ = ["chain"]

LANES, MOMENTS = 64, 100
"""Chains, of all widths together: few, as what they need is many moves."""
FAILING, LOST = 0.1, 3.0
"""The widest noise is the first of `WIDTHS` of which so many fail; where nothing does, this."""
LEVELS = 4, 16


def chain(
    key: chex.PRNGKey,
    sim: Simulator,
    *,
    episodes: int = 100_000,
    narrowest: float = 0.25,
    refine: float | None = None,
    top: int = 64,
    progress: bool = False,
    callback: Callback | None = None,
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
    episodes, top = E.whole(name, episodes=episodes, top=top)
    expected = "above 0 and below 1"
    narrowest = _checks.number(name, "narrowest", narrowest, lambda v: 0 < v < 1, expected)
    _checks.check_random_key(name, key)
    if is_traced(key, sim) or is_tracing():
        raise ValueError(f"{name}: cannot be traced; call it outside of jax.jit and jax.vmap")
    check(name, sim)
    settings = call_settings(name, key, episodes=episodes, narrowest=narrowest)
    settings = planned(name, refine, sim, settings, SHARE)
    size = max(2 * LEVELS[0], min(LANES, 1 << max(0, (episodes // 16).bit_length())))
    steps = math.ceil(math.log(LOST / narrowest) * math.sqrt(dimension(sim)) / 2)
    levels = min(max(steps + 1, LEVELS[0]), LEVELS[1], size // 2)
    shape = levels, size // levels
    search = _Search(key, sim, shape, narrowest)
    lanes = shape[0] * shape[1]
    before = incidents(sim)
    stretch = lanes if runs_on_host(sim) else lanes * max(1, episodes // (lanes * MOMENTS))
    looks = [lanes * (i + 1) for i in range(len(WIDTHS))]
    ends = [*looks, *range(looks[-1] + stretch, episodes, stretch)]
    ends = [*(end for end in ends if end < episodes), episodes]
    (kept, chains, widths, _), log = E.drive(
        search.chunk,
        (K.none(sim, max(top, 64)), None, (), []),
        ends,
        host=runs_on_host(sim),
        progress=progress,
        callback=callback,
        name=name,
    )
    if chains is not None:
        share = lambda a: np.round(np.asarray(a, float), 4).tolist()
        settings |= dict(
            widths=share(widths), accepted=share(chains.accepted), swapped=share(chains.swapped)
        )
    found = K.result(sim, search.reward, log, kept, settings, top)
    found = ended(key, sim, search.reward, found, top)
    return found._replace(incidents=new_incidents(before, incidents(sim)))


class _Search:
    """What does not change while a search runs."""

    def __init__(self, key, sim, shape, narrowest):
        self.key, self.sim, self.reward = tree_keys(key, 1)[0], sim, K.likelihood(sim)
        self.shape, self.narrowest = shape, narrowest

    def chunk(self, carry, begin, end):
        """Episodes ``begin`` .. ``end - 1``: look for failures, or move the chains."""
        kept, chains, widths, looks = carry
        ends = jnp.asarray(begin, jnp.int32), jnp.asarray(end, jnp.int32)
        if chains is None and not self._enough(looks):
            width = jnp.asarray(WIDTHS[len(looks)], normal_numbers(self.sim))
            lanes = self.shape[0] * self.shape[1]
            (kept, look), counted = T.look(
                self.key, self.sim, self.reward, lanes, kept, *ends, width
            )
            looks = [*looks, (float(width), look)]
        else:
            if chains is None:
                chains, widths = self._begun(looks)
            (kept, chains), counted = T.walk(
                self.key, self.sim, self.reward, kept, chains, widths, *ends
            )
        return (kept, chains, widths, looks), counted, K.best_of(kept), None

    def _enough(self, looks):
        share = lambda look: float(np.asarray(look[1][2]).mean())
        return len(looks) == len(WIDTHS) or (looks and share(looks[-1]) >= FAILING)

    def _begun(self, looks):
        """The chains and their widths: of the failures at the width that has most of them, up to
        the first that has enough; else of the nearest draws.
        """
        shares = [float(np.asarray(look[2]).mean()) for _, look in looks]
        i = int(np.argmax(shares)) if max(shares) > 0 else [w for w, _ in looks].index(LOST)
        widest, (z, used, failing, distance) = looks[i]
        rank = np.where(np.asarray(failing), -np.inf, np.asarray(distance))
        order = np.argsort(rank, kind="stable")
        known = int(np.asarray(failing).sum()) or len(order)
        levels, chains = self.shape
        # those of one width differ as far as there are enough
        rows = order[(np.arange(levels)[:, None] + levels * np.arange(chains)[None]) % known]
        real = z.dtype
        widths = np.geomspace(max(widest, 1.0), self.narrowest, levels)
        none, scale = np.zeros(levels, real), np.full(levels, 0.5, real)
        state = jax.tree.map(lambda a: np.asarray(a)[rows], (z, used, failing, distance))
        return T.Chains(*state, scale, none, none[1:]), widths.astype(real)
