"""The trajectory predictor and the routes that disturb it, as one `Simulator`; its paths and miss
distances for users and pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jast import distributions as D
from jast._src.core.episode import Episode, replay
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Numeric
from jast._src.simulators.fms import events
from jast._src.simulators.fms.database import APART, KLAX, KSFO, POSITIONS
from jast._src.simulators.fms.events import Misses
from jast._src.simulators.fms.geodesic import EARTHS, Earth, direct
from jast._src.simulators.fms.lateral import KNOT, NMI, Build, Path, lateral
from jast._src.util.checks import real_number, truth_value, whole_number, wrong

__all__ = ["MEANS", "SIGMAS", "FmsState", "fms", "fms_misses", "fms_path"]

MEANS = (180.0, 50.0, -88.5, 66.8)
SIGMAS = (45.0, 30.0, 39.5, 24.4)
"""Of x: true course (degrees), distance (nmi), wind direction (degrees), wind speed (kt). Standard
deviations, although the source calls them covariances.
"""


class FmsState(NamedTuple):
    """The route so far, of at most T waypoints. Rows that are not yet filled are zero."""

    t: jax.Array
    """int32: waypoints so far."""
    waypoints: jax.Array
    """[T, 2]: latitude and longitude (degrees)."""
    winds: jax.Array
    """[T, 2]: direction blown towards (degrees) and speed (kt) at each."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Model:
    """What the simulator's functions know: the predictor's settings (traced), how many waypoints
    and which event (static).
    """

    build: Build
    waypoints: int = field(metadata=dict(static=True))
    event: str = field(metadata=dict(static=True))


def fms(
    eps: Numeric = 0.03,
    bank: Numeric = 23.3,
    tas: Numeric = 450.0,
    waypoints: int = 12,
    guard: Literal["s-turns", "all"] = "s-turns",
    event: Literal["arc length", "kink", "disconnection", "course"] = "arc length",
    fixed: bool = False,
    *,
    earth: Literal["wgs84", "sphere"] = "wgs84",
    snap: bool = True,
    database: bool = False,
) -> Simulator:
    """A path predictor on routes from KSFO to KLAX: an episodic `Simulator`. A step places the next
    waypoint; the path is judged at the end.

    x [4] are four normals (`MEANS`, `SIGMAS`): true course (degrees) and distance (nmi) from the
    last waypoint, negative ones backwards; wind direction (degrees, blown towards) and speed (kt).
    Only the event "arc length" sees the defect, and with ``snap=False`` only "disconnection".

    Args:
        eps: nmi. The defect acts on legs shorter than that; traced, like what is not static.
        bank: degrees; sets the radii of turns, like ``tas``.
        tas: true air speed (kt).
        waypoints: steps of an episode; static.
        guard: the defect acts where the turns at both ends of the leg have opposite senses
            ("s-turns"), or always ("all").
        event: which miss distance counts, a failure where it is not positive: "arc length", "kink"
            (radians), "disconnection" (ft) or "course" (radians); static. `fms_misses` gives all
            four.
        fixed: the defect never acts: a negative control, on which a search must find nothing.
        earth: "wgs84" or "sphere".
        snap: False leaves overlapping turns disconnected.
        database: the next waypoint is one of 26 named beacons more than 5 nmi away, all as likely
            as each other: x = {"fix": int, "wind": [2]}, a baseline on which nothing fails; static.

    Raises:
        ValueError: unless it is made and used in float64, inside ``with jax.enable_x64(True):`` or
            with JAX_ENABLE_X64=1; and for settings out of range.

    Example:
        >>> import jax, jast
        >>> with jax.enable_x64(True):
        ...     episode = jast.rollout(jax.random.key(0), jast.simulators.fms(waypoints=3))
        >>> int(episode.length)
        3
    """
    _double()
    waypoints = whole_number("fms", "waypoints", waypoints)
    for name, value, known in (
        ("guard", guard, ("s-turns", "all")),
        ("event", event, (*events.EVENTS,)),
        ("earth", earth, (*EARTHS,)),
    ):
        if value not in known:
            raise wrong("fms", name, f"be one of {', '.join(map(repr, known))}", f"{value!r}")
    truth_value("fms", fixed=fixed, snap=snap, database=database)
    eps = real_number("fms", "eps", eps, lambda v: 0 <= v < jnp.inf, "of nmi, at least 0")
    bank = real_number("fms", "bank", bank, lambda v: 0 < v < 90, "of degrees between 0 and 90")
    tas = real_number("fms", "tas", tas, lambda v: 0 < v < jnp.inf, "of knots, positive")
    eps, bank, tas = (
        jnp.asarray(v, jnp.float64)
        for v in (eps * (0.0 if fixed else NMI), jnp.radians(bank), tas * KNOT)
    )
    build = Build(
        eps=eps,
        every=jnp.asarray(guard == "all"),
        bank=bank,
        tas=tas,
        snap=jnp.asarray(snap),
        earth=Earth(*(jnp.asarray(v, jnp.float64) for v in EARTHS[earth])),
    )
    model = Model(build, waypoints, event)
    step, disturbance = (
        (_step_database, _disturbance_database) if database else (_step, _disturbance)
    )
    return Simulator(
        init=Partial(_init, model),
        step=Partial(step, model),
        disturbance=Partial(disturbance, model),
        evaluate=Partial(_evaluate, model),
        horizon=waypoints,
        observe=_observe,
        episodic=True,
    )


