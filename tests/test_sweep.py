"""jast.sweep: one function on many systems, the table that comes of it, and where it crosses a
level.
"""

import concurrent.futures
import dataclasses
import math
import pickle
from statistics import NormalDist

import jax
import numpy as np
import pytest
from jax.tree_util import Partial
from reports import estimate
from scipy.stats import beta, expon, gamma, lognorm, norm, t
from systems import above

import jast
from jast._src.core.nominal import Nominal
from jast._src.estimate.tilts.fit import as_tilts, of_tilts
from jast._src.estimate.tilts.tilts import Tilts
from jast._src.sweeping.simulators import count_kinds, make_simulators
from jast._src.util.intervals import clopper_pearson
from jast.estimate import failure_probability
from jast.sweeping import Sweep

LIMITS = (0.5, 1.0, 1.5, 2.0)


def make(limit, horizon=1):
    return above(limit, horizon)


def crude(key, limits=LIMITS, simulators=make, **how):
    return jast.sweep(key, simulators, {"limit": limits}, jast.nominal, episodes=200, **how)


def test_a_row_is_the_call_with_its_key(key, equal):
    table = crude(key)
    assert table.settings["programs"] == 1 and table.errors == (None,) * 4
    for i, limit in enumerate(LIMITS):
        own = jax.random.fold_in(key, i)
        equal(table.results[i][:7], jast.nominal(own, table.simulators[i], episodes=200)[:7])
        # the same as of the simulator that a user would build
        alone = jast.nominal(own, make(limit), episodes=200)
        assert alone.failing == table.results[i].failing
    np.testing.assert_array_equal(table.probability, [r.rate for r in table.results])
    assert table.episodes == 800 and table.reliable.all()
    assert table.values == {"limit": LIMITS}


def test_one_program_serves_all_values_and_the_next_sweep(key, monkeypatch):
    crude(key)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compiled.append(name) if "backend_compile" in name else None
    )
    try:
        crude(key, np.linspace(0.3, 0.9, 5))
        assert not compiled
        jast.nominal(key, make(0.5), episodes=200)
        assert compiled  # the listener hears
    finally:
        jax.monitoring.clear_event_listeners()


def branches(limit):
    return make(0.5 if limit < 1 else limit)


def horizons(limit):
    return make(limit, horizon=1 if limit < 1 else 2)


def of_words(limit):
    return make({"low": 0.5, "high": 1.5}[limit])


@pytest.mark.parametrize(
    "of, limits, n",
    [
        (make, LIMITS, 1),
        (make, (1, 2), 1),
        (branches, LIMITS, 4),
        (horizons, LIMITS, 4),
        (of_words, ("low", "high"), 2),
    ],
)
def test_what_cannot_be_traced_compiles_apart(of, limits, n):
    made = make_simulators(of, [{"limit": v} for v in limits])
    assert count_kinds(made) == n


def test_values_may_be_lists_of_different_lengths(key):
    table = jast.sweep(key, lambda ws: make(sum(ws)), {"ws": [[0.5, 0.5], [1.0]]}, jast.nominal)
    assert table.results[0].rate > 0 and table.values == {"ws": ([0.5, 0.5], [1.0])}


def test_simulators_of_one_kind_are_taken_as_they_are():
    sims = [jast.simulators.walk1d(threshold=v) for v in (3.0, 4.0)]
    assert all(a is b for a, b in zip(make_simulators(sims, [{}, {}]), sims))
    assert count_kinds(sims) == 1
    shared = lambda limit: jast.simulators.walk1d(threshold=limit)
    made = make_simulators(shared, [{"limit": 3.0}, {"limit": 4.0}])
    assert made[0].evaluate.func is sims[0].evaluate.func


def test_a_row_that_raises_does_not_lose_the_others(key):
    def fragile(limit):
        if limit is None:
            raise RuntimeError("no such limit")
        return "no simulator" if limit == "text" else make(limit)

    table = crude(key, [0.5, None, "text"], fragile)
    assert [e is None for e in table.errors] == [True, False, False]
    assert "no such limit" in table.errors[1] and "received str" in table.errors[2]
    assert table.simulators[1] is None and np.isnan(table.probability[1:]).all()
    text = str(table)
    assert "RuntimeError: no such limit" in text and text.splitlines()[0].split()[-1] == "note"
    with pytest.raises(RuntimeError, match="no such limit"):  # as no row has a result
        crude(key, [None, None], fragile)


