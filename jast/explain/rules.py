"""rules: a few words that tell the episodes which fail from those that nearly do."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jast import _checks, results
from jast.counter import generator
from jast.episode import Episode
from jast.explain.features import Describer, describer, table
from jast.explain.gathered import distinct, gathered, whole
from jast.explain.learning import DISTINCT, learner, parted
from jast.explain.variants import seeds, variants
from jast.intervals import clopper_pearson
from jast.simulator import Simulator

__all__ = ["Rule", "Rules", "rules"]

OTHERS, HELD_OUT, FOLDS, DRAWS = "does not fail", 0.3, 3, 4
"""What the others are called; the share of the episodes that is held out; parts of the rest by
which the size of the tree is chosen; draws of a proposal for each episode wanted."""
OF = "disturbances", "states", "both"


class Rule(NamedTuple):
    """One way through the tree."""

    label: str
    """What it says of an episode: "fails", or the kind of failure."""
    conditions: tuple
    """(what, kind, low, high) of each: ``low < what <= high``. What holds or not is 1 or 0."""
    precision: float
    """Of the held-out episodes that it fits, the share that is of this label."""
    precision_interval: tuple
    recall: float
    """Of the held-out episodes of this label, the share that it fits."""
    recall_interval: tuple

    def __str__(self):
        text = " and ".join(map(_condition, self.conditions)) or "always"
        return f"{text} -> {self.label}"


@results.result("evaluations")
class Rules(NamedTuple):
    """Rules for failures, and how they do on episodes that they were not made from."""

    rules: tuple
    """`Rule` of each way to a failure, by label and then those first that tell the most."""
    classes: tuple
    """What `predict` may say; the first is "does not fail"."""
    precision: dict
    """Class -> of the held-out episodes that are said to be of it, the share that is."""
    recall: dict
    """Class -> of the held-out episodes of it, the share that is said to be."""
    held_out: dict
    """Class -> how many episodes were held out."""
    level: float
    """Of the intervals."""
    tree: Any
    """The `sklearn.tree.DecisionTreeClassifier`."""
    features: tuple
    """Names of its columns."""
    describer: Describer
    ends: np.ndarray
    """Lengths of the failures, from which those of other episodes are drawn where rules are about
    states."""
    sim: Simulator
    evaluations: int
    """Episodes simulated."""
    settings: dict

    def __str__(self):
        lines = []
        for rule in self.rules:
            lines.append(str(rule))
            (a, b), (c, d) = rule.precision_interval, rule.recall_interval
            lines.append(
                f"    precision {rule.precision:.3f} [{a:.3f}, {b:.3f}],"
                f" recall {rule.recall:.3f} [{c:.3f}, {d:.3f}]"
            )
        if not lines:
            lines.append("no rule tells the failures from the others")
        lines.append(f"all rules, on episodes held out ({self.level:.0%} intervals above):")
        for name in self.classes:
            lines.append(
                f"    {name:<14} precision {self.precision[name]:.3f},"
                f" recall {self.recall[name]:.3f} of {self.held_out[name]}"
            )
        return "\n".join(lines)

    def predict(self, episodes: Any) -> np.ndarray:
        """What the rules say of ``episodes``, in any form that `rules` takes: [n] of ``classes``.

        The disturbances decide; what an early end left undrawn is drawn from the model.
        """
        e = gathered("predict", "episodes", self.sim, episodes)
        key = jax.random.key(1)
        seen = whole(self.sim, e, key, self.describer.of != "disturbances")
        x = table(self.sim, self.describer, seen, _ends(generator(key), e, self.ends))[1]
        return np.asarray(self.classes)[self.tree.predict(x)]


def rules(
    sim: Simulator,
    failures: Any,
    others: Any = None,
    *,
    labels: Sequence | None = None,
    key: jax.Array | None = None,
    episodes: int = 1000,
    of: str = "disturbances",
    lead: int = 5,
    most: int = 8,
    level: float = 0.95,
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
    `jast.estimate.failure_probability`, the chains start from weighted draws of its proposal: then
    the failures are as probable as in the model. All that precision and recall tell is about
    episodes like these, as many failures as near misses: among ordinary episodes, of which few
    fail, a rule is less precise. Variants of one failure are held out together, unless more than a
    quarter of the chains starts from it.

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
            for each of them, and of an estimate 4 more.
        of: "disturbances", "states" or "both". States are those seen until ``lead`` steps before
            the end of the episode; others end when a failure drawn at random did.
        lead: steps, 0 or more; at 0 the rules say again what a failure is.
        most: ways through the tree at most, 2 or more. How many there are is chosen by parts of the
            episodes that are not held out.
        level: of the intervals (Clopper and Pearson 1934), which take the episodes for independent.

    Returns:
        `Rules`; printed they are sentences.

    Raises:
        ValueError: for bad arguments, episodes that are not what they should be, and too few.
        ImportError: without scikit-learn.
    """
    name = "rules"
    trees = learner(name, "tree")
    key = jax.random.key(0) if key is None else key
    _checks.random_key(name, key)
    episodes = _checks.whole(name, "episodes", episodes, 20)
    most, lead = _checks.whole(name, "most", most, 2), _checks.whole(name, "lead", lead, 0)
    level = _checks.number(name, "level", level, lambda v: 0 < v < 1, "between 0 and 1")
    if of not in OF:
        raise ValueError(f"{name}: of must be one of {OF}, received {of!r}")
    first, second, third = jax.random.split(key, 3)
    e, owner, group, names, spent = _episodes(name, first, sim, failures, others, labels, episodes)
    seen = whole(sim, e, second, of != "disturbances")
    rng = generator(third)
    ends = e.length[owner > 0]
    d = describer(sim, seen, of, lead)
    features, x = table(sim, d, seen, _ends(rng, e, ends))
    if not np.isfinite(x).all():
        raise ValueError(
            f"{name}: disturbances and states must be finite, received some that are not"
        )
    out = parted(rng, owner, group, HELD_OUT)
    tree = _grown(trees, rng, x[~out], owner[~out], group[~out], most)
    said, leaf = tree.predict(x[out]), tree.apply(x[out])
    truth = owner[out]
    ratio = lambda part, all_: float(part / all_) if all_ else float("nan")
    right = [int(np.sum((said == k) & (truth == k))) for k in range(len(names))]
    return Rules(
        _rules(tree, features, names, leaf, truth, level),
        names,
        {n: ratio(right[k], np.sum(said == k)) for k, n in enumerate(names)},
        {n: ratio(right[k], np.sum(truth == k)) for k, n in enumerate(names)},
        {n: int(np.sum(truth == k)) for k, n in enumerate(names)},
        level,
        tree,
        tuple(f.name for f in features),
        d,
        ends,
        sim,
        spent + seen.evaluations,
        results.asked(name, key, episodes=episodes, of=of, lead=lead, most=most, level=level),
    )


