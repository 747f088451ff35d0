"""The types of what is exported: annotated, complete for a type checker, and shipped."""

import importlib
import inspect
import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import jast

ROOT = Path(__file__).parents[1]
DOORS = [
    m.name
    for m in pkgutil.walk_packages(jast.__path__, "jast.")
    if not m.name.endswith("__main__")
    and (m.name.removeprefix("jast.") in jast.__all__ or m.name in ("jast.sweeping",))
]
DOORS += ["jast", "jast.cross_entropy.schedules", "jast.simulators.arch", "jast.stress_testing"]


def exported():
    """(room.name, object) of every function and class of jast at a door."""
    for door in DOORS:
        room = importlib.import_module(door)
        for name in room.__all__:
            value = getattr(room, name)
            ours = getattr(value, "__module__", "").startswith("jast")
            if ours and (inspect.isfunction(value) or inspect.isclass(value)):
                yield f"{door}.{name}", value


FUNCTIONS = [(name, f) for name, f in exported() if inspect.isfunction(f)]


@pytest.mark.parametrize("door", DOORS)
def test_every_parameter_and_what_comes_back_is_annotated(door):
    for name, function in FUNCTIONS:
        if name.rpartition(".")[0] == door:
            signature = inspect.signature(function)
            bare = [p for p in signature.parameters.values() if p.annotation is p.empty]
            assert not bare, f"{name}: {bare}"
            assert signature.return_annotation is not signature.empty, name


def test_keywords_that_are_passed_on_are_explained():
    for name, function in FUNCTIONS:
        for p in inspect.signature(function).parameters.values():
            if p.kind is p.VAR_KEYWORD:
                assert f"``{p.name}``" in function.__doc__ or f"{p.name}:" in function.__doc__, name


def test_a_type_checker_knows_all_that_is_exported():
    """pyright's own count of complete types, of the names at the doors and of their members."""
    pytest.importorskip("pyright", reason="needs the extra `types`")
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable]
    done = subprocess.run(
        [*command, "--verifytypes", "jast", "--ignoreexternal", "--outputjson"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    try:
        symbols = json.loads(done.stdout)["typeCompleteness"]["symbols"]
    except ValueError:
        pytest.skip(f"pyright does not run here: {done.stderr[-300:]}")
    ours = {f"{value.__module__}.{value.__qualname__}" for _, value in exported()}
    seen = {s["name"] for s in symbols}
    assert ours <= seen, ours - seen
    unknown = [
        s["name"] + "".join("\n  " + d["message"] for d in s["diagnostics"])
        for s in symbols
        if not s["isTypeKnown"]
        and any(s["name"] == name or s["name"].startswith(name + ".") for name in ours)
    ]
    assert not unknown, "\n".join(unknown)


def test_the_marker_of_types_is_shipped():
    assert (ROOT / "jast/py.typed").exists()
    assert '"jast" = ["py.typed"]' in (ROOT / "pyproject.toml").read_text()