def test_a_row_of_nan_is_one_row(key):
    with pytest.warns(UserWarning, match="invalid"):
        table = crude(key, (0.5, math.nan))
    assert table.results[1].failing == 0 or table.results[1].invalid
    assert table.results[0].failing > 0
    searched = jast.sweep(key, make, {"limit": [math.nan]}, jast.search.monte_carlo, episodes=50)
    estimated = jast.sweep(key, make, {"limit": [math.nan, 0.5]}, budget=60)
    assert "all 50 episodes are invalid" in str(searched)
    assert str(estimated).count("episodes are invalid: nothing is known") == 1


def test_a_file_gives_a_sweep_back(key, tmp_path, equal):
    with pytest.warns(UserWarning, match="invalid"):
        table = crude(key, [0.5, math.nan, "text"], lambda limit: make(limit + 0))
    jast.save(tmp_path / "table.jast", table)
    again = jast.load(tmp_path / "table.jast")
    assert str(again) == str(table) and again.settings == table.settings
    assert again.errors == table.errors and again.simulators == (None,) * 3
    equal(again.probability, table.probability)
    equal(again.interval, table.interval)
    jast.save(tmp_path / "at.jast", table_of([1.0, 2.0], [100, 10]).crossing(0.05))
    at = jast.load(tmp_path / "at.jast")
    assert at == table_of([1.0, 2.0], [100, 10]).crossing(0.05)


def test_rows_run_on_an_executor(key, equal):
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        equal(crude(key, executor=pool).interval, crude(key).interval)


def test_an_interruption_keeps_the_rows_that_are_done(key):
    def stop(done, total, _):
        assert total == 4
        if done == 2:
            raise KeyboardInterrupt

    table = crude(key, callback=stop)
    assert len(table.results) == len(table.simulators) == len(table.values["limit"]) == 2
    assert table.settings["interrupted"] == "after 2 of 4 values"
    assert "interrupted after 2 of 4 values" in str(table)

    def never(key, sim):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        jast.sweep(key, make, {"limit": LIMITS}, never)


def test_a_row_that_was_interrupted_is_the_last(key):
    cut = lambda key, sim: jast.nominal(key, sim, 200)._replace(settings={"interrupted": "early"})
    table = jast.sweep(key, make, {"limit": LIMITS}, cut)
    assert len(table.results) == 1


@pytest.mark.slow
def test_results_of_any_kind_have_a_row(key):
    table = jast.sweep(
        key,
        lambda limit, name: make(limit),
        {"limit": [1.0, 1.5], "name": ["a", "b"]},
        jast.search.monte_carlo,
        episodes=256,
        refine=0,
    )
    head, first, _ = str(table).splitlines()
    assert head.split() == ["limit", "name", "best", "log", "p", "fails", "episodes"]
    assert first.split()[:2] == ["1", "a"] and first.split()[-2:] == ["yes", "256"]
    assert "3" in str(jast.sweep(key, make, {"limit": [1.0]}, lambda key, sim: 3))
    with pytest.raises(ValueError, match="plot.sweep: table must hold at least one probability"):
        table.plot()


def table_of(xs, counts, n=1000, **more):
    """A table of so many failures in ``n`` episodes at each value."""
    found = tuple(
        Nominal(None, k, n, k / n, clopper_pearson(k, n), 0.0, 0, None, {}) for k in counts
    )
    none = (None,) * len(counts)
    return Sweep({"gain": tuple(xs), **more}, found, none, none, {})


def test_a_setting_may_be_called_as_a_column():
    table = table_of([1.0, 2.0], [100, 0], interval=(5, 6), note=("a", "b"))
    lines = str(table).splitlines()
    names = ["gain", "interval", "note", "probability", "interval", "episodes", "note"]
    assert lines[0].split() == names
    assert lines[1].split()[:4] == ["1", "5", "a", "0.1"] and lines[2].endswith("UNRELIABLE")


