"""A forest by its settings: what `jast.search.forest` and `jast.search.mcts` have in common, from
their arguments to their result.
"""

import os
import warnings

import jax
import jax.numpy as jnp
import numpy as np

from jast._jax import is_traced
from jast.counter import tree_keys
from jast.episode import Episode, replay
from jast.failures import collect, identity
from jast.heads.rounds import enrol, teach
from jast.heads.settings import MODES as HEAD_MODES
from jast.heads.settings import checked
from jast.incidents import hosted, incidents, since
from jast.search.lockstep import prepare, whole
from jast.search.result import History, SearchResult, Trials
from jast.search.tree import memory
from jast.search.tree.choice import Choice
from jast.search.tree.guide import guide
from jast.search.tree.layout import (
    FAILURE,
    FRESH,
    INVALID,
    RAN,
    Problem,
    Settings,
    levels,
    most_lanes,
    pages_of,
    widths,
)
from jast.search.tree.run import Plan, bytes_per_tree, grow_all, grow_traced

__all__ = ["grow_trees", "settled"]

SWITCHES = ("spread", "follow", "feed", "urgent")
# trees in lockstep in one thread: enough to fill vector units, few enough to stay near the
# processor
LANES = 128


def settled(method, modes, mode, actions, **given):
    """The settings of a mode, those that the user gave (not None) in place of its own, and its
    name; checked.
    """
    if mode not in modes:
        raise ValueError(f"{method}: mode must be one of {sorted(modes)}, received {mode!r}")
    chosen = modes[mode] | {name: value for name, value in given.items() if value is not None}
    if chosen["focus"] is None:
        chosen["focus"] = getattr(actions, "focus", 1.0)
    widening, focus = chosen["widening"], chosen["focus"]
    if (
        not isinstance(widening, tuple | list)
        or len(widening) != 2
        or not (is_traced(*widening) or (widening[0] > 0 and 0 <= widening[1] <= 1))
    ):
        raise ValueError(
            f"{method}: widening must be a pair (k, alpha), k > 0 and 0 <= alpha <= 1, received"
            f" {widening!r}"
        )
    if not is_traced(focus) and not focus > 0:
        raise ValueError(f"{method}: focus must be above 0, received {focus!r}")
    for name in SWITCHES:
        if not isinstance(chosen[name], bool):
            raise ValueError(f"{method}: {name} must be True or False, received {chosen[name]!r}")
    return dict(mode=mode) | chosen


