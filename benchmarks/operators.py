"""Closed loops whose probability of failure is known exactly: the transition operator of each, on
a grid of its state, and `easier`, which compares these operators with plain draws in NumPy where
failures are frequent. `benchmarks.closed_loops` makes simulators of them.
"""

import math

import jax.numpy as jnp
import numpy as np
from scipy import stats

__all__ = ["EASIER", "OPERATORS", "SYSTEMS", "easier"]


def breaker_step(s, w):
    """A breaker trips where four surges in a row are above 1.9: nothing shows before."""
    row = jnp.where(w > 1.9, s[0] + 1, 0.0)
    return jnp.stack([row, jnp.maximum(s[1], 1.0 * (row >= 4))])


def breaker_distance(s):
    """1 until it has tripped."""
    return 1 - s[1]


TANK = dict(fill=0.08, drain=0.25, noise=0.11, low=0.5, high=1.5, most=2.4, steps=150)


def tank_step(s, w):
    """A tank's level and its pump, which starts above 1.5 and stops below .5."""
    level, pump = s
    pump = jnp.where(level > TANK["high"], 1.0, jnp.where(level < TANK["low"], 0.0, pump))
    flow = TANK["fill"] - TANK["drain"] * pump + TANK["noise"] * w
    return jnp.stack([jnp.maximum(level + flow, 0.0), pump])


STORE = dict(stock=30, order=12, below=18, mean=3.8, spread=1.4, steps=100, shelf=40)


def store_step(s, w):
    """Stock of a store that orders 12 where it has fewer than 18; demand is a rounded normal
    number, and what cannot be sold is lost.
    """
    stock = s[0]
    demand = jnp.clip(jnp.round(STORE["mean"] + STORE["spread"] * w), 0.0, 15.0)
    ordered = jnp.where(stock < STORE["below"], float(STORE["order"]), 0.0)
    return jnp.stack([jnp.maximum(stock - demand, 0.0) + ordered, jnp.maximum(demand - stock, 0.0)])


def store_distance(s):
    """1 and what is left in the store, in whole items, until demand was not met."""
    return jnp.where(s[1] > 0, 0.0, 1 + s[0])


def tank_probability(cells: int = 2400) -> float:
    """By the transition operator of the level and the pump on a grid of ``cells``."""
    t = TANK
    edges = np.linspace(0, t["most"], cells + 1)
    middle = (edges[:-1] + edges[1:]) / 2

    def on_next(pump):
        return np.where(middle > t["high"], 1.0, np.where(middle < t["low"], 0.0, pump))

    # by the mode after the switch: where the level goes from each cell
    kernels = []
    for pump in (0.0, 1.0):
        mean = middle + t["fill"] - t["drain"] * pump
        below = stats.norm.cdf((edges[None] - mean[:, None]) / t["noise"])
        below[:, 0] = 0.0  # the level stays at 0 at least: the first cell holds that atom
        kernels.append(np.diff(below, axis=1))
    mass = np.zeros((2, cells))
    mass[0, np.searchsorted(edges, 1.0) - 1] = 1.0
    for _ in range(t["steps"]):
        switched = np.zeros_like(mass)
        for pump in (0, 1):
            after = on_next(float(pump))
            for new in (0, 1):
                switched[new] += np.where(after == new, mass[pump], 0)
        mass = np.stack([switched[i] @ kernels[i] for i in (0, 1)])
    return float(1 - mass.sum())


def store_probability() -> float:
    """By the transition matrix of the stock: some demand is not met in 100 steps."""
    t = STORE
    demands = np.arange(16)
    edges = (np.concatenate([[-np.inf], demands[:-1] + 0.5, [np.inf]]) - t["mean"]) / t["spread"]
    chance = np.diff(stats.norm.cdf(edges))
    tail = stats.norm.sf((demands - 0.5 - t["mean"]) / t["spread"])
    kept, lost = np.zeros(60), 0.0
    kept[t["stock"]] = 1.0
    for _ in range(t["steps"]):
        new = np.zeros(60)
        for stock in np.flatnonzero(kept):
            ordered = t["order"] if stock < t["below"] else 0
            met = demands[demands <= stock]
            np.add.at(new, stock - met + ordered, kept[stock] * chance[: len(met)])
            if stock < 15:
                lost += kept[stock] * tail[stock + 1]
        kept = new
    return float(lost)


def breaker_probability() -> float:
    """By the chain of how many surges in a row there were."""
    surge = stats.norm.sf(1.9)
    row, total = np.eye(4)[0], 0.0
    for _ in range(80):
        total += row[3] * surge
        row = np.append(row.sum() * (1 - surge), row[:3] * surge)
    return float(total)


