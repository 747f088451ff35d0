"""The types of what is exported: annotated, complete for a type checker, and shipped."""

import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from doors import DOORS, exported, functions

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("door", DOORS)
def test_every_parameter_and_what_comes_back_is_annotated(door):
    for name, function in functions():
        if name.rpartition(".")[0] == door:
            signature = inspect.signature(function)
            bare = [p for p in signature.parameters.values() if p.annotation is p.empty]
            assert not bare, f"{name}: {bare}"
            assert signature.return_annotation is not signature.empty, name


def test_keywords_that_are_passed_on_are_explained():
    for name, function in functions():
        for p in inspect.signature(function).parameters.values():
            if p.kind is p.VAR_KEYWORD:
                assert f"``{p.name}``" in function.__doc__ or f"{p.name}:" in function.__doc__, name


@pytest.mark.slow
def test_a_type_checker_knows_all_that_is_exported():
    """pyright's own count of complete types, of the names at the doors and of their members."""
    pytest.importorskip("pyright", reason="needs the extra `types`")
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable]
    done = subprocess.run(
        [*command, "--verifytypes", "jast", "--ignoreexternal", "--outputjson"],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},  # it does not see editable installs
        capture_output=True,
        text=True,
        timeout=300,
    )
    try:
        symbols = json.loads(done.stdout)["typeCompleteness"]["symbols"]
    except ValueError:
        pytest.skip(f"pyright does not run here: {done.stderr[-300:]}")
    ours = {name for name, _ in exported()}
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