def fms_path(sim: Simulator, episode: Episode | FmsState) -> Path:
    """The lateral path of an episode of `fms`.

    Args:
        sim: a simulator of `fms`.
        episode: an `Episode`, or an `FmsState`.

    Returns:
        `jast.simulators.fms.Path`.

    Raises:
        ValueError: for a simulator or an episode of another system.

    Example:
        >>> import jax, jast
        >>> with jax.enable_x64(True):
        ...     sim = jast.simulators.fms(waypoints=3)
        ...     path = jast.simulators.fms_path(sim, jast.rollout(jax.random.key(0), sim))
        >>> type(path).__name__
        'Path'
    """
    return _path(*_route("fms_path", sim, episode))


def fms_misses(sim: Simulator, episode: Episode | FmsState) -> Misses:
    """The miss distances of all four events of an episode of `fms`.

    Args:
        sim: a simulator of `fms`.
        episode: an `Episode`, or an `FmsState`.

    Returns:
        `jast.simulators.fms.Misses`.

    Raises:
        ValueError: as `fms_path`.

    Example:
        >>> import jax, jast
        >>> with jax.enable_x64(True):
        ...     sim = jast.simulators.fms(waypoints=3)
        ...     misses = jast.simulators.fms_misses(sim, jast.rollout(jax.random.key(0), sim))
        >>> len(misses)
        4
    """
    return _misses(*_route("fms_misses", sim, episode))


def _route(caller, sim, episode):
    model = next(iter(getattr(getattr(sim, "init", None), "args", ())), None)
    if not isinstance(model, Model):
        raise wrong(caller, "sim", "be a jast.simulators.fms()", type(sim).__name__)
    state = episode
    if isinstance(episode, Episode):
        states = replay(sim, episode).states if episode.states is None else episode.states
        state = jax.tree.map(lambda a: jnp.asarray(a)[episode.length], states)
    if not isinstance(state, FmsState) or jnp.shape(state.waypoints) != (model.waypoints, 2):
        must = f"be one Episode or FmsState of {model.waypoints} waypoints"
        raise wrong(caller, "episode", must, type(state).__name__)
    _double()
    return model, state


@jax.jit
def _path(model, s):
    waypoints = jnp.concatenate([_point(KSFO)[None], s.waypoints, _point(KLAX)[None]])
    return lateral(model.build, waypoints, s.winds, s.t)


@jax.jit
def _misses(model, s):
    return events.misses(model.build.earth, _path(model, s))


@jax.jit
def _evaluate(model, s):
    distance = events.EVENTS[model.event](model.build.earth, _path(model, s))
    return distance <= 0, distance


def _init(model, x0):
    _double()
    rows = jnp.zeros((model.waypoints, 2), jnp.float64)
    return FmsState(jnp.zeros((), jnp.int32), rows, rows)


@jax.jit
def _step(model, s, x):
    point, _ = direct(model.build.earth, _last(s), jnp.radians(x[0]), x[1] * NMI)
    return _append(s, point, x[2:])


def _step_database(model, s, x):
    return _append(s, jnp.asarray(POSITIONS)[x["fix"]], x["wind"])


def _append(s, point, wind):
    return FmsState(s.t + 1, s.waypoints.at[s.t].set(point), s.winds.at[s.t].set(wind))


def _disturbance(model, s):
    return _normals(slice(0, 4))


def _disturbance_database(model, s):
    apart = jnp.asarray(APART)  # rows: the beacons, KSFO, KLAX
    here = jnp.append(jnp.all(POSITIONS == _last(s)[None], axis=1), s.t == 0)
    may = jnp.any(apart[:-1] & here[:, None], axis=0) & (apart[-1] | (s.t < model.waypoints - 1))
    return D.Joint(
        {"fix": D.Categorical(logits=jnp.where(may, 0.0, -jnp.inf)), "wind": _normals(slice(2, 4))}
    )


def _normals(which):
    return D.Independent(
        D.Normal(jnp.asarray(MEANS[which], jnp.float64), jnp.asarray(SIGMAS[which], jnp.float64)), 1
    )


def _last(s, back=0):
    """The waypoint that is ``back`` before the last one of the route so far, KSFO before all."""
    at = s.t - back
    return jnp.where(at > 0, s.waypoints[jnp.maximum(at - 1, 0)], _point(KSFO))


def _observe(s):
    """The share of the waypoints that are placed; the way to KLAX and the last leg, north and east
    (100 nmi, as on a plane); the last wind.
    """
    here, goal = _last(s), _point(KLAX)
    east = jnp.stack([jnp.ones(()), jnp.cos(jnp.radians(goal[0]))])
    ways = jnp.concatenate([goal - here, here - _last(s, 1)]) * 0.6 * jnp.concatenate([east, east])
    wind = s.winds[jnp.maximum(s.t - 1, 0)]
    course = jnp.radians(wind[0])
    placed = s.t.astype(jnp.float64) / len(s.waypoints)
    last_wind = jnp.stack([wind[1] / 100, jnp.sin(course), jnp.cos(course)])
    return jnp.concatenate([placed[None], ways, last_wind])


def _point(degrees):
    return jnp.asarray(degrees, jnp.float64)


def _double():
    if not jax.config.jax_enable_x64:
        raise ValueError(
            "fms: float64 is needed, make and use it inside `with jax.enable_x64(True):`, received"
            " jax_enable_x64=False"
        )
