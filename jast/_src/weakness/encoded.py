"""The networks that the thesis's selector ended with, for pictures of what they have learned."""

from __future__ import annotations

import json
from typing import NamedTuple

import jax
import numpy as np

from jast._src.core.typing import Array, ArrayTree
from jast._src.util import display
from jast._src.weakness import networks
from jast._src.weakness.data import data_of_result
from jast._src.weakness.features import scale_inputs
from jast._src.weakness.result import Result
from jast._src.weakness.thesis_selector import adversary_of, train_encoder
from jast._src.weakness.validation import iteration_key

__all__ = ["Encoded", "encoded"]


@display.printable()
class Encoded(NamedTuple):
    """The autoencoder and the adversary of a result (`encoded`); n inputs, codes of h numbers.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> small = jast.weakness.thesis(iterations=1, sample=50, hidden=(8,), encoder_epochs=1)
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(jax.random.key(0), wrong, inputs, labels, selector=small)
        >>> networks = jast.weakness.encoded(found, inputs, labels)
        >>> networks.decode(networks.codes[:3]).shape
        (3, 8, 8)
    """

    codes: np.ndarray
    """[n, h]: E(x) of each input"""
    scores: np.ndarray
    """[n]: A(E(x)), how suspect the adversary finds each input, in [0, 1]"""
    shape: tuple[int, ...]
    """Of an input"""
    autoencoder: ArrayTree
    """Parameters"""
    adversary: ArrayTree
    """Parameters"""
    hidden: tuple[int, ...]
    """The autoencoder's widths"""

    def score(self, rows: Array) -> Array:
        """A(E(x)) [m] of ``rows`` [m, d] in the scale of the autoencoder, 0 to 1."""
        codes = self._network.encode(self.autoencoder, np.asarray(rows, np.float32))
        return np.asarray(jax.nn.sigmoid(networks.logits(self.adversary, codes)))

    def decode(self, codes: Array) -> Array:
        """What the decoder makes of ``codes`` [m, h]: [m, ...] in the shape of the inputs."""
        rows = self._network.decode(self.autoencoder, np.asarray(codes, np.float32))
        return np.asarray(rows).reshape(-1, *self.shape)

    @property
    def _network(self):
        return networks.autoencoder(int(np.prod(self.shape)), self.hidden)


def encoded(result: Result, inputs: Array, labels: Array, *, classes: int | None = None) -> Encoded:
    """The `Encoded` networks of a result of the thesis's selector.

    A result keeps the codes and the adversary, not the autoencoder, which is trained here once more
    from the result's key, to the same weights.

    Args:
        result: of `validate` with ``selector="thesis"`` or `thesis`.
        inputs, labels, classes: those of the validation.

    Returns:
        `Encoded`.

    Raises:
        ValueError: for a result of another selector, and for inputs or labels that are not its own.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> small = jast.weakness.thesis(iterations=1, sample=50, hidden=(8,), encoder_epochs=1)
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(jax.random.key(0), wrong, inputs, labels, selector=small)
        >>> jast.weakness.encoded(found, inputs, labels).scores.shape
        (200,)
    """
    data = data_of_result("encoded", result, inputs, labels, classes)
    name, settings = json.loads(result.state.selector)
    if name != "thesis":
        raise ValueError(f"encoded: result must be of the selector thesis, received one of {name}")
    first, _ = jax.random.split(iteration_key(result.state.key, 0))
    hidden, params, _ = train_encoder(first, scale_inputs(data), settings)
    memory = result.state.memory
    adversary = adversary_of(memory)
    codes = np.asarray(memory["codes"])
    return Encoded(
        codes=codes,
        scores=np.asarray(jax.nn.sigmoid(networks.logits(adversary, codes))),
        shape=data.inputs.shape[1:],
        autoencoder=params,
        adversary=adversary,
        hidden=hidden,
    )
