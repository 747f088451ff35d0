"""What is published: one version everywhere, a citation that tools can read, workflows whose
commands exist, and a wheel that works in an empty environment.
"""

import email
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import jast

yaml = pytest.importorskip("yaml", reason="comes with the extra `docs`")

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EMPTY = """
import jax, jax.numpy as jnp, jast
assert jast.__version__ == "{version}" and "{here}" in jast.__file__, jast.__file__
sim = jast.Simulator(
    init=lambda x0: jnp.zeros(()),
    step=lambda level, x: level + x,
    disturbance=lambda level: jast.distributions.Normal(0.0, 1.0),
    evaluate=lambda level: (level >= 6.0, jnp.maximum(6.0 - level, 0.0)),
    horizon=4,
)
report = jast.stress(jax.random.key(0), sim, budget=2000)
assert len(report.failures) and "likeliest" in str(report)
report.html("report.html")
"""


def test_one_version_everywhere():
    newest = re.search(r"^## (\d\S*)", (ROOT / "CHANGELOG.md").read_text(), re.M)[1]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert jast.__version__ == newest == citation["version"]
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "jast.__version__"}


def test_the_citation_has_what_its_format_requires():
    """The required fields of the Citation File Format, version 1.2.0."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0" and citation["type"] in ("software", "dataset")
    for key in ("message", "title"):
        assert citation[key].strip()
    assert citation["license"] == PROJECT["project"]["license"]
    for reference in [citation, *citation["references"]]:
        assert reference["type"]
        assert reference["title"]
        assert reference["authors"]
        for author in reference["authors"]:  # an entity has a name, a person other fields
            assert set(author) <= {"name"} or set(author) <= {"family-names", "given-names"}


def test_workflows_run_commands_that_exist():
    files = sorted((ROOT / ".github/workflows").glob("*.yml"))
    assert files
    for file in files:
        jobs = yaml.safe_load(file.read_text())["jobs"]
        steps = [step for job in jobs.values() for step in job["steps"]]
        assert all(("uses" in step) != ("run" in step) for step in steps), file
        for step in steps:
            for script in re.findall(r"\.ci/\w+", step.get("run", "")):
                assert os.access(ROOT / script, os.X_OK), (file, script)
            for extra in re.findall(r"\.\[(\w+)\]", step.get("run", "")):
                assert extra in PROJECT["project"]["optional-dependencies"], (file, extra)


def test_the_paper_cites_what_it_lists():
    text, listed = (ROOT / "paper.md").read_text(), (ROOT / "paper.bib").read_text()
    cited = set(re.findall(r"@(\w+)", text.split("---", 2)[2]))
    keys = re.findall(r"^@\w+\{(\w+),", listed, re.M)
    assert len(set(keys)) == len(keys) and cited == set(keys)
    for page in re.findall(r"`(docs/[\w/.]+)`", text):
        assert (ROOT / page).exists(), page


def succeeds(*command, cwd, env=None):
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


@pytest.mark.long
def test_the_wheel_works_in_an_empty_environment(tmp_path):
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "XLA_FLAGS")}
    python = tmp_path / "venv/bin/python"
    succeeds(sys.executable, "-m", "venv", "venv", cwd=tmp_path, env=env)
    asked = subprocess.run(
        [python, "-m", "pip", "install", "-q", "build"], capture_output=True, text=True, env=env
    )
    if asked.returncode:
        pytest.skip(f"the package index cannot be reached: {asked.stderr.splitlines()[-1]}")

    source, dist = tmp_path / "source", tmp_path / "dist"
    ignored = shutil.ignore_patterns(".git", ".venv", "*.egg-info", "build", "dist", "__pycache__")
    shutil.copytree(ROOT, source, ignore=ignored)
    succeeds(python, "-m", "build", "-o", dist, source, cwd=tmp_path, env=env)
    [wheel], [archive] = dist.glob("*.whl"), dist.glob("*.tar.gz")
    there = {str(p.relative_to(source)) for p in (source / "jast").rglob("*") if p.is_file()}
    with zipfile.ZipFile(wheel) as file:
        names = {name for name in file.namelist() if ".dist-info/" not in name}
        [about] = [name for name in file.namelist() if name.endswith(".dist-info/METADATA")]
        about = email.message_from_bytes(file.read(about))
    assert names == there  # and nothing else: no tests, no benchmarks
    assert about["Version"] == jast.__version__ and about["License-Expression"] == "MIT"
    assert about.get_payload().startswith("# jast")
    with tarfile.open(archive) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    assert {"LICENSE", "CITATION.cff", "docs/index.md", "tests/test_release.py"} <= names

    succeeds(python, "-m", "pip", "install", "-q", wheel, cwd=tmp_path, env=env)
    code = EMPTY.format(version=jast.__version__, here=tmp_path / "venv")
    succeeds(python, "-c", code, cwd=tmp_path, env=env)
    assert (tmp_path / "report.html").exists()
    assert "probability" in succeeds(
        python, "-m", "jast", "--budget", "5000", "--output", "out", cwd=tmp_path, env=env
    )
