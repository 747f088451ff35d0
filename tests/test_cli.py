"""The command line: its report, its files, its refusals and its exit status, with counts as small
as they go.
"""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import jast
from jast import __main__ as cli

ROOT = Path(__file__).parents[1]
HELD = jast.simulators.walk1d()
SMALL = ["--trees", "2", "--simulations", "30", "--quiet"]


@pytest.fixture(autouse=True)
def cached(monkeypatch):
    """The calls of `jast.cache`, which would change JAX's options for other tests."""
    calls = []
    monkeypatch.setattr(cli, "cache", lambda: calls.append("cache"))
    return calls


@pytest.mark.slow
def test_a_report_is_saved_before_it_is_printed(tmp_path, monkeypatch):
    def closed(*args, **kwargs):
        raise BrokenPipeError

    monkeypatch.setattr(cli, "print", closed, raising=False)
    with pytest.raises(BrokenPipeError):
        cli.main(["--budget", "300", "--quiet", "--output", str(tmp_path)])
    assert jast.load(tmp_path / "report.npz", jast.simulators.ferry()).tried


@pytest.mark.slow
def test_compiled_programs_are_kept_unless_told_otherwise(capsys, tmp_path, cached):
    run(capsys, tmp_path, "--method", "monte-carlo", "--no-cache")
    assert cached == []
    run(capsys, tmp_path, "--method", "monte-carlo")
    assert cached == ["cache"]


@pytest.mark.slow
def test_a_call_goes_on_where_no_program_can_be_kept(capsys, tmp_path, monkeypatch):
    def full():
        raise ValueError("cache: folder must be one that can be made")

    monkeypatch.setattr(cli, "cache", full)
    assert cli.main(["--method", "monte-carlo", *SMALL, "--output", str(tmp_path)]) == 0
    assert "can be made; compiled programs are not kept" in capsys.readouterr().err


def run(capsys, tmp_path, *argv):
    """Exit status, standard output and the folder of results."""
    status = cli.main([*argv, *SMALL, "--output", str(tmp_path / "out")])
    return status, capsys.readouterr().out, tmp_path / "out"


@pytest.mark.slow
@pytest.mark.parametrize("method", ["forest", "mcts", "cem", "monte-carlo"])
def test_every_method_reports_and_saves(capsys, tmp_path, method):
    status, text, out = run(
        capsys, tmp_path, "--method", method, *(["--prunes", "3"] if method == "forest" else [])
    )
    assert status == 0
    assert "best episode" in text
    [row] = [line for line in text.splitlines() if line.startswith(method)]
    assert int(row.split()[1]) == (2 * 3 * 30 if method == "forest" else 2 * 30)
    held, settings = jast.failures.load(out / "failures.npz", jast.simulators.ferry())
    assert held.size == 0
    assert settings["simulator"] == "ferry"
    assert settings["method"] == method.replace("-", "_")
    pytest.importorskip("matplotlib")
    assert all(
        (out / name).read_bytes().startswith(b"\x89PNG") for name in ("episode.png", "history.png")
    )


OWN = """
import jax.numpy as jnp
import jast

def walk():
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + x,
        disturbance=lambda s: jast.distributions.Normal(0.0, 1.0),
        evaluate=lambda s: (s >= 4, jnp.maximum(4 - s, 0.0)),
        horizon=2,
    )
"""