def test_a_flagged_row_shows_what_plain_draws_guarantee_and_the_doubtful_number_behind():
    good = estimate(unseen=None, plain=(0, 0, 1000))
    bad = good._replace(reliable=False, warnings=("no",), plain=(0, 0, 1_000_000))
    bare, none = bad._replace(plain=None), (None,) * 3
    head, *rows = str(Sweep({"gain": (1, 2, 3)}, (good, bad, bare), none, none, {})).splitlines()
    names = ["gain", "probability", "interval", "episodes", "doubtful", "note"]
    assert head.split() == names
    assert rows[0].split() == ["1", "1e-05", "[8e-06,", "2e-05]", "999"]
    assert rows[1].split("  ")[-1].endswith("UNRELIABLE: no")
    assert "  0 of 1000000 fail  [0, 3.689e-06]" in rows[1] and "     1e-05  UNREL" in rows[1]
    assert rows[2].split() == ["3", "1e-05", "[8e-06,", "2e-05]", "999", "UNRELIABLE:", "no"]


def test_the_crossing_of_a_straight_line_and_its_interval():
    """Of two rows of .1 and .001: .01 is crossed where a straight normal score is that of .01, and
    the interval goes to where the rows' own do by the logs on one side, by the scores on the other.
    """
    n, level = 10**6, 0.01
    table = table_of([2.0, 0.0], [1000, 100_000], n)
    found = table.crossing(level)
    assert found.name == "gain" and found.level == level
    score = norm.ppf([0.1, 0.001]) - norm.ppf(level)
    assert found.value == pytest.approx(2 * score[0] / (score[0] - score[1]), abs=1e-12)
    ends = np.array([clopper_pearson(k, n) for k in (100_000, 1000)])
    for i, scale in enumerate((np.log, norm.ppf)):
        a, b = scale(ends[:, i]) - scale(level)
        assert found.interval[i] == pytest.approx(2 * a / (a - b), abs=1e-9)
    assert "gain 1.15" in str(found) and "[0.9" in str(found)


@pytest.mark.parametrize("rows", [4, 7, 13])
@pytest.mark.parametrize("tail", [norm(), gamma(5), expon(), beta(2, 8), t(4), lognorm(0.5)])
def test_the_interval_of_a_crossing_holds_the_bend_of_the_curve_between_rows(tail, rows):
    """Rows that hardly err, from a probability of .3 to one of 1e-6, of tails that bend in either
    way: wherever the level lies between the first and the last gap.
    """
    x, n = np.linspace(*tail.isf([0.3, 1e-6]), rows), 10**9
    table = table_of(x, np.rint(n * tail.sf(x)).astype(int), n)
    for truth in np.linspace(x[1], x[-2], 12):
        found = table.crossing(float(tail.sf(truth)))
        assert found.interval[0] <= truth <= found.interval[1]
        assert found.interval[0] < found.value < found.interval[1]


def test_of_a_normal_system_the_crossing_is_exact_between_any_rows():
    """Within what rounding to whole failures of 10^12 episodes leaves."""
    x, n = np.array([2.0, 3.0, 4.0]), 10**12
    table = table_of(x, np.rint(n * norm.sf(x)).astype(int), n)
    assert table.crossing(float(norm.sf(3.5))).value == pytest.approx(3.5, abs=1e-6)
    assert table.crossing(float(norm.sf(2.5))).value == pytest.approx(2.5, abs=1e-6)
    at = table.crossing(table.probability[1])  # the level of a row
    assert at.value == pytest.approx(3.0) and np.ptp(at.interval) < 0.01


def test_a_crossing_is_covered_as_often_as_the_rows_are():
    """Binomial rows about p = exp(-3 - x): the interval of the crossing of exp(-4.5) holds 1.5 in
    95 % of 150 tables, less 3 standard errors of 1.8 %, and Clopper and Pearson's are wider.
    """
    rng, x = np.random.default_rng(0), np.arange(4.0)
    hits = 0
    for _ in range(150):
        found = table_of(x, rng.binomial(3000, np.exp(-3 - x)), 3000).crossing(math.exp(-4.5))
        hits += found.interval[0] <= 1.5 <= found.interval[1]
    assert hits / 150 > 0.95 - 3 * 0.018


