"""jast.simulators.arch: the F-16 against the book's numbers, its autopilot, flights as episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from benchmarks import arch_flights, f16_design
from jast._src.simulators.arch import f16, gcas
from jast.distributions import Independent, Normal
from jast.simulators.arch import SPECIFICATIONS, fly
from jast.simulators.arch import ground_collision_avoidance as avoidance
from jast.specs import robustness

WORST = np.pi / 4 + np.pi / 30, -0.4 * np.pi, -np.pi / 4


@jax.jit
def slopes(x, controls, centre):
    """The derivative of speed, alpha, beta, attitude, rates, position and power [13]."""
    v, alpha, beta = x[:3]
    c = jnp.cos(beta)
    way = jnp.stack([jnp.cos(alpha) * c, jnp.sin(beta), jnp.sin(alpha) * c])
    now = f16.F16(v * way, x[3:6], x[6:9], x[9:12], x[12])
    rate, _ = f16.motion(now, f16.Controls(*controls), centre)
    wind = jax.jvp(lambda s: jnp.stack([s.speed, s.alpha, s.beta]), (now,), (rate,))[1]
    power = rate.power[None]
    return jnp.concatenate([wind, rate.attitude, rate.rates, rate.position, power])


def test_the_books_test_case(x64):
    """Stevens and Lewis, table 3.5-2; their moments of inertia are rounded."""
    x = jnp.array([500, 0.5, -0.2, -1, 1, -1, 0.7, -0.8, 0.9, 1000, 900, 10000, 90])
    found = slopes(x, jnp.array([0.9, 20, -15, -20]), 0.4)
    book = np.array([-75.23724, -0.8813491, -0.4759990, 2.505734, 0.3250820, 2.145926, 12.62679,
                     0.9649671, 0.5809759, 342.4439, -266.7707, 248.1241, -58.68999])  # fmt: skip
    np.testing.assert_allclose(found[6:9], book[6:9], rtol=3e-4)
    np.testing.assert_allclose(np.delete(found, [6, 7, 8]), np.delete(book, [6, 7, 8]), rtol=4e-7)


def test_the_books_turn(x64):
    """Example 3.6-2: .3 rad/s at 502 ft/s, trimmed there by a search."""
    x = jnp.array([502, 0.2392628, 0.0005061803, 1.366289, 0.05000808, 0.2340769, -0.01499617,
                   0.2933811, 0.06084932, 0, 0, 0, 64.12363])  # fmt: skip
    found = slopes(x, jnp.array([0.8349601, -1.481766, 0.09553108, -0.4118124]), 0.35)
    np.testing.assert_allclose(found[np.r_[:3, 6:9]], 0, atol=5e-4)
    np.testing.assert_allclose(found[5], 0.3, atol=1e-6)


@pytest.mark.slow
def test_the_books_level_flight(x64):
    """Table 3.6-2: throttle, alpha and elevator by speed, to its digits; 502 ft/s of 3.6-3."""
    book = np.array([[170, 0.464, 27.2, 0.621], [200, 0.287, 19.7, 0.723],
                     [260, 0.148, 11.6, -0.09], [300, 0.122, 8.49, -0.591],
                     [400, 0.108, 4.16, -0.591],
                     [500, 0.137, 2.14, -0.756], [502, 0.1385, 2.115, -0.7588],
                     [540, 0.160, 1.63, -0.798], [700, 0.282, 0.382, -0.900],
                     [800, 0.378, -0.045, -0.943]])  # fmt: skip
    alpha, controls = jax.jit(jax.vmap(f16_design.trim))(book[:, 0])
    np.testing.assert_allclose(controls.throttle, book[:, 1], atol=6e-4)
    np.testing.assert_allclose(np.rad2deg(alpha), book[:, 2], atol=0.05)
    np.testing.assert_allclose(controls.elevator, book[:, 3], atol=6e-4)


@pytest.mark.slow
def test_the_gains_are_what_the_design_says():
    design = f16_design.design()
    np.testing.assert_allclose(gcas.PITCH, design.pitch, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(gcas.LATERAL, design.lateral, rtol=1e-4, atol=1e-4)
    held = design.alpha, design.controls.throttle, design.controls.elevator
    np.testing.assert_allclose((gcas.LEVEL_ALPHA, gcas.THROTTLE, gcas.ELEVATOR), held, rtol=2e-6)


def test_a_flight():
    trace, dt = fly(*WORST)
    assert trace.altitude.shape == (451,) and dt == 1 / 30
    mode, aircraft = np.asarray(trace.mode), trace.aircraft
    assert (np.diff(mode[1:]) != 0).sum() == 2 and [mode[1], mode[-1]] == [1, 0]
    pulls = np.flatnonzero(mode == 2)
    before = pulls[0] - 1
    assert abs(aircraft.attitude[before, 0]) < np.deg2rad(5)
    assert len(pulls) >= 2 / dt and aircraft.climb[pulls[-1]] > 0
    # 5 g, by the way that the path turns: v (rate of its angle) / g + the share of gravity
    path = np.arcsin(aircraft.climb / aircraft.speed)
    k = pulls[0] + 45
    load = aircraft.speed[k] * (path[k + 1] - path[k - 1]) / (2 * dt) / 32.17
    assert load + np.cos(path[k]) == pytest.approx(6, abs=0.3)


def test_flights_are_exact_enough():
    """Half the integrator's step, and float64, move the least altitude by less than 1 ft."""
    begin = lambda: gcas.start(jnp.array(WORST), 2338.0)
    least = float(fly(*WORST, altitude=2338.0)[0].altitude.min())
    with jax.enable_x64(True):
        halved = jax.jit(lambda s: gcas.drive(s, 450, steps=2)[1].altitude.min())(begin())
    assert least == pytest.approx(float(halved), abs=0.1)
    assert least == pytest.approx(47.65, abs=0.5)  # as of this design; published gains differ


