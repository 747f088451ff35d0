"""refine and modes, against closed forms."""

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from benchmarks.stress_systems import CASES, linear
from jast._src.normal_space import transform
from jast._src.normal_space.mode_coordinates import centred
from jast._src.search.refine import refine as refinement
from jast._src.search.refine.modes import modes
from jast.distributions import (
    Exponential,
    Laplace,
    MultivariateNormalDiag,
    Normal,
    Poisson,
    tent,
    where,
)
from jast.failures import collect
from jast.rewards import likelihood
from jast.search import refine


def draws(sim, scale, n=300, seed=0):
    """Failures of wider noise: an archive, ranked by log p relative to the mode."""
    z = scale * np.random.default_rng(seed).standard_normal((n, transform.dimension(sim)))
    e = jax.device_get(transform.episodes(sim, jnp.asarray(z, transform.normal_numbers(sim))))
    return collect(sim, likelihood(sim), e, top=200)


@pytest.mark.parametrize("gradients", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_linear_system_ends_at_the_closed_form(gradients, key):
    sim = linear(10)
    found = draws(sim, 4.0)
    result = refine(key, sim, found, budget=12_000, gradients=gradients)
    best = result.failures.best
    assert float(best.reward) == pytest.approx(-(4.55**2) / 2, abs=0.01 if gradients else 0.1)
    # the disturbances of the optimum are those of the filter's impulse response
    weights = 0.95 ** np.arange(9, -1, -1)
    np.testing.assert_allclose(
        best.disturbances, 4.55 * weights / np.linalg.norm(weights), atol=0.05 if gradients else 0.3
    )
    assert result.episodes <= 12_000
    if gradients:
        assert result.residual[0] < 0.02


def test_what_comes_back_replays_and_is_sorted(key):
    sim = CASES["relay"].make()
    found = draws(sim, 3.0)
    result = refine(key, sim, found, budget=2000)
    rewards = result.failures.episodes.reward
    assert len(rewards) and (np.diff(rewards) <= 0).all()
    for e, origin, gain in zip(result.failures, result.origin, result.gain, strict=True):
        assert bool(jast.replay(sim, e).failure)
        assert gain >= 0
        before = float(found[int(origin)].reward)
        assert float(e.reward) >= before - 1e-3 * abs(before)


def test_on_a_knife_edge_the_replay_counts(key, monkeypatch):
    """Another program may round a failing episode to one that does not fail."""
    sim = linear(10)
    found = draws(sim, 4.0)
    says_no = lambda sim, z: transform.played(sim, z)._replace(failure=np.zeros(len(z), bool))
    monkeypatch.setattr(refinement, "played", says_no)
    result = refine(key, sim, found, budget=200)
    assert len(result.failures) == 1 and result.gain[0] > 0
    assert float(result.failures.best.reward) > float(found.best.reward)


@pytest.mark.slow
def test_slips_of_whole_numbers_are_taken_out(key):
    """No slope leads anywhere: removals alone."""
    sim = CASES["slips"].make()
    result = refine(key, sim, draws(sim, 2.0, n=3000), budget=6000)
    assert float(result.failures.best.reward) == pytest.approx(3 * math.log(0.04 / 0.9), abs=1e-4)


@pytest.mark.long
def test_disturbances_of_other_families(key):
    """An exponential one, whose mode is at the edge: -x is log p less that of the mode."""
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + x,
        disturbance=lambda s: Exponential(1.0),
        evaluate=lambda s: (s >= 12, jnp.maximum(12 - s, 0.0)),
        horizon=4,
    )
    result = refine(key, sim, draws(sim, 2.0), budget=3000)
    assert float(result.failures.best.reward) == pytest.approx(-12, abs=0.01)


