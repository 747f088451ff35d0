"""The geodesics of the flight management system against Karney's library, and against the closed
forms of a sphere.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from geographiclib.geodesic import Geodesic

from jast._src.simulators.fms.geodesic import EARTHS, Earth, direct, inverse, wrap

pytestmark = pytest.mark.usefixtures("x64")
R = 6378137.0


def earth(name="wgs84"):
    return Earth(*(jnp.asarray(v, jnp.float64) for v in EARTHS[name]))


def legs(n=600, seed=0):
    """Points, azimuths (degrees) and distances (m) of legs of .001 to 3000 nmi, half of them
    backwards.
    """
    rng = np.random.default_rng(seed)
    points = np.stack([rng.uniform(-85, 85, n), rng.uniform(-180, 180, n)], -1)
    distance = 1852 * 10 ** rng.uniform(-3, np.log10(3000), n) * rng.choice([-1, 1], n)
    return points, rng.uniform(-180, 180, n), distance


def apart(a, b):
    """Metres between points (degrees) that nearly coincide."""
    turned = (a - b + 180) % 360 - 180
    return R * np.radians(np.hypot(turned[:, 0], turned[:, 1] * np.cos(np.radians(a[:, 0]))))


def turned(a, degrees):
    return np.abs((np.asarray(a) - np.radians(degrees) + np.pi) % (2 * np.pi) - np.pi)


def test_direct():
    points, azimuth, distance = legs()
    found, course = direct(
        earth(), jnp.asarray(points), jnp.radians(jnp.asarray(azimuth)), jnp.asarray(distance)
    )
    true = [
        Geodesic.WGS84.Direct(*p, z, s) for p, z, s in zip(points, azimuth, distance, strict=True)
    ]
    end = np.array([[g["lat2"], g["lon2"]] for g in true])
    assert found.dtype == jnp.float64 and apart(np.asarray(found), end).max() < 1e-8
    flat = np.abs(end[:, 0]) < 85  # a course has no meaning at the poles
    assert turned(course, [g["azi2"] for g in true])[flat].max() < 1e-14


def test_inverse():
    points, azimuth, distance = legs(seed=1)
    ends = np.array(
        [
            [g["lat2"], g["lon2"]]
            for g in (
                Geodesic.WGS84.Direct(*p, z, s)
                for p, z, s in zip(points, azimuth, distance, strict=True)
            )
        ]
    )
    found, first, last = inverse(earth(), jnp.asarray(points), jnp.asarray(ends))
    true = [Geodesic.WGS84.Inverse(*p, *q) for p, q in zip(points, ends, strict=True)]
    length = np.array([g["s12"] for g in true])
    np.testing.assert_allclose(found, length, rtol=0, atol=1e-8)
    for course, name in ((first, "azi1"), (last, "azi2")):
        error = turned(course, [g[name] for g in true])
        assert (error * np.minimum(length, R)).max() < 1e-8  # sideways, m
        assert error[length > 37].max() < 3e-10  # .02 nmi, where the defect is


def test_points_that_coincide_or_nearly_do():
    points = legs(200, 2)[0]
    length, first, last = inverse(earth(), jnp.asarray(points), jnp.asarray(points))
    assert (length == 0).all()
    assert jnp.isfinite(first).all()
    assert jnp.isfinite(last).all()
    back, course = direct(earth(), jnp.asarray(points), jnp.ones(200), jnp.zeros(200))
    assert apart(np.asarray(back), points).max() < 1e-8
    np.testing.assert_allclose(course, 1, rtol=1e-12)
    near, _ = direct(earth(), jnp.asarray(points), jnp.linspace(-3, 3, 200), jnp.full(200, 3.0))
    length, first, _ = inverse(earth(), jnp.asarray(points), near)
    np.testing.assert_allclose(length, 3, atol=1e-8)
    np.testing.assert_allclose(first, np.linspace(-3, 3, 200), atol=1e-8 / 3)


def test_poles_equator_and_antipodes_are_finite():
    ends = jnp.array(
        [
            [90.0, 0.0],
            [-90.0, 30.0],
            [0.0, 0.0],
            [0.0, 10.0],
            [0.0, 180.0],
            [0.0, 179.9],
            [45.0, -180.0],
            [45.0, 180.0],
        ]
    )
    a, b = (
        g.reshape(-1, 2) for g in (jnp.repeat(ends, len(ends), 0), jnp.tile(ends, (len(ends), 1)))
    )
    length, first, last = (np.asarray(v).reshape(8, 8) for v in inverse(earth(), a, b))
    assert np.isfinite([length, first, last]).all()
    assert length[2, 3] == pytest.approx(R * np.pi / 18, abs=1e-8)
    assert first[2, 3] == pytest.approx(np.pi / 2)
    assert length[6, 7] < 1e-8  # one point, from both sides of the date line
    assert length[0, 2] == pytest.approx(10001965.729, abs=1e-3)  # a quarter of a meridian


def test_sphere():
    points, azimuth, distance = legs(seed=3)
    ball, radius = earth("sphere"), EARTHS["sphere"][0]
    there, _ = direct(
        ball, jnp.asarray(points), jnp.radians(jnp.asarray(azimuth)), jnp.asarray(distance)
    )
    length, first, _ = inverse(ball, jnp.asarray(points), there)
    (phi, theta), (lam, mu) = (
        np.radians([a, b]) for a, b in zip(points.T, np.asarray(there).T, strict=True)
    )
    chord = np.sqrt(
        np.sin((theta - phi) / 2) ** 2 + np.cos(phi) * np.cos(theta) * np.sin((mu - lam) / 2) ** 2
    )
    np.testing.assert_allclose(length, 2 * radius * np.arcsin(chord), atol=1e-8)
    np.testing.assert_allclose(length, np.abs(distance), atol=1e-8)
    assert (
        turned(first, np.where(distance < 0, azimuth + 180, azimuth)) * np.asarray(length)
    ).max() < 5e-8


def test_wrap():
    np.testing.assert_allclose(
        wrap(jnp.array([0.0, 3.0, 4.0, -4.0, 7.0])),
        [0, 3, 4 - 2 * np.pi, 2 * np.pi - 4, 7 - 2 * np.pi],
    )
