"""jast.simulators.arch: the models against closed forms, integrators with events and published
falsifying inputs.
"""

import csv
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from jast._src.simulators.arch import transmission
from jast.distributions import Beta, Independent
from jast.simulators.arch import SPECIFICATIONS, automatic_transmission, chasing_cars, simulate
from jast.specs import always, parts, predicate, robustness, trace_of

CORNERS = np.random.default_rng(2).integers(0, 2, (20, 2)).astype(float)


@pytest.mark.slow
def test_the_first_switch_is_where_the_closed_form_has_it():
    """At full throttle y1 = -t^2 / 2. The gap of 10 + t^2 / 2 reaches 15 at sqrt(10) s, and then
    grows by y2' = -(t - sqrt(10)).
    """
    trace, dt = simulate("chasing cars", [0.0], [[1.0, 0.0]])
    t, switch = dt * np.arange(2001), np.sqrt(10)
    gap = np.where(t < switch, 10 + t**2 / 2, 10 + t * switch - switch**2 / 2)
    np.testing.assert_allclose(trace.gaps[:150, 0], gap[:150], atol=2e-4)
    np.testing.assert_allclose(trace.y[:150, 0], -(t[:150] ** 2) / 2, atol=2e-4)
    np.testing.assert_array_equal(trace.modes[:150, 0], (t[:150] > switch).astype(int))
    assert trace.y.shape == (2001, 5) and dt == 0.05


def integrated(inputs, until):
    """Positions [n, 5] at 0.05, 0.1, .. by an integrator that stops at each switch."""
    from scipy.integrate import solve_ivp

    y, v, mode, out = np.arange(5) * 10.0, np.zeros(5), [0] * 4, []
    switches = [(0, 15, 1, 1), (0, 5, 2, -1), (1, 10, 0, -1), (2, 20, 1, 1)]
    for piece in range(int(until / 5)):
        t, (throttle, brake) = 0.0, inputs[piece]
        while t < 5 - 1e-12:

            def slope(_, s, throttle=throttle, brake=brake):
                w = s[5:]
                ways = [w[0]] + [w[i + 1] * (1 if mode[i] == 0 else -1) for i in range(4)]
                push = [(0.0, 1.0, -w[i + 1])[mode[i]] for i in range(4)]
                return np.array([*ways, -throttle - brake * w[0], *push])

            events, then = [], []
            for i in range(4):
                for of, level, to, way in switches:
                    if mode[i] == of:
                        event = lambda _, s, i=i, level=level: s[i + 1] - s[i] - level
                        event.terminal, event.direction = True, way
                        events.append(event)
                        then.append((i, to))
            grid = np.arange(1, 101) * 0.05
            grid = grid[grid > t + 1e-12]
            found = solve_ivp(
                slope,
                (t, 5),
                np.r_[y, v],
                events=events,
                t_eval=grid,
                rtol=1e-9,
                atol=1e-9,
                max_step=0.05,
            )
            seen = np.asarray(found.y)
            out += list(seen[:5].T) if seen.size else []
            if found.status == 1:
                k = next(j for j, e in enumerate(found.t_events) if len(e))
                t, state = found.t_events[k][0], found.y_events[k][0]
                mode[then[k][0]] = then[k][1]
            else:
                t, state = 5.0, seen[:, -1]
            y, v = state[:5], state[5:]
    return np.array(out)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_switches_are_located(seed, x64):
    """Fixed steps of 0.01 s put cars 5 m off."""
    until = 25 if seed == 0 else 100
    inputs = np.random.default_rng(seed).uniform(size=(20, 2))
    trace, _ = simulate("chasing cars", 5.0 * np.arange(20), inputs)
    expected = integrated(inputs, until)
    away = np.abs(expected - np.asarray(trace.y)[1 : 1 + len(expected)])
    assert away.max() < 3e-3


@pytest.mark.slow
def test_precisions_agree():
    times = 5.0 * np.arange(20)
    single, _ = simulate("chasing cars", times, CORNERS)
    with jax.enable_x64(True):
        double, _ = simulate("chasing cars", times, CORNERS)
    np.testing.assert_allclose(single.gaps, double.gaps, atol=0.1)


