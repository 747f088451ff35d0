"""jast._src.runtime.device: what programs look like on an accelerator, tried on this CPU."""

import jax
import numpy as np
import pytest

import jast
from jast._src.normal_space import evaluate_points
from jast._src.runtime import device
from jast.simulators import landing, landing_probability


@pytest.fixture
def accelerated(monkeypatch):
    """As if the CPU were an accelerator, for whatever is traced anew."""
    monkeypatch.setattr(device, "on_cpu", lambda: False)
    monkeypatch.setattr(evaluate_points, "on_cpu", lambda: False)
    monkeypatch.setattr(evaluate_points, "ACCELERATED_LANES", 5120)


def test_a_cpu_runs_blocks():
    assert device.block_size(8192) == 128
    assert device.block_size(100) == 100


def test_an_accelerator_runs_all_side_by_side(accelerated):
    assert device.block_size(8192) == 8192


def test_the_default_device_says_what_runs():
    with jax.default_device(jax.devices("cpu")[0]):
        assert device.on_cpu()
    with jax.default_device("cpu"):
        assert device.on_cpu()


def test_few_points_run_on_the_cpu(accelerated):
    with device.where_few_points_run():
        assert jax.config.jax_default_device.platform == "cpu"


def test_few_points_run_where_there_is_no_cpu(accelerated, monkeypatch):
    def none(platform):
        raise RuntimeError(f"Unknown backend {platform}")

    monkeypatch.setattr(jax, "devices", none)
    with device.where_few_points_run():
        assert jax.config.jax_default_device is None


def test_outcomes_do_not_follow_from_the_blocks(accelerated):
    """The same points, in blocks of 128 and all side by side."""
    sim, rng = landing(b=0.5), np.random.default_rng(0)
    d = evaluate_points.transform.dimension(sim)
    z = (2 * rng.standard_normal((5000, d))).astype(evaluate_points.transform.normal_numbers(sim))
    assert evaluate_points.lanes_of(d) == 5120
    wide = evaluate_points.evaluate_points(sim, z)
    few = [evaluate_points.evaluate_points(sim, z[i : i + 1000]) for i in range(0, 5000, 1000)]
    assert wide.failure.any()
    np.testing.assert_array_equal(wide.failure, np.concatenate([o.failure for o in few]))
    np.testing.assert_allclose(
        wide.distance, np.concatenate([o.distance for o in few]), rtol=1e-5, atol=1e-5
    )


@pytest.mark.slow
def test_a_population_of_one_block_finds_the_probability(accelerated, key):
    """1920 points, of which no other test has as many: 300,000 evaluations have a standard error of
    5 %, and 20 % are four.
    """
    sim = landing(b=0.5)
    found = jast.estimate.population(key, sim, 300_000, particles=1920)
    assert abs(found.mean / float(landing_probability(b=0.5)) - 1) < 4 * 0.05
