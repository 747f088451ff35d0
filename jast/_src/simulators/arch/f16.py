"""The F-16 as in Stevens and Lewis, Aircraft Control and Simulation, appendix A: rigid, six degrees
of freedom, below Mach 1 and 45 degrees of angle of attack.

English units, as in the book; angles of the surfaces in degrees.

Its tables are a smaller version of the wind-tunnel data of Nguyen and others (1979), NASA TP-1538,
without the leading edge flap. The numbers, in `f16.json`, were taken from
FlightMechanicsSimulator.jl (A. Saez, MIT licence), which marks two misprints of the book as Morelli
corrected them (CYp at 45 degrees is -.227, Cmq at -5 degrees is -5.40). Angles of attack are -10,
-5, .. 45 degrees.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast._src.simulators.arch._table import along, read

__all__ = ["F16", "Controls", "Loads", "motion"]

GRAVITY = 32.17  # ft/s2
MASS = 1 / 1.57e-3
"""slug; rounded as in the book, whose check values need it so"""
AREA = 300.0  # ft2
SPAN = 30.0  # ft
CHORD = 11.32  # ft
CENTRE = 0.35
"""Of gravity, in chords: where the tables have it."""
INERTIA = np.array([[9496.0, 0, -982], [0, 55814, 0], [-982, 0, 63100]])
"""slug ft2"""
ENGINE = 160.0
"""Angular momentum of the engine, slug ft2/s, along the body's x axis."""

_TABLES = read("f16.json")


def _side_by_side(name: str) -> np.ndarray:
    """Tables [m, n] of one place in the file, as one [n, m, tables]"""
    return np.stack([table.T for table in _TABLES[name].values()], axis=-1)


DAMPING = np.stack(list(_TABLES["damping"].values()), axis=-1)
"""[12, 9]: CX by q, CY by r and p, CZ by q, Cl by r and p, Cm by q, Cn by r and p."""
LIFT = _TABLES["lift"]
PITCHING = _side_by_side("pitching") / 1000
"""[12, 5, 2]: CX and Cm, by the elevator at -24, -12, .. 24 degrees."""
_RIGHT = _side_by_side("slipping") / 1000  # at 0, 5, .. 30 degrees; odd in the sideslip
SLIPPING = np.concatenate([0 - _RIGHT[:, :0:-1], _RIGHT], axis=1)
"""[12, 13, 2]: Cl and Cn, by a sideslip of -30, -25, .. 30 degrees."""
STEERING = _side_by_side("steering") / 1000
"""[12, 7, 4]: Cl and Cn by the aileron at 20 degrees, then by the rudder at 30; by a sideslip of
-30, -20, .. 30 degrees."""
THRUST = np.stack(list(_TABLES["thrust"].values()), axis=-1)
"""[6, 6, 3] lb, by Mach 0, .2, .. 1 and altitude of 0, 10,000, .. 50,000 ft: idle, military,
maximum."""


class F16(NamedTuple):
    """The aircraft at a moment, over a flat earth."""

    velocity: jax.Array
    """[3] ft/s along the body's axes: forward, right, down"""
    attitude: jax.Array
    """[3] rad: roll, pitch, yaw"""
    rates: jax.Array
    """[3] rad/s: p, q, r"""
    position: jax.Array
    """[3] ft: north, east, altitude"""
    power: jax.Array
    """Of the engine, 0 to 100"""

    @property
    def speed(self) -> Any:
        """ft/s."""
        return jnp.sqrt((self.velocity**2).sum(-1))

    @property
    def alpha(self) -> Any:
        """rad: angle of attack."""
        return jnp.arctan2(self.velocity[..., 2], self.velocity[..., 0])

    @property
    def beta(self) -> Any:
        """rad: sideslip."""
        return jnp.arcsin(self.velocity[..., 1] / self.speed)

    @property
    def altitude(self) -> Any:
        """ft."""
        return self.position[..., 2]

    @property
    def climb(self) -> Any:
        """ft/s."""
        roll, pitch = self.attitude[..., 0], self.attitude[..., 1]
        u, v, w = jnp.moveaxis(self.velocity, -1, 0)
        return u * jnp.sin(pitch) - (v * jnp.sin(roll) + w * jnp.cos(roll)) * jnp.cos(pitch)


class Controls(NamedTuple):
    """What moves the aircraft."""

    throttle: jax.Array
    """0 to 1"""
    elevator: jax.Array
    """degrees"""
    aileron: jax.Array
    """degrees"""
    rudder: jax.Array
    """degrees"""


class Loads(NamedTuple):
    """Aerodynamic accelerations at the centre of gravity, in g."""

    side: jax.Array
    """To the right"""
    normal: jax.Array
    """Up, 1 in level flight"""