def test_where_there_is_no_crossing_the_error_says_why():
    table = table_of([0.0, 1.0, 2.0], [100, 10, 0])
    with pytest.raises(
        ValueError, match="does not cross 1e-06: for gain from 0 to 1 .* 0.01 and 0"
    ):
        table.crossing()
    with pytest.raises(ValueError, match="level must be a number between 0 and 1, received 1"):
        table.crossing(1)
    with pytest.raises(ValueError, match="two rows with a reliable probability, received 1 of 2"):
        table_of([0.0, 1.0], [100, 0]).crossing(0.05)
    many = table_of([0.0, 1.0, 2.0, 3.0], [900, 10, 900, 10])
    with pytest.raises(ValueError, match="crosses 0.1 at several values of gain: 0.71"):
        many.crossing(0.1)
    # within the noise of the rows it is one crossing
    one = table_of([0.0, 1.0, 2.0, 3.0], [200, 101, 99, 20]).crossing(0.1)
    assert 1 < one.value < 2
    noisy = table_of([0.0, 1.0, 2.0, 3.0], [120, 98, 103, 80]).crossing(0.1)
    assert 0.5 < noisy.value < 2.5
    assert noisy.interval[0] < 1
    assert noisy.interval[1] > 2
    assert math.isinf(table_of([0.0, 1.0], [11, 9]).crossing(0.01).interval[0])


def test_the_setting_must_be_numbers():
    named = table_of([1.0, 1.0], [100, 10], name=("a", "b"), other=(1, 2))
    assert named.crossing(0.05).name == "other"
    for against in ("name", "none"):
        with pytest.raises(ValueError, match=r"one of \['gain', 'other'\], received '" + against):
            named.crossing(0.05, against)
    both = table_of([1.0, 2.0], [100, 10], other=(1, 2))
    with pytest.raises(ValueError, match="crossing: against must name a setting"):
        both.crossing(0.05)
    assert both.crossing(0.05, "other").value == pytest.approx(both.crossing(0.05, "gain").value)


