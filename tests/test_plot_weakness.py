"""Pictures of weakness recognition: that each draws what the result says, in the axes that it is
given, and refuses what it cannot draw.
"""

import numpy as np
import pytest
from pictures import drawn, legend, matplotlib, plt, words

from jast import plot
from jast._src.plot.style import BLUE, GREY, VERMILION
from jast._src.weakness.measures import auc, roc
from jast._src.weakness.result import History, Result

N, CLASSES = 60, 4
NUMBERS = np.random.default_rng(0)
LABELS = NUMBERS.integers(0, CLASSES, N)
FAILED = NUMBERS.permutation(N) < 12
ANSWERS = np.where(FAILED, (LABELS + 1) % CLASSES, LABELS).astype(np.int32)
IMAGES = NUMBERS.random((N, 6, 5)).astype(np.float32)


def made(order, iterations=3, failed=FAILED):
    """The outcome of a validation that was never run."""
    order, n = np.asarray(order, int), len(failed)
    answers = ANSWERS if n == N and failed is FAILED else failed.astype(np.int32)
    predicted = np.full(n, -1, np.int32)
    predicted[order] = answers[order]
    noise = np.random.default_rng(len(order)).random((iterations, n))
    scores = (noise + 0.3 * np.arange(iterations)[:, None] * failed).astype(np.float32)
    calls = np.linspace(0, len(order), iterations + 1)[1:].astype(int)
    nothing = np.full(iterations, np.nan)
    history = History(
        calls,
        np.array([failed[order[:k]].sum() for k in calls]),
        nothing,
        nothing,
        nothing,
        nothing,
        scores,
    )
    left = np.setdiff1d(np.arange(n), order)
    return Result(
        order[failed[order]],
        len(order),
        order,
        predicted,
        scores[-1] if iterations else np.full(n, 0.5),
        left,
        0.0,
        history,
        (),
        None,
    )


BEST = np.argsort(~FAILED, kind="stable")
ORDERS = [np.random.default_rng(seed).permutation(N)[: 30 + seed] for seed in range(3)]
SEEDS = [made(order) for order in ORDERS]
NOTHING = made(BEST[::-1][:20])


def line(ax, label):
    [found] = [line for line in ax.lines if line.get_label() == label]
    return found


def titles(axes):
    return [ax.get_title(loc="left") for ax in axes]


def counted(order):
    return np.append(0, np.cumsum(FAILED[order]))


def band(collection, x):
    vertices = collection.get_paths()[0].vertices
    at = vertices[vertices[:, 0] == x, 1]
    return at.min(), at.max()


def test_a_curve_counts_failures_call_by_call():
    ax = drawn(plot.failures_found(SEEDS[0]))
    curve = line(ax, "found")
    np.testing.assert_array_equal(curve.get_xdata(), np.arange(31))
    np.testing.assert_array_equal(curve.get_ydata(), counted(ORDERS[0]))
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_xlim()) == (
        "calls of the system",
        "failures found",
        (0, 30),
    )
    found = FAILED[ORDERS[0]].sum()
    assert words(ax) == ["perfect choice", f"{found} found"] and not ax.collections
    np.testing.assert_array_equal(
        line(ax, "perfect choice").get_xdata(), line(ax, "perfect choice").get_ydata()
    )
    assert len(ax.lines) == 2


def test_the_truth_adds_its_bounds():
    ax = drawn(plot.failures_found(made(BEST[:40]), FAILED))
    assert line(ax, "all failures").get_ydata() == [12, 12]
    np.testing.assert_array_equal(line(ax, "perfect choice").get_xydata(), [[0, 0], [12, 12]])
    x, mean = line(ax, "random choice").get_data()
    np.testing.assert_allclose(mean, 12 * x / N)
    assert (x[0], x[-1]) == (0, N)
    deviation = np.sqrt(20 * (12 / N) * (48 / N) * (N - 20) / (N - 1))  # of a hypergeometric number
    np.testing.assert_allclose(band(ax.collections[0], 20), (4 - 2 * deviation, 4 + 2 * deviation))
    assert band(ax.collections[0], N) == (12, 12)
    assert set(words(ax)) == {
        "all 12 failures",
        "perfect choice",
        "random choice, ± 2 sd",
        "12 found (100.0 %)",
    }


