"""Learned policies in one file: parameters, moments, the start and the curve of the training; the
simulator's functions are not in it.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.core.check import OBSERVED, contract
from jast._src.core.signature import outline
from jast._src.core.simulator import Simulator
from jast._src.heads.heads import Moments
from jast._src.io import save_load
from jast._src.io.npz import arrays_of, check_array, named
from jast._src.policies import proximal_training
from jast._src.policies.actor import Normalisation, count_latents, make_networks
from jast._src.policies.failure_policy import FailurePolicy, History, Learned, assemble
from jast._src.policies.q_learning_training import Table
from jast._src.policies.soft_actor_critic_training import init_learner
from jast._src.policies.start_fit import Tilt

if TYPE_CHECKING:
    from jast._src.core.typing import PathLike

__all__ = ["load", "save"]


def save(path: PathLike, policy: FailurePolicy) -> None:
    """Write a `FailurePolicy` to a file. Deprecated: use `jast.save`; this function goes with the
    next version.

    Args:
        path: of the file.
        policy: what to write.

    Raises:
        ValueError: for a policy of another kind.

    Example:
        >>> import jast
        >>> sim = jast.simulators.walk1d()
        >>> model = jast.Policy(sim.start, lambda s, t: sim.disturbance(s))
        >>> try:
        ...     jast.policies.save("policy.npz", model)
        ... except ValueError:
        ...     print("only what was learned")
        only what was learned
    """
    save_load.store(path, "jast policy", policy)


def load(path: PathLike, sim: Simulator) -> FailurePolicy:
    """A `FailurePolicy` from a file. Deprecated: use `jast.load`; this function goes with the next
    version.

    Args:
        path: of the file.
        sim: the simulator that the policy was taught on, or one like it.

    Example:
        >>> import os, tempfile, jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> small = dict(episodes=32, lanes=4, hidden=(8,), batch=16, updates=1)
        >>> policy = jast.policies.sac(jax.random.key(0), sim, **small)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "policy.npz")
        ...     jast.policies.save(path, policy)
        ...     type(jast.policies.load(path, sim)).__name__
        'FailurePolicy'
    """
    return save_load.restore(path, "jast policy", sim)[0]


def parts(policy: FailurePolicy) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and arrays of a policy's file."""
    if not isinstance(policy, FailurePolicy):
        raise ValueError(
            f"save: policy must be a jast.policies.FailurePolicy, received {type(policy).__name__}"
        )
    learned = policy.learned
    if isinstance(learned.actor, Table):
        raise ValueError("save: a policy of q_learning has no file: learn it again, with its key")
    layers = learned.actor["params"]
    widths = [int(layers[f"Dense_{i}"]["bias"].shape[0]) for i in range(len(layers))]
    sim, _, dense_reward = policy.disturbance.args[:3]
    n, _ = count_latents(sim, "load")
    components = widths[-1] // (2 * n + 1)
    header = dict(
        hidden=widths[:-1],
        components=components,
        horizon=sim.horizon,
        tilted=learned.tilt != (),
        dense=bool(dense_reward),
        # two critics of state and action, stacked in front, or one of the state
        critics=2 if learned.critic["params"]["Dense_0"]["bias"].ndim == 2 else 1,
    )
    return header, named(learned._asdict() | dict(history=policy.history))


def whole(
    path: str | os.PathLike, header: dict, arrays: dict[str, np.ndarray], sim: Simulator | None
) -> FailurePolicy:
    """The policy of `parts`; ValueError where it does not fit ``sim`` (horizon, numbers seen, sizes
    of x and x0), or there is none.
    """
    if sim is None:
        raise ValueError(
            f"load: {path} holds a failure policy, which only its simulator can restore: load(path,"
            " sim)"
        )
    contract("load", sim, observed=OBSERVED)
    if header["horizon"] != sim.horizon:
        raise ValueError(
            f"load: {path} does not fit sim: its horizon is {header['horizon']}, expected"
            f" {sim.horizon}"
        )
    n, n0 = count_latents(sim, "load")
    if header["tilted"] != bool(n0):
        raise ValueError(
            f"load: {path} does not fit sim: it holds {'a' if header['tilted'] else 'no'} learned"
            f" start, expected {'one' if n0 else 'none'}"
        )
    (m,) = outline(sim).observation
    hidden, components = tuple(header["hidden"]), header["components"]
    init = proximal_training.init_learner if header.get("critics") == 1 else init_learner
    new = jax.eval_shape(lambda: init(jax.random.key(0), m, n, hidden, components, jnp.float32(1)))

    def floats(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    k = len(arrays["tilt.0"]) if n0 else 0
    like = Learned(
        actor=new.actor,
        critic=new.critic,
        net=Normalisation(Moments(floats(), floats(m), floats(m)), floats()),
        tilt=Tilt(floats(k), floats(k, n0), floats(k, n0)) if n0 else (),
        alpha=floats(),
        scale=floats(),
    )
    learned = Learned(*(_part(path, name, arrays, part) for name, part in like._asdict().items()))
    _, (apply, _) = make_networks(n, hidden, components)
    history = History(*(np.asarray(a) for a in arrays_of(arrays, "history")))
    return assemble(sim, apply, header["dense"], learned, history)


def _part(path, name, arrays, like):
    leaves, structure = arrays_of(arrays, name), jax.tree.structure(like)
    if len(leaves) != structure.num_leaves:
        raise ValueError(
            f"load: {path} does not fit sim: {name} has {len(leaves)} arrays, expected"
            f" {structure.num_leaves}"
        )
    for a, (at, s) in zip(leaves, jax.tree_util.tree_leaves_with_path(like), strict=True):
        check_array(path, "sim", f"{name}{jax.tree_util.keystr(at)}", a, s)
    return structure.unflatten(leaves)
