"""distrax, loaded at the first use of one of its names."""

import warnings

# tensorflow-probability, below distrax, touches deprecated names of jax
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import distrax

    distrax.Normal(0.0, 1.0).name  # noqa: B018  (they are touched lazily, so touch them here)

__all__ = ["distrax"]
