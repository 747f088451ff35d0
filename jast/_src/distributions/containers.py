"""Distributions of vectors and structures whose parts are independent."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jast._src.core.typing import Array, PRNGKey
from jast._src.distributions.base import Distribution, is_distribution, tree_map
from jast._src.distributions.operations import mode
from jast._src.distributions.scipy_and_numpyro import translate

__all__ = ["Independent", "Joint", "accepted", "leaves"]


class Independent(Distribution):
    """The last ``reinterpreted_batch_ndims`` axes of a batch of distributions as one value.

    Args:
        distribution: of arrays, with a ``batch_shape``.
        reinterpreted_batch_ndims: how many axes; None: all but the first.

    Raises:
        ValueError: where values are structures, or there are fewer axes than that.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.Independent(D.Normal(jnp.zeros(3), 1.0), 1)
        >>> d.event_shape
        (3,)
    """

    def __init__(self, distribution: Any, reinterpreted_batch_ndims: int | None = None) -> None:
        d = _accepted(distribution)
        event, n = d.event_shape, reinterpreted_batch_ndims
        if not (isinstance(event, tuple) and all(isinstance(i, int) for i in event)):
            raise ValueError(
                f"Independent: distribution: expected one of arrays, received {_name(d)}"
                f" with event shape {event!r}; wrap its parts instead"
            )
        ndim = len(d.batch_shape)
        n = max(ndim - 1, 0) if n is None else n
        if not 0 <= n <= ndim:
            raise ValueError(
                f"Independent: reinterpreted_batch_ndims: {_name(d)} has {ndim} batch"
                f" dimensions, received {n}"
            )
        self.distribution: Any = d
        self.reinterpreted_batch_ndims: int = n

    @property
    def event_shape(self) -> Any:
        batch = self.distribution.batch_shape
        return batch[len(batch) - self.reinterpreted_batch_ndims :] + self.distribution.event_shape

    @property
    def batch_shape(self) -> tuple[int, ...]:
        batch = self.distribution.batch_shape
        return batch[: len(batch) - self.reinterpreted_batch_ndims]

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return self.distribution.sample(seed=key, sample_shape=n)

    def log_prob(self, value: Any) -> Array:
        log_p = self.distribution.log_prob(value)
        return jnp.sum(log_p, axis=tuple(-i - 1 for i in range(self.reinterpreted_batch_ndims)))

    def mean(self) -> Any:
        return self.distribution.mean()

    def variance(self) -> Any:
        return self.distribution.variance()

    def stddev(self) -> Any:
        return self.distribution.stddev()

    def median(self) -> Any:
        return self.distribution.median()

    def mode(self) -> Any:
        return mode(self.distribution)


class Joint(Distribution):
    """A structure (dict, tuple, NamedTuple, ...) of independent distributions of one batch shape:
    values are structures alike.

    Raises:
        ValueError: where a leaf is no distribution, or the batch shapes differ.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Joint({"gust": D.Normal(0.0, 1.0), "late": D.Bernoulli(probs=0.1)})
        >>> sorted(d.sample(seed=0))
        ['gust', 'late']
    """

    def __init__(self, distributions: Any) -> None:
        self.distributions: Any = tree_map(_accepted, distributions)
        batches = {d.batch_shape for d in leaves(self.distributions)}
        if len(batches) > 1:
            each = ", ".join(f"{_name(d)} {d.batch_shape}" for d in leaves(self.distributions))
            raise ValueError(
                f"Joint: expected one batch shape, received {each}; a part that is a vector is"
                " Independent(part, 1)"
            )

    @property
    def event_shape(self) -> Any:
        return tree_map(lambda d: d.event_shape, self.distributions)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return leaves(self.distributions)[0].batch_shape

    @property
    def dtype(self) -> Any:
        return tree_map(lambda d: d.dtype, self.distributions)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        treedef = jax.tree.structure(self.distributions, is_leaf=is_distribution)
        keys = treedef.unflatten(list(jax.random.split(key, treedef.num_leaves)))
        return tree_map(lambda d, k: d.sample(seed=k, sample_shape=n), self.distributions, keys)

    def log_prob(self, value: Any) -> Array:
        parts = tree_map(lambda d, v: d.log_prob(v), self.distributions, value)
        return jnp.sum(jnp.stack(jax.tree.leaves(parts)), axis=0)

    def mean(self) -> Any:
        return tree_map(lambda d: d.mean(), self.distributions)

    def median(self) -> Any:
        return tree_map(lambda d: d.median(), self.distributions)

    def mode(self) -> Any:
        return tree_map(mode, self.distributions)


def leaves(distributions: Any) -> list[Any]:
    """The distributions of a structure of them."""
    return jax.tree.leaves(distributions, is_leaf=is_distribution)


def accepted(d: Any) -> Any:
    """``d``, one of scipy.stats or of NumPyro as jast has it."""
    return d if isinstance(d, Distribution) else translate(d, Independent)


def _accepted(d: Any) -> Any:
    """The same, one of tensorflow-probability as distrax sees it."""
    if isinstance(d := accepted(d), Distribution):
        return d
    if type(d).__module__.partition(".")[0] != "tensorflow_probability":
        raise ValueError(f"expected a distribution, received {d!r}")
    from jast._src.distributions.distrax_loader import distrax

    return distrax.as_distribution(d)


def _name(d: Any) -> str:
    return type(d).__name__
