"""Monte Carlo forest search with action pruning: MCFS-AP of Lytskjold and Mengshoel, Algorithm
1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import jax

from jast._src.core.simulator import Simulator
from jast._src.core.typing import Actions, Callback, Executor, PathLike, PRNGKey, Reward
from jast._src.heads.heads import Heads
from jast._src.heads.settings import HeadSettings
from jast._src.search.result import SearchResult
from jast._src.search.tree.forest_run import grow_trees
from jast._src.search.tree.settings import PLAIN

__all__ = ["MODES", "forest"]

CODE = PLAIN | dict(widening=(0.5, 0.6))  # as published
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
    key: PRNGKey,
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
    spread: bool | None = None,
    focus: float | None = None,
    follow: bool | None = None,
    feed: bool | None = None,
    urgent: bool | None = None,
    head_settings: HeadSettings | None = None,
    memoize: Literal["auto", "node", "root", "none"] = "auto",
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
    """Grow independent trees, each from many roots in turn. The reward is maximised.

    A simulation walks down from the root by eq. 3, Q(s, a) + c sqrt(ln N(s) / (1 + N(s, a))), where
    a node has at most k N^alpha + 1 children. It takes a child that was never visited, rolls out at
    random to the episode's end, and backs its reward up as a mean. Then the most visited child
    becomes the root and keeps its subtree. A tree ends early when its root is an episode's end. The
    equations are those of MCFS-AP.

    The modes are:

    - "default" is what works: ``widening`` (2, 0.5), ``spread`` and ``focus``.
    - "code" (earlier: "paper") is the published search: ``widening`` (0.5, 0.6), every action drawn
      independently, `jast.rewards.standard` and draws of the model. "text" differs from it in the
      heads.
    - "episodic" is for failures that a chance rollout hits and that nothing points to, as in
      systems that are judged at their end only: ``urgent`` and ``follow``.
    - "thesis" is Moss's: ``widening`` (10, 0.3), ``urgent`` and ``feed``, with the published reward
      and draws of the model.

    With heads, the trees grow in rounds. Between two rounds the heads learn from the statistics of
    the roots, and the policy also from the best episodes. No untrained head guides the first round.
    ``result.lessons`` tells of each round; a training whose loss is not finite is rejected.

    A KeyboardInterrupt ends the search with an honest result of what was done. Under `jax.jit` and
    `jax.vmap` one traced program runs, with no archive.

    Args:
        key: consumed.
        sim: the simulator.
        trees: how many; each is a search of its own.
        prunes: roots of a tree.
        simulations: from each root.
        heads: networks that guide the trees, on what ``observe`` shows. "rollout" is a policy from
            which rollouts draw, "value" a v(s, a) that joins eq. 3, "both" is both; or
            `jast.heads.Heads` of your own or of an earlier result (``result.heads``), also of
            another start of the same system. The modes "code" and "text" have the heads of the
            published code and text.
        reward: default: `jast.rewards.lexicographic`, which ranks any failure above all misses,
            then the likeliest failure, then the nearest miss.
        actions: of `jast.actions`. Default: `jast.actions.wide` where disturbances have a quantile
            function, else draws of the model. The scales of reward and actions come from up to 768
            episodes of the system (60 of a black box) before the first tree, the same for every
            key; these count among the episodes, and their failures are tree -1's.
        exploration: c of eq. 3, in the units of the reward. Default: 1 with the lexicographic
            reward, else the published 10. With a reward of your own in mode "episodic", give a
            hundredth of what a failure earns.
        mode: see above. The settings below override it, each on its own.
        widening: (k, alpha), alpha in [0, 1].
        spread: the children of a node cover the action space evenly.
        focus: every second child, and in half of the trees every second rollout step, is drawn
            closer to the mode of the disturbance by this factor: 0.2 for a uniform box, 1 (off) for
            draws of the model, which are near it already. Above 1 it reaches into the tails, for
            failures too rare for the model's own draws; where failures lie at the edge of a tight
            box, 1 finds more.
        follow: as soon as a failure is the best of its tree, the next simulations grow its path
            into the tree, an action each, so that every step of it can be varied; not with a value
            head.
        feed: with half of its steps to go, a rollout takes the action that the tree's best episode
            took there (Algorithm 9 of the thesis).
        urgent: a child that was never visited comes first (else its Q is 0).
        head_settings: of `jast.heads.settings`. Default: the mode's. ``settings(train=False)`` uses
            heads as they are, which is what `jax.jit` and `jax.vmap` do.
        memoize: keeps the simulator's states at every "node", at the current "root" only, or
            nowhere ("none"). The trees are the same; it trades memory for simulator steps. "auto"
            takes "node" where it fits.
        refine: evaluations of `jast.search.refine` at the end, on top of the trees, as a share of
            their episodes. It pulls the archived failures to where they are likeliest;
            ``result.refined`` says what came of that, ``result.evaluations`` counts both. Default:
            0.1 with the lexicographic reward, else 0; also 0 in modes "code", "text" and "thesis",
            under `jax.jit` and `jax.vmap`, and where a disturbance has no quantile function. A
            share of fewer than 100 evaluations is not spent.
        top: distinct failures kept.
        record: keep the numbers of every episode (``result.trials``).
        keep_trees: keep the trees themselves (``result.trees``), which `jast.plot.tree` shows;
            states are then kept at every node.
        threads: how many run trees. Default: one for each processor. Like ``lanes``, it changes no
            result.
        lanes: trees that a thread runs side by side, at most 128 by default. They are the unit of
            a checkpoint or an executor, whose default is 64 to 128: smaller units lose less and
            make one wait less, but cost more each.
        available: bytes that the trees in flight may take. Default: what is free.
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` now and then, with the simulations of
            all trees.
        checkpoint: a folder that keeps finished units of the work. The same call then goes on where
            it was stopped, to the same result.
        executor: runs the units: anything with ``submit(function, *args)``, such as the executors
            of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `SearchResult`.

    Raises:
        ValueError: for counts below 1, a negative ``refine`` and one above 0 where it is not
            possible, a simulator that breaks its contract, heads that do not fit it, an ``observe``
            that is not finite at the start, and trees that do not fit into memory, with the
            numbers.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> result = jast.search.forest(jax.random.key(0), sim, trees=4, prunes=2, simulations=100)
        >>> bool(result.best.failure)
        True
    """
    return grow_trees("forest", MODES, **locals())
