"""Pictures of cross-entropy methods: that each draws what the result says, in the axes that it is
given, and refuses what it cannot draw.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.patches import Ellipse
from pictures import drawn, matplotlib, plt

from benchmarks import sierra_figure
from jast import cross_entropy as ce
from jast import plot
from jast.cross_entropy import (
    CEResult,
    Gaussian,
    History,
    Mixture,
    ce_method,
    normal,
    paraboloid,
    scores,
    sierra,
)

OBJECTIVE, PROPOSAL = sierra(), normal([1.0, -2.0], jnp.array([[50.0, 20.0], [20.0, 30.0]]))
RUNS = jax.device_get(
    jax.vmap(lambda key: ce_method(key, OBJECTIVE, PROPOSAL, iterations=4))(
        jax.random.split(jax.random.key(0), 8)
    )
)
RUN = jax.tree.map(lambda a: a[0], RUNS)
K, N, JUDGED = 3, 12, 40


def made(proposals, judged=JUDGED):
    """The outcome of three iterations of four points each that were never run."""
    numbers = np.random.default_rng(0)
    x, value = numbers.normal(size=(N, 2)), numbers.normal(size=N)
    best = [np.argmin(value[: 4 * k + 4]) for k in range(K)]
    model_x = numbers.normal(size=(K, judged, 2))
    model_x[0, JUDGED // 2 :] = np.nan
    history = History(
        x, value, np.repeat(np.arange(K), 4), x[best], value[best], proposals, model_x
    )
    return CEResult(
        jax.tree.map(lambda a: a[-1], proposals), x[best[-1]], value[best[-1]], history, 0
    )


COVARIANCES = np.array([[[3.0, 1.0], [1.0, 2.0]], [[0.5, -0.2], [-0.2, 0.1]]])
MIXTURES = Mixture(
    np.tile([0.8, 0.2], (K + 1, 1)),
    np.tile(np.array([[1.0, 0.0], [-2.0, 3.0]]), (K + 1, 1, 1)),
    np.tile(COVARIANCES, (K + 1, 1, 1, 1)),
)
GAUSSIANS = Gaussian(
    np.arange(2.0 * (K + 1)).reshape(K + 1, 2), np.arange(1.0, K + 2)[:, None, None] * np.eye(2)
)
MIXED, MODELLED = made(MIXTURES), made(GAUSSIANS)


def ellipses(ax):
    return [patch for patch in ax.patches if isinstance(patch, Ellipse)]


def points(ax, label):
    [line] = [line for line in ax.lines if line.get_label().replace("\n", " ") == label]
    return line.get_xydata()


def on_ellipse(patch, mean, covariance, deviations):
    """Its outline is where the Mahalanobis distance is ``deviations``."""
    angle = np.linspace(0, 2 * np.pi, 50)
    outline = patch.get_patch_transform().transform(np.stack([np.cos(angle), np.sin(angle)], -1))
    z = outline - mean
    np.testing.assert_allclose(
        np.sqrt(np.sum(z @ np.linalg.inv(covariance) * z, 1)), deviations, rtol=1e-3
    )


def test_a_gaussian_is_its_ellipses_of_one_and_two_deviations():
    axes = drawn(plot.proposal_contours(RUN, OBJECTIVE, iterations=[1, 3]))
    assert [ax.get_title(loc="left") for ax in axes] == ["iteration 1", "iteration 3"]
    for ax, k in zip(axes, (0, 2), strict=True):
        one, two = ellipses(ax)
        mean, covariance = (np.asarray(a[k], float) for a in RUN.history.proposals)
        for patch, deviations in ((one, 1), (two, 2)):
            on_ellipse(patch, mean, covariance, deviations)
            assert sorted([patch.width, patch.height]) == pytest.approx(
                2 * deviations * np.sqrt(np.linalg.eigvalsh(covariance)), rel=1e-4
            )
    np.testing.assert_allclose(ellipses(axes[0])[0].center, PROPOSAL.mean)


def test_a_mixture_is_the_ellipses_of_its_components():
    ax = drawn(plot.proposal_contours(MIXED, paraboloid))[0]
    patches = ellipses(ax)
    assert len(patches) == 4 and patches[0].get_alpha() > patches[2].get_alpha()
    for i, patch in enumerate(patches):
        on_ellipse(patch, MIXTURES.means[0, i // 2], COVARIANCES[i // 2], 1 + i % 2)


def test_points_are_those_of_the_history():
    axes = plot.proposal_contours(RUN, OBJECTIVE, elites=3)
    assert len(axes) == 4
    x, value = RUN.history.x, RUN.history.value
    for k, ax in enumerate(axes):
        np.testing.assert_array_equal(
            points(ax, "evaluated in the iteration"), x[10 * k : 10 * k + 10]
        )
        so_far = slice(0, 10 * k + 10)
        np.testing.assert_array_equal(
            points(ax, "the 3 best so far"), x[so_far][np.argsort(value[so_far], kind="stable")[:3]]
        )
        np.testing.assert_array_equal(points(ax, "best so far"), RUN.history.best_x[k][None])


def test_default_bounds_hold_the_points_and_given_ones_say_how_many_do_not():
    for ax, k in zip(plot.proposal_contours(RUN, None), range(4), strict=True):
        x = RUN.history.x[10 * k : 10 * k + 10]
        low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
        assert ((low < x) & (x < high)).all() and not ax.texts
        assert ax.get_aspect() == 1
    [ax] = plot.proposal_contours(MIXED, None, iterations=2, bounds=((0, 1), (-1, 2)))
    x = MIXED.history.x[4:8]
    outside = np.sum((x[:, 0] < 0) | (x[:, 0] > 1) | (x[:, 1] < -1) | (x[:, 1] > 2))
    assert (ax.get_xlim(), ax.get_ylim()) == ((0, 1), (-1, 2))
    assert [t.get_text() for t in ax.texts] == [f"{outside} of 4 outside"]


def test_a_proposal_that_shrank_to_a_point_is_drawn():
    history = MODELLED.history._replace(x=np.ones((N, 2)), best_x=np.ones((K, 2)))
    still = MODELLED._replace(
        history=history._replace(
            proposals=Gaussian(np.ones((K + 1, 2)), np.full((K + 1, 2, 2), 1e-20))
        )
    )
    drawn(plot.proposal_contours(still, paraboloid))
    drawn(plot.surrogate_samples(still, paraboloid, 1))


def test_the_objective_is_drawn_below_whatever_it_is_written_in():
    def outside_jax(x):
        return float(x[0]) ** 2 + float(x[1]) ** 2

    areas = [
        drawn(plot.proposal_contours(MIXED, f, iterations=1))[0].collections[0]
        for f in (paraboloid, outside_jax)
    ]
    np.testing.assert_allclose(areas[0].get_array(), areas[1].get_array(), rtol=1e-4)
    assert areas[0].get_array().min() < 1
    assert areas[0].get_zorder() < ellipses(plt.gca())[0].get_zorder()
    for flat in (lambda x: jnp.zeros(()), lambda x: jnp.full((), jnp.nan)):
        assert not drawn(plot.proposal_contours(MIXED, flat, iterations=1))[0].collections
    assert not plot.proposal_contours(MIXED, None, iterations=1)[0].collections
    hole = plot.proposal_contours(MIXED, lambda x: jnp.where(x[0] > 0, x[0], jnp.nan), iterations=1)
    assert np.isfinite(drawn(hole)[0].collections[0].get_array()).all()


def test_an_unfinished_search_shows_what_it_has():
    search = ce.start(jax.random.key(0), PROPOSAL, "ce_method", iterations=3)
    with pytest.raises(ValueError, match="plot.proposal_contours: result must have evaluations"):
        plot.proposal_contours(ce.finish(search), None)
    x = ce.ask(search)
    half = ce.finish(ce.tell(search, x, np.full(10, np.nan)))
    [ax] = drawn(plot.proposal_contours(half, None))
    np.testing.assert_allclose(points(ax, "evaluated in the iteration"), x)
    assert len(points(ax, "the 5 best so far")) == 0


def test_surrogate_samples_are_those_of_the_iteration():
    for k in (1, 3):
        left, right = drawn(plot.surrogate_samples(MODELLED, paraboloid, k))
        history = MODELLED.history
        judged = history.model_x[k - 1][: JUDGED // 2 if k == 1 else JUDGED]
        np.testing.assert_array_equal(points(left, "truly evaluated"), history.x[4 * k - 4 : 4 * k])
        np.testing.assert_array_equal(points(right, "judged by the surrogate"), judged)
        assert [ax.get_title(loc="left") for ax in (left, right)] == [
            "4 truly evaluated",
            f"{len(judged)} judged; next proposal",
        ]
        for ax, i in ((left, k - 1), (right, k)):
            on_ellipse(
                ellipses(ax)[0], history.proposals.mean[i], history.proposals.covariance[i], 1
            )
            np.testing.assert_array_equal(points(ax, "best so far"), history.best_x[k - 1][None])
        assert left.get_xlim() == right.get_xlim() and left.get_ylim() == right.get_ylim()


def test_convergence_is_the_mean_and_its_band():
    value, distance = drawn(plot.convergence({"one": RUNS, "two": RUNS}, (1.0, 2.0)))
    score = scores(RUNS, (1.0, 2.0))
    away = np.linalg.norm(np.asarray(RUNS.history.best_x, float) - (1.0, 2.0), axis=2)
    for ax, mean, error in (
        (value, score.best_value, score.standard_error),
        (distance, score.mean_distance, away.std(0, ddof=1) / np.sqrt(8)),
    ):
        np.testing.assert_array_equal(ax.lines[0].get_xdata(), [10, 20, 30, 40])
        np.testing.assert_allclose(ax.lines[0].get_ydata(), mean)
        outline = ax.collections[0].get_paths()[0].vertices
        for x, m, e in zip((10, 20, 30, 40), mean, error, strict=True):
            band = outline[outline[:, 0] == x, 1]
            np.testing.assert_allclose(
                [band.min(), band.max()], [m - 1.96 * e, m + 1.96 * e], atol=1e-9
            )
    assert [t.get_text() for t in value.get_legend().get_texts()] == ["one", "two"]
    assert distance.get_yscale() == "log"


@pytest.mark.slow
def test_convergence_of_uneven_batches_and_of_values_that_are_missing():
    uneven = jax.vmap(
        lambda key: ce_method(
            key, OBJECTIVE, PROPOSAL, iterations=3, schedule=ce.schedules.manual((15, 10, 5))
        )
    )(jax.random.split(jax.random.key(1), 3))
    [ax] = drawn(plot.convergence(uneven))
    np.testing.assert_array_equal(ax.lines[0].get_xdata(), [15, 25, 30])
    assert ax.get_legend().get_texts()[0].get_text() == "mean of 3 runs"
    late = RUNS._replace(
        history=RUNS.history._replace(
            best_value=np.where(np.arange(4) < 2, np.inf, RUNS.history.best_value)
        )
    )
    np.testing.assert_array_equal(drawn(plot.convergence(late))[0].lines[0].get_xdata(), [30, 40])
    single = drawn(plot.convergence(jax.tree.map(lambda a: a[:1], RUNS), (0.0, 0.0)))
    assert not single[0].collections and not single[1].collections


@pytest.mark.slow
def test_sierra_is_drawn_as_printed():
    """Six panels; the least of the third is the optimum of Table 2.1."""
    panels = sierra_figure.sierra()
    assert len(panels) == 6 and "decay 1\nleast -0.0220" in panels[2].get_title("left")
    given = plt.figure().subplots(1, 2)
    assert sierra_figure.sierra([(6, 1)], given, order="thesis") == [given[0]] and given[1].axison
    assert "-0.0220" in given[0].get_title("left")
    for settings in ([], [3], 7):
        with pytest.raises(ValueError, match="settings must be pairs"):
            sierra_figure.sierra(settings)


def test_given_axes_are_used_and_settings_left_alone():
    before = dict(matplotlib.rcParams)
    axes = plt.figure().subplots(2, 3)
    assert plot.proposal_contours(MIXED, paraboloid, axes) == axes.ravel().tolist()[:3]
    assert not axes[1, 2].lines
    assert axes[1, 2].axison
    axes = plt.figure().subplots(1, 2)
    assert plot.surrogate_samples(MODELLED, paraboloid, 1, axes) == list(axes)
    axes = plt.figure().subplots()
    assert plot.convergence(RUNS, axes=axes) == [axes]
    assert len(plt.get_fignums()) == 3 and dict(matplotlib.rcParams) == before


def test_what_cannot_be_drawn_is_refused():
    three = ce_method(jax.random.key(0), paraboloid, normal(jnp.zeros(3), 1.0), iterations=2)
    for draw in (
        plot.proposal_contours,
        lambda result, objective: plot.surrogate_samples(result, objective, 1),
    ):
        with pytest.raises(
            ValueError, match=r"result must .*received one with leading axes \(8,\)"
        ):
            draw(RUNS, OBJECTIVE)
        with pytest.raises(
            ValueError, match="result must be of an objective of 2 numbers, received 3"
        ):
            draw(three, paraboloid)
        with pytest.raises(ValueError, match="result must be a CEResult, received (Array|ndarray)"):
            draw(RUN.best_x, OBJECTIVE)
    for wrong in ([0], [1, 5], 2.5, [True], ["1"]):
        with pytest.raises(
            ValueError, match="plot.proposal_contours: iterations must be in 1 .. 4"
        ):
            plot.proposal_contours(RUN, OBJECTIVE, iterations=wrong)
    with pytest.raises(ValueError, match="iterations must name at least one"):
        plot.proposal_contours(RUN, OBJECTIVE, iterations=[])
    for wrong in ((0, 1), ((1, 0), (0, 1)), ((0, np.inf), (0, 1))):
        with pytest.raises(ValueError, match="plot.proposal_contours: bounds must be"):
            plot.proposal_contours(RUN, OBJECTIVE, bounds=wrong)
    with pytest.raises(ValueError, match="elites must be an int of at least 1, received 0"):
        plot.proposal_contours(RUN, OBJECTIVE, elites=0)
    with pytest.raises(
        ValueError, match="plot.proposal_contours: axes must be at least 4.*received 1"
    ):
        plot.proposal_contours(RUN, OBJECTIVE, plt.figure().subplots())
    with pytest.raises(ValueError, match="plot.surrogate_samples: result must .* with a surrogate"):
        plot.surrogate_samples(RUN, OBJECTIVE, 1)
    with pytest.raises(ValueError, match="plot.surrogate_samples: iteration must .*received 4"):
        plot.surrogate_samples(MODELLED, OBJECTIVE, 4)
    with pytest.raises(ValueError, match=r"plot.convergence: results must .*axes \(\) for 'one'"):
        plot.convergence({"one": RUN})
    with pytest.raises(ValueError, match="plot.convergence: results must hold at least one"):
        plot.convergence({})
    with pytest.raises(ValueError, match=r"optimum must be \[2\]"):
        plot.convergence(RUNS, (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="plot.convergence: axes must be at least 2"):
        plot.convergence(RUNS, (0.0, 0.0), plt.figure().subplots())
