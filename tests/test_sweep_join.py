"""The rows of a sweep of cheap systems are joined by what their failures say of one another."""

import concurrent.futures
import math
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import line

import jast
from jast._src.estimate.population.failure_sample import Sample, draws_of_sample
from jast._src.sweeping.curve import join_rows
from jast._src.sweeping.simulators import make_simulators
from jast.estimate import Estimate
from jast.sweeping import Sweep

LIMITS = np.linspace(3.0, 3.7, 8)
PHI = NormalDist()


def walk(limit, horizon=1):
    """The sum of its steps leaves [-limit, limit] at the end: 2 Phi(-limit / sqrt(horizon))."""
    evaluate = lambda s: (jnp.abs(s) > limit, jnp.maximum(limit - jnp.abs(s), 0.0))
    return line(evaluate=evaluate, horizon=horizon, episodic=True)


def log_truth(limits, horizon=1):
    return np.log([2 * PHI.cdf(-v / math.sqrt(horizon)) for v in limits])


MADE = make_simulators(walk, [{"limit": v} for v in LIMITS])
BLANK = dict.fromkeys(Estimate._fields)


def row(rng, i, families, copies=1, error=0.05, sides=(-1, 1), **about):
    """A row as a call would leave it: an exact log probability plus a normal error, and so many
    families of exact failures, of equal members each.
    """
    u = rng.random(families) * PHI.cdf(-LIMITS[i])
    z = np.array([PHI.inv_cdf(v) for v in u]) * rng.choice(sides, families)
    z = np.repeat(z, copies)[:, None].astype(np.float32)
    family, none = np.repeat(np.arange(families, dtype=np.int32), copies), np.zeros(len(z))
    sample = Sample(z, np.ones(len(z), np.int32), none, none, family)
    log_mean = log_truth(LIMITS)[i] + error * rng.standard_normal()
    return (
        Estimate(**BLANK)
        ._replace(
            log_mean=log_mean,
            mean=math.exp(log_mean),
            relative_error=error,
            level=0.95,
            interval=(0.0, 1.0),
            reliable=True,
            warnings=(),
            proposal=sample if copies > 1 else None,
            draws=draws_of_sample(jax.random.key(0), MADE[i], sample, 10 * len(z)),
            settings=dict(budget=300_000),
        )
        ._replace(**about)
    )


def check_rows(rows, truth):
    """What they say [n, 3], a value and its interval of 95 %, within 4.5 standard errors of the
    log ``truth``.
    """
    half = np.diff(np.log(rows[:, 1:]), axis=1)[:, 0] / 2
    assert (np.abs(np.log(rows[:, 0]) - truth) < 4.5 / 1.96 * half).all()


def keys(n):
    return list(jax.random.split(jax.random.key(0), n))


@pytest.mark.slow
@pytest.mark.parametrize("copies", [1, 4])
def test_intervals_hold_the_truth_and_ratios_are_sharper(copies):
    """120 curves of 8 rows. All rows of a curve share errors, so coverage is told by curves: the
    mean of their shares lies within 4 standard errors of .95. Equal members of a family add
    nothing, and are not taken for more.
    """
    rng, truth = np.random.default_rng(copies), log_truth(LIMITS)
    curves, ratios, errors, alone = [], [], [], []
    for _ in range(120):
        found = [row(rng, i, 300, copies) for i in range(len(LIMITS))]
        curve, ratio, _ = join_rows(keys(8), MADE, found)
        low, high = np.log(curve[:, 1:].T)
        curves.append(np.mean((low < truth) & (truth < high)))
        (low, high), step = np.log(ratio[:, 1:].T), np.diff(truth)
        ratios.append(np.mean((low < step) & (step < high)))
        errors.append(np.log(ratio[:, 0]) - step)
        gaps = np.diff(np.log(curve[:, 0])) - step  # NaN beside one that stands alone
        np.testing.assert_allclose(gaps, np.where(np.isnan(gaps), gaps, errors[-1]), atol=1e-6)
        alone.append(np.diff([r.log_mean for r in found]) - step)
    for hits in (curves, ratios):
        assert abs(np.mean(hits) - 0.95) < 4 * np.std(hits) / math.sqrt(len(hits))
    rms = lambda a: math.sqrt(np.mean(np.square(a)))
    # at an overlap p of .73 a share has the error sqrt((1 - p) / p / 300) = .035, rows .071
    assert rms(errors) < 0.6 * rms(alone)


def test_a_row_that_is_flagged_takes_no_part():
    rng = np.random.default_rng(0)
    found = [row(rng, i, 300) for i in range(4)]
    found[1] = found[1]._replace(reliable=False)
    curve, ratios, _ = join_rows(keys(4), MADE[:4], found)
    assert np.isnan(curve[1]).all() and np.isfinite(np.delete(curve, 1, 0)).all()
    assert np.isnan(ratios[:2]).all() and np.isfinite(ratios[2]).all()
    for none in (None, 3, found[0]._replace(draws=None), found[1]):
        assert join_rows(keys(2), MADE[:2], [found[0], none]) == (None, None, {})
    assert join_rows(keys(1), MADE[:1], found[:1]) == (None, None, {})
    dear = found[0]._replace(settings=dict(budget=10_000))
    assert join_rows(keys(2), MADE[:2], [dear, dear]) == (None, None, {})


