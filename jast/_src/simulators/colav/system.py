"""The ferry, the adversary, the tracker between them and the disturbances, as one `Simulator`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Numeric
from jast._src.runtime._jax import is_traced
from jast._src.simulators.colav import planner, tracker, vessels
from jast._src.simulators.colav.scenarios import SCENARIOS, Scenario
from jast._src.simulators.colav.tracker import BUFFER, PERIOD, Track
from jast._src.simulators.parameter import positive
from jast._src.util.checks import wrong

__all__ = ["COLLISION", "ColavState", "colav"]

KINDS = ("delay", "steering", "noise")
COLLISION = 1.0  # m between the centres: published
DOCK = 99.0  # m north: published


class ColavState(NamedTuple):
    """Both vessels, what the ferry believes and wants, and the last disturbances."""

    pose: vessels.Pose
    velocity: vessels.Velocity
    control: vessels.Control
    choice: jax.Array
    """int32: which of `planner.SPEEDS` is commanded."""
    track: Track
    """Where the ferry believes the adversary to be, and its velocity."""
    adversary: vessels.Adversary
    past: jax.Array
    """[16, 4]: the adversary's `Track` at the ends of the last search steps (`tracker`)."""
    step: jax.Array
    """int32: search steps taken."""
    delay: jax.Array
    """The last one, as a fraction of the longest."""
    steering: jax.Array
    """The last one, in [0, 1]; 0.5 is none."""
    near: jax.Array
    """Least distance between the centres (m) since the last state."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Model:
    """What the simulator's functions know: the encounter, and the scales of the disturbances
    (traced); which of them there are, and the substeps (static).
    """

    scenario: Scenario
    longest: jax.Array
    change: jax.Array
    easing: jax.Array
    swing: jax.Array
    noise: jax.Array
    kinds: tuple = field(metadata=dict(static=True))
    substeps: int = field(metadata=dict(static=True))


def colav(
    scenario: Scenario | Literal["head-on", "crossing", "overtaking", "sharp turn"] = "sharp turn",
    disturbances: str | Sequence[str] = "delay",
    *,
    substeps: int = 30,
    longest_delay: Numeric = BUFFER,
    delay_change: Numeric = 0.2,
    delay_easing: Numeric = 0.8,
    steering_change: Numeric = 0.5,
    noise: Sequence[float] = (0.3, 0.1),
) -> Simulator:
    """A ferry with collision avoidance meets an adversary: a `Simulator` of 25 to 27 steps of 3 s,
    with states of 90 numbers.

    The disturbances are one or several of these kinds. With one kind x is its array (scalar,
    scalar, [4]), with several a dict of them by name.

    - "delay": the ferry's sensors show the adversary as it was a x ``longest_delay`` seconds ago
      (nothing before the start), a in [0, 1] drawn each step: tent-shaped around ``delay_easing``
      times the last a, of half width ``delay_change``. Undisturbed: 0.
    - "steering": the adversary turns at a - 0.5 rad/s on top of its route; a in [0, 1], tent-shaped
      around the last, of half width ``steering_change``. Undisturbed: 0.5.
    - "noise": errors of the sensed position (two, in m) and velocity (two, in m/s), normal of
      standard deviations ``noise``, one draw a step. Undisturbed: 0.

    The published step rewards of delay and steering are ln(1 - |a - a'|) up to a factor, with -0.5
    a for a delay (for which the easing stands here); the published steering stands in place of a
    route, the published noise is within 0.5 and costs its mean absolute value. The past is kept at
    the ends of steps and read in between (`tracker`), not as a buffer of samples.

    In a step the planner looks at the track and commands a speed (`planner`). Then, in each
    substep, the adversary moves, the tracker takes in what the sensors show, and the ferry follows
    its path (`vessels`). Miss distance: least distance (m) between the centres at substeps; failure
    below 1 m. An episode ends when the ferry is at the dock (99 m). The dtype is JAX's default
    float. The planner's choice is among speeds, so the miss distance has no useful gradient in
    delays and noise.

    Args:
        scenario: one of the names, or a `Scenario` of your own (``from jast.simulators.colav import
            Scenario``).
        disturbances: "delay", "steering", "noise", or several of them.
        substeps: of a step; static. The published code has 30 simulator steps of 0.1 s in a search
            step: the default. The published text says 20: ``substeps=20`` are as many in the same 3
            s, of 0.15 s each. At 30 the ferry's path is right to 10 cm; one substep of 3 s is
            unstable but for small motions and serves measurements of time.
        longest_delay: seconds, at most 40.
        delay_change, delay_easing, steering_change, noise: see above.

    Raises:
        ValueError: for an unknown scenario or disturbance, a scenario that is not finite or has
            other shapes, a delay beyond the buffer, substeps below 1, scales that are not positive
            and finite, and an easing above 1.

    Example:
        >>> import jax.numpy as jnp, jast
        >>> sim = jast.simulators.colav("head-on", substeps=5)
        >>> episode = jast.replay(sim, jnp.zeros(sim.horizon))  # no delay
        >>> bool(episode.failure)
        False
    """
    kinds = _kinds(disturbances)
    if isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1:
        raise ValueError(f"colav: substeps must be an int of at least 1, received {substeps!r}")
    try:
        noise_of_position, noise_of_velocity = noise
    except (TypeError, ValueError):
        must = "be a pair, of position (m) and velocity (m/s)"
        raise wrong("colav", "noise", must, f"{noise!r}") from None
    scales = positive(
        "colav",
        longest_delay=longest_delay,
        delay_change=delay_change,
        delay_easing=delay_easing,
        steering_change=steering_change,
        noise_of_position=noise_of_position,
        noise_of_velocity=noise_of_velocity,
    )
    for name, value, most, why in (
        ("longest_delay", longest_delay, BUFFER, " s, the past that is kept"),
        ("delay_easing", delay_easing, 1, ""),
    ):
        if not is_traced(value) and float(value) > most:
            raise ValueError(f"colav: {name} must be at most {most:g}{why}, received {value!r}")
    dtype = jnp.zeros(()).dtype
    *scales, place, speed = (a.astype(dtype) for a in scales)
    model = Model(
        _settled(scenario, dtype), *scales, jnp.stack([place, place, speed, speed]), kinds, substeps
    )
    return Simulator(
        init=Partial(_init, model),
        step=Partial(_step, model),
        disturbance=Partial(_disturbance, model),
        evaluate=_evaluate,
        horizon=model.scenario.route.shape[0],
        is_terminal=_is_terminal,
        observe=_observe,
    )


def _kinds(disturbances):
    """The kinds of disturbance as a tuple; ValueError for what is none."""
    kinds = tuple(disturbances) if isinstance(disturbances, tuple | list) else (disturbances,)
    if not kinds or not all(kind in KINDS for kind in kinds) or len(set(kinds)) != len(kinds):
        raise wrong("colav", "disturbances", f"be one or several of {KINDS}", f"{disturbances!r}")
    return kinds


def _settled(scenario, dtype):
    """The scenario as arrays, or a ValueError that says what is wrong with it."""
    if isinstance(scenario, str):
        scenario = SCENARIOS.get(scenario, scenario)
    if not isinstance(scenario, Scenario):
        received = repr(scenario) if isinstance(scenario, str) else type(scenario).__name__
        raise wrong("colav", "scenario", f"be one of {list(SCENARIOS)} or a Scenario", received)
    shapes = dict(
        adversary="three numbers (north, east, heading)",
        route="[steps, 3] (surge, sway, yaw rate)",
        ferry="three numbers (north, east, heading)",
    )
    arrays = {}
    for name, expected in shapes.items():
        value = getattr(scenario, name)
        try:
            a = jnp.asarray(value, dtype)
        except (TypeError, ValueError):
            must = f"be {expected}"
            raise wrong("colav", f"{name} of the scenario", must, f"{value!r}") from None
        if a.ndim != 1 + (name == "route") or a.shape[-1] != 3 or a.shape[0] < 1:
            raise wrong("colav", f"{name} of the scenario", f"be {expected}", f"shape {a.shape}")
        if not is_traced(a) and not np.isfinite(a).all():
            raise ValueError(f"colav: {name} of the scenario must be finite, received {value!r}")
        arrays[name] = a
    return Scenario(**arrays)


def _init(model, x0):
    start = model.scenario
    zero = jnp.zeros((), start.route.dtype)
    pose, (surge, sway, _) = vessels.Pose(*start.ferry), start.route[0]
    adversary = vessels.Adversary(
        vessels.Pose(*start.adversary), vessels.Velocity(surge, sway, zero)
    )
    now = _seen(adversary)
    return ColavState(
        pose=pose,
        velocity=vessels.Velocity(zero, zero, zero),
        control=vessels.Control(along=pose.n, speed=zero, sum_n=zero, sum_e=zero, sum_psi=zero),
        choice=jnp.int32(planner.FIRST),
        track=now,
        adversary=adversary,
        past=tracker.begin(now),
        step=jnp.int32(0),
        delay=zero,
        steering=zero + 0.5,
        near=jnp.sqrt(_apart(pose, adversary.pose)),
    )


def _disturbance(model, s):
    def of(kind):
        if kind == "delay":
            return D.tent(model.easing * s.delay, model.change)
        if kind == "steering":
            return D.tent(s.steering, model.swing)
        return D.MultivariateNormalDiag(jnp.zeros(4, s.delay.dtype), model.noise)

    if len(model.kinds) == 1:
        return of(model.kinds[0])
    return D.Joint({kind: of(kind) for kind in model.kinds})


def _step(model, s, x):
    x = {model.kinds[0]: x} if len(model.kinds) == 1 else x
    dtype, n = s.near.dtype, model.substeps
    zero = jnp.zeros((), dtype)
    delay = jnp.clip(x.get("delay", zero), 0, 1)
    steering = jnp.clip(x.get("steering", s.steering), 0, 1)
    noise = Track(*x.get("noise", jnp.zeros(4, dtype)))
    dt = PERIOD / n

    told = model.scenario.route[s.step]
    told = vessels.Velocity(told[0], told[1], told[2] + steering - 0.5)

    def sail(adversary, _):
        adversary = vessels.adversary_substep(adversary, told, dt)
        return adversary, adversary.pose

    # it minds nobody, so it may go first
    adversary, poses = lax.scan(sail, s.adversary, None, length=n)
    past = tracker.push(s.past, _seen(adversary))
    read = tracker.reader(past, s.step, delay * (jnp.minimum(model.longest, BUFFER) / PERIOD))
    choice = planner.plan(s.control.along, s.choice, s.track)
    speed = planner.speed_of(choice, dtype)

    def drive(carry, at):
        pose, velocity, control, track, near = carry
        since, adversary = at
        seen = Track(*(a + b for a, b in zip(read(since), noise, strict=True)))
        track = tracker.track(track, seen, dt)
        pose, velocity, control = vessels.ferry_substep(pose, velocity, control, speed, dt)
        return (pose, velocity, control, track, jnp.minimum(near, _apart(pose, adversary))), None

    start = (s.pose, s.velocity, s.control, s.track, zero + math.inf)
    since = jnp.arange(1, n + 1, dtype=dtype) / n
    (pose, velocity, control, track, near), _ = lax.scan(drive, start, (since, poses))
    return ColavState(
        pose=pose,
        velocity=velocity,
        control=control,
        choice=choice,
        track=track,
        adversary=adversary,
        past=past,
        step=s.step + 1,
        delay=delay,
        steering=steering,
        near=jnp.sqrt(near),
    )


def _evaluate(s):
    return s.near < COLLISION, s.near


def _is_terminal(s):
    return s.pose.n > DOCK


def _observe(s):
    """Twelve numbers: both vessels, the track's error, and the last disturbances; positions in
    units of 100 m.
    """
    p, a = s.pose, s.adversary.pose
    ferry = p.n / 100, p.e / 100, p.psi, s.velocity.u
    adversary = a.n / 100, a.e / 100, jnp.sin(a.psi), jnp.cos(a.psi)
    error = (s.track.n - a.n) / 100, (s.track.e - a.e) / 100
    return jnp.stack([*ferry, *adversary, *error, s.delay, s.steering])


def _seen(adversary):
    """The adversary's true `Track`."""
    return Track(*adversary.pose[:2], *vessels.pose_rate(*adversary)[:2])


def _apart(a, b):
    """Squared distance, m^2."""
    return (a.n - b.n) ** 2 + (a.e - b.e) ** 2
