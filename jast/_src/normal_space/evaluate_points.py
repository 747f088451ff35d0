"""Points of normal numbers evaluated by simulation, from the host, in one program whatever their
number.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast._src.core.simulator import Simulator
from jast._src.normal_space import transform
from jast._src.runtime._jax import is_brief, jit
from jast._src.runtime.checkpoints import answer_once
from jast._src.runtime.device import BLOCK, block_size, on_cpu
from jast._src.runtime.host_errors import runs_on_host
from jast._src.runtime.progress_bar import Watch
from jast._src.util.pytrees import join_rows

__all__ = [
    "PointEvaluator",
    "evaluate_distances",
    "evaluate_on_device",
    "evaluate_points",
    "lanes_of",
]

LANES = 4096  # points of a call at most
ACCELERATED_LANES = 2**16  # on an accelerator: an H100 then draws plainly ten times as fast
WIDEST = 256  # numbers of a point up to which a call takes all of its lanes


class PointEvaluator:
    """Judges points of ``sim`` and counts the episodes, ``spent``.

    A black box runs for no more than ``most`` points: what is beyond comes back as invalid.
    """

    def __init__(self, sim: Simulator, most: int | None = None):
        self.sim, self.dtype, self.spent = sim, transform.normal_numbers(sim), 0
        self.most = most if runs_on_host(sim) else None
        self.watch: Watch | None = None  # whose bar moves with every call

    def __call__(self, points: np.ndarray) -> transform.Outcomes:
        """`Outcomes` [m] of ``points`` [m, D]."""
        points = np.asarray(points, self.dtype)
        n = len(points)
        room = n if self.most is None else max(min(n, self.most - self.spent), 0)
        self.spent += room
        found = evaluate_points(self.sim, points[:room]) if room else None
        if self.watch is not None:
            self.watch.reach(min(self.spent, self.watch.total))
        if found is not None and room == n:
            return found
        none = transform.Outcomes(
            failure=np.zeros(n, bool),
            distance=np.full(n, np.inf, self.dtype),
            used=np.zeros(n, np.int32),
            length=np.zeros(n, np.int32),
            invalid=np.ones(n, bool),
            log_p=np.full(n, -np.inf, self.dtype),
        )
        if found is None:
            return none
        return jax.tree.map(lambda a, b: np.concatenate([a, b[room:]]), found, none)


def evaluate_points(sim: Simulator, z: np.ndarray) -> transform.Outcomes:
    """`Outcomes` of the points ``z`` [n, D], on the host. One program serves every ``n``; a black
    box runs once a point, in batches of ``n``.
    """
    if runs_on_host(sim):
        return answer_once(lambda z: _together(sim, jnp.asarray(z)), z)
    return _by_program(_program(), sim, z, _outcomes)


def evaluate_distances(sim: Simulator, z: np.ndarray) -> tuple[transform.Outcomes, np.ndarray]:
    """`transform.outcome_and_distances` of the points ``z`` [n, D], likewise."""
    if runs_on_host(sim):
        return answer_once(lambda z: _together(sim, jnp.asarray(z), True), z)
    return _by_program(transform.outcome_and_distances, sim, z)


def evaluate_on_device(sim: Simulator, z: jax.Array, n: int) -> transform.Outcomes:
    """`Outcomes` [n] of the first ``n`` of the points ``z`` [`lanes_of`, D] that are on the device,
    by the program of `evaluate_points`.
    """
    play = _program()
    return answer_once(lambda z: _outcomes(_in_blocks(play, sim, z, np.int32(n))), z, rows=n)


def _program():
    """What is asked of each point: calls of few evaluations ask for distances, too, so that they
    need no other program for these.
    """
    return transform.outcome_and_distances if is_brief() else transform.outcome


def _outcomes(found):
    return found if isinstance(found, transform.Outcomes) else found[0]


def _by_program(play, sim, z, part=lambda found: found):
    """What ``play`` says of the points, or the ``part`` of it that is asked for."""
    n, d = z.shape
    lanes, out = lanes_of(d), []
    if n <= LANES:
        lanes = min(lanes, LANES)  # on an accelerator a few points are not filled up with many
    for i in range(0, n, lanes):
        points = z[i : i + lanes]
        ask = partial(_padded, play, sim, lanes, part)
        out.append(answer_once(ask, points, rows=len(points)))
    return out[0] if len(out) == 1 else join_rows(*out)


@partial(jit, static_argnums=2)
def _together(sim, z, distances=False):
    play = transform.outcome_and_distances if distances else transform.outcome
    return jax.vmap(partial(play, sim))(z)


def _padded(play, sim, lanes, part, z):
    """``part`` of what ``play`` says [lanes], of which the first ones are of ``z`` [n, D]."""
    filled = np.zeros((lanes, z.shape[1]), z.dtype)
    filled[: len(z)] = z
    return part(_in_blocks(play, sim, filled, np.int32(len(z))))


def lanes_of(d: int) -> int:
    """Points of ``d`` numbers that one call of the program takes."""
    most = LANES if on_cpu() else ACCELERATED_LANES
    return max(min(most, WIDEST * most // max(d, 1) // BLOCK * BLOCK), BLOCK)


@partial(jit, static_argnums=0)
def _in_blocks(play, sim, z, n):
    """What ``play`` says of the first ``n`` of ``z``; of the others what is left of their
    blocks.
    """
    size = block_size(len(z))
    run = jax.jit(jax.vmap(partial(play, sim)))  # traced once for its shapes and for the loop
    like = jax.eval_shape(run, jax.ShapeDtypeStruct((size, *z.shape[1:]), z.dtype))

    def block(i, out):
        new = run(lax.dynamic_slice_in_dim(z, i * size, size))
        place = partial(lax.dynamic_update_slice_in_dim, start_index=i * size, axis=0)
        return jax.tree.map(place, out, new)

    nothing = jax.tree.map(lambda s: jnp.zeros((len(z), *s.shape[1:]), s.dtype), like)
    return lax.fori_loop(0, (n + size - 1) // size, block, nothing)
