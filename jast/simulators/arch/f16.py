"""The F-16 as in Stevens and Lewis, Aircraft Control and Simulation, appendix A: rigid, six degrees
of freedom, below Mach 1 and 45 degrees of angle of attack.

Its aerodynamics are a smaller version of the wind-tunnel data of Nguyen and others (1979), NASA
TP-1538, without the leading edge flap. The numbers were taken from FlightMechanicsSimulator.jl (A.
Saez, MIT licence), which marks two misprints of the book as Morelli corrected them (CYp at 45
degrees is -.227, Cmq at -5 degrees is -5.40). English units, as there; angles of the surfaces in
degrees.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jast.simulators.arch._table import along

__all__ = ["F16", "Controls", "Loads", "motion"]

GRAVITY = 32.17
MASS = 1 / 1.57e-3
"""slug; rounded as in the book, whose check values need it so"""
AREA, SPAN, CHORD = 300.0, 30.0, 11.32
"""ft2, ft, ft"""
CENTRE = 0.35
"""Of gravity, in chords: where the tables have it."""
INERTIA = np.array([[9496.0, 0, -982], [0, 55814, 0], [-982, 0, 63100]])
"""slug ft2"""
ENGINE = 160.0
"""Angular momentum of the engine, slug ft2/s, along the body's x axis."""


def _odd(rows: Any) -> np.ndarray:
    """A table [7, 12] over sideslips of 0 to 30 degrees as one over -30 to 30."""
    rows = np.array(rows)
    return np.concatenate([-rows[:0:-1], rows])


def _thousandths(*tables: Any) -> np.ndarray:
    """Tables [n, 12] of thousandths, over something and angles of attack, as one [12, n, tables]"""
    return np.stack([np.array(t, float).T / 1000 for t in tables], axis=-1)


# columns: angles of attack of -10, -5, .. 45 degrees
DAMPING = np.array([
    [-.267, -.110, .308, 1.34, 2.08, 2.91, 2.76, 2.05, 1.50, 1.49, 1.83, 1.21],  # CX, q
    [.882, .852, .876, .958, .962, .974, .819, .483, .590, 1.21, -.493, -1.04],  # CY, r
    [-.108, -.108, -.188, .110, .258, .226, .344, .362, .611, .529, .298, -.227],  # CY, p
    [-8.80, -25.8, -28.9, -31.4, -31.2, -30.7, -27.7, -28.2, -29, -29.8, -38.3, -35.3],  # CZ, q
    [-.126, -.026, .063, .113, .208, .230, .319, .437, .680, .100, .447, -.330],  # Cl, r
    [-.360, -.359, -.443, -.420, -.383, -.375, -.329, -.294, -.230, -.210, -.120, -.100],  # Cl, p
    [-7.21, -5.40, -5.23, -5.26, -6.11, -6.64, -5.69, -6.00, -6.20, -6.40, -6.60, -6.00],  # Cm, q
    [-.380, -.363, -.378, -.386, -.370, -.453, -.550, -.582, -.595, -.637, -1.02, -.840],  # Cn, r
    [.061, .052, .052, -.012, -.013, -.024, .050, .150, .130, .158, .240, .150],  # Cn, p
]).T  # fmt: skip
LIFT = np.array([.770, .241, -.100, -.416, -.731, -1.053, -1.366, -1.646, -1.917, -2.120, -2.248,
                 -2.229])  # fmt: skip
