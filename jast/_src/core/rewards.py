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

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Density, Numeric, Reward
from jast._src.runtime._jax import is_traced
from jast._src.util.checks import check_numbers, one_of

__all__ = [
    "Episodic",
    "Lexicographic",
    "LogLikelihood",
    "STANDARD",
    "Shaped",
    "Standard",
    "as_pytree",
    "density_of",
    "episodic",
    "lexicographic",
    "likelihood",
    "log_likelihood",
    "once",
    "shaped",
    "standard",
]

_density = dict(default="raw", metadata=dict(static=True))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Standard:
    """See `standard`.

    Example:
        >>> from jast.rewards import Standard
        >>> float(Standard(event_bonus=50.0)(-1.0, True, 0.0, True))
        49.0
    """

    event_bonus: Numeric = 0.0
    density: str = field(**_density)

    def __call__(
        self, log_p: Any, event: Any, distance: Any, terminal: Any, approach: Any = 0.0
    ) -> Any:
        bonus = _like(self.event_bonus, log_p)
        return log_p + jnp.where(terminal, jnp.where(event, bonus, -distance), 0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Episodic:
    """See `episodic`.

    Example:
        >>> from jast.rewards import Episodic
        >>> float(Episodic(bonus=10.0)(-1.0, False, 2.0, True))  # a miss by 2
        -3.0
    """

    bonus: Numeric = 100.0
    density: str = field(**_density)
    mode: str = field(default="default", metadata=dict(static=True))

    @property
    def once(self) -> bool:
        return self.mode == "thesis"

    def __call__(
        self, log_p: Any, event: Any, distance: Any, terminal: Any, approach: Any = 0.0
    ) -> Any:
        bonus = _like(self.bonus, log_p)
        if self.mode == "thesis":
            return jnp.where(event, bonus, 1) * (log_p - distance)  # eq. 3.2
        depth = jnp.where(event, (bonus - 1) * jnp.maximum(-distance, 0), 0)
        return log_p + jnp.where(terminal, depth - distance, 0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shaped:
    """See `shaped`.

    Example:
        >>> from jast.rewards import Shaped
        >>> float(Shaped(scale=2.0)(-1.0, False, 3.0, False, 0.5))  # it came nearer by 0.5
        0.0
    """

    scale: Numeric = 1.0
    event_bonus: Numeric = 0.0
    density: str = field(**_density)

    def __call__(
        self, log_p: Any, event: Any, distance: Any, terminal: Any, approach: Any = 0.0
    ) -> Any:
        scale, bonus = (_like(v, log_p) for v in (self.scale, self.event_bonus))
        return log_p + scale * approach + jnp.where(event, bonus, 0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LogLikelihood:
    """The log density alone: likelihood where failures are all that is ranked, and a reward that
    costs nothing where only the course of an episode is wanted.

    Example:
        >>> from jast.rewards import LogLikelihood
        >>> LogLikelihood()(-4.5, False, 3.0, True)
        -4.5
    """

    density: str = field(**_density)

    def __call__(
        self, log_p: Any, event: Any, distance: Any, terminal: Any, approach: Any = 0.0
    ) -> Any:
        return log_p


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lexicographic:
    """See `lexicographic`.

    Example:
        >>> import jast
        >>> reward = jast.rewards.lexicographic()
        >>> reward.scaled, reward.once  # a search sets the scales
        (False, True)
    """

    near: Numeric | None = None
    rare: Numeric | None = None
    likely: Numeric = 0.0
    density: str | None = field(default=None, metadata=dict(static=True))

    once = True

    @property
    def scaled(self) -> bool:
        """Whether it has its scales; else a search sets them."""
        return self.near is not None and self.rare is not None

    def __call__(
        self, log_p: Any, event: Any, distance: Any, terminal: Any, approach: Any = 0.0
    ) -> jax.Array:
        if not self.scaled:
            raise ValueError(
                "rewards.lexicographic: only a search sets near and rare by itself; here give"
                " both, such as lexicographic(near=1.0, rare=10.0)"
            )
        near, rare, likely = (_like(v, log_p) for v in (self.near, self.rare, self.likely))
        cost, miss = (likely - log_p) / rare, jnp.maximum(distance, 0)
        below = jnp.reciprocal(1 + jnp.maximum(cost, 0))
        above = 2 - jnp.reciprocal(1 + jnp.maximum(-cost, 0))  # likelier than ``likely``
        value = jnp.where(event, jnp.where(cost < 0, above, below), -miss / (near + miss))
        return jnp.where(log_p == -jnp.inf, -jnp.inf, value)  # the model never does that


def standard(event_bonus: Numeric = 0.0, density: Density = "raw") -> Standard:
    """Sum of every step's log p, plus a bonus at a failure, or less the miss distance at any other
    end.

    Eq. 3.1 of Moss's thesis, eq. 3 of Lipkis and Agogino, eq. 1 of MCFS-AP as a sum of logs. Unlike
    in the first two as printed, the last step's log p counts. The published ferry reward is
    ``standard(event_bonus=30., density="mode")``.

    Args:
        event_bonus: paid at a failure.
        density: "mode" counts log p less its value at the mode, "raw" the log density itself.

    Example:
        >>> import jast
        >>> float(jast.rewards.standard()(-1.0, False, 3.0, True))
        -4.0
    """
    check_numbers("rewards.standard", event_bonus=event_bonus)
    return Standard(event_bonus, _checked("standard", density))


def episodic(
    bonus: Numeric = 100.0,
    density: Density = "raw",
    mode: Literal["default", "thesis"] = "default",
) -> Episodic:
    """log p - d at a non-failing end; at a failure log p - d + (bonus - 1) max(-d, 0).

    This is eq. 3.2 of Moss's thesis, ``(log p - d) bonus``, made monotone. As printed the equation
    multiplies log p < 0 by the bonus as well, so a failure less deep than -log p scores far below a
    miss, and searches turn away from it. Here only the depth of the failure (a negative miss
    distance) is multiplied.

    Args:
        bonus: factor of the depth of a failure.
        density: "mode" counts log p less its value at the mode, "raw" the log density itself.
        mode: "thesis" is the equation as printed; it warns (UserWarning).

    Example:
        >>> import jast
        >>> float(jast.rewards.episodic(bonus=10.0)(-1.0, True, -2.0, True))
        19.0
    """
    check_numbers("rewards.episodic", bonus=bonus)
    one_of("rewards.episodic", "mode", mode, ("default", "thesis"))
    if mode == "thesis":
        warnings.warn(
            "rewards.episodic: eq. 3.2 as printed scores a failure below a miss unless its miss"
            ' distance is below log p; use mode="default" for anything but a comparison with the'
            " thesis",
            stacklevel=2,
        )
    return Episodic(bonus, density=_checked("episodic", density), mode=mode)


def shaped(scale: Numeric, event_bonus: Numeric = 0.0, density: Density = "raw") -> Shaped:
    """log p + scale (d(s) - d(s')) at every step, plus a bonus on arrival at a failure: eq. 21 of
    Lipkis and Agogino, paid once.

    The shaping telescopes to scale (d(s0) - d(sT)), so it moves no optimum between episodes of
    equal start and end distance. For an episodic system, whose distance means nothing before its
    end, it is -scale d(sT).

    Args:
        scale: worth of a unit of miss distance.
        event_bonus: paid at a failure.
        density: "mode" counts log p less its value at the mode, "raw" the log density itself.

    Example:
        >>> import jast
        >>> float(jast.rewards.shaped(2.0)(-1.0, False, 3.0, False, 0.5))
        0.0
    """
    check_numbers("rewards.shaped", scale=scale, event_bonus=event_bonus)
    return Shaped(scale, event_bonus, _checked("shaped", density))


def lexicographic(
    near: Numeric | None = None,
    rare: Numeric | None = None,
    likely: Numeric = 0.0,
    density: Density | None = None,
) -> Lexicographic:
    """Any failure above all episodes that do not fail; failures by log p, the others by nearness.

    The default of every search. A failure earns 1 / (1 + u) with u = (likely - log p) / rare, which
    is in (0, 1]; another episode -d / (near + d), its miss distance d at least 0, which is in
    (-1, 0]. So it is bounded, as trees need it, and no weight of log p against distance is to be
    chosen. The order of episodes is that of (failure, log p, -distance) whatever the scales; these
    only say which differences a mean over many episodes sees.

    Args:
        near: a miss distance that is neither near nor far, above 0. None: a search sets it to the
            median miss distance of plain episodes of the model, those that miss.
        rare: nats, above 0: how far log p of an episode usually is below ``likely``. None: a search
            sets it to the median of that over the same episodes. Medians, as they have the unit of
            what they divide and heed no outlier: a system written in other units has the same
            rewards.
        likely: log p of an episode from which rarity is counted: 0 with ``density="mode"``. Where a
            search sets the scales of raw densities, the highest of the plain episodes; an episode
            above it earns up to 2.
        density: "mode" counts log p less its value at the mode, "raw" the log density itself. None:
            "mode", and in a search "raw" where a distribution has no finite mode.

    Raises:
        ValueError: for a scale that is not above 0, an unknown density; when called without its
            scales.

    Example:
        >>> import jast
        >>> reward = jast.rewards.lexicographic(near=2.0, rare=10.0)
        >>> failure, miss = reward(-10.0, True, 0.0, True), reward(-1.0, False, 2.0, True)
        >>> float(failure), float(miss)
        (0.5, -0.5)
    """
    for name, value in (("near", near), ("rare", rare)):
        if value is None:
            continue
        check_numbers("rewards.lexicographic", **{name: value})
        if not is_traced(value) and not value > 0:
            raise ValueError(f"rewards.lexicographic: {name} must be above 0, received {value!r}")
    if density is not None:
        _checked("lexicographic", density)
    elif near is not None and rare is not None:
        density = "mode"
    return Lexicographic(near, rare, likely, density)


def likelihood(sim: Simulator) -> LogLikelihood:
    """The log density as a reward, free of units where it can be: relative to the mode where the
    disturbances have modes.

    Args:
        sim: the simulator.

    Example:
        >>> import jast
        >>> jast.rewards.likelihood(jast.simulators.walk1d()).density
        'mode'
    """
    return LogLikelihood(signature_of(sim).density)


def density_of(reward: Reward) -> Density:
    """The density, "raw" or "mode", that a reward wants its log p in.

    Args:
        reward: any reward.

    Example:
        >>> import jast
        >>> jast.rewards.density_of(jast.rewards.standard(density="mode"))
        'mode'
    """
    return getattr(getattr(reward, "func", reward), "density", "raw")


def once(reward: Reward) -> bool:
    """Whether a reward is one of whole episodes: it is called with the sum of their log p, and what
    it returns at the end is the episode's reward.

    Args:
        reward: any reward.

    Example:
        >>> import jast
        >>> jast.rewards.once(jast.rewards.lexicographic())
        True
    """
    return getattr(getattr(reward, "func", reward), "once", False)


def as_pytree(reward: Reward) -> Reward:
    """A reward as what `jax.jit` takes: a plain function becomes a `jax.tree_util.Partial`, static
    by identity.

    Args:
        reward: any reward.

    Raises:
        ValueError: for what cannot be called.

    Example:
        >>> import jax, jast
        >>> reward = jast.rewards.as_pytree(lambda log_p, event, d, terminal, approach: log_p)
        >>> jax.tree.leaves(reward)
        []
    """
    if not callable(reward):
        raise ValueError(
            f"reward must be one of jast.rewards, or a function like these, received {reward!r:.80}"
        )
    return Partial(reward) if jax.tree_util.all_leaves([reward]) else reward


def _checked(name, density):
    if density not in ("raw", "mode"):
        raise ValueError(f'rewards.{name}: density must be "raw" or "mode", received {density!r}')
    return density


def _like(value, log_p):
    return jnp.asarray(value, jnp.result_type(log_p))


STANDARD = standard()
log_likelihood: LogLikelihood = LogLikelihood()
