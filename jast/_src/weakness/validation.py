"""The validation loop: which inputs a classifier gets wrong, found with few calls."""

from __future__ import annotations

import json
import os
import traceback
import warnings
from typing import Literal

import jax
import numpy as np

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.typing import Array, Callback, PathLike, Predict, PRNGKey
from jast._src.runtime.checkpoints import open_checkpoint
from jast._src.runtime.progress_bar import Watch, terminable
from jast._src.util.checks import check_random_key, whole_number, wrong
from jast._src.weakness import selectors
from jast._src.weakness.data import are_indices, check_data, fingerprint
from jast._src.weakness.measures import auc
from jast._src.weakness.result import History, Result, State
from jast._src.weakness.selector_contract import Seen, Selector

__all__ = ["iteration_key", "validate"]

CHUNK = 1024  # inputs of one call of predict: memory, and what is lost at an interruption
IDLE = 20  # iterations in a row without a new call, after which a selector is stuck


class _NoAnswer(Exception):
    """The system did not answer."""


def validate(
    key: PRNGKey,
    predict: Predict,
    inputs: Array,
    labels: Array,
    *,
    budget: int | None = None,
    selector: Selector | Literal["default", "random", "thesis"] = "default",
    classes: int | None = None,
    state: State | None = None,
    checkpoint: PathLike | None = None,
    progress: bool = False,
    callback: Callback | None = None,
) -> Result:
    """Find the inputs of a labelled data set that a classifier gets wrong, with few calls of it.

    The search ends with a RuntimeWarning where ``predict`` raises, or answers with something else
    than m labels in range, and at a KeyboardInterrupt or SIGTERM. The result so far says so in
    ``incidents``, with the batch: nothing that was answered is lost, and the same batch is asked
    again by a run that continues. So it is where anything else raises after the first answer:
    ``callback``, the checkpoint's disk, a selector.

    Args:
        key: consumed. A ``state`` continues with its own.
        predict: inputs [m, ...] -> labels [m]: the system under test, any Python callable. It is
            called with up to 1024 inputs at once, in the dtype of ``inputs``, and never twice on
            one input.
        inputs: [n, ...]: images [n, height, width] and the like, or rows of a table [n, columns].
        labels: [n]: the true classes, whole numbers in 0 ... ``classes`` - 1, as the predictions
            must be.
        budget: calls, those of ``state`` included. Default: all n. The iteration in which it is
            spent is cut short.
        selector: "default" learns from the labels how hard each input is, and from each answer
            where the system differs (`default`); "thesis" is the adversary on encodings of chapter
            4 of Moss's thesis (`thesis`); "random"; or a `Selector` with settings of your own.
        classes: how many there are. Default: the largest label and 1.
        state: of an earlier result of the same data and selector, to continue from: after an
            interruption as if there had been none, after a budget that was spent with new batches.
        checkpoint: a folder that keeps the state after every call of ``predict``. The same call
            then goes on where it was stopped, to the same result (docs/scale.md), and with a larger
            budget as from a ``state``.
        progress: whether to show a progress bar, of calls.
        callback: called as ``callback(done, total, result)`` after each iteration, with the calls
            and the result so far.

    Returns:
        `Result`.

    Raises:
        ValueError: for a wrong answer at the very first call; for inputs that are not finite,
            labels out of range, a state of other data or of another selector, and a checkpoint of
            another call.

    Example:
        >>> import jax, jast
        >>> inputs, labels = (a[:200] for a in jast.weakness.digits())
        >>> wrong = lambda x: (x.sum((1, 2)) > 20).astype(int)  # a poor classifier
        >>> found = jast.weakness.validate(
        ...     jax.random.key(0), wrong, inputs, labels, budget=50, selector="random"
        ... )
        >>> found.calls, len(found.failures) > 20
        (50, True)
    """
    data = check_data("validate", inputs, labels, classes)
    chosen = _selector(selector)
    n = data.size
    if not callable(predict):
        must = "be callable: inputs [m, ...] -> labels [m]"
        raise wrong("validate", "predict", must, f"{predict!r}")
    budget = n if budget is None else min(whole_number("validate", "budget", budget), n)
    if state is None:
        check_random_key("validate", key)
    else:
        _fits(state, data, chosen)
    about = dict(predict=predict, data=fingerprint(data), selector=_described(chosen), state=state)
    with open_checkpoint("validate", checkpoint, key, **about) as store, terminable():
        kept = None if store is None else store.state()
        state = kept or state or _begin(key, data, chosen)
        budget = max(budget, len(state.order))
        return _run(state, chosen, data, predict, budget, store, progress, callback)


