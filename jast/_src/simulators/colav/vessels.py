"""The two vessels: a ferry of three degrees of freedom under path-following control, and an
adversary with first-order velocities.

Frame: N (north, along the ferry's path) and E (east), metres; heading psi, radians, from north
towards east; body velocities u (surge), v (sway), r (yaw rate). Everything is a scalar, one vessel:
XLA then makes one kernel of a substep for all vessels of a batch.

The ferry is milliAmpere, the small brother of the mA2: masses (added mass included) and damping of
Pedersen, Optimization Based System Identification for the milliAmpere Ferry (NTNU 2019), without
the identified couplings, some of which would create energy (the damping matrix is indefinite at v =
1 m/s). Gains are those published for the mA2 in the S1 study of Lytskjold and Mengshoel; they fit
these masses (0.29 rad/s, damping ratio 0.5 in surge).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

__all__ = [
    "Adversary",
    "Control",
    "Pose",
    "Velocity",
    "adversary_substep",
    "ferry_substep",
    "pose_rate",
]

MASS = (2389.657, 2533.911, 5068.910)  # kg, kg, kg m^2
LINEAR, QUADRATIC, CUBIC = (
    (27.632, 52.948, 122.861),
    (110.064, 116.487, 874.428),
    (13.965, 24.313, 0.0),
)  # damping X, Y, N
KP = (200.0, 200.0, 800.0)  # proportional gains of surge, sway and yaw
KI = (10.0, 10.0, 15.0)  # integral gains
KD = (700.0, 700.0, 1600.0)  # derivative gains
THRUST = (1000.0, 1000.0, 2000.0)  # greatest force (N) and moment (N m), each way: ours
# greatest position error that the controller sees, m: ours (the published planner allows 5 along
# the path, 3 across)
REACH = 5.0
LAGS = (3.0, 5.0, 3.0)  # time constants of the adversary's surge, sway and yaw rate, s: published
ACCELERATION = 0.15  # greatest change of the reference speed, m/s^2: ours
WINDUP = 20.0  # greatest integral of an error (m s, rad s): ours


class Pose(NamedTuple):
    """Position (m) and heading (radians)."""

    n: jax.Array
    e: jax.Array
    psi: jax.Array


class Velocity(NamedTuple):
    """Of the body: surge, sway (m/s), yaw rate (rad/s)."""

    u: jax.Array
    v: jax.Array
    r: jax.Array


class Control(NamedTuple):
    """Of the ferry: what the path-following controller remembers."""

    along: jax.Array
    """Place of the reference on the path (m)."""
    speed: jax.Array
    """Its speed (m/s)."""
    sum_n: jax.Array
    """Integrals of the errors in position (m s) and heading (rad s)."""
    sum_e: jax.Array
    sum_psi: jax.Array


class Adversary(NamedTuple):
    pose: Pose
    velocity: Velocity


def pose_rate(pose, velocity):
    """d pose / dt: the body's velocity turned into the frame."""
    c, s = jnp.cos(pose.psi), jnp.sin(pose.psi)
    return Pose(c * velocity.u - s * velocity.v, s * velocity.u + c * velocity.v, velocity.r)


def forces(control, pose, velocity):
    """Thrust of the controller: PID on position and heading in the body's axes, cut to what the
    thrusters can.
    """
    c, s = jnp.cos(pose.psi), jnp.sin(pose.psi)
    error_n, error_e, error_psi = _errors(control.along, pose)

    def body(n, e):
        return c * n + s * e, c * e - s * n

    (p_u, p_v), (i_u, i_v) = body(error_n, error_e), body(control.sum_n, control.sum_e)
    want_u, want_v = body(control.speed, jnp.zeros_like(control.speed))

    def force(kp, ki, kd, p, i, d, most):
        return jnp.clip(kp * p + ki * i + kd * d, -most, most)

    errors, integrals = (p_u, p_v, error_psi), (i_u, i_v, control.sum_psi)
    rates = want_u - velocity.u, want_v - velocity.v, -velocity.r
    return Velocity(*map(force, KP, KI, KD, errors, integrals, rates, THRUST))


def ferry_substep(pose, velocity, control, command, dt):
    """Pose, velocity and control ``dt`` seconds on, with the planner's speed ``command`` (m/s).

    M nu' + C(nu) nu + D(nu) nu = tau; damping implicit, the pose with the new velocity: first
    order, stable up to a step of 1.5 s.
    """
    thrust = forces(control, pose, velocity)
    u, v, r = velocity
    m_u, m_v, _ = MASS
    turning = (m_v * v * r, -m_u * u * r, (m_u - m_v) * u * v)  # -C(nu) nu: does no work

    def faster(m, x, f, g, a, b, c):
        drag = a + b * jnp.abs(x) + c * x**2
        return (m * x + dt * (f + g)) / (m + dt * drag)

    velocity = Velocity(*map(faster, MASS, velocity, thrust, turning, LINEAR, QUADRATIC, CUBIC))
    rate = pose_rate(pose, velocity)
    pose = Pose(*(x + dt * dx for x, dx in zip(pose, rate, strict=True)))
    speed = control.speed + jnp.clip(command - control.speed, -ACCELERATION * dt, ACCELERATION * dt)
    # the reference waits for the ferry
    along = jnp.clip(control.along + dt * speed, pose.n - REACH, pose.n + REACH)

    def summed(integral, error):
        return jnp.clip(integral + dt * error, -WINDUP, WINDUP)

    integrals = control.sum_n, control.sum_e, control.sum_psi
    sums = map(summed, integrals, _errors(control.along, pose))
    return pose, velocity, Control(along, speed, *sums)


def adversary_substep(adversary, command, dt):
    """The adversary ``dt`` seconds on; its velocities approach ``command`` exponentially (exact),
    the pose follows by the midpoint (second order).
    """

    def nearer(x, to, lag):
        return to + (x - to) * jnp.exp(-dt / lag)

    pose, velocity = adversary
    after = Velocity(*map(nearer, velocity, command, LAGS))
    mean = Velocity(*((a + b) / 2 for a, b in zip(velocity, after, strict=True)))
    rate = pose_rate(pose._replace(psi=pose.psi + dt / 2 * mean.r), mean)
    return Adversary(Pose(*(x + dt * dx for x, dx in zip(pose, rate, strict=True))), after)


def _errors(along, pose):
    """What is missing to the reference: north and east (m, as far as the controller sees), heading
    (radians, the short way round).
    """
    turn = pose.psi - 2 * jnp.pi * jnp.round(pose.psi / (2 * jnp.pi))
    return Pose(jnp.clip(along - pose.n, -REACH, REACH), jnp.clip(-pose.e, -REACH, REACH), -turn)
