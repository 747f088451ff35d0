"""The points of populations as tilts need them: what was seen of each state, the normal numbers and
the choices of each step, in one program.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core.rewards import likelihood
from jast._src.core.simulator import Simulator
from jast._src.core.transition import advance, begin, conclude
from jast._src.distributions.independent_parts import parts
from jast._src.estimate.tilts.exploration import FAR
from jast._src.estimate.tilts.family import Points
from jast._src.estimate.tilts.tilts import Trace, assemble, stack_choices, tilt_inputs
from jast._src.normal_space.transform import normal_numbers, outcomes_of, side_by_side, split_point
from jast._src.runtime._jax import quick
from jast._src.util.pytrees import index_tree, select

__all__ = ["failing_points"]

LANES = 256
"""Episodes that run side by side: a population leaves some hundred failures or thousands."""


def failing_points(sim: Simulator, z: np.ndarray) -> Points:
    """The `Points` of the failures among the points ``z`` [n, D] of `normal_space.transform`. On
    the host.
    """
    z = np.asarray(z, normal_numbers(sim))
    outcomes, trace = side_by_side(sim, partial(_record, sim), z, lanes=LANES)
    return index_tree(Points(trace, outcomes.length), np.flatnonzero(outcomes.failure))


@quick
def _record(sim, z):
    """(`Outcomes`, `Trace`) of the points ``z`` [n, D]. By a scan: `transform.simulate`
    would carry the rows along, and took 10 to 40 times as long.
    """
    horizon, density = sim.horizon, likelihood(sim)

    def one(z):
        start, steps = split_point(sim, z)

        def step(carry, given):
            progress, length = carry
            numbers, t = given
            seen = tilt_inputs(sim, progress.state)
            x, *row = _as_parts(sim.disturbance(progress.state), numbers, z.dtype)
            after = advance(sim, density, progress, x, t + 1 >= horizon)
            done = progress.done
            length = length + jnp.where(done, 0, 1)
            return (select(done, progress, after), length), (seen, *row)

        x0, *first = _as_parts(sim.start(), start, z.dtype)
        begun = begin(sim, density, x0), jnp.zeros((), jnp.int32)
        times = jnp.arange(horizon, dtype=jnp.int32)
        (end, length), rows = lax.scan(step, begun, (steps, times))
        return outcomes_of(sim, conclude(sim, density, end), length), Trace(*first, *rows)

    return jax.vmap(one)(z)


def _as_parts(d: Any, numbers: Any, dtype: Any) -> tuple[Any, ...]:
    """The value of ``d`` at these normal numbers, and its own normal numbers [A], categories [B]
    and log probabilities [B, C]: a choice has no normal number behind it among tilts.
    """
    p = parts(d)
    if p.choices:
        x = D.from_normal(d, numbers)
        z, choices = p.inverse(x)
        z = jnp.nan_to_num(z, posinf=FAR, neginf=-FAR)
        return x, z.astype(dtype), jnp.concatenate(choices), stack_choices(p).astype(dtype)
    leaves = jax.tree.leaves(numbers)
    z = jnp.concatenate([jnp.zeros(0, dtype), *(jnp.ravel(a).astype(dtype) for a in leaves)])
    none = jnp.zeros(0, jnp.int32)
    return assemble(p, z, none), z, none, stack_choices(p).astype(dtype)
