"""sac: a failure policy by soft actor-critic (Lipkis and Agogino, NASA; Haarnoja et al. 2018,
arXiv:1812.05905).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp

from jast._checks import random_key, whole
from jast.checkpoints import open_checkpoint
from jast.contract import OBSERVED, contract
from jast.memory import require, size
from jast.outline import outline
from jast.policies import course, settings
from jast.policies import training as T
from jast.policies.exploring import Shape
from jast.policies.failure_policy import FailurePolicy, Learned, assemble, history
from jast.policies.latent import sizes
from jast.policies.learner import Rates, networks
from jast.simulator import Simulator

if TYPE_CHECKING:
    import chex

    from jast.typing import Callback, PathLike


__all__ = ["sac"]

UPDATES = 5000
ALONE = 0.1
"""Share of the learning of the critics alone."""


def sac(
    key: chex.PRNGKey,
    sim: Simulator,
    *,
    episodes: int = 12_000,
    scale: float | Literal["auto"] = "auto",
    bonus: float = 0.0,
    alpha: float | Literal["auto"] = 1.0,
    entropy: float = -0.1,
    shaping: Literal["auto", "steps", "end"] = "auto",
    widen: float | Literal["auto"] = "auto",
    components: int = 2,
    lanes: int = 16,
    hidden: Sequence[int] = (100, 100),
    learning_rate: float = 1e-3,
    batch: int = 256,
    buffer: int = 100_000,
    polyak: float = 0.01,
    updates: int | Literal["auto"] = "auto",
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
) -> FailurePolicy:
    """Teach a policy by soft actor-critic to make a system fail in the likeliest ways: a
    `jast.Policy` with its start, for `jast.rollout` and importance sampling.

    The policy acts in the latents z of a disturbance, x = Q(Phi(z)) with z ~ N(0, I) under p(x |
    s). Any disturbance of floats that has a quantile function and its inverse will do, whatever its
    units. The networks see ``observe(state)``, d(s) and t / horizon. The reward of a step is -|z|^2
    / 2 (log p relative to its mode) + lambda (d(s) - d(s')) + ``bonus`` at a failure, undiscounted
    (eq. 21 of Lipkis and Agogino; d is the miss distance, and counts 0 at a failure). The start
    that is handed out is a mixture fitted to p(x0) exp(V(s0) - lambda d(s0)) by the critics, 5 % of
    it p(x0); a start that is not of floats with quantiles is left as it is.

    Transitions in which a number is not finite are counted (``history.invalid``), end their episode
    and are never learned from. Where there are more ways to fail out of one certain state than
    ``components``, the others are left out. A proposal that is moved to the ``mode`` has only one
    of them; importance sampling from the policy itself has both of two.

    The loop runs on the host, so not under `jax.jit` or `jax.vmap`; the result does.

    Args:
        key: consumed.
        sim: the simulator.
        episodes: in all, of full length; where they end early there are more of them. At least 4
            for each lane.
        scale: lambda, above 0, per unit of distance: above the log-likelihood that the last unit
            costs. "auto" begins with 1.5 E[d] / Var[d] of the nominal miss distance (that cost were
            d normal and linear in z), or, where d does not vary, with what makes the loss of a
            typical distance worth 64. It is raised by half after each twentieth of the training in
            which less than a fifth of the episodes failed, up to three quarters of the training.
        bonus: of the reward at a failure.
        alpha: temperature, above 0. With 1 the best policy is the disturbances given failure, and V
            the log of their probability. "auto": such that the mean entropy of a latent is
            ``entropy`` above that of N(0, 1) (on `landing` 1.1 to 1.2, and no sharper).
        entropy: see ``alpha``.
        shaping: "steps": d counts at every state, also of an ``episodic`` system, where it must
            then mean something on the way (as in `landing`). "end": only at the end of an episode,
            a sparse reward. "auto": "end" for an episodic black box, else "steps".
        widen: starts are drawn this many times as wide as p(x0), at least 1. "auto": 3, or, where
            that is more, a third of E[d] over the deviation of d, at most 10.
        components: of the policy, a mixture of normal distributions of z: the ways out of one
            state. Its ``mode`` is the middle of the heaviest.
        lanes: episodes side by side.
        hidden: widths of the networks' layers.
        learning_rate: of Adam; falls to a twentieth.
        batch: transitions of one update.
        buffer: transitions that are kept to learn from.
        polyak: rate of the target networks.
        updates: of all networks after each step of all lanes. "auto": one, or as many as make 5000
            in all.
        progress: whether to show a progress bar.
        callback: called twenty times as ``callback(done, total, history)``, with the steps of all
            lanes and the `History` so far.
        checkpoint: a folder that keeps where the training stands after each stretch. The same call
            then goes on from there, to the same bits (docs/scale.md).

    Returns:
        `FailurePolicy`. A KeyboardInterrupt or SIGTERM ends the training after its last whole
        stretch and gives what was learned by then (it is raised again where there is none).

    Raises:
        ValueError: for settings out of range, a simulator that breaks its contract, a disturbance
            that is not of floats or cannot be tilted (named), and a checkpoint of another call.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> small = dict(episodes=32, lanes=4, hidden=(8,), batch=16, updates=1)
        >>> policy = jast.policies.sac(jax.random.key(0), sim, **small)
        >>> jast.rollout(jax.random.key(1), sim, policy).disturbances.shape
        (30,)
    """
    random_key("sac", key)
    contract("sac", sim, observed=OBSERVED)
    counts = dict(episodes=episodes, lanes=lanes, batch=batch, buffer=buffer, components=components)
    episodes, lanes, batch, buffer, components = (
        whole("sac", name, value) for name, value in counts.items()
    )
    plan = settings.plan("sac", episodes, sim.horizon, lanes)
    hidden = settings.widths("sac", hidden)
    dense = settings.shaped("sac", shaping, sim)
    auto_scale, auto_alpha = settings.auto(scale), settings.auto(alpha)
    scale = None if auto_scale else settings.positive("sac", "scale", scale)
    number = lambda name, value, holds, expected: settings.number(
        "sac", name, value, holds, expected
    )
    rates = Rates(
        learning_rate=settings.positive("sac", "learning_rate", learning_rate),
        polyak=number("polyak", polyak, lambda v: 0 < v <= 1, "above 0 and at most 1"),
        alpha=1.0 if auto_alpha else settings.positive("sac", "alpha", alpha),
        entropy=number("entropy", entropy, math.isfinite, "that is finite"),
        bonus=number("bonus", bonus, math.isfinite, "that is finite"),
        adapt=float(auto_alpha),
    )
    widen = settings.widening("sac", widen)
    if settings.auto(updates):
        updates = -(-UPDATES // plan.learning)
    updates = whole("sac", "updates", updates)
    n, n0 = sizes(sim, "sac")
    (m,) = outline(sim).observation
    shape = Shape(m, n, n0, hidden, components, dense, lanes, batch, max(buffer, lanes))
    about = dict(
        sim=sim,
        shape=shape,
        plan=plan,
        updates=updates,
        rates=rates,
        scale=scale,
        widen=widen,
    )

    for_first, for_steps, for_start = jax.random.split(key, 3)
    applies = tuple(apply for _, apply in networks(m, n, hidden, components))
    rates = jax.tree.map(jnp.float32, rates)
    acts = plan.nominal + plan.around + int(ALONE * plan.learning)
    phase = T.Phase(jnp.int32(0), jnp.int32(acts), jnp.float32(plan.total))
    begin = lambda: T.first(for_first, sim, shape, rates.alpha)
    like = jax.eval_shape(begin)
    kept = f"a buffer of {shape.capacity} steps and the networks"
    require("sac", 2 * size(like), kept, "use a smaller buffer")
    run = lambda updates: (
        lambda training, steps: jax.block_until_ready(
            T.stretch(
                for_steps,
                sim,
                shape,
                applies,
                rates,
                training,
                phase._replace(updates=jnp.int32(updates)),
                steps,
            )
        )
    )
    look = lambda: course.look(begin(), run(0), plan, sim.horizon, scale, widen)
    with open_checkpoint("sac", checkpoint, key, **about) as store:
        training, rows = course.learn(
            "sac",
            look,
            run(updates),
            plan,
            auto_scale=auto_scale,
            progress=progress,
            callback=callback,
            store=store,
            like=like,
        )
    tilt = T.tilt(for_start, sim, shape, applies, training, rates.bonus) if n0 else ()
    learned = Learned(
        training.learner.average,
        training.learner.target,
        training.net,
        tilt,
        jnp.exp(training.learner.log_alpha),
        training.scale,
    )
    return assemble(sim, applies[0], dense, learned, history(rows[1:]))
