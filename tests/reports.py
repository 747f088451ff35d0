"""A report that was never computed, for the tests of what is made of reports; its names are as bad
as a user's can be.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jast
from jast._src.core.nominal import Nominal
from jast._src.estimate.estimate import Estimate
from jast._src.search.refine.modes import Mode, Modes
from jast._src.stress_testing.report import Report, Tried
from jast.distributions import Joint, Normal

__all__ = ["EVIL", "SIM", "Car", "estimate", "made"]

EVIL = "</script><script>fail()</script><b>&\"'<!--"


class Car(NamedTuple):
    position: jax.Array
    speed: jax.Array


SIM = jast.Simulator(
    init=lambda x0: Car(jnp.zeros(2), jnp.ones(())),
    step=lambda s, x: Car(s.position + s.speed, s.speed + x[EVIL]),
    disturbance=lambda s: Joint({EVIL: Normal(0.0, 0.5)}),
    evaluate=lambda s: (s.speed > 4, jnp.maximum(4 - s.speed, 0)),
    horizon=8,
)


def estimate(**changes):
    """A probability of 1e-5, by hand."""
    numbers = (-11.5, 1e-5, 1e-6, 0.1, (8e-6, 2e-5), 0.95, 90.0, 0.5, 0.01, 9, 99, 999, 9, 0, None)
    return Estimate("mine", *numbers, True, (), unseen=0.02)._replace(**changes)


def made(**changes):
    """A report of two modes, by hand."""
    pushes = ([1.1, np.float32(0.1), 2.5], [0.5, 3.0])
    rows = [np.pad(np.asarray(p, jnp.zeros(()).dtype), (0, 8 - len(p))) for p in pushes]
    found = jast.failures.collect(
        SIM,
        jast.rewards.standard(),
        jax.vmap(lambda x: jast.replay(SIM, {EVIL: x}))(jnp.asarray(np.stack(rows))),
    )
    assert len(found) == 2
    quiet = jax.device_get(jast.replay(SIM, {EVIL: jnp.zeros(8)}))
    modes = Modes([Mode(found[0], 3, 0.75, (0.702, 0.801)), Mode(found[1], 1, np.nan)])
    nominal = Nominal(quiet, 0, 9, 0.0, (0.0, 0.3), 3.0, 0)
    tried = (Tried(EVIL, 9, 0, -np.inf), Tried(EVIL, 5, 2, -1.5))
    settings = dict(method="stress", seed=[0, 1], note=EVIL)
    given = (nominal, found, modes, None, np.nan, np.nan, tried, 14, 0, settings, SIM)
    return Report(*given)._replace(**changes)