def test_rows_without_common_failures_stand_alone():
    rng = np.random.default_rng(0)
    a, b = row(rng, 0, 300, sides=(1,)), row(rng, 1, 300, sides=(-1,))
    apart = [walk(3.0), walk(9.0)]
    curve, ratios, _ = join_rows(keys(2), apart, [a, b])
    assert np.isnan(curve).all() and ratios[0, 0] == pytest.approx(b.mean / a.mean)


def test_a_row_that_misses_a_failure_mode_is_named():
    """Half of the probability of row 2 is missing, with its failures: its neighbours know."""
    rng = np.random.default_rng(0)
    found = [row(rng, i, 2000, error=0.02) for i in range(5)]
    lost = row(rng, 2, 2000, error=0.02, sides=(1,))
    found[2] = lost._replace(log_mean=lost.log_mean - math.log(2))
    *curve_and_ratios, said = join_rows(keys(5), MADE[:5], found)
    assert said["apart"] == [1, 2]
    assert "apart" not in join_rows(keys(5), MADE[:5], [row(rng, i, 2000) for i in range(5)])[2]
    none = (None,) * 5
    table = Sweep({"limit": tuple(LIMITS[:5])}, (1,) * 5, none, none, said, *curve_and_ratios)
    assert str(table).splitlines()[-2:] == [
        "rows 1 and 2: their failures say another ratio",
        "rows 2 and 3: their failures say another ratio",
    ]


def test_a_sweep_is_joined_wherever_its_rows_run(key, tmp_path, equal):
    """Of ten steps, at 1e-3 to 3e-4: the errors of all rows and ratios are below 4.5 standard
    errors.
    """
    limits = (10.0, 10.5, 11.0)
    go = lambda **how: jast.sweep(
        key, lambda limit: walk(limit, 10), {"limit": limits}, budget=300_000, **how
    )
    table = go()
    assert table.reliable.all() and np.isfinite(table.curve).all()
    assert table.settings["programs"] == 1 and "apart" not in table.settings
    truth, own = log_truth(limits, 10), np.array([r.log_mean for r in table.results])
    assert (np.log(table.probability) != own).all()
    np.testing.assert_array_equal(table.curve[:, 0], table.probability)
    check_rows(np.column_stack([table.probability, table.interval]), truth)
    half = np.diff(np.log(table.interval), axis=1)[:, 0] / 2
    assert (half < [1.96 * r.relative_error for r in table.results]).all()
    check_rows(table.ratios, np.diff(truth))
    assert table.episodes == sum(r.episodes for r in table.results) + table.settings["judged"]
    at = table.crossing(math.exp(truth[1]))
    assert at.interval[0] < 10.5 < at.interval[1]
    assert f"{table.probability[0]:.4g}" in str(table)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        for other in (
            go(executor=pool),
            go(checkpoint=tmp_path / "a"),
            go(checkpoint=tmp_path / "a"),
        ):
            equal(other.curve, table.curve)
            equal(other.ratios, table.ratios)
    jast.save(tmp_path / "table.jast", table)
    again = jast.load(tmp_path / "table.jast")
    assert str(again) == str(table)
    equal(again.ratios, table.ratios)


@pytest.mark.slow
def test_rows_by_plain_draws_take_part(key):
    """.05 of the first row, which plain draws tell; the third one has .0024, and other ways."""
    limits = (6.2, 7.8, 9.6)
    table = jast.sweep(key, lambda limit: walk(limit, 10), {"limit": limits}, budget=300_000)
    plain = ["plain draws" in r.method for r in table.results]
    assert plain[0] and not plain[2]
    truth = log_truth(limits, 10)
    assert np.isfinite(table.curve).all() and np.isfinite(table.ratios).all()
    check_rows(np.column_stack([table.probability, table.interval]), truth)
    check_rows(table.ratios, np.diff(truth))


@pytest.mark.long
def test_ratios_of_whole_sweeps_are_sharper_and_held():
    """10 sweeps of 8 values at 2e-4 to 1e-5. 70 ratios: fewer than 60 in their intervals has a
    chance of 1 %. The errors of ratios by rows alone are 2.0 times as great (14 keys), and more
    than 1.4 times as great here.
    """
    limits = np.linspace(12.0, 14.0, 8)
    truth = log_truth(limits, 10)
    tables = [
        jast.sweep(
            jax.random.key(i), lambda limit: walk(limit, 10), {"limit": limits}, budget=300_000
        )
        for i in range(10)
    ]
    ratios = np.log([t.ratios for t in tables])
    alone = np.diff([[r.log_mean for r in t.results] for t in tables], axis=1)
    step = np.diff(truth)
    good = np.isfinite(ratios[:, :, 0])
    held = (ratios[:, :, 1] < step) & (step < ratios[:, :, 2])
    assert good.sum() > 60 and held.sum() > good.sum() - 10
    rms = lambda a: math.sqrt(np.mean(np.square(a)))
    assert rms((ratios[:, :, 0] - step)[good]) < rms((alone - step)[good]) / 1.4
