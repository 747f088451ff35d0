"""The house keeps its shape: doors only hand out, arrows run one way, what a module lends stands in
its list, files stay readable."""

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
PRIVATE = "jast._src."
# a room, and those that it never imports
WALLS = [
    ("simulators", ("search", "estimate", "policies", "cross_entropy")),
    ("search", ("estimate", "policies", "weakness")),
    ("cross_entropy", ("search", "estimate", "policies")),
    ("distributions", ("search", "estimate", "heads", "normal_space")),
    ("specs", ("search", "estimate", "explain", "simulators")),
    ("core", ("search", "estimate", "heads", "simulators")),
    ("util", ("search", "estimate", "heads", "simulators", "distributions")),
]
LATE = {  # the pictures of a result, drawn when somebody asks for them
    "jast._src.page.notebook",
    "jast._src.sweeping.table",
}


def source(name):
    path = MODULES.get(name, ROOT / "jast")
    return path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"


TREES = {name: ast.parse(source(name).read_text()) for name in ("jast", *MODULES)}


def for_types(tree):
    """What stands below ``if TYPE_CHECKING``, which no program runs."""
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            yield from ast.walk(node)


def imports(name, top=True):
    """(module, name) of what a module imports from jast; ``top``: at its own import only."""
    tree = TREES[name]
    unused = set(map(id, for_types(tree)))
    for node in tree.body if top else ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and id(node) not in unused:
            if (node.module or "").split(".")[0] == "jast":
                for alias in node.names:
                    yield node.module, alias.name


def behind(module, attribute):
    """The module in which what a door hands out under this name is written."""
    if f"{module}.{attribute}" in MODULES and not hasattr(sys.modules.get(module), attribute):
        return f"{module}.{attribute}"
    if not module.startswith(PRIVATE):
        for node in TREES.get(module, ast.Module([], [])).body:
            if isinstance(node, ast.ImportFrom):
                for alias in node.names:
                    if (alias.asname or alias.name) == attribute:
                        whole = f"{node.module}.{alias.name}"
                        return whole if whole in MODULES else node.module
    whole = f"{module}.{attribute}"
    return whole if whole in MODULES else module


def targets(name, top=True):
    """The modules that a module imports; ``top``: at its own import only."""
    for module, attribute in imports(name, top):
        yield behind(module, attribute)


def test_a_door_only_hands_out():
    for name in MODULES:
        if not f"{name}.".startswith(PRIVATE):
            code = [n.name for n in TREES[name].body if isinstance(n, ast.FunctionDef)]
            assert set(code) <= {"__getattr__", "__dir__"}, f"{name}: {code}"
            assert not any(isinstance(n, ast.ClassDef) for n in TREES[name].body), name


def test_no_two_modules_import_one_another():
    """Late imports count, and what comes through a door counts as what is behind it."""
    graph = {
        name: {t for t in targets(name, top=False) if t.startswith(PRIVATE) and t != name}
        for name in MODULES
        if name.startswith(PRIVATE) and source(name).name != "__init__.py"
    }
    done, under_way = set(), []

    def visit(name):
        assert name not in under_way, " -> ".join([*under_way[under_way.index(name) :], name])
        if name not in done:
            under_way.append(name)
            for other in sorted(graph.get(name, ())):
                visit(other)
            done.add(under_way.pop())

    for name in sorted(graph):
        visit(name)


@pytest.mark.parametrize("room, walled", WALLS, ids=[room for room, _ in WALLS])
def test_arrows_run_downwards(room, walled):
    for name in MODULES:
        if f"{name}.".startswith(f"{PRIVATE}{room}."):
            for target in targets(name):
                assert not target.startswith(tuple(f"{PRIVATE}{other}." for other in walled)), (
                    f"{name} imports {target}"
                )


def test_nothing_imports_the_pictures():
    for name in MODULES:
        if not name.startswith(f"{PRIVATE}plot") and name not in ("jast.plot", *LATE):
            for target in targets(name, top=False):
                assert not target.startswith((f"{PRIVATE}plot", "jast.plot")), name


def own_names(tree):
    """What a module defines at its top level; not what it imports."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            yield from (n.id for n in ast.walk(node) if isinstance(n, ast.Name))


def lent():
    """(borrower, module, name) of every name of a private module that another one uses."""
    for name, tree in TREES.items():
        modules = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jast"):
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    if whole in MODULES and source(node.module).name == "__init__.py":
                        modules[alias.asname or alias.name] = whole
                    else:
                        yield name, node.module, alias.name
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                if node.value.id in modules:
                    yield name, modules[node.value.id], node.attr


def test_what_a_module_lends_stands_in_its_list():
    unlisted = set()
    for borrower, module, name in lent():
        if module.startswith(PRIVATE) and name in set(own_names(TREES[module])):
            if name not in getattr(importlib.import_module(module), "__all__", ()):
                unlisted.add(f"{borrower} takes {name} of {module}")
    assert not unlisted, "\n".join(sorted(unlisted))


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
