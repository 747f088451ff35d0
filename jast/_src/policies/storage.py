"""Learned policies in files: parameters, moments, the start and the curve of the training; the
simulator's functions are not in them.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jast._src.core.contract import OBSERVED, contract
from jast._src.core.signature import signature_of
from jast._src.io.codec import Given, check_fits
from jast._src.io.npz import misfit
from jast._src.policies.actor import count_latents, make_networks, parameter_shapes
from jast._src.policies.failure_policy import FailurePolicy, assemble
from jast._src.policies.q_learning_training import Table
from jast._src.policies.start_fit import Tilt

__all__ = ["parts", "whole"]


def parts(policy: FailurePolicy) -> dict[str, Any]:
    """The fields of a policy as a file has them."""
    learned, (sim, _, dense_reward) = policy.learned, policy.disturbance.args[:3]
    if isinstance(learned.actor, Table):
        raise ValueError("save: a policy of q_learning has no file: learn it again, with its key")
    about = dict(horizon=sim.horizon, dense=bool(dense_reward))
    return about | dict(learned=learned, history=policy.history)


def whole(path: Any, fields: dict[str, Any], given: Given) -> FailurePolicy:
    """The policy of `parts`; ValueError where it does not fit the simulator (horizon, numbers seen,
    sizes of x and x0), or there is none.
    """
    sim, learned = given.sim, fields["learned"]
    if sim is None:
        raise ValueError(
            f"load: {path} holds a failure policy, which only its simulator can restore: load(path,"
            " sim)"
        )
    contract("load", sim, observed=OBSERVED)
    if fields["horizon"] != sim.horizon:
        words = f"its horizon is {fields['horizon']}, expected {sim.horizon}"
        raise misfit(path, "sim", words)
    n, n0 = count_latents(sim, "load")
    layers = learned.actor["params"]
    *hidden, outputs = (len(layers[f"Dense_{i}"]["bias"]) for i in range(len(layers)))
    (init, _), (apply, _) = make_networks(n, tuple(hidden), outputs // (2 * n + 1))
    (m,) = signature_of(sim).observation
    check_fits(path, "sim", "actor", learned.actor, parameter_shapes(init, m + 2))
    start = ()
    if n0:
        k = len(learned.tilt[0]) if learned.tilt else 0
        start = Tilt(*(jax.ShapeDtypeStruct(s, jnp.float32) for s in ((k,), (k, n0), (k, n0))))
    check_fits(path, "sim", "the start", learned.tilt, start)
    return assemble(sim, apply, fields["dense"], learned, fields["history"])
