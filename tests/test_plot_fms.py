"""Pictures of the flight management system, and of every evaluation of a search."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import drawn, plt

import jast
from jast import plot
from jast._src.search.result import Trials
from jast.simulators import fms, fms_path, walk1d
from jast.simulators.fms import KLAX, KSFO


def lines(ax, label):
    return [line.get_xydata() for line in ax.lines if line.get_label() == label]


def route(courses=(240.0, 200.0)):
    """Twelve waypoints southwards, the first two .01 nmi apart with turns to either side."""
    x = np.tile([180.0, 50.0, 0.0, 0.0], (12, 1))
    x[1, :2], x[2, 0] = (courses[0], 0.01), courses[1]
    return jnp.asarray(x)


# fms


@pytest.mark.slow
def test_the_failing_arc_is_shown(x64):
    sim = fms()
    episode = jast.replay(sim, route())
    path = fms_path(sim, episode)
    ground, turn = drawn(plot.fms(episode, sim))
    title, other = ground.get_title(loc="left"), turn.get_title(loc="left")
    assert "failure at step 12" in title
    assert f"arc length: miss distance {float(episode.distance):,.5g}" in title
    assert "Turn at waypoint 2, 61 ft behind 1" in other and "was not fitted" in other
    [whole] = lines(ground, "predicted path")
    np.testing.assert_allclose(whole[[0, -1]], [KSFO[::-1], KLAX[::-1]], atol=1e-9)
    [marked] = lines(ground, "arc with the largest error")
    # leads all the way round to its end
    np.testing.assert_allclose(marked[-1], path.end[1][::-1], atol=1e-6)
    [arc] = lines(turn, "as its packet says")
    centre = ((np.asarray(path.centre[1]) - np.asarray(path.waypoints[2])) * 60)[::-1] * [
        np.cos(np.radians(path.waypoints[2, 0])),
        1,
    ]
    # a circle, in nmi
    np.testing.assert_allclose(np.hypot(*(arc - centre).T), abs(path.radius[1]) / 1852, rtol=0.01)
    angles = np.unwrap(np.arctan2(*(arc - centre).T))
    assert 6.1 < abs(angles[-1] - angles[0]) < 2 * np.pi
    [built] = lines(turn, "as it was built")
    np.testing.assert_allclose(built[-1], arc[-1], atol=1e-6)
    assert {"s", "e", "c"} <= {text.get_text() for text in turn.texts}
    assert "1, 2" in [text.get_text() for text in ground.texts]


@pytest.mark.slow
def test_other_routes_are_drawn(x64):
    sim = fms()
    sound = plot.fms(
        jast.replay(sim, route((200.0, 180.0)).at[1, 1].set(30.0))._replace(states=None),
        sim,
        plt.figure(layout="constrained").subplots(1, 2),
    )
    assert "no failure" in drawn(sound)[0].get_title(loc="left")
    assert "was not fitted" not in sound[1].get_title(loc="left")
    drawn(plot.fms(jast.replay(sim, route()[:3]), sim))
    empty = drawn(plot.fms(jast.replay(sim, route()[:0]), sim))
    assert not empty[1].lines and len(lines(empty[0], "predicted path")[0]) == 2


@pytest.mark.slow
def test_fms_asks_for_an_episode_of_its_own(x64):
    sim = fms()
    episode = jast.replay(sim, route())
    many = jax.tree.map(lambda a: jnp.stack([a, a]), episode)
    for bad, match in (
        (
            lambda: plot.fms(many, sim),
            r"plot.fms: episode must be one Episode, received Episode with leading axes \(2,\)",
        ),
        (lambda: plot.fms(episode, walk1d()), "fms_path: sim must be a jast.simulators.fms"),
        (
            lambda: plot.fms(episode, sim, plt.figure().subplots()),
            "plot.fms: axes must be at least 2",
        ),
    ):
        with pytest.raises(ValueError, match=match):
            bad()


# trials


def recorded(distance, ran=None):
    distance = np.asarray(distance, float)
    failure = distance <= 0
    ran = np.ones(distance.shape, bool) if ran is None else np.asarray(ran)
    return SimpleNamespace(
        trials=Trials(
            -distance,
            distance,
            np.linspace(-9, -2, distance.size).reshape(distance.shape),
            failure,
            ran,
            np.zeros_like(failure),
        )
    )


FEW = [[4.0, np.inf], [2.0, 6.0], [-3.0, -2.0], [5.0, np.inf]]


def test_running_figures():
    mean, least, failures = drawn(plot.trials(recorded(FEW)))
    [mean_line], [least_line], [failure_line] = (ax.lines for ax in (mean, least, failures))
    np.testing.assert_array_equal(mean_line.get_xdata(), [1, 2, 3, 4])
    np.testing.assert_allclose(mean_line.get_ydata(), [np.nan, 4.5, 1.5, 2])
    np.testing.assert_allclose(least_line.get_ydata(), [np.nan, 4, -2.5, -2.5])
    np.testing.assert_allclose(failure_line.get_ydata(), [0, 0, 1, 1])
    assert len(mean.collections) == 1
    assert mean.get_legend().get_texts()[0].get_text() == "mean of 2 trees"
    band = mean.collections[0].get_paths()[0].vertices  # quartiles of 3 and 6, 1 and 2, 2 and 2
    assert band[:, 1].max() == pytest.approx(5.25) and band[:, 1].min() == pytest.approx(1.25)


def test_running_figures_of_several_searches():
    rng = np.random.default_rng(0)
    results = {
        "one": recorded(rng.normal(3, 2, (5000, 1))),
        "many": recorded(rng.normal(2, 2, (300, 20))),
    }
    axes = drawn(plot.trials(results))
    assert [t.get_text() for t in axes[0].get_legend().get_texts()] == [
        "one",
        "many: mean of 20 trees",
    ]
    one, many = axes[2].lines
    assert len(one.get_xdata()) == 2000
    assert one.get_xdata()[-1] == 5000
    assert one.get_ydata()[-1] == (results["one"].trials.distance <= 0).sum()
    assert many.get_ydata()[-1] == pytest.approx((results["many"].trials.distance <= 0).sum() / 20)


def test_ends_that_a_tree_knew_are_left_out():
    ran = [[True], [True], [False], [True]]
    axes = plot.trials(recorded([[4.0], [-2.0], [-2.0], [7.0]], ran))
    assert list(axes[2].lines[0].get_ydata()) == [0, 1, 1, 1]
    assert axes[0].lines[0].get_ydata()[-1] == 3
    top, bottom = plot.trial_distances(recorded([[4.0], [-2.0], [-2.0], [7.0]], ran))
    assert top.get_legend().get_texts()[0].get_text() == "3 episodes, 1 fail"


def test_distributions_of_trials():
    top, bottom = drawn(
        plot.trial_distances({"few": recorded(FEW), "none": recorded(np.full((9, 2), 5.0))}, bins=8)
    )
    assert [t.get_text() for t in top.get_legend().get_texts()] == [
        "few: 6 episodes, 2 fail",
        "none: 18 episodes, 0 fail",
    ]
    assert [t.get_text() for t in bottom.get_legend().get_texts()] == ["few: mean -4.5"]
    shares = [patch.get_data().values for patch in top.patches]
    assert len(shares) == 4
    assert all(share.sum() == pytest.approx(1) and len(share) == 8 for share in shares)
    assert shares[0][0] == pytest.approx(2 / 6)  # both failures
    assert "none" in [
        t.get_text() for t in drawn(plot.trial_distances(recorded(np.full((9, 2), 5.0))))[1].texts
    ]
    drawn(plot.trial_distances(recorded(np.full((3, 1), np.inf))))


def test_trials_are_asked_for():
    for draw, name in ((plot.trials, "trials"), (plot.trial_distances, "trial_distances")):
        with pytest.raises(
            ValueError, match=f"plot.{name}: results must .*record=True, received a SimpleNamespace"
        ):
            draw(SimpleNamespace(trials=None))
        with pytest.raises(
            ValueError, match=rf"plot.{name}: trials must .*received distances of shape \(3,\)"
        ):
            draw({"flat": recorded(np.ones(3))})
        with pytest.raises(ValueError, match=f"plot.{name}: results must be a search result"):
            draw({})
        with pytest.raises(ValueError, match=f"plot.{name}: axes must be at least"):
            draw(recorded(FEW), axes=plt.figure().subplots())


def test_figures_of_the_thesis_as_printed():
    """Of one tree: distances 4, 2, -3, 5 negated, with a standard deviation of those so far."""
    one = [[row[0]] for row in FEW]
    mean, greatest, failures = drawn(plot.trials(recorded(one), mode="thesis"))
    assert mean.get_xscale() == failures.get_xscale() == "log"
    np.testing.assert_allclose(mean.lines[0].get_ydata(), [-4, -3, -1, -2])
    np.testing.assert_allclose(greatest.lines[0].get_ydata(), [-4, -2, 3, 3])
    band = mean.collections[0].get_paths()[0].vertices
    so_far = [np.std([4, 2, -3, 5][: k + 1]) for k in range(4)]
    for k, (x, middle) in enumerate(zip([1, 2, 3, 4], [-4, -3, -1, -2], strict=True)):
        ends = band[np.isclose(band[:, 0], x), 1]
        np.testing.assert_allclose(
            [ends.min(), ends.max()], [middle - so_far[k], middle + so_far[k]]
        )
    assert [line.get_label() for line in mean.lines[1:]] == ["event horizon"]
    distances, _ = drawn(plot.trial_distances(recorded(one), mode="thesis"))
    assert distances.get_xlabel() == "-d" and distances.lines[0].get_xdata() == [0, 0]
    for draw in (plot.trials, plot.trial_distances):
        with pytest.raises(
            ValueError, match='mode must be "default" or "thesis", received "log"|log'
        ):
            draw(recorded(one), mode="log")
