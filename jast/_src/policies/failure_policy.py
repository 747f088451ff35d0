"""What a learner of failures hands out: a `Policy` with its start, its parameters and the curve of
its training.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jast._src.core.policy import Policy
from jast._src.core.simulator import Simulator
from jast._src.core.typing import ArrayTree
from jast._src.distributions.mixtures import Blended
from jast._src.heads.heads import observation
from jast._src.policies.actor import Normalisation, latent_mixture, network_inputs
from jast._src.policies.lanes import potential
from jast._src.policies.start_fit import Tilt
from jast._src.util import display

__all__ = ["FailurePolicy", "History", "Learned", "assemble"]


@display.printable()
class History(NamedTuple):
    """The training, a row for each twentieth of it: [rows] each.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> small = dict(episodes=32, lanes=4, hidden=(8,), batch=16, updates=1)
        >>> policy = jast.policies.sac(jax.random.key(0), sim, **small)
        >>> int(policy.history.episodes[-1]) == int(policy.episodes)
        True
    """

    episodes: np.ndarray
    """Simulated so far, including those of the exploration before the learning."""
    steps: np.ndarray
    """Steps of the simulator so far."""
    mean_return: np.ndarray
    """Of the episodes since the row before: log p in the latents relative to the mode, -|z|^2 / 2,
    and lambda (d(s0) - d(s_T)).
    """
    failing_share: np.ndarray
    log_p: np.ndarray
    """Mean of -|z|^2 / 2 over its failing episodes; NaN where none failed."""
    alpha: np.ndarray
    critic_loss: np.ndarray
    """In squares of the unit that the critics answer in."""
    scale: np.ndarray
    """lambda."""
    invalid: np.ndarray
    """Transitions so far in which a number was not finite: they are left out of the training."""


class Learned(NamedTuple):
    """All that was learned, as arrays."""

    actor: ArrayTree
    """Parameters: the latents' mixture from what is observed; of `q_learning` the `Table`."""
    critic: ArrayTree
    """Parameters: of `sac` those of two, stacked in front."""
    net: Normalisation
    tilt: Tilt | tuple[()]
    """Of the start; () where it was not tilted."""
    alpha: jax.Array
    scale: jax.Array


@display.result_class("episodes")
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FailurePolicy(Policy):
    """A `Policy` that was taught to fail; a pytree of arrays, so it goes through `jax.jit` and
    `jax.vmap`. ``print`` shows how it learned.

    ``disturbance(state, t)`` is a mixture in the latents of x, its ``mode`` the deterministic
    policy's value; ``start()`` is the start tilted by the critics. Both have samples and densities,
    above 0 wherever the model's are, so `jast.rollout` plays it and importance sampling may draw
    from it.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> small = dict(episodes=32, lanes=4, hidden=(8,), batch=16, updates=1)
        >>> policy = jast.policies.sac(jax.random.key(0), sim, **small)
        >>> log_prob = policy.disturbance(sim.init(()), 0).log_prob(1.0)
        >>> bool(log_prob > -float("inf")), int(policy.episodes) >= 32
        (True, True)
    """

    learned: Learned = None
    history: History = None

    @property
    def episodes(self) -> Any:
        """int: episodes simulated."""
        return self.history.episodes[..., -1]

    @property
    def steps(self) -> Any:
        """int: steps of the simulator."""
        return self.history.steps[..., -1]

    @property
    def invalid(self) -> Any:
        """int: transitions in which a number was not finite."""
        return self.history.invalid[..., -1]

    def __str__(self) -> str:
        h, last = self.history, len(self.history.episodes) - 1
        columns = (  # field, heading, format
            ("episodes", "episodes", "9d"),
            ("mean_return", "return", "10.4g"),
            ("failing_share", "failing", "8.1%"),
            ("log_p", "log p", "9.4g"),
            ("alpha", "alpha", "7.3f"),
            ("critic_loss", "loss", "10.3g"),
            ("scale", "lambda", "9.4g"),
        )
        table = [" ".join(f"{name:>{form.split('.')[0].rstrip('d')}}" for _, name, form in columns)]
        for i in sorted({*range(0, last, max(1, last // 8)), last}):
            cells = (f"{getattr(h, field)[i].item():{form}}" for field, _, form in columns)
            table.append(" ".join(cells))
        if n := h.invalid[-1]:
            table.append(f"{n} transitions were not finite and were left out of the training")
        if self.learned.tilt != ():
            parts = zip(*self.learned.tilt, strict=True)
            components = (f"{w:.2f} N({_text(m)}, {_text(s)})" for w, m, s in parts)
            table.append("start, mean and deviation of its latents: " + " + ".join(components))
        return "\n".join(table)


def _text(array: Any) -> str:
    return np.array2string(np.asarray(array), precision=2, suppress_small=True)


def assemble(
    sim: Simulator, apply: Callable, dense_reward: bool, learned: Learned, history: History
) -> FailurePolicy:
    """The `FailurePolicy` of ``sim`` with what was ``learned``; ``apply``: the actor's function;
    ``dense_reward``: whether it sees the distance.
    """
    start = sim.start if learned.tilt == () else Partial(_start, sim.start, learned.tilt)
    of = sim, apply, jnp.asarray(dense_reward), learned.actor, learned.net
    return FailurePolicy(start, Partial(_disturbance, *of), learned, history)


def _start(start, tilt):
    return Blended(start(), *tilt)


def _disturbance(sim, apply, dense_reward, actor, normalisation, state, t):
    distance = potential(sim, dense_reward, state)
    inputs = network_inputs(normalisation, sim.horizon, observation(sim, state), t, distance)
    log_w, mean, deviation = latent_mixture(apply, actor, inputs)
    return Blended(sim.disturbance(state), jnp.exp(log_w), mean, deviation)
