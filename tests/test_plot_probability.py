"""Pictures of estimates: that each draws what the numbers say, marks what must not be believed, and
refuses what it cannot draw.
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import drawn, legend, plt, words

import jast
from jast import plot
from jast._src.estimate.estimate import Estimate
from jast._src.plot import style
from jast._src.plot.style import BLUE, VERMILION
from jast._src.search.refine.modes import Mode, Modes
from jast.estimate import Exceedance, FailureSamples, Traces, pareto_k

WALK = jast.simulators.walk1d()
FEW = jax.device_get(
    jax.vmap(lambda key: jast.rollout(key, WALK)._replace(states=None))(
        jax.random.split(jax.random.key(0), 120)
    )
)
FAILED = jax.tree.map(lambda a: a[np.asarray(FEW.failure)], FEW)


def made(mean=1e-9, error=0.1, reliable=True, interval=None, level=0.95):
    """An estimate that was never made."""
    log_mean, interval = (
        np.log(mean),
        (mean * (1 - 2 * error), mean * (1 + 2 * error)) if interval is None else interval,
    )
    numbers = dict(
        level=level,
        ess=500.0,
        k_hat=0.1,
        max_share=0.01,
        failing=500,
        samples=1000,
        episodes=1000,
        steps=9,
        invalid=0,
        modes=None,
    )
    return Estimate(
        "made",
        log_mean,
        mean,
        mean * error,
        error,
        interval,
        reliable=reliable,
        warnings=() if reliable else ("a reason",),
        **numbers,
    )


NOTHING = made(np.nan, np.nan, False, (0.0, 3.7e-6))


def test_an_estimate_and_its_interval_are_where_the_numbers_say():
    e = made()
    ax = drawn(plot.probability(e, 1.1e-9))
    truth, interval, dot = ax.lines
    assert ax.get_xscale() == "log" and ax.get_xlabel() == "failure probability"
    assert tuple(interval.get_xdata()) == e.interval
    assert list(dot.get_xdata()) == [e.mean]
    assert list(truth.get_xdata()) == [1.1e-9] * 2
    assert [label.get_text() for label in ax.get_yticklabels()] == ["made"]
    assert words(ax) == ["1e-09  SE 10 %"]
    assert legend(ax) == [
        "truth 1.1e-09",
        "estimate, 0.95 interval",
    ]


def test_what_is_not_to_be_believed_is_drawn_otherwise_and_named():
    ax = drawn(plot.probability({"good": made(), "bad": made(reliable=False)}))
    good, dot, bad, cross = ax.lines
    assert good.get_color() == BLUE
    assert not good.is_dashed()
    assert dot.get_marker() == "o"
    assert bad.get_color() == VERMILION
    assert bad.is_dashed()
    assert cross.get_marker() == "X"
    assert words(ax) == ["1e-09  SE 10 %", "1e-09  UNRELIABLE"] and "UNRELIABLE" in legend(ax)
    flagged = made(reliable=False)._replace(plain=(0, 0, 1_000_000))
    counted = flagged._replace(chernoff=0.1, jeffreys=0.1)
    nothing = NOTHING._replace(plain=(0, 0, 1_000_000))
    known = drawn(plot.probability({"a": flagged, "b": counted, "c": nothing}))
    first = "between 0 and 3.69e-06"
    assert words(known) == [f"{first}\n1e-09  UNRELIABLE", f"{first}\nUNRELIABLE", first]
    # the first row is the highest
    assert bad.get_ydata()[0] > good.get_ydata()[0] and ax.yaxis_inverted()


def test_several_seeds_share_a_row():
    ax = drawn(
        plot.probability(
            {
                "seeds": [made(m, reliable=m < 2e-9) for m in (1e-9, 2e-9, 3e-9)],
                "fine": [made(), made()],
            }
        )
    )
    heights = [line.get_ydata()[0] for line in ax.lines[::2]]
    assert len(set(heights)) == 5 and max(map(abs, heights[:3])) < 0.5 < min(heights[3:])
    assert words(ax) == ["2 of 3 UNRELIABLE", "2 runs"]


def test_no_failure_is_an_upper_bound():
    ax = drawn(plot.probability({"nominal": NOTHING}))
    [bound] = ax.lines
    assert list(bound.get_xdata()) == [3.7e-6]
    assert words(ax) == ["below 3.7e-06"]
    assert "upper bound" in legend(ax)[0]
    ax = drawn(plot.probability({"none": NOTHING._replace(interval=(0.0, 1.0)), "one": made()}))
    assert words(ax)[0] == "no failure seen" and len(ax.lines) == 2
    assert plot.probability(made(interval=(1e-320, 1e-8))).lines[0].get_xdata()[0] > 0


@pytest.mark.parametrize(
    "arguments, text",
    [
        ((), "estimates must be an Estimate or a dict"),
        (({},), "received none"),
        (({"a": 1e-9},), "received ['float']"),
        ((made()._replace(mean=0.0),), "above the smallest float64"),
        ((made(), 0.0), "truth must be above 0"),
        ((made(), 1.5), "truth must be above 0"),
    ],
)
def test_probability_refuses(arguments, text):
    with pytest.raises(ValueError, match="plot.probability: ") as error:
        plot.probability(*(arguments or (None,)))
    assert text in str(error.value)


def test_a_fan_replays_every_failure():
    ax = drawn(plot.failure_fan(FAILED, WALK, lambda s: s, FEW))
    behind = [line for line in ax.lines if line.get_color() == style.GREY]
    lines = [
        line
        for line in ax.lines
        if line.get_color() in (BLUE, VERMILION)
        and line.get_linestyle() != "None"
        and len(line.get_xdata())
    ]
    assert len(behind) == len(FEW.length) and len(lines) == len(FAILED.length)
    assert sorted(len(line.get_ydata()) for line in lines) == sorted(
        int(n) + 1 for n in FAILED.length
    )
    assert {line.get_color() for line in lines} == {BLUE, VERMILION}
    for line in lines:  # the side is that of the end
        assert (line.get_ydata()[-1] > 0) == (line.get_color() == BLUE)
    assert sum(int(text.split()[0]) for text in legend(ax)[1:]) == len(FAILED.length)
    assert legend(ax)[0] == "120 nominal episodes"


def test_a_fan_of_miss_distances():
    ax = drawn(plot.failure_fan(FailureSamples(FAILED, 5.0, 5, 0.5, 100), WALK, most=3))
    lines = [line for line in ax.lines if len(line.get_xdata()) and line.get_linestyle() != "None"]
    assert len(lines) == 3
    assert legend(ax) == ["3 failures"]
    assert ax.get_ylabel() == "miss distance"
    assert all(line.get_ydata()[-1] == 0 for line in lines)
    given = plt.figure().subplots()
    assert plot.failure_fan(FAILED, WALK, ax=given) is given


def test_a_fan_by_mode_and_of_a_field():
    """A colour and a mark for each mode; a field by its name; one episode is a fan of one."""
    few = jax.tree.map(lambda a: a[:4], FAILED)
    ax = drawn(
        plot.failure_fan(few, WALK, "state", modes=np.array([0, 2, 0, 7]), units=dict(state="m"))
    )
    assert legend(ax) == ["mode 1: 2 failures", "mode 3: 1 failure", "mode 8: 1 failure"]
    assert ax.get_ylabel() == "state (m)"
    marks = [line for line in ax.lines if line.get_linestyle() == "None"]
    assert [line.get_marker() for line in marks] == ["o", "^", "x"]
    assert len({line.get_color() for line in marks}) == 3
    only = jax.tree.map(lambda a: a[0], FAILED)
    assert len(plot.failure_fan(only, WALK).lines) == 3
    heads = Modes([Mode(jax.tree.map(lambda a, i=i: a[i], FAILED), 1, 0.5) for i in (0, 1)])
    ax = plot.failure_fan(jax.tree.map(lambda a: a[:2], FAILED), WALK, modes=heads)
    assert legend(ax) == ["mode 1: 1 failure", "mode 2: 1 failure"]
    assert legend(plot.failure_fan(heads, WALK)) == legend(ax)


def test_a_fan_refuses():
    for other in (
        jax.tree.map(lambda a: a[:0], FEW),
        FEW.length,
        SimpleNamespace(),
    ):
        with pytest.raises(ValueError, match="plot.failure_fan: samples must be failures"):
            plot.failure_fan(other, WALK)
    with pytest.raises(ValueError, match="plot.failure_fan: sim must be the jast.Simulator"):
        plot.failure_fan(FAILED)
    with pytest.raises(ValueError, match="plot.failure_fan: fields must be among .*'speed'"):
        plot.failure_fan(FAILED, WALK, "speed")
    with pytest.raises(ValueError, match="plot.failure_fan: modes must be"):
        plot.failure_fan(FAILED, WALK, modes=[0])
    with pytest.raises(ValueError, match="plot.failure_fan: most must be"):
        plot.failure_fan(FAILED, WALK, most=0)
    with pytest.raises(ValueError, match=r"plot.failure_fan: value must .*received shape \(2,\)"):
        plot.failure_fan(FAILED, WALK, lambda s: jnp.zeros(2))


def traces(log_w, failing=None):
    n = len(log_w)
    return Traces(
        log_w,
        np.zeros((n, 1)),
        np.ones(n, bool) if failing is None else failing,
        np.zeros(n, bool),
        np.ones(n, int),
    )


def test_weights_are_shares_above_and_the_tail_has_the_slope_of_k_hat():
    e = np.random.default_rng(0).exponential(size=20_000)
    t = {"heavy": traces(1.5 * e), "light": traces(0.2 * e, e > 0.5)}
    ax = drawn(plot.weights(t))
    points, fits = ax.lines[::2], ax.lines[1::2]
    assert ax.get_xscale() == ax.get_yscale() == "log" and len(points) == len(fits) == 2
    for line, one in zip(points, t.values(), strict=True):
        w = np.exp(one.log_weight) * one.failure
        x, y = line.get_data()
        np.testing.assert_allclose(
            y, [(w / w.mean() >= v * (1 - 1e-9)).mean() for v in x], rtol=1e-9
        )
    k = pareto_k(t["heavy"].log_weight, 20_000)
    x, y = (a[np.isfinite(fits[0].get_ydata())] for a in fits[0].get_data())
    assert np.log(y[-1] / y[-9]) / np.log(x[-1] / x[-9]) == pytest.approx(-1 / k, rel=0.1)
    assert legend(ax) == [
        f"heavy: k-hat {k:.2f} UNRELIABLE",
        f"light: k-hat {pareto_k(0.2 * e[e > 0.5], 20_000):.2f}",
    ]


def test_weights_of_any_kind():
    drawn(plot.weights(traces(np.zeros(100))))  # all alike: no tail to fit
    ax = drawn(plot.weights(traces(np.linspace(0, 1, 3))))
    assert legend(ax) == ["k-hat nan UNRELIABLE"]
    # below the least double, and bounded
    drawn(plot.weights(traces(-1000 - np.random.default_rng(0).exponential(size=1000))))
    with pytest.raises(ValueError, match="plot.weights: traces must be Traces"):
        plot.weights(np.zeros(3))
    with pytest.raises(ValueError, match="plot.weights: traces must .*received 0 for 'none'"):
        plot.weights({"none": traces(np.zeros(9), np.zeros(9, bool))})


@pytest.mark.slow
def test_a_fan_of_an_archive_and_its_labels():
    archive = jast.search.monte_carlo(jax.random.key(0), WALK, episodes=5000, refine=0, top=8)
    for found in (archive, archive.failures):
        ax = drawn(plot.failure_fan(found, WALK, label="offset (m)"))
        assert legend(ax) == [f"{len(archive.failures)} failures"] and len(archive.failures) > 1
        assert ax.get_ylabel() == "offset (m)"

    def wind_speed(state):
        return state

    named = plot.failure_fan(archive, WALK, wind_speed)
    assert named.get_ylabel() == "wind speed"
    unnamed = plot.failure_fan(archive, WALK, lambda s: s)
    assert unnamed.get_ylabel() == "number of the state"


def curve(u, p, reliable=True):
    u, p = np.asarray(u, float), np.asarray(p, float)
    good = np.broadcast_to(reliable, u.shape)
    return Exceedance(u, p, p / 2, 2 * p, 0 * u + 500, good, 0.95, "made")


def test_the_exceedance_curve_and_its_band():
    c = curve([-0.5, 0.0, 0.5, 1.0], [1e-9, 1e-8, 1e-7, np.nan], [True, True, False, False])
    ax = drawn(plot.exceedance(c, truth=lambda u: 1e-8 * 10 ** (2 * u)))
    failure, good, doubted, truth = ax.lines
    assert ax.get_yscale() == "log" and list(failure.get_xdata()) == [0, 0]
    np.testing.assert_array_equal(good.get_ydata(), [1e-9, 1e-8, np.nan, np.nan])
    np.testing.assert_array_equal(doubted.get_ydata(), [np.nan, np.nan, 1e-7, np.nan])
    assert len(truth.get_xdata()) == 4
    assert legend(ax) == ["failure", "made, 0.95 interval", "UNRELIABLE", "truth"]
    (band,) = ax.collections
    assert band.get_datalim(ax.transData).ymax == pytest.approx(2e-7)


def test_exceedance_of_estimates_and_what_it_refuses():
    ax = drawn(plot.exceedance({"plain": jast.estimate.monte_carlo(jax.random.key(0), WALK, 2000)}))
    assert legend(ax)[1] == "plain, 0.95 interval"
    for wrong in ({}, 3.0, {"a": "b"}):
        with pytest.raises(ValueError, match="plot.exceedance: curves must be an Exceedance"):
            plot.exceedance(wrong)
    with pytest.raises(ValueError, match="curves must hold at least one probability"):
        plot.exceedance(curve([0.0], [np.nan]))
    with pytest.raises(ValueError, match="exceedance: estimate must have kept its weighted draws"):
        plot.exceedance(made())
