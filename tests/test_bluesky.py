"""BlueSky as a black box: routes that pass and fail, the same to the bit, in this process and in
another one.
"""

import importlib.metadata

import jax.numpy as jnp
import numpy as np
import pytest

import jast
from jast import blackbox
from jast._src.simulators.bluesky import Route, bluesky, bluesky_flight, judged, nearest
from jast.incidents import incidents


@pytest.fixture(scope="module")
def installed():
    pytest.importorskip("bluesky.traffic")
    pytest.importorskip("loky")


STRAIGHT = np.array([[0.0, 7.0, 0.0, 0.0], [20.0, 4.0, 0.0, 0.0]])
# BlueSky turns long before the waypoint
SHARP = np.array([[0.0, 6.0, 0.0, 0.0], [165.0, 6.0, 0.0, 0.0]])


def test_routes_pass_and_fail_as_the_track_says(installed, equal):
    sim = bluesky(2)
    calm, missed = (
        jast.replay(sim, jnp.asarray(x, jnp.zeros(()).dtype)) for x in (STRAIGHT, SHARP)
    )
    assert not calm.failure
    assert 1 < calm.distance < 7
    assert missed.failure
    assert missed.distance < -0.5
    assert incidents(sim) == () and blackbox.calls(sim).episodes == 2
    equal(missed, jast.replay(sim, jnp.asarray(SHARP, jnp.zeros(()).dtype)))
    for x, episode in ((STRAIGHT, calm), (SHARP, missed)):  # this process has a BlueSky of its own
        flight, again = bluesky_flight(x), bluesky_flight(x)
        equal(flight._asdict() | {"finished": 0}, again._asdict() | {"finished": 0})
        assert flight.finished
        assert flight.route.shape == (3, 2)
        assert flight.turns[1] == 0
        np.testing.assert_allclose(flight.track[0], 0)
        excess = np.max(flight.nearest - flight.allowed)
        np.testing.assert_allclose(episode.distance, np.log(1 / max(excess, 1e-3)), rtol=1e-5)
        np.testing.assert_allclose(
            flight.nearest,
            np.min(np.hypot(*(flight.track - flight.route[1:, None]).T), axis=0),
            atol=0.05,
        )


def test_a_flight_is_the_same_after_others_and_prints_nothing(installed, capfd):
    first = bluesky_flight(SHARP)
    bluesky_flight(STRAIGHT[:1])
    assert np.array_equal(bluesky_flight(SHARP).track, first.track)
    # a cross wind does not carry it away
    assert np.ptp(bluesky_flight([[90.0, 3.0, 0.0, 60.0]]).track[:, 0]) < 0.05
    here = Route(1.0)
    here.initialize()
    # a leg is never shorter than 0.1 nmi
    here.transition(np.array([0.0, -5.0, 0.0, 0.0], np.float32))
    here.evaluate()
    assert not here.is_event()
    assert capfd.readouterr().out == ""


def test_the_nearest_point_lies_on_a_segment():
    track = np.array([[0.0, 0.0], [0.0, 4.0], [0.0, 4.0]])
    np.testing.assert_allclose(nearest(np.array([[1.0, 2.0], [3.0, 8.0]]), track), [1.0, 5.0])


R = 1.953093
"""nmi: the radius of a turn at 250 kt and 25 degrees of bank, v^2 / (g tan(bank))."""


@pytest.mark.parametrize(
    "courses, lengths, turns, allowed",
    [
        # right, then left by 90 degrees: corners are cut by R (sqrt(2) - 1), the end by nothing
        ([0, 90, 0], [6, 6, 6], [90, -90], [0.414214 * R, 0.414214 * R]),
        # the turns lead by R each: of the leg between them 2 R - 3 is missing, at both its ends
        ([0, 90, 0], [6, 3, 6], [90, -90], [1.414214 * R + R - 3] * 2),
        # from north west to north east by the north; then one counted as of 120 degrees
        ([-45, 45, 195], [9, 9, 9], [90, 150], [0.414214 * R, R]),
    ],
)
def test_what_is_asked_of_a_flight_depends_on_its_turns(courses, lengths, turns, allowed):
    """By hand: how much a fly-by turn cuts its corner, and what does not fit on a leg."""
    course = np.radians(courses)
    legs = np.array(lengths)[:, None] * np.stack([np.cos(course), np.sin(course)], axis=1)
    route = np.concatenate([np.zeros((1, 2)), np.cumsum(legs, axis=0)])
    flight = judged(route, route, 250.0, True)
    np.testing.assert_allclose(flight.turns, [*turns, 0], atol=1e-9)
    np.testing.assert_allclose(flight.allowed, [*allowed, 0], rtol=1e-4)
    np.testing.assert_allclose(flight.nearest, 0, atol=1e-9)  # it flew over all of them


def test_bad_input_and_a_missing_extra_are_named(monkeypatch):
    with pytest.raises(ValueError, match="bluesky: waypoints must be"):
        bluesky(0)
    with pytest.raises(ValueError, match="bluesky: tolerance must be a number of nmi above 0"):
        bluesky(tolerance=0.0)
    with pytest.raises(
        ValueError, match=r"bluesky_flight: disturbances must .*received shape \(3,\)"
    ):
        bluesky_flight(np.zeros(3))

    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    for call in (bluesky, lambda: bluesky_flight(STRAIGHT)):
        with pytest.raises(ImportError, match=r"pip install 'jast\[bluesky\]'"):
            call()
