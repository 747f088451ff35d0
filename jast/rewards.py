"""Rewards: what a search maximises, step by step; an episode's reward is the sum over s0..sT.

A reward is any function ``(log_p, event, distance, terminal, approach) -> float`` of one arrival at
a state:

=============  ===================================================================================
``log_p``      log density of the disturbance that led here; of x0 at the start
``event``      a failure was reached here (paid once: the episode ends)
``distance``   miss distance of the episode so far: the least, or the last one of an episodic system
``terminal``   the episode ends here, in a failure or otherwise
``approach``   by how much the last step reduced the state's own miss distance: d(s) - d(s')
=============  ===================================================================================

Its attribute ``density`` ("raw" where absent) says whether ``log_p`` is the log density or that
less its value at the mode. With an attribute ``once`` that is true it is a reward of whole
episodes: ``log_p`` is their sum, and what it returns at the end is all that the episode is paid.

An episodic system has no distance before its end: there ``distance`` and ``approach`` are 0, and at
the end ``approach`` is -d.
"""

import warnings
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

__all__ = [
    "Episodic",
    "Shaped",
    "Standard",
    "as_pytree",
    "density_of",
    "episodic",
    "log_likelihood",
    "once",
    "shaped",
    "standard",
]

_density = dict(default="raw", metadata=dict(static=True))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Standard:
    """See `standard`."""

    event_bonus: Any = 0.0
    density: str = field(**_density)

    def __call__(self, log_p, event, distance, terminal, approach=0.0):
        return log_p + jnp.where(
            terminal, jnp.where(event, _like(self.event_bonus, log_p), -distance), 0
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Episodic:
    """See `episodic`."""

    bonus: Any = 100.0
    density: str = field(**_density)
    mode: str = field(default="default", metadata=dict(static=True))

    @property
    def once(self):
        return self.mode == "thesis"

    def __call__(self, log_p, event, distance, terminal, approach=0.0):
        bonus = _like(self.bonus, log_p)
        if self.mode == "thesis":
            return jnp.where(event, bonus, 1) * (log_p - distance)  # eq. 3.2
        depth = jnp.where(event, (bonus - 1) * jnp.maximum(-distance, 0), 0)
        return log_p + jnp.where(terminal, depth - distance, 0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shaped:
    """See `shaped`."""

    scale: Any = 1.0
    event_bonus: Any = 0.0
    density: str = field(**_density)

    def __call__(self, log_p, event, distance, terminal, approach=0.0):
        return (
            log_p
            + _like(self.scale, log_p) * approach
            + jnp.where(event, _like(self.event_bonus, log_p), 0)
        )


def standard(event_bonus=0.0, density="raw"):
    """Sum of every step's log p, plus ``event_bonus`` at a failure or less the miss distance at
    another end.

    Thesis of Moss eq. 3.1, Lipkis and Agogino eq. 3, MCFS-AP eq. 1 as a sum of logs; unlike the
    first two as printed, the last step's log p counts. ``density="mode"`` counts log p less its
    value at the mode. The published ferry reward is ``standard(event_bonus=30., density="mode")``.
    """
    return Standard(event_bonus, _checked("standard", density))


def episodic(bonus=100.0, density="raw", mode="default"):
    """log p - d at a non-failing end; at a failure log p - d + (bonus - 1) max(-d, 0): thesis eq.
    3.2, ``(log p - d) bonus``, made monotone.

    As printed (``mode="thesis"``) the equation multiplies log p < 0 by the bonus as well, so a
    failure less deep than -log p scores far below a miss, and searches turn away from it; here only
    the depth of the failure (a negative miss distance) is multiplied. Warns (UserWarning) of that
    mode.
    """
    if mode not in ("default", "thesis"):
        raise ValueError(f'rewards.episodic: mode must be "default" or "thesis", received {mode!r}')
    if mode == "thesis":
        warnings.warn(
            "rewards.episodic: eq. 3.2 as printed scores a failure below a miss unless its miss"
            ' distance is below log p; use mode="default" for anything but a comparison with the'
            " thesis",
            stacklevel=2,
        )
    return Episodic(bonus, density=_checked("episodic", density), mode=mode)


def shaped(scale, event_bonus=0.0, density="raw"):
    """log p + scale (d(s) - d(s')) at every step, plus ``event_bonus`` on arrival at a failure:
    Lipkis and Agogino eq. 21, paid once.

    The shaping telescopes to scale (d(s0) - d(sT)), so it moves no optimum between episodes of
    equal start and end distance; for an episodic system, whose distance means nothing before its
    end, to -scale d(sT).
    """
    return Shaped(scale, event_bonus, _checked("shaped", density))


def log_likelihood(
    log_p: Any, event: Any, distance: Any, terminal: Any, approach: Any = 0.0
) -> Any:
    """The log density alone: a reward that costs nothing, where only the course of an episode is
    wanted.
    """
    return log_p


def density_of(reward):
    """The density, "raw" or "mode", that ``reward`` wants its log p in."""
    return getattr(getattr(reward, "func", reward), "density", "raw")


def once(reward):
    """Whether ``reward`` is of whole episodes: called with the sum of their log p, and what it
    returns at the end is the episode's reward.
    """
    return getattr(getattr(reward, "func", reward), "once", False)


def as_pytree(reward):
    """``reward`` as what `jax.jit` takes: a plain function becomes a `jax.tree_util.Partial`,
    static by identity.
    """
    return Partial(reward) if jax.tree_util.all_leaves([reward]) and callable(reward) else reward


def _checked(name, density):
    if density not in ("raw", "mode"):
        raise ValueError(f'rewards.{name}: density must be "raw" or "mode", received {density!r}')
    return density


def _like(value, log_p):
    return jnp.asarray(value, jnp.result_type(log_p))


STANDARD = standard()
