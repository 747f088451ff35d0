"""The archive of failures: the best distinct ones that a search found, each exactly replayable, in
memory and in one file.

An archived episode went through `jast.replay` once and carries its numbers, so that every later
replay on the same platform agrees with them to the bit. All arrays are NumPy's: they keep their
dtype whatever the precision that JAX is set to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import index
from typing import Any

import jax
import numpy as np

from jast._src.core.episode import Episode, replay, stacked
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.core.typing import Array, PathLike, Reward
from jast._src.io import save_load
from jast._src.io.data_frames import dataframe
from jast._src.io.export import by_step, from_json, to_csv, to_numpy
from jast._src.util import display
from jast._src.util.checks import instance, wrong
from jast._src.util.pytrees import index_tree, join_rows

__all__ = [
    "Failures",
    "collect",
    "empty",
    "from_json",
    "identity",
    "load",
    "merge",
    "rank",
    "save",
    "to_csv",
    "to_numpy",
]


@display.printable("seen")
@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Failures:
    """The n best distinct failures, by falling reward, equal ones by falling log p: a sequence of
    them. Also a pytree of arrays.

    ``len(failures)`` is n, ``failures[i]`` the i-th best `Episode`, a slice is an archive of its
    own, and a loop runs over the episodes.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0).failures
        >>> all(episode.failure for episode in found[:3])
        True
    """

    episodes: Episode
    """Leading axis [n]; ``states`` is None (`jast.replay` gives them)."""
    counts: np.ndarray
    """int32 [n]: how often each was found."""
    tree: np.ndarray
    """int32 [n]: the tree that found it first (least simulation, then least tree); -1: the episodes
    before the search, -2: its refinement.
    """
    simulation: np.ndarray
    """int32 [n]: the simulation of that tree; of a refinement, its row in ``refined.failures``."""
    seen: int
    """Failing episodes simulated in all, repetitions and those beyond the best n included."""
    dropped: int
    """Candidates that did not replay to a failure: a knife edge on which compiled programs differ
    in the last digit.
    """

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, i: int | slice) -> Episode | Failures:
        return self.take(i) if isinstance(i, slice) else self.episode(index(i))

    def take(self, rows: slice | np.ndarray) -> Failures:
        """The archive of these ``rows``, a slice or rising numbers."""
        return Failures(*index_tree(self.rows(), rows), seen=self.seen, dropped=self.dropped)

    def rows(self) -> tuple[Any, ...]:
        """What has a row for each episode."""
        return self.episodes, self.counts, self.tree, self.simulation

    def __iter__(self) -> Iterator[Episode]:
        return (self.episode(i) for i in range(len(self)))

    def replace(self, **changes: Any) -> Failures:
        """The archive with other fields."""
        return replace(self, **changes)

    _replace = replace

    def to_dataframe(self, steps: bool = False) -> Any:
        """The archive as a table of pandas (the extra ``tables``), by falling reward.

        Args:
            steps: one row for each step of each failure, as `jast.failures.to_csv` writes them,
                with the numbers of the disturbances; else one for each failure, with its
                ``reward``, ``log_prob``, ``distance``, ``length``, ``counts``, ``tree`` and
                ``simulation``.

        Returns:
            The ``pandas.DataFrame``; its index is ``failure``, from 1, or (``failure``, ``step``).

        Raises:
            ImportError: where pandas is not installed.
        """
        if steps:
            return dataframe(by_step(self).items(), ["failure", "step"])
        columns = [("failure", np.arange(1, len(self) + 1))]
        for name in ("reward", "log_prob", "distance", "length"):
            columns.append((name, getattr(self.episodes, name)))
        columns += [(name, getattr(self, name)) for name in ("counts", "tree", "simulation")]
        return dataframe(columns, ["failure"])

    @property
    def size(self) -> int:
        """n, the number of episodes held."""
        return len(self)

    @property
    def best(self) -> Episode | None:
        """The `Episode` of the highest reward, of equal ones that of the highest log p, or None
        where there is no failure."""
        return self.episode(0) if self.size else None

    def episode(self, i: int) -> Episode:
        """The i-th best `Episode`, unbatched; negative ``i`` counts from the end. IndexError
        outside the archive.
        """
        if not self.size:
            raise IndexError(
                f"no failure was found, so there is no episode {i}: try a larger budget, and a miss"
                " distance that falls all the way to a failure; jast.check(sim) warns of what keeps"
                " failures away"
            )
        if not -self.size <= i < self.size:
            raise IndexError(
                f"Failures.episode: i must be within the {self.size} episodes held, received {i}"
            )
        return index_tree(self.episodes, i)

    def __str__(self) -> str:
        found = f"{int(self.seen)} failing episode{'s' * (self.seen != 1)} simulated"
        if self.dropped:
            found += f", {int(self.dropped)} did not replay to a failure"
        if not self.size:
            return "no failure was found" + (f" ({found})" if self.seen or self.dropped else "")
        lines = [f"{self.size} distinct failure{'s' * (self.size > 1)} ({found})"]
        lines.append(
            f"{'rank':>4} {'reward':>11} {'log p':>11} {'distance':>11} {'length':>6} {'found':>6}"
            f" {'tree':>6} {'simulation':>10}"
        )
        e = self.episodes
        for i in range(min(self.size, 10)):
            numbers = " ".join(f"{float(v[i]):11.6g}" for v in (e.reward, e.log_prob, e.distance))
            lines.append(
                f"{i + 1:4d} {numbers} {int(e.length[i]):6d} {self.counts[i]:6d} {self.tree[i]:6d}"
                f" {self.simulation[i]:10d}"
            )
        if self.size > 10:
            lines.append(f"... and {self.size - 10} more")
        return "\n".join(lines)


def empty(sim):
    """`Failures` with n = 0, of the shapes and dtypes of ``sim``."""
    like = signature_of(sim)
    zero = np.zeros(0, like.dtype)
    x0 = jax.tree.map(lambda s: np.zeros((0, *s.shape), s.dtype), like.x0)
    x = jax.tree.map(lambda s: np.zeros((0, sim.horizon, *s.shape), s.dtype), like.x)
    none = np.zeros(0, np.int32)
    episodes = Episode(
        x0=x0,
        disturbances=x,
        log_prob=zero,
        distance=zero,
        failure=np.zeros(0, bool),
        length=none,
        reward=zero,
    )
    return Failures(episodes, counts=none, tree=none, simulation=none, seen=0, dropped=0)


def collect(
    sim: Simulator,
    reward: Reward,
    episodes: Episode,
    tree: Array | Sequence[int] | None = None,
    simulation: Array | Sequence[int] | None = None,
    seen: int | None = None,
    top: int = 64,
) -> Failures:
    """The best distinct failures among candidate episodes.

    Every candidate whose ``failure`` holds is replayed; one that no longer fails is dropped and
    counted. Episodes with the same bytes of x0 and of the first ``length`` disturbances are one
    failure, and their counts are added.

    Args:
        sim: the simulator.
        reward: ranks the failures; more is better.
        episodes: the candidates, an `Episode` with a leading axis [m], NumPy or JAX.
        tree: [m]: the tree where each was found. Default: 0.
        simulation: [m]: the simulation where each was found. Default: its position.
        seen: failing episodes simulated, where they were more than the candidates. Default: the
            failing candidates.
        top: distinct failures kept.

    Returns:
        `Failures`.

    Raises:
        ValueError: for axes that disagree, ``top`` below 1, and disturbances that do not fit
            ``sim``.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> keys = jax.random.split(jax.random.key(0), 200)
        >>> many = jax.vmap(jast.rollout, (0, None))(keys, sim)
        >>> found = jast.failures.collect(sim, jast.rewards.standard(), many, top=3)
        >>> len(found), int(found.seen) == int(many.failure.sum())
        (3, True)
    """
    instance("collect", "episodes", episodes, Episode, "a batch of jast.Episode")
    episodes = jax.device_get(episodes._replace(states=None))
    m = np.shape(episodes.length)[0] if np.ndim(episodes.length) == 1 else None
    if m is None or any(np.shape(leaf)[:1] != (m,) for leaf in jax.tree.leaves(episodes)):
        must = "share one leading axis"
        raise wrong("collect", "episodes", must, f"the shapes {jax.tree.map(np.shape, episodes)}")
    tree = _numbers("tree", np.zeros(m, np.int32) if tree is None else tree, m)
    simulation = _numbers("simulation", np.arange(m) if simulation is None else simulation, m)

    replays, rows, kept = {}, [], []
    failing = np.flatnonzero(episodes.failure)
    for i in failing:
        candidate = index_tree(episodes, i)
        name = identity(candidate)
        if name not in replays:
            again = jax.device_get(replay(sim, candidate, reward=reward)._replace(states=None))
            replays[name] = jax.tree.map(np.asarray, again)
        if replays[name].failure:
            rows.append(i)
            kept.append(replays[name])
    archive = empty(sim)
    if rows:
        archive = Failures(
            episodes=stacked(kept),
            counts=np.ones(len(rows), np.int32),
            tree=tree[rows],
            simulation=simulation[rows],
            seen=0,
            dropped=0,
        )
    return _best("collect", archive, top).replace(
        seen=len(failing) if seen is None else int(seen), dropped=len(failing) - len(rows)
    )


def merge(a: Failures, b: Failures, top: int = 64) -> Failures:
    """The best distinct failures of two archives of one simulator and one reward; ``seen`` and
    ``dropped`` are added.

    Args:
        a, b: `Failures`.
        top: distinct failures kept.

    Raises:
        ValueError: for what is no archive, where the shapes of the two disagree, or ``top`` is
            below 1.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> search = lambda seed: jast.search.monte_carlo(jax.random.key(seed), sim, episodes=500)
        >>> a, b = search(0).failures, search(1).failures
        >>> both = jast.failures.merge(a, b)
        >>> int(both.seen) == int(a.seen + b.seen)
        True
    """
    for name, given in (("a", a), ("b", b)):
        instance("merge", name, given, Failures, "an archive of jast.failures, as report.failures")
    trees = [jax.tree.structure(f.episodes) for f in (a, b)]
    shapes = [[np.shape(leaf)[1:] for leaf in jax.tree.leaves(f.episodes)] for f in (a, b)]
    if trees[0] != trees[1] or shapes[0] != shapes[1]:
        received = f"episodes of shapes {shapes[0]} and {shapes[1]}"
        raise wrong("merge", "both archives", "be of one simulator", received)
    arrays = join_rows(a.rows(), b.rows())
    return _best("merge", Failures(*arrays, seen=0, dropped=0), top).replace(
        seen=a.seen + b.seen, dropped=a.dropped + b.dropped
    )


def save(path: PathLike, failures: Failures, settings: dict[str, Any] | None = None) -> None:
    """Write an archive to a file, with settings beside it. Deprecated: use `jast.save` on the
    result of the search, which has both; this function goes with the next version.

    Args:
        path: of the file.
        failures: the archive.
        settings: a dict that a file can hold: method, seed, counts ...

    Raises:
        ValueError: for settings that it cannot hold.

    Example:
        >>> import os, tempfile, jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0).failures
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     jast.failures.save(os.path.join(folder, "failures.npz"), found)
    """
    if not isinstance(failures, Failures):
        raise ValueError(f"save: failures must be an archive, received {type(failures).__name__}")
    save_load.store(path, failures, settings=settings or {})


def load(path: PathLike, sim: Simulator | None = None) -> tuple[Failures, dict[str, Any]]:
    """An archive and the settings beside it, from a file of `save`. Deprecated: use `jast.load`;
    this function goes with the next version.

    Args:
        path: of the file.
        sim: as for `jast.load`.

    Returns:
        ``(Failures, settings)``.

    Example:
        >>> import os, tempfile, jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0).failures
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "failures.npz")
        ...     jast.failures.save(path, found, {"seed": 0})
        ...     jast.failures.load(path, sim)[1]
        {'seed': 0}
    """
    failures, beside = save_load.restore(path, sim)
    save_load.check_kind(path, failures, Failures)
    return failures, beside.get("settings", {})


def _numbers(name, values, m):
    values = np.asarray(values)
    if values.shape != (m,):
        raise wrong("collect", name, f"have the shape {(m,)}, one number an episode", values.shape)
    return values.astype(np.int32)


def identity(episode):
    """What makes two failures one: the bytes of x0 and of the disturbances that were used."""
    length = int(episode.length)
    used = [a[:length] for a in jax.tree.leaves(episode.disturbances)]
    leaves = [*jax.tree.leaves(episode.x0), *used]
    return length, *(np.ascontiguousarray(a).tobytes() for a in leaves)


def rank(episodes: Episode) -> np.ndarray:
    """The place of each of ``episodes`` [n], 0 for the best: by falling reward, and of equal ones
    by falling log p; equal in both is the same place.

    Of a fair coin log p relative to the mode is the same for all: the likeliest is the shortest.
    """
    keys = np.stack([-np.asarray(episodes.reward), -np.asarray(episodes.log_prob)], axis=1)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)


def _best(caller, failures, top):
    """The best ``top``, with equal ones put together; ``seen`` and ``dropped`` are left to the
    caller.
    """
    if isinstance(top, bool) or not isinstance(top, int | np.integer) or top < 1:
        raise ValueError(f"{caller}: top must be an int of at least 1, received {top!r}")
    # equal ones are ordered by when they were found, so that the order of the candidates does not
    # matter
    order = np.lexsort((failures.tree, failures.simulation, rank(failures.episodes)))
    groups = {}
    for i in order:
        groups.setdefault(identity(index_tree(failures.episodes, i)), []).append(i)
    groups = list(groups.values())[:top]
    best = np.array([group[0] for group in groups], np.int64)
    first = np.array(
        [min(group, key=lambda i: (failures.simulation[i], failures.tree[i])) for group in groups],
        np.int64,
    )
    return failures.take(best).replace(
        counts=np.array([failures.counts[group].sum() for group in groups], np.int32),
        tree=failures.tree[first],
        simulation=failures.simulation[first],
    )
