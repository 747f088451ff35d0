"""Paths of episodes of a black box whose objects are saved where they came nearer to a failure, and
resumed there. Disturbances are drawn on the device, for all lanes of a batch at once.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import distributions as D
from jast._src.core.counter_prng import counter_key
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.estimate.splitting.levels import FRESH, Played
from jast._src.runtime._jax import quick
from jast._src.util.pytrees import index_tree

__all__ = ["ObjectPaths"]

LANES = 32
"""Objects that are moved side by side, by one draw of disturbances for all of them; so many are
alive at once."""


class Branch(NamedTuple):
    """A state of a path at which others may go on."""

    score: float
    state: Any
    """The simulator's, in NumPy"""
    saved: Any
    """What brings the object back; None where the episode is over"""


class Lane:
    """An episode that is under way: its newest state, its object, and where it came to."""

    def __init__(self, state: Any, thing: Any, horizon: int):
        self.state, self.thing, self.horizon = state, thing, horizon
        self.score = self.top = -np.inf
        self.steps = self.undefined = 0

    @property
    def x0(self):
        """Leaves."""
        return jax.tree.leaves(self.state.x0)

    @property
    def over(self):
        """Whether the episode is."""
        s = self.state
        return bool(s.event | s.terminal | self.invalid) or int(s.t) >= self.horizon

    @property
    def invalid(self):
        """Whether something went wrong."""
        return not np.isfinite(self.state.distance)


class ObjectPaths:
    """``n`` paths of a black box, as `levels.Paths`."""

    def __init__(self, key: jax.Array, sim: Simulator, score: Callable | None, n: int, objects):
        self.sim, self.score, self.n, self.objects = sim, score, n, objects
        self.key, self.times = counter_key(key, 1), 0
        self.branches: list[list[Branch]] = [[] for _ in range(n)]
        signature = signature_of(sim)
        self.blank = jax.tree.map(lambda s: np.zeros(s.shape, s.dtype), signature.state)

    def play(self, paths: np.ndarray, parents: np.ndarray, level: float) -> Played:
        """As `levels.Paths`."""
        played = []
        for begin in range(0, len(paths), LANES):
            here = slice(begin, begin + LANES)
            played += self._play_lanes(paths[here], parents[here], level)
        for path in range(self.n):  # nobody branches below a level again
            self.branches[path] = [b for b in self.branches[path] if b.score > level]
        return Played(
            np.array([lane.top for lane in played]),
            np.array([lane.invalid for lane in played]),
            sum(lane.steps for lane in played),
            sum(lane.undefined for lane in played),
        )

    def _play_lanes(self, paths, parents, level):
        """The last `Lane` of each."""
        self.times += 1
        if (parents == FRESH).all():
            lanes = self.begin(len(paths))
            for path, lane in zip(paths, lanes, strict=True):
                self.branches[path] = []
                self._keep(path, lane)
        else:
            lanes = [self._resume(path, parent, level) for path, parent in zip(paths, parents)]
        while live := [i for i, lane in enumerate(lanes) if not lane.over]:
            xs = self.draw(lanes)
            for i in live:
                self.move(lanes[i], [a[i] for a in xs])
            self._rate([lanes[i] for i in live])
            for i in live:
                self._keep(paths[i], lanes[i])
        return lanes

    def begin(self, count):
        """New episodes: a list of `Lane`."""
        x0s = jax.device_get(_draw_starts(self.sim, self.key, np.int32(self.times)))
        lanes = []
        for i in range(count):
            x0 = index_tree(x0s, i)
            thing, look = self.objects.begin(jax.tree.leaves(x0))
            state = self.blank._replace(begun=np.ones((), bool), x0=x0)
            lanes.append(Lane(_with_look(state, look), thing, self.sim.horizon))
        self._rate(lanes)
        return lanes

    def _resume(self, path, parent, level):
        """The `Lane` that goes on from the first state of its parent above ``level``."""
        branch = next(b for b in self.branches[parent] if b.score > level)
        self.branches[path] = [branch]
        lane = Lane(branch.state, None, self.sim.horizon)
        lane.score = lane.top = branch.score
        if branch.saved is not None:
            lane.thing = self.objects.resume(branch.saved, lane.x0)
        return lane

    def draw(self, lanes):
        """The next disturbance of each lane, as leaves [LANES, ...]."""
        xs = _draw_next(self.sim, self.key, np.int32(self.times), self._stacked(lanes))
        return jax.tree.leaves(jax.device_get(xs))

    def move(self, lane, x):
        """The lane goes on by this disturbance, leaves; returns what its object then says."""
        state, t = lane.state, int(lane.state.t)
        leaves, tree = jax.tree.flatten(state.disturbances)
        leaves = [a.copy() for a in leaves]  # a branch may hold the old ones
        for a, value in zip(leaves, x, strict=True):
            a[t] = value
        state = state._replace(t=np.int32(t + 1), disturbances=tree.unflatten(leaves))
        lane.thing, look = self.objects.move(lane.thing, lane.x0, [a[: t + 1] for a in leaves])
        lane.state, lane.steps = _with_look(state, look), lane.steps + 1
        return look

    def _rate(self, lanes):
        """Set the scores of these lanes at their states."""
        given = [-lane.state.distance for lane in lanes]
        if self.score is not None:
            given = jax.device_get(_score_states(self.score, self._stacked(lanes)))
        for lane, value in zip(lanes, given):  # what fills up a batch has no lane
            undefined = bool(np.isnan(value)) and not lane.invalid
            lane.undefined += undefined
            lane.score = min(float(value), float(np.finfo(value.dtype).max))
            if undefined or lane.invalid:
                lane.score = -np.inf
            if lane.state.event:
                lane.score = np.inf

    def _stacked(self, lanes):
        """Their states as arrays [LANES, ...], filled up with states of zeros."""
        states = [lane.state for lane in lanes] + [self.blank] * (LANES - len(lanes))
        return jax.tree.map(lambda *a: np.stack(a), *states)

    def _keep(self, path, lane):
        """Save a state where a lane came higher than before; let go of its object at the end."""
        if lane.score > lane.top or not self.branches[path]:
            lane.top = lane.score
            saved = None if lane.over else self.objects.save(lane.thing)
            self.branches[path].append(Branch(lane.score, lane.state, saved))
        if lane.over and lane.thing is not None:
            self.objects.release(lane.thing)
            lane.thing = None


def _with_look(state, look):
    """The simulator's state with what the object says there."""
    dtype = state.distance.dtype
    with np.errstate(over="ignore"):
        return state._replace(
            event=np.asarray(look.event),
            distance=np.asarray(look.distance, dtype),
            terminal=np.asarray(look.terminal),
            log_p=np.asarray(look.log_p, state.log_p.dtype),
            seen=np.asarray(look.seen, state.seen.dtype),
        )


@quick
def _draw_starts(sim, key, time):
    """x0 of `LANES` episodes."""
    keys = jax.random.split(jax.random.fold_in(key, time), LANES)
    return jax.vmap(lambda k: D.sample(sim.start(), jax.random.fold_in(k, 0)))(keys)


@quick
def _draw_next(sim, key, time, states):
    """The disturbances of `LANES` episodes at their states."""
    keys = jax.random.split(jax.random.fold_in(key, time), LANES)

    def draw(key, state):
        return D.sample(sim.disturbance(state), jax.random.fold_in(key, state.t + 1))

    return jax.vmap(draw)(keys, states)


@quick
def _score_states(score, states):
    """[LANES] scores."""
    return jax.vmap(lambda state: jnp.asarray(score(state)).astype(jnp.zeros(()).dtype))(states)
