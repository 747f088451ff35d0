"""An episode as a point of normal numbers that are 0 at the mode, and back."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.normal_space import transform
from jast._src.normal_space.evaluate_points import PointEvaluator
from jast._src.normal_space.mode_coordinates import centred
from jast._src.util.leaf_names import entry_places, leaf_name
from jast._src.util.pytrees import conform, count_numbers

__all__ = [
    "EpisodePoint",
    "failing_point",
    "like_disturbances",
    "names_of_leaves",
    "number_names",
    "number_steps",
    "turned_in_time",
]

# by how much farther from the mode an episode is taken where it does not fail as recorded;
# or nearer to it: failure may lie there (a refined one of the ferry fails again 1e-4 nearer)
LIFTS = 0.0, 1e-6, 1e-5, 1e-4, 1e-3, -1e-5, -1e-4, -1e-3


class EpisodePoint(NamedTuple):
    """An episode that is to be explained."""

    sim: Simulator
    """Centred: 0 is the mode of every disturbance"""
    evaluate: PointEvaluator
    v: np.ndarray
    """[D] float64; 0 where a number decided nothing"""
    outcome: transform.Outcomes
    """Of the point, one row"""


def failing_point(
    name: str, sim: Simulator, episode: Episode, most: int | None = None
) -> EpisodePoint:
    """The `EpisodePoint` of an ``episode`` that must fail where it is replayed; ``most`` of its
    `PointEvaluator`.
    """
    if not isinstance(episode, Episode):
        raise ValueError(
            f"{name}: episode must be a jast.Episode (as of result.failures or jast.replay),"
            f" received {type(episode).__name__}{': no failure was found' * (episode is None)}"
        )
    if np.ndim(episode.failure):
        raise ValueError(
            f"{name}: episode must be one episode, received a batch of shape"
            f" {np.shape(episode.failure)}: choose one of them"
        )
    transform.check(name, sim)
    like = signature_of(sim)
    rows = jax.tree.map(lambda s: jax.ShapeDtypeStruct((sim.horizon, *s.shape), s.dtype), like.x)
    conform(f"{name}: disturbances of episode", episode.disturbances, rows)
    of_modes = centred(sim)
    one = jax.tree.map(lambda a: np.asarray(a)[None], episode._replace(states=None))
    recorded = transform.normal_of(of_modes, one)[0].astype(np.float64)
    evaluate = PointEvaluator(of_modes, most)
    # the way to normal numbers and back rounds, and a refined failure lies on the edge of failing
    for lift in LIFTS if bool(episode.failure) else LIFTS[:1]:
        v = (1 + lift) * recorded
        outcome = evaluate(v[None])
        if outcome.failure[0]:
            break
    else:
        raise ValueError(
            f"{name}: episode must fail when it is replayed, received one that ends after"
            f" {int(outcome.length[0])} steps without a failure"
        )
    v = np.where(np.arange(len(v)) < outcome.used[0], v, 0.0)
    return EpisodePoint(of_modes, evaluate, v, outcome)


def like_disturbances(sim: Simulator, row: np.ndarray) -> tuple[Any, Any]:
    """The numbers ``row`` [D] in the shapes of x0 and of the disturbances [horizon, ...]."""
    return jax.tree.map(lambda a: np.asarray(a).astype(row.dtype), transform.split_point(sim, row))


def turned_in_time(sim: Simulator, z: np.ndarray, later: np.ndarray, last: int) -> np.ndarray:
    """The points ``z`` [n, D] with the disturbances of the first ``last`` steps that many steps
    ``later`` [n, 1], in a ring.
    """
    start, t = count_numbers(signature_of(sim).x0), np.arange(sim.horizon)
    at = np.where(t < last, (t - later) % last, t)
    steps = z[:, start:].reshape(len(z), sim.horizon, -1)
    moved = np.take_along_axis(steps, at[:, :, None], axis=1)
    return np.concatenate([z[:, :start], moved.reshape(len(z), -1)], axis=1)


def number_steps(sim: Simulator) -> np.ndarray:
    """[D]: the step that each number belongs to, from 1; 0 for those of the start."""
    signature = signature_of(sim)
    start, each = count_numbers(signature.x0), count_numbers(signature.x)
    return np.concatenate([np.zeros(start, int), 1 + np.arange(sim.horizon * each) // max(each, 1)])


def number_names(sim: Simulator) -> list[str]:
    """[D]: what each number is called: "x" or its field, with its place in an array."""
    signature = signature_of(sim)
    return [*names_of_leaves(signature.x0, "x0"), *names_of_leaves(signature.x, "x") * sim.horizon]


def names_of_leaves(like: Any, root: str) -> list[str]:
    """What each number of ``like``, arrays or their shapes, is called: its field with its place in
    an array, or ``root``.
    """
    leaves, _ = jax.tree_util.tree_flatten_with_path(like)
    return [leaf_name(path, root) + at for path, s in leaves for at in entry_places(s.shape)]
