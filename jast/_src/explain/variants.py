"""Failures as the model has them, and near misses: variants of failures that are known."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.estimate.estimate import Estimate
from jast._src.estimate.proposal_search.mixture_draws import resample
from jast._src.estimate.redraw import is_proposal_of, redraw_failures
from jast._src.estimate.weighted_draws import Draws
from jast._src.explain.episodes import distinct_rows, gather_episodes, named_kinds
from jast._src.normal_space import transform
from jast._src.normal_space.episode_point import turned_in_time
from jast._src.normal_space.evaluate_points import PointEvaluator
from jast._src.normal_space.pcn import proposed
from jast._src.search.refine.modes import Modes, owners
from jast._src.util.checks import wrong
from jast._src.util.pytrees import index_tree, join_rows

__all__ = ["EACH", "draw_variants", "find_seeds"]

# how far the disturbances of a move go: 1 is a new draw; None: they all come some steps later
SCALES = (1.0, 0.3, None, 1.0, 0.7, 1.0, None, 0.15, 1.0, 0.5)
EACH = len(SCALES) + 2  # evaluations of a failure and its near miss: moves, and both are played
MODES = 6  # that are told apart
CROWDED = 0.1  # share of the chains from one seed above which seeds are not held out as a whole
UNKNOWN_WEIGHT = -700.0  # log weight that counts only where nothing else is known


class Seeds(NamedTuple):
    """Failures that are known, as points of normal numbers."""

    z: np.ndarray
    """[m, D]"""
    used: np.ndarray
    """[m] how many of the numbers decided something."""
    log_weight: np.ndarray
    """[m] by how much each stands for the model; all 0 where that is not known."""
    label: np.ndarray
    """[m] index into"""
    names: tuple[str, ...]
    evaluations: int


def find_seeds(function: str, sim: Simulator, given: Any, labels: Any, most: int) -> Seeds:
    """The `Seeds` in ``given``: of an estimate, or the estimate of a report, the failing draws that
    it kept, at most ``most``, with their weights; else the episodes themselves.

    Args:
        labels: names of the kinds of the episodes, one each; None: of a report or of
            `jast.search.Modes` the number of the mode, else all are of one kind.
    """
    transform.check(function, sim)
    estimate = getattr(given, "probability", None) or given
    kept = estimate.draws if isinstance(estimate, Estimate) else None
    modes = given if isinstance(given, Modes) else getattr(given, "modes", None)
    modes = modes if isinstance(modes, Modes) else None
    if labels is None and _holds_points(sim, kept):
        z, log_w, length, spent = redraw_failures(sim, kept, most)
        found = Seeds(
            z=z,
            used=transform.used_numbers(sim, length),
            log_weight=log_w,
            label=np.zeros(len(z), int),
            names=("fails",),
            evaluations=spent,
        )
        return _label_by_mode(function, sim, found, modes)
    if isinstance(given, Estimate):
        must = "be episodes, or an estimate for sim that drew normal numbers and saw failures"
        raise wrong(function, "failures", must, f"one by {given.method} that did not")
    of_mode = isinstance(given, Modes) and len(given) > 1
    e = gather_episodes(function, "failures", sim, given[:MODES] if of_mode else given)
    n = len(e.length)
    names, label = ("fails",), np.zeros(n, int)
    if labels is not None:
        names, label = named_kinds(function, labels, n)
    elif of_mode:
        names, label = _mode_names(n), np.arange(n)
    rows = distinct_rows(e)
    e, label = index_tree(e, rows), label[rows]
    if not len(e.length):
        raise ValueError(f"{function}: failures must hold at least one failure, received none")
    z = transform.normal_of(sim, e)
    o = PointEvaluator(sim)(z)
    if not e.failure.all() or not o.failure.any():
        raise ValueError(
            f"{function}: failures must all fail, received"
            f" {int((~(e.failure & o.failure)).sum())} of {len(z)} that do not"
        )
    found = Seeds(
        z=z[o.failure],
        used=o.used[o.failure],
        log_weight=np.zeros(int(o.failure.sum())),
        label=label[o.failure],
        names=names,
        evaluations=len(rows),
    )
    return found if labels is not None or of_mode else _label_by_mode(function, sim, found, modes)


def _holds_points(sim: Simulator, kept: Draws | None) -> bool:
    """Whether points of failures can be told from these draws."""
    if kept is None or not kept.failure.any():
        return False
    of_model = isinstance(kept.source, str) and kept.source == "model"
    return of_model or is_proposal_of(sim, kept.source)


def _label_by_mode(function: str, sim: Simulator, seeds: Seeds, modes: Any) -> Seeds:
    """``seeds`` with the mode that each is most alike, where there are several; each mode has its
    likeliest failure as a seed, too.
    """
    if modes is None or len(modes) < 2:
        return seeds
    best = gather_episodes(function, "modes", sim, modes[:MODES])
    heads = transform.normal_of(sim, best)
    evaluate = PointEvaluator(sim)
    o = evaluate(heads)
    z = np.concatenate([seeds.z, heads[o.failure]]).astype(heads.dtype)
    used = np.concatenate([seeds.used, o.used[o.failure]])
    label = owners(sim, transform.played(sim, z), best)
    label[len(seeds.z) :] = np.flatnonzero(o.failure)
    # a mode's likeliest failure counts only where nothing else is known of the mode
    log_w = np.concatenate([seeds.log_weight, np.full(int(o.failure.sum()), UNKNOWN_WEIGHT)])
    return Seeds(
        z=z,
        used=used,
        log_weight=log_w,
        label=label,
        names=_mode_names(len(best.length)),
        evaluations=seeds.evaluations + evaluate.spent,
    )


def _mode_names(k: int) -> tuple:
    return tuple(f"mode {i + 1}" for i in range(k))


def draw_variants(
    key: jax.Array, sim: Simulator, seeds: Seeds, n: int
) -> tuple[Episode, np.ndarray, np.ndarray, int]:
    """``n`` failures and at most as many near misses, from Markov chains that begin at ``seeds``:
    (episodes, the failures first; the kind of each, 0 of a near miss and else 1 + its label; its
    group; evaluations). Those of one group come from the same seed, unless one seed has many.

    In each move of a chain some of the disturbances are drawn anew, or moved a little
    (`normal_space.pcn.proposed`), or all come some steps later, so that the model stays as it is:
    where the system still fails the chain goes there, and where it does not that is a near miss, of
    which each chain keeps one at random. So disturbances that matter not are as in any other
    episode, in failures and near misses alike, and so is the time where it does not matter. All
    kinds of failures get the same number of chains.
    """
    rng, evaluate = numpy_generator(key), PointEvaluator(sim)
    kinds = np.unique(seeds.label)
    each = [_draw_seeds(rng, seeds, k, -(-n // len(kinds))) for k in kinds]
    seed = np.concatenate(each)
    z = seeds.z[seed].astype(np.float64)
    behind = np.arange(z.shape[1]) >= seeds.used[seed][:, None]
    z = np.where(behind, rng.standard_normal(z.shape), z)
    near, misses = np.zeros_like(z), np.zeros(len(z), int)
    for scale in SCALES:
        if scale is None:
            later = rng.integers(0, sim.horizon, (len(z), 1))
            to = turned_in_time(sim, z, later, sim.horizon)
        else:
            to = _redraw(rng, z, scale)
        o = evaluate(to)
        rejected = ~o.failure & ~o.invalid
        misses += rejected
        kept = rejected & (rng.random(len(z)) * misses < 1)
        near[kept] = to[kept]
        z = np.where(o.failure[:, None], to, z)
    missed = np.flatnonzero(misses)
    bad = transform.played(sim, z)
    calm = transform.played(sim, near[missed]) if len(missed) else bad
    fails = np.flatnonzero(bad.failure)
    calm_rows = np.flatnonzero(~calm.failure) if len(missed) else np.zeros(0, int)
    label, origin = seeds.label[seed[fails]], seed[fails]
    group = np.concatenate([origin, seed[missed[calm_rows]]])
    crowded = any(
        np.unique(origin[label == k], return_counts=True)[1].max() > CROWDED * np.sum(label == k)
        for k in np.unique(label)
    )
    if crowded:
        # no seed can be held out: its variants are
        group = np.arange(len(group))
    e = join_rows(index_tree(bad, fails), index_tree(calm, calm_rows))
    kind = np.concatenate([1 + label, np.zeros(len(calm_rows), int)])
    return e, kind, group, evaluate.spent + len(z) + len(missed)


def _redraw(rng: np.random.Generator, z: np.ndarray, scale: float) -> np.ndarray:
    """``z`` [n, D] of which some numbers moved, of each row another share."""
    meant = rng.random(z.shape) < rng.random((len(z), 1))
    return np.where(meant, proposed(z, rng.standard_normal(z.shape), scale, 1.0), z)


def _draw_seeds(rng: np.random.Generator, seeds: Seeds, kind: int, n: int) -> np.ndarray:
    """Rows [n] of the seeds of one kind, by weight; all alike, so many times each."""
    rows = np.flatnonzero(seeds.label == kind)
    return rows[resample(seeds.log_weight[rows], n, rng.random())]
