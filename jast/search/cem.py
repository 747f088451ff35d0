"""The cross-entropy method over disturbance sequences: draw episodes, keep the elites, draw the
next ones like them.

The cross-entropy method for optimisation with smoothed updating (de Boer, Kroese, Mannor and
Rubinstein 2005, A tutorial on the cross-entropy method), for proposals that are independent over
time, each step with its own (`jast.cross_entropy.sequences`). Unlike there, elites are the best of
all iterations.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast import _checks, units
from jast import actions as choices
from jast._jax import jit
from jast.checkpoints import keep_answers, open_checkpoint
from jast.counter import tree_keys
from jast.cross_entropy import sequences
from jast.episode import Episode
from jast.incidents import incidents, new_incidents, runs_on_host
from jast.memory import require_episodes
from jast.outline import outline
from jast.search import lockstep as E
from jast.search import proposals as P
from jast.search.ending import ended, planned, usual
from jast.search.pilot import joined
from jast.search.prepare import default_actions, prepare
from jast.simulator import require_simulator

if TYPE_CHECKING:
    import chex

    from jast.failures import Failures
    from jast.search.result import SearchResult
    from jast.simulator import Simulator
    from jast.typing import Actions, Callback, PathLike, Reward

__all__ = ["cem"]


class Settings(NamedTuple):
    """The real-valued settings, all traced."""

    smoothing: Any
    floor: Any
    fresh: Any


class Plan(NamedTuple):
    """The static ones."""

    samples: int
    elites: int
    kinds: tuple[str, str]
    """Of x0 and x (`P.kinds`)."""


class Pool(NamedTuple):
    """The K best distinct episodes of a tree so far, best first: the elites, and the archive."""

    episode: Episode
    """[K]; reward -inf where there are fewer."""
    latent: Any
    """z of (x0, x): leaves [K, 1, ...] and [K, horizon, ...]; ``()`` where they are copied."""
    tag: Any
    number: Any
    count: Any


def cem(
    key: chex.PRNGKey,
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
    samples, elites, iterations, trees, top = E.whole(
        "cem", samples=samples, elites=elites, iterations=iterations, trees=trees, top=top
    )
    if elites > samples:
        raise ValueError(f"cem: elites must be at most samples, {samples}, received {elites}")
    if samples * iterations * trees >= 2**31:
        raise ValueError(
            f"cem: samples x iterations x trees must be below 2^31, received {samples} x"
            f" {iterations} x {trees}"
        )
    share = lambda name, value: _checks.real_number(
        "cem", name, value, lambda v: 0 <= v <= 1, "from 0 to 1"
    )
    require_simulator("cem", sim)
    require_episodes("cem", sim, samples * trees)
    real = Settings(share("smoothing", smoothing), share("floor", floor), share("fresh", fresh))
    actions = default_actions("cem", sim) if actions is None else actions
    before = incidents(sim)
    counts = dict(samples=samples, elites=elites, iterations=iterations, trees=trees)
    reward, actions, settings, pilot = prepare(
        "cem", key, sim, reward, actions, widen="blind", **counts, **real._asdict()
    )
    settings = planned("cem", refine, sim, settings, usual(sim, reward))
    plan = Plan(samples, elites, P.kinds(sim, actions))
    around = () if failures is None else P.around(sim, actions, failures, settings)
    asked = counts | dict(sim=sim, reward=reward, actions=actions, real=real, around=around)
    asked |= dict(top=top, record=bool(record))
    search = partial(_iteration, tree_keys(key, trees), sim, reward, actions, real, plan)
    width = actions.width if isinstance(actions, choices.Wide) else 1.0
    carry = _nothing(sim, plan, trees, max(elites, top), width, around)
    if settings is None:
        units.require_untraced("cem", checkpoint=checkpoint)

        def body(i, carry):
            inner, counted = carry
            inner, more, *_ = search(inner, i * samples)
            return inner, E.add(counted, more)

        (pool, _), counted = lax.fori_loop(0, iterations, body, (carry, E.nothing(trees)))
        best = pool.episode.reward[:, 0]
        found = E.finish_traced(sim, reward, counted, _best(pool), best)
        return joined(sim, reward, pilot, found, top)

    def chunk(carry, begin, end):
        carry, counted, best, rows = search(carry, begin)
        return carry, counted, best, jax.tree.map(jnp.transpose, rows) if record else None

    ends = [samples * (i + 1) for i in range(iterations)]
    with open_checkpoint("cem", checkpoint, key, **asked) as store, keep_answers(store):
        (pool, _), log = E.drive(
            chunk,
            carry,
            ends,
            host=runs_on_host(sim),
            trees=trees,
            progress=progress,
            callback=callback,
            name="cem",
        )
    found, tree, number, count = jax.device_get(_archive(pool, top))
    n = int((found.reward > -jnp.inf).sum())
    found = E.finish(
        sim,
        reward,
        log,
        _best(pool),
        jax.tree.map(lambda a: a[:n], found),
        tree[:n],
        number[:n],
        count[:n],
        settings,
        top,
    )
    found = ended(key, sim, reward, joined(sim, reward, pilot, found, top), top)
    return found._replace(incidents=new_incidents(before, incidents(sim)))


@partial(jit, static_argnums=5)
def _iteration(keys, sim, reward, actions, real, plan, carry, begin):
    """One iteration of all trees, from episode number ``begin`` on: ((`Pool`, proposals of x0 and
    x), `E.Tally`, best reward [trees], `Trials`).
    """
    pool, proposals = carry
    (trees,), samples = keys.shape, plan.samples
    number = begin + jnp.arange(samples, dtype=jnp.int32)
    keys = jax.vmap(lambda k: jax.vmap(partial(jax.random.fold_in, k))(number))(keys)
    rows = jax.vmap(lambda k, p, g: _propose(k, sim, real, plan, p, g))(keys, pool, proposals)

    flat = lambda a: a.reshape(trees * samples, *a.shape[2:])
    apart = lambda a: a.reshape(trees, samples, *a.shape[1:])
    draws = (
        P.drawer(kind, a, f)
        for kind, a, f in zip(
            plan.kinds,
            (choices.quantiles(), actions),
            (actions.draw_start, actions.draw),
            strict=True,
        )
    )
    live = jnp.ones((trees * samples,), bool)
    played = E.play(
        sim,
        reward,
        flat(keys),
        *draws,
        live,
        jax.tree.map(lambda a: jnp.moveaxis(flat(a), 1, 0), rows),
        record=True,
    )
    tree = jnp.repeat(jnp.arange(trees, dtype=jnp.int32), samples)
    # trees run side by side
    counted = E.tally(played, live, jnp.tile(number, trees) * trees + tree, tree, trees)

    latent = tuple(
        row if kind == "latent" else () for kind, row in zip(plan.kinds, rows, strict=True)
    )
    number = jnp.broadcast_to(number, (trees, samples))
    new = Pool(
        jax.tree.map(apart, played.episode),
        latent,
        apart(played.tag),
        number,
        jnp.ones_like(number),
    )
    pool = jax.vmap(_merge)(pool, new)
    proposals = jax.vmap(lambda g, p: _fit(g, p, real, plan))(proposals, pool)
    return (
        (pool, proposals),
        counted,
        pool.episode.reward[:, 0],
        jax.tree.map(apart, E.trials(played)),
    )


def _propose(keys, sim, real, plan, pool, proposals):
    """Of one tree: the rows [samples, 1, ...] that x0 is made of (``()``: one start), and [samples,
    horizon, ...] those of x.
    """
    elite = jax.tree.map(lambda a: a[: plan.elites], pool.episode)
    start = outline(sim).random_start
    known = jnp.where(elite.reward > -jnp.inf, 1, -1)
    parents = (
        (jax.tree.map(lambda a: a[:, None], elite.x0), known),
        (elite.disturbances, jnp.where(known > 0, elite.length, -1)),
    )

    def rows(part):
        if plan.kinds[part] == "latent":
            return jax.vmap(lambda k: sequences.sample(k, proposals[part], int(start) * part))(keys)
        return jax.vmap(lambda k: P.copies(k, *parents[part], real.fresh, part))(keys)

    return rows(0) if start else (), rows(1)


def _fit(proposals, pool, real, plan):
    """The proposals of one tree, fitted to the elites at the steps that they reached."""
    z, reward, length = jax.tree.map(
        lambda a: a[: plan.elites], (pool.latent, pool.episode.reward, pool.episode.length)
    )
    known = reward[:, None] > -jnp.inf
    horizon = jax.tree.leaves(pool.episode.disturbances)[0].shape[1]
    counts = known, known & (jnp.arange(horizon, dtype=jnp.int32)[None] < length[:, None])
    return tuple(
        sequences.fit(g, v, n, real.smoothing, real.floor) if g != () else ()
        for g, v, n in zip(proposals, z, counts, strict=True)
    )


def _merge(pool, new):
    """The best of both; an episode of reward -inf stands first only where there is no other."""
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), pool, new)
    (k,), (n,) = pool.tag.shape, both.tag.shape
    places, counts = E.distinct(
        both.episode.failure, both.episode.reward, both.tag, both.number, both.count, k
    )
    there = places < n
    taken = _take(both, jnp.where(there | (jnp.arange(k) > 0), places, k))
    return taken._replace(
        episode=taken.episode._replace(reward=jnp.where(there, taken.episode.reward, -jnp.inf)),
        count=counts,
    )


@partial(jax.jit, static_argnums=(1, 2, 3))
def _nothing(sim, plan, trees, k, width, around=()):
    """An empty `Pool` and the first proposals, of every tree."""
    about = outline(sim)
    likes = about.x0, about.x
    latent = [
        kind == "latent" and bool(jax.tree.leaves(like))
        for kind, like in zip(plan.kinds, likes, strict=True)
    ]
    proposals = tuple(
        sequences.standard_normal(like, steps, width) if use else ()
        for use, like, steps in zip(latent, likes, (1, sim.horizon), strict=True)
    )
    if around:
        proposals = tuple(
            g._replace(mean=z) if g != () else () for g, z in zip(proposals, around, strict=True)
        )
    z = tuple(
        jax.tree.map(lambda a: jnp.zeros((k, *a.shape), a.dtype), g.mean) if g != () else ()
        for g in proposals
    )
    zero = lambda dtype: jnp.zeros((k,), dtype)
    one = Pool(E.blank(sim, k), z, zero(jnp.uint32), zero(jnp.int32), zero(jnp.int32)), proposals
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (trees, *a.shape)), one)


@jax.jit
def _best(pool):
    """The best episode of all trees."""
    e = jax.tree.map(lambda a: a[:, 0], pool.episode)
    i = jnp.argmax(jnp.where(e.failure | ~jnp.any(e.failure), e.reward, -jnp.inf))
    return jax.tree.map(lambda a: a[i], e)


@partial(jax.jit, static_argnums=1)
def _archive(pool, top):
    """The ``top`` best distinct failures of all trees: (episodes, tree, number, count), reward -inf
    where there are fewer.
    """
    trees, k = pool.tag.shape
    flat = jax.tree.map(lambda a: a.reshape(trees * k, *a.shape[2:]), pool._replace(latent=()))
    value = jnp.where(flat.episode.failure, flat.episode.reward, -jnp.inf)
    places, counts = E.distinct(flat.episode.failure, value, flat.tag, flat.number, flat.count, top)
    episode, number = _take((flat.episode, flat.number), places)
    return (
        episode._replace(reward=jnp.where(places < trees * k, episode.reward, -jnp.inf)),
        places // k,
        number,
        counts,
    )


def _take(tree, places):
    return jax.tree.map(lambda a: a.at[places].get(mode="fill", fill_value=0), tree)