def test_linear_inputs_are_steps_of_many_pieces():
    times = np.array([0.0, 12.3, 60.0])
    inputs = np.array([[0.1, 0.9], [1.0, 0.0], [0.3, 0.4]])
    fine = np.arange(0, 100, 0.01)
    held = np.stack([np.interp(fine + 0.005, times, c) for c in inputs.T], axis=1)
    one, _ = simulate("chasing cars", times, inputs, interpolation="linear")
    two, _ = simulate("chasing cars", fine, held)
    np.testing.assert_allclose(one.gaps, two.gaps, atol=0.05)


@pytest.mark.parametrize("name", ["CC3", pytest.param("CC1", marks=pytest.mark.long)])
def test_a_simulator_is_the_model_under_its_requirement(name):
    times, found = 5.0 * np.arange(20), []
    sim = chasing_cars(name)
    replay = jax.jit(lambda x: jast.replay(sim, x))
    for seed in range(8):
        inputs = np.random.default_rng(seed).integers(0, 2, (20, 2)).astype(float)
        trace, dt = simulate("chasing cars", times, inputs)
        whole = float(robustness(SPECIFICATIONS[name], trace, dt))
        e = replay(jnp.asarray(inputs, jnp.zeros(()).dtype))
        assert bool(e.failure) == (whole < 0)
        assert float(e.distance) == pytest.approx(max(whole, 0), abs=0.05)
        found.append(whole < 0)
    assert len(set(found)) == 2
    seen = trace_of(jax.device_get(e), samples=lambda s: s.samples)
    rows = parts(SPECIFICATIONS[name], seen, 0.05, goes_on=True).rows
    assert max(rows[0].value, 0) == pytest.approx(float(e.distance), abs=1e-3)


@pytest.mark.long
def test_uniform_inputs_are_equally_likely_and_a_density_is_the_users(key):
    keys = jax.random.split(key, 3)
    formula = always(predicate(lambda s: 100.0 - s.gaps[0], "y2 - y1 < 100"))
    plain = chasing_cars(formula, segments=2)
    assert set(np.asarray(jax.vmap(lambda k: jast.rollout(k, plain).log_prob)(keys))) == {0.0}
    mild = Independent(Beta(jnp.full(2, 2.0), jnp.full(2, 2.0)), 1)
    e = jast.rollout(key, chasing_cars(formula, 2, mild))
    assert float(e.log_prob) != 0


@pytest.mark.long
def test_as_many_fail_as_in_another_transcription(key):
    """Of 20,000 uniform inputs .87 % failed there: 4 standard errors of the difference."""
    n, share = 2000, 0.0087
    found = float(jast.estimate.monte_carlo(key, chasing_cars("CC1"), n).mean)
    assert abs(found - share) < 4 * np.sqrt(share * (1 - share) * (1 / n + 1 / 20_000))


@pytest.mark.slow
def test_published_inputs_falsify():
    """FalCAuN's (MasWag/FalCAuN-ARCH-COMP, MIT licence). Its version of 2023 reads the outputs
    where inputs change; its three signals for CC3 that end at 20 s do not falsify.
    """
    lines = (Path(__file__).parent / "arch_published.csv").read_text().splitlines()
    kept = 0
    for row in csv.DictReader(lines):
        name, text = row["requirement"], row["times throttle brake"]
        points = np.array([p.split() for p in text.split(";")], float)
        model = "chasing cars" if name.startswith("CC") else "automatic transmission"
        way = "linear" if name == "CC4" else "step"
        trace, dt = simulate(model, points[:, 0], points[:, 1:], interpolation=way)
        if name.startswith("AT6") and row["year"] == "2023":
            dt, every = points[1, 0], round(points[1, 0] / dt)
            trace = jax.tree.map(lambda a, n=every: a[::n], trace)
        kept += float(robustness(SPECIFICATIONS[name], trace, dt)) >= 0
    assert kept == 3


