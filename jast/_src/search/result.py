"""What every search returns, how its episodes are counted and ranked, and its archive of
failures.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.failures import Failures
from jast._src.core.typing import Array
from jast._src.heads.heads import Heads
from jast._src.io.data_frames import dataframe
from jast._src.search.refine.refine import Refined
from jast._src.util import display

__all__ = ["History", "SearchResult", "Trials", "table"]


@display.printable()
class History(NamedTuple):
    """How the search went, at C moments of it.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0)
        >>> int(found.history.failing[-1]) == round(500 * found.failing_share)
        True
    """

    simulations: np.ndarray
    """[C] int: episodes simulated by each tree so far."""
    best_reward: np.ndarray
    """[C, trees] float: reward of each tree's best episode so far (failures before all others)."""
    failing: np.ndarray
    """[C] int: failing episodes so far, over all trees."""

    @property
    def failures(self) -> Any:
        """The same as ``failing``."""
        return self.failing


@display.printable()
class Trials(NamedTuple):
    """Every simulated episode of a search, [n, trees]: n of each tree, in the order in which they
    were simulated.
    """

    reward: Array
    """float; -inf where the episode was invalid."""
    distance: Array
    """float: miss distance; inf where the episode was invalid."""
    log_prob: Array
    """float: true log density of the disturbances."""
    failure: Array
    """bool."""
    ran: Array
    """bool: it was simulated; a search tree that comes to an episode's end again has its outcome
    already.
    """
    repeated: Array | None = None
    """bool: a failure that a tree came to again, which ``failure`` counts once; None in files of
    versions that did not keep it.
    """

    def to_dataframe(self) -> Any:
        """The episodes as a table of pandas (the extra ``tables``), tree after tree, with the
        fields above as columns.

        Returns:
            The ``pandas.DataFrame``; its index is (``tree``, ``episode``), from 0.

        Raises:
            ImportError: where pandas is not installed.
        """
        n, trees = np.shape(self.reward)
        columns = [("tree", np.repeat(np.arange(trees), n)), ("episode", np.tile(range(n), trees))]
        kept = [(name, a) for name, a in self._asdict().items() if a is not None]
        columns += [(name, np.asarray(a).T.reshape(-1)) for name, a in kept]
        return dataframe(columns, ["tree", "episode"])


@display.result_class("episodes")
class SearchResult(NamedTuple):
    """The outcome of a search; on the host, NumPy and Python numbers. Under `jax.jit` or `jax.vmap`
    all are traced arrays and ``failures`` is None.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0)
        >>> found.episodes, found.invalid, bool(found.best.failure)
        (500, 0, True)
    """

    best: Episode
    """The best episode: the failure of the highest reward, or the episode of the highest reward
    where none failed; of equal ones the first that was found. With its states.
    """
    best_reward_per_tree: Array
    """[trees] float: reward of each tree's best episode, likewise; -inf where the simulator
    returned no finite number.
    """
    failures: Failures | None
    """The archive: the best distinct failures, replayed (`jast.failures`)."""
    episodes: Array | int
    """int: episodes simulated."""
    steps: Array | int
    """int: calls of ``step``; an episode that starts from a kept state costs only its new steps."""
    first_failure: Array | int | None
    """int: how many episodes were simulated up to and including the first that failed, or None (-1
    when traced).
    """
    failing_share: Array | float
    """float: share of the simulated episodes that failed. The share of the trees is
    ``failing_trees``.
    """
    failing_per_tree: Array
    """[trees] bool: whether the tree found a failure."""
    history: History | None
    invalid: Array | int
    """int: episodes in which the simulator, a density or the reward gave NaN or infinity; they
    count as no failure, with reward -inf.
    """
    settings: dict[str, Any] | None
    """What was asked for: method, counts, seed."""
    roots: Any = None
    """Of trees: statistics of every root (`search.tree.prune.Roots`, one for each prune)."""
    heads: Heads | None = None
    """`jast.heads.Heads` as the search left them, to be used again; None without."""
    trials: Trials | None = None
    """Every episode, where the search was asked to ``record``."""
    incidents: tuple[Any, ...] = ()
    """What went wrong on the host of a black box: `jast.incidents.Incident`, with counts and an
    example of each.
    """
    lessons: tuple[Any, ...] = ()
    """Of each round of training: name of the head -> `jast.heads.Lesson`."""
    failing: Array | int | None = None
    """int: how many of the episodes failed."""
    refined: Refined | None = None
    """What came of the search's failures by `jast.search.refine`, scored by log p relative to the
    mode; they are among ``failures`` too, as those of tree -2, and ``best`` may be one. All other
    fields are of the search itself. None where nothing was refined.
    """
    trees: Any = None
    """The trees themselves (`search.tree.edges.Branches`), where the search was asked to
    ``keep_trees``: for `jast.plot.tree`.
    """
    misses: Episode | None = None
    """Of trees: the best episodes that do not fail, of trees that found no failure, one a tree, at
    most ``top`` of them by falling reward: an `Episode` with a leading axis, without states.
    """

    @property
    def simulator_steps(self) -> Any:
        """The same as ``steps``."""
        return self.steps

    @property
    def failing_trees(self) -> Any:
        """Share of the trees that found a failure: the rate of Table 1 of the MCFS-AP paper."""
        return self.failing_per_tree.mean()

    @property
    def evaluations(self) -> Any:
        """int: the episodes, and the evaluations of the refinement."""
        return self.episodes + (0 if self.refined is None else self.refined.episodes)

    def __str__(self) -> str:
        return table({(self.settings or {}).get("method", "search"): self}) + "\n" + _words(self)


