"""Environments of other libraries in JAX as simulators."""
