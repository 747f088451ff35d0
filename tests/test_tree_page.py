"""Trees that a search keeps, their picture and their page."""

import jax
import numpy as np
import pytest
from browser import Page, browsed
from systems import TOLD, ring, walk

import jast
from jast._src.core.signature import signature_of
from jast._src.page.tree import nodes_of

CASES = {
    "ring": (ring(), TOLD),
    "follow": (walk(), dict(mode="episodic")),
    "feed": (walk(), dict(mode="thesis")),
}


def searched(name):
    sim, settings = CASES[name]
    return jast.search.mcts(
        jax.random.key(3), sim, trees=2, simulations=120, keep_trees=True, refine=0, **settings
    )


@pytest.fixture(scope="module")
def found():
    return searched("ring")


def actions_of(nodes, trees, node):
    """(x0, x) of the nodes from the root to ``node``, the first level first."""
    path = []
    while node > 0:
        path.append(int(nodes.row[node]))
        node = int(nodes.parent[node])
    return [
        jax.tree.map(lambda a, i=i: a[i, nodes.tree], (trees.start, trees.x)) for i in path[::-1]
    ]


@pytest.mark.parametrize(
    "name", ["ring", *(pytest.param(n, marks=pytest.mark.long) for n in CASES if n != "ring")]
)
def test_what_is_kept_is_the_tree(name, found):
    """The children of the roots are those of the statistics of roots; the actions on the way to a
    failure are those of its episode, but for the rounding of another program.
    """
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    result = found if name == "ring" else searched(name)
    sim, trees = CASES[name][0], result.trees
    for lane in range(2):
        nodes = nodes_of("test", result, lane)
        visits, q = result.roots.visits[0, lane], result.roots.q[0, lane]
        first = nodes.children(0)
        assert nodes.visits[first].tolist() == sorted(visits[visits > 0].tolist(), reverse=True)
        assert sorted(nodes.q[first]) == pytest.approx(sorted(q[visits > 0]), rel=1e-5, abs=1e-6)
        inner = [n for n in range(1, len(nodes.parent)) if len(nodes.children(n))]
        assert inner  # a visit made the node, the others went on to its children
        for n in inner:
            assert nodes.visits[n] == 1 + nodes.visits[nodes.children(n)].sum()
        assert nodes.failing[0] == (trees.failure & (trees.visits > 0))[:, lane].sum()
    archive, seen = result.failures, 0
    start = signature_of(sim).random_start
    for i, episode in enumerate(archive):
        lane, simulation = int(archive.tree[i]), int(archive.simulation[i])
        if lane < 0:
            continue
        nodes = nodes_of("test", result, lane)
        (node,) = np.flatnonzero(nodes.row == simulation)
        taken = actions_of(nodes, trees, int(node))
        if start:
            jax.tree.map(close, taken.pop(0)[0], episode.x0)
        for t, (_, x) in enumerate(taken):
            seen += 1
            here = jax.tree.map(lambda a, t=t: a[t], episode.disturbances)
            jax.tree.map(close, x, here)
    assert seen > 5


def test_the_best_path_leads_to_the_best_episode(found):
    nodes = nodes_of("test", found)
    trees, last = found.trees, nodes.path[-1]
    made = trees.visits > 0
    failing = np.where(made & trees.failure, trees.reward, -np.inf)
    best = failing if np.isfinite(failing).any() else np.where(made, trees.reward, -np.inf)
    assert trees.reward[nodes.row[last], nodes.tree] == best.max()
    assert nodes.path[0] == 0 and (nodes.parent[nodes.path[1:]] == nodes.path[:-1]).all()


def test_the_picture_shows_visits_and_q_along_the_path(found):
    pytest.importorskip("matplotlib").use("Agg")
    nodes, axes = nodes_of("test", found), jast.plot.tree(found)
    axes[0].figure.canvas.draw()
    for ax, values in zip(axes, (nodes.q, nodes.visits), strict=True):
        np.testing.assert_allclose(ax.lines[-1].get_ydata(), values[nodes.path])
    assert len(jast.plot.tree(found, tree=1, levels=1)[0].lines[-1].get_xdata()) == 2


def test_refusals(found, tmp_path):
    for name in ("tree", "tree_page"):
        more = () if name == "tree" else (tmp_path / "t.html",)
        draw = getattr(jast.plot, name)
        with pytest.raises(ValueError, match=rf"plot.{name}: result must be .* keep_trees=True"):
            draw(found._replace(trees=None), *more)
        with pytest.raises(ValueError, match=rf"plot.{name}: tree must be in 0 .. 1, received 2"):
            draw(found, *more, tree=2)
    with pytest.raises(ValueError, match="mcts: memoize must be .* keep_trees=True.*'none'"):
        jast.search.mcts(jax.random.key(0), walk(), keep_trees=True, memoize="none")


def test_a_file_keeps_the_trees(found, tmp_path):
    jast.save(tmp_path / "r", found)
    back = jast.load(tmp_path / "r", CASES["ring"][0]).trees
    assert jax.tree.structure(back) == jax.tree.structure(found.trees)
    jax.tree.map(np.testing.assert_array_equal, back, found.trees)


def test_a_large_tree_is_cut_where_it_was_visited_least(found, tmp_path, monkeypatch):
    from jast._src.page import tree as page

    monkeypatch.setattr(page, "BYTES", 3000)
    jast.plot.tree_page(found, tmp_path / "t.html", tree=0)
    data = Page((tmp_path / "t.html").read_text()).data
    nodes = nodes_of("test", found, 0)
    assert len(data["parent"]) < len(nodes.parent)
    assert len(data["parent"]) + sum(data["more"]) <= len(nodes.parent)
    assert all(p < i for i, p in enumerate(data["parent"]))
    assert [data["visits"][i] for i in data["path"]] == nodes.visits[nodes.path].tolist()


def test_nodes_open_in_a_browser(found, tmp_path):
    jast.plot.tree_page(found, tmp_path / "tree.html")
    page, nodes = (tmp_path / "tree.html").read_text(encoding="utf-8"), nodes_of("test", found)
    check = """
      const open = () => document.querySelectorAll(".node").length;
      const visits = () => [...document.querySelectorAll("#tree > ul > li > ul > li > .node")].map(
        (node) => Number(node.querySelector(".visits").textContent.slice(2)));
      found.best = document.querySelectorAll(".node.best").length;
      found.visits = visits();
      found.action = document.querySelector("#tree > ul > li > ul .action").textContent;
      found.before = open();
      document.getElementById("close").click();
      found.closed = open();
      document.querySelector(".node").click();
      found.again = visits();
      const child = [...document.querySelectorAll("#tree > ul > li > ul > li > .node")].find(
        (node) => node.getAttribute("aria-expanded") === "false");
      const was = open();
      child.click();
      found.more = open() - was;
      found.marked = child.querySelector(".mark").textContent;
    """
    seen = browsed(page, check, tmp_path)
    assert "error" not in seen, seen
    children = [len(nodes.children(n)) for n in nodes.path]
    assert seen["best"] == len(nodes.path) and seen["before"] == 1 + sum(children)
    assert seen["visits"] == seen["again"] == nodes.visits[nodes.children(0)].tolist()
    assert seen["closed"] == 1
    assert seen["more"] > 0
    assert seen["marked"] == "\N{BLACK DOWN-POINTING SMALL TRIANGLE}"
    assert seen["action"].startswith("gust = ") and "hit = " in seen["action"]  # of x0
