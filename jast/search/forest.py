"""Monte Carlo forest search with action pruning: MCFS-AP of Lytskjold and Mengshoel, Algorithm
1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from jast.search.tree.grow import grow_trees
from jast.search.tree.settings import PLAIN, settled

if TYPE_CHECKING:
    import chex
    import jax

    from jast.heads.heads import Heads
    from jast.heads.settings import HeadSettings
    from jast.search.result import SearchResult
    from jast.simulator import Simulator
    from jast.typing import Actions, Callback, Executor, PathLike, Reward

__all__ = ["MODES", "forest"]

CODE = PLAIN | dict(widening=(0.5, 0.6))
MODES = {
    "default": PLAIN | dict(widening=(2.0, 0.5), spread=True, focus=None),
    "code": CODE,
    "text": CODE,  # they differ in their heads
    "paper": CODE,  # the earlier name of "code"
    "thesis": PLAIN | dict(widening=(10.0, 0.3), feed=True, urgent=True),
    "episodic": (
        PLAIN | dict(widening=(2.0, 0.5), spread=True, focus=None, follow=True, urgent=True)
    ),
}


def forest(
    key: chex.PRNGKey,
    sim: Simulator,
    *,
    trees: int = 200,
    prunes: int = 18,
    simulations: int = 500,
    heads: Heads | Literal["rollout", "value", "both"] | None = None,
    reward: Reward | None = None,
    actions: Actions | None = None,
    exploration: float | None = None,
    mode: Literal["default", "code", "text", "paper", "thesis", "episodic"] = "default",
    widening: tuple[float, float] | None = None,
    spread: float | None = None,
    focus: float | None = None,
    follow: float | None = None,
    feed: int | None = None,
    urgent: float | None = None,
    head_settings: HeadSettings | None = None,
    memoize: bool | Literal["auto"] = "auto",
    refine: float | None = None,
    top: int = 64,
    record: bool = False,
    keep_trees: bool = False,
    threads: int | None = None,
    lanes: int | None = None,
    available: int | None = None,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> SearchResult:
    """Grow ``trees`` independent trees of ``prunes`` roots with ``simulations`` each:
    `SearchResult`. The reward is maximised.

    A simulation walks down from the root by eq. 3, Q(s, a) + ``exploration`` sqrt(ln N(s) / (1 +
    N(s, a))), where a node has at most k N^alpha + 1 children, ``widening`` = (k, alpha), alpha in
    [0, 1]; takes a child never visited, rolls out at random to the episode's end, and backs its
    reward up as a mean. After ``simulations`` of them the most visited child becomes the root and
    keeps its subtree; a tree ends early when its root is an episode's end.

    ``mode="code"`` (earlier: "paper") is the published search: ``widening`` (0.5, 0.6), every
    action drawn independently. ``mode="default"`` is what works: (2, 0.5); ``spread``: the children
    of a node cover the action space evenly; ``focus``: every second child, and in half of the trees
    every second rollout step, is drawn closer to the mode of the disturbance by this factor: 0.2
    for a uniform box, 1 (off) for draws of the model, which are near it already. Above 1 it reaches
    into the tails, for failures too rare for the model's own draws; where failures lie at the edge
    of a tight box, 1 finds more. Each may be given on its own.

    Default ``reward``: `jast.rewards.lexicographic`, any failure above all misses, then the
    likeliest failure, the nearest miss. Default ``actions``: `jast.actions.wide` where disturbances
    have a quantile function, else draws of the model. Their scales come from up to 768 episodes of
    the system (60 of a black box) before the first tree, the same for every key; these count among
    the episodes, and their failures are tree -1's. ``exploration``: default 1 with the
    lexicographic reward, else the published 10. Modes "code", "text" and "thesis" have the
    published `jast.rewards.standard` and draws of the model.

    ``memoize`` keeps the simulator's states at every "node", at the current "root" only, or "none":
    the same trees, for memory against simulator steps; "auto" takes "node" where it fits. ``top``:
    failures kept in the archive; ``record=True`` keeps the numbers of every episode as well
    (``result.trials``), ``keep_trees=True`` the trees themselves (``result.trees``), which
    `jast.plot.tree` shows; states are kept at every node then.

    ``refine``: evaluations of `jast.search.refine` at the end, on top of the trees, as a share of
    their episodes. It pulls the archived failures to where they are likeliest; ``result.refined``
    says what came of that, ``result.evaluations`` counts both. Default: 0.1 with the lexicographic
    reward, else 0; also 0 in modes "code", "text" and "thesis", under `jax.jit` and `jax.vmap`, and
    where a disturbance has no quantile function. A share of fewer than 100 evaluations is not
    spent.

    ``mode="episodic"`` is for failures that a chance rollout hits and that nothing points to, as of
    systems that are judged at their end only: ``urgent`` and ``follow``. ``urgent``: a child that
    was never visited comes first (else its Q is 0). ``follow``: as soon as a failure is the best of
    its tree, the next simulations grow its path into the tree, an action each, so that every step
    of it can be varied; not with a value head. ``exploration`` is in the units of the reward: of
    one of your own give here a hundredth of what a failure earns. ``mode="thesis"`` is Moss's:
    ``widening`` (10, 0.3), ``urgent``, and ``feed``: with half of its steps to go, a rollout takes
    the action that the tree's best episode took there (Algorithm 9).

    Trees run ``lanes`` at a time in each of ``threads`` threads (default: all processors); neither
    changes a result. ``available``: bytes that the trees in flight may take (default: what is
    free). ``progress=True`` shows a bar; ``callback(done, total, None)`` is called now and then
    with the simulations of all trees. A KeyboardInterrupt ends the search with an honest result of
    what was done. Under `jax.jit` and `jax.vmap` one traced program runs, with no archive.

    ``checkpoint``: a folder that keeps finished units of the work; the same call goes on where it
    was ended, by whatever, to the same result. ``executor``: has ``submit(function, *args)``, as
    those of `concurrent.futures` and of Dask; ``devices``: some of `jax.devices()`, a thread each.
    Neither changes a result (`jast.units`; docs/scale.md).
    A unit is a group of ``lanes`` trees, with a checkpoint or an executor 64 to 128 by default:
    fewer are less to lose and to wait for, but cost more each.

    ``heads``: networks on what ``observe`` shows. "rollout": a policy from which rollouts draw,
    "value": a v(s, a) that joins eq. 3, "both"; or `jast.heads.Heads` of your own or of an earlier
    result (``result.heads``), also of another start of the same system. The trees then grow in
    rounds, and between two rounds the heads learn from the statistics of the roots and, the policy,
    from the best episodes; no untrained head guides the first round. With ``mode="code"`` they are
    those of the published code, with ``mode="text"`` those of the published text, a tree a round
    (`jast.heads.settings` has what differs). ``head_settings``: `jast.heads.settings`, if not the
    mode's; ``settings(train=False)`` uses heads as they are, which is what `jax.jit` and `jax.vmap`
    do. ``result.lessons`` tells of each round; a training whose loss is not finite is rejected.

    Raises ValueError for counts below 1, a negative ``refine`` and one above 0 where it cannot be,
    a simulator that breaks its contract, heads that do not fit it, an ``observe`` that is not
    finite at the start, and trees that do not fit into memory, with the numbers.
    """
    given = dict(
        widening=widening, spread=spread, focus=focus, follow=follow, feed=feed, urgent=urgent
    )
    return grow_trees(
        "forest",
        key,
        sim,
        settled("forest", MODES, mode, actions, **given),
        trees=trees,
        prunes=prunes,
        simulations=simulations,
        heads=heads,
        head_settings=head_settings,
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
