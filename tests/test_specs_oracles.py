"""jast.specs against rtamt and stljax, where they are installed (extra `oracles`)."""

import jax.numpy as jnp
import numpy as np
import pytest

from jast.specs import always, eventually, implies, predicate, robustness, until

X = predicate(lambda s: s["x"] - 0.2, "x > 0.2")
Y = predicate(lambda s: 0.5 - s["y"], "y < 0.5")
FORMULAS = {
    "always[0:3] (x > 0.2)": always(X, 0, 3),
    "always[0:10] eventually[0:5] (x > 0.2)": always(eventually(X, 0, 5), 0, 10),
    "eventually[1:4] always[0:2] (y < 0.5)": eventually(always(Y, 0, 2), 1, 4),
    "always[0:8] ((x > 0.2) implies (eventually[1:3] (y < 0.5)))": always(
        implies(X, eventually(Y, 1, 3)), 0, 8
    ),
    "not ((x > 0.2) and (y < 0.5)) or (eventually[2:9] (x > 0.2))": ~(X & Y) | eventually(X, 2, 9),
}
LENGTHS = 14, 40
"""The shorter one ends within windows, which are clipped there."""


def traces(length):
    return [np.random.default_rng(k).normal(size=(2, length)) for k in range(5)]


def by_rtamt(text, x, y):
    rtamt = pytest.importorskip("rtamt")
    spec = rtamt.StlDiscreteTimeSpecification()
    for name in ("x", "y", "out"):
        spec.declare_var(name, "float")
    spec.spec = f"out = {text}"
    spec.parse()
    samples = dict(time=list(range(len(x))), x=x.tolist(), y=y.tolist())
    return float(spec.evaluate(samples)[0][1])


@pytest.mark.parametrize("text", FORMULAS)
def test_rtamt(text, x64):
    for length in LENGTHS:
        for x, y in traces(length):
            found = robustness(FORMULAS[text], dict(x=jnp.array(x), y=jnp.array(y)), 1.0)
            assert float(found) == pytest.approx(by_rtamt(text, x, y), abs=1e-12)


def test_until_of_rtamt_leaves_the_last_moment_out(x64):
    """There f need not hold at the moment of g: the same as until(f, g), with f asked one sample
    earlier, or g at once.
    """
    for x, y in traces(20):
        trace = dict(x=jnp.array(x), y=jnp.array(y))
        before = dict(x=jnp.array(np.append(np.inf, x[:-1])), y=trace["y"])
        told = by_rtamt("(x > 0.2) until[0:6] (y < 0.5)", x, y)
        assert float(robustness(until(X, Y, 0, 6), before, 1.0)) == pytest.approx(told, abs=1e-12)
        assert float(robustness(until(X, Y, 0, 6), trace, 1.0)) <= told


@pytest.mark.slow
def test_stljax(x64):
    F = pytest.importorskip("stljax.formula")
    p = F.Predicate("x", lambda s: s[..., 0]) > 0.2
    q = F.Predicate("y", lambda s: s[..., 1]) < 0.5
    pairs = [
        (always(X, 0, 3), F.Always(p, interval=[0, 3])),
        (
            always(eventually(X, 0, 5), 0, 10),
            F.Always(F.Eventually(p, interval=[0, 5]), interval=[0, 10]),
        ),
        (
            always(implies(X, eventually(Y, 1, 3)), 0, 8),
            F.Always(F.Implies(p, F.Eventually(q, interval=[1, 3])), interval=[0, 8]),
        ),
        (until(X, Y, 1, 6), F.Until(p, q, interval=[1, 6])),
    ]
    for x, y in traces(20):
        signal = jnp.array(np.stack([x, y], axis=1))
        for ours, theirs in pairs:
            found = robustness(ours, dict(x=signal[:, 0], y=signal[:, 1]), 1.0)
            assert float(found) == pytest.approx(float(theirs.robustness(signal)), abs=1e-12)
