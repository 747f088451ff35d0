"""failure_probability: an estimate from a proposal that is found within the budget, and the plainer
methods beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np

from jast import limit_state as latent
from jast import units
from jast._checks import random_key, whole
from jast._jax import was_interrupted
from jast.checkpoints import stored
from jast.estimate import budgets, diagnostics, few_calls, sums, tilt_estimate, tilt_guard
from jast.estimate.batches import balanced
from jast.estimate.draws import drawn_by
from jast.estimate.estimate import Estimate, estimate, of_counts, or_rough
from jast.estimate.gaussian_estimate import estimated
from jast.estimate.gaussians import effective, together
from jast.estimate.importance_sampling import Traces, chunks, importance
from jast.estimate.multilevel import failure_proposal
from jast.estimate.plain import of_points
from jast.estimate.population import by_populations
from jast.estimate.redrawn import fits
from jast.estimate.sample import Sample
from jast.estimate.seek import Seeker, seek
from jast.estimate.subset import by_levels
from jast.intervals import checked_level
from jast.journal import kept
from jast.results import asked
from jast.rounding import rounded
from jast.watch import Watch

if TYPE_CHECKING:
    import chex

    from jast.failures import Failures
    from jast.simulator import Simulator
    from jast.typing import Callback, Executor, PathLike

__all__ = ["adaptive_cross_entropy", "failure_probability"]

NAME, LEAST = "failure_probability", 5000
SEEN, LOST = 100, 2.0
"""Failures of the model from which plain draws tell a probability; what may be lost, as a multiple
of what was found, from which the proposal is given up.
"""
ASTRAY = "no proposal was found that draws failures in proportion to their probability"
TILTS, POOR, PLENTY = 0.2, 0.05, 500
"""Of the budget, what must be left for tilts to be tried after Gaussians; effective draws of a draw
below which they are, and of all that are left at which they are not.
"""
EXACT, MODEL = 0.01, (0.1, 0.4)
"""Relative standard error beyond which draws serve better as the model's own; their least and
greatest share of the last part.
"""


def failure_probability(
    key: chex.PRNGKey,
    sim: Simulator,
    budget: int | None = None,
    *,
    seconds: float | None = None,
    failures: Failures | None = None,
    near: Estimate | None = None,
    gradients: bool = True,
    level: float = 0.95,
    progress: bool = False,
    callback: Callback | None = None,
    checkpoint: PathLike | None = None,
    executor: Executor | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> Estimate:
    """The probability that a system fails, by the way that suits what an episode costs.

    By default the rate of the system is measured. One that simulates 300,000 episodes in some eight
    CPU seconds is answered by populations that stay on the device (`population`), and so is every
    system in JAX with a budget from 300,000 on. ``settings`` names the budget that was used: the
    same key with that budget gives the same bits. The others, and calls with ``failures`` or
    ``near``, are answered by a proposal that this function finds itself.

    An episode is a point of normal numbers (x_t is the quantile of p(x | s) at Phi(z_t)). Design
    points come from gradients of the miss distance, from noise that is wide first and then cooled,
    from the mirror images of what these found, and from a population of subset simulation where
    gradients did not help and no ``failures`` came with the call; up to 128 directions are kept,
    fewer of more than 250 numbers. Mixtures of Gaussians are fitted to the weighted failures of a
    few batches. A guard, a population that is kept out of what the proposal covers, looks for lost
    failure modes; what it finds is taken in, or else the estimate is UNRELIABLE. Systems of 30
    steps or more, or whose disturbances hold choices (Bernoulli, Categorical), are first tried with
    tilts: each step's own disturbance is tilted by the state and the time, choices by their odds,
    and the tilts are fitted by cross-entropy; a normal number comes from one of three Gaussians
    where a single one serves badly. Others are tried with tilts where the Gaussians promise few
    effective draws.

    What is left of the budget, about half, is drawn from the proposal as it then stands. The
    estimate and its interval come from these episodes alone. A tenth of them or more, up to two
    fifths where the standard error stays below 1 %, are the model's own draws, which meet what no
    explorer was led to; ``unseen`` bounds what they did not meet. All are drawn from the model
    where plain Monte Carlo would be more exact, and where the proposal is given up but the model
    fails often enough. Where it does not, the answer is subset simulation's, and UNRELIABLE. So is
    that of a system whose floats are too coarse (`jast.rounding`), and an estimate with a relative
    standard error above 5 %.

    Fewer than 5000 episodes are for systems that cost a second each. A Gaussian process learns the
    limit state from two thirds of them, 240 at most: the miss distance of the safe ones, and where
    failures are. The others, drawn at random, correct it: the interval comes from these, and holds
    the surrogate's error. Batches of calls suit black boxes with workers. The estimate is
    UNRELIABLE if one call changes much, the relative standard error is above 25 %, or there are
    fewer than 10 failures; if there are none, draws of the model give an upper bound. Above some 20
    numbers an episode it mostly ends so. The method itself takes some 4 CPU seconds for 200 calls,
    more where NumPy's threads wait for one another (OPENBLAS_NUM_THREADS=1); their number changes
    what is drawn.

    A failure mode below ``unseen`` that all explorers miss is missing without a sign. A
    KeyboardInterrupt during the last part ends it with the estimate of the draws so far; before
    that, with an UNRELIABLE estimate from the batches of the search, and it is raised where there
    is none yet. Host loop, not for `jax.jit` or `jax.vmap`.

    Args:
        key: consumed.
        sim: the simulator; its disturbances have quantile functions.
        budget: episodes to simulate, at least 50. Default: what a cheap system simulates in some
            eight CPU seconds, at most 33,554,432; 100,000 of others.
        seconds: in place of ``budget``: as many episodes as the system simulates in so many CPU
            seconds (a black box: seconds), rounded down to 2^k or 3 2^k. Compilation and the
            method's own work come on top.
        failures: known ones (an archive, `jast.failures`), which join what the explorers find, so
            that no mode among them is lost. They lead to a proposal and never enter the estimate.
            Tilts take in two modes that they hardly draw; where others are left, or these could not
            be learned, the estimate is UNRELIABLE.
        near: the `Estimate` of a similar system, such as the neighbour in a sweep. Its proposal,
            fitted to two or three batches, takes the place of the search where it serves; the guard
            and the last draws stay. One without a proposal that fits changes nothing.
        gradients: differentiate the miss distance. Where its gradients lead nowhere, nothing
            depends on them.
        level: of the interval, in (0, 1).
        progress: whether to show a progress bar.
        callback: called as ``callback(done, total, None)`` after each chunk of the last part.
        checkpoint: a folder that keeps finished units of the work. The same call then goes on where
            it was stopped, to the same result.
        executor: runs the units: anything with ``submit(function, *args)``, such as the executors
            of `concurrent.futures` and Dask's client. It changes no result.
        devices: some of `jax.devices()`, one thread each. They change no result (docs/scale.md).

    Returns:
        `Estimate`. ``modes`` are parts of the estimate by direction; ``proposal`` serves
        `jast.estimate.failure_samples`; ``history`` tells how the search went; ``evaluations``
        counts each episode, and three for one with its gradient.

    Raises:
        ValueError: for a budget below 50, a budget together with ``seconds``, ``seconds`` not above
            0, a level outside (0, 1), disturbances without a quantile function, and where the
            simulator's functions do not fit together.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing(b=0.8)  # truly 6e-9
        >>> found = jast.estimate.failure_probability(jax.random.key(0), sim, 6000)
        >>> truth = float(jast.simulators.landing_probability(b=0.8))
        >>> 0.8 < found.mean / truth < 1.25
        True
    """
    name = NAME
    random_key(name, key)
    budgets.given(name, budget, seconds)
    if budget is not None:
        budget = whole(name, "budget", budget, few_calls.LEAST)
    level = checked_level(name, level)
    latent.check(name, sim)
    if near is not None and not isinstance(near, Estimate):
        raise ValueError(f"{name}: near must be an Estimate, received {type(near).__name__}")
    similar = near.proposal if near is not None and fits(sim, near.proposal) else None
    similar = None if isinstance(similar, Sample) else similar  # which draws nothing
    alone = failures is None and similar is None
    if budget is None:
        guided = not alone and seconds is None
        of_time = lambda: budgets.budget_of(name, key, sim, seconds, few_calls.LEAST)
        budget = budgets.DEAR if guided else of_time()
    settings = asked(name, key, budget=budget, gradients=bool(gradients), level=level)
    known = None if failures is None else latent.normal_of(sim, failures.episodes)
    ways = units.ways(name, executor, devices)
    about = dict(sim=sim, budget=budget, gradients=bool(gradients), known=known, near=similar)
    with stored(name, checkpoint, key, **about) as store, kept(store):
        if alone and budgets.cheap(sim, budget):
            ways, watched = ways._replace(store=store), (progress, callback)
            found = by_populations(name, key, sim, budget, level=level, watched=watched, ways=ways)
        elif budget < LEAST:
            found = few_calls.few_calls(key, sim, budget, level, known, progress, callback)
        else:
            ways, watched = ways._replace(store=store), (progress, callback)
            s = Seeker(key, sim, budget, known, similar)
            s.recorded = None if failures is None else failures.episodes
            found = or_rough(_sought(key, s, gradients, level, watched, ways))
    return found._replace(settings=settings)


def _sought(key, s, gradients, level, watched, ways):
    """The `Estimate` by a proposal that the `Seeker` ``s`` seeks within the budget; ``watched``:
    progress and callback.
    """
    if (coarse := rounded(s.sim)) is not None:
        s.coarse.append(coarse)
    try:
        t = tilt_estimate.first(s)
        if t is None or not t.serves(tilt_estimate.SERVES) or not _enough(s, t):
            t = _beside_gaussians(s, t, gradients)
        return _with_the_rest(key, s, t, level, watched, ways)
    except (KeyboardInterrupt, jax.errors.JaxRuntimeError) as error:
        if not was_interrupted(error):
            raise
        if not s.batches:
            raise KeyboardInterrupt from error
        return _of_the_search(s, level)


def _beside_gaussians(s, t, gradients):
    """Seek Gaussians: the `TiltSeeker` that serves better than these and than plain draws, else
    None; ``t``: one that has been sought.
    """
    tried = [t]

    def instead(s):
        if tried[0] is not None or not _poor(s, tilt_estimate.SERVES) or _plain_is_better(s):
            return False
        tried[0] = tilt_estimate.after(s)
        return tried[0].serves(tilt_estimate.SERVES)

    seek(s, gradients, instead)
    n, [t], known = s.budget - s.spent, tried, s.log_mean is not None
    better = known and _plain_is_better(s)
    if t is None and (_astray(s, n) or _poor(s, POOR)) and n > TILTS * s.budget and not better:
        t = tilt_estimate.after(s)
    gaussian = 0.0 if not known or max(s.lost, s.asked) > LOST else _promised(s, 1)
    return t if t is not None and t.serves(gaussian) else None


def _with_the_rest(key, s, t, level, watched, ways):
    """The `Estimate` of what is left of the budget, by the proposal that was found: that of the
    `TiltSeeker` ``t`` where there is one.
    """
    if t is not None and _enough(s, t):
        tilt_guard.guarded(s, t)
        n = s.budget - s.spent
        share, watch = _of_the_model(t.promised * n), Watch(NAME, n, "episode", *watched)
        return tilt_estimate.estimated(key, s, t, share, level, watch, ways)
    # a search of many parts may have spent all
    sim, n = s.sim, max(s.budget - s.spent, s.batch)
    lanes = s.batch
    about = dict(level=level, reasons=[*s.coarse, *s.reasons], history=tuple(s.history))
    astray, log_p = _astray(s, n), _about(s)
    enough = math.exp(min(log_p, 0.0)) * n >= SEEN
    if astray and not enough:
        found = by_levels(key, sim, n, log_p, level, about["reasons"] or [ASTRAY])
        if found is not None:
            return found._replace(
                episodes=s.spent + found.episodes,
                history=(*about["history"], *found.history),
                plain=s.plain,
            )
    if s.log_mean is None or (astray and enough) or _plain_is_better(s):
        watch = Watch(NAME, n, "episode", *watched)
        total, notes, lost = chunks(of_points, (key, sim, lanes, n), lanes, watch, ways)
        about["reasons"] = [*s.coarse, *lost]  # the others are about the proposal
        found = of_counts(
            NAME, total, notes=notes, evaluations=s.spent + total.samples, proposal=s.q, **about
        )
        return found._replace(draws=drawn_by(found.draws, key, lanes, "model"))
    share = _of_the_model(_promised(s, n))
    watch = Watch(NAME, n, "episode", *watched)
    about |= dict(spent=s.spent, plain=s.plain, share=share, drawn=s.batch)
    q = together(s.q, s.model(), share)
    return estimated(key, sim, q, lanes, watch, ways, **about)._replace(proposal=s.q)


def _enough(s, t):
    """Whether what is left of the budget tells the probability by the `TiltSeeker` ``t``."""
    return t.promised * (s.budget - s.spent) > diagnostics.ESS


def _about(s):
    """The log probability, roughly; -inf where no failure was seen."""
    if s.log_mean is not None:
        return s.log_mean
    return max((p.log_mean for p in s.populations if p.reached), default=-math.inf)


def _astray(s, n):
    """Whether ``n`` draws of the proposal would not tell the probability."""
    if s.log_mean is None or s.lost > LOST:
        return True
    return _promised(s, n) < diagnostics.ESS


def _promised(s, n):
    """The effective sample size of ``n`` draws of the proposal, by its last batch."""
    b = s.batches[-1]
    return effective(b.log_weight[b.failure]) / len(b.z) * n


def _poor(s, share):
    """Whether draws of the proposal have less than ``share`` effective ones each, and all that are
    left of the budget less than `PLENTY`.
    """
    return _promised(s, 1) < share and _promised(s, s.budget - s.spent) < PLENTY


def _of_the_model(promised):
    """The share of the last draws, of ``promised`` effective ones, that are the model's own: as
    great as leaves a standard error of `EXACT`. They bound what nothing led to.
    """
    return float(np.clip(1 - 1 / (EXACT**2 * promised), *MODEL))


def _of_the_search(s, level):
    """The `Estimate` of the batches of a search that was interrupted, by the balance heuristic."""
    log_w, failing = balanced(s.batches)
    rows = len(failing)
    log_weights = np.full(rows, -np.inf)
    log_weights[failing] = log_w
    none = np.zeros(rows)
    seen = Traces(log_weights, none[:, None], failing, none.astype(bool), none.astype(int))
    against = (
        f"interrupted after {s.spent} of {s.budget} evaluations: the estimate uses the same"
        " episodes that chose the proposal"
    )
    return estimate(
        NAME,
        sums.add(sums.nothing(rows), seen),
        level=level,
        reasons=[*s.coarse, against],
        evaluations=s.spent,
        proposal=s.q,
        history=tuple(s.history),
        plain=s.plain,
    )


def adaptive_cross_entropy(
    key: chex.PRNGKey, sim: Simulator, budget: int = 100_000, *, level: float = 0.95
) -> Estimate:
    """The multi-level cross-entropy method (de Boer, Kroese, Mannor and Rubinstein 2005) with one
    Gaussian, then importance sampling with the rest of the budget.

    Each of 20 iterations spends ``budget // 100`` episodes on finding the proposal
    (`jast.estimate.failure_proposal`). It settles on one failure mode without a sign of the others:
    a baseline, and quick where there is only one.

    Args:
        key: consumed.
        sim: the simulator.
        budget: episodes in all, at least 5000.
        level: of the interval, in (0, 1).

    Returns:
        `Estimate`.

    Raises:
        ValueError: for a budget below 5000, and as `failure_proposal`.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing()
        >>> found = jast.estimate.adaptive_cross_entropy(jax.random.key(0), sim, 5000)
        >>> found.episodes
        5000
    """
    name = "adaptive_cross_entropy"
    random_key(name, key)
    budget = whole(name, "budget", budget, LEAST)
    level = checked_level(name, level)
    settings = asked(name, key, budget=budget, level=level)
    for_search, key = jax.random.split(key)
    found = failure_proposal(for_search, sim, samples=budget // 100, iterations=20)
    result = importance(key, sim, found.policy, budget - int(found.episodes), level=level)
    against = () if bool(found.reached) else ("the search for a proposal did not reach failures",)
    words = "one Gaussian covers one failure mode, and no others were looked for"
    return result._replace(
        method=name,
        episodes=budget,
        settings=settings,
        reliable=result.reliable and not against,
        warnings=(*against, *result.warnings, words),
        history=tuple(str(found).splitlines()),
    )


def _plain_is_better(s):
    """Whether counting failures of the model has less variance than weighing those of the
    proposal.
    """
    b, p = s.batches[-1], min(math.exp(s.log_mean), 1.0)
    w = np.where(b.failure, np.exp(np.where(b.failure, b.log_weight - s.log_mean, 0)), 0)
    return p > 0 and (w**2).mean() - w.mean() ** 2 >= (1 - p) / p
