"""A forest by its settings: what `jast.search.forest` and `jast.search.mcts` have in common, from
their arguments to their result.

`plan` says what is to be grown, `with_heads` adds the heads that guide it, `grow_rounds` grows it,
and `grow_trees` is all of them in a row.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.actions import samples
from jast._src.core.counter_prng import tree_keys
from jast._src.core.rewards import STANDARD, Lexicographic, lexicographic
from jast._src.core.simulator import Simulator
from jast._src.heads.settings import MODES as HEAD_MODES
from jast._src.heads.settings import HeadSettings, check_settings
from jast._src.heads.train_heads import HeadTraining, init_heads, train_heads
from jast._src.runtime import work
from jast._src.runtime._jax import is_traced
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.host_errors import incidents, runs_on_host
from jast._src.runtime.progress_bar import Watch
from jast._src.search.calibration import Calibration, with_calibration
from jast._src.search.driver import complete, require_counts
from jast._src.search.refine.final import default_share, with_refine_share
from jast._src.search.result import SearchResult
from jast._src.search.setup import default_actions, prepare
from jast._src.search.tree.head_guidance import guide
from jast._src.search.tree.layout import Problem, levels, pages_of
from jast._src.search.tree.memory import LANES, fit, require_rewards
from jast._src.search.tree.results import result, traced_result
from jast._src.search.tree.run import Plan, Round, grow_all, grow_traced
from jast._src.search.tree.settings import mode_settings, problem_of
from jast._src.util.checks import one_of, wrong

__all__ = ["grow_trees"]

MEMOIZE = ("auto", "node", "root", "none")
PUBLISHED = ("code", "text", "paper", "thesis")
"""Modes that maximise the reward of before by default, over draws of the model."""
EXECUTOR_LANES = 64  # trees of a group with an executor, at least: fewer cost more each
EXPLORATION = 10.0  # the published one
BOUNDED_EXPLORATION = 1.0  # for `jast.rewards.lexicographic`, whose range is (-1, 1]
CHUNK = 500  # simulations of a tree between two looks at the keyboard
HOSTED_CHUNK = 10  # those of a system on the host


class Job(NamedTuple):
    """What is to be grown."""

    method: str
    problem: Problem
    plan: Plan
    trees: int
    at_once: int
    """Trees of a round: all of them where no heads learn."""
    top: int
    settings: dict | None
    """What was asked for, for the result; None in a traced search."""
    calibration: Calibration | None = None
    """The episodes that gave the scales."""
    training: HeadTraining | None = None
    """The heads, where there are any."""
    head_settings: HeadSettings | None = None

    @property
    def sim(self) -> Simulator:
        return self.problem.sim

    @property
    def reward(self) -> Any:
        return self.problem.reward


def grow_trees(
    method: str,
    modes: Mapping[str, dict],
    key: jax.Array,
    sim: Simulator,
    *,
    trees: int,
    prunes: int,
    simulations: int,
    mode: str,
    reward: Any,
    actions: Any,
    exploration: float | None,
    memoize: str,
    refine: float | None,
    top: int,
    record: bool,
    keep_trees: bool,
    threads: int | None,
    lanes: int | None,
    available: int | None,
    progress: bool,
    callback: Callable | None,
    checkpoint: Any,
    executor: Any,
    devices: Any,
    heads: Any = None,
    head_settings: HeadSettings | None = None,
    **choices: Any,
) -> SearchResult:
    """A forest by the arguments of `jast.search.forest`, which ``method`` was called with;
    ``modes`` and ``choices`` as for `search.tree.settings.mode_settings`.
    """
    chosen = mode_settings(method, modes, mode, actions, **choices)
    counts = dict(trees=trees, prunes=prunes, simulations=simulations, top=top)
    given = {k: n for k, n in dict(threads=threads, lanes=lanes).items() if n is not None}
    trees, prunes, simulations, top, *_ = require_counts(method, **counts, **given)
    before, placement = incidents(sim), work.placement(method, executor, devices)
    about = dict(sim=sim, chosen=chosen, reward=reward, actions=actions, exploration=exploration)
    about |= dict(memoize=memoize, record=bool(record), keep_trees=bool(keep_trees))
    about |= dict(heads=heads, head_settings=head_settings)
    job = plan(method, key, sim, chosen, counts, reward, actions, exploration, memoize)
    share = 0.0 if mode in PUBLISHED else default_share(sim, job.reward)
    job = job._replace(settings=with_refine_share(method, refine, sim, job.settings, share))
    if heads is not None:
        job = with_heads(job, key, heads, head_settings, mode, memoize)
    if job.settings is None:
        work.require_untraced(method, checkpoint=checkpoint, executor=executor, devices=devices)
        grown = grow_traced(job.problem, tree_keys(key, trees), job.plan)
        found = traced_result(sim, job.reward, grown)
        return with_calibration(sim, job.reward, job.calibration, found, top)
    if keep_trees and memoize in ("root", "none"):
        must = 'be "node" or "auto" with keep_trees=True, which needs states at every node'
        raise wrong(method, "memoize", must, f"{memoize!r}")
    wanted = job.plan._replace(record=bool(record), branches=bool(keep_trees))
    if lanes is None and executor is not None:
        lanes = min(LANES, -(-job.at_once // max(job.at_once // EXECUTOR_LANES, 1)))
    if devices is not None:
        threads = len(placement.devices)
    fitted, threads, lanes = fit(
        method, job.problem, wanted, job.at_once, threads, lanes, available, memoize == "auto"
    )
    total = trees * fitted.prunes * simulations
    require_rewards(method, sim, total, bool(record))
    with (
        open_checkpoint(method, checkpoint, key, **counts, **given, **about) as store,
        Watch(method, total, "sim", progress, callback) as watch,
    ):
        if store is not None:  # what was free when it began may not be now
            first = store.choose_once(lambda: dict(memoize=fitted.memoize, lanes=lanes))
            fitted, lanes = fitted._replace(memoize=first["memoize"]), first["lanes"]
        job = job._replace(plan=fitted)
        ran, training = grow_rounds(
            job, key, threads, lanes, watch, placement._replace(store=store)
        )
    settings = job.settings | dict(prunes=job.plan.prunes, memoize=job.plan.memoize)
    if job.training is not None:
        settings |= _settings_of_heads(heads, job)
    if short := work.describe_missing("simulations", ran, watch.done, watch.total):
        settings |= dict(interrupted=short)
    found = result(job, ran.state, settings, training)
    return complete(key, job, found, before, job.calibration, ran.incidents)


def plan(
    method: str,
    key: jax.Array,
    sim: Simulator,
    chosen: dict[str, Any],
    counts: dict[str, int],
    reward: Any,
    actions: Any,
    exploration: float | None,
    memoize: str,
) -> Job:
    """The `Job` without heads; ValueError for settings that do not fit one another or ``sim``."""
    trees, simulations = counts["trees"], counts["simulations"]
    one_of(method, "memoize", memoize, MEMOIZE)
    published = chosen["mode"] in PUBLISHED
    if actions is None:
        actions = samples() if published else default_actions(method, sim)
    if reward is None:
        reward = STANDARD if published else lexicographic()
    if exploration is None:
        exploration = BOUNDED_EXPLORATION if isinstance(reward, Lexicographic) else EXPLORATION
    if chosen["focus"] is None:
        chosen = chosen | dict(focus=getattr(actions, "focus", 1.0))
    asked = dict(trees=trees, simulations=simulations, exploration=exploration) | chosen
    asked["widening"] = list(chosen["widening"])
    reward, actions, settings, calibration = prepare(method, key, sim, reward, actions, **asked)
    prunes = min(counts["prunes"], levels(sim))  # a tree of so many roots is at an episode's end
    total = prunes * simulations
    if total >= 2**24:
        raise ValueError(
            f"{method}: prunes * simulations must be below 2**24, received {prunes} *"
            f" {simulations}: grow more trees instead"
        )
    problem = problem_of(sim, reward, actions, chosen, exploration, total)
    table = problem.settings.widths
    children = total + 1 if is_traced(table) else int(table.max())
    kept = "node" if memoize == "auto" else memoize
    return Job(
        method=method,
        problem=problem,
        plan=Plan(prunes, simulations, children, kept),
        trees=trees,
        at_once=trees,
        top=counts["top"],
        settings=settings,
        calibration=calibration,
    )


def with_heads(
    job: Job,
    key: jax.Array,
    heads: Any,
    head_settings: HeadSettings | None,
    mode: str,
    memoize: str,
) -> Job:
    """The `Job` with heads that guide it; ValueError where these do not fit its settings."""
    if head_settings is None:
        head_settings = HEAD_MODES.get(mode, HEAD_MODES["default"])
    head_settings = check_settings(head_settings)
    sim, actions = job.sim, job.problem.choice.actions
    training = init_heads(jax.random.fold_in(key, job.trees), sim, actions, heads, head_settings)
    if job.problem.choice.follow and training.value is not None:
        must = "be False with a value head, since that judges each child by an action drawn for it"
        raise wrong(job.method, "follow", must, f"True (mode={mode!r})")
    problem = job.problem._replace(guide=guide(training.heads, head_settings))
    learns = head_settings.train
    edges = learns and head_settings.edges == "all" and training.value is not None
    recount = learns and head_settings.counted == "tree"
    if job.settings is None and isinstance(heads, str):
        raise ValueError(
            f"{job.method}: heads are trained between rounds of trees, which cannot be done inside"
            " of jax.jit and jax.vmap: pass trained jast.heads.Heads"
        )
    if edges and memoize in ("root", "none"):
        raise ValueError(
            f'{job.method}: memoize must be "node" or "auto" where heads learn from all edges'
            f" (head_settings.edges), which needs states at every node, received {memoize!r}"
        )
    usual = max(1, min(job.trees // 5, LANES))
    return job._replace(
        problem=problem,
        plan=job.plan._replace(
            pages=pages_of(problem, job.plan.prunes * job.plan.simulations),
            edges=edges,
            recount=recount,
        ),
        at_once=min(job.trees, head_settings.round or usual) if learns else job.trees,
        training=training,
        head_settings=head_settings,
    )


def grow_rounds(
    job: Job, key: jax.Array, threads: int, lanes: int, watch: Watch, placement: work.Placement
) -> tuple[work.UnitsRun, HeadTraining | None]:
    """Grow all trees, a round at a time, and teach the heads between two rounds.

    Args:
        job: what is to be grown.
        key: of the search.
        threads: that trees grow in.
        lanes: trees side by side in each of them.
        watch: is told of the simulations.
        placement: how groups of trees are run.

    Returns:
        `runtime.work.UnitsRun` with the batches in the order of the trees, and the heads as they
        are now.
    """
    problem, training, sim = job.problem, job.training, job.sim
    chunk = max(1, min(job.plan.simulations, HOSTED_CHUNK if runs_on_host(sim) else CHUNK))
    words = np.asarray(jax.random.key_data(tree_keys(key, job.trees)))
    ran = work.UnitsRun((), 0)
    for first in range(0, job.trees, job.at_once):
        own = words[first : first + job.at_once]
        turn = Round(problem, own, job.plan, lanes, chunk, max(256, 4 * job.top), first)
        try:
            new = grow_all(turn, watch, placement, threads)
            ran = work.concatenate(ran, new)
            if new.ended is not None:
                break
            if training is not None and job.head_settings.train:
                own = jax.random.fold_in(key, job.trees + 1 + first)
                actions = problem.choice.actions
                training = train_heads(own, training, sim, actions, job.head_settings, new.state)
                problem = problem._replace(guide=guide(training.heads, job.head_settings))
        except KeyboardInterrupt:
            if not ran.state:
                raise
            ran = ran._replace(ended="")
            break
    return ran, training


def _settings_of_heads(heads: Any, job: Job) -> dict[str, Any]:
    """What a result's settings say of heads."""
    kind = heads
    if not isinstance(heads, str):
        kind = "/".join(name for name in ("policy", "value") if getattr(heads, name) is not None)
    used = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in job.head_settings._asdict().items()
    }
    return dict(heads=kind, head_settings=used | dict(round=job.at_once))
