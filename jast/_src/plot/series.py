"""What the pictures of general systems are drawn from: episodes of any source, played again, as
named numbers over the steps.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.blackbox.states import Record, Standing
from jast._src.core.episode import Episode, replay, rollout, stacked
from jast._src.core.failures import Failures
from jast._src.core.policy import undisturbed
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.io.codec import name_of
from jast._src.page.episode_data import far
from jast._src.plot import style
from jast._src.runtime.host_errors import runs_on_host
from jast._src.search.refine.modes import Mode, Modes, owners
from jast._src.search.result import SearchResult
from jast._src.util.checks import instance, whole_number
from jast._src.util.leaf_names import named_numbers
from jast._src.util.pytrees import index_tree, merge_axes
from jast.estimate import FailureSamples

__all__ = [
    "DISTANCE",
    "Samples",
    "Series",
    "choose_fields",
    "replays_without_calls",
    "samples_of",
    "by_mode",
    "series_of",
    "nominal_series",
    "undisturbed_series",
]

DISTANCE = "miss distance"
DRAWS = 200  # nominal episodes of a band


class Samples(NamedTuple):
    """Episodes that are to be drawn."""

    episodes: Episode
    """[n]"""
    sim: Simulator
    mode: np.ndarray | None
    """[n] int: which failure mode each is of, from 0; None where there are no modes"""


class Series(NamedTuple):
    """Numbers of episodes over their steps."""

    columns: dict[str, np.ndarray]
    """name -> [n, horizon + 1]; NaN behind the end, and at step 0 where a number has none"""
    length: np.ndarray
    """[n]"""
    state: tuple[str, ...]
    """Which of the names are drawn where nobody chooses: those of the state, if it has any"""


def samples_of(caller: str, samples: Any, sim: Any, modes: Any, most: int) -> Samples:
    """At most ``most`` episodes of ``samples``, evenly taken.

    Args:
        caller: for messages.
        samples: a `Report`, `Modes`, a result of a search, its archive, `FailureSamples`, one
            `Episode` or a batch of them.
        sim: their simulator; None where a report has it.
        modes: `Modes`, a number for each of the episodes, or None: those of a report, else none.
        most: at least 1.
    """
    most = whole_number(f"plot.{caller}", "most", most)
    source = samples
    if name_of(samples) == "Report":
        sim = samples.sim if sim is None else sim
        modes = samples.modes if modes is None else modes
        samples = samples.failures
    instance(f"plot.{caller}", "sim", sim, Simulator, "the jast.Simulator of the episodes")
    if isinstance(samples, Mode):
        samples = Modes([samples])
    if isinstance(samples, Modes) and len(samples):
        modes = np.arange(len(samples)) if modes is None else modes
        samples = stacked(m.failure for m in samples)
    if isinstance(samples, SearchResult | FailureSamples):
        samples = samples.failures
    samples = samples.episodes if isinstance(samples, Failures) else samples
    if isinstance(samples, Episode) and not np.ndim(samples.length):
        samples = index_tree(samples, None)
    if not isinstance(samples, Episode) or np.ndim(samples.length) != 1 or not len(samples.length):
        received = f"a {type(source).__name__} without any"
        if isinstance(samples, Episode):
            received = f"leading axes {np.shape(samples.length)}"
        raise ValueError(
            f"plot.{caller}: samples must be failures (a report, modes, a result of a search,"
            f" FailureSamples) or Episodes with one leading axis, received {received}"
        )
    n = len(samples.length)
    rows = np.unique(np.linspace(0, n - 1, min(most, n)).round().astype(int))
    few = index_tree(samples, rows)
    if modes is None or (isinstance(modes, Modes) and not len(modes)):
        return Samples(few, sim, None)
    if isinstance(modes, Modes):
        likeliest = stacked(m.failure for m in modes)
        return Samples(few, sim, owners(sim, few._replace(states=None), likeliest))
    numbers = np.asarray(modes)
    if numbers.shape != (n,) or numbers.dtype.kind not in "iu" or numbers.min() < 0:
        must = f"be jast.search.Modes, or the number of its mode from 0 for each of {n} episodes"
        raise style.wrong(caller, "modes", must, f"{modes!r}")
    return Samples(few, sim, numbers[rows])


def by_mode(g: Samples) -> list[tuple[np.ndarray, str, str, str]]:
    """(which episodes, colour, mark, words of the legend) of each mode, or of all in one."""
    noun = "failure" if np.asarray(g.episodes.failure).all() else "episode"
    if g.mode is None:
        n = len(g.episodes.length)
        return [(np.arange(n), *style.look(1), style.count_of(n, noun))]
    each = [(k, np.flatnonzero(g.mode == k)) for k in np.unique(g.mode)]
    return [
        (own, *style.look(k), f"mode {k + 1}: {style.count_of(len(own), noun)}") for k, own in each
    ]


def series_of(sim: Simulator, episodes: Episode) -> Series:
    """The numbers of the states of ``episodes`` [n], their miss distance, and their disturbances as
    "disturbance ...". Without states they are replayed; a black box with states is run once an
    episode then.
    """
    like, states = signature_of(sim).state, episodes.states
    if states is None and not isinstance(like, Record):
        states = (_states if runs_on_host(sim) else _compiled_states)(sim, episodes)
    length = np.asarray(episodes.length)
    there = np.arange(sim.horizon + 1) <= length[:, None]
    box = isinstance(like, Record | Standing)  # a record of the disturbances, then
    state = dict(seen=states.seen) if isinstance(like, Standing) else states
    columns = {} if isinstance(like, Record) else _columns(state, "state", there)
    if isinstance(like, Standing):
        columns[DISTANCE] = np.where(there, np.asarray(states.distance, float), np.nan)
    elif not sim.episodic and not box:
        distance = np.asarray(far(sim, merge_axes(states)), float).reshape(there.shape)
        columns[DISTANCE] = np.where(there, distance, np.nan)
    own = tuple(columns)
    late = jax.tree.map(lambda a: _from_step_1(a, sim.horizon), episodes.disturbances)
    for name, values in _columns(late, "disturbance", there).items():
        columns[name if name.startswith("disturbance") else f"disturbance {name}"] = values
    return Series(columns, length, own or tuple(columns))


def replays_without_calls(sim: Simulator) -> bool:
    """Whether `series_of` calls no black box."""
    return not runs_on_host(sim) or isinstance(signature_of(sim).state, Record)


_states = jax.vmap(lambda sim, episode: replay(sim, episode).states, (None, 0))
_drawn = jax.vmap(rollout, (0, None))
_compiled_states, _compiled_draws = jax.jit(_states), jax.jit(_drawn)


def _columns(tree: Any, root: str, there: np.ndarray) -> dict[str, np.ndarray]:
    found = named_numbers(tree, root, lead=2)
    return {name: np.where(there, values, np.nan) for name, values in found}


def _from_step_1(a: np.ndarray, horizon: int) -> np.ndarray:
    """[n, horizon + 1, ...]: the disturbance of step t led to state t."""
    a = np.asarray(a, float)
    out = np.full((len(a), horizon + 1, *a.shape[2:]), np.nan)
    out[:, 1 : a.shape[1] + 1] = a
    return out


def _changes(values: np.ndarray) -> bool:
    seen = values[np.isfinite(values)]
    return bool(len(seen)) and float(np.ptp(seen)) > 0


def _departs(values: np.ndarray, usual: np.ndarray) -> bool:
    gap = np.abs(values - usual)
    size = np.abs(values[np.isfinite(values)]).max(initial=0.0)
    return bool((gap[np.isfinite(gap)] > 1e-6 * size).any())


def nominal_series(caller: str, sim: Simulator, nominal: Any) -> Series | None:
    """The `Series` of nominal episodes: those of an `Episode` batch, or so many drawn with key 0.

    ``nominal`` None: 200 are drawn, of a black box none, as each is a call.
    """
    if isinstance(nominal, Episode):
        return series_of(sim, samples_of(caller, nominal, sim, None, DRAWS).episodes)
    count = (0 if runs_on_host(sim) else DRAWS) if nominal is None else nominal
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        must = "be Episodes with one leading axis, or how many to draw"
        raise style.wrong(caller, "nominal", must, f"{nominal!r}")
    if not count:
        return None
    keys = jax.random.split(jax.random.key(0), count)
    return series_of(sim, (_drawn if runs_on_host(sim) else _compiled_draws)(keys, sim))


def undisturbed_series(sim: Simulator) -> Series | None:
    """The `Series` of the undisturbed episode; None where a disturbance has neither a mode nor a
    median.
    """
    if not signature_of(sim).has_mode:
        return None
    quiet = rollout(jax.random.key(0), sim, undisturbed(sim))
    return series_of(sim, index_tree(quiet, None))


def choose_fields(
    caller: str, names: Any, of: Series, most: int, quiet: Series | None = None
) -> list[str]:
    """The names to draw: those asked for, where "car" stands for all numbers of that array; or the
    first ``most`` of what moves, and otherwise than in the episode ``quiet``, the miss distance
    among them.
    """
    if names is None:
        rest = [k for k in of.state if k != DISTANCE]
        rest = [k for k in rest if _changes(of.columns[k])] or rest
        if quiet is not None:
            rest = [k for k in rest if _departs(of.columns[k], quiet.columns[k])] or rest
        own = [DISTANCE] * (DISTANCE in of.state)
        return [*rest[: most - len(own)], *own]
    found = []
    for name in [names] if isinstance(names, str) else list(names):
        parts = [k for k in of.columns if k.startswith((f"{name}[", f"{name}."))]
        these = [name] if name in of.columns else parts
        if not these:
            raise style.wrong(caller, "fields", f"be among {list(of.columns)}", f"{name!r}")
        found += these
    if not found:
        raise ValueError(f"plot.{caller}: fields must name a field, received {names!r}")
    return found
