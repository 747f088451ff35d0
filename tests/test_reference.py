"""The reference: what is exported says what its arguments are, and shows itself at work."""

import doctest
import inspect
import re

import jax
import pytest
from doors import DOORS, exported, functions

READY = ["jast", "jast.search", "jast.estimate", "jast.explain", "jast.failures", "jast.specs"]
READY += ["jast.incidents", "jast.rewards", "jast.actions", "jast.stress_testing", "jast.sweeping"]
READY += ["jast.simulators", "jast.distributions", "jast.policies", "jast.blackbox", "jast.heads"]
READY += ["jast.weakness"]
READY += ["jast.simulators.arch", "jast.cross_entropy", "jast.cross_entropy.schedules"]
"""Rooms whose docstrings are whole."""
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def of_rooms(pairs, rooms):
    return [(name, value) for name, value in pairs if name.rpartition(".")[0] in rooms]


def explained(text):
    """Names of the arguments in the section ``Args:`` of a docstring."""
    section = re.search(r"^Args:\n((?:(?: {4}.*)?\n)+)", text + "\n", re.M)
    lines = re.findall(r"^ {4}([\w*, ]+):", section[1], re.M) if section else []
    return {name.strip(" *") for line in lines for name in line.split(",")}


@pytest.mark.parametrize("room", READY)
def test_every_argument_is_explained(room):
    for name, function in of_rooms(functions(), [room]):
        left = set(inspect.signature(function).parameters) - explained(inspect.getdoc(function))
        assert not left, f"{name}: {left}"


@pytest.mark.parametrize("room", READY)
def test_every_function_has_an_example(room):
    for name, function in of_rooms(functions(), [room]):
        assert "\nExample:\n    >>> " in inspect.getdoc(function), name


def run(name, value):
    """The example of a name, as in a fresh session with JAX's default precision."""
    said = []
    with jax.enable_x64(False):
        for test in doctest.DocTestFinder(recurse=False).find(value, name, globs={}):
            doctest.DocTestRunner(optionflags=OPTIONS).run(test, out=said.append)
    assert not said, "".join(said)


@pytest.mark.parametrize("name", ["rollout", "replay", "Policy", "nominal"])
def test_a_quick_example_runs(name):
    run(name, dict(exported())[f"jast.{name}"])


@pytest.mark.long
@pytest.mark.parametrize("door", DOORS)
def test_the_examples_of_a_room_run(door):
    for name, value in of_rooms(exported(), [door]):
        run(name, value)
