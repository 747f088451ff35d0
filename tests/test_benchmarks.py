"""Every benchmark runs and reports numbers, at its smallest sizes."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SHORT = {  # of the suite: seconds each
    "peers": "--seeds 1 --cases branin --peers random_search differential_evolution".split(),
    "reference": ["--trees", "1"],
    "reliability": "--seeds 1 --budget 2000 --cases parallel --methods subset form_16".split(),
}
LONG = {
    "blackbox": ["--quick"],
    "bridge": ["--quick"],
    "colav": ["--quick"],
    "cross_entropy": ["--quick", "--seeds", "4"],
    "engine": ["--quick"],
    "ferry": ["--quick", "--trees", "10"],
    "fms": ["--quick", "--seeds", "1"],
    "limit_states": ["--seeds", "1"],
    "probability": ["--quick", "--seeds", "1"],
    "table1": "--table1 --quick --trees 10 --seeds 1".split(),
    "weakness": ["--quick", "--seeds", "1"],
}
NEEDS = {  # of the extra `benchmark`, which the tests do not install
    "cross_entropy": ["cma"],
    "engine": ["mctx"],
    "reliability": ["openturns"],
}


def test_no_benchmark_is_left_out():
    programs = {
        path.stem for path in (ROOT / "benchmarks").glob("*.py") if "argparse" in path.read_text()
    }
    assert programs | {"table1"} == SHORT.keys() | LONG.keys()


@pytest.mark.parametrize("name", [*SHORT, *(pytest.param(n, marks=pytest.mark.long) for n in LONG)])
def test_a_benchmark_reports(name, tmp_path):
    for package in NEEDS.get(name, []):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    module = "ferry" if name == "table1" else name
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{module}", "--json", *(SHORT | LONG)[name]],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    assert len(numbers(json.loads(done.stdout[done.stdout.index("{") :]))) > 5


def numbers(report):
    if isinstance(report, dict):
        report = list(report.values())
    if isinstance(report, list):
        return [number for part in report for number in numbers(part)]
    return [report] if isinstance(report, int | float) else []
