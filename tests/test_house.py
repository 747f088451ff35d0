"""The house keeps its shape: arrows run one way, names keep their rooms, files stay readable."""

import ast
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import jast

ROOT = Path(__file__).parents[1]
MODULES = {
    m.name: Path(m.module_finder.path, *m.name.split(".")[-1:])
    for m in pkgutil.walk_packages(jast.__path__, "jast.")
    if not m.name.endswith("__main__")
}
# who may not import whom: (room, what it never imports)
WALLS = [
    ("jast.simulators", ("jast.search", "jast.estimate", "jast.policies", "jast.cross_entropy")),
    ("jast.search", ("jast.estimate", "jast.policies", "jast.weakness")),
    ("jast.cross_entropy", ("jast.search", "jast.estimate", "jast.policies")),
    ("jast.distributions", ("jast.episode", "jast.search", "jast.estimate", "jast.heads")),
    ("jast.specs", ("jast.search", "jast.estimate", "jast.explain", "jast.simulators")),
    ("jast.episode", ("jast.search", "jast.estimate", "jast.heads", "jast.simulators")),
]


def source(name):
    path = MODULES[name]
    return path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"


def imports(name, top=True):
    """(module, name) of what a module imports from jast; ``top``: at its own import only."""
    tree = ast.parse(source(name).read_text())
    for node in tree.body if top else ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jast":
            for alias in node.names:
                yield node.module, alias.name
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "jast":
                    yield alias.name, None


def targets(name, top=True):
    """The modules that a module imports; ``top``: at its own import only."""
    for module, attribute in imports(name, top):
        whole = f"{module}.{attribute}"
        yield whole if whole in MODULES else module


def test_no_two_modules_import_one_another():
    graph = {
        name: {t for t in targets(name, top=False) if t in MODULES and t != name}
        for name in MODULES
    }
    for package in [n for n in graph if source(n).name == "__init__.py"]:
        graph[package] = set()  # a door imports its rooms; what matters is what the rooms import
    done, under_way = set(), []

    def visit(name):
        assert name not in under_way, " -> ".join([*under_way[under_way.index(name) :], name])
        if name not in done:
            under_way.append(name)
            for other in sorted(graph[name]):
                visit(other)
            done.add(under_way.pop())

    for name in sorted(graph):
        visit(name)


@pytest.mark.parametrize("room, walled", WALLS, ids=[room for room, _ in WALLS])
def test_arrows_run_downwards(room, walled):
    for name in MODULES:
        if name == room or name.startswith(room + "."):
            for target in targets(name):
                assert not target.startswith(walled), f"{name} imports {target}"


def test_nothing_imports_the_pictures():
    for name in MODULES:
        if not name.startswith("jast.plot"):
            assert not any(t.startswith("jast.plot") for t in targets(name)), name


def test_no_module_imports_the_private_names_of_another():
    for name in MODULES:
        for module, attribute in imports(name, top=False):
            private = attribute is not None and attribute.startswith("_")
            assert (
                not private or f"{module}.{attribute}" in MODULES or attribute == "__version__"
            ), f"{name} imports {attribute} from {module}"


def test_names_at_each_door_exist_and_are_public():
    for name in ("jast", *MODULES):
        module = importlib.import_module(name)
        names = getattr(module, "__all__", ())
        assert len(set(names)) == len(names)
        for each in names:
            assert hasattr(module, each) and not each.startswith("_"), f"{name}.{each}"


def test_lines_are_short_and_the_code_is_formatted():
    pytest.importorskip("ruff")
    for command in (["check"], ["format", "--check"]):
        done = subprocess.run(
            [sys.executable, "-m", "ruff", *command, "-q", "jast", "tests", "benchmarks"],
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout + done.stderr
