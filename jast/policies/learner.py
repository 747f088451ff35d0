"""Soft actor-critic (Haarnoja et al. 2018, arXiv:1812.05905) in the latents of a disturbance, with
the model itself as the measure of entropy.

With temperature 1 the soft return is sum log p(z) / pi(z | s) + lambda (d(s) - d(s_T)). Its optimum
is V(s) = log E_p[exp(lambda (d(s) - d(s_T)))], which is, less lambda d(s) and for a large lambda,
the log of the probability of failure from s; the best pi is the disturbances given failure.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jast.heads.networks import dense
from jast.policies.actor import act, adam, descend, drawn, entropy_term, network, see

__all__ = ["learner", "networks"]


class Rates(NamedTuple):
    """Real-valued settings of the updates, float32 and traced."""

    learning_rate: Any
    polyak: Any
    alpha: Any
    entropy: Any
    """Wanted entropy of the policy, of a latent and above that of N(0, 1)."""
    bonus: Any
    adapt: Any
    """1 where alpha follows ``entropy``, else 0."""


class Learner(NamedTuple):
    """All that is learned."""

    actor: Any
    critic: Any
    """Two, stacked in front."""
    target: Any
    """Their running averages."""
    average: Any
    """The actor's: what is handed out."""
    log_alpha: Any
    optimiser: Any
    """Adam's state of the actor, the critics and log alpha."""


def networks(m, n, hidden, components):
    """The networks' ``(init, apply)``, the actor's and the critic's, for ``m`` numbers seen, time
    and distance beside them, and ``n`` latents.
    """
    return network(n, hidden, components), dense(hidden, (), "relu", True)


def learner(key, m, n, hidden, components, alpha):
    """A `Learner` that has learned nothing."""
    inits = [init for init, _ in networks(m, n, hidden, components)]
    shapes = [
        jax.eval_shape(init, jax.random.key(0), jnp.zeros((size,), jnp.float32))
        for init, size in zip(inits, (m + 2, m + 2 + n), strict=True)
    ]
    actor, one, other = drawn(key, (shapes[0], shapes[1], shapes[1]))
    critic = jax.tree.map(lambda a, b: jnp.stack([a, b]), one, other)
    parts = actor, critic, jnp.log(alpha)
    return Learner(actor, critic, critic, actor, parts[2], tuple(adam().init(p) for p in parts))


def _values(apply, unit, critic, inputs, z):
    """[2]: Q of both critics. The networks' part is what is to come beside log p, so far out, where
    they know nothing, -|z|^2 / 2 decides.
    """
    both = jnp.concatenate([inputs, z])
    return unit * jax.vmap(lambda p: apply(p, both))(critic) - 0.5 * jnp.sum(z**2)


def _soft(applies, unit, actor, critic, inputs, noise):
    """The least of two Q, and the entropy term, in the mean over the components at a draw of
    each.
    """
    log_w, mean, deviation = act(applies[0], actor, inputs)
    w, z = jnp.exp(log_w), mean + deviation * noise[None]
    q = jax.vmap(lambda z: jnp.min(_values(applies[1], unit, critic, inputs, z)))(z)
    log_pi = jax.vmap(lambda z: entropy_term(z, log_w, mean, deviation))(z)
    return jnp.sum(w * q), jnp.sum(w * log_pi)


def soft_value(applies, unit, learner, inputs, noise):
    """V at ``inputs`` by the average actor and the target critics, over the draws ``noise`` [k, n]
    (Haarnoja eq. 3).
    """
    q, log_pi = jax.vmap(
        lambda e: _soft(applies, unit, learner.average, learner.target, inputs, e)
    )(noise)
    return jnp.mean(q - jnp.exp(learner.log_alpha) * log_pi)


def update(noise, learner, applies, net, rates, acting, scale, rows, horizon):
    """One step of all networks on transitions, ``rows`` [batch], with ``noise`` [2, batch, n]:
    ``(Learner, critic loss)``; ``scale`` is lambda.

    ``acting``: 1, or 0 while the critics learn alone.
    """
    unit, alpha = net.unit * scale, jnp.exp(learner.log_alpha)
    inputs = jax.vmap(lambda *row: see(net, horizon, *row))(rows.seen, rows.t, rows.potential)
    following = jax.vmap(lambda *row: see(net, horizon, *row))(
        rows.next_seen, rows.t + 1, rows.potential - rows.approach
    )
    soft = jax.vmap(lambda *args: _soft(applies, unit, *args), (None, None, 0, 0))

    q, log_pi = soft(learner.actor, learner.target, following, noise[0])
    # log p relative to its mode, the shaping and the bonus: Lipkis and Agogino eq. 21; the target:
    # Haarnoja eq. 5 with gamma 1
    reward = (
        -0.5 * jnp.sum(rows.z**2, axis=1)
        + scale * rows.approach
        + rates.bonus * rows.failure.astype(jnp.float32)
    )
    goal = reward + jnp.where(rows.done, 0, q - alpha * log_pi)

    def critic_loss(critic):
        q = jax.vmap(lambda i, z: _values(applies[1], unit, critic, i, z))(inputs, rows.z)
        return jnp.mean(((q - goal[:, None]) / unit) ** 2)

    def actor_loss(actor):  # Haarnoja eq. 7
        q, log_pi = soft(actor, learner.critic, inputs, noise[1])
        return jnp.mean(alpha * log_pi - q) / unit, jnp.mean(log_pi)

    loss, by_critic = jax.value_and_grad(critic_loss)(learner.critic)
    (_, log_pi), by_actor = jax.value_and_grad(actor_loss, has_aux=True)(learner.actor)
    # Haarnoja eq. 18, in log alpha: the mean entropy of a latent less that of N(0, 1), of which log
    # pi is -1/2, is held at what is wanted
    by_alpha = -rates.adapt * (log_pi + rows.z.shape[1] * (rates.entropy + 0.5))
    gradients, parts = (
        (by_actor, by_critic, by_alpha),
        (learner.actor, learner.critic, learner.log_alpha),
    )
    steps = acting * rates.learning_rate, rates.learning_rate, acting * rates.learning_rate
    moved = [
        descend(*each) for each in zip(gradients, learner.optimiser, parts, steps, strict=True)
    ]
    (actor, critic, log_alpha), optimiser = zip(*moved, strict=True)
    follow = lambda old, new: jax.tree.map(lambda a, b: a + rates.polyak * (b - a), old, new)
    return (
        Learner(
            actor,
            critic,
            follow(learner.target, critic),
            follow(learner.average, actor),
            log_alpha,
            optimiser,
        ),
        loss,
    )
