"""Names for what users pass to jast: the functions of a system, rewards, choices of actions,
callbacks and executors.

They are for annotations: `Step` says what ``step`` of a `jast.Simulator` takes and returns.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, Protocol, TypeAlias

import jax
import numpy as np

__all__ = [
    "Actions",
    "Array",
    "ArrayTree",
    "Callback",
    "Density",
    "DistributionLike",
    "Disturbance",
    "Evaluate",
    "Executor",
    "Init",
    "IsTerminal",
    "Numeric",
    "Objective",
    "Observe",
    "PRNGKey",
    "PathLike",
    "Predict",
    "Reward",
    "Schedule",
    "Start",
    "Step",
]

Array: TypeAlias = jax.Array | np.ndarray | np.bool_ | np.number
"""An array of JAX or NumPy, or one number of NumPy; no number of Python."""

Numeric: TypeAlias = Array | float | int
"""An array or a number."""

ArrayTree: TypeAlias = "Array | Iterable[ArrayTree] | Mapping[Any, ArrayTree]"
"""A pytree of arrays."""

PRNGKey: TypeAlias = jax.Array
"""A key of `jax.random`."""

PathLike: TypeAlias = str | os.PathLike[str]
"""Where a file or a folder is."""

Callback: TypeAlias = Callable[[int, int, Any], object]
"""``callback(done, total, result)``: called between pieces of long work, with the result so far or
None.
"""

Density: TypeAlias = Literal["raw", "mode"]
"""Which log p a reward is given: the log density, or that less its value at the mode."""

Schedule: TypeAlias = Callable[[int, int], Sequence[int]]
"""``schedule(budget, iterations)``: how many samples each iteration gets; see
`jast.cross_entropy.schedules`.
"""


class DistributionLike(Protocol):
    """A distribution of jast, of distrax, or of one's own.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> class Coin:  # 0 or 1
        ...     def sample(self, *, seed, sample_shape=()):
        ...         return jax.random.bernoulli(seed, 0.5, sample_shape).astype(jnp.int32)
        ...
        ...     def log_prob(self, value):
        ...         return jnp.full(jnp.shape(value), jnp.log(0.5))
        >>> coin: "jast.typing.DistributionLike" = Coin()
        >>> coin.sample(seed=jax.random.key(0)).dtype, coin.log_prob(1).shape
        (dtype('int32'), ())
    """

    def sample(self, *, seed: Any, sample_shape: Any = ()) -> Any:
        """Values of shape ``sample_shape`` + that of one value."""
        ...

    def log_prob(self, value: Any) -> Any:
        """Log density of ``value``."""
        ...


class Init(Protocol):
    """``init`` of a `jast.Simulator`: the state that the initial disturbance leads to.

    Example:
        >>> import jax.numpy as jnp
        >>> def init(x0):  # at rest, at a random height
        ...     return jnp.stack([x0, 0.0])
        >>> init(jnp.array(3.0)).tolist()
        [3.0, 0.0]
    """

    def __call__(self, x0: Any, /) -> ArrayTree: ...


class Step(Protocol):
    """``step`` of a `jast.Simulator`: the next state, of the same shapes and dtypes.

    Example:
        >>> import jax.numpy as jnp
        >>> def step(state, x):  # position and speed, after a gust x
        ...     position, speed = state
        ...     return jnp.stack([position + speed, 0.5 * speed + x])
        >>> step(jnp.array([1.0, 2.0]), 0.5).tolist()
        [3.0, 1.5]
    """

    def __call__(self, state: Any, x: Any, /) -> ArrayTree: ...


class Disturbance(Protocol):
    """``disturbance`` of a `jast.Simulator`: the distribution p(x | state) of the next
    disturbance.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> def disturbance(state):  # the faster, the stronger
        ...     return D.Normal(0.0, 1.0 + jnp.abs(state[1]))
        >>> float(disturbance(jnp.array([0.0, 2.0])).scale)
        3.0
    """

    def __call__(self, state: Any, /) -> DistributionLike: ...


class Evaluate(Protocol):
    """``evaluate`` of a `jast.Simulator`: (failure event, miss distance), and log p as a third
    value where only the system knows it.

    Example:
        >>> import jax.numpy as jnp
        >>> def evaluate(state):  # fails 1.4 m from the middle
        ...     distance = jnp.maximum(1.4 - jnp.abs(state), 0.0)
        ...     return distance <= 0.0, distance
        >>> [bool(evaluate(jnp.array(s))[0]) for s in (0.5, -1.5)]
        [False, True]
    """

    def __call__(self, state: Any, /) -> tuple[Array, ...]: ...


class Start(Protocol):
    """``start`` of a `jast.Simulator`: the distribution p(x0) of the initial disturbance.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> def start():  # the height at the beginning
        ...     return D.Uniform(2.0, 4.0)
        >>> float(jnp.exp(start().log_prob(3.0)))
        0.5
    """

    def __call__(self) -> DistributionLike: ...


class IsTerminal(Protocol):
    """``is_terminal`` of a `jast.Simulator`: whether the episode ends without a failure.

    Example:
        >>> import jax.numpy as jnp
        >>> def is_terminal(state):  # landed: nothing can fail any more
        ...     return state <= 0.0
        >>> bool(is_terminal(jnp.array(-0.1)))
        True
    """

    def __call__(self, state: Any, /) -> Array: ...


class Observe(Protocol):
    """``observe`` of a `jast.Simulator`: the float vector that policies and networks see.

    Example:
        >>> import jax.numpy as jnp
        >>> def observe(state):  # an angle without a jump, and a rate
        ...     return jnp.stack([jnp.sin(state[0]), jnp.cos(state[0]), state[1]])
        >>> observe(jnp.zeros(2)).tolist()
        [0.0, 1.0, 0.0]
    """

    def __call__(self, state: Any, /) -> Array: ...


class Reward(Protocol):
    """What a search maximises, for one arrival at a state; see `jast.rewards`.

    Example:
        >>> import jax.numpy as jnp
        >>> def reward(log_p, event, distance, terminal, approach):  # the last distance costs
        ...     return log_p - jnp.where(terminal, distance, 0.0)
        >>> float(reward(-1.0, False, 3.0, True, 0.0))
        -4.0
    """

    def __call__(
        self, log_p: Any, event: Any, distance: Any, terminal: Any, approach: Any, /
    ) -> Any: ...


class Actions(Protocol):
    """How a search chooses disturbances; see `jast.actions`.

    Example:
        >>> import jax, jax.numpy as jnp, jast
        >>> from jast import distributions as D
        >>> class Twice:  # draws of the model, doubled
        ...     def draw(self, key, dist):
        ...         return 2.0 * dist.sample(seed=key)
        ...
        ...     draw_start = draw
        ...
        ...     def log_prob(self, x, dist):
        ...         return dist.log_prob(x / 2.0) - jnp.log(2.0)
        >>> Twice().draw(jax.random.key(0), D.Normal(0.0, 1.0)).shape
        ()
    """

    def draw(self, key: PRNGKey, dist: DistributionLike) -> ArrayTree:
        """One disturbance, where ``dist`` is the model of disturbances at the state."""
        ...

    def draw_start(self, key: PRNGKey, dist: DistributionLike) -> ArrayTree:
        """One initial disturbance, where ``dist`` is its model."""
        ...

    def log_prob(self, x: Any, dist: DistributionLike) -> Array:
        """Log density of `draw` at ``x``."""
        ...


class Objective(Protocol):
    """A function of a vector [d] to be minimised; see `jast.cross_entropy`.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> def bowl(x):
        ...     return jnp.sum((x - 1.0) ** 2)
        >>> wide = ce.normal(jnp.zeros(2), 9.0)
        >>> found = ce.ce_method(jax.random.key(0), bowl, wide, iterations=5)
        >>> bool(found.best_value < 1.0)
        True
    """

    def __call__(self, x: Any, /) -> Any: ...


class Predict(Protocol):
    """A classifier under test: labels [m] of the inputs [m, ...]; see `jast.weakness.validate`.

    Example:
        >>> import numpy as np
        >>> def predict(inputs):  # bright images are of class 1
        ...     return (inputs.sum((1, 2)) > 20).astype(int)
        >>> predict(np.ones((2, 8, 8))).tolist()
        [1, 1]
    """

    def __call__(self, inputs: Any, /) -> Any: ...


class Executor(Protocol):
    """What runs units of work elsewhere: an executor of `concurrent.futures`, a client of Dask.

    Example:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> with ThreadPoolExecutor(2) as executor:
        ...     executor.submit(max, 2, 3).result()
        3
    """

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        """Start ``function(*arguments)``; returns a future."""
        ...