def test_seeds_are_a_mean_and_a_band_as_far_as_all_of_them_go():
    for given, name, text in ((SEEDS, "found", ""), ({"mine": SEEDS}, "mine", "mine: ")):
        ax = drawn(plot.failures_found(given))
        counts = np.array([counted(order)[:31] for order in ORDERS])
        np.testing.assert_allclose(line(ax, name).get_ydata(), counts.mean(0))
        assert band(ax.collections[0], 17) == (counts[:, 17].min(), counts[:, 17].max())
        last = f"{counts[:, -1].mean():.1f}"
        assert f"{text or ''}{last}{'' if text else ' found'}\nmean of 3 runs" in words(ax)


def test_several_curves_have_a_name_and_a_marker_each_and_their_labels_are_apart():
    every = np.arange(N)
    ax = drawn(
        plot.failures_found(
            {"one": made(BEST), "two": made(every), "three": made(BEST[::-1])}, FAILED
        )
    )
    curves = [line(ax, name) for name in ("one", "two", "three")]
    assert (
        len({curve.get_marker() for curve in curves})
        == len({curve.get_color() for curve in curves})
        == 3
    )
    keys = [key.get_marker() for key in ax.lines if key.get_label() == "_key"]
    texts = [text for text in ax.texts if text.get_text().endswith("(100.0 %)")]
    assert [text.get_text() for text in texts] == [
        f"{name}: 12 (100.0 %)" for name in ("three", "two", "one")
    ]  # all end there; ordered as they run
    assert keys == [curve.get_marker() for curve in curves[::-1]]
    heights = [text.get_position()[1] for text in texts]
    assert (np.diff(heights) >= 0.064 * ax.get_ylim()[1]).all() and max(heights) <= ax.get_ylim()[1]


def test_labels_move_as_little_as_it_takes():
    from jast._src.plot.weakness import _apart

    np.testing.assert_allclose(_apart([1, 5, 9], 1, 0, 10), [1, 5, 9])
    np.testing.assert_allclose(_apart([4, 4, 4], 1, 0, 10), [3, 4, 5])
    np.testing.assert_allclose(_apart([1, 5, 5.5], 1, 0, 10), [1, 4.75, 5.75])
    np.testing.assert_allclose(_apart([0, 0, 10, 10], 2, 0, 10), [0, 2, 8, 10])
    assert len(_apart([], 1, 0, 10)) == 0


def test_searches_that_found_nothing_or_made_no_call_are_drawn():
    ax = drawn(plot.failures_found(NOTHING, FAILED))
    assert not line(ax, "found").get_ydata().any() and "0 found (0.0 %)" in words(ax)
    assert "0 found" in words(drawn(plot.failures_found(NOTHING)))
    np.testing.assert_array_equal(
        line(drawn(plot.failures_found(made([], 0))), "found").get_xydata(), [[0, 0]]
    )
    never = made(np.arange(20), 0, np.zeros(N, bool))
    ax = drawn(plot.failures_found(never, np.zeros(N, bool)))
    assert set(words(ax)) == {"no input fails", "0 found", "random choice, ± 2 sd"}
    only = np.arange(N) == 3
    assert "the only failure" in words(drawn(plot.failures_found(made([3], 0, only), only)))
    one = np.ones(1, bool)
    drawn(plot.failures_found(made([0], 1, one), one))
    drawn(plot.failures_found({"short": made(BEST[:5]), "long": made(BEST)}, FAILED))


def test_roc_curves_are_those_of_the_scores():
    result = made(BEST[:30], 9)
    ax = drawn(plot.roc(result, FAILED))
    assert legend(ax) == [
        f"iteration {k}:  AUC {auc(result.history.scores[k - 1], FAILED):.3f}" for k in (1, 4, 6, 9)
    ]
    for k, curve in zip((1, 4, 6, 9), ax.lines[1:], strict=True):
        expected = roc(result.history.scores[k - 1], FAILED)
        np.testing.assert_array_equal(
            curve.get_xydata(), np.stack([expected.false_positive, expected.true_positive], 1)
        )
    light = [sum(matplotlib.colors.to_rgb(curve.get_color())) for curve in ax.lines[1:]]
    assert (np.diff(light) < 0).all()
    assert (np.diff([curve.get_linewidth() for curve in ax.lines[1:]]) > 0).all()
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), [[0, 0], [1, 1]])
    assert words(ax) == ["chance"] and ax.get_aspect() == 1
    for given, names in (
        (2, ["iteration 2"]),
        ([5, 1], ["iteration 5", "iteration 1"]),
        (np.array([3]), ["iteration 3"]),
    ):
        assert [
            text.split(":")[0] for text in legend(drawn(plot.roc(result, FAILED, given)))
        ] == names
    assert len(drawn(plot.roc(made(BEST[:5], 1), FAILED)).lines) == 2


