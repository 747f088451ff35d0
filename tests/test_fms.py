"""The stand-in for a flight management system: its paths against a second implementation on
Karney's geodesics, its events, and its measured rates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from geographiclib.geodesic import Geodesic
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jast
from jast import distributions as D
from jast._src.core.episode import _rollout, play_back
from jast._src.simulators.fms import database, events, system
from jast.simulators import fms, fms_misses, fms_path
from jast.simulators.fms import FIXES, KLAX, KSFO, MEANS, SIGMAS, FmsState

pytestmark = pytest.mark.usefixtures("x64")
NMI, FOOT = 1852.0, 0.3048
MEANS, SIGMAS = np.array(MEANS), np.array(SIGMAS)


CHUNK = 1024  # of routes: few programs, of one shape


@jax.jit
def _fly(sim, x):
    return jax.lax.scan(
        lambda s, x: (jax.vmap(sim.step)(s, x), None), jax.vmap(lambda _: sim.init(()))(x[0]), x
    )[0]


@jax.jit
def _judge(model, states):
    def one(s):
        path = system._path(model, s)
        return events.misses(model.build.earth, path), path.skipped.any(), path.legs / NMI

    return jax.vmap(one)(states)


def judge(sim, states):
    """The misses, whether the defect acted, and the legs (nmi) of many final states: NumPy
    arrays.
    """
    n = len(states.t)
    judged = []
    for i in range(0, n, CHUNK):
        chunk = jax.tree.map(
            lambda a, i=i: np.resize(np.asarray(a[i : i + CHUNK]), (CHUNK, *a.shape[1:])), states
        )
        judged.append(jax.device_get(_judge(sim.init.args[0], chunk)))
    return jax.tree.map(lambda *a: np.concatenate(a)[:n], *judged)


def fly(sim, x):
    """`judge` of routes with disturbances ``x`` [n, T, 4]."""
    return judge(sim, _fly(fms(), jnp.swapaxes(x, 0, 1)))


def routes(n, seed=0, means=MEANS, sigmas=SIGMAS):
    return jnp.asarray(means + sigmas * np.random.default_rng(seed).normal(size=(n, 12, 4)))


def play(sim, x):
    """The final state after the disturbances ``x`` [T, 4]."""
    return jax.tree.map(lambda a: a[len(x)], jast.replay(sim, jnp.asarray(x)).states)


def final(x):
    """The final state after ``x`` [12, 4], computed step by step as it would be by a user."""
    sim, state = fms(), fms().init(())
    for row in np.asarray(x):
        state = sim.step(state, jnp.asarray(row))
    return state


def turning(leg, courses=(200.0, 160.0)):
    """A route whose two first turns are ``leg`` nmi apart: south, there on the first course, on on
    the second, and south again.
    """
    x = np.tile([180.0, 50.0, 0.0, 0.0], (12, 1))
    x[1, :2], x[2, :2] = (courses[0], leg), (courses[1], 50.0)
    return x


# the second implementation: section by section, a waypoint at a time


def reference(x, eps=0.03, bank=23.3, tas=450.0, every=False, snap=True):
    """Packets (s, e, c, signed r, beta, straight) and the miss distances: plain Python on
    geographiclib.
    """
    W = Geodesic.WGS84
    ahead = lambda p, azimuth, m: (lambda g: ((g["lat2"], g["lon2"]), g["azi2"]))(
        W.Direct(*p, azimuth, m)
    )
    wrapped = lambda degrees: (degrees + 180) % 360 - 180
    points = [KSFO]
    for course, distance, *_ in x:
        points.append(ahead(points[-1], course, distance * NMI)[0])
    points.append(KLAX)
    legs = [W.Inverse(*a, *b) for a, b in zip(points[:-1], points[1:], strict=True)]
    n = len(x)
    turns, radii, leads = [], [], [0.0]
    for i in range(n):
        out = legs[i + 1]["azi1"]
        turn = np.radians(wrapped(out - legs[i]["azi2"]))
        speed = max(tas + x[i][3] * np.cos(np.radians(x[i][2] - out)), 150) * NMI / 3600
        radius = speed**2 / (9.80665 * np.tan(np.radians(bank)))
        lead = radius * np.tan(abs(turn) / 2)
        if lead > 20 * NMI:
            radius, lead = radius * 20 * NMI / lead, 20 * NMI
        turns.append(turn), radii.append(radius), leads.append(lead)
    leads.append(0.0)
    sense = [0, *np.sign(turns), 0]
    factors = []
    for i, g in enumerate(legs):
        skip = g["s12"] < eps * NMI and (every or sense[i] * sense[i + 1] < 0)
        need = leads[i] + leads[i + 1]
        factors.append(1.0 if skip or need == 0 else min(1.0, 0.999 * g["s12"] / need))
    for i in range(n):
        factor = min(factors[i], factors[i + 1])
        radii[i], leads[i + 1] = radii[i] * factor, leads[i + 1] * factor
    packets, last = [], KSFO
    for i in range(n):
        s, course = ahead(points[i + 1], legs[i]["azi2"], -leads[i + 1])
        e, out = ahead(points[i + 1], legs[i + 1]["azi1"], leads[i + 1])
        c, _ = ahead(s, course + np.copysign(90, turns[i]), radii[i])
        straight = leads[i] + leads[i + 1] <= legs[i]["s12"]
        if snap and not straight:
            s = last
        packets.append(
            (s, e, c, np.copysign(radii[i], turns[i]), abs(turns[i]) * radii[i], straight)
        )
        last = e
    worst = gap = kink = bend = 0.0
    for i, (s, e, c, r, beta, straight) in enumerate(packets):
        alpha = np.radians(np.sign(r) * (W.Inverse(*c, *e)["azi1"] - W.Inverse(*c, *s)["azi1"])) % (
            2 * np.pi
        )
        alpha = 0 if 2 * np.pi - alpha < 1e-6 else alpha
        worst = max(worst, abs(beta - alpha * abs(r)) / FOOT)
        before = packets[i - 1][1] if i else KSFO
        if straight:
            g = W.Inverse(*before, *s)
            kink = max(kink, abs(wrapped(W.Inverse(*c, *s)["azi2"] - g["azi2"] + np.sign(r) * 90)))
            bend = max(
                bend,
                (
                    abs(wrapped(g["azi1"] - W.Inverse(*points[i], *before)["azi2"]))
                    if i and leads[i]
                    else 0
                ),
            )
        elif i:
            gap = max(gap, W.Inverse(*before, *s)["s12"] / FOOT)
    return packets, (
        100 * np.log(10 / max(worst, 1e-9)),
        1e-3 - np.radians(kink),
        10 - gap,
        np.radians(1 - bend),
    )


HAND_MADE = [
    turning(0.01),
    turning(0.01, (160.0, 220.0)),
    turning(0.029, (250.0, 110.0)),
    turning(0.031),
    turning(0.01, (200.0, 240.0)),
    turning(5.0),
    turning(-0.02),
    turning(0.08),
]


@pytest.mark.slow
def test_packets_and_events_are_those_of_the_second_implementation():
    build = dict(eps=0.03, bank=23.3, tas=450.0)
    near = routes(6, 3, np.array([180.0, 1, -88.5, 66.8]), np.array([45.0, 3, 39.5, 24.4]))
    xs = [*HAND_MADE, *np.asarray(routes(8)), *np.asarray(near)]
    fails = 0
    for x in xs:
        for every, snap in ((False, True), (True, True), (False, False)):
            sim = fms(**build, guard="all" if every else "s-turns", snap=snap)
            state = play(sim, x)
            path, found = fms_path(sim, state), fms_misses(sim, state)
            packets, expected = reference(x, **build, every=every, snap=snap)
            s, e, c, r, beta, straight = (np.array(column) for column in zip(*packets, strict=True))
            for a, b in ((path.start, s), (path.end, e), (path.centre, c)):
                np.testing.assert_allclose(a, b, rtol=0, atol=2e-11)  # degrees: 2e-6 m
            np.testing.assert_allclose(path.radius, r, rtol=1e-6, atol=1e-3)
            np.testing.assert_allclose(path.beta, beta, rtol=0, atol=1e-3)
            np.testing.assert_array_equal(path.straight[:-1], straight)
            assert float(found.arc_length) == pytest.approx(expected[0], abs=0.01)
            np.testing.assert_allclose(found[1:], expected[1:], rtol=0, atol=1e-5)
            assert bool(path.skipped.any()) == (not straight.all())
            fails += expected[0] <= 0
    assert 10 <= fails < len(xs)


@pytest.mark.slow
@pytest.mark.parametrize(
    "x, settings, fails",
    [
        (turning(0.01), {}, True),
        (turning(0.01), dict(fixed=True), False),
        (turning(0.01), dict(eps=0.005), False),
        (turning(0.01), dict(snap=False), False),
        (turning(0.01), dict(snap=False, event="disconnection"), True),
        (turning(0.01), dict(event="disconnection"), False),
        (turning(0.08), {}, False),
        (turning(0.08), dict(eps=0.1), True),
        (turning(0.01, (200.0, 240.0)), {}, False),  # both turns to the right
        (turning(0.01, (200.0, 240.0)), dict(guard="all"), True),
        (turning(0.01, (200.0, 240.0)), dict(guard="all", earth="sphere"), True),
    ],
)
def test_the_defect_acts_where_it_should(x, settings, fails):
    episode = jast.replay(fms(**settings), jnp.asarray(x))
    assert bool(episode.failure) == fails == (float(episode.distance) <= 0)


def test_an_arc_leads_nearly_all_the_way_round():
    sim = fms()
    episode = jast.replay(sim, jnp.asarray(turning(0.01, (240.0, 200.0))))
    path = fms_path(sim, episode)
    angles = events.extent(sim.init.args[0].build.earth, path)
    assert 6.1 < angles[1] < 2 * np.pi
    assert path.turn[0] > 1
    assert path.turn[1] < -0.6
    error = (angles[1] * abs(path.radius[1]) - path.beta[1]) / FOOT
    assert float(episode.distance) == pytest.approx(100 * np.log(10 / float(error)), abs=1e-6)
    assert float(episode.distance) < -980


# measured rates: within 4.5 standard errors of those of 400,000 routes


@pytest.mark.long
def test_rate_and_miss_distances():
    n, few = 16 * CHUNK, 3 * CHUNK
    x = routes(n)
    found, skipped, legs = fly(fms(), x)
    d, fails = found.arc_length, found.arc_length <= 0
    np.testing.assert_array_equal(fails, skipped)  # fails if and only if the defect acted
    rate = 1.29e-3
    assert abs(fails.mean() - rate) < 4.5 * np.sqrt(rate / n + 0.06e-3**2)
    assert abs(d.mean() - 407.0) < 4.5 * 74 / np.sqrt(n)
    assert 55 < d[~fails].std() < 60
    assert d[~fails].min() > 200
    assert -1100 < d.min() < -900 and abs(d[fails].mean() + 845) < 4.5 * 110 / np.sqrt(fails.sum())
    assert fails.sum() < (legs.min(1) < 0.03).sum()  # near-duplicates do not always cause failures
    assert (np.array(found[1:]) > 0).all()  # the other events see nothing

    some = np.concatenate([x[fails], x[:few]])[:few]
    fixed, skipped, _ = fly(fms(fixed=True), some)
    count = fails.sum()
    assert not skipped.any() and fixed.arc_length.min() > 200
    sound = ~fails[: few - count]
    np.testing.assert_allclose(fixed.arc_length[count:][sound], d[: few - count][sound], rtol=1e-6)
    apart, skipped, _ = fly(fms(snap=False), some[:CHUNK])
    np.testing.assert_array_equal(apart.disconnection <= 0, skipped)
    assert skipped[:count].all() and (apart.arc_length > 0).all()
    ball, _, _ = fly(fms(earth="sphere"), some)
    assert ball.arc_length[:count].max() < 0
    assert abs(ball.arc_length[count:][sound].mean() - fixed.arc_length[count:][sound].mean()) < 0.5


@pytest.mark.slow
def test_rate_of_short_legs():
    n = 5 * CHUNK
    # the thesis's first proposal of the cross-entropy method
    x = routes(n, 1, np.array([180.0, 1, -88.5, 66.8]), np.array([45.0, 3, 39.5, 24.4]))
    d = fly(fms(), x)[0].arc_length
    assert abs((d <= 0).mean() - 0.0428) < 4.5 * np.sqrt(0.0428 / n)
    assert abs(d.mean() - 791) < 4.5 * 341 / np.sqrt(n)
    assert fly(fms(fixed=True), x[:CHUNK])[0].arc_length.min() > 0


def test_undisturbed():
    sim = fms()
    state = play(sim, np.tile(MEANS, (12, 1)))
    assert float(fms_misses(sim, state).arc_length) == pytest.approx(414.7, abs=0.1)
    assert float(sim.disturbance(state).log_prob(jnp.asarray(MEANS))) - 2 == pytest.approx(
        -237.05 / 12, abs=1e-3
    )  # four normals: 2 below the mode, on average


@pytest.mark.slow
def test_database():
    sim = fms(database=True)

    @jax.jit
    @jax.vmap
    def many(key):
        step = lambda s, key: (sim.step(s, D.sample(sim.disturbance(s), key)), None)
        return jax.lax.scan(step, sim.init(()), jax.random.split(key, 12))[0]

    states = many(jax.random.split(jax.random.key(0), 5 * CHUNK))
    found, skipped, legs = judge(sim, states)
    assert not skipped.any()
    assert found.arc_length.min() > 100
    assert legs.min() > 4.9
    assert {tuple(w) for w in np.asarray(states.waypoints).reshape(-1, 2)} == set(FIXES.values())
    dist = sim.disturbance(sim.init(()))
    x = {"fix": jnp.int32(list(FIXES).index("SFO")), "wind": jnp.zeros(2)}
    assert dist.log_prob(x) == -jnp.inf  # the beacon of the airport is less than 5 nmi away
    assert not np.diag(database.APART).any()
    assert (database.APART[:-2] == database.APART[:-2].T).all()


# odd routes


@pytest.mark.slow
def test_unfinished_routes_and_empty_states():
    sim = fms()
    zero = jax.tree.map(jnp.zeros_like, sim.init(()))
    full = play(sim, turning(0.01))
    for state in (zero, sim.init(()), full._replace(t=jnp.int32(1)), full._replace(t=jnp.int32(3))):
        assert np.isfinite(fms_misses(sim, state)).all()
    assert not bool(sim.evaluate(full._replace(t=jnp.int32(1)))[0]) and bool(sim.evaluate(full)[0])
    short, path = (
        jast.replay(sim, jnp.asarray(turning(0.01)[:3])),
        fms_path(sim, full._replace(t=jnp.int32(3))),
    )
    assert bool(short.failure)
    assert float(path.legs[4:].max()) == 0
    assert not path.arc[3:].any()
    few = fms(waypoints=3)  # ends where the cut one did
    assert float(jast.replay(few, jnp.asarray(turning(0.01)[:3])).distance) == pytest.approx(
        float(short.distance), abs=1e-6
    )
    assert np.isfinite(
        fms_misses(fms(waypoints=1), jast.replay(fms(waypoints=1), jnp.asarray(MEANS)[None]))
    ).all()


COURSE = st.one_of(st.sampled_from([0.0, 90.0, 180.0, 270.0, 360.0]), st.floats(-720, 720))
LENGTH = st.one_of(
    st.sampled_from([0.0, 1e-9, 1e-6, 0.01, -0.01, 20.0, 50.0, 600.0]), st.floats(-200, 200)
)
WIND = st.one_of(st.just(0.0), st.floats(-500, 500))
ROUTE = st.lists(st.tuples(COURSE, LENGTH, COURSE, WIND), min_size=12, max_size=12)


@pytest.mark.slow
@settings(
    max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(ROUTE, st.booleans(), st.booleans())
def test_odd_routes_give_numbers(x, every, snap):
    for fixed in (False, True):
        sim = fms(guard="all" if every else "s-turns", snap=snap, fixed=fixed)
        found = fms_misses(sim, final(x))
        assert np.isfinite(found).all()
        if fixed:
            assert found.arc_length > 0 and found.disconnection > 0


# the contract


@pytest.mark.parametrize("database", [pytest.param(False, marks=pytest.mark.long), True])
def test_contract(database, key):
    sim = fms(database=database)
    assert jast.check(sim) is sim
    if database:
        return
    episode = jast.rollout(key, sim)
    assert int(episode.length) == 12
    assert episode.distance.dtype == episode.log_prob.dtype == jnp.float64
    assert float(fms_misses(sim, episode).arc_length) == float(
        fms_misses(sim, episode._replace(states=None)).arc_length
    )
    assert float(fms_misses(sim, episode).arc_length) == pytest.approx(
        float(episode.distance), abs=1e-3
    )
    assert sim.observe(jax.tree.map(lambda a: a[5], episode.states)).shape == (8,)
    assert np.abs(sim.observe(sim.init(()))).max() < 5


def test_settings_are_traced(key, traced):
    jast.rollout(key, fms())
    traced.clear()
    for sim in (
        fms(0.1, 15, 300),
        fms(fixed=True),
        fms(guard="all", earth="sphere"),
        fms(jnp.float32(0.01), snap=False),
    ):
        jast.rollout(key, sim)
        assert jax.tree.structure(sim) == jax.tree.structure(fms())
    assert not {_rollout.__name__, play_back.__name__} & set(traced)


@pytest.mark.parametrize(
    "bad, match",
    [
        (lambda: fms(eps=-0.1), "fms: eps must be a number of nmi, at least 0, received -0.1"),
        (lambda: fms(bank=90), "fms: bank must .*received 90"),
        (lambda: fms(tas=0.0), "fms: tas must be a number of knots, positive, received 0.0"),
        (lambda: fms(waypoints=0), "fms: waypoints must be a whole number of at least 1"),
        (lambda: fms(guard="some"), "fms: guard must be one of 's-turns', 'all', received 'some'"),
        (lambda: fms(event="stall"), "fms: event must .*received 'stall'"),
        (lambda: fms(earth="flat"), "fms: earth must be one of 'wgs84', 'sphere', received 'flat'"),
        (lambda: fms(fixed="no"), "fms: fixed must be True or False, received 'no'"),
        (
            lambda: fms_path(jast.simulators.walk1d(), None),
            "fms_path: sim must be a jast.simulators.fms",
        ),
        (lambda: fms_misses(fms(), jnp.zeros(3)), "fms_misses: episode must .* 12 waypoints"),
        (
            lambda: fms_misses(fms(waypoints=3), fms().init(())),
            "fms_misses: episode must .* 3 waypoints, received FmsState",
        ),
    ],
)
def test_bad_settings(bad, match):
    with pytest.raises(ValueError, match=match):
        bad()


def test_float64_is_asked_for(key):
    sim, state = fms(), fms().init(())
    assert isinstance(state, FmsState) and state.waypoints.dtype == jnp.float64
    with jax.enable_x64(False):
        for use in (fms, lambda: jast.rollout(key, sim), lambda: fms_path(sim, state)):
            with pytest.raises(ValueError, match="fms: float64 is needed.*with jax.enable_x64"):
                use()
