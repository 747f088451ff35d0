"""monitor: while the system runs, will it fail within the next steps?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.simulator import Simulator
from jast._src.core.typing import PRNGKey
from jast._src.explain.episodes import draw_ordinary, observations
from jast._src.explain.held_out import hold_out, share_of, sklearn_module
from jast._src.explain.training_cases import given_cases, simulate_cases
from jast._src.util import checks, display
from jast._src.util.intervals import checked_level
from jast._src.util.pytrees import join_rows
from jast._src.weakness.measures import Roc, roc

__all__ = ["Monitor", "monitor"]

AFTER = 4  # evaluations of each episode: an ordinary one beside it, and all three are watched
HELD_OUT = 0.3  # the share of the episodes that tells how good the monitor is
ASIDE = 0.3  # of the other ordinary ones, the share that sets the threshold
EPISODES = 12  # failures, and others, the least
ROWS = 200_000  # observations to learn from, the most
BINS = 256  # different scores of the bootstrap
REPEATS = 400  # samples of the bootstrap
FAILING, NEAR, ORDINARY = 1, 2, 0  # kinds of episodes


@display.result_class("evaluations")
class Monitor(NamedTuple):
    """A classifier of observations, and how it does on episodes that it has not seen.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0)
        >>> watch = jast.explain.monitor(sim, found, model="logistic", episodes=100)
        >>> 0.0 <= watch.threshold <= 1.0, min(watch.held_out) > 0
        (True, True)
    """

    model: Any
    """The scikit-learn classifier."""
    within: int
    """Steps that it looks ahead."""
    threshold: float
    """It warns where `probability` is above this."""
    false_alarms: tuple[Any, ...]
    """(share, (low, high)): of the held-out others, those with a warning at any step. Near misses
    are not among them."""
    warned: tuple[Any, ...]
    """(share, (low, high)): of the held-out failures, those with a warning before the failure."""
    ahead: tuple[Any, ...]
    """Steps from the first warning to the failure: the least of 90 %, the median, and the least of
    10 %, of those with a warning; NaN where there is none."""
    auc: float
    """Area under the ROC curve: the chance that of two held-out moments, one within reach of a
    failure and one not, the first has the higher probability."""
    auc_interval: tuple[Any, ...]
    roc: Roc
    held_out: tuple[Any, ...]
    """(failures, near misses, others): episodes."""
    level: float
    maxima: np.ndarray
    """The greatest probability of each of the others that set the threshold, sorted."""
    evaluations: int
    settings: dict[str, Any]

    def __str__(self) -> str:
        n, near, calm = self.held_out
        (rate, (a, b)), (hit, (c, d)) = self.false_alarms, self.warned
        low, high = self.auc_interval
        few, median, many = self.ahead
        return "\n".join(
            [
                f"fails within {self.within} steps? on {n} failures, {near} near misses and {calm}"
                " others held out:",
                f"  area under the ROC curve {self.auc:.4f} [{low:.4f}, {high:.4f}]",
                f"  warns above {self.threshold:.3g}: in {hit:.1%} [{c:.1%}, {d:.1%}] of the"
                " failures before they fail,",
                f"    {median:g} steps ahead (median; 90 % at least {few:g}, 10 % at least"
                f" {many:g}),",
                f"    and in {rate:.1%} [{a:.1%}, {b:.1%}] of the others",
            ]
        )

    def probability(self, observation: Any) -> Any:
        """Of failing within the next steps: a float for one observation [d], [n] for many [n, d].

        That is among episodes like those learned from, of which a third or half fail. In operation
        failures are rarer, so this is a score to compare with ``threshold``, not how probable a
        failure is.
        """
        x = np.asarray(observation, float)
        d = self.model.n_features_in_
        if x.ndim not in (1, 2) or x.shape[-1] != d:
            raise checks.wrong("probability", "observation", f"be [{d}] or [n, {d}]", list(x.shape))
        p = self.model.predict_proba(np.atleast_2d(x))[:, 1]
        return float(p[0]) if x.ndim == 1 else p

    def warns(self, observation: Any) -> Any:
        """Whether `probability` is above the threshold: bool, or [n] bool."""
        return self.probability(observation) > self.threshold

    def threshold_for(self, false_alarms: float) -> float:
        """Above which at most this share of the others that set thresholds would ever warn."""
        checks.number(
            "threshold_for", "false_alarms", false_alarms, lambda v: 0 <= v <= 1, "from 0 to 1"
        )
        return _threshold(self.maxima, false_alarms)


def monitor(
    sim: Simulator,
    failures: Any,
    others: Any = None,
    *,
    within: int = 5,
    observe: Callable[[Any], Any] | None = None,
    model: Literal["boosted", "logistic"] = "boosted",
    false_alarms: float = 0.01,
    key: PRNGKey | None = None,
    episodes: int = 1000,
    level: float = 0.95,
    budget: int | None = None,
) -> Monitor:
    """A runtime monitor: will the system fail within the next ``within`` steps?

    A classifier of scikit-learn learns it from what is observed at each step of failing and other
    episodes. ``monitor(...).probability(observation)`` is then its answer, which needs neither the
    simulator nor JAX. 30 % of the episodes are held out, and tell how good it is.

    Without ``others`` the episodes are simulated: failures and near misses as in
    `jast.explain.rules`, and as many ordinary episodes, drawn from the model. The threshold is such
    that ``false_alarms`` of ordinary episodes, of some that are set aside for this, would ever
    warn.

    Args:
        sim: the simulator.
        failures: as of `jast.explain.rules`.
        others: ordinary episodes, that do not fail; by default they are drawn.
        within: steps, at least 1.
        observe: state -> vector of numbers, what the monitor gets to see; by default
            ``sim.observe``.
        model: "boosted", a hundred small boosted trees (Friedman 2001), or "logistic", the
            regression on standardised numbers.
        false_alarms: the share of ordinary episodes, from 0 to 1, that may warn.
        key: of the draws and of what is held out; `jax.random.key(0)` by default.
        episodes: without ``others``: failures, near misses and ordinary episodes, so many of each
            at most; at least 40.
        level: of the intervals: exact ones of shares, and of the area that of the bootstrap over
            episodes (Efron 1979).
        budget: evaluations at most, without ``others``: 16 for each of the ``episodes``, of which
            there are fewer where it affords no more. Default: none; 3000 of a black box.

    Returns:
        `Monitor`.

    Raises:
        ValueError: for bad arguments, episodes that are not what they should be, and too few.
        ImportError: without scikit-learn.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0)
        >>> watch = jast.explain.monitor(sim, found, model="logistic", episodes=100)
        >>> 0.0 <= watch.probability([9.5]) <= 1.0
        True
    """
    name = "monitor"
    sklearn_module(name, "ensemble")
    key = jax.random.key(0) if key is None else key
    checks.check_random_key(name, key)
    within = checks.whole_number(name, "within", within, 1)
    episodes = checks.whole_number(name, "episodes", episodes, 40)
    if budget is not None:
        budget = checks.whole_number(name, "budget", budget, 1)
    rate = checks.number(name, "false_alarms", false_alarms, lambda v: 0 <= v <= 1, "from 0 to 1")
    level = checked_level(name, level)
    checks.one_of(name, "model", model, sorted(MODELS))
    first, second = jax.random.split(key)
    e, owner, group, spent = _episodes(name, first, sim, failures, others, episodes, budget)
    seen = observations(name, sim, sim.observe if observe is None else observe, e)
    rng = numpy_generator(second)
    out = hold_out(rng, owner, group, HELD_OUT)
    aside = np.zeros(len(out), bool)
    calm = np.flatnonzero(~out & (owner == ORDINARY))
    aside[rng.permutation(calm)[: max(int(ASIDE * len(calm)), 1)]] = True
    live = np.arange(seen.shape[1]) < e.length[:, None]
    soon = live & (owner == FAILING)[:, None]
    soon &= e.length[:, None] - np.arange(seen.shape[1]) <= within
    learned = np.argwhere(live & ~(out | aside)[:, None])
    if len(learned) > ROWS:
        learned = learned[rng.choice(len(learned), ROWS, replace=False)]
    i, t = learned.T
    if soon[i, t].all() or not soon[i, t].any():
        raise ValueError(
            f"{name}: within must separate moments soon before a failure from others, received"
            f" {within} steps where failures last {e.length[owner == FAILING].mean():.3g} steps"
        )
    fitted = MODELS[model](name).fit(seen[i, t], soon[i, t])
    score = np.full(live.shape, -np.inf)
    score[live] = fitted.predict_proba(seen[live])[:, 1]
    maxima = np.sort(score[aside].max(axis=1))
    threshold = _threshold(maxima, rate)
    alarm = score > threshold
    failing, ordinary = out & (owner == FAILING), out & (owner == ORDINARY)
    hit, wrong = alarm[failing].any(axis=1), alarm[ordinary].any(axis=1)
    steps = (e.length[failing] - np.argmax(alarm[failing], axis=1))[hit]
    ahead = np.quantile(steps, (0.1, 0.5, 0.9), method="lower") if len(steps) else [np.nan] * 3
    rows = live & out[:, None]
    curve = roc(score[rows], soon[rows])
    settings = dict(within=within, model=model, false_alarms=rate, episodes=episodes, level=level)
    return Monitor(
        model=fitted,
        within=within,
        threshold=threshold,
        false_alarms=share_of(int(wrong.sum()), len(wrong), level),
        warned=share_of(int(hit.sum()), len(hit), level),
        ahead=tuple(map(float, ahead)),
        auc=curve.area,
        auc_interval=_area_interval(rng, score, soon, rows, group, level),
        roc=curve,
        held_out=tuple(int(np.sum(out & (owner == k))) for k in (FAILING, NEAR, ORDINARY)),
        level=level,
        maxima=maxima,
        evaluations=spent + len(e.length),
        settings=display.call_settings(name, key, **settings),
    )


def _boosted(name: str) -> Any:
    return sklearn_module(name, "ensemble").HistGradientBoostingClassifier(
        max_leaf_nodes=8, early_stopping=False, random_state=0
    )


def _logistic(name: str) -> Any:
    scaler = sklearn_module(name, "preprocessing").StandardScaler()
    regression = sklearn_module(name, "linear_model").LogisticRegression(max_iter=1000)
    return sklearn_module(name, "pipeline").make_pipeline(scaler, regression)


MODELS: dict[str, Callable] = {"boosted": _boosted, "logistic": _logistic}


def _episodes(name, key, sim, failures, others, episodes, budget):
    """The episodes [n], what they are [n], their group [n], evaluations."""
    if others is not None:
        cases = given_cases(name, sim, failures, others, None, EPISODES)
        return cases.episodes, cases.kind, cases.group, 0
    own, calm = jax.random.split(key)
    cases = simulate_cases(name, own, sim, failures, None, episodes, budget=budget, after=AFTER)
    episodes = cases.asked
    plain = draw_ordinary(calm, sim, episodes)
    n = len(plain.length)
    if n < EPISODES:
        raise ValueError(
            f"{name}: others: expected at least {EPISODES} of {episodes} ordinary episodes that do"
            f" not fail, received {n}"
        )
    e = join_rows(cases.episodes, plain)
    kind = np.concatenate([np.where(cases.kind > 0, FAILING, NEAR), np.full(n, ORDINARY)])
    group = np.concatenate([cases.group, cases.group.max() + 1 + np.arange(n)])
    return e, kind, group, cases.evaluations + episodes


def _threshold(maxima: np.ndarray, rate: float) -> float:
    """The least above which a share of at most ``rate`` of ``maxima`` is."""
    n = len(maxima)
    return float(maxima[n - 1 - min(int(rate * n), n - 1)])


def _area_interval(rng, score, soon, rows, group, level) -> tuple[float, float]:
    """Of the area under the ROC curve, by the bootstrap over groups of episodes."""
    values = np.sort(score[rows])
    edges = np.unique(values[np.linspace(0, len(values) - 1, BINS).astype(int)])
    bins = np.searchsorted(edges, score[rows])
    each = np.broadcast_to(group[:, None], score.shape)[rows]
    names, at = np.unique(each, return_inverse=True)
    counts = np.zeros((2, len(names), len(edges)))
    np.add.at(counts, (soon[rows].astype(int), at, bins), 1)
    times = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), REPEATS)
    no, yes = times @ counts[0], times @ counts[1]

    def area(no, yes):
        below = np.cumsum(no, axis=-1) - no / 2
        total = no.sum(axis=-1) * yes.sum(axis=-1)
        return np.sum(yes * below, axis=-1) / np.where(total > 0, total, np.nan)

    tail = (1 - level) / 2
    low, high = np.nanquantile(area(no, yes), (tail, 1 - tail))
    return float(low), float(high)
