"""Pictures of what a search costs by how slow its simulator is."""

import numpy as np
import pytest
from pictures import drawn, matplotlib, plt  # noqa: F401

from benchmarks import costs
from jast.search import SearchResult


def result(failing, episodes=9000, steps=90_000):
    empty = dict.fromkeys(SearchResult._fields)
    return SearchResult(
        **empty | dict(failing_per_tree=np.array(failing), episodes=episodes, steps=steps)
    )


RESULTS = {"forest": result([True, True, False, False]), "random": result([False] * 4, steps=10**6)}
SECONDS = {"forest": 2.0, "random": 1.0}


def test_failing_trees_in_a_second():
    ax = drawn(costs.failing_trees(RESULTS, SECONDS, costs=[1e-9, 1.0]))
    forest, random = (line.get_ydata() for line in ax.lines)
    # 2 of 4 trees in 2 s, and in 90,002 s
    np.testing.assert_allclose(forest, [1, 2 / 90_002], rtol=1e-4)
    # none of 4: at most .602 of them, by Clopper and Pearson, 1 - .025^(1/4)
    np.testing.assert_allclose(random, [4 * (1 - 0.025**0.25), 4 * 0.602 / 1e6], rtol=1e-2)
    assert "at most" in ax.get_legend().get_texts()[1].get_text()


def test_the_time_of_a_simulation():
    given = plt.figure().subplots()
    ax = costs.simulation_times(RESULTS["forest"], 9.0, costs=[1e-12, 1.0], ax=given)
    assert drawn(ax) is given
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [1e-3, 10.001], rtol=1e-6)
    assert ax.get_legend().get_texts()[0].get_text() == "10.0 steps"


@pytest.mark.parametrize(
    "results, seconds, more, said",
    [
        ({}, {}, {}, "results must be results of a search, received none"),
        ({"a": 1}, {"a": 1.0}, {}, r"results must be results of a search, received \['int'\]"),
        (RESULTS, 1.0, {}, "seconds must be a dict of the same names as results"),
        (RESULTS, {"forest": 1.0}, {}, r"seconds must have the names \['forest', 'random'\]"),
        (RESULTS, SECONDS | {"random": 0.0}, {}, "seconds must be above 0, received 0.0 for 'ran"),
        (RESULTS["forest"], 1.0, dict(costs=[0.0]), "costs must be seconds above 0"),
    ],
)
def test_errors_name_the_argument(results, seconds, more, said):
    with pytest.raises(ValueError, match=said):
        costs.simulation_times(results, seconds, **more)
