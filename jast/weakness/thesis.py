"""The adversary on encodings: R. J. Moss, "Algorithms for Efficient Validation of Black-Box
Systems", Stanford 2021, chapter 4.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import numpy as np

from jast._checks import number, whole
from jast.counter import generator
from jast.weakness import networks
from jast.weakness.contract import Selector, Step
from jast.weakness.views import require_room, scaled

__all__ = ["thesis"]

ADVERSARY = "adversary/"


def thesis(
    *,
    iterations: int = 10,
    sample: int = 500,
    threshold: float = 0.5,
    copies: int = 10,
    epochs: int = 20,
    rate: float = 3e-5,
    hidden: Sequence[int] | None = None,
    encoder_epochs: int = 20,
    encoder_rate: float = 1e-3,
    batch: int | None = None,
    replacement: bool = False,
) -> Selector:
    """The selector of chapter 4 of Moss's thesis: a failure classifier on what an autoencoder makes
    of the inputs, without their labels.

    The autoencoder is trained on all inputs before any call. Each iteration draws inputs without
    replacement, runs the first half, and trains the adversary on their codes, row by row, shuffled
    each epoch. The adversary's weights carry over to the next iteration; Adam starts anew. Those of
    the second half with a score of at least ``threshold`` are the candidates, and are run. What was
    run before is not run again; it is learned from again only if drawn again.

    Images are scaled to [0, 1] as a whole, tables column by column. The scores are the adversary's
    output, on inputs it was trained on too, as published. ``expected`` is the failure rate of the
    random halves, of what was run there first, for every input not yet run.

    Args:
        iterations: how many.
        sample: inputs drawn in each.
        threshold: of a candidate's score.
        copies: how many more times a failure is learned from in an epoch.
        epochs: of the adversary, by Adam.
        rate: of its Adam.
        hidden: widths of the autoencoder. Default: `networks.sizes`, the published 392 and 64 for
            784 pixels.
        encoder_epochs: of the autoencoder, by Adam.
        encoder_rate: of its Adam.
        batch: its minibatches. Default: a tenth of the inputs, at most 1000; the text's 1000 for
            its 10,000.
        replacement: draw with replacement, as the published code does: an input may come twice,
            also once in each half.

    Example:
        >>> import jast
        >>> jast.weakness.thesis(iterations=3).settings["iterations"]
        3
    """
    whole_ = functools.partial(whole, "thesis")
    iterations, sample, epochs, encoder_epochs = (
        whole_(name, value)
        for name, value in dict(
            iterations=iterations, sample=sample, epochs=epochs, encoder_epochs=encoder_epochs
        ).items()
    )
    batch = None if batch is None else whole_("batch", batch)
    copies = whole_("copies", copies, 0)
    threshold = number("thesis", "threshold", threshold, lambda v: 0 <= v <= 1, "in 0 ... 1")
    rate = number("thesis", "rate", rate, lambda v: 0 < v < np.inf, "above 0")
    encoder_rate = number(
        "thesis", "encoder_rate", encoder_rate, lambda v: 0 < v < np.inf, "above 0"
    )
    if not isinstance(replacement, bool):
        raise ValueError(f"thesis: replacement must be True or False, received {replacement!r}")
    hidden = (
        None
        if hidden is None
        else tuple(whole_("hidden", width) for width in np.atleast_1d(hidden).tolist())
    )
    if hidden == ():
        raise ValueError("thesis: hidden must be at least one width, received none")
    settings = dict(
        iterations=iterations,
        sample=sample,
        threshold=threshold,
        copies=copies,
        epochs=epochs,
        rate=rate,
        hidden=hidden and list(hidden),
        encoder_epochs=encoder_epochs,
        encoder_rate=encoder_rate,
        batch=batch,
    )
    if replacement:  # named only then, so that earlier states go on
        settings["replacement"] = True
    start = functools.partial(_start, hidden, encoder_epochs, encoder_rate, batch)
    return Selector(
        "thesis",
        settings,
        start,
        functools.partial(_step, iterations, sample, replacement, threshold, copies, epochs, rate),
    )


def halves(key, size, sample, replacement):
    """The ``sample`` inputs of an iteration, by its key and the ``size`` of the data: (those that
    the adversary learns from, those that it proposes from), indices.
    """
    rng = generator(jax.random.split(key)[0])
    drawn = rng.integers(size, size=sample) if replacement else rng.permutation(size)[:sample]
    half = (len(drawn) + 1) // 2
    return drawn[:half], drawn[half:]


def encoder(key, rows, hidden, epochs, rate, batch):
    """The autoencoder trained on ``rows`` [n, d]: (its widths, params, losses [epochs]); None for
    the default widths and batch.
    """
    hidden = tuple(hidden) if hidden else networks.sizes(rows.shape[1])
    batch = batch or max(1, min(1000, len(rows) // 10))
    return hidden, *networks.fit_autoencoder(
        key, rows, hidden, epochs=epochs, batch=batch, rate=rate
    )


def _start(hidden, epochs, rate, batch, key, data):
    require_room(data)
    first, then = jax.random.split(key)
    rows = scaled(data)
    hidden, params, losses = encoder(first, rows, hidden, epochs, rate, batch)
    codes = networks.codes_of(params, rows, hidden)
    adversary = networks.adversary(codes.shape[1]).init(then)
    counts = {name: np.zeros((), np.int64) for name in ("iteration", "drawn", "failed")}
    return {"codes": np.asarray(codes), "losses": np.asarray(losses), **counts, **_flat(adversary)}


def _step(
    iterations, sample, replacement, threshold, copies, epochs, rate, key, data, memory, seen, ask
):
    if memory["iteration"] >= iterations:
        return None
    _, train = jax.random.split(key)
    lesson, rest = halves(key, data.size, sample, replacement)

    now = ask(lesson)
    once = np.unique(lesson)
    new = once[~seen.tried[once] & now.tried[once]]
    params = _taught(train, nested(memory), memory["codes"], lesson, now, copies, epochs, rate)
    scores = np.asarray(jax.nn.sigmoid(networks.logits(params, memory["codes"])))

    candidates = rest[scores[rest] >= threshold]
    now = ask(candidates)
    counts = dict(
        iteration=memory["iteration"] + 1,
        drawn=memory["drawn"] + len(new),
        failed=memory["failed"] + now.failed[new].sum(),
    )
    expected = counts["failed"] / max(counts["drawn"], 1) * np.sum(~now.tried)
    return Step(
        {
            **memory,
            **_flat(params),
            **{name: np.asarray(count, np.int64) for name, count in counts.items()},
        },
        scores,
        candidates,
        float(expected),
    )


def _taught(key, params, codes, lesson, seen, copies, epochs, rate):
    """The adversary after training on those of ``lesson`` that were answered: a budget may end in
    the midst of it.
    """
    answered, failed = seen.tried[lesson], seen.failed[lesson]
    rows = np.repeat(
        np.arange(len(lesson), dtype=np.int32), np.where(failed, 1 + copies, 1) * answered
    )
    if len(rows) == 0:
        return params
    # of one size, whatever failed: one program for all iterations
    room = np.zeros(len(lesson) * (1 + copies), np.int32)
    room[: len(rows)] = rows
    return networks.fit_adversary(
        key,
        params,
        codes[lesson],
        failed.astype(np.float32),
        room,
        len(rows),
        epochs=epochs,
        rate=rate,
    )[0]


def _flat(params):
    from flax.traverse_util import flatten_dict

    return {
        ADVERSARY + name: np.asarray(array) for name, array in flatten_dict(params, sep="/").items()
    }


def nested(memory):
    """The adversary's parameters in the ``memory`` of a state."""
    from flax.traverse_util import unflatten_dict

    return unflatten_dict(
        {
            name.removeprefix(ADVERSARY): array
            for name, array in memory.items()
            if name.startswith(ADVERSARY)
        },
        sep="/",
    )
