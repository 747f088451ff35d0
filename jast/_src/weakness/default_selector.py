"""The default selector: how hard each input is, learned from the labels before any call, and how
the system differs, learned from its answers.
"""

from __future__ import annotations

import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.util.checks import number, whole_number
from jast._src.weakness import committee, features
from jast._src.weakness.failure_odds import fit_logistic, residual_log_odds, sigmoid
from jast._src.weakness.selector_contract import Selector, Step

__all__ = ["PASSES", "STRENGTH", "default"]

PASSES = {True: 8, False: 50}
"""Over images, whose many pixels are soon learned by heart, and over tables."""
CLOSE = 64  # principal components in which distances are measured; a convention
STRENGTH = 10  # weight of an answer of the system in the committee that imitates it; a label's is 1
PRIOR_FAILURES = 2  # that the scores' sum over easy inputs is worth; a convention
LEAST_RANDOM = 20  # random calls that correct that sum: fewer say little
PRIOR = np.array([0.3, 0.25, 0.25, 0.1, -0.5])
"""Prior mean of b in log odds of failure = b . (difficulty, imitation by two views, neighbours, 1):
about an average of the opinions, and below it."""
PRECISION = np.array([4.0, 4.0, 4.0, 4.0, 1.0])
"""Of that prior: deviations of a half, and of 1 for the constant."""
MOST_RANDOM = 0.2  # of a batch


