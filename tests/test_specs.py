"""jast.specs: robustness against brute force, windows, gradients, which part broke, bad input."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.tree_util import Partial

from jast._src.specs.formulas import Implies, Junction, Not, Predicate, Temporal, Until, predicates
from jast._src.specs.monitor import begin, push
from jast._src.specs.robustness import fits
from jast.specs import always, eventually, implies, parts, predicate, robustness, until

T = 7
X = predicate(lambda s: s["x"], "x > 0")
Y = predicate(lambda s: s["y"], "y > 0")


def brute(f, margins, t=0, sign=1, unknown=False, total=None):
    """The definitions, read off: samples one second apart. Beyond the samples there is nothing, and
    windows are clipped; or, ``unknown``, the best for ``sign``, up to ``total`` samples.
    """
    end = len(margins["x"]) - 1
    ask = lambda f, t, sign=sign: brute(f, margins, t, sign, unknown, total)
    if t > end:  # asked only where unknown
        return sign * math.inf
    if isinstance(f, Predicate):
        return margins[f.name[0]][t]
    if isinstance(f, Not):
        return -ask(f.of, t, -sign)
    if isinstance(f, Implies):
        return max(-ask(f.left, t, -sign), ask(f.right, t))
    if isinstance(f, Junction):
        return (min if f.kind == "&" else max)(ask(p, t) for p in f.parts)
    last = end if not unknown else end + 5 if total is None else total - 1
    window = range(t + int(f.a), min(last, last if f.b is None else t + int(f.b)) + 1)
    if isinstance(f, Temporal):
        op, none = (min, math.inf) if f.kind == "always" else (max, -math.inf)
        return op((ask(f.of, s) for s in window), default=none)
    assert isinstance(f, Until)
    left = lambda s: min(ask(f.left, r) for r in range(t, s + 1))
    return max((min(ask(f.right, s), left(s)) for s in window), default=-math.inf)


@st.composite
def formulas(draw, depth=3):
    kind = draw(st.sampled_from(["p", "~", "&", "|", "implies", "always", "eventually", "until"]))
    if depth == 0 or kind == "p":
        return draw(st.sampled_from([X, Y]))
    one = lambda: draw(formulas(depth=depth - 1))
    if kind in "~&|":
        return {"~": lambda: ~one(), "&": lambda: one() & one(), "|": lambda: one() | one()}[kind]()
    if kind == "implies":
        return implies(one(), one())
    a = draw(st.integers(0, 2))
    b = draw(st.one_of(st.none(), st.integers(a, 4)))
    if kind == "until":
        return until(one(), one(), a, b)
    return {"always": always, "eventually": eventually}[kind](one(), a, b)


traces = st.lists(st.floats(-4, 4, width=16), min_size=2 * T, max_size=2 * T).map(
    lambda v: {"x": np.array(v[:T], np.float32), "y": np.array(v[T:], np.float32)}
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(formulas(), traces)
def test_robustness_is_that_of_brute_force(f, trace):
    with jax.disable_jit():
        assert float(robustness(f, trace, 1.0, goes_on=True)) == brute(f, trace, unknown=True)
        try:
            found = float(robustness(f, trace, 1.0))
        except ValueError as e:
            assert "its window begins after the trace's end" in str(e)
            return
    assert found == brute(f, trace)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(formulas(), traces, st.sampled_from([1, 2, 3]))
def test_the_monitor_knows_the_bound_of_brute_force(f, trace, block):
    """After each block of samples; the bound never rises, and ends in the robustness."""
    try:
        fits("test", f, T, 1.0)
    except ValueError:
        return
    with jax.disable_jit():
        memory, n, before = begin(f, 1.0, T, jnp.float32), 0, math.inf
        while n < T:
            news = tuple(jnp.asarray(trace[p.name[0]][n : n + block]) for p in predicates(f))
            start, n = jnp.asarray(n, jnp.int32), n + len(news[0])
            memory, bound = push(f, memory, news, start, jnp.asarray(n < T), 1.0, T)
            seen = {k: v[:n] for k, v in trace.items()}
            assert float(bound) == brute(f, seen, unknown=n < T, total=T)
            assert float(bound) <= before
            before = float(bound)
    assert before == brute(f, trace)


SAMPLES = np.array([3.0, -1.0, 2.0, 5.0, 0.5, 1.0, 4.0])
TRACE = {"x": SAMPLES, "y": SAMPLES[::-1].copy()}
FORMULAS = {
    "always": always(X, 1, 4),
    "nested": always(eventually(X & Y, 0, 2), 0, 4),
    "until": until(X, Y, 1, 5),
    "response": always(implies(X, eventually(~Y, 0, 1))),
}


@pytest.mark.parametrize("name", FORMULAS)
def test_both_precisions(name, dtype):
    trace = {k: jnp.asarray(v, dtype) for k, v in TRACE.items()}
    found = robustness(FORMULAS[name], trace, 1.0)
    assert found.dtype == dtype and float(found) == brute(FORMULAS[name], TRACE)


@pytest.mark.parametrize("name", FORMULAS)
def test_the_gradient_is_that_of_the_sample_that_decides(name, x64):
    f, trace = FORMULAS[name], jax.tree.map(jnp.asarray, TRACE)
    slope = jax.grad(lambda t: robustness(f, t, 1.0))(trace)
    for k in trace:
        for i in range(T):
            moved = [trace | {k: trace[k].at[i].add(h)} for h in (1e-4, -1e-4)]
            up, down = (float(robustness(f, t, 1.0)) for t in moved)
            assert float(slope[k][i]) == pytest.approx((up - down) / 2e-4, abs=1e-6)


@pytest.mark.parametrize("name", FORMULAS)
def test_the_smooth_version_comes_near_and_is_smooth(name, x64):
    f, trace = FORMULAS[name], jax.tree.map(jnp.asarray, TRACE)
    smooth = lambda t, temperature: robustness(f, t, 1.0, temperature=temperature)
    exact = float(robustness(f, trace, 1.0))
    for temperature in (1.0, 0.1, 0.01):  # at most three levels of at most T numbers each
        away = abs(float(smooth(trace, temperature)) - exact)
        assert away <= 3 * temperature * math.log(2 * T)
    slope = jax.grad(smooth)(trace, 1.0)
    moved = trace | {"x": trace["x"].at[3].add(1e-5)}
    change = (float(smooth(moved, 1.0)) - float(smooth(trace, 1.0))) / 1e-5
    assert float(slope["x"][3]) == pytest.approx(change, abs=1e-4)


@pytest.mark.slow
def test_ties_share_a_gradient_without_nan():
    for f in FORMULAS.values():
        for how in (dict(), dict(temperature=0.1), dict(goes_on=True)):
            flat = {k: jnp.ones(T) for k in TRACE}
            slope = jax.grad(lambda t, f=f, how=how: robustness(f, t, 1.0, **how))(flat)
            assert all(np.isfinite(v).all() for v in slope.values())
    slope = jax.grad(lambda t: robustness(always(X), t, 1.0))(flat)
    assert float(slope["x"].sum()) == pytest.approx(1)


def test_batches_of_traces_and_of_parameters():
    above = lambda level: always(predicate(Partial(lambda c, s: s["x"] - c, level), "x > c"))
    trace = jax.tree.map(jnp.asarray, TRACE)
    levels = jnp.array([0.0, 1.0, 2.0])
    found = jax.vmap(lambda c: robustness(above(c), trace, 1.0))(levels)
    np.testing.assert_allclose(found, -1 - np.array([0, 1, 2]))
    many = {k: jnp.stack([v, 2 * v]) for k, v in trace.items()}
    np.testing.assert_allclose(jax.vmap(lambda t: robustness(always(X), t, 1.0))(many), [-1, -2])


def test_windows_are_seconds_and_both_ends_belong():
    trace = jax.tree.map(jnp.asarray, TRACE)
    for a, b, rows in [(0, 0.3, slice(0, 4)), (0.1, 0.2, slice(1, 3)), (0.25, None, slice(3, 7))]:
        assert float(robustness(always(X, a, b), trace, 0.1)) == SAMPLES[rows].min()
        assert float(robustness(eventually(X, a, b), trace, 0.1)) == SAMPLES[rows].max()


def test_windows_are_those_of_a_dt_from_float32():
    for dt, seconds in [(0.05, 100), (0.1, 50), (0.7, np.int64(700)), (0.3, np.float32(300))]:
        dt, trace = float(np.float32(dt)), {"x": jnp.arange(2001.0)}
        n = round(float(seconds) / dt)
        assert float(robustness(eventually(X, 0, seconds), trace, dt)) == n
        assert float(robustness(always(X, seconds, seconds), trace, dt)) == n


def test_formulas_print_as_they_read():
    near, slow = predicate(lambda s: s["x"], "gap > 5"), predicate(lambda s: s["y"], "slow")
    f = always(implies(near, eventually(slow & ~near, 0, 3)), 0.5) | until(slow, near, 1, 2)
    said = (
        "(always[0.5, end] ((gap > 5) implies (eventually[0, 3] (slow & ~(gap > 5)))))"
        " | (slow until[1, 2] (gap > 5))"
    )
    assert str(f) == repr(f) == said

    def margin(s):
        return s["x"]

    assert (str(predicate(margin)), str(predicate(lambda s: s["x"]))) == ("margin", "predicate")
    assert str(X & Y & X) == "(x > 0) & (y > 0) & (x > 0)"


def test_which_part_broke_and_when():
    found = parts(always(implies(Y, X & always(Y, 0, 1)), 0, 2), TRACE, 0.5)
    by_name = {str(p.formula): p for p in found.rows}
    assert len(found.rows) == 7 and found.rows[0].value == -1
    assert (by_name["x > 0"].time, by_name["x > 0"].value) == (0.5, -1.0)
    assert by_name["x > 0"].decides and not by_name["x > 0"].held
    assert not by_name["always[0, 1] (y > 0)"].decides and by_name["always[0, 1] (y > 0)"].held
    np.testing.assert_array_equal(by_name["x > 0"].values, SAMPLES)
    text = str(found)
    assert "does not" in text
    assert "x > 0" in text
    assert len(text.splitlines()) == 8


def test_a_long_formula_prints_whole():
    f = always(X & ~Y, 0, 1) | always(Y & ~X, 0, 1) | eventually(X & Y, 0, 2) | until(X, Y, 0, 2)
    lines = str(parts(f, TRACE, 1.0)).splitlines()
    words = lambda text: "".join(text.split())
    assert len(str(f)) > 70 and words(str(f)) in words("".join(line[:70] for line in lines))


def test_which_part_decided_an_until():
    rows = parts(until(X, Y, 1, 5), TRACE, 1.0).rows
    # x is below 0 at 1 s: that decides for any later moment of y, and the first is named
    assert [(p.time, p.value) for p in rows] == [(0, -1), (1, -1), (1, 1)]


def test_zero_is_no_violation():
    rows = parts(always(X), {"x": jnp.array([1.0, 0.0]), "y": jnp.ones(2)}, 1.0).rows
    assert [(p.value, p.held) for p in rows] == [(0, True), (0, True)]


def test_the_parts_of_a_beginning():
    seen = {k: v[:2] for k, v in TRACE.items()}
    f = always(X, 0, 4) & eventually(Y, 0, 4)
    rows = parts(f, seen, 1.0, goes_on=True).rows
    assert rows[0].value == rows[2].value == -1 and rows[2].time == 1
    assert rows[3].value == math.inf and math.isnan(rows[4].time)


def test_the_left_part_of_a_beginning_decides_an_until():
    """Y may come true yet, but X broke at 1 s."""
    seen = {"x": jnp.array([1.0, -1.0, 0.5]), "y": jnp.full(3, -3.0)}
    for a in (0, 4):
        rows = parts(until(X, Y, a, 5), seen, 1.0, goes_on=True).rows
        assert [p.value for p in rows[:2]] == [-1, -1] and rows[1].time == 1
        assert rows[1].decides and math.isnan(rows[2].time)


BAD = {
    "beyond": (always(X, 0, 7), r"robustness: always\[0, 7\] \(x > 0\): the window is longer"),
    "late": (
        eventually(always(X, 5), 0, 3),
        r"always\[5, end\] \(x > 0\): .* asks for it up to 3 s",
    ),
    "narrow": (always(X, 0.2, 0.4), r"always\[0.2, 0.4\] \(x > 0\): the window holds no sample"),
    "field": (always(predicate(lambda s: s["z"], "z")), "robustness: z: the predicate raised KeyE"),
    "vector": (predicate(lambda s: s["x"] * jnp.ones(2, s["x"].dtype), "v"), "v: .*received flo"),
    "boolean": (predicate(lambda s: s["x"] > 0, "b"), "b: .*write a > b as a - b, received bool"),
    "text": (predicate(lambda s: "yes", "t"), "t: the predicate must return a float scalar"),
    "nan": (always(predicate(lambda s: jnp.log(s["x"]), "log x")), "log x: .*NaN at 1 s"),
}


@pytest.mark.parametrize("name", BAD)
def test_errors_name_the_part(name):
    formula, said = BAD[name]
    with pytest.raises(ValueError, match=said):
        robustness(Y | formula, jax.tree.map(jnp.asarray, TRACE), 1.0)


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: always(X, 3, 2), r"always \(x > 0\): the window must be .*a=3, b=2"),
        (lambda: eventually(X, -1, 2), r"eventually \(x > 0\): the window must be .*a=-1, b=2"),
        (lambda: until(X, Y, 0, math.inf), r"until \(y > 0\): the window"),
        (lambda: always(lambda s: s), "always: f must be a formula"),
        (lambda: X & 1, "each side must be a formula"),
        (lambda: X and Y, "combine formulas by the operators &"),
        (lambda: predicate(1), "predicate: fn"),
        (lambda: predicate(abs, ""), "predicate: name"),
        (lambda: robustness(X, TRACE, 0), "robustness: dt"),
        (lambda: robustness(X, TRACE, 1.0, temperature=0), "robustness: temperature"),
        (lambda: robustness(X, {"x": np.ones(3), "y": np.ones(2)}, 1.0), "robustness: trace"),
        (lambda: robustness(X, {"x": 1.0, "y": 1.0}, 1.0), "robustness: trace"),
    ],
)
def test_what_is_no_formula_is_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_robustness_of_what_is_no_formula_is_refused():
    for ask in (robustness, parts):
        with pytest.raises(
            ValueError, match="robustness: formula must be a formula, as jast.specs"
        ):
            ask(lambda s: 5.0 - s, jnp.ones(3), 1.0)
