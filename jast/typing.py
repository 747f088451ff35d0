"""Names for what users pass to jast: the functions of a system, rewards, choices of actions,
callbacks and executors.

They are for annotations: `Step` says what ``step`` of a `jast.Simulator` takes and returns. Arrays,
pytrees and keys are named by chex (``chex.Array``, ``chex.ArrayTree``, ``chex.PRNGKey``), which is
only imported by type checkers.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

if TYPE_CHECKING:
    import chex

__all__ = [
    "Actions",
    "Callback",
    "Density",
    "DistributionLike",
    "Disturbance",
    "Evaluate",
    "Executor",
    "Init",
    "IsTerminal",
    "Objective",
    "Observe",
    "PathLike",
    "Predict",
    "Reward",
    "Schedule",
    "Start",
    "Step",
]

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
    """A distribution of jast, of distrax, or of one's own."""

    def sample(self, *, seed: Any, sample_shape: Any = ()) -> Any:
        """Values of shape ``sample_shape`` + that of one value."""
        ...

    def log_prob(self, value: Any) -> Any:
        """Log density of ``value``."""
        ...


class Init(Protocol):
    """``init`` of a `jast.Simulator`: the state that the initial disturbance leads to."""

    def __call__(self, x0: Any, /) -> chex.ArrayTree: ...


class Step(Protocol):
    """``step`` of a `jast.Simulator`: the next state, of the same shapes and dtypes."""

    def __call__(self, state: Any, x: Any, /) -> chex.ArrayTree: ...


class Disturbance(Protocol):
    """``disturbance`` of a `jast.Simulator`: the distribution p(x | state) of the next
    disturbance.
    """

    def __call__(self, state: Any, /) -> DistributionLike: ...


class Evaluate(Protocol):
    """``evaluate`` of a `jast.Simulator`: (failure event, miss distance), and log p as a third
    value where only the system knows it.
    """

    def __call__(self, state: Any, /) -> tuple[chex.Array, ...]: ...


class Start(Protocol):
    """``start`` of a `jast.Simulator`: the distribution p(x0) of the initial disturbance."""

    def __call__(self) -> DistributionLike: ...


class IsTerminal(Protocol):
    """``is_terminal`` of a `jast.Simulator`: whether the episode ends without a failure."""

    def __call__(self, state: Any, /) -> chex.Array: ...


class Observe(Protocol):
    """``observe`` of a `jast.Simulator`: the float vector that policies and networks see."""

    def __call__(self, state: Any, /) -> chex.Array: ...


class Reward(Protocol):
    """What a search maximises, for one arrival at a state; see `jast.rewards`."""

    def __call__(
        self, log_p: Any, event: Any, distance: Any, terminal: Any, approach: Any, /
    ) -> Any: ...


class Actions(Protocol):
    """How a search chooses disturbances; see `jast.actions`."""

    def draw(self, key: chex.PRNGKey, dist: DistributionLike) -> chex.ArrayTree:
        """One disturbance, where ``dist`` is the model of disturbances at the state."""
        ...

    def draw_start(self, key: chex.PRNGKey, dist: DistributionLike) -> chex.ArrayTree:
        """One initial disturbance, where ``dist`` is its model."""
        ...

    def log_prob(self, x: Any, dist: DistributionLike) -> chex.Array:
        """Log density of `draw` at ``x``."""
        ...


class Objective(Protocol):
    """A function of a vector [d] to be minimised; see `jast.cross_entropy`."""

    def __call__(self, x: Any, /) -> Any: ...


class Predict(Protocol):
    """A classifier under test: labels [m] of the inputs [m, ...]; see `jast.weakness.validate`."""

    def __call__(self, inputs: Any, /) -> Any: ...


class Executor(Protocol):
    """What runs units of work elsewhere: an executor of `concurrent.futures`, a client of Dask."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        """Start ``function(*arguments)``; returns a future."""
        ...
