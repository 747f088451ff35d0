"""Pictures of how failures were learned."""

import jax
import matplotlib
import numpy as np
import pytest

matplotlib.use("Agg")

from matplotlib import pyplot as plt  # noqa: E402

import jast  # noqa: E402
from jast import plot  # noqa: E402

KEY = jax.random.key(0)
WALK = jast.simulators.walk1d(threshold=3.0, horizon=8)


def test_the_levels_of_a_proposal_fall_to_failures():
    found = jast.estimate.failure_proposal(KEY, WALK, samples=200)
    ax = plot.levels(found)
    [line] = ax.lines
    np.testing.assert_allclose(line.get_ydata(), found.levels)
    assert ax.get_legend() is None and ax.get_ylabel() == "miss distance of the elites"
    both = plot.levels({"a": found, "b": found}, ax=plt.figure().subplots())
    assert [text.get_text() for text in both.get_legend().texts] == ["a", "b"]


@pytest.mark.long
def test_the_training_of_a_policy():
    policy = jast.policies.sac(KEY, WALK, episodes=400, lanes=16, hidden=(8,))
    share, log_p = plot.training(policy)
    np.testing.assert_allclose(share.lines[0].get_ydata(), policy.history.failing_share)
    np.testing.assert_allclose(share.lines[0].get_xdata(), policy.history.episodes)
    np.testing.assert_allclose(log_p.lines[0].get_ydata(), policy.history.log_p)
    share.figure.canvas.draw()


@pytest.mark.parametrize("picture", [plot.levels, plot.training])
@pytest.mark.parametrize("bad", [3, {}, {"a": None}])
def test_other_things_are_refused(picture, bad):
    with pytest.raises(ValueError, match=f"plot.{picture.__name__}: .* a dict of name -> one"):
        picture(bad)