def _selector(selector):
    if isinstance(selector, Selector):
        return selector
    if not isinstance(selector, str) or selector not in selectors.NAMES:
        hint = f": call it, {selector.__name__}()" if selector in selectors.NAMES.values() else ""
        must = f"be one of {sorted(selectors.NAMES)} or a Selector"
        raise wrong("validate", "selector", must, f"{selector!r}{hint}")
    return selectors.NAMES[selector]()


def _described(selector):
    return json.dumps([selector.name, selector.settings], sort_keys=True)


def _begin(key, data, selector):
    n = data.size
    columns = (np.zeros(0, kind) for kind in (int, int, float, float, float, float))
    history = History(*columns, scores=np.zeros((0, n), np.float32))
    numbers = np.asarray(jax.random.key_data(key))
    if numbers.shape != (2,):  # of another generator
        numbers = numpy_generator(key).integers(0, 2**32, 2, np.uint32)
    memory = selector.start(iteration_key(numbers, 0), data)
    return State(
        selector=_described(selector),
        data=fingerprint(data),
        key=numbers,
        memory=memory,
        order=np.zeros(0, int),
        predicted=np.full(n, -1, np.int32),
        complete=0,
        history=history,
        finished=False,
    )


def iteration_key(numbers, iteration):
    """The key of an iteration, from 1; of the selector's start, 0. ``numbers``: of a `State`."""
    return jax.random.fold_in(jax.random.wrap_key_data(numbers, impl="threefry2x32"), iteration)


def _fits(state, data, selector):
    if not isinstance(state, State):
        hint = ": give result.state" if isinstance(state, Result) else ""
        must = "be the state of a Result"
        raise wrong("validate", "state", must, f"{type(state).__name__}{hint}")
    if state.data != fingerprint(data):
        raise ValueError("validate: state is of other inputs or labels")
    if state.selector != _described(selector):
        raise ValueError(
            f"validate: state is of the selector {state.selector}, received {_described(selector)}:"
            " give the same again"
        )


def _run(state, selector, data, predict, budget, store, progress, callback):
    answers, answered = state.predicted.copy(), list(state.order)  # all that the system has said
    # what whole iterations have seen of it
    seen = _seen(state.order[: state.complete], answers, data.labels)
    memory, history, finished, incidents = state.memory, state.history, state.finished, []
    watch = Watch("validate", budget, "call", progress, callback, done=len(answered))

    def kept():
        order, predicted, _ = _seen(answered, answers, data.labels)
        return state._replace(
            memory=memory,
            order=order,
            predicted=predicted,
            complete=len(seen.order),
            history=history,
            finished=finished,
        )

    def keep():
        if store is not None:
            store.replace(kept())

    current = seen

    def ask(indices):
        nonlocal current
        indices = np.asarray(indices)
        if indices.size and indices.ndim != 1 or not are_indices(indices, data.size):
            must = f"ask for indices [m] in 0 ... {data.size - 1}"
            raise wrong("validate", f"the selector {selector.name}", must, f"{indices!r}")
        left = budget - len(current.order)
        new = [i for i in dict.fromkeys(indices.tolist()) if current.predicted[i] < 0][:left]
        fresh = [i for i in new if answers[i] < 0][: budget - len(answered)]
        for at in range(0, len(fresh), CHUNK):
            batch = np.asarray(fresh[at : at + CHUNK])
            answers[batch] = _answers(predict, data, batch)
            answered.extend(batch.tolist())
            watch.reach(len(answered))
            keep()
        order = current.order.tolist() + [i for i in new if answers[i] >= 0]
        current = _seen(order, answers, data.labels)
        return current

    idle = 0
    try:
        while not finished and len(seen.order) < budget:
            current = seen
            key = iteration_key(state.key, 1 + len(history.calls))
            step = selector.step(key, data, memory, seen, ask)
            if step is None:
                finished = True
                break
            idle = 0 if len(current.order) > len(seen.order) else idle + 1
            row = _row(history, step, current)
            # those that an interrupted iteration had asked for, and this one has not, come last
            others = np.asarray(answered, int)[~current.tried[answered]]
            order = current.order.tolist() + others.tolist()
            seen, memory, history, answered = current, step.memory, row, order
            watch.tell(lambda: _result(kept(), data, ()))
            if idle == IDLE:
                incidents.append(f"the selector asked for nothing new in {IDLE} iterations")
                break
        keep()
    except _NoAnswer as stop:
        if not answered:
            raise ValueError(f"validate: {stop}") from stop.__cause__
        incidents.append(str(stop))
    except Exception as error:
        if not answered:
            raise
        frame = traceback.extract_tb(error.__traceback__)[-1]
        incidents.append(
            f"{type(error).__name__}: {error} ({os.path.basename(frame.filename)}:{frame.lineno})"
        )
    except KeyboardInterrupt:
        if not answered:
            raise
        incidents.append("interrupted")
    finally:
        watch.close()
    if incidents:
        warnings.warn(
            f"validate: ended after {len(answered)} of {budget} calls: {incidents[0]}",
            RuntimeWarning,
            stacklevel=3,
        )
    return _result(kept(), data, tuple(incidents))


