"""Chasing cars: five cars on a line; the first is driven, each other one keeps its distance.

After Hu, Lygeros and Sastry (2000), Towards a theory of stochastic hybrid systems, as the
falsification category of ARCH-COMP has it: 100 s, inputs throttle and brake in [0, 1]. Car 1: v' =
-throttle - brake v, y' = v, from 0 at rest (the signs are the benchmark's). Cars 2 to 5 begin at
10, 20, 30, 40 at rest, in mode Keep; with g = y_i - y_{i-1} and v never reset at a switch:

=====  ================  =====================================
mode   dynamics          leaves to
=====  ================  =====================================
Keep   v' = 0, y' = v    Chase at g >= 15, Brake at g <= 5
Chase  v' = 1, y' = -v   Keep at g <= 10
Brake  v' = -v, y' = -v  Chase at g >= 20
=====  ================  =====================================

Within a mode the motion has a closed form. A switch is located within a sample's time, not stepped
over: fixed steps of 0.01 s put cars 5 m off. One switch of each car is seen in `DT` seconds.

Published, falsified of 10 runs and mean simulations: FalCAuN 2023 CC1 10, 229; CC2 10, 119; CC3
10, 195; FalCAuN 2024 CC1 396, CC2 76, CC3 122, CC4 4 or 7 of 10, 1257, CCx none.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jast._src.util.pytrees import index_tree

__all__ = ["DT", "DURATION", "INPUTS", "Cars", "drive", "observe", "start"]

DT = 0.05
"""Seconds between samples."""
DURATION = 100.0
"""Seconds of a run."""
INPUTS = (("throttle", 0.0, 1.0), ("brake", 0.0, 1.0))
"""Names and ranges of the inputs."""
KEEP, CHASE, BRAKE = 0, 1, 2
SECANTS = 3  # by which a switch is located


class Cars(NamedTuple):
    """The cars at a moment. Gaps, not positions, as these are large.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast.simulators.arch import Cars
        >>> cars = Cars(jnp.full(4, 10.0), jnp.zeros(5), jnp.zeros(4, jnp.int32), jnp.array(0.0))
        >>> cars.y.tolist()
        [0.0, 10.0, 20.0, 30.0, 40.0]
    """

    gaps: jax.Array
    """[4] m: y2 - y1, .., y5 - y4"""
    speeds: jax.Array
    """[5] m/s: v of each car; cars 2 to 5 that chase or brake move by -v"""
    modes: jax.Array
    """[4] int32 of cars 2 to 5: 0 Keep, 1 Chase, 2 Brake"""
    first: jax.Array
    """m: y1"""

    @property
    def y(self) -> Any:
        """[..., 5] m: the positions."""
        first = jnp.asarray(self.first)[..., None]
        return jnp.concatenate([first, first + jnp.cumsum(self.gaps, axis=-1)], axis=-1)


class _Path(NamedTuple):
    """How a car moves within a sample's time: by one law up to ``switch``, then by another. A law
    is the factors of the first five powers of time in its way; the sixth is below 1e-9 m.
    """

    law: tuple[Any, ...]
    switch: jax.Array
    """Seconds; inf where there is none"""
    later: tuple[Any, ...]
    gone: jax.Array
    """m, up to the switch"""


def start() -> Cars:
    """The cars at 0 s."""
    return Cars(jnp.full(4, 10.0), jnp.zeros(5), jnp.zeros(4, jnp.int32), jnp.zeros(()))


def drive(cars: Cars, inputs: jax.Array) -> tuple[Cars, Cars]:
    """The cars after driving, and each sample of it.

    Args:
        cars: at the beginning.
        inputs: [k, 2]: throttle and brake, constant for `DT` each.

    Returns:
        (the cars k `DT` later, `Cars` [k, ...] after each input).
    """
    # car by car, as each depends on those before it alone
    path, (speed, first) = _drive_first(cars, inputs)
    gaps, speeds, modes = [], [speed], []
    for i in range(4):
        begin = cars.gaps[i], cars.speeds[i + 1], cars.modes[i]
        _, (path, (gap, speed, mode)) = lax.scan(_drive_follower, begin, path)
        gaps.append(gap)
        speeds.append(speed)
        modes.append(mode)
    gaps, speeds, modes = (jnp.stack(columns, axis=-1) for columns in (gaps, speeds, modes))
    samples = Cars(gaps, speeds, modes, first)
    return index_tree(samples, -1), samples


def observe(cars: Cars) -> tuple[Any, ...]:
    """What policies see of the cars."""
    return cars.gaps, cars.speeds, cars.modes


def _drive_first(cars: Cars, inputs: jax.Array) -> tuple[_Path, tuple[Any, Any]]:
    """The paths of car 1, and its speeds and positions, [k, ...]."""

    def body(at: tuple[Any, Any], u: jax.Array) -> tuple[Any, Any]:
        speed, y = at
        throttle, brake = u
        fading = _braking(brake)
        late = (0, *(c / k for k, c in enumerate(fading[:4], 2)))
        law = tuple(speed * a - throttle * b for a, b in zip(fading, late, strict=True))
        after = _speed(law, DT), y + _distance(law, DT)
        return after, (law, after)

    begin = cars.speeds[0], cars.first
    _, (laws, after) = lax.scan(body, begin, (inputs[:, 0], inputs[:, 1]))
    never, zero = (jnp.full(len(inputs), v, cars.first.dtype) for v in (jnp.inf, 0))
    return _Path(laws, never, laws, zero), after


def _drive_follower(at: tuple[Any, Any, Any], ahead: _Path) -> tuple[Any, Any]:
    """A car (its gap, speed and mode) behind one that goes ``ahead``: as it is `DT` later, and with
    its path. It switches once at most.
    """
    gap, speed, mode = at
    law = _law(mode, speed)

    def free(t: Any) -> Any:
        """The gap, as long as the car does not switch."""
        return gap + _distance(law, t) - _distance_gone(ahead, t)

    up = jnp.where(mode == KEEP, 15.0, jnp.where(mode == BRAKE, 20.0, jnp.inf))
    down = jnp.where(mode == KEEP, 5.0, jnp.where(mode == CHASE, 10.0, -jnp.inf))
    up, down = up.astype(gap.dtype), down.astype(gap.dtype)

    # the gap has a kink where the car ahead switches: it may be past a level there alone
    end = jnp.asarray(DT, gap.dtype)
    kink = jnp.minimum(ahead.switch, end)
    sides = free(kink), free(end)
    early = (sides[0] >= up) | (sides[0] <= down)
    high = jnp.where(early, sides[0], sides[1]) >= up
    switches = early | high | (sides[1] <= down)
    level = jnp.where(switches, jnp.where(high, up, down), 0)
    sign = jnp.where(high, 1, -1).astype(gap.dtype)
    left = jnp.where(early, jnp.zeros_like(kink), kink)
    right = jnp.where(early, kink, end)

    def over(t: Any) -> Any:
        """At least 0 from the switch on."""
        return sign * (free(t) - level)

    for _ in range(SECANTS):
        a, b = jnp.minimum(over(left), 0), jnp.maximum(over(right), 0)
        share = jnp.where(b > a, -a / jnp.where(b > a, b - a, 1), 0)
        when = left + share * (right - left)
        beyond = over(when) >= 0
        left, right = jnp.where(beyond, left, when), jnp.where(beyond, when, right)

    new = jnp.where(high, CHASE, jnp.where(mode == KEEP, BRAKE, KEEP)).astype(mode.dtype)
    then = jnp.where(mode == KEEP, speed, jnp.abs(_speed(law, when)))
    later = _law(new, then)
    path = _Path(law, jnp.where(switches, when, jnp.inf), later, _distance(law, when))
    mode = jnp.where(switches, new, mode)
    last = jnp.where(switches, _speed(later, DT - when), _speed(law, DT))
    after = gap + _distance_gone(path, end) - _distance_gone(ahead, end), jnp.abs(last), mode
    return after, (path, after)


def _law(mode: Any, speed: Any) -> Any:
    """The way of a car in ``mode``, in powers of time."""
    zero = jnp.zeros_like(speed)
    keep = (speed, *[zero] * 4)
    chase = (-speed, zero - 0.5, *[zero] * 3)
    brake = tuple(-speed * c for c in _braking(zero + 1))
    return tuple(
        jnp.where(mode == KEEP, k, jnp.where(mode == CHASE, c, b))
        for k, c, b in zip(keep, chase, brake, strict=True)
    )


def _braking(rate: Any) -> tuple[Any, ...]:
    """(1 - exp(-rate t)) / rate in powers of t."""
    powers = [jnp.ones_like(rate)]
    for k in (2, 3, 4, 5):
        powers.append(powers[-1] * -rate / k)
    return tuple(powers)


def _distance(law: Any, t: Any) -> Any:
    """m, by t."""
    total = law[4]
    for k in (3, 2, 1, 0):
        total = total * t + law[k]
    return total * t


def _speed(law: Any, t: Any) -> Any:
    """m/s, after t."""
    total = 5 * law[4]
    for k in (3, 2, 1, 0):
        total = total * t + (k + 1) * law[k]
    return total


def _distance_gone(path: _Path, t: Any) -> Any:
    """m, by t."""
    rest = jnp.where(t > path.switch, t - path.switch, 0)
    later = path.gone + _distance(path.later, rest)
    return jnp.where(t > path.switch, later, _distance(path.law, t))
