"""An encounter of `jast.simulators.colav` as numbers, for its pictures: where both vessels are,
what the ferry believes and orders, and what disturbed it.
"""

from __future__ import annotations

from operator import index
from typing import NamedTuple

import jax
import numpy as np

from jast._src.plot import style
from jast._src.simulators.colav.planner import SPEEDS, STILL, ZONES
from jast._src.simulators.colav.system import COLLISION, ColavState
from jast._src.simulators.colav.tracker import PERIOD
from jast._src.simulators.svg_states import placed

__all__ = [
    "checked_moments",
    "by_kind",
    "headline",
    "limits",
    "log_of",
    "row_at",
    "states_of",
    "zone_outline",
]

OUTLINE = 200  # points of a zone's edge; a convention


class EncounterLog(NamedTuple):
    """What the pictures need of an episode's states, row by row."""

    ferry: np.ndarray
    """[steps + 1, 3]: east (m), north (m), heading (radians, without jumps)."""
    adversary: np.ndarray
    believed: np.ndarray
    order: np.ndarray
    """[steps + 1]: the speed (m/s) ordered at that state, for the step after it; the last stays."""


def states_of(caller, episode, sim):
    """s_0 .. s_length as NumPy arrays."""
    if style.one_episode(caller, episode).states is None and sim is None:
        must = "have states, or sim be the simulator to replay it on"
        raise style.wrong(caller, "episode", must, "neither")
    states = style.states_of(caller, episode, sim, "colav", ColavState)
    return jax.tree.map(lambda a: np.asarray(a)[: int(episode.length) + 1], states)


def log_of(states):
    track, adversary = states.track, states.adversary.pose
    still = np.hypot(track.v_n, track.v_e) < STILL  # as the planner has it
    course = np.where(still, 0, np.arctan2(track.v_e, track.v_n))
    rows = (
        (states.pose.e, states.pose.n, states.pose.psi),
        (adversary.e, adversary.n, adversary.psi),
        (track.e, track.n, course),
    )
    choice = np.concatenate([states.choice[1:], states.choice[-1:]])
    return EncounterLog(
        *(np.stack([e, n, np.unwrap(psi)], -1).astype(float) for e, n, psi in rows), SPEEDS[choice]
    )


def row_at(rows, t):
    """The row at ``t``, between two by a straight line; at a whole number the row itself."""
    return np.array([np.interp(t, np.arange(len(rows)), column) for column in rows.T])


def zone_outline(zone, n, e, course):
    """The edge of a zone around an obstacle at (n, e) on a course (radians): [OUTLINE, 2] of
    (e, n).
    """
    angle = np.linspace(0, 2 * np.pi, OUTLINE)
    ahead = np.cos(angle) * np.where(np.cos(angle) > 0, zone.forward, zone.aft)
    right = np.sin(angle) * np.where(np.sin(angle) > 0, zone.starboard, zone.port)
    return placed(ahead, right, e, n, course)


def limits(log, moments):
    """Corners (east, north) that hold the paths up to the last moment, and the high penalty region
    at each: the low one would make the ships small.
    """
    ships = [rows[: max(moments) + 1, :2] for rows in log[:3]]
    zones = [zone_outline(ZONES[1], *log.believed[t][[1, 0, 2]]) for t in moments]
    points = np.concatenate(ships + zones)
    return points.min(0) - 5, points.max(0) + 5


def checked_moments(caller, moments, states):
    last = len(states.step) - 1
    wrong = ValueError(
        f"plot.{caller}: moments must be at least 1, or step numbers in 0 .. {last}, received"
        f" {moments!r}"
    )
    try:
        if np.ndim(moments):
            chosen = [index(t) for t in moments]
        else:
            count, nearest = max(index(moments), 0), int(np.argmin(states.near))
            end = nearest if nearest >= count else last
            evenly = np.linspace(0, end, count + 1).round().astype(int)
            chosen = np.unique(evenly[1:])
    except TypeError:
        raise wrong from None
    if not len(chosen) or not all(0 <= t <= last for t in chosen):
        raise wrong
    return [int(t) for t in chosen]


def headline(episode, states):
    nearest = int(np.argmin(states.near))
    return style.headline(
        "Ferry and adversary",
        episode,
        f"\nclosest approach {states.near[nearest]:.2f} m by t = {nearest * PERIOD:g} s (collision:"
        f" below {COLLISION:g} m)",
    )


def by_kind(episode, states, sim):
    """``{label: {name: [steps] values}}``, a label for each kind of disturbance."""
    n, x = int(episode.length), episode.disturbances
    model = next(iter(getattr(getattr(sim, "init", None), "args", ())), None)
    if not isinstance(x, dict):  # one kind: which, the simulator says, or what the states remember
        kind = "noise" if np.ndim(x) == 2 else "delay"
        if kind == "delay" and not states.delay.any():
            same = np.allclose(np.clip(x[:n], 0, 1), states.steering[1:])
            kind = "steering" if same else "delay"
        x = {model.kinds[0] if hasattr(model, "kinds") else kind: x}
    x = {kind: np.asarray(a, float)[:n] for kind, a in x.items()}
    longest = getattr(model, "longest", None)
    rows = {}
    if "delay" in x and longest is None:
        rows["delay (share)"] = {"": x["delay"]}
    elif "delay" in x:
        rows["delay (s)"] = {"": x["delay"] * float(longest)}
    if "steering" in x:
        rows["steering (rad/s)"] = {"": x["steering"] - 0.5}
    if "noise" in x:
        position, velocity = (np.hypot(*x["noise"][:, i : i + 2].T) for i in (0, 2))
        rows["size of noise"] = {"position (m)": position, "velocity (m/s)": velocity}
    return rows