@pytest.mark.slow
def test_stress_of_a_system_of_ones_own(capsys, tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    command = [f"{tmp_path / 'own.py'}:walk", "--budget", "600", "--quiet"]
    assert cli.main([*command, "--output", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert "undisturbed" in text
    assert "likeliest failure: " in text
    assert "next: " in text
    page = (tmp_path / "out/report.html").read_text()
    assert "The likeliest failure takes" in page and f"saved {tmp_path / 'out/report.html'}" in text
    report = jast.load(tmp_path / "out/report.npz")
    assert float(report.failures.best.reward) == pytest.approx(-4, abs=0.15)
    for place, words in (
        (f"{tmp_path / 'own.py'}:run", "no jast.Simulator"),
        ("a.py:b", "no file"),
    ):
        with pytest.raises(SystemExit):
            cli.main([place, "--output", str(tmp_path / "out")])
        assert words in capsys.readouterr().err


def stopped_stress(monkeypatch, tmp_path, *argv):
    """What a command line hands to `jast.stress`: (simulator, budget, settings)."""
    given = []

    def stress(key, sim, budget, **settings):
        given.append((sim, budget, settings))
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "stress", stress)
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert cli.main([*argv, "--quiet", "--output", str(tmp_path / "out")]) == 130
    return given[0]


def test_a_file_finds_its_neighbour_and_so_do_the_workers_of_its_black_box(monkeypatch, tmp_path):
    (tmp_path / "neighbour_of_it.py").write_text("def limit():\n    return 2.0\n")
    (tmp_path / "file_with_one.py").write_text(
        "import jast\nfrom neighbour_of_it import limit\n\n"
        "def run(x):\n    import neighbour_of_it as other\n    near = other.limit() - float(x[0])\n"
        "    return near <= 0, max(near, 0.0)\n\n"
        "sim = jast.blackbox.from_python(\n    run, horizon=1, workers=1,"
        " disturbance=jast.distributions.Normal(0.0, limit()),\n)\n"
    )
    sim, *_ = stopped_stress(monkeypatch, tmp_path, f"{tmp_path / 'file_with_one.py'}:sim")
    assert float(jast.replay(sim, jax.numpy.array([0.5])).distance) == 1.5


def test_options_go_to_stress_as_they_are(monkeypatch, tmp_path):
    options = ["--seconds", "2.5", "--checkpoint", str(tmp_path / "kept")]
    _, budget, settings = stopped_stress(monkeypatch, tmp_path, *options)
    assert budget is None
    assert settings == dict(seconds=2.5, checkpoint=tmp_path / "kept", progress=False)


@pytest.mark.long
def test_stress_is_what_is_run_where_nothing_is_said(capsys, tmp_path):
    assert cli.main(["--budget", "20000", "--quiet", "--output", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert "undisturbed" in text
    assert "probability" in text
    assert (tmp_path / "out/report.npz").exists()
    assert ">adversary<" in (tmp_path / "out/report.html").read_text()


@pytest.mark.long
@pytest.mark.parametrize(
    "simulator",
    [
        pytest.param(name, marks=pytest.mark.long if name == "colav" else ())
        for name in cli.SYSTEMS
        if name != "ferry"
    ],
)
def test_every_simulator(capsys, tmp_path, simulator):
    status, text, out = run(capsys, tmp_path, "--simulator", simulator, "--prunes", "2", "--paper")
    assert status == 0 and text.startswith(f"{simulator}, seed 0")
    assert ("\n  x0: " in text) == (simulator == "landing")
    make, reward, chosen = cli.SYSTEMS[simulator]
    jast.check(make(), chosen)
    held, settings = jast.failures.load(out / "failures.npz", make())
    assert settings["mode"] == "paper" and settings["widening"] == [0.5, 0.6]
    if held.size:
        assert "likeliest failure: " in text and f"{held.best.reward:.4f}" in text
        assert jast.replay(make(), held.best, reward=reward).reward == held.best.reward


@pytest.mark.long
def test_heads_of_a_forest(capsys, tmp_path):
    status, text, out = run(capsys, tmp_path, "--prunes", "2", "--heads", "both")
    assert status == 0 and "best episode" in text
    settings = jast.failures.load(out / "failures.npz", jast.simulators.ferry())[1]
    assert settings["heads"] == "both" and settings["head_settings"]["round"] == 1


@pytest.mark.long
def test_a_seed_gives_the_same_report(capsys, tmp_path):
    one, two, other = (
        run(capsys, tmp_path, "--simulator", "walk1d", "--prunes", "2", "--seed", seed)[1]
        for seed in "330"
    )
    assert one == two != other


@pytest.mark.long
def test_without_matplotlib_it_goes_on(capsys, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    status, text, out = run(capsys, tmp_path, "--simulator", "walk1d", "--prunes", "2")
    assert status == 0 and "pip install 'jast[plot]'" in text
    assert [path.name for path in out.iterdir()] == ["failures.npz"]


def test_help(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["--help"])
    text = capsys.readouterr().out
    assert end.value.code == 0
    assert all(
        option in text for option in ("--simulator", "--method", "--paper", "--quiet", "ferry-b")
    )


@pytest.mark.parametrize(
    "argv, words",
    [
        (["--simulator", "boat"], "argument --simulator: invalid choice: 'boat'"),
        (["--method", "luck"], "argument --method: invalid choice: 'luck'"),
        (["--trees", "0"], "argument --trees: must be a whole number of at least 1, received '0'"),
        (
            ["--simulations", "-3"],
            "argument --simulations: must be a whole number of at least 1, received '-3'",
        ),
        (
            ["--prunes", "1.5"],
            "argument --prunes: must be a whole number of at least 1, received '1.5'",
        ),
        (["--seed", "x"], "argument --seed: must be a whole number of 32 bits, received 'x'"),
        (["--seed", str(2**70)], "argument --seed: must be a whole number of 32 bits"),
        (["--simulator", "ferry", "mine.py:sim"], "argument --simulator: of the built-in ones"),
        (["sim"], "argument FILE.py:NAME: name the simulator, too, as in sim:sim"),
        ([f"{__file__}:run"], "argument FILE.py:NAME: run must need no arguments"),
        ([f"{__file__}:rum"], f"{__file__} has no jast.Simulator rum; it has HELD"),
        (["--method", "cem", "--seconds", "3"], "argument --seconds: only of --method stress"),
        (["--seconds", "0"], "stress: seconds must be a number above 0, received 0.0"),
        (
            ["--method", "mcts", "--prunes", "3"],
            "argument --prunes: only of --method forest, not of mcts",
        ),
        (
            ["--method", "mcts", "--heads", "both"],
            "argument --heads: only of --method forest, not of mcts",
        ),
        (
            ["--method", "cem", "--paper"],
            "argument --paper: only of --method forest or mcts, not of cem",
        ),
        (["--output", __file__], "argument --output: "),
        (
            ["--trees", "1", "--simulations", "2000000000"],
            "prunes * simulations must be below 2**24",
        ),
    ],
)
def test_bad_arguments(capsys, tmp_path, monkeypatch, argv, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        cli.main(argv)
    assert end.value.code == 2 and words in capsys.readouterr().err
    assert "FILE.py" not in words or not list(tmp_path.iterdir())


def test_interrupted_at_once(capsys, tmp_path, monkeypatch):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "forest", stop)
    assert cli.main([*SMALL, "--output", str(tmp_path)]) == 130
    assert "interrupted before there was a result" in capsys.readouterr().err


@pytest.mark.slow
def test_interrupted_search_reports_what_was_done(capsys, tmp_path, monkeypatch):
    whole = cli.forest

    def stopped(*args, **kwargs):
        def callback(done, total, _):
            raise KeyboardInterrupt

        return whole(*args, callback=callback, threads=1, lanes=1, **kwargs)

    monkeypatch.setattr(cli, "forest", stopped)
    status = cli.main(
        [
            "--simulator",
            "walk1d",
            "--trees",
            "40",
            "--simulations",
            "200",
            "--quiet",
            "--output",
            str(tmp_path),
        ]
    )
    text = capsys.readouterr().out
    assert status == 130
    assert (
        0
        < int(next(line for line in text.splitlines() if line.startswith("forest")).split()[1])
        < 40 * 18 * 200
    )


@pytest.mark.long
def test_as_a_program(tmp_path):
    command = [
        sys.executable,
        "-m",
        "jast",
        "--simulator",
        "walk1d",
        "--trees",
        "2",
        "--prunes",
        "2",
        "--simulations",
        "20",
    ]
    cache = {
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir or "",
        "PYTHONPATH": str(ROOT),
    }
    done = subprocess.run(
        command, cwd=tmp_path, env=os.environ | cache, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert "saved jast-output" in done.stdout and "forest: 100%" in done.stderr
    assert (tmp_path / "jast-output" / "failures.npz").exists()
    wrong = subprocess.run(
        [*command, "--trees", "none"],
        cwd=tmp_path,
        env=os.environ | cache,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert wrong.returncode == 2
    assert wrong.stderr.splitlines()[-1].startswith("python -m jast: error: argument --trees")
