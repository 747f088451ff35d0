"""The documentation: it builds without a warning, and what it shows runs."""

import ast
import functools
import importlib
import inspect
import operator
import re
import zlib
from pathlib import Path
from types import ModuleType

import pytest
from checks import python
from doors import DOORS

import jast
from benchmarks.doors import EXAMPLES

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "docs/start.md", *sorted((ROOT / "docs/guides").glob("*.md"))]
SYSTEMS = ROOT / "docs/guides/environments.md"  # its examples stand alone, and need other libraries
PAGES.remove(SYSTEMS)
ROOMS = [name for name in jast.__all__ if isinstance(getattr(jast, name), ModuleType)]


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_code_of_a_page_runs(page, tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.S)
    assert blocks
    (tmp_path / "page.py").write_text("\n".join(blocks))
    assert python("page.py", cwd=tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_of_a_system_runs_as_printed(name, tmp_path):
    for line in EXAMPLES[name].splitlines():
        if words := re.match(r"(?:import|from) (\w+)", line):
            pytest.importorskip(words[1], reason="needs the extra `systems`")
    (tmp_path / "example.py").write_text(EXAMPLES[name])
    assert python("example.py", cwd=tmp_path)


@pytest.mark.long
def test_it_builds_without_a_warning(tmp_path):
    pytest.importorskip("myst_nb", reason="needs the extra `docs`")
    python("-m", "sphinx", "-q", "-W", "--keep-going", "-c", "docs", ".", str(tmp_path), cwd=ROOT)
    assert (tmp_path / "docs/index.html").exists()
    listed = zlib.decompress((tmp_path / "objects.inv").read_bytes().split(b"\n", 4)[4]).decode()
    pages = {line.split()[0]: line.split()[3] for line in listed.splitlines()}
    for door in DOORS:
        room = importlib.import_module(door)
        for name in room.__all__:
            value = getattr(room, name)
            ours = getattr(value, "__module__", None) or "jast"  # a constant has none
            if not inspect.ismodule(value) and ours.startswith("jast"):
                ways = (f"{door}.{name}", f"jast.{name}")  # `jast.stress`, `jast.sweep`
                assert any(pages.get(way, "").startswith("docs/api/") for way in ways), ways


FEWER = {
    "trees=2000": "trees=2, prunes=1, simulations=50",
    "10_000_000": "1000",
    "Executor(4": "Executor(1",
}


def scale():
    """The code of docs/scale.md: that of one machine, and that of a cluster."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/scale.md").read_text(), re.S)
    here = [block for block in blocks if "dask" not in block]
    there = [block for block in blocks if "dask" in block]
    assert len(here) == 3
    assert there
    return here, there


@pytest.mark.long
def test_the_code_for_long_work_on_one_machine_runs(tmp_path):
    """As on the page, with fewer episodes, trees and processes."""
    start = "import jax, jast\nkey, sim = jax.random.key(0), jast.simulators.walk1d()\n"
    for i, block in enumerate(scale()[0]):
        less = functools.reduce(lambda text, few: text.replace(*few), FEWER.items(), block)
        assert less != block
        (tmp_path / f"page{i}.py").write_text(start + less)
        python(f"page{i}.py", cwd=tmp_path)
    assert (tmp_path / "run.jast").is_dir()


def test_code_that_needs_a_cluster_names_what_exists():
    """It is not run: it is Python, and its calls and their settings exist."""
    for block in scale()[1]:
        names_what_exists(block)


def names_what_exists(code):
    """Every function of jast that is called takes these arguments."""
    for call in (n for n in ast.walk(ast.parse(code)) if isinstance(n, ast.Call)):
        name = ast.unparse(call.func)
        if re.fullmatch(r"jast[\w.]+", name):
            function = operator.attrgetter(name.removeprefix("jast."))(jast)
            settings = {k.arg: None for k in call.keywords}
            signature, cut = inspect.signature(function), "(..." in ast.unparse(call)
            (signature.bind_partial if cut else signature.bind)(*call.args, **settings)


def test_the_calls_of_the_tables_exist():
    """Of docs/choose.md and of the guides: functions by their names, calls with their arguments."""
    for page in (ROOT / "docs/choose.md", *PAGES):
        text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
        for code in re.findall(r"`(jast\.[^`]+)`", text):
            if code.endswith(")"):
                names_what_exists(code)
            elif re.fullmatch(r"[\w.]+", code) and not code.endswith("."):
                operator.attrgetter(code.removeprefix("jast."))(jast)


def test_every_room_has_a_page():
    pages = {path.stem for path in (ROOT / "docs/api").glob("*.md")}
    assert set(ROOMS) <= pages
    listed = (ROOT / "docs/index.md").read_text()
    assert all(f"api/{page}" in listed for page in pages)


def test_every_name_at_the_top_has_its_documentation():
    text = (ROOT / "docs/api/jast.md").read_text()
    for name in set(jast.__all__) - set(ROOMS):
        assert name in text, name


def test_links_lead_somewhere():
    for page in [*(ROOT / "docs").rglob("*.md"), ROOT / "CONTRIBUTING.md"]:
        for link in re.findall(r"\]\(((?!http|#)[^)#]+)", page.read_text()):
            assert (page.parent / link).exists(), (page, link)


def test_the_front_page_moves_and_every_lesson_has_a_picture():
    image = pytest.importorskip("PIL.Image", reason="comes with matplotlib")
    film = ROOT / "docs/failure.gif"
    assert film.stat().st_size < 500_000
    with image.open(film) as frames:
        assert frames.n_frames > 20
    gallery = (ROOT / "docs/lessons.md").read_text()
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        assert gallery.count(f"../notebooks/{notebook.name}") == 2, notebook.stem
        assert f"thumbnails/{notebook.stem}.png" in gallery


@pytest.mark.long
def test_the_film_is_made_by_its_script(tmp_path):
    """As many frames as the committed one, of the same size."""
    image = pytest.importorskip("PIL.Image", reason="comes with matplotlib")
    python("docs/film.py", str(tmp_path / "failure.gif"), cwd=ROOT)
    with image.open(tmp_path / "failure.gif") as new, image.open(ROOT / "docs/failure.gif") as old:
        assert new.n_frames == old.n_frames and new.size == old.size


def test_the_list_of_figures_has_every_page_and_its_commands():
    pages = {path.stem: path.read_text() for path in (ROOT / "docs/figures").glob("*.md")}
    rows = re.findall(
        r"\| \[.+?\]\(figures/(\w+)\.md\)(.*)", (ROOT / "docs/figures.md").read_text()
    )
    assert sorted(pages) == sorted(name for name, _ in rows)
    for name, row in rows:
        commands = re.findall(r"`(python -m benchmarks\.\w+)`", row)
        assert commands
        for command in commands:
            assert command in pages[name], (name, command)
            assert (ROOT / (command.split()[-1].replace(".", "/") + ".py")).exists(), command