BAD = {
    'values must be a dict of name -> values, such as {"gain"': dict(values=[1.0, 2.0]),
    "values must be a dict of name -> values, .*received {}": dict(values={}),
    "limit must be a sequence of values, received 'text'": dict(values={"limit": "text"}),
    "limit must be a sequence of values, received 3": dict(values={"limit": 3}),
    r"limit must be a sequence of values, received \{4\}": dict(values={"limit": {4}}),
    r"equally many for each setting, at least 1, received {'limit': 2, 'other': 1}": dict(
        values={"limit": [1, 2], "other": [1]}
    ),
    r"equally many for each setting, at least 1, received {'limit': 0}": dict(values={"limit": []}),
    "must be 2, one for each value, received 1": dict(simulators=[make(1.0)]),
    "one for each value, received Simulator": dict(simulators=make(1.0)),
    "one for each value, received int": dict(simulators=3),
    "function must be callable, received 3": dict(function=3),
    "executor must have submit": dict(executor=3),
    "checkpoint must be the path of a folder, received 3": dict(checkpoint=3),
    "key must be a jax.random.key": dict(key=3),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_named(message, key):
    asked = dict(key=key, simulators=make, values={"limit": [1.0, 2.0]}) | BAD[message]
    with pytest.raises(ValueError, match=f"sweep: .*{message}"):
        jast.sweep(**asked)


def test_the_picture(key):
    table = table_of([0.0, 1.0, 2.0, 3.0], [300, 100, 30, 0])
    ax = table.plot(level=0.05, truth=lambda x: 0.3 * np.exp(-1.1 * x))
    labels = [t.get_text() for t in ax.get_legend().get_texts()]
    assert labels[0] == "probability"
    assert "no failure seen: below" in labels
    assert "truth" in labels
    assert ax.get_yscale() == "log" and ax.get_xlabel() == "gain"
    with pytest.raises(ValueError, match="plot.sweep: table must be a Sweep, received int"):
        jast.plot.sweep(3)


def test_partials_of_make_are_equal_in_other_sweeps_and_processes():
    rows = [{"limit": v} for v in LIMITS]
    a, b = make_simulators(make, rows), make_simulators(make, rows[:2])
    assert jax.tree.structure(a[0]) == jax.tree.structure(b[1])
    assert isinstance(a[0].step, Partial)
    sent = pickle.loads(pickle.dumps(a[0]))  # as to another process
    assert jax.tree.structure(sent) == jax.tree.structure(a[0])


# --- each row from the one before
# ----------------------------------------------------------------------------


def after_five(limit):
    """The sum of five steps is above ``limit`` at the end: Phi(-limit / sqrt(5))."""
    return above(limit, 5, episodic=True)


def test_a_row_that_follows_is_the_call_with_its_neighbour(key, equal):
    limits = [8.0, 8.3, 14.0]
    table = jast.sweep(key, after_five, {"limit": limits}, budget=5000)
    assert table.settings["follow"] is True and table.settings["programs"] == 1
    for i, limit in enumerate(limits):
        own = jax.random.fold_in(key, i)
        near = table.results[i - 1] if i else None
        alone = failure_probability(own, table.simulators[i], 5000, near=near)
        assert alone.log_mean == table.results[i].log_mean
        assert alone.history == table.results[i].history
        truth = NormalDist().cdf(-limit / math.sqrt(5))
        error = 4 * table.results[i].relative_error * truth  # 4 standard errors
        assert table.probability[i] == pytest.approx(truth, abs=error)
    first, near, far = (" ".join(r.history) for r in table.results)
    assert "proposal of a similar system" not in first and "cooling" in first
    assert "proposal of a similar system" in near and "cooling" not in near
    assert "proposal of a similar system" in far
    # where the neighbour's proposal does not lead to failures, the search is as ever
    away = failure_probability(
        key, after_five(0.5), 5000, near=table.results[2]._replace(proposal=opposite(table))
    )
    assert "cooling" in " ".join(away.history)
    equal(
        failure_probability(key, make(2.0), 5000, near=table.results[0]).interval,
        failure_probability(key, make(2.0), 5000).interval,  # of another system: changes nothing
    )
    with pytest.raises(ValueError, match="failure_probability: near must be an Estimate, received"):
        failure_probability(key, after_five(8.0), 5000, near=3)


def opposite(table):
    """The proposal of the last row, on the other side."""
    q = table.results[2].proposal
    return q._replace(means=-q.means)


def test_an_executor_that_is_shut_down_leaves_the_rows_that_are_done(key):
    pool = concurrent.futures.ThreadPoolExecutor(1)
    close = lambda *_: pool.shutdown(wait=False, cancel_futures=True)
    table = crude(key, np.linspace(0.3, 1.5, 40), executor=pool, callback=close)
    assert 0 < len(table.results) < 40 and None not in table.results
    assert "the executor takes no more work" in table.settings["interrupted"]


def test_rows_of_an_executor_do_not_follow(key):
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        with pytest.raises(ValueError, match="follow must be False with an executor"):
            crude(key, executor=pool, follow=True)


def test_each_row_has_a_checkpoint_of_its_own(key, tmp_path):
    given = lambda key, sim, checkpoint: str(checkpoint)
    table = jast.sweep(key, make, {"limit": [1.0, 2.0]}, given, checkpoint=tmp_path)
    assert table.results == (str(tmp_path / "row-0"), str(tmp_path / "row-1"))


CALLS = []


def counted(key, sim):
    CALLS.append(sim.horizon)
    if sim.horizon == 2:
        raise RuntimeError("too short")
    return jast.nominal(key, sim, episodes=200)


@pytest.mark.parametrize("where", ["here", "elsewhere"])
def test_rows_that_are_done_are_not_done_again(key, where, tmp_path, equal):
    def stop(done, total, _):
        if done == 2:
            raise KeyboardInterrupt

    sims = [jast.simulators.walk1d(threshold=v) for v in (2.0, 3.0, 4.0)]
    sims, values = [*sims, jast.simulators.walk1d(horizon=2)], {"row": range(4)}
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        how = dict(executor=pool if where == "elsewhere" else None)
        go = lambda **more: jast.sweep(key, sims, values, counted, **how, **more)
        alone = go()
        part = go(checkpoint=tmp_path, callback=stop)
        assert len(part.results) == 2 and part.settings["interrupted"] == "after 2 of 4 values"
        CALLS.clear()
        whole = go(checkpoint=tmp_path)
        assert len(CALLS) <= 2
        CALLS.clear()
        again = go(checkpoint=tmp_path)
        assert CALLS == [2]  # the row that raised
    for table in (whole, again):
        assert str(table) == str(alone) and table.settings == alone.settings
        for a, b in zip(table.results, alone.results):
            equal(a and a[:7], b and b[:7])
        assert table.errors == (None, None, None, "RuntimeError: too short")
    with pytest.raises(ValueError, match="sweep: checkpoint .* another call: values.row.0 is"):
        jast.sweep(key, sims, {"row": range(1, 5)}, counted, checkpoint=tmp_path)


@pytest.mark.slow
def test_a_row_that_follows_is_the_same_from_a_checkpoint(key, tmp_path):
    go = lambda **how: jast.sweep(key, after_five, {"limit": [8.0, 8.3]}, budget=5000, **how)

    def stop(*_):
        raise KeyboardInterrupt

    assert len(go(checkpoint=tmp_path, callback=stop).results) == 1
    table, alone = go(checkpoint=tmp_path), go()
    assert "proposal of a similar system" in " ".join(table.results[1].history)
    for a, b in zip(table.results, alone.results):
        assert repr(tuple(a)) == repr(tuple(b))


def test_what_no_file_holds_cannot_be_kept(key, tmp_path):
    with pytest.raises(ValueError, match="save: result must be an array, a number or a text"):
        jast.sweep(key, make, {"limit": [1.0]}, lambda key, sim: object(), checkpoint=tmp_path)


class Dying:
    """An executor whose process dies at the second row."""

    def __init__(self):
        self.pool = concurrent.futures.ThreadPoolExecutor(1)

    def submit(self, function, *args):
        if args[-1] == 1:
            return self.pool.submit(lambda: 1 / 0)
        return self.pool.submit(function, *args)


def test_a_row_whose_process_dies_has_an_error(key):
    table = crude(key, executor=Dying())
    assert [e is None for e in table.errors] == [True, False, True, True]
    assert "failed in every attempt" in table.errors[1]


def test_follow_skips_rows_that_raise(key):
    seen = []

    def function(key, sim, near=None):
        seen.append(near)
        if len(seen) == 2:
            raise RuntimeError("once")
        return len(seen)

    table = jast.sweep(key, make, {"limit": LIMITS}, function, follow=True)
    assert seen == [None, 1, 1, 3] and table.results == (1, None, 3, 4)


@pytest.mark.long
def test_tilts_go_on_from_those_of_a_neighbour(key):
    """Systems of 40 steps, whose proposals are tilts: Phi(-limit / sqrt(40)), within 4 standard
    errors.
    """

    def long(limit):
        sim = after_five(limit)
        return dataclasses.replace(sim, horizon=40)

    limits = (24.0, 24.5, 25.0)
    table = jast.sweep(key, long, {"limit": limits}, budget=20_000)
    for limit, result in zip(limits, table.results):
        assert isinstance(result.proposal, Tilts)
        truth = NormalDist().cdf(-limit / math.sqrt(40))
        assert result.mean == pytest.approx(truth, abs=4 * result.relative_error * truth)
    sought = [sum("tilts: level" in line for line in r.history) for r in table.results]
    assert sought[0] > 0 == sought[1] == sought[2]
    tilts, weights, frame = of_tilts(table.results[0].proposal)
    again = as_tilts(tilts, weights, frame, len(table.results[0].proposal.floors), np.float32)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), again, table.results[0].proposal
    )