@pytest.mark.parametrize("gradients", [pytest.param(True, marks=pytest.mark.long), False])
def test_a_kink_at_the_mode(gradients, key):
    """Of Laplace noise the likeliest failure is one large number, in the step that counts most."""
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: 0.9 * s + x,
        disturbance=lambda s: Laplace(0.0, 1.0),
        evaluate=lambda s: (s >= 12, jnp.maximum(12 - s, 0.0)),
        horizon=8,
    )
    result = refine(key, sim, draws(sim, 3.0), budget=6000, gradients=gradients)
    assert float(result.failures.best.reward) == pytest.approx(-12, abs=0.05)


@pytest.mark.long
def test_a_mode_that_moves_with_the_state(key):
    """A random walk of tents, as of a seed that changes little: the failure is one jump, held."""
    sim = jast.Simulator(
        init=lambda x0: jnp.full(2, 0.5) * jnp.array([1.0, 0.0]),
        step=lambda s, x: jnp.stack([x, s[1] + x]),
        disturbance=lambda s: tent(s[0]),
        evaluate=lambda s: (s[1] >= 5.6, jnp.maximum(5.6 - s[1], 0.0)),
        horizon=8,
    )
    result = refine(key, sim, draws(sim, 1.5), budget=6000)
    # 8 steps of 0.5 + j make 5.6
    assert float(result.failures.best.reward) == pytest.approx(math.log(1 - 0.2), abs=0.005)


@pytest.mark.slow
def test_modes_are_the_origin_of_a_centred_simulator(key):
    """Also one at the end of its support, which moves with the state; it has a slope."""
    sim = jast.Simulator(
        init=lambda x0: jnp.ones(()),
        step=lambda s, x: s + x,
        disturbance=lambda s: where(s > 3, tent(s / 10), Exponential(1 / s)),
        evaluate=lambda s: (s >= 12, jnp.maximum(12 - s, 0.0)),
        horizon=4,
    )
    same = centred(sim)
    drawn = jax.device_get(jax.vmap(partial(jast.rollout, sim=sim))(jax.random.split(key, 20)))
    back = transform.episodes(same, transform.normal_of(same, drawn))
    np.testing.assert_allclose(back.disturbances, drawn.disturbances, rtol=1e-3, atol=1e-5)
    quiet = lambda v: jast.rollout(key, same, transform.policy_of(same, v), likelihood(sim)).reward
    assert float(quiet(jnp.zeros(4))) == pytest.approx(0, abs=1e-5)
    assert np.isfinite(jax.grad(quiet)(jnp.full(4, 0.5))).all()


def test_a_simulator_whose_modes_are_medians_is_centred_already():
    """So its programs serve refinement and estimates alike."""
    lane = linear(3)
    assert centred(lane) == lane
    other = replace(lane, disturbance=lambda y: Exponential(1.0))
    assert centred(other) != other


@pytest.mark.long
def test_a_random_start_is_refined_too(key):
    sim = jast.Simulator(
        init=lambda x0: x0,
        step=lambda s, x: s + x,
        disturbance=lambda s: Normal(0.0, 1.0),
        evaluate=lambda s: (s >= 6, jnp.maximum(6 - s, 0.0)),
        horizon=3,
        start=lambda: Normal(0.0, 1.0),
    )
    best = refine(key, sim, draws(sim, 3.0), budget=4000).failures.best
    assert float(best.reward) == pytest.approx(-(6**2) / 2 / 4, abs=0.01)
    np.testing.assert_allclose([best.x0, *best.disturbances], 1.5, atol=0.05)


def test_gradients_that_are_nan_do_no_harm(key):
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(2),
        step=lambda s, x: s + x,
        disturbance=lambda s: MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2)),
        # the slope of sqrt is NaN at 0 when masked by where
        evaluate=lambda s: (
            s[0] >= 4,
            jnp.where(s[0] < 4, jnp.maximum(4 - s[0], 0) + 0 * jnp.sqrt(s[1] * 0), 0.0),
        ),
        horizon=2,
    )
    result = refine(key, sim, draws(sim, 3.0), budget=4000)
    assert float(result.failures.best.reward) == pytest.approx(-4.0, abs=0.02)
    assert np.isnan(result.residual).all()