def _episodes(name, key, sim, failures, others, labels, episodes):
    """The episodes [n], their class [n] (0: others), their group [n], the classes, evaluations."""
    k, more = jax.random.split(key)
    many = isinstance(others, int | np.integer) and not isinstance(others, bool)
    if others is None or many:
        s = seeds(name, k, sim, failures, labels, DRAWS * episodes)
        v = variants(more, sim, s, episodes)
        near = len(v.near_group)
        if many:
            near = min(near, _checks.whole(name, "others", others, 1))
        if near < 2 * DISTINCT:
            raise ValueError(
                f"{name}: others: {near} of the variants of the failures do not fail, expected"
                f" {2 * DISTINCT} or more: nearly everything fails"
            )
        cut = jax.tree.map(lambda a: a[:near], v.near)
        e = jax.tree.map(lambda a, b: np.concatenate([a, b]), v.failures, cut)
        owner = np.concatenate([1 + v.label, np.zeros(near, int)])
        group = np.concatenate([v.group, v.near_group[:near]])
        return e, owner, group, (OTHERS, *map(str, s.names)), s.evaluations + v.evaluations
    a, b = gathered(name, "failures", sim, failures), gathered(name, "others", sim, others)
    for argument, part, wanted in (("failures", a, True), ("others", b, False)):
        if (wrong := int((part.failure != wanted).sum())) or not len(part.length):
            raise ValueError(
                f"{name}: {argument} must {'all fail' if wanted else 'not fail'}, received"
                f" {len(part.length)} episodes, of which {wrong} do{'' if not wanted else ' not'}"
            )
    kinds, label = ("fails",), np.zeros(len(a.length), int)
    if labels is not None:
        kinds, label = np.unique(np.asarray(labels).astype(str), return_inverse=True)
        if label.shape != a.length.shape:
            raise ValueError(
                f"{name}: labels must be one for each of the {len(a.length)} failures, received"
                f" the shape {np.shape(labels)}"
            )
    rows, calm = distinct(a), distinct(b)
    a, b = (jax.tree.map(lambda v, r=r: v[r], part) for part, r in ((a, rows), (b, calm)))
    owner = np.concatenate([1 + label[rows], np.zeros(len(calm), int)])
    least = int(np.unique(owner, return_counts=True)[1].min())
    if least < DISTINCT:
        raise ValueError(
            f"{name}: failures and others must be {DISTINCT} distinct episodes or more of each"
            f" kind, received {least}; without others rules simulates more"
        )
    e = jax.tree.map(lambda u, v: np.concatenate([u, v]), a, b)
    return e, owner, np.arange(len(owner)), (OTHERS, *map(str, kinds)), 0


