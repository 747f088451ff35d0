"""The README: its example runs, its commands and names exist."""

import re
from pathlib import Path

import pytest
from checks import python

import jast

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text()
SYSTEMS = (ROOT / "docs/systems.md").read_text()
SPECIFICATIONS = (ROOT / "docs/specifications.md").read_text()


def run(text, folder):
    """What the one Python example of ``text`` prints."""
    [code] = re.findall(r"```python\n(.*?)```", text, re.S)
    (folder / "example.py").write_text(code)
    return python("example.py", cwd=folder)


@pytest.mark.long
def test_the_example_runs_and_finds_a_failure(tmp_path):
    printed = run(TEXT, tmp_path)
    shown = TEXT.split("and prints (")[1]
    for words in ("undisturbed  no failure", "locally likeliest", "likeliest    log p -10.79"):
        assert words in printed and words in shown


@pytest.mark.long
def test_the_example_of_specifications_prints_what_it_says(tmp_path):
    printed = run(SPECIFICATIONS, tmp_path)
    shown = SPECIFICATIONS.split("```")[3]
    words = lambda text: re.findall(r"[a-z]{4,}", text)
    assert words(printed) == words(shown)


def test_names_in_the_tables_exist():
    names = set(re.findall(r"`(jast(?:\.\w+)+)", TEXT + SYSTEMS))
    assert len(names) > 12
    for name in names:
        thing = jast
        for part in name.split(".")[1:]:
            thing = getattr(thing, part, None)
        assert callable(thing) or name in (
            "jast.actions",
            "jast.cross_entropy",
            "jast.estimate",
            "jast.explain",
            "jast.rewards",
            "jast.plot",
            "jast.specs",
        ), name


def test_files_exist():
    for path in re.findall(r"\]\(((?!http)[^)]+)\)", TEXT) + [
        "notebooks/quickstart.ipynb",
        "CITATION.cff",
    ]:
        assert (ROOT / path).exists(), path
    assert (ROOT / "docs/ferry_failure.png").stat().st_size < 150_000


def test_the_test_command_is_the_one_that_is_run():
    command = (
        'python3 -m venv .venv && .venv/bin/pip install -q -e ".[test]" && .venv/bin/python -m'
        " pytest"
    )
    assert command in TEXT.splitlines()
    assert (ROOT / ".ci/run").read_text().splitlines()[-3:] == [
        command,
        '.venv/bin/python -m pytest -m "slow and not long"',
        ".venv/bin/python -m pytest -m long",
    ]


def test_it_is_short():
    assert len(TEXT.splitlines()) < 120
