"""Distributions of disturbances; these three modules register what each family can do."""

from jast._src.distributions import distrax_rows, gamma_and_beta, normal_rows  # noqa: F401
