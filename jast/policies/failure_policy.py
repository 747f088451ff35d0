"""What a learner of failures hands out: a `Policy` with its start, its parameters and the curve of
its training.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jast import results
from jast.distributions.mixtures import Blended
from jast.heads.heads import observed
from jast.policies.actor import act, see
from jast.policies.lanes import potential
from jast.policy import Policy

__all__ = ["FailurePolicy", "History"]


@results.shown()
class History(NamedTuple):
    """The training, a row for each stretch of it: [rows] each.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> small = dict(episodes=32, lanes=4, hidden=(8,), batch=16, updates=1)
        >>> policy = jast.policies.sac(jax.random.key(0), sim, **small)
        >>> int(policy.history.episodes[-1]) == int(policy.episodes)
        True
    """

    episodes: Any
    """Simulated so far, including those of the exploration before the learning."""
    steps: Any
    """Steps of the simulator so far."""
    mean_return: Any
    """Of the stretch's episodes: log p in the latents relative to the mode, -|z|^2 / 2, and lambda
    (d(s0) - d(s_T)).
    """
    failing_share: Any
    log_p: Any
    """Mean of -|z|^2 / 2 over its failing episodes; NaN where none failed."""
    alpha: Any
    critic_loss: Any
    """In squares of the unit that the critics answer in."""
    scale: Any
    """lambda."""
    invalid: Any
    """Transitions so far in which a number was not finite: they are left out of the training."""


FAILING_SHARE = History._fields.index("failing_share")
WHOLE = {"episodes": np.int64, "steps": np.int64, "invalid": np.int64}


def history(rows):
    """The `History` of ``rows`` [n, fields], float64."""
    return History(
        *(rows[:, i].astype(WHOLE.get(name, np.float64)) for i, name in enumerate(History._fields))
    )


def row(rows, training, count):
    """``rows`` and that of a stretch more, by its `Count`."""
    episodes, steps, invalid = (
        rows[-1, History._fields.index(name)] if len(rows) else 0 for name in WHOLE
    )
    share = lambda a, b: float(a) / float(b) if b else np.nan
    new = History(
        episodes=episodes + count.episodes,
        steps=steps + count.steps,
        mean_return=share(count.log_p + float(training.scale) * count.gain, count.whole),
        failing_share=share(count.failures, count.whole),
        log_p=share(count.failing_log_p, count.failures),
        alpha=np.exp(float(training.learner.log_alpha)),
        critic_loss=share(count.loss, count.updates),
        scale=float(training.scale),
        invalid=invalid + count.invalid,
    )
    return np.concatenate([rows, np.array([new], np.float64)])


class Learned(NamedTuple):
    """All that was learned, as arrays."""

    actor: Any
    """Parameters: the latents' mixture from what is seen."""
    critic: Any
    """Parameters: of `sac` those of two, stacked in front."""
    net: Any
    """`Net`: moments of the observation, unit of the critics."""
    tilt: Any
    """`Tilt` of the start, or () where it was not tilted."""
    alpha: Any
    scale: Any


@results.result("episodes")
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
        formats = dict(
            episodes="9d",
            mean_return="10.4g",
            failing_share="8.1%",
            log_p="9.4g",
            alpha="7.3f",
            critic_loss="10.3g",
            scale="9.4g",
        )
        names = ("episodes", "return", "failing", "log p", "alpha", "loss", "lambda")
        table = [
            " ".join(
                f"{name:>{form.split('.')[0].rstrip('d')}}"
                for name, form in zip(names, formats.values(), strict=True)
            )
        ]
        for i in sorted({*range(0, last, max(1, last // 8)), last}):
            table.append(
                " ".join(f"{getattr(h, name)[i].item():{form}}" for name, form in formats.items())
            )
        if h.invalid[-1]:
            table.append(
                f"{h.invalid[-1]} transitions were not finite and were left out of the training"
            )
        if self.learned.tilt != ():
            text = lambda a: np.array2string(np.asarray(a), precision=2, suppress_small=True)
            parts = (
                f"{w:.2f} N({text(m)}, {text(s)})"
                for w, m, s in zip(*self.learned.tilt, strict=True)
            )
            table.append("start, mean and deviation of its latents: " + " + ".join(parts))
        return "\n".join(table)


def assemble(sim, apply, dense, learned, history):
    """The `FailurePolicy` of ``sim`` with what was ``learned``; ``apply``: the actor's function;
    ``dense``: whether it sees the distance.
    """
    start = sim.start if learned.tilt == () else Partial(_start, sim.start, learned.tilt)
    return FailurePolicy(
        start,
        Partial(_disturbance, sim, apply, jnp.asarray(dense), learned.actor, learned.net),
        learned,
        history,
    )


def _start(start, tilt):
    dist = start()
    return Blended(dist, *tilt)


def _disturbance(sim, apply, dense, actor, net, state, t):
    inputs = see(net, sim.horizon, observed(sim, state), t, potential(sim, dense, state))
    log_w, mean, deviation = act(apply, actor, inputs)
    return Blended(sim.disturbance(state), jnp.exp(log_w), mean, deviation)