OVEN = dict(
    start=1.5,
    loss=0.06,
    heat=0.22,
    noise=0.085,
    low=1.2,
    high=1.8,
    trip=2.3,
    least=-0.7,
    most=2.4,
    steps=120,
)


def oven_step(s, w):
    """An oven's temperature and its heater: 0 off, 1 on, 2 tripped. It heats below 1.2 until it is
    above 1.8; above 2.3 it trips for good, and what is in it may freeze.
    """
    heat, mode = s
    new = jnp.where(heat < OVEN["low"], 1.0, jnp.where(heat > OVEN["high"], 0.0, mode))
    mode = jnp.where((mode > 1) | (heat > OVEN["trip"]), 2.0, new)
    heat = heat - OVEN["loss"] * heat + OVEN["heat"] * (mode == 1) + OVEN["noise"] * w
    return jnp.stack([heat, mode])


def oven_distance(s):
    """To the nearer of too hot and frozen."""
    return jnp.minimum(OVEN["most"] - s[0], s[0] - OVEN["least"])


def oven_probability(cells: int, t: dict = OVEN) -> float:
    """By the transition operator of the temperature in each mode of the heater. The cells are at
    least ``cells``, with an edge at each threshold (a multiple of .05).
    """
    parts = round((t["most"] - t["least"]) / 0.05)
    edges = np.linspace(t["least"], t["most"], parts * -(-cells // parts) + 1)
    middle = (edges[:-1] + edges[1:]) / 2
    kernels = [
        _moved(edges, middle - t["loss"] * middle + t["heat"] * (mode == 1), t["noise"])
        for mode in range(3)
    ]
    switched = [
        np.where(middle < t["low"], 1, np.where(middle > t["high"], 0, mode)) for mode in (0, 1)
    ]
    switched = [np.where(middle > t["trip"], 2, new) for new in switched]
    switched.append(np.full(len(middle), 2))
    mass = np.zeros((3, len(middle)))
    mass[0] = _moved(edges, np.array([(1 - t["loss"]) * t["start"]]), t["noise"])[0]
    for _ in range(t["steps"] - 1):
        to = np.zeros_like(mass)
        for mode in range(3):
            for new in range(3):
                to[new] += np.where(switched[mode] == new, mass[mode], 0)
        mass = np.stack([to[mode] @ kernels[mode] for mode in range(3)])
    return float(1 - mass.sum())


RAIL = dict(dead=0.3, gain=0.35, reach=0.25, drift=0.02, noise=0.18, left=-1.75, right=1.9)
RAIL_STEPS = 150


def rail_step(s, w):
    """A cart's offset on a rail that leans to the right; its correction has a dead zone and
    saturates.
    """
    beyond = jnp.sign(s) * jnp.maximum(jnp.abs(s) - RAIL["dead"], 0.0)
    push = jnp.clip(RAIL["gain"] * beyond, -RAIL["reach"], RAIL["reach"])
    return s - push + RAIL["drift"] + RAIL["noise"] * w


def rail_distance(s):
    """To the nearer end of the rail."""
    return jnp.minimum(RAIL["right"] - s[0], s[0] - RAIL["left"])


def rail_probability(cells: int, t: dict = RAIL) -> float:
    """By the transition operator of the offset."""
    edges = np.linspace(t["left"], t["right"], cells + 1)
    middle = (edges[:-1] + edges[1:]) / 2
    beyond = np.sign(middle) * np.maximum(np.abs(middle) - t["dead"], 0.0)
    push = np.clip(t["gain"] * beyond, -t["reach"], t["reach"])
    kernel = _moved(edges, middle - push + t["drift"], t["noise"])
    mass = _moved(edges, np.array([t["drift"]]), t["noise"])[0]
    for _ in range(RAIL_STEPS - 1):
        mass = mass @ kernel
    return float(1 - mass.sum())


def _moved(edges, means, noise):
    """The mass that each mean [m] sends into each cell: [m, cells]."""
    return np.diff(stats.norm.cdf((edges - means[:, None]) / noise), axis=1)


FREEZER = dict(rise=0.05, cool=0.2, noise=0.1, low=0.0, high=1.0, rest=12, most=2.3, steps=120)


def freezer_step(s, w):
    """A freezer's temperature, whether its compressor runs, and how long that must still rest: it
    starts above 1, stops below 0, and then rests for 12 steps.
    """
    heat, on, rest = s
    stops = (on > 0) & (heat < FREEZER["low"])
    starts = (on == 0) & (heat > FREEZER["high"]) & (rest == 0)
    on = jnp.where(stops, 0.0, jnp.where(starts, 1.0, on))
    rest = jnp.where(stops, float(FREEZER["rest"]), jnp.maximum(rest - 1, 0.0))
    heat = heat + FREEZER["rise"] - FREEZER["cool"] * on + FREEZER["noise"] * w
    return jnp.stack([heat, on, rest])


def freezer_distance(s):
    """To thawing."""
    return FREEZER["most"] - s[0]


def freezer_probability(cells: int = 2400, t: dict = FREEZER) -> float:
    """By the transition operator of the temperature in each mode: the compressor off and rested,
    with 1 to 12 steps to rest, and on.
    """
    most, running = t["rest"], t["rest"] + 1
    edges = np.linspace(t["most"] - 6, t["most"], cells + 1)  # none is colder
    middle = (edges[:-1] + edges[1:]) / 2
    off, on = (_moved(edges, middle + t["rise"] - c, t["noise"]) for c in (0.0, t["cool"]))
    mass = np.zeros((most + 2, cells))
    mass[0] = _moved(edges, np.array([0.5 + t["rise"]]), t["noise"])[0]
    for _ in range(t["steps"] - 1):
        to = np.zeros_like(mass)
        starts, stops = middle > t["high"], middle < t["low"]
        to[0] = mass[0] * ~starts + mass[1]
        to[1:most] = mass[2:running]
        to[most] = mass[running] * stops
        to[running] = mass[0] * starts + mass[running] * ~stops
        mass = np.concatenate([to[:running] @ off, to[running:] @ on])
    return float(1 - mass.sum())


PACKETS = dict(mean=2.0, spread=1.3, slow=1, fast=3, low=3, high=10, most=24, steps=150)


def packets_step(s, w):
    """Packets that wait, and whether they are sent fast: from more than 10 until fewer than 3."""
    waiting, fast = s
    fast = jnp.where(waiting > PACKETS["high"], 1.0, jnp.where(waiting < PACKETS["low"], 0.0, fast))
    came = jnp.clip(jnp.round(PACKETS["mean"] + PACKETS["spread"] * w), 0.0, 8.0)
    sent = jnp.where(fast > 0, float(PACKETS["fast"]), float(PACKETS["slow"]))
    return jnp.stack([jnp.maximum(waiting + came - sent, 0.0), fast])


def packets_distance(s):
    """Places that are left, in whole packets."""
    return PACKETS["most"] - s[0]


def packets_probability(t: dict = PACKETS) -> float:
    """By the transition matrix of the packets: the places are full once in 150 steps."""
    edges = (np.concatenate([[-np.inf], np.arange(8) + 0.5, [np.inf]]) - t["mean"]) / t["spread"]
    chance = np.diff(stats.norm.cdf(edges))
    mass = np.zeros((2, t["most"]))
    mass[0, 0] = 1.0
    for _ in range(t["steps"]):
        to = np.zeros_like(mass)
        for fast in (0, 1):
            for waiting in range(t["most"]):
                now = 1 if waiting > t["high"] else 0 if waiting < t["low"] else fast
                sent = t["fast"] if now else t["slow"]
                for came, p in enumerate(chance):
                    if (left := max(waiting + came - sent, 0)) < t["most"]:
                        to[now, left] += mass[fast, waiting] * p
        mass = to
    return float(1 - mass.sum())


SYSTEMS = {
    "breaker": ([0.0, 0.0], breaker_step, breaker_distance, 80),
    "tank": ([1.0, 0.0], tank_step, lambda s: TANK["most"] - s[0], TANK["steps"]),
    "store": ([STORE["stock"], 0.0], store_step, store_distance, STORE["steps"]),
    "oven": ([OVEN["start"], 0.0], oven_step, oven_distance, OVEN["steps"]),
    "rail": ([0.0], rail_step, rail_distance, RAIL_STEPS),
    "freezer": ([0.5, 0.0, 0.0], freezer_step, freezer_distance, FREEZER["steps"]),
    "packets": ([0.0, 0.0], packets_step, packets_distance, PACKETS["steps"]),
}
"""Of each its first state, its step and distance, and its steps, with one normal number each."""
OPERATORS = {
    "breaker": lambda cells: breaker_probability(),
    "tank": tank_probability,
    "store": lambda cells: store_probability(),
    "oven": oven_probability,
    "rail": rail_probability,
    "freezer": freezer_probability,
    "packets": lambda cells: packets_probability(),
}


def easier(draws: int, cells: int, seed: int = 0) -> dict[str, dict]:
    """The operators against plain draws in NumPy where failures are frequent."""
    rows = {}
    rng = np.random.default_rng(seed)
    for name, (settings, change, probability, fails) in EASIER.items():
        kept = dict(settings)
        settings.update(change)
        try:
            truth = probability(cells)
            failing = sum(
                int(np.sum(fails(rng, min(draws, 10_000)))) for _ in range(max(draws // 10_000, 1))
            )
        finally:
            settings.update(kept)
        drawn = min(draws, 10_000) * max(draws // 10_000, 1)
        error = math.sqrt(truth * (1 - truth) / drawn)
        rows[name] = dict(operator=truth, drawn=failing / drawn)
        rows[name]["apart"] = abs(failing / drawn - truth) / error
    return rows


def _tank_fails(rng, n):
    t = TANK
    level, pump, failed = np.full(n, 1.0), np.zeros(n), np.zeros(n, bool)
    for _ in range(t["steps"]):
        pump = np.where(level > t["high"], 1.0, np.where(level < t["low"], 0.0, pump))
        flow = t["fill"] - t["drain"] * pump + t["noise"] * rng.standard_normal(n)
        level = np.maximum(level + flow, 0.0)
        failed |= level >= t["most"]
    return failed


def _store_fails(rng, n):
    t = STORE
    stock, failed = np.full(n, t["stock"]), np.zeros(n, bool)
    for _ in range(t["steps"]):
        demand = np.round(t["mean"] + t["spread"] * rng.standard_normal(n))
        demand = np.clip(demand, 0, 15).astype(int)
        failed |= demand > stock
        stock = np.maximum(stock - demand, 0) + np.where(stock < t["below"], t["order"], 0)
    return failed


def _oven_fails(rng, n):
    t = OVEN
    heat, mode, failed = np.full(n, t["start"]), np.zeros(n), np.zeros(n, bool)
    for _ in range(t["steps"]):
        new = np.where(heat < t["low"], 1, np.where(heat > t["high"], 0, mode))
        mode = np.where((mode == 2) | (heat > t["trip"]), 2, new)
        noise = t["noise"] * rng.standard_normal(n)
        heat = heat - t["loss"] * heat + t["heat"] * (mode == 1) + noise
        failed |= (heat >= t["most"]) | (heat <= t["least"])
    return failed


def _rail_fails(rng, n):
    t = RAIL
    offset, failed = np.zeros(n), np.zeros(n, bool)
    for _ in range(RAIL_STEPS):
        beyond = np.sign(offset) * np.maximum(np.abs(offset) - t["dead"], 0.0)
        push = np.clip(t["gain"] * beyond, -t["reach"], t["reach"])
        offset = offset - push + t["drift"] + t["noise"] * rng.standard_normal(n)
        failed |= (offset >= t["right"]) | (offset <= t["left"])
    return failed


def _freezer_fails(rng, n):
    t = FREEZER
    heat, on, rest, failed = np.full(n, 0.5), np.zeros(n, bool), np.zeros(n), np.zeros(n, bool)
    for _ in range(t["steps"]):
        stops, starts = on & (heat < t["low"]), ~on & (heat > t["high"]) & (rest == 0)
        on = (on | starts) & ~stops
        rest = np.where(stops, t["rest"], np.maximum(rest - 1, 0))
        heat = heat + t["rise"] - t["cool"] * on + t["noise"] * rng.standard_normal(n)
        failed |= heat >= t["most"]
    return failed


def _packets_fails(rng, n):
    t = PACKETS
    waiting, fast, failed = np.zeros(n, int), np.zeros(n, bool), np.zeros(n, bool)
    for _ in range(t["steps"]):
        fast = (fast | (waiting > t["high"])) & (waiting >= t["low"])
        came = np.clip(np.round(t["mean"] + t["spread"] * rng.standard_normal(n)), 0, 8).astype(int)
        waiting = np.maximum(waiting + came - np.where(fast, t["fast"], t["slow"]), 0)
        failed |= waiting >= t["most"]
    return failed


EASIER = {
    "tank": (TANK, {"most": 2.0}, tank_probability, _tank_fails),
    "store": (STORE, {"spread": 2.4}, lambda cells: store_probability(), _store_fails),
    "oven": (OVEN, {"trip": 2.0, "least": 0.2, "most": 2.2}, oven_probability, _oven_fails),
    "rail": (RAIL, {"left": -1.2, "right": 1.3}, rail_probability, _rail_fails),
    "freezer": (FREEZER, {"most": 1.5}, freezer_probability, _freezer_fails),
    "packets": (PACKETS, {"most": 16}, lambda cells: packets_probability(), _packets_fails),
}