def default(
    *, first: int | None = None, growth: float = 0.35, exploration: float = 0.01, repeats: int = 4
) -> Selector:
    """The `Selector` that `validate` uses unless told otherwise. It needs no knowledge of the
    system, and works on images and tables.

    Before any call, a committee of small networks is cross-validated on the inputs and their
    labels: an input that members who have not seen it get wrong is a hard one for most classifiers.
    After each batch a second committee imitates the system. It learns the system's answers where
    they are known (each with the weight of ten) and the labels elsewhere, and again each input is
    judged by members that have not seen it. A logistic regression on the inputs that were run
    blends these opinions with that of an input's nearest neighbours. A Gaussian process over inputs
    with the same label adds what they all miss, such as a region of easy inputs that the system
    gets wrong.

    A batch is the inputs with the highest probability of failure, except for a share that is drawn
    at random from the others. The scores are probabilities of failure. ``expected`` is their sum
    over what was not run, corrected by how the random calls turned out once there are twenty. It is
    a rough guide, as suspicious inputs teach little about easy ones, and can be a tiny part of the
    truth where a kind of failure has not been met. What the random calls guarantee is
    `Result.at_most`; random choice expects without bias. In a state, ``memory["difficulty"]`` is
    the committee's opinion before any call, as log odds.

    Args:
        first: calls of the first batch. Default: half a per cent of the inputs, at least 10.
        growth: each later batch has this multiple of the calls so far, and at least ``first``.
        exploration: the random share is this over the least probability in the batch, at most a
            fifth: the less a call yields, the more of them are spent on what is not known.
        repeats: how often each input is left out; each repetition is five networks for each of two
            views.

    Example:
        >>> import jast
        >>> jast.weakness.default(first=20).settings["first"]
        20
    """
    first = first if first is None else whole_number("default", "first", first)
    repeats = whole_number("default", "repeats", repeats)
    growth = number("default", "growth", growth, lambda v: 0 <= v < np.inf, "of at least 0")
    exploration = number("default", "exploration", exploration, lambda v: 0 <= v <= 1, "in 0 ... 1")
    settings = dict(first=first, growth=growth, exploration=exploration, repeats=repeats)

    def start(key, data):
        features.require_memory(data)
        rng = numpy_generator(key)
        reduced = features.reduce_inputs(rng, data)
        seen_as = features.make_views(data, reduced)
        close = reduced[:, :CLOSE]
        if not reduced.shape[1]:
            close = features.principal_components(rng, seen_as.centred, CLOSE)
        learn = committee.folds(rng, data.size, min(5, data.size), repeats)
        opinions = [_odds(rng, view, data.labels, learn, learn, data) for view in seen_as]
        difficulty = sum(opinions) / len(opinions)
        neighbours = features.difficulty_of_neighbours(rng, close, data.labels, data.classes)
        drawn, blends = np.zeros(data.size, bool), np.tile(PRIOR, (data.size, 1))
        return dict(
            reduced=reduced,
            close=close,
            learn=learn,
            difficulty=difficulty,
            neighbours=neighbours,
            suspicion=difficulty,
            drawn=drawn,
            blends=blends,
        )

    def step(key, data, memory, seen, ask):
        rng = numpy_generator(key)
        least = max(10, data.size // 200) if first is None else first
        size = max(least, round(growth * len(seen.order)))
        chosen, likely = _batch(rng, memory["suspicion"], seen, size, exploration)
        seen = ask(chosen)
        tried = seen.tried
        answers = np.where(tried, seen.predicted, data.labels)
        weights = memory["learn"] * np.where(tried, STRENGTH, 1)
        imitations = [
            _odds(rng, view, answers, weights, memory["learn"], data)
            for view in features.make_views(data, memory["reduced"])
        ]
        opinions = memory["difficulty"], *imitations, memory["neighbours"], np.ones(data.size)
        rows = np.stack(opinions, axis=1)
        blend = fit_logistic(rows[tried], seen.failed[tried], PRIOR, PRECISION)
        # an input that was run is judged by the blend from before its outcome was known
        blends = np.where(tried[:, None], memory["blends"], blend)
        odds = np.sum(rows * blends, axis=1)
        missed = residual_log_odds(rng, memory["close"], data.labels, rows @ blend, seen)
        suspicion = np.where(tried, odds, odds + missed)
        scores = sigmoid(suspicion)
        random = tried & np.isin(np.arange(data.size), np.setdiff1d(chosen, likely))
        drawn = memory["drawn"] | random
        shares = memory.get("shares", np.zeros(3)) + _share(seen, random)
        memory = memory | dict(suspicion=suspicion, drawn=drawn, blends=blends, shares=shares)
        return Step(memory, scores, likely, _expected(scores, seen, drawn))

    return Selector("default", settings, start, step)


def _expected(scores, seen, drawn):
    """Failures among what was not run: the sum of the scores, times how many more failures than
    their scores say were among those ``drawn`` [n] at random.
    """
    left = scores[~seen.tried]
    # those that would not have been run by now for their scores
    alike = drawn & (scores <= left.max(initial=0))
    # a gamma prior of mean 1, worth so many failures
    more = (PRIOR_FAILURES + seen.failed[alike].sum()) / (PRIOR_FAILURES + scores[alike].sum())
    return float(left.sum() * (more if alike.sum() >= LEAST_RANDOM else 1))


def _share(seen, random):
    """[3] of a batch, for `Result.at_most`: the share that ``random`` [n] is of those it was drawn
    from, the same times the failures known to lie elsewhere, and how many of it failed.
    """
    run, failed = random.sum(), (random & seen.failed).sum()
    share = run / max(run + (~seen.tried).sum(), 1)
    return np.array([share, share * (seen.failed.sum() - failed), failed])


def _odds(rng, x, answers, weights, learn, data):
    """[n] log odds against each input's label, by the members that have not learned from it."""
    trained = committee.fit(rng, x, answers, weights, data.classes, PASSES[data.image])
    right = committee.held_out_probability(trained, x, data.labels, learn)
    right = np.clip(right.astype(float), 1e-6, 1 - 1e-6)
    return np.log1p(-right) - np.log(right)


def _batch(rng, suspicion, seen, size, exploration):
    """(inputs to run, those of them that are held for failures): the most suspect, and some of the
    others at random.
    """
    free = np.flatnonzero(~seen.tried)
    size = min(size, len(free))
    ranked = free[np.argsort(-suspicion[free], kind="stable")]
    share = min(exploration / max(sigmoid(suspicion[ranked[size - 1]]), 1e-6), MOST_RANDOM)
    # the first batch tells how the prior was
    random = rng.binomial(size, share) if len(seen.order) else 0
    likely = ranked[: size - random]
    return np.concatenate([likely, rng.permutation(ranked[size - random :])[:random]]), likely
