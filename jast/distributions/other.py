"""distrax, loaded at the first use of one of its names: its distributions take jast's as parts."""

import warnings

from jast.distributions.base import Distribution

# tensorflow-probability, below distrax, touches deprecated names of jax
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import distrax

    distrax.Normal(0.0, 1.0).name  # noqa: B018  (they are touched lazily, so touch them here)

distrax.Distribution.register(Distribution)

__all__ = ["distrax"]
