"""Floats that are too coarse for a state are told, those that are fine enough are not."""

import dataclasses
import warnings

import jax.numpy as jnp
import pytest

import jast
from jast import distributions as D
from jast._src.core.float_resolution import rounding_problem
from jast.estimate import failure_probability


def walk(offset, idle=0.0):
    """Forty steps of deviation 5 from ``offset``, beside a number that starts at ``idle``, moves
    likewise and decides nothing; one program serves all.
    """
    return _walk(jnp.asarray(offset, float), jnp.asarray(idle, float))


def _walk(offset, idle):
    gap = lambda s: jnp.maximum(100 - jnp.abs(s[0] - offset), 0)
    return jast.Simulator(
        init=lambda x0: jnp.stack([offset, idle]),
        step=lambda s, x: s + x,
        disturbance=lambda s: D.Normal(jnp.zeros((), s.dtype), jnp.asarray(5, s.dtype)),
        evaluate=lambda s: (gap(s) <= 0, gap(s)),
        horizon=40,
    )


@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_floats_that_are_fine_enough_are_not_mentioned(offset):
    assert rounding_problem(walk(offset)) is None


def test_an_offset_is_too_coarse():
    """4.6e6 in float32 has units of a half."""
    assert "state is too coarse: a disturbance changes one" in rounding_problem(walk(4.6e6))


def test_a_disturbance_that_is_mostly_rounded_away():
    """Units of 1 at 1e7: of steps of deviation .3 a tenth move it, none in the median."""
    sim = dataclasses.replace(
        walk(1e7),
        disturbance=lambda s: D.Normal(jnp.float32(0.0), jnp.float32(0.3)),
        evaluate=lambda s: (s[0] >= 1e7 + 3, jnp.maximum(1e7 + 3 - s[0], 0)),
        horizon=10,
    )
    assert "state is too coarse: a disturbance changes one" in rounding_problem(sim)


def test_what_decides_nothing_may_be_coarse():
    assert rounding_problem(walk(0.0, 4.6e6)) is None


def test_float64_is_fine(x64):
    assert rounding_problem(walk(4.6e6)) is None


@pytest.mark.slow
def test_check_and_the_estimate_say_so(key):
    with pytest.warns(UserWarning, match="check: step: the state is too coarse"):
        jast.check(walk(4.6e6))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jast.check(walk(0.0))
    found = failure_probability(key, walk(4.6e6), 5000)
    assert not found.reliable and found.warnings[0].startswith("the state is too coarse")


def test_a_random_start_and_an_episodic_system():
    sim = dataclasses.replace(
        walk(4.6e6),
        start=lambda: D.Normal(jnp.float32(4.6e6), jnp.float32(1.0)),
        init=lambda x0: jnp.stack([x0, x0]),
        episodic=True,
    )
    assert "state is too coarse" in rounding_problem(sim)