def _ends(rng: np.random.Generator, e: Episode, ends: np.ndarray) -> np.ndarray:
    """[n]: the ends of failures, and of others one drawn from ``ends``, but not behind theirs."""
    return np.where(e.failure, e.length, np.minimum(e.length, rng.choice(ends, len(e.length))))


def _grown(trees, rng, x, owner, group, most):
    """The tree of fewest ways that does as well as the best, up to one standard error (Breiman et
    al. 1984, section 3.4.3) of its balanced accuracy on the parts left out.
    """
    least = max(2, len(owner) // 200)
    grow = lambda ways, rows: trees.DecisionTreeClassifier(
        max_leaf_nodes=ways, min_samples_leaf=least, class_weight="balanced", random_state=0
    ).fit(x[rows], owner[rows])
    sizes = range(2, most + 1)
    score = np.zeros((FOLDS, len(sizes)))
    for i in range(FOLDS):
        out = parted(rng, owner, group, 1 / FOLDS)
        for j, ways in enumerate(sizes):
            said = grow(ways, ~out).predict(x[out])
            kinds = np.unique(owner[out])
            score[i, j] = np.mean([np.mean(said[owner[out] == k] == k) for k in kinds])
    mean = score.mean(axis=0)
    best = int(np.argmax(mean))
    tested = len(owner) / FOLDS
    error = np.sqrt(mean[best] * (1 - mean[best]) / tested)
    chosen = int(np.flatnonzero(mean >= mean[best] - error)[0])
    return grow(sizes[chosen], np.ones(len(owner), bool))


def _rules(tree, features, names, leaf, truth, level) -> tuple:
    """`Rule` of each leaf that says of an episode that it fails."""
    t, found = tree.tree_, []

    def walk(node: int, bounds: dict) -> None:
        if t.children_left[node] < 0:
            k = int(tree.classes_[np.argmax(t.value[node][0])])
            if k:
                here = leaf == node
                hits, fits, all_ = (
                    int(np.sum(here & (truth == k))),
                    int(here.sum()),
                    int(np.sum(truth == k)),
                )
                conditions = tuple(
                    (features[i].name, features[i].kind, low, high)
                    for i, (low, high) in bounds.items()
                )
                found.append(
                    Rule(
                        names[k], conditions, *_share(hits, fits, level), *_share(hits, all_, level)
                    )
                )
            return
        i, cut = int(t.feature[node]), float(t.threshold[node])
        low, high = bounds.get(i, (-np.inf, np.inf))
        walk(t.children_left[node], bounds | {i: (low, min(high, cut))})
        walk(t.children_right[node], bounds | {i: (max(low, cut), high)})

    walk(0, {})
    return tuple(sorted(found, key=lambda r: (names.index(r.label), -r.recall)))


def _share(part: int, all_: int, level: float) -> tuple:
    if not all_:
        return float("nan"), (0.0, 1.0)
    return part / all_, clopper_pearson(part, all_, level)


def _condition(condition: tuple) -> str:
    """ "gust at step 12 > 3.1" """
    what, kind, low, high = condition
    if kind == "truth":
        return what if low > -np.inf else f"not {what}"
    if kind == "count":
        low, high = np.floor(low) + 1, np.floor(high)
        if low == high:
            return f"{what} = {low:.0f}"
        least, most = (f"{what} >= {low:.0f}", f"{what} <= {high:.0f}")
        between = f"{low:.0f} <= {what} <= {high:.0f}"
    else:
        least, most, between = (
            f"{what} > {low:.3g}",
            f"{what} <= {high:.3g}",
            f"{low:.3g} < {what} <= {high:.3g}",
        )
    return (
        between if np.isfinite(low) and np.isfinite(high) else (least if np.isfinite(low) else most)
    )
