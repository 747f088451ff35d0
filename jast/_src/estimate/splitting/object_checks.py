"""Whether the objects of a black box can be saved and resumed, tried before the runs."""

from typing import Any

import jax
import numpy as np

from jast._src.blackbox.snapshots import BranchingRunner
from jast._src.core.simulator import Simulator
from jast._src.estimate.splitting.levels import NAME
from jast._src.estimate.splitting.object_paths import ObjectPaths
from jast._src.runtime.host_errors import hosts_of

__all__ = ["branching_objects", "check_objects"]


def branching_objects(sim: Simulator) -> Any:
    """What saves and resumes the objects of a black box; None for a simulator in JAX. ValueError
    for a black box without objects in this process.
    """
    host = next(hosts_of(sim), None)
    if host is None:
        return None
    if host.spec.episodic:
        raise ValueError(
            f"{NAME}: sim must be a black box of objects that are judged at every state"
            " (episodic=False), since a function of whole episodes cannot be resumed: use"
            " jast.estimate.failure_probability"
        )
    return BranchingRunner(host)


def check_objects(key: jax.Array, sim: Simulator, objects: Any) -> int:
    """Play an episode, and its second half twice more from a saved state; how many steps that took.
    ValueError where they do not come to the same.
    """
    paths, saved, at, looks, xs = ObjectPaths(key, sim, None, 1, objects), None, 0, [], []
    (lane,) = paths.begin(1)
    _check_methods(lane.thing)
    while not lane.over:
        if lane.steps & (lane.steps - 1) == 0:  # at 0, 1, 2, 4, ..: at half of the whole, or later
            saved, at = _attempt(objects.save, lane.thing), lane.steps
        xs.append([a[0] for a in paths.draw([lane])])
        looks.append(paths.move(lane, xs[-1]))
    steps = lane.steps
    if saved is None:
        return steps
    for _ in range(2):  # the second time, of what the first one left of it
        again = _attempt(objects.resume, saved, lane.x0)
        found = _replayed(objects, again, lane.x0, xs, at)
        steps += len(found)
        if not _alike(looks[at:], found):
            fresh = _replayed(objects, objects.begin(lane.x0)[0], lane.x0, xs, 0)
            raise ValueError(_difference(saved.copied, at, _alike(looks, fresh)))
    return steps


def _check_methods(thing):
    has = [method for method in ("snapshot", "restore") if callable(getattr(thing, method, None))]
    if len(has) == 1:
        raise ValueError(
            f"{NAME}: an object of the black box must have both methods snapshot() and"
            f" restore(saved), or neither; received {type(thing).__name__} with {has[0]} only"
        )


def _attempt(function, *args):
    """What ``function`` returns; ValueError where an object cannot be saved or resumed."""
    try:
        return function(*args)
    except Exception as error:
        raise ValueError(
            f"{NAME}: an object of the black box must have working methods snapshot() and"
            " restore(saved), or be one that copy.deepcopy copies; received"
            f" {type(error).__name__}: {error}"
        ) from error


def _replayed(objects, thing, x0, xs, at):
    """What an object at step ``at`` says after each further one of the disturbances ``xs``."""
    found = []
    for t in range(at + 1, len(xs) + 1):
        if thing is None:
            break
        thing, look = objects.move(thing, x0, [np.stack(a) for a in zip(*xs[:t], strict=True)])
        found.append(look)
    if thing is not None:
        objects.release(thing)
    return found


def _alike(looks, others):
    return len(looks) == len(others) and all(a.same(b) for a, b in zip(looks, others))


def _difference(copied, at, deterministic):
    """Why the same disturbances came to another end."""
    if not deterministic:
        return (
            f"{NAME}: the black box must be deterministic, received two outcomes of the same"
            " disturbances: seed every random number generator in initialize, or make its draws"
            " part of the disturbance"
        )
    what = "a copy by copy.deepcopy" if copied else "restore(saved) of its snapshot()"
    return (
        f"{NAME}: {what} must bring back all of an object, received one that goes on differently"
        f" from step {at} on under the same disturbances: is something outside of the object, or"
        " shared by saved states that change with it?"
    )
