"""The cross-entropy method over disturbance sequences: draw episodes, keep the elites, draw the
next ones like them.

The cross-entropy method for optimisation with smoothed updating (de Boer, Kroese, Mannor and
Rubinstein 2005, A tutorial on the cross-entropy method), for proposals that are independent over
time, each step with its own (`normal_space.sequences`). Unlike there, elites are the best of
all iterations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core import actions as choices
from jast._src.core.counter_prng import tree_keys
from jast._src.core.episode import Episode
from jast._src.core.failures import Failures
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator, require_simulator
from jast._src.core.typing import Actions, Callback, PathLike, PRNGKey, Reward
from jast._src.normal_space import sequences
from jast._src.runtime import work
from jast._src.runtime._jax import jit, quick
from jast._src.runtime.host_errors import incidents
from jast._src.runtime.memory import require_episodes
from jast._src.search.calibration import with_calibration
from jast._src.search.cem_proposals import copy_steps, latents_around, make_draw, proposal_kinds
from jast._src.search.driver import Log, finish, finish_traced, require_counts, run
from jast._src.search.lanes import Tally, blank_episodes, distinct_episodes, play_lanes, take_rows
from jast._src.search.refine.final import default_share, with_refine_share
from jast._src.search.result import SearchResult, Trials
from jast._src.search.setup import default_actions, prepare
from jast._src.util import checks
from jast._src.util.pytrees import index_tree, merge_axes

__all__ = ["cem"]


class Shares(NamedTuple):
    """The real-valued settings, all traced."""

    smoothing: jax.Array | float
    floor: jax.Array | float
    fresh: jax.Array | float


class Plan(NamedTuple):
    """The static ones."""

    samples: int
    elites: int
    kinds: tuple[str, str]
    """Of x0 and x (`proposal_kinds`)."""


class Elites(NamedTuple):
    """The K best distinct episodes of a tree so far, best first: the elites, and the archive."""

    episode: Episode
    """[K]; reward -inf where there are fewer."""
    latent: tuple[Any, Any] | tuple[()]
    """z of (x0, x): leaves [K, 1, ...] and [K, horizon, ...]; ``()`` where they are copied."""
    tag: jax.Array
    number: jax.Array
    count: jax.Array


class State(NamedTuple):
    """A search so far, of every tree."""

    elites: Elites
    proposals: tuple[Any, Any]
    """Of x0 and x: `normal_space.sequences.Steps`; ``()`` where they are copied."""


def cem(
    key: PRNGKey,
    sim: Simulator,
    *,
    samples: int = 300,
    elites: int = 30,
    iterations: int = 30,
    reward: Reward | None = None,
    actions: Actions | None = None,
    smoothing: float = 0.3,
    floor: float = 0.05,
    fresh: float = 0.1,
    trees: int = 1,
    failures: Failures | None = None,
    refine: float | None = None,
    top: int = 64,
    record: bool = False,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
) -> SearchResult:
    """Search by the cross-entropy method: every iteration simulates a batch of episodes like the
    best distinct ones so far, its elites.

    Failures rank before other episodes, each by reward; an episode whose reward is not finite is
    never an elite. With ``actions.quantiles()`` and ``uniform(low, high)``, x_t is the quantile, or
    the point of the box, at u = Phi(z). The z_t ~ N(m_t, s_t^2) are fitted to the elites and begin
    at N(0, 1). ``wide()`` begins at N(0, width^2); where no width is given it widens only where all
    plain episodes have the same miss distance, so that nothing else points to failures. With
    ``samples()``, for any disturbance (integers, seeds of unknown density), x_t is that of a random
    elite, each step from another. A random start is treated likewise, but never by the box.

    A reward whose log p outweighs the distance, such as `jast.rewards.standard` over many steps,
    has its best non-failing episode far from any failure, and the elites gather there.

    KeyboardInterrupt ends the search with the result of the whole iterations, and
    ``settings["interrupted"]`` says so. Works under `jax.jit` and `jax.vmap`, without archive,
    history and callbacks.

    Args:
        key: consumed.
        sim: the simulator.
        samples: episodes in a batch; static, like all counts. The defaults are tuned on the ferry;
            1000 samples, 100 elites and 10 iterations are the customary ones.
        elites: how many of the best episodes the next batch is like.
        iterations: how many batches.
        reward: what is maximised. Default: `jast.rewards.lexicographic`, with its scales from 128
            plain episodes of the system (10 of a black box), which count among the episodes, as
            tree -1.
        actions: of `jast.actions`. Default: wide where disturbances have a quantile function, else
            samples.
        smoothing: share of the last fit that is kept, from 0 to 1; traced, like ``floor`` and
            ``fresh``.
        floor: the least s_t, from 0 to 1.
        fresh: with ``samples()``, the probability that a step draws from p(x | s) instead.
        trees: independent searches, side by side; tree k is the same whatever their number.
        failures: an archive. The first draws lie around the likeliest of them, as wide as without
            it, so that a search continues from what others found. With ``quantiles()`` and
            ``wide()`` only.
        refine: as for `forest`, the share that pulls the failures to where they are likeliest.
        top: distinct failures kept.
        record: keep the numbers of every episode (``result.trials``).
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` after every iteration, with the episodes
            of all trees.
        checkpoint: a folder that keeps the iterations. The same call then goes on where it was
            stopped, to the same result (docs/scale.md).

    Returns:
        `SearchResult`.

    Raises:
        ValueError: for a count below 1, more elites than samples, a setting outside its range, a
            ``refine`` that is not possible, and where the simulator's functions or the actions do
            not fit together.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> result = jast.search.cem(jax.random.key(0), sim, samples=50, elites=5, iterations=4)
        >>> bool(result.best.failure)
        True
    """
    name = "cem"
    counts = dict(samples=samples, elites=elites, iterations=iterations, trees=trees)
    samples, elites, iterations, trees, top = require_counts(name, **counts, top=top)
    if elites > samples:
        raise ValueError(f"{name}: elites must be at most samples, {samples}, received {elites}")
    if samples * iterations * trees >= 2**31:
        raise ValueError(
            f"{name}: samples x iterations x trees must be below 2^31, received {samples} x"
            f" {iterations} x {trees}"
        )
    require_simulator(name, sim)
    require_episodes(name, sim, samples * trees)
    shares = dict(smoothing=smoothing, floor=floor, fresh=fresh)
    for setting, value in shares.items():
        shares[setting] = checks.real_number(
            name, setting, value, lambda v: 0 <= v <= 1, "from 0 to 1"
        )
    actions, before = default_actions(name, sim) if actions is None else actions, incidents(sim)
    reward, actions, settings, calibration = prepare(
        name, key, sim, reward, actions, widen="blind", **counts, **shares
    )
    settings = with_refine_share(name, refine, sim, settings, default_share(sim, reward))
    around = () if failures is None else latents_around(sim, actions, failures, settings)
    search = _Search(
        sim=sim,
        reward=reward,
        top=top,
        keys=tree_keys(key, trees),
        actions=actions,
        shares=Shares(**shares),
        plan=Plan(samples, elites, proposal_kinds(sim, actions)),
        around=around,
        record=bool(record),
    )
    ends = [samples * (i + 1) for i in range(iterations)]
    if settings is None:
        work.require_untraced(name, checkpoint=checkpoint)
        found = search.traced(iterations)
        return with_calibration(sim, reward, calibration, found, top)
    how = dict(trees=trees, record=search.record, calibration=calibration, before=before)
    watched = dict(progress=progress, callback=callback, checkpoint=checkpoint)
    about = dict(reward=reward, actions=actions, around=around)
    return run(key, search, ends, settings, **how, **watched, **about)


@dataclass(frozen=True)
class _Search:
    """A `search.driver.Search`."""

    sim: Simulator
    reward: Reward
    top: int
    keys: jax.Array
    """[trees]"""
    actions: Actions
    shares: Shares
    plan: Plan
    around: tuple[Any, Any] | tuple[()]
    record: bool

    def init(self) -> State:
        wide = isinstance(self.actions, choices.Wide)
        width = self.actions.width if wide else 1.0
        size = max(self.plan.elites, self.top)
        return _first_state(self.sim, self.plan, len(self.keys), size, width, self.around)

    def step(
        self, state: State, begin: int, end: int
    ) -> tuple[State, Tally, jax.Array, Trials | None]:
        """One iteration of all trees."""
        parts = self.keys, self.sim, self.reward, self.actions, self.shares, self.plan
        state, tally, best, trials = _iteration(*parts, state, begin)
        return state, tally, best, jax.tree.map(jnp.transpose, trials) if self.record else None

    def result(self, state: State, log: Log, settings: dict[str, Any]) -> SearchResult:
        found, tree, number, count = jax.device_get(_best_failures(state.elites, self.top))
        n = int((found.reward > -jnp.inf).sum())
        found, tree, number, count = index_tree((found, tree, number, count), np.s_[:n])
        best = _best_episode(state.elites)
        return finish(self, log, best, found, number, counts=count, settings=settings, trees=tree)

    def traced(self, iterations: int) -> SearchResult:
        """The `SearchResult` inside a transformation."""

        def body(i, carry):
            state, tally = carry
            state, more, *_ = self.step(state, i * self.plan.samples, None)
            return state, tally.add(more)

        start = self.init(), Tally.none(len(self.keys))
        state, tally = lax.fori_loop(0, iterations, body, start)
        best, rewards = _best_episode(state.elites), state.elites.episode.reward[:, 0]
        return finish_traced(self.sim, self.reward, tally, best, rewards)


@partial(jit, static_argnums=5)
def _iteration(keys, sim, reward, actions, shares, plan, state, begin):
    """One iteration of all trees, from episode number ``begin`` on: (`State`, `Tally`, the
    best rewards so far [trees], `Trials`).
    """
    (trees,), samples = keys.shape, plan.samples
    number = begin + jnp.arange(samples, dtype=jnp.int32)
    keys = jax.vmap(lambda k: jax.vmap(partial(jax.random.fold_in, k))(number))(keys)
    rows = jax.vmap(lambda k, s: _propose(k, sim, shares, plan, s))(keys, state)

    def by_tree(tree):
        return jax.tree.map(lambda a: a.reshape(trees, samples, *a.shape[1:]), tree)

    of_start = make_draw(plan.kinds[0], choices.quantiles(), actions.draw_start)
    of_step = make_draw(plan.kinds[1], actions, actions.draw)
    live = jnp.ones((trees * samples,), bool)
    level_first = jax.tree.map(lambda a: jnp.moveaxis(a, 1, 0), merge_axes(rows))
    keys = merge_axes(keys)
    played = play_lanes(sim, reward, keys, of_start, of_step, live, level_first, record=True)
    tree = jnp.repeat(jnp.arange(trees, dtype=jnp.int32), samples)
    # trees run side by side
    tally = Tally.of(played, live, jnp.tile(number, trees) * trees + tree, tree, trees)
    z = tuple(row if kind == "latent" else () for kind, row in zip(plan.kinds, rows, strict=True))
    number = jnp.broadcast_to(number, (trees, samples))
    episode, tag, once = by_tree(played.episode), by_tree(played.tag), jnp.ones_like(number)
    new = Elites(episode, z, tag, number=number, count=once)
    elites = jax.vmap(_merge)(state.elites, new)
    proposals = jax.vmap(lambda g, e: _fit(g, e, shares, plan))(state.proposals, elites)
    best = elites.episode.reward[:, 0]
    return State(elites, proposals), tally, best, by_tree(played.trials())


def _propose(keys, sim, shares, plan, state):
    """Of one tree: the rows [samples, 1, ...] that x0 is made of (``()``: one start), and [samples,
    horizon, ...] those of x.
    """
    elite = index_tree(state.elites.episode, np.s_[: plan.elites])
    start = signature_of(sim).random_start
    known = jnp.where(elite.reward > -jnp.inf, 1, -1)
    parents = (
        (index_tree(elite.x0, np.s_[:, None]), known),
        (elite.disturbances, jnp.where(known > 0, elite.length, -1)),
    )

    def rows(part):
        if plan.kinds[part] == "latent":
            steps, offset = state.proposals[part], int(start) * part
            return jax.vmap(lambda k: sequences.sample(k, steps, offset))(keys)
        return jax.vmap(lambda k: copy_steps(k, *parents[part], shares.fresh, part))(keys)

    return rows(0) if start else (), rows(1)


def _fit(proposals, elites, shares, plan):
    """The proposals of one tree, fitted to the elites at the steps that they reached."""
    z, reward, length = index_tree(
        (elites.latent, elites.episode.reward, elites.episode.length), np.s_[: plan.elites]
    )
    known = reward[:, None] > -jnp.inf
    horizon = jax.tree.leaves(elites.episode.disturbances)[0].shape[1]
    counts = known, known & (jnp.arange(horizon, dtype=jnp.int32)[None] < length[:, None])
    return tuple(
        sequences.fit(g, v, n, shares.smoothing, shares.floor) if g != () else ()
        for g, v, n in zip(proposals, z, counts, strict=True)
    )


def _merge(elites, new):
    """The best of both; an episode of reward -inf stands first only where there is no other."""
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), elites, new)
    (k,), (n,) = elites.tag.shape, both.tag.shape
    places, counts = distinct_episodes(
        both.episode.failure, both.episode.reward, both.tag, both.number, both.count, k
    )
    there = places < n
    best = take_rows(both, jnp.where(there | (jnp.arange(k) > 0), places, k))
    reward = jnp.where(there, best.episode.reward, -jnp.inf)
    return best._replace(episode=best.episode._replace(reward=reward), count=counts)


@partial(quick, static_argnums=(1, 2, 3))
def _first_state(sim, plan, trees, k, width, around):
    """No elites and the first proposals, of every tree."""

    def first(kind, like, steps, mean):
        """The proposal of x0 or x, and latents of the elites."""
        if kind == "copy" or not jax.tree.leaves(like):
            return (), ()
        made = sequences.standard_normal(like, steps, width)
        made = made._replace(mean=mean) if around else made
        return made, jax.tree.map(lambda a: jnp.zeros((k, *a.shape), a.dtype), made.mean)

    likes = signature_of(sim).x0, signature_of(sim).x
    parts = zip(plan.kinds, likes, (1, sim.horizon), around or ((), ()), strict=True)
    proposals, z = zip(*(first(*part) for part in parts), strict=True)
    zero = jnp.zeros((k,), jnp.int32)
    tag = zero.astype(jnp.uint32)
    elites = Elites(blank_episodes(sim, k), z, tag, number=zero, count=zero)
    one = State(elites, proposals)
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (trees, *a.shape)), one)


@quick
def _best_episode(elites):
    """The best episode of all trees."""
    e = index_tree(elites.episode, np.s_[:, 0])
    i = jnp.argmax(jnp.where(e.failure | ~jnp.any(e.failure), e.reward, -jnp.inf))
    return index_tree(e, i)


@partial(quick, static_argnums=1)
def _best_failures(elites, top):
    """The ``top`` best distinct failures of all trees: (episodes, tree, number, count), reward -inf
    where there are fewer.
    """
    trees, k = elites.tag.shape
    flat = merge_axes(elites._replace(latent=()))
    failure, reward = flat.episode.failure, flat.episode.reward
    value = jnp.where(failure, reward, -jnp.inf)
    places, counts = distinct_episodes(failure, value, flat.tag, flat.number, flat.count, top)
    episode, number = take_rows((flat.episode, flat.number), places)
    reward = jnp.where(places < trees * k, episode.reward, -jnp.inf)
    return episode._replace(reward=reward), places // k, number, counts
