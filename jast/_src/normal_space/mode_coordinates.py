"""A simulator whose modes are the origin: the normal numbers of `normal_space.transform`, each less
that of the mode of the distribution it is drawn from.

Where the mode moves with the state, as of a random walk's next step, the number of a step that is
as likely as can be changes with all that came before. Counted from the mode it is 0 whatever came
before: so a search can change one step and leave the others as likely as they were.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.distributions.base import Wrapped

__all__ = ["Centred", "centred"]

MOST = 5.0
"""How far from 0 a mode may be; one at the end of its support is infinitely far."""


class Centred(Wrapped):
    """The same distribution, with its mode at the normal number 0."""

    def _sample_n(self, key: jax.Array, n: int) -> Any:
        return jax.vmap(lambda k: D.sample(self._distribution, k))(jax.random.split(key, n))

    def log_prob_from_mode(self, value: Any) -> jax.Array:
        return D.log_density(self._distribution, value, "mode")

    def mode(self) -> Any:
        return D.mode(self._distribution)

    def quantile(self, u: Any) -> Any:
        return D.quantile(self._distribution, u)

    def from_normal(self, z: Any) -> Any:
        moved = jax.tree.map(lambda a, b: a + b.astype(a.dtype), z, _centre(self._distribution))
        return D.from_normal(self._distribution, moved)

    def to_normal(self, x: Any) -> Any:
        z = D.to_normal(self._distribution, x)
        return jax.tree.map(lambda a, b: a - b.astype(a.dtype), z, _centre(self._distribution))


def centred(sim: Simulator) -> Simulator:
    """``sim`` with `Centred` distributions: the same episodes, in coordinates from the mode.
    Distributions without a mode, or whose mode is 0 already, stay as they are: they share compiled
    programs.
    """
    signature = signature_of(sim)
    changes = {}
    if signature.disturbance.mode and not signature.disturbance.mode_is_median:
        changes["disturbance"] = Partial(_of_state, sim.disturbance)
    if signature.random_start and signature.start.mode and not signature.start.mode_is_median:
        changes["start"] = Partial(_of_start, sim.start)
    return replace(sim, **changes)


def _of_state(disturbance: Any, state: Any) -> Centred:
    return Centred(disturbance(state))


def _of_start(start: Any) -> Centred:
    return Centred(start())


def _centre(d: Any) -> Any:
    """The normal number of the mode, cut at `MOST`."""
    z = _number_of_mode(d)
    return jax.tree.map(lambda a: jnp.where(jnp.isnan(a), 0, jnp.clip(a, -MOST, MOST)), z)


@jax.custom_vjp
def _number_of_mode(d: Any) -> Any:
    """It has slopes where it is finite, and else 0."""
    return D.to_normal(d, D.mode(d))


def _forward(d: Any) -> Any:
    return jax.vjp(lambda d: D.to_normal(d, D.mode(d)), d)


def _backward(pull: Any, slopes: Any) -> Any:
    return (jax.tree.map(_finite, *pull(slopes)),)


def _finite(a: Any) -> Any:
    return a if a.dtype == jax.dtypes.float0 else jnp.where(jnp.isfinite(a), a, 0)


_number_of_mode.defvjp(_forward, _backward)
