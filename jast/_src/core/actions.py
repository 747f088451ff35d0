"""Actions: what a search chooses at a step. An action becomes a disturbance before ``step``; only
disturbances are stored.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jast import distributions as D
from jast._src.core.typing import Array, ArrayTree, DistributionLike, Numeric, PRNGKey
from jast._src.distributions import fine_draws
from jast._src.distributions.normal_tails import normal_score
from jast._src.runtime._jax import is_traced
from jast._src.util.checks import check_numbers, wrong

__all__ = [
    "Quantiles",
    "Samples",
    "UniformBox",
    "Wide",
    "quantiles",
    "samples",
    "uniform",
    "wide",
]


class _OfTheModel:
    """What choices of actions share that draw from the model, or from a proposal in its place."""

    places_start = False
    focus = 1.0  # draws of the model are near its mode already

    def of(self, dist: DistributionLike) -> DistributionLike:
        """The distribution whose quantiles they are: the model."""
        return dist

    def locate(self, x: Any, dist: DistributionLike) -> ArrayTree:
        """The point of [0, 1]^d at which ``x`` is, a pytree like ``x``: the inverse of `at`."""
        return D.cdf(self.of(dist), x)

    def log_prob(self, x: Any, dist: DistributionLike) -> Array:
        """Log density of `draw` at ``x``."""
        return self.of(dist).log_prob(x)

    def near(
        self, x: Any, dist: DistributionLike, scale: Numeric, start: bool = False
    ) -> ArrayTree:
        """``x`` drawn towards the mode of the distribution, by ``scale`` in (0, 1]; integers
        stay.
        """
        return _towards_mode(x, dist if start else self.of(dist), scale)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Samples(_OfTheModel):
    """See `samples`.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> float(jast.actions.samples().near(jnp.array(4.0), D.Normal(0.0, 1.0), 0.5))
        2.0
    """

    def draw(self, key: PRNGKey, dist: DistributionLike) -> ArrayTree:
        """One disturbance by this choice of actions, where ``dist`` is the disturbance model at the
        state.
        """
        return D.sample(dist, key)

    draw_start = draw

    def at(self, u: Any, dist: DistributionLike) -> ArrayTree:
        """The disturbance at the point ``u`` of [0, 1)^d; uniform points are draws of ``dist``."""
        return D.quantile(dist, u)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Quantiles(_OfTheModel):
    """See `quantiles`.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> float(jast.actions.quantiles().place(jnp.array(0.5), D.Normal(1.0, 2.0)))  # the median
        1.0
    """

    numbers: tuple[Any, ...] = ()
    """The leaves of the proposal."""
    kind: jax.tree_util.PyTreeDef | None = field(default=None, metadata=dict(static=True))
    """Its structure, or None without one."""

    @property
    def places_start(self) -> bool:
        """Whether `place` serves x0 as well: a proposal is one of steps."""
        return self.kind is None

    def of(self, dist: DistributionLike) -> DistributionLike:
        """The distribution whose quantiles they are."""
        return dist if self.kind is None else self.kind.unflatten(self.numbers)

    def draw(self, key: PRNGKey, dist: DistributionLike) -> ArrayTree:
        return self.place(_like(jax.random.uniform, key, dist), dist)

    def draw_start(self, key: PRNGKey, dist: DistributionLike) -> ArrayTree:
        return D.quantile(dist, _like(jax.random.uniform, key, dist))

    def place(self, u: Any, dist: DistributionLike) -> ArrayTree:
        """The action at the point ``u`` in [0, 1)^d."""
        return D.quantile(self.of(dist), u)

    at = place


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UniformBox:
    """See `uniform`.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> box = jast.actions.uniform(-2.0, 2.0)
        >>> float(jnp.exp(box.log_prob(jnp.array(1.0), D.Normal(0.0, 1.0))))
        0.25
    """

    low: ArrayTree | float
    high: ArrayTree | float
    places_start = False
    focus = 0.2  # a box knows nothing of the model

    def draw(self, key: PRNGKey, dist: DistributionLike) -> ArrayTree:
        return self.place(_like(jax.random.uniform, key, dist), dist)

    def draw_start(self, key: PRNGKey, dist: DistributionLike) -> ArrayTree:
        """The box is one of steps: a random start is drawn from its own distribution."""
        return D.sample(dist, key)

    def log_prob(self, x: Any, dist: DistributionLike) -> Array:
        """Log density of `draw` at ``x``: uniform, -inf outside the box."""

        def of(x, low, high):
            dtype = D.float_dtype(x.dtype)
            low, high = _as(dtype, low, high)
            width = high - low if jnp.issubdtype(x.dtype, jnp.floating) else high - low + 1
            x = x.astype(dtype)
            return jnp.sum(jnp.where((x >= low) & (x <= high), -jnp.log(width), -jnp.inf))

        return D.sum_parts(jax.tree.map(of, x, *self.ends(x)))

    def near(
        self, x: Any, dist: DistributionLike, scale: Numeric, start: bool = False
    ) -> ArrayTree:
        """A box ``scale`` times as wide around the mode of ``dist``, cut to the box."""
        if start:
            return _towards_mode(x, dist, scale)

        def shrink(x, m, low, high):
            if not jnp.issubdtype(x.dtype, jnp.floating):
                return x
            low, high = _as(x.dtype, low, high)
            return jnp.clip(m + jnp.asarray(scale, x.dtype) * (x - (low + high) / 2), low, high)

        return jax.tree.map(shrink, x, D.mode(dist), *self.ends(x))

    def place(self, u: Any, dist: DistributionLike) -> ArrayTree:
        """The point of the box at ``u`` in [0, 1)^d; integers are the whole numbers from ``low`` to
        ``high``, both included.
        """

        def place(u, s, low, high):
            low, high = _as(u.dtype, low, high)
            if jnp.issubdtype(s.dtype, jnp.floating):
                return low + u * (high - low)
            return jnp.floor(low + u * (high - low + 1)).astype(s.dtype)

        return jax.tree.map(place, u, D.event_like(dist), *self.ends(u))

    at = place

    def locate(self, x: Any, dist: DistributionLike) -> ArrayTree:
        """The point of [0, 1]^d at which `place` gives ``x``, a pytree like ``x``: that of the box
        nearest to it. Integers: the middle of the cell.
        """

        def locate(x, low, high):
            dtype = D.float_dtype(x.dtype)
            low, high = _as(dtype, low, high)
            if jnp.issubdtype(x.dtype, jnp.floating):
                return D.fraction(x, low, high)
            return D.fraction(jnp.clip(x.astype(dtype), low, high) + 0.5, low, high + 1)

        return jax.tree.map(locate, x, *self.ends(x))

    def ends(self, x: Any) -> tuple[ArrayTree, ArrayTree]:
        """``low`` and ``high`` as pytrees like ``x``: each is one already, or an array that serves
        every one of ``x``. ValueError where it is neither.
        """
        return [self._like(x, side) for side in ("low", "high")]

    def _like(self, x, side):
        end, like = getattr(self, side), jax.tree.structure(x)
        if jax.tree.structure(end) == like:
            return end
        try:
            array = jnp.asarray(end)
        except (TypeError, ValueError):
            raise ValueError(
                f"actions.uniform: {side} is {jax.tree.structure(end)}, expected an array or the"
                f" structure of a disturbance, {like}"
            ) from None
        return jax.tree.map(lambda _: array, x)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Wide(_OfTheModel):
    """See `wide`.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> float(jast.actions.wide(3.0).of_normal(jnp.array(1.0), D.Normal(0.0, 2.0)))
        6.0
    """

    width: Numeric | None = None
    places_start = True
    focus = 0.3  # wide noise is far from the mode, and less so than a box

    def _width(self, dtype: Any) -> jax.Array:
        return jnp.asarray(1 if self.width is None else self.width, dtype)

    def draw(self, key: PRNGKey, dist: Any) -> Any:
        """One disturbance by this choice of actions, where ``dist`` is the disturbance model at the
        state.
        """
        return self.of_normal(_like(fine_draws.normal, key, dist), dist)

    def draw_start(self, key: PRNGKey, dist: Any) -> Any:
        """Likewise x0; drawn from its own distribution where that has no quantile function."""
        return self.draw(key, dist) if D.has_quantile(dist) else D.sample(dist, key)

    def of_normal(self, z: Any, dist: Any) -> Any:
        """The disturbance at the normal numbers ``width * z``."""
        return D.from_normal(dist, jax.tree.map(lambda z: self._width(z.dtype) * z, z))

    def place(self, u: Any, dist: Any) -> Any:
        """The action at the point ``u`` in [0, 1)^d."""
        return self.of_normal(jax.tree.map(normal_score, u), dist)

    at = place

    def locate(self, x: Any, dist: Any) -> Any:
        """The point of [0, 1]^d at which ``x`` is, a pytree like ``x``: the inverse of `place`."""
        return jax.tree.map(lambda z: D.phi(z / self._width(z.dtype)), D.to_normal(dist, x))

    def log_prob(self, x: Any, dist: Any) -> jax.Array:
        """Log density of `draw` at ``x``."""

        def ratio(z: jax.Array) -> jax.Array:
            width = self._width(z.dtype)
            e = z / width
            return jnp.sum(0.5 * (z - e) * (z + e) - jnp.log(width))

        return dist.log_prob(x) + D.sum_parts(jax.tree.map(ratio, D.to_normal(dist, x)))

    def near(self, x: Any, dist: Any, scale: Any, start: bool = False) -> Any:
        """``x`` drawn towards the mode of the distribution, to ``scale`` times the spread of the
        model's own draws; integers stay.
        """
        return _towards_mode(x, dist, scale if self.width is None else scale / self.width)


def samples() -> Samples:
    """Disturbances drawn from the model p(x | s): always possible, also where the density is
    unknown (`jast.distributions.seeds`).

    Example:
        >>> import jax, jast
        >>> from jast import distributions as D
        >>> jast.actions.samples().draw(jax.random.key(0), D.Normal(0.0, 1.0)).shape
        ()
    """
    return Samples()


def quantiles(proposal: DistributionLike | None = None) -> Quantiles:
    """Points of [0, 1]^d, turned into disturbances by the quantile function of p(x | s); uniform
    points are draws of p.

    Args:
        proposal: a distribution with a quantile function in place of p(x | s), the same at every
            step, from which a search is to draw instead. What it chooses is still scored by p(x |
            s), and a random start is drawn from its own distribution.

    Raises:
        ValueError: where the proposal has no quantile function.

    Example:
        >>> import jax, jast
        >>> from jast import distributions as D
        >>> chosen = jast.actions.quantiles(D.Normal(0.0, 3.0))
        >>> chosen.draw(jax.random.key(0), D.Normal(0.0, 1.0)).shape
        ()
    """
    serves = isinstance(proposal, D.Distribution) and D.has_quantile(proposal)
    if not (proposal is None or serves):
        expected = "proposal must be a distribution with a quantile function"
        raise ValueError(f"actions.quantiles: {expected}, received {proposal!r}"[:200])
    # a distribution itself cannot be mapped over, as searches do with what they are given
    numbers, kind = jax.tree.flatten(proposal)
    return Quantiles(tuple(numbers), None if proposal is None else kind)


def wide(width: Numeric | None = None) -> Wide:
    """Draws of the model with wider noise, which reach the tails of any distribution with a
    quantile function.

    x is at the normal numbers width z, z ~ N(0, I), where z itself gives draws of p(x | s)
    (`jast.distributions.from_normal`). So it works in any unit and never leaves the support. A
    random start is widened likewise where it has a quantile function. It is the default of searches
    where disturbances have one.

    Args:
        width: above 0; 1 is the model. None: a search takes the first of 1, 1.5, 2, 3, 4, 6 at
            which a hundredth of a small batch of episodes fails. Where none reaches that, it takes
            the one at which most fail, and where none fails at all the one that comes nearest.

    Raises:
        ValueError: for a width that is not above 0 and finite.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> draw = lambda key: jast.actions.wide(3.0).draw(key, D.Normal(0.0, 1.0))
        >>> x = jax.vmap(draw)(jax.random.split(jax.random.key(0), 1000))
        >>> bool(2.5 < jnp.std(x) < 3.5)
        True
    """
    if width is not None:
        check_numbers("actions.wide", width=width)
        if not is_traced(width) and not 0 < width < np.inf:
            wrong = "above 0" if not width > 0 else "finite"
            raise ValueError(f"actions.wide: width must be {wrong}, received {width!r}")
    return Wide(width)


def uniform(low: ArrayTree | float, high: ArrayTree | float) -> UniformBox:
    """Disturbances uniform on a box. The ferry's published actions are ``uniform(0., 1.)``.

    Args:
        low, high: corners of the box: scalars, arrays that broadcast to x, or pytrees of them where
            x is one.

    Raises:
        ValueError: for what is no number, and where ``low`` is above ``high``, unless they are
            traced.

    Example:
        >>> import jax, jast
        >>> from jast import distributions as D
        >>> x = jast.actions.uniform(-3.0, 3.0).draw(jax.random.key(0), D.Normal(0.0, 1.0))
        >>> -3.0 <= float(x) <= 3.0
        True
    """
    for name, end in (("low", low), ("high", high)):
        for leaf in jax.tree.leaves(end):
            check_numbers("actions.uniform", **{name: leaf})
    if not is_traced(low, high):
        _ordered(low, high)
    return UniformBox(low, high)


def _ordered(low, high):
    ends = [jax.tree.leaves(end) for end in (low, high)]
    most = max(map(len, ends))
    for a, b in zip(*(end * most if len(end) == 1 else end for end in ends)):
        try:
            above = bool(np.any(np.asarray(a) > np.asarray(b)))
        except (TypeError, ValueError):  # no numbers, or shapes that do not fit: `check` says which
            continue
        if above:
            must = "not be above high"
            raise wrong("actions.uniform", "low", must, f"low={low!r}, high={high!r}")


def _as(dtype, *values):
    return (jnp.asarray(v).astype(dtype) for v in values)


def _like(draw: Callable[..., jax.Array], key: PRNGKey, dist: DistributionLike) -> Any:
    """Numbers by ``draw(key, shape, dtype)`` in the shape of a value of ``dist``, one independent
    stream a leaf.
    """
    leaves, treedef = jax.tree.flatten(D.event_like(dist))
    keys = [key] if len(leaves) == 1 else [jax.random.fold_in(key, i) for i in range(len(leaves))]
    draws = [draw(k, s.shape, D.float_dtype(s.dtype)) for k, s in zip(keys, leaves, strict=True)]
    return treedef.unflatten(draws)


def _towards_mode(x, dist, scale):
    def shrink(x, m):
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        return m + jnp.asarray(scale, x.dtype) * (x - m)

    return jax.tree.map(shrink, x, D.mode(dist))