def test_the_legend_lies_beyond_the_diagonal_and_a_truth_of_one_kind_has_no_area():
    result = made(BEST[:30], 3)
    above, below = (
        drawn(plot.roc(result, truth, 3)).get_legend().get_window_extent()
        for truth in (FAILED, ~FAILED)
    )
    assert above.y1 < below.y0
    for truth, word in (
        (np.zeros(N, bool), "no input fails"),
        (np.ones(N, bool), "all inputs fail"),
    ):
        ax = drawn(plot.roc(result, truth))
        assert word in words(ax) and legend(ax) == [f"iteration {k}:  AUC -" for k in (1, 2, 3)]


def test_the_grid_shows_the_first_failures_in_the_order_found():
    order = NUMBERS.permutation(N)
    result = made(order)
    axes = drawn(plot.first_failures(result, IMAGES, LABELS, count=7))
    first = order[FAILED[order]][:7]
    assert titles(axes) == [f"said {(LABELS[i] + 1) % CLASSES}, is {LABELS[i]}" for i in first]
    assert [ax.get_xlabel() for ax in axes] == [f"input {i}" for i in first]
    for ax, i in zip(axes, first, strict=True):
        np.testing.assert_allclose(ax.images[0].get_array(), IMAGES[i])
        assert ax.images[0].get_clim() == (IMAGES.min(), IMAGES.max())  # one grey for all tiles
    assert axes[0].figure.get_suptitle() == "The first 7 of 12 failures found"
    assert [ax.axison for ax in axes[0].figure.axes] == [True] * 7 + [False] * 3
    everything = drawn(plot.first_failures(result, IMAGES, LABELS))
    assert len(everything) == 12 and everything[0].figure.get_suptitle() == "12 failures found"
    assert (
        drawn(plot.first_failures(result, IMAGES, LABELS, count=1))[0].figure.get_suptitle()
        == "The first of 12 failures found"
    )
    assert (
        drawn(plot.first_failures(made(BEST[:1]), IMAGES, LABELS))[0].figure.get_suptitle()
        == "1 failure found"
    )


def test_the_grid_takes_names_and_colours():
    i, names = BEST[0], ["cat", "dog", "aeroplane", "horse"]
    [ax] = drawn(plot.first_failures(made(BEST[:1]), IMAGES[..., None], LABELS, names=names))
    assert titles([ax]) == [f"said {names[ANSWERS[i]]}\nis {names[LABELS[i]]}"]
    np.testing.assert_allclose(ax.images[0].get_array(), IMAGES[i])
    colours = NUMBERS.random((N, 6, 5, 3))
    for given, whole in ((colours, 1), ((255 * colours).astype(np.uint8), 255)):
        [ax] = drawn(plot.first_failures(made(BEST[:1]), given, LABELS))
        np.testing.assert_allclose(ax.images[0].get_array(), given[i] / whole)
    # normalised images, say
    [ax] = drawn(plot.first_failures(made(BEST[:1]), 4 * colours - 2, LABELS))
    shown = ax.images[0].get_array()
    assert shown.min() >= 0 and shown.max() <= 1
    drawn(plot.first_failures(made(BEST[:1]), np.zeros((N, 6, 5), bool), LABELS))


def test_the_grid_of_no_failure_says_so():
    [ax] = drawn(plot.first_failures(NOTHING, IMAGES, LABELS))
    assert words(ax) == ["no failure found"]
    assert not ax.axison
    assert not ax.images


def test_the_influence_of_columns_is_bars_from_the_greatest():
    values = np.array([[1.0, -2.0, 0.1, 0.0], [3.0, -4.0, -0.5, 0.0]])
    ax = drawn(plot.contributions(values, names=["age", "height", "speed", "colour"]))
    assert [text.get_text() for text in ax.get_yticklabels()] == [
        "height",
        "age",
        "speed",
        "colour",
    ]
    np.testing.assert_allclose([bar.get_width() for bar in ax.patches], [3, 2, 0.3, 0])
    assert words(ax) == ["lowers, mean -3", "raises, mean +2", "lowers, mean -0.2", "neither"]
    assert [text.get_color() for text in ax.texts] == [BLUE, VERMILION, BLUE, GREY]
    assert ax.get_ylim()[0] > ax.get_ylim()[1]  # the greatest on top
    assert ax.get_xlabel().endswith(", 2 inputs")