def motion(now: F16, controls: Controls, centre: float = CENTRE) -> tuple[F16, Loads]:
    """The time derivative of each field, and the loads."""
    dtype = now.velocity.dtype
    pressure, mach = _air(now.speed, now.altitude)
    force, moment = _coefficients(now, controls, centre)
    force = pressure * AREA * force
    moment = pressure * AREA * jnp.array([SPAN, CHORD, SPAN], dtype) * moment
    push = jnp.array([1, 0, 0], dtype) * _thrust(now.power, now.altitude, mach)
    frame = _frame(now.attitude)
    velocity = (force + push) / MASS + GRAVITY * frame[2] - jnp.cross(now.rates, now.velocity)
    inertia, inverse = (jnp.asarray(m, dtype) for m in (INERTIA, np.linalg.inv(INERTIA)))
    spin = inertia @ now.rates + jnp.array([ENGINE, 0, 0], dtype)
    rates = inverse @ (moment - jnp.cross(now.rates, spin))
    position = (now.velocity @ frame.T) * jnp.array([1, 1, -1], dtype)
    power = _spooling(now.power, controls.throttle)
    loads = Loads(force[1] / (MASS * GRAVITY), -force[2] / (MASS * GRAVITY))
    return F16(
        velocity=velocity, attitude=_turning(now), rates=rates, position=position, power=power
    ), loads


def _coefficients(now: F16, controls: Controls, centre: float) -> tuple[Any, Any]:
    """Of the forces [3] and the moments [3]."""
    alpha, beta = jnp.rad2deg(now.alpha), jnp.rad2deg(now.beta)
    aileron, rudder = controls.aileron / 20, controls.rudder / 30
    row = alpha / 5 + 2
    cx, cm = along(along(PITCHING, row), controls.elevator / 12 + 2)
    cl, cn = along(along(SLIPPING, row), beta / 5 + 6)
    cl_a, cn_a, cl_r, cn_r = along(along(STEERING, row), beta / 10 + 3)
    cy = -0.02 * beta + 0.021 * aileron + 0.086 * rudder
    cz = along(LIFT, row) * (1 - (beta / 57.3) ** 2) - 0.19 * controls.elevator / 25
    cl, cn = cl + cl_a * aileron + cl_r * rudder, cn + cn_a * aileron + cn_r * rudder

    cxq, cyr, cyp, czq, clr, clp, cmq, cnr, cnp = along(DAMPING, row)
    across = SPAN / (2 * now.speed)
    p, q, r = across * now.rates[0], CHORD / (2 * now.speed) * now.rates[1], across * now.rates[2]
    cx, cy, cz = cx + cxq * q, cy + cyr * r + cyp * p, cz + czq * q
    ahead = CENTRE - centre
    cm, cl = cm + cmq * q + cz * ahead, cl + clr * r + clp * p
    cn = cn + cnr * r + cnp * p - cy * ahead * CHORD / SPAN
    return jnp.stack([cx, cy, cz]), jnp.stack([cl, cm, cn])


def _air(speed: Any, altitude: Any) -> tuple[Any, Any]:
    """Dynamic pressure, lb/ft2, and Mach number."""
    factor = 1 - 0.703e-5 * altitude
    warmth = jnp.where(altitude >= 35000, 390, 519 * factor)
    return 0.5 * 2.377e-3 * factor**4.14 * speed**2, speed / jnp.sqrt(1.4 * 1716.3 * warmth)


def _thrust(power: Any, altitude: Any, mach: Any) -> Any:
    """lb."""
    return along(along(along(THRUST, 5 * mach), altitude / 10000), power / 50)


def _spooling(power: Any, throttle: Any) -> Any:
    """How fast the engine's power follows the throttle."""
    asked = jnp.where(throttle <= 0.77, 64.94 * throttle, 217.38 * throttle - 117.38)
    low, high = power < 50, asked >= 50
    goal = jnp.where(low & high, 60, jnp.where(~low & ~high, 40, asked))
    rate = jnp.where(low, jnp.clip(1.9 - 0.036 * (goal - power), 0.1, 1), 5)
    return rate * (goal - power)


def _frame(attitude: Any) -> Any:
    """[3, 3]: the body's axes (columns) in north, east and down."""
    (sf, st, ss), (cf, ct, cs) = jnp.sin(attitude), jnp.cos(attitude)
    return jnp.array([
        [ct * cs, sf * st * cs - cf * ss, cf * st * cs + sf * ss],
        [ct * ss, sf * st * ss + cf * cs, cf * st * ss - sf * cs],
        [-st, sf * ct, cf * ct],
    ])  # fmt: skip


def _turning(now: F16) -> Any:
    """Rates of roll, pitch and yaw."""
    roll, pitch = now.attitude[0], now.attitude[1]
    p, q, r = now.rates
    yaw = (q * jnp.sin(roll) + r * jnp.cos(roll)) / jnp.cos(pitch)
    return jnp.stack([p + yaw * jnp.sin(pitch), q * jnp.cos(roll) - r * jnp.sin(roll), yaw])
