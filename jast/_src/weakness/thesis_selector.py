"""The adversary on encodings: R. J. Moss, "Algorithms for Efficient Validation of Black-Box
Systems", Stanford 2021, chapter 4.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.util.checks import number, truth_value, whole_number
from jast._src.weakness import networks
from jast._src.weakness.features import require_memory, scale_inputs
from jast._src.weakness.selector_contract import Selector, Step

__all__ = ["adversary_of", "draw_halves", "thesis", "train_encoder"]

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
        hidden: widths of the autoencoder. Default: half of an input's numbers and a quarter, at
            most the published 392 and 64 for 784 pixels.
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
    whole = functools.partial(whole_number, "thesis")
    real = functools.partial(number, "thesis")
    positive = (lambda v: 0 < v < np.inf), "above 0"
    widths = None if hidden is None else np.atleast_1d(hidden).tolist()
    if widths == []:
        raise ValueError("thesis: hidden must be at least one width, received none")
    truth_value("thesis", replacement=replacement)
    settings = dict(
        iterations=whole("iterations", iterations),
        sample=whole("sample", sample),
        threshold=real("threshold", threshold, lambda v: 0 <= v <= 1, "in 0 ... 1"),
        copies=whole("copies", copies, 0),
        epochs=whole("epochs", epochs),
        rate=real("rate", rate, *positive),
        hidden=widths and [whole("hidden", width) for width in widths],
        encoder_epochs=whole("encoder_epochs", encoder_epochs),
        encoder_rate=real("encoder_rate", encoder_rate, *positive),
        batch=None if batch is None else whole("batch", batch),
    )
    if replacement:  # named only then, so that earlier states go on
        settings["replacement"] = True

    def start(key, data):
        require_memory(data)
        first, then = jax.random.split(key)
        rows = scale_inputs(data)
        widths, params, losses = train_encoder(first, rows, settings)
        codes = networks.codes_of(params, rows, widths)
        adversary = networks.adversary(codes.shape[1]).init(then)
        counts = dict.fromkeys(("iteration", "drawn", "failed"), np.zeros((), np.int64))
        codes, losses = np.asarray(codes), np.asarray(losses)
        return dict(codes=codes, losses=losses, **counts) | _flat(adversary)

    def step(key, data, memory, seen, ask):
        if memory["iteration"] >= settings["iterations"]:
            return None
        _, for_training = jax.random.split(key)
        lesson, rest = draw_halves(key, data.size, settings["sample"], replacement)

        now = ask(lesson)
        once = np.unique(lesson)
        new = once[~seen.tried[once] & now.tried[once]]
        codes, before = memory["codes"], adversary_of(memory)
        params = _train_adversary(for_training, before, codes, lesson, now, settings)
        scores = np.asarray(jax.nn.sigmoid(networks.logits(params, codes)))

        candidates = rest[scores[rest] >= settings["threshold"]]
        now = ask(candidates)
        counts = dict(
            iteration=memory["iteration"] + 1,
            drawn=memory["drawn"] + len(new),
            failed=memory["failed"] + now.failed[new].sum(),
        )
        expected = counts["failed"] / max(counts["drawn"], 1) * np.sum(~now.tried)
        counts = {name: np.asarray(count, np.int64) for name, count in counts.items()}
        return Step(memory | _flat(params) | counts, scores, candidates, float(expected))

    return Selector("thesis", settings, start, step)


def draw_halves(key, size, sample, replacement):
    """The ``sample`` inputs of an iteration, by its key and the ``size`` of the data: (those that
    the adversary learns from, those that it proposes from), indices.
    """
    rng = numpy_generator(jax.random.split(key)[0])
    drawn = rng.integers(size, size=sample) if replacement else rng.permutation(size)[:sample]
    half = (len(drawn) + 1) // 2
    return drawn[:half], drawn[half:]


def train_encoder(key, rows, settings):
    """The autoencoder trained on ``rows`` [n, d] by the ``settings`` of `thesis`: (its widths,
    params, losses [epochs]).
    """
    hidden = tuple(settings["hidden"] or networks.default_widths(rows.shape[1]))
    batch = settings["batch"] or max(1, min(1000, len(rows) // 10))
    how = dict(epochs=settings["encoder_epochs"], rate=settings["encoder_rate"], batch=batch)
    return hidden, *networks.fit_autoencoder(key, rows, hidden, **how)


def _train_adversary(key, params, codes, lesson, seen, settings):
    """The adversary after training on those of ``lesson`` that were answered: a budget may end in
    the midst of it.
    """
    answered, failed = seen.tried[lesson], seen.failed[lesson]
    times = np.where(failed, 1 + settings["copies"], 1) * answered
    rows = np.repeat(np.arange(len(lesson), dtype=np.int32), times)
    if len(rows) == 0:
        return params
    # of one size, whatever failed: one program for all iterations
    room = np.zeros(len(lesson) * (1 + settings["copies"]), np.int32)
    room[: len(rows)] = rows
    how = dict(epochs=settings["epochs"], rate=settings["rate"])
    failed = failed.astype(np.float32)
    return networks.fit_adversary(key, params, codes[lesson], failed, room, len(rows), **how)[0]


def _flat(params):
    from flax.traverse_util import flatten_dict

    flat = flatten_dict(params, sep="/")
    return {ADVERSARY + name: np.asarray(array) for name, array in flat.items()}


def adversary_of(memory):
    """The adversary's parameters in the ``memory`` of a state."""
    from flax.traverse_util import unflatten_dict

    own = [name for name in memory if name.startswith(ADVERSARY)]
    return unflatten_dict({name.removeprefix(ADVERSARY): memory[name] for name in own}, sep="/")