def test_the_influence_of_many_columns_is_that_of_fifteen():
    values = NUMBERS.normal(size=(9, 40)) * np.arange(1, 41)
    ax = drawn(plot.contributions(values))
    chosen = np.argsort(-np.abs(values).mean(0))[:15]
    assert [text.get_text() for text in ax.get_yticklabels()] == [f"column {i}" for i in chosen]
    assert titles([ax]) == ["Which columns mark the failures: the 15 greatest of 40"]
    drawn(plot.contributions(np.zeros((1, 3))))


def test_the_influence_of_pixels_is_a_map_over_the_background():
    values = NUMBERS.normal(size=(7, 6, 5))
    ax = drawn(plot.contributions(values))
    [heat] = ax.images
    np.testing.assert_allclose(heat.get_array(), np.abs(values).mean(0))
    assert heat.get_clim() == (0, np.abs(values).mean(0).max())
    bar = heat.colorbar.ax
    assert (
        bar.get_ylabel().replace("\n", " ")
        == "mean magnitude of the contribution to the log odds of failure, 7 inputs"
    )
    ax = drawn(plot.contributions(np.stack([values, -2 * values], -1), background=IMAGES.mean(0)))
    beneath, heat = ax.images
    np.testing.assert_allclose(beneath.get_array(), IMAGES.mean(0))
    np.testing.assert_allclose(heat.get_array(), 3 * np.abs(values).mean(0))
    # seen where nothing contributes
    assert beneath.get_zorder() < heat.get_zorder() and heat.cmap(0.0)[3] == 0
    drawn(plot.contributions(np.zeros((1, 6, 5)), background=np.ones((6, 5, 3))))


def test_the_influence_of_no_inputs_says_so():
    for shape in ((0, 3), (0, 6, 5)):
        ax = drawn(plot.contributions(np.zeros(shape)))
        assert words(ax) == ["no inputs to explain"] and not ax.axison


def test_given_axes_are_used_and_settings_left_alone():
    before = dict(matplotlib.rcParams)
    result = made(BEST[:30])
    axes = plt.figure(layout="constrained").subplots(2, 2).ravel()
    drawers = (
        lambda ax: plot.failures_found(result, FAILED, ax),
        lambda ax: plot.roc(result, FAILED, ax=ax),
        lambda ax: plot.contributions(np.ones((2, 3)), ax=ax),
        lambda ax: plot.contributions(np.ones((2, 3, 3)), ax=ax),
    )
    for ax, draw in zip(axes, drawers, strict=True):
        assert draw(ax) is ax
    drawn(axes)
    axes = plt.figure().subplots(2, 3)
    assert (
        drawn(plot.first_failures(result, IMAGES, LABELS, count=4, axes=axes))
        == axes.ravel().tolist()[:4]
    )
    assert axes[1, 2].axison and not axes[0, 0].figure.get_suptitle()
    assert plot.first_failures(NOTHING, IMAGES, LABELS, axes=axes[1, 2]) == [axes[1, 2]]
    assert len(plt.get_fignums()) == 2 and dict(matplotlib.rcParams) == before


def refused(text, draw, *args, **settings):
    with pytest.raises(ValueError, match=text):
        draw(*args, **settings)
    assert not plt.get_fignums()


