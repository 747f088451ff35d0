"""The reference: what is exported says what its arguments are, and shows itself at work."""

import doctest
import inspect
import re
import sys

import jax
import pytest
from doors import DOORS, exported, functions

OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def of_door(pairs, door):
    return [(name, value) for name, value in pairs if name.rpartition(".")[0] == door]


def explained(text):
    """Names of the arguments in the section ``Args:`` of a docstring."""
    section = re.search(r"^Args:\n((?:(?: {4}.*)?\n)+)", text + "\n", re.M)
    lines = re.findall(r"^ {4}([\w*, ]+):", section[1], re.M) if section else []
    return {name.strip(" *") for line in lines for name in line.split(",")}


@pytest.mark.parametrize("door", DOORS)
def test_every_argument_is_explained(door):
    for name, function in of_door(functions(), door):
        left = set(inspect.signature(function).parameters) - explained(inspect.getdoc(function))
        assert not left, f"{name}: {left}"


@pytest.mark.parametrize("door", DOORS)
def test_every_function_and_class_has_an_example(door):
    """Only constants and type aliases have none: they have no docstring of their own."""
    for name, value in of_door(exported(), door):
        assert "\nExample:\n    >>> " in (inspect.getdoc(value) or ""), name


def run(name, value):
    """The example of a name, as in a fresh session with JAX's default precision."""
    said = []
    with jax.enable_x64(False):
        for test in doctest.DocTestFinder(recurse=False).find(value, name, globs={}):
            doctest.DocTestRunner(optionflags=OPTIONS).run(test, out=said.append)
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    assert not said, "".join(said)


@pytest.mark.parametrize("name", ["rollout", "replay", "Policy", "nominal"])
def test_a_quick_example_runs(name):
    run(name, dict(exported())[f"jast.{name}"])


@pytest.mark.long
@pytest.mark.parametrize("door", DOORS)
def test_the_examples_of_a_room_run(door, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    for name, value in of_door(exported(), door):
        run(name, value)
