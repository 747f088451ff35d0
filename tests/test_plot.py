"""Pictures: that each draws what it says, in the axes that it is given, and refuses what it cannot
draw.
"""

import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import drawn, matplotlib, plt
from systems import dice, ring

import jast
from jast import plot
from jast.distributions import Joint, MultivariateNormalDiag, Normal

FERRY = jast.simulators.ferry()
STRAIGHT = jast.replay(FERRY, jnp.full(21, 0.5))
HIT = jast.replay(FERRY, jnp.array([0.998] * 4 + [0.9273, 0.8188, 0.7135, 0.6448] + [0.6431] * 13))


def result(trees=5, best=None):
    best = (
        np.maximum.accumulate(np.random.default_rng(0).normal(size=(18, trees)), 0)
        if best is None
        else best
    )
    return SimpleNamespace(
        history=SimpleNamespace(
            simulations=np.arange(1, len(best) + 1) * 500, best_reward=jnp.asarray(best)
        )
    )


def test_ferry_shows_both_paths_and_the_closest_approach():
    ax = drawn(plot.ferry(HIT))
    ferry, adversary = (line.get_xydata() for line in ax.lines[:3:2])
    assert len(ferry) == len(adversary) == int(HIT.length) + 1
    assert tuple(ferry[0]) == (0, 50) and tuple(adversary[0]) == (16, 0)
    assert "failure at step 19" in ax.get_title(loc="left") and "reward" in ax.get_title(loc="left")
    assert "4.84" in [text.get_text() for text in ax.texts]
    assert ax.patches[0].radius == 5
    assert "no failure" in drawn(plot.ferry(STRAIGHT)).get_title(loc="left")


def test_ferry_replays_an_archived_episode():
    bare = jax.device_get(HIT._replace(states=None))
    ax = plot.ferry(bare, FERRY, plt.figure().subplots())
    np.testing.assert_array_equal(ax.lines[2].get_xydata(), plot.ferry(HIT).lines[2].get_xydata())


def test_ferry_failing_at_the_start_is_drawn():
    drawn(plot.ferry(jast.replay(jast.simulators.ferry((1.0, 50.0)), jnp.zeros((0,)))))


def test_history_mean_band_and_best():
    best = np.array([[-3.0, -1.0], [0.0, 2.0], [1.0, 2.0]])
    ax = drawn(plot.history({"forest": result(best=best), "other": result()}))
    np.testing.assert_allclose(ax.lines[0].get_ydata(), best.mean(1))
    np.testing.assert_allclose(ax.lines[1].get_ydata(), best.max(1))
    assert len(ax.collections) == 2 and len(ax.get_legend().get_texts()) == 4
    drawn(plot.history(result(trees=1)))
    given = plt.figure().subplots()
    assert plot.history(result(best=np.array([[-np.inf, -np.inf], [1.0, 2.0]])), given) is given
    with pytest.raises(ValueError, match="plot.history: history must have"):
        plot.history(result(best=np.zeros(3)))


@pytest.mark.slow
def test_disturbances_of_any_structure():
    [ax] = plot.disturbances(HIT)
    np.testing.assert_array_equal(
        ax.lines[0].get_ydata(), np.asarray(HIT.disturbances)[: int(HIT.length)]
    )
    joint = lambda s: Joint(
        {
            "a": Normal(0.0, 1.0),
            "b": MultivariateNormalDiag(jnp.zeros(3)),
            "c": MultivariateNormalDiag(jnp.zeros(9)),
        }
    )
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x["a"],
        joint,
        lambda s: (jnp.abs(s) > 50, jnp.abs(s)),
        horizon=4,
    )
    axes = plot.disturbances(jast.rollout(jax.random.key(0), sim))
    assert [len(drawn(ax).lines) for ax in axes] == [1, 3, 9]
    assert [ax.get_ylabel() for ax in axes] == ["a", "b", "c"]
    with pytest.raises(ValueError, match="plot.disturbances: axes must be at least 3"):
        plot.disturbances(jast.rollout(jax.random.key(0), sim), plt.figure().subplots())
    drawn(plot.disturbances(jast.replay(FERRY, jnp.zeros((0,))))[0])


