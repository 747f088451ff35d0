"""rules: a few words that tell the episodes which fail from those that nearly do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PRNGKey
from jast._src.explain.decision_tree import grow_tree, read_rules
from jast._src.explain.episodes import gather_episodes, play_to_horizon
from jast._src.explain.feature_table import Describer, feature_table, make_describer
from jast._src.explain.held_out import DISTINCT, hold_out, sklearn_module
from jast._src.explain.training_cases import given_cases, simulate_cases
from jast._src.util import checks, display
from jast._src.util.intervals import checked_level

__all__ = ["Rules", "rules"]

AFTER = 2  # evaluations of a failure and its near miss once they are known: played to the horizon
HELD_OUT = 0.3  # the share of the episodes that tells how often the rules are right
OF = "disturbances", "states", "both"


@display.result_class("evaluations")
class Rules(NamedTuple):
    """Rules for failures, and how they do on episodes that they were not made from.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d(form="one-sided")
        >>> found = jast.search.gradient(jax.random.key(0), sim, starts=4, refine=0)
        >>> told = jast.explain.rules(sim, found, episodes=100)
        >>> told.classes, told.recall["fails"] > 0.5
        (('does not fail', 'fails'), True)
    """

    rules: tuple[Any, ...]
    """`Rule` of each way to a failure, by label and then those first that tell the most."""
    classes: tuple[Any, ...]
    """What `predict` may say; the first is "does not fail"."""
    precision: dict[str, Any]
    """Class -> of the held-out episodes that are said to be of it, the share that is; NaN where
    none is."""
    recall: dict[str, Any]
    """Class -> of the held-out episodes of it, the share that is said to be."""
    held_out: dict[str, Any]
    """Class -> how many episodes were held out."""
    level: float
    """Of the intervals."""
    tree: Any
    """The `sklearn.tree.DecisionTreeClassifier`."""
    features: tuple[Any, ...]
    """Names of its columns."""
    describer: Describer
    ends: np.ndarray
    """Lengths of the failures, from which those of other episodes are drawn where rules are about
    states."""
    sim: Simulator
    evaluations: int
    """Episodes simulated."""
    settings: dict[str, Any]

    def __str__(self) -> str:
        lines = []
        for rule in self.rules:
            precision = _words(rule.precision, rule.precision_interval)
            recall = _words(rule.recall, rule.recall_interval)
            lines += [str(rule), f"    precision {precision}, recall {recall}"]
        if not lines:
            lines.append("no rule tells the failures from the others")
        lines.append(f"all rules, on episodes held out ({self.level:.0%} intervals above):")
        for name in self.classes:
            lines.append(
                f"    {name:<14} precision {_words(self.precision[name])},"
                f" recall {_words(self.recall[name])} of {self.held_out[name]}"
            )
        return "\n".join(lines)

    def predict(self, episodes: Any) -> np.ndarray:
        """What the rules say of ``episodes``, in any form that `rules` takes: [n] of ``classes``.

        The disturbances decide; what an early end left undrawn is drawn from the model.
        """
        e = gather_episodes("predict", "episodes", self.sim, episodes)
        key = jax.random.key(1)
        seen, _ = play_to_horizon(self.sim, e, key, self.describer.of != "disturbances")
        ends = _ends(numpy_generator(key), e, self.ends)
        _, x = feature_table(self.sim, self.describer, seen, ends)
        return np.asarray(self.classes)[self.tree.predict(x)]


def rules(
    sim: Simulator,
    failures: Any,
    others: Any = None,
    *,
    labels: Sequence[Any] | None = None,
    key: PRNGKey | None = None,
    episodes: int = 1000,
    of: Literal["disturbances", "states", "both"] = "disturbances",
    lead: int = 5,
    most: int = 8,
    level: float = 0.95,
    budget: int | None = None,
) -> Rules:
    """Which rule describes the failures?

    A small decision tree (Breiman, Friedman, Olshen and Stone 1984) tells failures from near misses
    by what the disturbances of an episode were: the value of each at each step, means over some
    steps, the greatest and the least and when that was, the greatest mean of steps in a row, what
    one was while another was greatest; of kinds and truths how often and how long in a row they
    came. All have the names of the user's fields. 30 % of the episodes are held out, and tell how
    often the rules are right.

    Without ``others`` the episodes are simulated: Markov chains start from the failures given, and
    draw some of the disturbances anew, move them a little, or let all come some steps later, as the
    model has it. What still fails is a failure, what no longer does is a near miss. So what has no
    part in the failures is the same in both. Of a report of `jast.stress`, or an estimate of
    `jast.estimate.failure_probability`, the chains start from its failing draws, by their weights:
    then the failures are as probable as in the model. All that precision and recall tell is about
    episodes like these, as many failures as near misses: among ordinary episodes, of which few
    fail, a rule is less precise. Variants of one failure are held out together, unless more than a
    tenth of the chains starts from it: then rules are judged on variants of what they were made
    from.

    Args:
        sim: the simulator. Without ``others`` its disturbances have quantile functions.
        failures: a report, an estimate, the result of a search, its ``failures``, modes of
            `jast.search.modes`, a batch of failing episodes [n] or a list of them.
        others: episodes that do not fail, in the same forms; None: near misses; a number: so many
            near misses at most.
        labels: names of the kinds of the failures, one for each; there are rules for each kind. By
            default those of a report or of modes are told apart by their mode, the first six.
        key: of the draws and of what is held out; `jax.random.key(0)` by default.
        episodes: failures to be simulated without ``others``, at least 20. About 13 evaluations
            for each of them.
        of: "disturbances", "states" or "both". States are those seen until ``lead`` steps before
            the end of the episode; others end when a failure drawn at random did.
        lead: steps, 0 or more; at 0 the rules say again what a failure is.
        most: ways through the tree at most, 2 or more. How many there are is chosen by parts of the
            episodes that are not held out.
        level: of the intervals (Clopper and Pearson 1934), which take the episodes for independent.
        budget: evaluations at most, without ``others``: 14 for each of the ``episodes``, of which
            there are fewer where it affords no more. Default: none; 3000 of a black box.

    Returns:
        `Rules`; printed they are sentences.

    Raises:
        ValueError: for bad arguments, episodes that are not what they should be, and too few.
        ImportError: without scikit-learn.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d(form="one-sided")
        >>> found = jast.search.gradient(jax.random.key(0), sim, starts=4, refine=0)
        >>> told = jast.explain.rules(sim, found, episodes=100)
        >>> len(told.rules) >= 1
        True
    """
    name = "rules"
    trees = sklearn_module(name, "tree")
    key = jax.random.key(0) if key is None else key
    checks.check_random_key(name, key)
    episodes = checks.whole_number(name, "episodes", episodes, 20)
    most = checks.whole_number(name, "most", most, 2)
    lead = checks.whole_number(name, "lead", lead, 0)
    if budget is not None:
        budget = checks.whole_number(name, "budget", budget, 1)
    level = checked_level(name, level)
    checks.one_of(name, "of", of, OF)
    first, second, third = jax.random.split(key, 3)
    number = isinstance(others, int | np.integer) and not isinstance(others, bool)
    if others is None or number:
        many = checks.whole_number(name, "others", others, 1) if number else None
        cases = simulate_cases(name, first, sim, failures, labels, episodes, many, budget, AFTER)
    else:
        cases = given_cases(name, sim, failures, others, labels, DISTINCT)
    e, owner, group, names, spent = cases[:5]
    seen, played = play_to_horizon(sim, e, second, of != "disturbances")
    rng = numpy_generator(third)
    ends = e.length[owner > 0]
    d = make_describer(sim, seen, of, lead)
    features, x = feature_table(sim, d, seen, _ends(rng, e, ends))
    if not np.isfinite(x).all():
        raise checks.wrong(name, "disturbances and states", "be finite", "some that are not")
    out = hold_out(rng, owner, group, HELD_OUT)
    tree = grow_tree(trees, rng, x[~out], owner[~out], group[~out], most)
    said, leaf = tree.predict(x[out]), tree.apply(x[out])
    truth = owner[out]
    kinds = {n: (said == k, truth == k) for k, n in enumerate(names)}
    settings = dict(episodes=episodes, of=of, lead=lead, most=most, level=level)
    return Rules(
        rules=read_rules(tree, features, names, leaf, truth, level),
        classes=names,
        precision={n: _mean(true[said]) for n, (said, true) in kinds.items()},
        recall={n: _mean(said[true]) for n, (said, true) in kinds.items()},
        held_out={n: int(true.sum()) for n, (_, true) in kinds.items()},
        level=level,
        tree=tree,
        features=tuple(f.name for f in features),
        describer=d,
        ends=ends,
        sim=sim,
        evaluations=spent + played,
        settings=display.call_settings(name, key, **settings),
    )


def _mean(which: np.ndarray) -> float:
    """The share that is True; NaN of none."""
    return float(which.mean()) if len(which) else float("nan")


def _words(share: float, interval: tuple[Any, ...] = ()) -> str:
    """ "0.950 [0.940, 0.960]" """
    if np.isnan(share):
        return "unknown (of no episode held out)"
    return f"{share:.3f}" + (" [{:.3f}, {:.3f}]".format(*interval) if interval else "")


def _ends(rng: np.random.Generator, e: Episode, ends: np.ndarray) -> np.ndarray:
    """[n]: the ends of failures, and of others one drawn from ``ends``, but not behind theirs."""
    return np.where(e.failure, e.length, np.minimum(e.length, rng.choice(ends, len(e.length))))