def test_what_cannot_be_drawn_is_refused():
    result = made(BEST[:30])
    for wrong, received in (
        (None, "NoneType"),
        ({}, "none"),
        ([], "none"),
        ({"a": []}, "none"),
        ({"a": FAILED}, "ndarray"),
        ([result, 1], "int"),
    ):
        refused(
            r"plot.failures_found: results must be a jast.weakness.Result, a list .*received"
            rf" .*{received}",
            plot.failures_found,
            wrong,
        )
    refused(
        "results must be of the same inputs, received results of 5, 60 inputs",
        plot.failures_found,
        [result, made([1], 1, np.ones(5, bool))],
    )
    refused(
        "plot.failures_found: failed must agree with the results, .* contradicts 30 of the 30"
        " calls",
        plot.failures_found,
        result,
        ~FAILED,
    )
    for wrong, received in (
        (FAILED[:5], r"bool of shape \(5,\)"),
        (FAILED.astype(int), r"int64 of shape \(60,\)"),
        (np.True_, r"bool of shape \(\)"),
    ):
        refused(
            rf"plot.failures_found: failed must be bool \[60\], received {received}",
            plot.failures_found,
            result,
            wrong,
        )
        refused(
            rf"plot.roc: failed must be bool \[60\], received {received}", plot.roc, result, wrong
        )
    refused(
        "plot.roc: result must be a jast.weakness.Result, received list", plot.roc, [result], FAILED
    )
    refused(
        "plot.roc: result must have iterations, received none", plot.roc, made(BEST[:3], 0), FAILED
    )
    refused("plot.roc: iterations must name at least one", plot.roc, result, FAILED, [])
    for wrong in (0, 4, True, 1.5, "1", [1, -1]):
        refused("plot.roc: iterations must be in 1 .. 3, received", plot.roc, result, FAILED, wrong)


def test_a_grid_that_cannot_be_drawn_is_refused():
    result = made(BEST[:30])
    grid = plot.first_failures
    refused(
        "plot.first_failures: result must be a jast.weakness.Result, received dict",
        grid,
        {"a": result},
        IMAGES,
        LABELS,
    )
    refused(
        r"inputs must be images .* received rows of a table, shape \(60, 30\): reshape them",
        grid,
        result,
        IMAGES.reshape(N, -1),
        LABELS,
    )
    refused(
        r"inputs must be images .* received shape \(60, 3, 6, 5\)",
        grid,
        result,
        np.zeros((N, 3, 6, 5)),
        LABELS,
    )
    refused(
        "plot.first_failures: inputs must be those of the result, 60, received 50",
        grid,
        result,
        IMAGES[:50],
        LABELS[:50],
    )
    refused(
        r"plot.first_failures: labels must be whole numbers \[60\]",
        grid,
        result,
        IMAGES,
        LABELS[:5],
    )
    refused(
        "labels must be those of the result, received .* agree with its answer in 12 of its 12",
        grid,
        result,
        IMAGES,
        ANSWERS,
    )
    for wrong in (0, 2.5, True):
        refused(
            "plot.first_failures: count must be a whole number of at least 1",
            grid,
            result,
            IMAGES,
            LABELS,
            wrong,
        )
    refused(
        "names must be a list of one for each class, at least 4, received 2",
        grid,
        result,
        IMAGES,
        LABELS,
        names=["a", "b"],
    )
    refused(
        "names must be a list of one for each class, at least 4, received dict",
        grid,
        result,
        IMAGES,
        LABELS,
        names={0: "a"},
    )
    with pytest.raises(
        ValueError, match="plot.first_failures: axes must be at least 12.*received 1"
    ):
        grid(result, IMAGES, LABELS, axes=plt.figure().subplots())


def test_an_influence_that_cannot_be_drawn_is_refused():
    values = np.ones((2, 3, 3))
    for wrong in (np.ones(3), np.ones((1, 2, 3, 4, 5)), np.zeros((3, 0)), 1.0):
        refused(
            r"plot.contributions: values must be \[k, columns\], .* received shape",
            plot.contributions,
            wrong,
        )
    refused(
        "plot.contributions: values must be .* received no such array",
        plot.contributions,
        ["a", "b"],
    )
    refused(
        "plot.contributions: values must be finite, 1 are not", plot.contributions, [[1.0, np.nan]]
    )
    refused(
        "plot.contributions: names must be 3, one for each column, received 1",
        plot.contributions,
        values[0],
        names=["a"],
    )
    refused(
        "plot.contributions: names must be None for images, received list",
        plot.contributions,
        values,
        names=["a"],
    )
    refused(
        "plot.contributions: background must be None for rows of a table, received ndarray",
        plot.contributions,
        values[0],
        background=values[0],
    )
    refused(
        r"plot.contributions: background must be finite \[3, 3\] or with channels, received shape"
        r" \(2, 2\)",
        plot.contributions,
        values,
        background=np.ones((2, 2)),
    )
    refused(
        r"background must be finite .* with numbers that are not",
        plot.contributions,
        values,
        background=np.full((3, 3), np.inf),
    )
    refused(
        r"background must be finite .* received no such array",
        plot.contributions,
        values,
        background="mean",
    )
