"""Which numbers of an input make it fail: contributions to the log odds of failure, by networks
that imitate the system.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.typing import Array, PRNGKey
from jast._src.util.checks import check_random_key, wrong
from jast._src.weakness import committee
from jast._src.weakness.data import are_indices, data_of_result
from jast._src.weakness.default_selector import PASSES, STRENGTH
from jast._src.weakness.features import centre, scale_inputs
from jast._src.weakness.result import Result

__all__ = ["influence"]

MEMBERS = 5  # of the committee that imitates; a convention
EFFORT = 4  # times the passes of the selector's committee: there is one fit, not one a batch


def influence(
    key: PRNGKey,
    result: Result,
    inputs: Array,
    labels: Array,
    *,
    at: Array | Sequence[int] | None = None,
    classes: int | None = None,
) -> np.ndarray:
    """What each number of an input contributes to the log odds that the system gets it wrong.

    It is the gradient of these log odds times the input's difference from the mean input, by five
    networks that have learned the system's answers where ``result`` has them, and the labels
    elsewhere, whatever selector found them. A first-order picture of an imitation, not of the
    system itself.

    Args:
        key: consumed.
        result: of `validate`.
        inputs, labels, classes: those of the validation.
        at: which inputs, k of them. Default: the failures found.

    Returns:
        [k, ...], in the shape of the inputs; above 0: towards failure.

    Raises:
        ValueError: for other inputs or labels than the result's, and indices out of range.

    Example:
        >>> import jax, jast
        >>> key, (inputs, labels) = jax.random.key(0), (a[:100] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(key, wrong, inputs, labels, selector="random")
        >>> jast.weakness.influence(key, found, inputs, labels, at=[0, 1]).shape
        (2, 8, 8)
    """
    check_random_key("influence", key)
    data = data_of_result("influence", result, inputs, labels, classes)
    at = np.asarray(result.failures if at is None else at)
    if at.ndim != 1 or not are_indices(at, data.size):
        raise wrong("influence", "at", f"be indices [k] in 0 ... {data.size - 1}", f"{at!r}")
    at = at.astype(int)
    tried = result.predicted >= 0
    answers = np.where(tried, result.predicted, data.labels)
    weights = np.tile(np.where(tried, STRENGTH, 1), (MEMBERS, 1))
    rng = numpy_generator(key)
    x = centre(scale_inputs(data), data.image)
    passes = EFFORT * PASSES[data.image]
    imitation = committee.fit(rng, x, answers, weights, data.classes, passes)
    slope = np.asarray(committee.failure_gradient(imitation, x[at], data.labels[at]))
    return (slope * (x[at] - x.mean(0))).reshape(-1, *data.inputs.shape[1:])