def shifted(inputs, until):
    """Engine and vehicle speed each 0.02 s by an integrator, stopped each 0.04 s for the logic."""
    from scipy.integrate import solve_ivp

    T = transmission

    def at(table, place):
        row = int(np.clip(np.floor(place), 0, len(table) - 2))
        return table[row] + (place - row) * (table[row + 1] - table[row])

    now, gear, wish, waited, out = np.array([1000.0, 0.0]), 0, 0, 0, []
    for tick in range(round(until / 0.04)):
        throttle, brake = inputs[int(tick * 0.04 / 5 + 1e-9)]
        v, waited = 2 * np.pi * 60 / 5280 * now[1], waited + 1
        up, down = at(T.UP, throttle / 5)[gear], at(T.DOWN, throttle / 5)[gear]
        if wish == 0:
            wish, waited = int(v > up) - int(v < down), 0
        elif (v >= up if wish > 0 else v <= down) and waited >= 2:
            gear, wish = gear + wish, 0
        elif v < up if wish > 0 else v > down:
            wish = 0

        def slope(_, s, ratio=T.GEARS[gear], throttle=throttle, brake=brake):
            v = 2 * np.pi * 60 / 5280 * s[1]
            capacity, gain = at(T.CONVERTER, 100 * 3.23 * ratio * s[1] / s[0])
            impeller = (s[0] / capacity) ** 2
            rise = at(at(T.TORQUE, throttle / 10), s[0] / 400 - 2) - impeller
            load = (40 + 0.02 * v**2 + brake) * np.sign(v)
            return rise / 0.0219914882836, (3.23 * ratio * impeller * gain - load) / 12.0941478573

        grid = np.array([0.02, 0.04])
        found = solve_ivp(slope, (0, 0.04), now, t_eval=grid, rtol=1e-7, atol=1e-6, max_step=0.004)
        now = found.y[:, -1]
        out += [(rpm, 2 * np.pi * 60 / 5280 * w, gear + 1) for rpm, w in found.y.T]
    return np.array(out)


@pytest.mark.slow
def test_the_transmission_is_what_its_equations_say(x64):
    """Up to the third gear, and down again when full throttle asks for it."""
    inputs = np.array([[50.0, 0.0], [100.0, 0.0], [10.0, 200.0]])
    until = 12
    expected = shifted(inputs, until)
    trace, _ = simulate("automatic transmission", [0.0, 5.0, 10.0], inputs)
    n = 1 + len(expected)
    np.testing.assert_array_equal(np.asarray(trace.gear)[1:n], expected[:, 2])
    assert set(np.diff(expected[:, 2])) == {-1, 0, 1}
    np.testing.assert_allclose(np.asarray(trace.rpm)[1:n], expected[:, 0], atol=1)
    np.testing.assert_allclose(np.asarray(trace.speed)[1:n], expected[:, 1], atol=0.01)


@pytest.mark.slow
def test_a_transmission_under_its_requirement(key):
    sim = automatic_transmission("AT6abc")
    assert sim.horizon == 10
    for inputs in ([[30.0, 0.0]] * 10, [[45.0, 0.0]] + [[30.0, 100.0]] * 9, [[100.0, 0.0]] * 10):
        trace, dt = simulate("automatic transmission", 5.0 * np.arange(10), inputs)
        whole = float(robustness(SPECIFICATIONS["AT6abc"], trace, dt))
        e = jast.replay(sim, jnp.asarray(inputs))
        assert bool(e.failure) == (whole < 0) and int(e.length) <= 7
        assert float(e.distance) == pytest.approx(max(whole, 0), rel=1e-3)


def test_equal_settings_compile_once():
    @jax.jit
    def traced(sim):
        calls.append(0)
        return sim.init(())

    calls = []
    for _ in range(2):
        traced(chasing_cars("CCx"))
        traced(automatic_transmission("AT6c"))
    assert len(calls) == 2
    # trees map over simulators: these hold no arrays, and no distribution as a leaf
    assert not jax.tree.leaves(automatic_transmission("AT6c"))


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda: chasing_cars("CC9"), "chasing_cars: requirement"),
        (lambda: chasing_cars("CC1", 7), "chasing_cars: segments must divide 2000"),
        (lambda: chasing_cars("CC1", 0), "chasing_cars: segments"),
        (lambda: automatic_transmission("CC1"), "automatic_transmission: requirement"),
        (lambda: automatic_transmission("AT1", 3), "automatic_transmission: segments must divide"),
        (lambda: simulate("cars", [0], [[0, 0]]), "simulate: model"),
        (lambda: simulate("chasing cars", [1.0], [[0, 0]]), "simulate: times"),
        (lambda: simulate("chasing cars", [0, np.inf], [[0, 0]] * 2), "simulate: times"),
        (lambda: simulate("chasing cars", [0, 5], [[0, 0]]), "simulate: inputs must have the sh"),
        (lambda: simulate("chasing cars", [0], [[0, 2]]), r"inputs: brake must be in \[0, 1\]"),
        (lambda: simulate("chasing cars", [0], [[0, 1]], "cubic"), "simulate: interpolation"),
    ],
)
def test_errors(call, said):
    with pytest.raises(ValueError, match=said):
        call()