def _answers(predict, data, batch):
    """[m] int32: what the system says about the inputs numbered ``batch``."""
    where = (
        f"the batch of {len(batch)} inputs"
        f" [{', '.join(map(str, batch[:4]))}{', ...' if len(batch) > 4 else ''}]"
    )

    def refusal(must, received):
        return _NoAnswer(f"predict must return {must}, received {received}, on {where}")

    try:
        given = predict(data.inputs[batch])
    except Exception as error:
        raise _NoAnswer(f"predict raised {type(error).__name__}: {error}, on {where}") from error
    try:
        said = np.asarray(given)
    except Exception as error:
        raise refusal(f"labels [{len(batch)}]", type(given).__name__) from error
    if said.shape != batch.shape or said.dtype.kind not in "iub":
        hint = ""
        if said.dtype.kind == "f":
            hint = "; give the argmax of scores" if said.ndim > 1 else "; give them as integers"
        received = f"{said.dtype} of shape {said.shape}{hint}"
        raise refusal(f"whole numbers [{len(batch)}]", received)
    out = np.flatnonzero((said < 0) | (said >= data.classes))
    if len(out):
        must = f"labels in 0 ... {data.classes - 1} (classes={data.classes})"
        raise refusal(must, f"{said[out[0]]} for input {batch[out[0]]}")
    return said.astype(np.int32)


def _seen(order, answers, labels):
    predicted = np.full_like(answers, -1)
    predicted[order] = answers[order]
    return Seen(np.asarray(order, int), predicted, labels)


def _row(history, step, seen):
    """``history`` and one more iteration."""
    failed, tried = seen.failed, seen.tried
    scores = np.asarray(step.scores, np.float32)
    outside = ~((scores >= 0) & (scores <= 1))
    if scores.shape != tried.shape or outside.any():
        bad = f", {outside.sum()} elsewhere" if scores.shape == tried.shape else ""
        must = f"be [{len(tried)}] in [0, 1]"
        raise wrong("validate", "the selector's scores", must, f"shape {scores.shape}{bad}")
    ran = np.asarray(step.candidates, int)
    ran = ran[tried[ran]]
    found, total = int(failed.sum()), failed.sum() + step.expected
    new = (
        len(seen.order),
        found,
        failed[ran].mean() if len(ran) else np.nan,
        found / total if total > 0 else np.nan,
        auc(scores[tried], failed[tried]),
        step.expected,
        scores,
    )
    return History(
        *(
            np.concatenate([old, np.asarray(one, old.dtype)[None]])
            for old, one in zip(history, new, strict=True)
        )
    )


def _result(state, data, incidents):
    seen = Seen(state.order, state.predicted, data.labels)
    h, left = state.history, np.flatnonzero(~seen.tried)
    scores = h.scores[-1] if len(h.scores) else np.full(data.size, 0.5, np.float32)
    ranked = left[np.argsort(-scores[left], kind="stable")]
    failures = state.order[seen.failed[state.order]]
    # of the last iteration, unless more has been answered since
    expected = (
        float(h.expected[-1]) if len(h.expected) and state.complete == len(state.order) else np.nan
    )
    return Result(
        failures=failures,
        calls=len(state.order),
        order=state.order,
        predicted=state.predicted,
        scores=scores,
        ranked=ranked,
        expected=expected,
        history=h,
        incidents=incidents,
        state=state,
    )