@pytest.mark.slow
def test_flights_are_episodes(key):
    """In the worst corner, from an altitude that hits the ground and from one that does not; yaw
    changes nothing.
    """
    replay = jax.jit(lambda sim, x0: jast.replay(sim, jnp.zeros((15, 0)), x0=x0))
    for altitude, yaw in ((2262.0, WORST[2]), (2338.0, WORST[2] + np.pi / 8)):
        trace, dt = fly(*WORST[:2], yaw, altitude)
        whole = float(robustness(SPECIFICATIONS["F16"], trace, dt))
        e = replay(avoidance(altitude=altitude), jnp.array([*WORST[:2], yaw]))
        assert bool(e.failure) == (whole < 0) == (altitude < 2338)
        assert float(e.distance) == pytest.approx(max(whole, 0), abs=0.05)
        assert int(e.length) == (6 if whole < 0 else 15)
    assert whole == pytest.approx(47.65, abs=0.5)


@pytest.mark.slow
def test_falsify_needs_no_disturbances():
    found = jast.search.falsify(jax.random.key(1), avoidance(), simulations=60)
    assert found.first_failure is not None
    x0 = np.asarray(found.best.x0)
    assert found.best.failure and np.all((x0 > WORST[0] - 0.2) | (x0 < 0))


@pytest.mark.long
def test_the_least_altitudes_of_the_box():
    found = arch_flights.rows(200)
    for r in found.values():
        assert r["corner"]["roll"] == 1 and r["corner"]["pitch"] == 0
        assert r["yaw"] < 0.01 and r["halved"] < 1
    assert found["2338"]["share"] == 0 and found["2262"]["least"] < 0


@pytest.mark.long
def test_a_start_of_the_users_and_its_probability(key):
    mild = Independent(Normal(jnp.array([0.8, -1.2, -0.8]), jnp.array([0.03, 0.02, 0.1])), 1)
    sim, crude = avoidance(altitude=2270.0, start=mild), 4000
    found = jast.estimate.failure_probability(key, sim, 2000)
    plain = jast.estimate.monte_carlo(key, sim, crude)
    error = np.hypot(found.standard_error, plain.standard_error)
    assert abs(float(found.mean - plain.mean)) < 4 * error


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda: avoidance("AT1"), "ground_collision_avoidance: requirement"),
        (lambda: avoidance(altitude=0.0), "ground_collision_avoidance: altitude"),
        (lambda: fly(0.8, np.nan, 0.0), "fly: pitch must be a number of rad"),
        (lambda: fly("left", -1.2, 0.0), "fly: roll must be a number of rad"),
        (lambda: fly(0.8, -1.2, 0.0, altitude=-1.0), "fly: altitude"),
    ],
)
def test_errors(call, said):
    with pytest.raises(ValueError, match=said):
        call()


@pytest.mark.slow
def test_equal_settings_compile_once():
    @jax.jit
    def traced(sim):
        calls.append(0)
        return sim.init(jnp.zeros(3))

    calls = []
    for altitude in (2262.0, 2262.0, 4040):
        traced(avoidance(altitude=altitude))
    assert len(calls) == 1