def test_nothing_in_nothing_out(key):
    sim = linear(10)
    result = refine(key, sim, draws(sim, 1.0, n=10), budget=100)
    assert len(result.failures) == 0 and "no failure" in str(result)
    assert modes(sim, result.failures) == ()


def test_bad_input_is_named(key):
    sim = linear(10)
    found = draws(sim, 4.0, n=50)
    with pytest.raises(ValueError, match="refine: budget"):
        refine(key, sim, found, budget=10)
    seeds = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s,
        disturbance=lambda s: jast.distributions.seeds(),
        evaluate=lambda s: (s > 1, s),
        horizon=2,
    )
    with pytest.raises(ValueError, match="refine: disturbance: Seeds has no quantile function"):
        refine(key, seeds, found)


@pytest.mark.parametrize("name", [pytest.param("pedestrians", marks=pytest.mark.long), "branches"])
def test_planted_modes_are_recovered(name, key):
    case = CASES[name]
    sim = case.make()
    found = draws(sim, 4.0, n=400)
    result = refine(key, sim, found, budget=10_000)
    kinds = modes(sim, result.failures, found)
    assert len(kinds) == case.modes
    assert sum(m.members for m in kinds) == len(result.failures) + len(found)
    assert sum(m.share for m in kinds) == pytest.approx(1)
    assert float(kinds[0].failure.reward) == pytest.approx(case.optimum, abs=0.01)
    assert len(str(kinds).splitlines()) == case.modes + 1


def test_a_failure_at_another_time_is_of_the_same_mode(key):
    """Four disturbances in a row above a threshold, at any time."""
    sim = CASES["latch"].make()
    archive = []
    for at in (3, 20, 41):
        x = np.zeros(50, jnp.zeros(()).dtype)
        x[at : at + 4] = 2.0
        archive.append(jax.device_get(jast.replay(sim, x)._replace(states=None)))
    found = collect(sim, likelihood(sim), jax.tree.map(lambda *a: np.stack(a), *archive))
    assert len(found) == 3
    assert len(modes(sim, found)) == 1


@pytest.mark.long
def test_results_print_and_save(key, tmp_path):
    sim = linear(10, sides=2)
    found = draws(sim, 4.0)
    result = refine(key, sim, found, budget=1000)
    assert "log p rel." in str(result)
    jast.save(tmp_path / "refined", result)
    again = jast.load(tmp_path / "refined", sim)
    np.testing.assert_array_equal(again.gain, result.gain)
    kinds = modes(sim, result.failures, found)
    jast.save(tmp_path / "modes", kinds)
    assert str(jast.load(tmp_path / "modes")) == str(kinds)


def test_what_are_no_failures_is_refused(key):
    with pytest.raises(
        ValueError, match="refine: failures must be an archive .* received NoneType"
    ):
        refine(key, linear(4), None)
    with pytest.raises(ValueError, match="modes: likeliest must be an archive .* received list"):
        modes(linear(4), [])
    with pytest.raises(ValueError, match="modes: others must be an archive .* received int"):
        modes(linear(4), draws(linear(4), 1.0), 3)


def test_counts_give_up_a_unit_to_one_another(key):
    """Ten units in five steps of Poisson(.3): two each are the likeliest, 5 log(.3^2 / 2) relative
    to none at all; no count can fall alone.
    """
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + x.astype(s.dtype),
        disturbance=lambda s: Poisson(0.3),
        evaluate=lambda s: (s >= 10, jnp.maximum(10.0 - s, 0.0)),
        horizon=5,
    )
    counts = jnp.asarray([[3, 2, 1, 2, 2], [4, 0, 4, 1, 1]], jnp.int32)
    given = jax.vmap(lambda x: jast.replay(sim, x, reward=likelihood(sim)))(counts)
    for i in (0, 1):
        start = jax.tree.map(lambda a, i=i: a[i : i + 1], given._replace(states=None))
        best = refine(key, sim, start, budget=4000).failures.best
        assert list(best.disturbances) == [2, 2, 2, 2, 2]
        assert float(best.reward) == pytest.approx(5 * np.log(0.3**2 / 2), rel=1e-5)