# CX and Cm; rows: elevator at -24, -12, .. 24 degrees
PITCHING = _thousandths(
    [[-99, -81, -81, -63, -25, 44, 97, 113, 145, 167, 174, 166],
     [-48, -38, -40, -21, 16, 83, 127, 137, 162, 177, 179, 167],
     [-22, -20, -21, -4, 32, 94, 128, 130, 154, 161, 155, 138],
     [-40, -38, -39, -25, 6, 62, 87, 85, 100, 110, 104, 91],
     [-83, -73, -76, -72, -46, 12, 24, 25, 43, 53, 47, 40]],
    [[205, 168, 186, 196, 213, 251, 245, 238, 252, 231, 198, 192],
     [81, 77, 107, 110, 110, 141, 127, 119, 133, 108, 81, 93],
     [-46, -20, -9, -5, -6, 10, 6, -1, 14, 0, -13, 32],
     [-174, -145, -121, -127, -129, -102, -97, -113, -87, -84, -69, -6],
     [-259, -202, -184, -193, -199, -150, -160, -167, -104, -76, -41, -5]],
)  # fmt: skip
# Cl and Cn; rows: sideslip of 0, 5, .. 30 degrees
SLIPPING = _thousandths(
    _odd([[0] * 12,
          [-1, -4, -8, -12, -16, -19, -20, -20, -15, -8, -13, -15],
          [-3, -9, -17, -24, -30, -34, -40, -37, -16, -2, -10, -19],
          [-1, -10, -20, -30, -39, -44, -50, -49, -23, -6, -14, -27],
          [0, -10, -22, -34, -47, -46, -59, -61, -33, -36, -35, -35],
          [7, -10, -23, -34, -49, -46, -68, -71, -60, -58, -62, -59],
          [9, -11, -23, -37, -50, -47, -74, -79, -91, -76, -77, -76]]),
    _odd([[0] * 12,
          [18, 19, 18, 19, 19, 18, 13, 7, 4, -14, -17, -33],
          [38, 42, 42, 42, 43, 39, 30, 17, 4, -35, -47, -57],
          [56, 57, 59, 58, 58, 53, 32, 12, 2, -46, -71, -73],
          [64, 77, 76, 74, 73, 57, 29, 7, 12, -34, -65, -41],
          [74, 86, 93, 89, 80, 62, 49, 22, 28, -12, -2, -13],
          [79, 90, 106, 106, 96, 80, 68, 30, 64, 15, 11, -1]]),
)  # fmt: skip
# Cl and Cn by the aileron at 20 degrees, then by the rudder at 30; rows: sideslip of -30, .. 30
STEERING = _thousandths(
    [[-41, -52, -53, -56, -50, -56, -82, -59, -42, -38, -27, -17],
     [-41, -53, -53, -53, -50, -51, -66, -43, -38, -27, -23, -16],
     [-42, -53, -52, -51, -49, -49, -43, -35, -26, -16, -18, -14],
     [-40, -52, -51, -52, -48, -48, -42, -37, -31, -26, -17, -12],
     [-43, -49, -48, -49, -43, -42, -42, -36, -25, -21, -16, -11],
     [-44, -48, -48, -47, -42, -41, -20, -28, -13, -14, -11, -10],
     [-43, -49, -47, -45, -42, -37, -3, -13, -10, -3, -7, -8]],
    [[1, -27, -17, -13, -12, -16, 1, 17, 11, 17, 8, 16],
     [2, -14, -16, -16, -14, -19, -21, 2, 12, 15, 15, 11],
     [-6, -8, -6, -6, -5, -8, -5, 7, 4, 7, 6, 6],
     [-11, -11, -10, -9, -8, -6, 0, 4, 7, 10, 4, 10],
     [-15, -15, -14, -12, -11, -8, -2, 2, 6, 12, 11, 11],
     [-24, -10, -4, -2, -1, 3, 14, 6, -1, 4, 4, 6],
     [-22, 2, -3, -5, -3, -1, -9, -9, -1, 3, -2, 1]],
    [[5, 17, 14, 10, -5, 9, 19, 5, 0, -5, -11, 8],
     [7, 16, 14, 14, 13, 9, 12, 5, 0, 4, 9, 7],
     [13, 13, 11, 12, 11, 9, 8, 5, -2, 5, 3, 5],
     [18, 15, 15, 14, 14, 14, 14, 15, 13, 11, 6, 1],
     [15, 14, 13, 13, 12, 11, 11, 10, 8, 8, 7, 3],
     [21, 11, 10, 11, 10, 9, 8, 10, 6, 5, 0, 1],
     [23, 10, 11, 11, 11, 10, 8, 10, 6, 14, 20, 0]],
    [[-18, -52, -52, -52, -54, -49, -59, -51, -30, -37, -26, -13],
     [-28, -51, -43, -46, -45, -49, -57, -52, -30, -33, -30, -8],
     [-37, -41, -38, -40, -40, -38, -37, -30, -27, -24, -19, -13],
     [-48, -45, -45, -45, -44, -45, -47, -48, -49, -45, -33, -16],
     [-43, -44, -41, -41, -40, -38, -34, -35, -35, -29, -22, -9],
     [-52, -34, -36, -36, -35, -28, -24, -23, -20, -16, -10, -14],
     [-62, -34, -27, -28, -27, -27, -23, -23, -19, -9, -25, -10]],
)  # fmt: skip
# lb, by Mach 0, .2, .. 1 (rows) and altitude of 0, 10,000, .. 50,000 ft: idle, military, maximum
THRUST = np.stack([
    [[1060, 670, 880, 1140, 1500, 1860], [635, 425, 690, 1010, 1330, 1700],
     [60, 25, 345, 755, 1130, 1525], [-1020, -710, -300, 350, 910, 1360],
     [-2700, -1900, -1300, -247, 600, 1100], [-3600, -1400, -595, -342, -200, 700]],
    [[12680, 9150, 6200, 3950, 2450, 1400], [12680, 9150, 6313, 4040, 2470, 1400],
     [12610, 9312, 6610, 4290, 2600, 1560], [12640, 9839, 7090, 4660, 2840, 1660],
     [12390, 10176, 7750, 5320, 3250, 1930], [11680, 9848, 8050, 6100, 3800, 2310]],
    [[20000, 15000, 10800, 7000, 4000, 2500], [21420, 15700, 11225, 7323, 4435, 2600],
     [22700, 16860, 12250, 8154, 5000, 2835], [24240, 18910, 13760, 9285, 5700, 3215],
     [26070, 21075, 15975, 11115, 6860, 3950], [28886, 23319, 18300, 13484, 8642, 5057]],
], axis=-1)  # fmt: skip


class F16(NamedTuple):
    """The aircraft at a moment, over a flat earth."""

    velocity: Any
    """[3] ft/s along the body's axes: forward, right, down"""
    attitude: Any
    """[3] rad: roll, pitch, yaw"""
    rates: Any
    """[3] rad/s: p, q, r"""
    position: Any
    """[3] ft: north, east, altitude"""
    power: Any
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

    throttle: Any
    """0 to 1"""
    elevator: Any
    """degrees"""
    aileron: Any
    """degrees"""
    rudder: Any
    """degrees"""


class Loads(NamedTuple):
    """Aerodynamic accelerations at the centre of gravity, in g."""

    side: Any
    """To the right"""
    normal: Any
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
    return F16(velocity, _turning(now), rates, position, power), loads


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
