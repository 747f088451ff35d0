"""The problems of benchmarks/structural.py and benchmarks/literature.py: what they compute, and
their truths against plain draws.
"""

import jax
import numpy as np
import pytest

from benchmarks.literature import CASES, collision_avoidance, table
from benchmarks.structural import PROBLEMS
from jast._src.normal_space.evaluate_points import evaluate_points

DRAWS = 20_000


@pytest.mark.long
@pytest.mark.parametrize("name", PROBLEMS)
def test_a_truth_is_within_the_error_of_plain_draws(name):
    """Of 400,000 draws within 4.5 standard errors, for the problems that fail often enough."""
    problem = PROBLEMS[name]
    n = 400_000 if problem.dimension < 50 else 20_000
    if problem.truth * n < 50:
        pytest.skip("fails too rarely to be counted")
    rng, failing = np.random.default_rng(0), 0
    for _ in range(n // DRAWS):
        failing += (problem.batch(rng.standard_normal((DRAWS, problem.dimension))) < 0).sum()
    expected = n * problem.truth
    assert abs(failing - expected) < 4.5 * np.sqrt(expected * (1 - problem.truth))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["RP14", "RP60", "RP110"])
def test_a_simulator_fails_where_the_problem_does(name):
    """Its distributions are those of SciPy, its limit state that of NumPy, but for rounding."""
    problem = PROBLEMS[name]
    z = 2 * np.random.default_rng(1).standard_normal((2000, problem.dimension))
    failure = evaluate_points(problem.simulator(), z.astype(np.float32)).failure
    g = problem.batch(z.astype(np.float32))
    sure = np.abs(g) > 1e-3 * np.abs(g).mean()
    assert np.array_equal(failure[sure], g[sure] < 0)
    assert 0 < failure.mean() < 1


def test_references():
    """What the benchmark's authors publish, or print in other digits than these."""
    known = {"RP22": 4.2073e-3, "RP25": 4.1486e-5, "RP31": 3.2267e-3, "RP35": 3.4789e-3}
    for name, p in known.items():
        assert PROBLEMS[name].truth == pytest.approx(p, rel=2e-4)


def test_values_of_the_avoidance_system():
    """At the closest point being near costs 100 and a change of the action 1; a second before, what
    the rate makes of the altitude.
    """
    q, level = table(), 10
    near = np.arange(8, 13)
    assert np.array_equal(np.flatnonzero(q[1, 0, 1, level] == -100), near)
    assert (q[0, :, 1] <= q[0, :, 0]).all() and (q.max(axis=0) <= 0).all()
    assert np.allclose(q[1, 2, 1, level, 7:9], [-2.5, -97.5])
    assert np.allclose(q[1, 3, 1, level, 6:9], [-0.25, -5.25, -91.71875])


def test_an_encounter_that_nobody_avoids(key):
    """Far away and level the system does nothing; near and level it climbs or descends."""
    sim = collision_avoidance()
    step = jax.jit(sim.step)
    far = sim.init((190.0, 0.0))
    assert int(step(far, 0.0).action) == 1 and float(step(far, 0.0).altitude) == 190.0
    near = sim.init((10.0, 0.0))._replace(time=np.int32(15))
    assert int(step(near, 0.0).action) != 1


@pytest.mark.parametrize("name", ["simple Gaussian", "half-planes", "squares", "Himmelblau"])
def test_a_truth_of_the_literature(name):
    published = [0.02275, 3.644e-6, 5.519e-4, 0.09736]
    known = dict(zip(("simple Gaussian", "half-planes", "squares", "Himmelblau"), published))
    assert CASES[name][1] == pytest.approx(known[name], rel=2e-4)