def table(results: Mapping[str, SearchResult]) -> str:
    """A readable table of several searches.

    Args:
        results: name -> `SearchResult`.

    Example:
        >>> import jax, jast
        >>> key, sim = jax.random.key(0), jast.simulators.walk1d()
        >>> chance = jast.search.monte_carlo(key, sim, episodes=500, refine=0)
        >>> len(jast.search.table({"chance": chance}).splitlines())
        2
    """
    lines = [
        f"{'method':14} {'episodes':>10} {'steps':>12} {'failing':>9} {'trees':>7} {'first':>9}"
        f" {'best reward':>12} {'mean best':>10}"
    ]
    for name, r in results.items():
        first = "-" if r.first_failure is None else str(r.first_failure)
        best = np.asarray(r.best_reward_per_tree)
        lines.append(
            f"{name:14} {r.episodes:10d} {r.steps:12d} {100 * r.failing_share:8.3f}%"
            f" {100 * r.failing_trees:6.1f}% {first:>9} {float(r.best.reward):12.4f}"
            f" {best[np.isfinite(best)].mean() if np.isfinite(best).any() else -np.inf:10.4f}"
        )
    return "\n".join(lines)


def _words(result):
    if bool(result.best.failure):
        e = result.best
        text = (
            f"likeliest failure: reward {float(e.reward):.4f}, log p {float(e.log_prob):.4f},"
            f" distance {float(e.distance):.4f}, {int(e.length)} steps"
        )
    else:
        text = (
            "no failure was found; the nearest episode came to distance"
            f" {float(result.best.distance):.4f}\nto find one: more episodes{_advice(result)};"
            "\n  jast.estimate.failure_probability, which looks for failures alone"
        )
    if result.refined is not None:
        text += "\n" + _refined(result.refined)
    if result.invalid:
        text += (
            f"\n{result.invalid} episodes were invalid: the simulator, a density or the reward"
            " returned NaN or infinity"
        )
    text += "".join(f"\n  {incident}" for incident in result.incidents)
    for n, lesson in enumerate(result.lessons):
        for name, of in lesson.items():
            if of.rejected:
                text += (
                    f"\nround {n + 1}: training of the {name} head was rejected, its loss was"
                    f" {of.loss}; the parameters from before were kept"
                )
    if dropped := sum(of.dropped for lesson in result.lessons for of in lesson.values()):
        text += (
            f"\n{dropped} samples for the heads were left out: observe, a disturbance or a reward"
            " was not finite"
        )
    note = (result.settings or {}).get("interrupted")
    return text + (f"\ninterrupted: {note}" if note else "")


def _refined(refined):
    """What the refinement cost, and by how much the likeliest failure got likelier."""
    asked = refined.settings
    text = f"refined: {refined.episodes:,} evaluations"
    if not len(refined.failures):
        return text + ", no failure came of it"
    density = "log p relative to the mode" if asked["density"] == "mode" else "log p"
    best = float(refined.failures.best.reward)
    return f"{text}, {density} {asked['likeliest']:.2f} -> {best:.2f}"


def _advice(result):
    """What to change where no failure was found; nothing of what is the default already."""
    settings = result.settings or {}
    advice = ""
    if settings.get("reward", "rewards.lexicographic") != "rewards.lexicographic":
        advice += ";\n  the default reward, which ranks any failure above all misses"
    if settings.get("actions") == "actions.samples" and settings.get("method") != "monte_carlo":
        advice += ";\n  actions=jast.actions.wide(3.0), which reach into the tails"
    return advice
