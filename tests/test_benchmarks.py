"""Every benchmark runs and reports numbers: at its smallest size in the suite, and the shorter ones
as their users run them with the long tests.
"""

import importlib
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from systems import mark_long

ROOT = Path(__file__).parents[1]
SMALLEST = {  # beside each other what shares compiled programs
    "ferry": ["--smoke"],
    "few_calls": ["--smoke"],
    "first_minute": ["--smoke"],
    "table1": ["--table1", "--smoke"],
    "engine": ["--smoke"],
    "arch": ["--smoke"],
    "blackbox": ["--smoke"],
    "bridge": ["--smoke"],
    "closed_loops": ["--smoke"],
    "colav": ["--smoke"],
    "cross_entropy": ["--smoke"],
    "doors": ["--smoke"],
    "explain": ["--smoke"],
    "failure_samples": ["--smoke"],
    "fms": ["--smoke"],
    "fms_readings": ["--smoke"],
    "indices": ["--smoke"],
    "limit_states": ["--smoke"],
    "memory": ["--smoke"],
    "nasa": ["--smoke"],
    "peers": ["--smoke"],
    "populations": ["--smoke"],
    "probability": ["--smoke"],
    "random_loops": ["--smoke"],
    "rates": ["--smoke"],
    "reference": ["--trees", "1"],
    "reliability": ["--smoke"],
    "scale": ["--smoke"],
    "search_settings": ["--smoke"],
    "splitting": ["--smoke"],
    "stress": ["--smoke"],
    "sweep": ["--smoke"],
    "table1_seeds": ["--smoke"],
    "time_to_answer": ["--smoke"],
    "weakness": ["--smoke"],
}
QUICK = {  # those whose quick mode takes less than half a minute
    "arch": ["--quick"],
    "blackbox": ["--quick"],
    "cross_entropy": ["--quick", "--seeds", "4"],
    "engine": ["--quick"],
    "explain": "--quick --seeds 1 --parts rules ferry".split(),
    "ferry": ["--quick", "--trees", "10"],
    "fms_readings": ["--quick", "--seeds", "1"],
    "limit_states": ["--seeds", "1"],
    "memory": ["--quick"],
    "table1_seeds": ["--trees", "2", "--seeds", "2", "--rows", "both, text"],
    "weakness": ["--quick", "--seeds", "1"],
}
# of the extra `benchmark`, which the tests do not install
NEEDS_SMALLEST = {"reliability": ["openturns"]}
NEEDS_QUICK = {"cross_entropy": ["cma"], "engine": ["mctx"]}


def module(name):
    return "benchmarks.ferry" if name == "table1" else f"benchmarks.{name}"


def skip_without(packages):
    for package in packages:
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")


def numbers(report):
    if isinstance(report, dict):
        report = list(report.values())
    if isinstance(report, list):
        return [number for part in report for number in numbers(part)]
    return [report] if isinstance(report, int | float) else []


def check(printed):
    assert len(numbers(json.loads(printed))) > 5


def test_no_benchmark_is_left_out():
    programs = {
        path.stem
        for path in (ROOT / "benchmarks").glob("*.py")
        if "\ndef main(" in path.read_text()
    }
    assert programs | {"table1"} == SMALLEST.keys()


SLOW = (
    "arch",
    "blackbox",
    "bridge",
    "colav",
    "cross_entropy",
    "engine",
    "ferry",
    "fms",
    "memory",
    "nasa",
    "probability",
    "random_loops",
    "stress",
    "sweep",
    "table1",
    "table1_seeds",
    "weakness",
)


@pytest.fixture
def as_users_have_it():
    """JAX's own precision and promotion, which a benchmark may also change for itself."""
    kept = {name: getattr(jax.config, name) for name in SETTINGS}
    for name, value in SETTINGS.items():
        jax.config.update(name, value)
    yield
    for name, value in kept.items():
        jax.config.update(name, value)


SETTINGS = {
    "jax_enable_x64": False,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(SMALLEST, *SLOW))
def test_a_benchmark_runs(name, as_users_have_it, monkeypatch, capsys):
    skip_without(NEEDS_SMALLEST.get(name, []))
    monkeypatch.syspath_prepend(str(ROOT))
    importlib.import_module(module(name)).main([*SMALLEST[name], "--json"])
    check(capsys.readouterr().out)


@pytest.mark.long
@pytest.mark.parametrize("name", QUICK)
def test_a_benchmark_reports(name):
    skip_without(NEEDS_QUICK.get(name, []))
    done = subprocess.run(
        [sys.executable, "-m", module(name), "--json", *QUICK[name]],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    check(done.stdout)


def test_a_measurement_in_a_process_of_its_own_is_the_same(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    sizes = importlib.import_module("benchmarks.sizes")
    fresh, same = (
        f("interval", 3, 10, module="reference")
        for f in (sizes.in_fresh_process, sizes.in_this_process)
    )
    assert tuple(fresh) == same