@pytest.mark.slow
def test_disturbances_by_how_far_out_they_are():
    """A normal number by its standard deviations from its mode, a choice by its rarity."""
    sim = ring()
    x = {
        "gust": jnp.array([[0.5, -1.0], [0.0, 0.25]]),
        "hit": jnp.array([1, 0]),
    }
    e = jast.replay(sim, x, {"gust": jnp.asarray(-2.0), "hit": jnp.asarray(1)})
    axes = plot.disturbances(e, sim=sim)
    assert [drawn(ax).get_ylabel() for ax in axes] == ["x0 gust", "x0 hit", "gust", "hit"]
    lines = [[line.get_ydata() for line in ax.lines] for ax in axes]
    np.testing.assert_allclose(lines[0], [[-2.0]], atol=1e-5)
    np.testing.assert_allclose(lines[1], [[0.0]], atol=1e-5)
    np.testing.assert_allclose(lines[2], [[1.0, 0.0], [-2.0, 0.5]], atol=1e-5)
    rare = np.sqrt(2 * np.log(0.6 / 0.4))
    np.testing.assert_allclose(lines[3], [[rare, 0.0]], atol=1e-5)
    assert "standard deviations" in axes[0].get_title(loc="left")
    with pytest.raises(ValueError, match="plot.disturbances: disturbance.*no quantile function"):
        plot.disturbances(jast.rollout(jax.random.key(0), dice()), sim=dice())


def test_distances():
    many = jax.vmap(lambda key: jast.rollout(key, FERRY))(jax.random.split(jax.random.key(0), 30))
    ax = drawn(
        plot.distances(many, jax.tree.map(lambda a: a[None], HIT), labels=["nominal", "found"])
    )
    assert [t.get_text() for t in ax.get_legend().get_texts()] == [
        "nominal: 30 episodes, 0 fail",
        "found: 1 episode, 1 fail",
    ]
    drawn(plot.distances(many._replace(distance=jnp.full(30, jnp.inf))))
    with pytest.raises(ValueError, match="plot.distances: labels must be 1 names"):
        plot.distances(many, labels=[])
    with pytest.raises(ValueError, match="plot.distances: episodes must be"):
        plot.distances(many.distance)


def test_one_episode_of_the_right_system_is_asked_for():
    many = jax.tree.map(lambda a: jnp.stack([a, a]), HIT)
    for draw in (plot.ferry, plot.disturbances):
        with pytest.raises(
            ValueError, match=r"episode must .*received Episode with leading axes \(2,\)"
        ):
            draw(many)
    with pytest.raises(ValueError, match="plot.ferry: episode must be of jast.simulators.ferry"):
        plot.ferry(HIT._replace(states=jnp.zeros(22)))


def test_settings_of_matplotlib_are_left_alone():
    before = dict(matplotlib.rcParams)
    plot.ferry(HIT)
    assert dict(matplotlib.rcParams) == before


@pytest.mark.slow
def test_pictures_are_on_the_door_without_matplotlib():
    code = "import sys, jast; jast.plot.history; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize(
    "name, place",
    [
        ("confusion", "benchmarks/weakness_figures.py"),
        ("likely_failures", "benchmarks/weakness_figures.py"),
        ("pixel_likelihood", "benchmarks/weakness_figures.py"),
        ("threshold_sweep", "benchmarks/weakness_figures.py"),
        ("sierra", "benchmarks/sierra_figure.py"),
        ("influence", "jast.plot.contributions"),
        ("failure_grid", "jast.plot.first_failures"),
    ],
)
def test_a_former_name_says_where_its_picture_is(name, place):
    with pytest.raises(AttributeError, match=f"no attribute '{name}': it is now .*{place}"):
        getattr(plot, name)