def grow_trees(
    method,
    key,
    sim,
    chosen,
    *,
    trees,
    prunes,
    simulations,
    reward,
    actions,
    exploration,
    memoize,
    top,
    record,
    threads,
    lanes,
    available,
    progress,
    callback,
    heads=None,
    head_settings=None,
):
    """A forest by its settings, all given: what `forest` and `mcts` call. ``chosen``: of
    `settled`.
    """
    widening, focus = chosen["widening"], chosen["focus"]
    given = {
        name: value
        for name, value in dict(threads=threads, lanes=lanes).items()
        if value is not None
    }
    trees, prunes, simulations, top, *_ = whole(
        method, trees=trees, prunes=prunes, simulations=simulations, top=top, **given
    )
    if memoize not in ("auto", "node", "root", "none"):
        raise ValueError(
            f'{method}: memoize must be "auto", "node", "root" or "none", received {memoize!r}'
        )
    names = (
        dict(trees=trees, simulations=simulations, exploration=exploration)
        | chosen
        | dict(widening=list(widening))
    )
    reward, settings = prepare(method, key, sim, reward, actions, **names)
    prunes = min(prunes, levels(sim))  # a tree of so many roots is at an episode's end
    total = prunes * simulations
    if total >= 2**24:
        raise ValueError(
            f"{method}: prunes * simulations must be below 2**24, received {prunes} *"
            f" {simulations}: grow more trees instead"
        )
    table = widths(total, *widening)
    switches = {name: chosen[name] for name in SWITCHES}
    choice = Choice(
        actions,
        jnp.asarray(focus, jnp.float32),
        focused=is_traced(focus) or focus != 1,
        **switches,
    )
    problem = jax.tree.map(
        jnp.asarray,
        Problem(sim, reward, choice, Settings(jnp.asarray(exploration, jnp.float32), table)),
    )
    children = total + 1 if is_traced(table) else int(table.max())
    plan = Plan(
        prunes,
        simulations,
        children,
        "node" if memoize == "auto" else memoize,
        record=bool(record) and settings is not None,
    )
    school, at_once = None, trees
    if heads is not None:
        head_settings = checked(
            HEAD_MODES.get(chosen["mode"], HEAD_MODES["default"])
            if head_settings is None
            else head_settings
        )
        school = enrol(jax.random.fold_in(key, trees), sim, actions, heads, head_settings)
        if chosen["follow"] and school.value is not None:
            mode = chosen["mode"]
            raise ValueError(
                f"{method}: follow must be False with a value head, which judges a child by an"
                f" action of its own, received True (mode={mode!r})"
            )
        problem = problem._replace(guide=guide(school.heads, head_settings))
        plan = plan._replace(
            pages=pages_of(problem, total),
            edges=head_settings.train and head_settings.edges == "all" and school.value is not None,
        )
        at_once = (
            min(trees, head_settings.round or max(1, min(trees // 5, LANES)))
            if head_settings.train
            else trees
        )
        if settings is None and isinstance(heads, str):
            raise ValueError(
                f"{method}: heads learn between rounds of trees, which jax.jit and jax.vmap cannot"
                " hold: pass jast.heads.Heads that were trained"
            )
        if plan.edges and memoize in ("root", "none"):
            raise ValueError(
                f"{method}: heads that learn from all edges (head_settings.edges) need states at"
                f" every node, received memoize={memoize!r}"
            )
    if settings is None:
        return _traced(grow_traced(problem, tree_keys(key, trees), plan))
    plan, threads, lanes = _fit(
        method, problem, plan, at_once, threads, lanes, available, auto=memoize == "auto"
    )
    settings |= dict(prunes=prunes, memoize=plan.memoize)
    if school is not None:
        kind = (
            heads
            if isinstance(heads, str)
            else "/".join(name for name in ("policy", "value") if getattr(heads, name) is not None)
        )
        used = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in head_settings._asdict().items()
        }
        settings |= dict(heads=kind, head_settings=used | dict(round=at_once))
    if progress:
        from tqdm import tqdm
    bar = tqdm(total=trees * total, unit="sim", unit_scale=True, desc=method) if progress else None
    done = [0]

    def on_chunk(n):
        done[0] += n
        if bar is not None:
            bar.update(n)
        if callback is not None:
            callback(done[0], trees * total)

    chunk = max(1, min(simulations, 10 if hosted(sim) else 500))
    keys, harvests, interrupted, before = tree_keys(key, trees), [], False, incidents(sim)
    for first in range(0, trees, at_once):
        new, interrupted = grow_all(
            problem,
            keys[first : first + at_once],
            plan,
            threads=threads,
            lanes=lanes,
            chunk=chunk,
            candidates=max(256, 4 * top),
            on_chunk=on_chunk,
            first=first,
        )
        harvests += new
        if interrupted:
            break
        if school is not None and head_settings.train:
            try:
                school = teach(
                    jax.random.fold_in(key, trees + 1 + first),
                    school,
                    sim,
                    actions,
                    head_settings,
                    new,
                )
            except KeyboardInterrupt:
                interrupted = True
                break
            problem = problem._replace(guide=guide(school.heads, head_settings))
    if bar is not None:
        bar.close()
    if interrupted:
        settings["interrupted"] = f"after {done[0]} of {trees * total} simulations"
    if not harvests:
        raise KeyboardInterrupt
    return _result(sim, reward, harvests, settings, top, school)._replace(
        incidents=since(before, incidents(sim))
    )


def _fit(method, problem, plan, trees, threads, lanes, available, auto):
    """The plan with its memoization settled, and the threads and lanes with which it fits into
    memory; ValueError if it does not.
    """
    if threads is None:
        cores = (
            len(os.sched_getaffinity(0))
            if hasattr(os, "sched_getaffinity")
            else os.cpu_count() or 1
        )
        threads = max(1, min(cores, trees // 8)) if jax.default_backend() == "cpu" else 1
    given, free = lanes, memory.available() if available is None else available
    if lanes is None:
        rounds = -(-trees // (threads * LANES))
        lanes = -(-trees // (threads * rounds)) if jax.default_backend() == "cpu" else trees
    lanes = min(lanes, trees, most_lanes(pages_of(problem, plan.prunes * plan.simulations)))
    threads = min(threads, -(-trees // lanes))
    for memoize in ["node", "root"] if auto and not plan.edges else [plan.memoize]:
        plan = plan._replace(memoize=memoize)
        one = bytes_per_tree(problem, plan)
        within = lanes if free is None else int(0.8 * free // (one * threads))
        if within >= (lanes if given else min(lanes, 8)):
            break
    if within < 1 or (given and within < lanes):
        asked = (
            f"{lanes} trees in each of {threads} threads take"
            f" {memory.readable(one * lanes * threads)}"
        )
        shape = (
            f"{memory.readable(one)} a tree of {plan.prunes} x {plan.simulations} simulations,"
            f" memoize={plan.memoize!r}"
        )
        raise ValueError(
            f"{method}: {asked} ({shape}), {memory.readable(free)} are free; use fewer lanes,"
            " threads or simulations"
        )
    if auto and plan.memoize == "root":
        warnings.warn(
            f"{method}: states at every node do not fit into memory, so they are kept at roots:"
            ' memoize="root"',
            stacklevel=4,
        )
    return plan, threads, max(1, min(lanes, within))


def _result(sim, reward, harvests, settings, top, school):
    log, outcome = (
        np.concatenate([getattr(h, field) for h in harvests], axis=1)
        for field in ("log", "outcome")
    )
    has = lambda bit: (outcome & bit) > 0
    ran, failed = has(RAN), has(FAILURE)
    order = failed.reshape(-1)
    episodes = int(ran.sum())
    first = int(ran.reshape(-1)[: order.argmax() + 1].sum()) if order.any() else None
    fresh_failure = failed & has(FRESH)
    value = np.where(ran, log, -np.inf)
    per_tree = np.where(
        fresh_failure.any(0), np.where(fresh_failure, value, -np.inf).max(0), value.max(0)
    )
    found = jax.tree.map(lambda *parts: np.concatenate(parts), *(h.found for h in harvests))
    tree, simulation = (
        np.concatenate([getattr(h, f) for h in harvests]) for f in ("tree", "simulation")
    )
    chosen = _distinct(found, tree, simulation, top)
    archive = collect(
        sim,
        reward,
        _take(found, chosen),
        tree[chosen],
        simulation[chosen],
        seen=int(failed.sum()),
        top=top,
    )
    best = archive.best
    if best is None:
        best = _take(found, np.argmax(np.where(found.failure, -np.inf, found.reward)))
    roots = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *(h.roots for h in harvests))
    return SearchResult(
        best=jax.device_get(replay(sim, best, reward=reward)),
        best_reward_per_tree=per_tree,
        failures=archive,
        episodes=episodes,
        simulator_steps=int(sum(h.steps.astype(np.int64).sum() for h in harvests)),
        first_failure=first,
        failing_share=float(failed.sum() / max(episodes, 1)),
        failing=fresh_failure.any(0),
        history=_history(value, fresh_failure, failed),
        invalid=int(has(INVALID).sum()),
        trials=_trials(harvests, value, failed, has(FRESH)),
        settings=settings,
        roots=roots,
        heads=None if school is None else school.heads,
        lessons=() if school is None else school.lessons,
    )


def _trials(harvests, value, failed, fresh):
    if isinstance(harvests[0].trials, tuple):
        return None
    distance, log_prob = np.moveaxis(np.concatenate([h.trials for h in harvests], axis=2), 1, 0)
    return Trials(
        value,
        np.where(fresh & np.isfinite(value), distance, np.inf),
        log_prob,
        failed & fresh,
        fresh,
    )


def _distinct(found, tree, simulation, top):
    """Candidates worth a replay: failures by falling reward, up to a few more distinct ones than
    the archive holds.
    """
    names, chosen, seen = set(), [], set()
    for i in np.argsort(-found.reward, kind="stable"):
        if not found.failure[i] or (tree[i], simulation[i]) in seen:
            continue
        seen.add((tree[i], simulation[i]))
        names.add(identity(_take(found, i)))
        if len(names) > top + 8:
            break
        chosen.append(i)
    return np.array(chosen, np.int64)


def _history(value, failure, failed):
    moments = np.unique(np.linspace(1, value.shape[0], min(value.shape[0], 200)).astype(int))
    best = np.maximum.accumulate(value, axis=0)[moments - 1]
    best_failure = np.maximum.accumulate(np.where(failure, value, -np.inf), axis=0)[moments - 1]
    best = np.where(np.maximum.accumulate(failure, axis=0)[moments - 1], best_failure, best)
    return History(moments, best, np.cumsum(failed.sum(1))[moments - 1])


def _traced(found):
    """`SearchResult` of traced arrays."""
    steps = found.first.shape[0]
    failing = found.best.failure
    score = jnp.where(
        jnp.any(failing), jnp.where(failing, found.best.reward, -jnp.inf), found.best.reward
    )
    episodes = jnp.sum(found.episodes)
    first = jnp.where(
        jnp.any(found.failures > 0),
        jnp.min(found.first) * steps + jnp.argmin(found.first).astype(jnp.int32) + 1,
        -1,
    )
    return SearchResult(
        jax.tree.map(lambda a: a[jnp.argmax(score)], found.best),
        found.best.reward,
        None,
        episodes,
        jnp.sum(found.steps),
        first,
        jnp.sum(found.failures) / jnp.maximum(episodes, 1),
        failing,
        None,
        jnp.sum(found.invalid),
        None,
    )


def _take(episodes, i):
    return Episode(*jax.tree.map(lambda a: a[i], tuple(episodes[:-1])))
