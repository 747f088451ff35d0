"""Multistart descent by gradients through the simulator to the boundary of failure, and along it to
the likeliest failures (`jast.boundary`, `jast.search.refine`).
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import jax
import numpy as np

from jast import _checks
from jast import boundary as B
from jast._jax import is_traced, is_tracing, jit
from jast.episode import Episode, play_back
from jast.incidents import runs_on_host
from jast.limit_state import check, dimension, normal_numbers, played, side_by_side
from jast.results import call_settings
from jast.search import kept as K
from jast.search import lockstep as E
from jast.search.ending import ended, planned
from jast.search.result import SearchResult
from jast.simulator import Simulator

if TYPE_CHECKING:
    import chex

    from jast.typing import Callback

__all__ = ["gradient"]

GRADIENT = 4
"""Evaluations that one with its gradient is counted as."""
SHARE = 2.0
"""Of the evaluations, for the refinement: descents are few, and end anywhere on the boundary."""
LIFTS = 0.0, 1e-6, 1e-5, 1e-4, 1e-3
"""How much farther out a point may be taken that is on the knife edge."""


def gradient(
    key: chex.PRNGKey,
    sim: Simulator,
    *,
    starts: int = 48,
    refine: float | None = None,
    top: int = 64,
    progress: bool = False,
    callback: Callback | None = None,
) -> SearchResult:
    """Follow the gradient of the miss distance to failures, and make them as likely as they get.

    From each of ``starts`` draws of the model, twelve steps to the nearest point of the linearised
    boundary of failure, in the normal numbers of the disturbances; then `jast.search.refine`. It
    needs few evaluations where the distance is smooth, and finds nothing where it is flat.

    Args:
        key: consumed.
        sim: the simulator, written in JAX; its disturbances have quantile functions.
        starts: draws of the model to go from.
        refine: evaluations of the refinement, as a share of those of the descents; 0 for none.
            Default: 2.
        top: distinct failures kept.
        progress: show a bar.
        callback: called as ``callback(done, total, None)``, in evaluations, after the descents.

    Returns:
        `SearchResult`: the ends of the descents, and what came of them (``refined``). Its reward is
        that of `jast.rewards.standard` with the density relative to the mode (raw, where there is
        none). ``episodes`` and ``steps`` are evaluations of the descents, one with its gradient
        counted as 4. ``settings["useful_gradients"]`` is the share of the gradients that were
        finite and not 0: where that is 0 the distance has none, and no failure is found but by the
        draws themselves.

    Raises:
        ValueError: for a count below 1, a negative ``refine``, a system that runs on the host,
            disturbances without a quantile function, a simulator whose functions do not fit
            together, and inside of a transformation of JAX.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> result = jast.search.gradient(jax.random.key(0), sim, starts=4, refine=0)
        >>> bool(result.best.failure)
        True
    """
    name = "gradient"
    starts, top = E.whole(name, starts=starts, top=top)
    _checks.check_random_key(name, key)
    if is_traced(key, sim) or is_tracing():
        raise ValueError(f"{name}: cannot be traced; call it outside of jax.jit and jax.vmap")
    if runs_on_host(sim):
        raise ValueError(
            f"{name}: sim runs on the host and has no gradients; jast.search.go_explore and"
            " jast.search.chain need none"
        )
    check(name, sim)
    search = _Search(key, sim, starts, top)
    settings = planned(name, refine, sim, call_settings(name, key, starts=starts), SHARE)
    cost = starts * (B.STEPS * GRADIENT + B.EPISODES)
    found, log = E.drive(
        search.chunk,
        (None, None, 0.0),
        [cost],
        progress=progress,
        callback=callback,
        name=name,
    )
    found = search.result(found, log, settings | dict(useful_gradients=round(found[2], 4)))
    return ended(key, sim, search.reward, found, top)


class _Search:
    """What does not change while a search runs."""

    def __init__(self, key, sim, starts, top):
        self.sim, self.reward, self.starts, self.top = sim, K.likelihood(sim), starts, top
        self.draw, _ = jax.random.split(key)

    def chunk(self, *_):
        """The descents: ((failing episodes, the nearest one, share of useful gradients), `E.Tally`,
        best reward, None).
        """
        sim, n = self.sim, self.starts
        z = jax.random.normal(self.draw, (n, dimension(sim)), normal_numbers(sim))
        d = jax.device_get(B.descents(sim, z))
        ends = np.where(np.isfinite(d.point).all(axis=1) & d.found)[0]
        failing = self._failing(d.point[ends])
        i = int(np.argmin(d.distance))
        nearest = jax.tree.map(lambda a: a[0], played(sim, d.nearest[i][None]))
        first = int(d.first.min())
        # side by side, the gradients of a step before its other episodes
        order = (first * (GRADIENT * n + n * (B.EPISODES // B.STEPS))) + GRADIENT * n
        order += int(np.argmin(d.first)) + 1
        counted = self._tally(
            n * (B.STEPS * GRADIENT + B.EPISODES),
            GRADIENT * int(d.slopes.sum()) + int(d.steps.sum()),
            int(d.failing.sum()),
            int(d.invalid.sum()),
            order if first < B.STEPS else None,
        )
        found = failing, nearest, float(d.useful.sum()) / (n * B.STEPS)
        return found, counted, self._best(found), None

    def _failing(self, z):
        """The failing episodes of the points ``z`` [n, D], lifted as little as makes them fail;
        None where there is none.
        """
        if not len(z):
            return None
        lifted = z[None] * (1 + np.array(LIFTS, z.dtype))[:, None, None]
        e = played(self.sim, lifted.reshape(-1, z.shape[1]))
        fails = e.failure.reshape(len(LIFTS), -1)
        rows = (np.argmax(fails, axis=0) * len(z) + np.arange(len(z)))[fails.any(axis=0)]
        return self._scored(jax.tree.map(lambda a: a[rows], e)) if len(rows) else None

    def _scored(self, e):
        """The episodes, with log p relative to the mode as their reward."""
        return side_by_side(self.sim, partial(_scored, self.sim, self.reward), e)

    def _best(self, found):
        failing, nearest, _ = found
        return np.array([nearest.reward if failing is None else failing.reward.max()])

    def _tally(self, episodes, steps, failures, invalid, first):
        number = E.NEVER if first is None else first
        return E.Tally(episodes, steps, failures, invalid, number, np.array([failures > 0]))

    def result(self, found, log, settings):
        failing, nearest, _ = found
        none = jax.tree.map(lambda a: np.asarray(a)[None][:0], nearest)
        e = none if failing is None else failing
        n = len(e.length)
        numbers = np.arange(n), np.ones(n, np.int32)
        return E.finish(
            self.sim, self.reward, log, nearest, e, [0] * n, *numbers, settings, self.top
        )


@jit
def _scored(sim, reward, e: Episode) -> Episode:
    play = lambda x0, x, n: play_back(sim, reward, x0, x, n)._replace(states=None)
    return jax.vmap(play)(e.x0, e.disturbances, e.length)
