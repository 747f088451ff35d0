"""The validation loop of jast.weakness: calls are counted and never repeated, nothing that was
answered is lost, and scores are judged as scikit-learn does.
"""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import roc_auc_score, roc_curve

from jast import weakness
from jast._src.core.counter_prng import numpy_generator
from jast._src.io import npz
from jast._src.runtime.checkpoints import Checkpoint
from jast.weakness import Selector, Step, validate

KEY = jax.random.key(0)


def same(a, b):
    """That two results or states are the same to the bit, NaN and texts included."""
    assert type(a) is type(b)
    if isinstance(a, tuple | dict):
        assert len(a) == len(b)
        for name in a if isinstance(a, dict) else range(len(a)):
            same(a[name], b[name])
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b


class System:
    """Answers from a list, by the first number of an input, which is its index; notes what it was
    asked.
    """

    def __init__(self, answers):
        self.answers, self.batches = np.asarray(answers), []

    def __call__(self, batch):
        at = np.asarray(batch).reshape(len(batch), -1)[:, 0].astype(int)
        self.batches.append(at)
        return self.answers[at]

    @property
    def asked(self):
        return np.concatenate(self.batches) if self.batches else np.zeros(0, int)


def problem(n, rate=0.2, classes=3, seed=0):
    """(inputs [n, 2] whose first number is the index, labels, answers of a system that is wrong at
    ``rate``).
    """
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, classes, n)
    return (
        np.stack([np.arange(n), rng.normal(size=n)], 1),
        labels,
        np.where(rng.random(n) < rate, (labels + 1) % classes, labels),
    )


def in_turn(size=7, sets=2):
    """A selector that asks for the next inputs, ``sets`` times an iteration, and remembers how many
    it has seen fail.
    """

    def step(key, data, memory, seen, ask):
        at = int(memory["at"])
        for _ in range(sets):
            now = ask(np.arange(at, min(at + size, data.size)))
            at += size
        noise = numpy_generator(key).random(data.size, np.float32)
        return Step(
            {"at": np.asarray(at), "failed": np.asarray(now.failed.sum())},
            noise,
            np.arange(int(memory["at"]), min(at, data.size)),
            1.5,
        )

    return Selector(
        "in turn",
        {"size": size},
        lambda key, data: {"at": np.asarray(0), "failed": np.asarray(0)},
        step,
    )


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 80), st.integers(1, 100), st.floats(0, 1), st.integers(0, 10**6))
def test_every_input_is_asked_at_most_once_and_every_call_is_counted(n, budget, rate, seed):
    inputs, labels, answers = problem(n, rate, seed=seed)
    system = System(answers)
    result = validate(
        jax.random.key(seed), system, inputs, labels, budget=budget, selector="random", classes=3
    )
    assert result.calls == min(n, budget) == len(system.asked) == len(set(system.asked.tolist()))
    np.testing.assert_array_equal(result.order, system.asked)
    np.testing.assert_array_equal(
        result.failures, [i for i in result.order if answers[i] != labels[i]]
    )
    np.testing.assert_array_equal(
        result.predicted, np.where(np.isin(np.arange(n), result.order), answers, -1)
    )
    assert sorted(result.ranked.tolist() + result.order.tolist()) == list(range(n))
    assert result.history.calls[-1] == result.calls
    assert result.history.found[-1] == len(result.failures)


def test_random_choice_expects_what_its_rate_says():
    inputs, labels, answers = problem(4000, 0.1)
    result = validate(KEY, System(answers), inputs, labels, budget=1000, selector="random")
    left = int(np.sum(answers != labels)) - len(result.failures)
    # hypergeometric: the standard error of the rate of 1000 of 4000, times the 3000 left; 4 of them
    assert abs(result.expected - left) < 4 * 4000 * np.sqrt(0.1 * 0.9 / 1000 * 3000 / 4000)
    assert result.history.recall[-1] == pytest.approx(
        len(result.failures) / (len(result.failures) + result.expected)
    )


def test_rows_of_the_history():
    inputs, labels, answers = problem(60, 0.3)
    result = validate(KEY, System(answers), inputs, labels, selector=in_turn())
    failed = answers != labels
    ends = np.r_[14:60:14, 60]
    np.testing.assert_array_equal(result.history.calls, ends)
    np.testing.assert_array_equal(result.history.found, [failed[:e].sum() for e in ends])
    np.testing.assert_allclose(
        result.history.precision,
        [failed[a:e].mean() for a, e in zip(np.r_[0, ends], ends, strict=False)],
    )
    np.testing.assert_allclose(
        result.history.recall, [failed[:e].sum() / (failed[:e].sum() + 1.5) for e in ends]
    )
    np.testing.assert_allclose(
        result.history.auc,
        [
            roc_auc_score(failed[:e], s[:e])
            for e, s in zip(ends, result.history.scores, strict=True)
        ],
        rtol=1e-6,
    )
    np.testing.assert_array_equal(result.scores, result.history.scores[-1])


def test_the_most_suspect_come_first():
    inputs, labels, answers = problem(50)
    result = validate(KEY, System(answers), inputs, labels, budget=28, selector=in_turn())
    assert np.all(np.diff(result.scores[result.ranked]) <= 0) and len(result.ranked) == 22


def test_large_batches_are_cut(monkeypatch):
    inputs, labels, answers = problem(3000)
    system = System(answers)
    validate(KEY, system, inputs, labels, selector=in_turn(2500, 1))
    assert [len(b) for b in system.batches] == [1024, 1024, 452, 500]


def test_inputs_reach_the_system_as_they_are():
    seen = []
    images = np.arange(40, dtype=np.uint8).reshape(10, 2, 2)
    validate(
        KEY,
        lambda x: seen.append(x) or np.zeros(len(x), int),
        images,
        np.zeros(10, int),
        selector=in_turn(10, 1),
    )
    assert seen[0].dtype == np.uint8 and seen[0].shape == (10, 2, 2)


class Flaky(System):
    """Raises ``error`` when it is asked for input ``at``, once."""

    def __init__(self, answers, at, error):
        super().__init__(answers)
        self.at, self.error = at, error

    def __call__(self, batch):
        if self.error is not None and self.at in batch[:, 0]:
            error, self.error = self.error, None
            raise error
        return super().__call__(batch)


@pytest.mark.parametrize(
    "error", [RuntimeError("out of memory"), KeyboardInterrupt()], ids=["raises", "interrupted"]
)
@pytest.mark.parametrize("at", [7, 20, 59])
def test_an_interrupted_validation_goes_on_as_if_it_had_not_been(at, error):
    inputs, labels, answers = problem(60)
    whole = validate(KEY, System(answers), inputs, labels, selector=in_turn())
    system = Flaky(answers, at, error)
    with pytest.warns(RuntimeWarning, match="ended after"):
        part = validate(KEY, system, inputs, labels, selector=in_turn())
    assert len(part.incidents) == 1 and part.calls == len(system.asked) < 60
    if isinstance(error, RuntimeError):
        assert "RuntimeError: out of memory" in part.incidents[0]
        assert f"[{at // 7 * 7}, " in part.incidents[0]
        assert "out of memory" in str(part)
    rest = validate(
        jax.random.key(99), system, inputs, labels, selector=in_turn(), state=part.state
    )
    same(rest, whole)
    assert len(system.asked) == 60


def test_a_checkpoint_holds_every_answer(tmp_path):
    inputs, labels, answers = problem(60)
    path = tmp_path / "run.jast"
    whole = validate(KEY, System(answers), inputs, labels, selector=in_turn())
    system = Flaky(answers, 38, SystemExit())  # what nothing catches
    with pytest.raises(SystemExit):
        validate(KEY, system, inputs, labels, selector=in_turn(), checkpoint=path)
    _, state = npz.read(path / "state.jast", {"jast checkpoint state": 1}, "a state")
    assert len(state["result.order"]) == 35
    same(validate(KEY, system, inputs, labels, selector=in_turn(), checkpoint=path), whole)
    assert len(system.asked) == 60
    same(validate(KEY, system, inputs, labels, selector=in_turn(), checkpoint=path), whole)
    assert len(system.asked) == 60
    for change, what in [
        (dict(key=jax.random.key(1)), "key is"),
        (dict(predict=lambda x: x), "predict is .*Flaky there, .*lambda"),
        (dict(labels=labels[::-1]), "data is"),
        (dict(selector="random"), "selector is"),
        (dict(state=whole.state), "state"),
    ]:
        asked = dict(key=KEY, predict=system, inputs=inputs, labels=labels, selector=in_turn())
        with pytest.raises(ValueError, match=f"validate: checkpoint .* another call: {what}"):
            validate(**asked | change, checkpoint=path)


def test_a_state_and_its_checkpoint_go_on_together(tmp_path):
    inputs, labels, answers = problem(60)
    go_on = lambda system, **how: validate(KEY, system, inputs, labels, selector=in_turn(), **how)
    state, whole = go_on(System(answers), budget=14).state, go_on(System(answers))
    system = Flaky(answers, 38, SystemExit())
    with pytest.raises(SystemExit):
        go_on(system, state=state, checkpoint=tmp_path)
    same(go_on(system, state=state, checkpoint=tmp_path), whole)
    assert len(system.asked) == 60 - 14


def test_a_state_survives_its_file(tmp_path):
    inputs, labels, answers = problem(60)
    state = validate(KEY, System(answers), inputs, labels, budget=28, selector=in_turn()).state
    weakness.save(tmp_path / "s.npz", state)
    same(weakness.load(tmp_path / "s.npz"), state)
    data = bytearray((tmp_path / "s.npz").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "s.npz").write_bytes(data)
    with pytest.raises(ValueError, match="load: .* damaged"):
        weakness.load(tmp_path / "s.npz")


def test_answers_that_an_iteration_does_not_ask_for_again_are_kept():
    """A selector that changes its mind after an interruption."""
    inputs, labels, answers = problem(60)
    system, mind = Flaky(answers, 38, OSError("gone")), []

    def step(key, data, memory, seen, ask):
        at = len(seen.order)
        plan = (
            [np.arange(at, min(at + 10, 60)), np.arange(30, 40)]
            if not mind
            else [np.flatnonzero(~seen.tried)[-25:]]
        )
        for part in plan:
            now = ask(part)
        return Step({}, np.full(60, 0.5), plan[0], float(len(now.order)))

    changing = Selector("changing", {}, lambda key, data: {}, step)
    with pytest.warns(RuntimeWarning, match="OSError"):
        part = validate(KEY, system, inputs, labels, selector=changing, budget=50)
    # asked, but of an iteration that has not ended
    assert part.order.tolist() == list(range(10)) and len(part.history.calls) == 0
    mind.append(True)
    result = validate(KEY, system, inputs, labels, selector=changing, budget=50, state=part.state)
    assert len(system.asked) == len(set(system.asked.tolist())) == result.calls == 50
    assert result.history.calls.tolist() == [25, 40, 50]
    assert set(range(10)) <= set(result.order.tolist())
    assert result.state.complete == 50
    assert sorted(result.ranked.tolist() + result.order.tolist()) == list(range(60))


def test_a_larger_budget_goes_on():
    inputs, labels, answers = problem(60)
    part = validate(KEY, System(answers), inputs, labels, budget=28, selector=in_turn())
    same(
        validate(
            KEY, System(answers), inputs, labels, budget=60, selector=in_turn(), state=part.state
        ),
        validate(KEY, System(answers), inputs, labels, selector=in_turn()),
    )


def test_a_selector_that_asks_nothing_is_stopped():
    inputs, labels, answers = problem(20)
    idle = Selector(
        "idle",
        {},
        lambda key, data: {},
        lambda key, data, memory, seen, ask: Step({}, np.full(20, 0.5), np.zeros(0, int), 0.0),
    )
    with pytest.warns(RuntimeWarning, match="nothing new"):
        result = validate(KEY, System(answers), inputs, labels, selector=idle)
    assert result.calls == 0 and np.isnan(result.history.precision).all()


def test_a_selector_may_pause():
    """Only so many idle iterations in a row are an end."""
    inputs, labels, answers = problem(30)

    def step(key, data, memory, seen, ask):
        turn = int(memory["turn"])
        now = ask(np.arange(0 if turn % 15 else len(seen.order) + 10)[:30])
        return Step(
            {"turn": np.asarray(turn + 1)},
            np.full(30, 0.5),
            np.zeros(0, int),
            float(len(now.order)),
        )

    result = validate(
        KEY,
        System(answers),
        inputs,
        labels,
        selector=Selector("pauses", {}, lambda key, data: {"turn": np.asarray(0)}, step),
    )
    assert result.calls == 30
    assert len(result.history.calls) == 31
    assert not result.incidents


@pytest.mark.parametrize("wrong", [[-1], [60], [0.5], [[1, 2]]])
def test_indices_that_are_none(wrong):
    inputs, labels, answers = problem(60)
    asks = Selector(
        "odd", {}, lambda key, data: {}, lambda key, data, memory, seen, ask: ask(wrong)
    )
    with pytest.raises(ValueError, match="the selector odd must ask for indices"):
        validate(KEY, System(answers), inputs, labels, selector=asks)


def boom(*_):
    raise OSError("disk full")


@pytest.mark.parametrize("where", ["callback", "selector", "scores", "checkpoint"])
def test_nothing_is_lost_where_something_else_raises(where, tmp_path, monkeypatch):
    inputs, labels, answers = problem(60)
    system, selector = System(answers), in_turn()

    def step(key, data, memory, seen, ask):
        out = in_turn().step(key, data, memory, seen, ask)
        return (
            out
            if len(seen.order) < 28
            else boom()
            if where == "selector"
            else out._replace(scores=out.scores + 2)
        )

    if where in ("selector", "scores"):
        selector = selector._replace(step=step)
    if where == "checkpoint":
        calls, real = [], Checkpoint.replace
        monkeypatch.setattr(
            Checkpoint,
            "replace",
            lambda *a: boom() if len(calls) == 5 else calls.append(1) or real(*a),
        )
    at = (
        (lambda done, n, r: boom() if len(r.history.calls) == 3 else None)
        if where == "callback"
        else None
    )
    with pytest.warns(
        RuntimeWarning,
        match="disk full" if where != "scores" else r"scores must be \[60\] in \[0, 1\]",
    ):
        part = validate(
            KEY,
            system,
            inputs,
            labels,
            selector=selector,
            callback=at,
            checkpoint=tmp_path if where == "checkpoint" else None,
        )
    assert part.calls == len(system.asked) == 42 and len(part.incidents) == 1
    assert np.isnan(part.expected) == (where != "callback")  # the third iteration had ended
    monkeypatch.undo()
    rest = validate(KEY, system, inputs, labels, selector=in_turn(), state=part.state)
    same(rest, validate(KEY, System(answers), inputs, labels, selector=in_turn()))
    assert len(system.asked) == 60


def test_a_smaller_budget_ends_what_was_begun():
    inputs, labels, answers = problem(60)
    system = Flaky(answers, 35, OSError("gone"))
    with pytest.warns(RuntimeWarning, match="gone"):
        part = validate(KEY, system, inputs, labels, selector=in_turn(20))
    assert part.calls == 20
    rest = validate(KEY, system, inputs, labels, budget=5, selector=in_turn(20), state=part.state)
    assert rest.calls == 20 and rest.history.calls.tolist() == [20]


def test_the_last_iteration_is_in_the_checkpoint(tmp_path):
    inputs, labels, answers = problem(60)
    asked = dict(inputs=inputs, labels=labels, selector=in_turn(), checkpoint=tmp_path)
    result = validate(KEY, System(answers), **asked)
    system = System(answers)
    same(validate(KEY, system, **asked), result)
    assert not len(system.asked)


def test_more_classes_may_turn_up():
    inputs, labels, answers = problem(60)
    answers[45] = 3
    system = System(answers)
    with pytest.warns(RuntimeWarning, match=r"0 ... 2 \(classes=3\), received 3 for input 45"):
        part = validate(KEY, system, inputs, labels, selector=in_turn())
    rest = validate(KEY, system, inputs, labels, selector=in_turn(), state=part.state, classes=4)
    assert rest.calls == 60 and 45 in rest.failures
    assert weakness.influence(KEY, rest, inputs, labels).shape == (len(rest.failures), 2)


@pytest.mark.parametrize(
    "key", [jax.random.PRNGKey(3), jax.random.key(3, impl="rbg")], ids=["legacy", "rbg"]
)
def test_keys_of_other_kinds(key):
    inputs, labels, answers = problem(60)
    part = validate(key, System(answers), inputs, labels, budget=20, selector="random")
    same(validate(key, System(answers), inputs, labels, budget=20, selector="random"), part)
    assert (
        validate(
            KEY, System(answers), inputs, labels, budget=40, selector="random", state=part.state
        ).calls
        == 40
    )


def test_random_choice_is_random():
    inputs, labels, answers = problem(400)
    order = validate(KEY, System(answers), inputs, labels, selector="random", budget=100).order
    # the mean of 100 of 0 ... 399 without replacement has a standard error of 10; they are in no
    # order
    assert abs(order.mean() - 199.5) < 40 and 30 < np.sum(np.diff(order) > 0) < 70


def test_scores_of_any_kind_of_number():
    assert weakness.auc(np.array([0, 1, 2], np.uint8), np.array([False, False, True])) == 1
    assert weakness.auc(np.array([-128, 1, 2], np.int8), np.array([True, False, False])) == 0
    assert weakness.auc(np.array([False, True]), np.array([False, True])) == 1


def test_a_selector_may_end_before_the_budget():
    inputs, labels, answers = problem(20)
    done = Selector("done", {}, lambda key, data: {}, lambda key, data, memory, seen, ask: None)
    result = validate(KEY, System(answers), inputs, labels, selector=done)
    assert result.calls == 0
    assert result.incidents == ()
    assert result.state.finished
    assert len(result.ranked) == 20
    assert "0 failures in 0 calls" in str(result)


@pytest.mark.parametrize("wrong", [False, True])
@pytest.mark.parametrize("selector", ["random", in_turn()], ids=["random", "own"])
def test_a_system_without_failures_and_one_with_nothing_else(wrong, selector):
    inputs, labels, _ = problem(30)
    result = validate(KEY, System((labels + wrong) % 3), inputs, labels, selector=selector)
    assert len(result.failures) == (30 if wrong else 0)
    assert np.isnan(result.history.auc).all()
    assert str(result)
    judged = weakness.judge(result, np.full(30, wrong))
    assert np.isnan(judged.auc).all()


def test_progress_and_callback(capsys):
    inputs, labels, answers = problem(60)
    calls = []
    validate(
        KEY,
        System(answers),
        inputs,
        labels,
        selector=in_turn(),
        progress=True,
        callback=lambda done, total, r: calls.append((done, total, r.calls)),
    )
    assert calls == [(n, 60, n) for n in (14, 28, 42, 56, 60)]
    assert "60/60" in capsys.readouterr().err


def test_results_print_as_a_table():
    inputs, labels, answers = problem(60)
    lines = str(
        validate(KEY, System(answers), inputs, labels, budget=28, selector=in_turn())
    ).splitlines()
    assert "failures in 28 calls (60 inputs)" in lines[0]
    assert lines[1].split() == [
        "iteration",
        "calls",
        "failures",
        "precision",
        "~recall",
        "AUC",
        "run",
        "~expected",
    ]
    assert [line.split()[:2] for line in lines[2:]] == [["1", "14"], ["2", "28"]]
    assert "guide" not in lines[0]


def test_the_default_selector_says_how_rough_its_expectation_is():
    inputs, labels, answers = problem(60)
    result = validate(KEY, System(answers), inputs, labels, budget=20)
    head = str(result).splitlines()[0]
    assert f"roughly {result.expected:.0f} expected among the 40 not run (a guide only" in head
    memory = result.state.memory | dict(shares=np.array([0.5, 0.0, 0.0]))
    sure = result._replace(state=result.state._replace(memory=memory))
    # as many draws as half of the inputs without a failure: log .05 / (exp(-1.5) - 1) / .5 in all
    assert sure.at_most == pytest.approx(7.7125 - result.failing, abs=1e-3)
    assert f", by its random calls at most {sure.at_most:.0f} in 95 %" in str(sure)
    none = result.state._replace(memory={})
    assert np.isnan(result._replace(state=none).at_most)


def test_a_bound_that_every_input_may_reach_is_not_told():
    """Of 40 inputs that were not run at most 40 fail: that is no news. A bound of 39 is told."""
    inputs, labels, answers = problem(60)
    result = validate(KEY, System(answers), inputs, labels, budget=20)

    def bounded(at_most):
        """The result whose random calls bound the failures left by ``at_most``."""
        share = 0.5
        known = (at_most + result.failing) * share - np.log(20) / -np.expm1(-1.5)
        memory = result.state.memory | dict(shares=np.array([share, known, 0.0]))
        return result._replace(state=result.state._replace(memory=memory))

    few, all_of_them = bounded(39.0), bounded(41.0)
    assert few.at_most == pytest.approx(39) and all_of_them.at_most == 40
    assert "at most 39 in 95 %" in str(few) and "at most" not in str(all_of_them)


GOOD = np.zeros((6, 2)), np.array([0, 1, 2, 0, 1, 2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(inputs=np.zeros(6)), r"inputs must be numbers \[n, ...\].*shape \(6,\)"),
        (dict(inputs=np.array([["a"] * 2] * 6)), "inputs must be numbers"),
        (dict(inputs=np.zeros((0, 2)), labels=np.zeros(0, int)), "inputs must be numbers"),
        (
            dict(inputs=np.where(np.arange(12).reshape(6, 2) == 5, np.nan, 0.0)),
            "1 of 6 hold NaN or infinity, the first is number 2",
        ),
        (
            dict(inputs=np.where(np.arange(12).reshape(6, 2) > 9, np.inf, 0.0)),
            "1 of 6 hold NaN or infinity, the first is number 5",
        ),
        (dict(labels=np.zeros(5, int)), r"labels must be whole numbers \[6\].*shape \(5,\)"),
        (dict(labels=np.zeros(6)), "labels must be whole numbers.*float64"),
        (
            dict(labels=np.array([0, 1, -1, 0, 1, 2])),
            r"labels must lie in 0 ... 2; 1 do not, the first is number 2: -1",
        ),
        (dict(classes=2), r"labels must lie in 0 ... 1; 2 do not, the first is number 2: 2"),
        (dict(classes=1), "classes must be a whole number of at least 2"),
        (dict(inputs=GOOD[0] + 1e31), r"inputs must lie within 1e\+30 of 0"),
        (
            dict(labels=np.array([0, 1, 2, 0, 1, 2**31])),
            "there may be 65536 classes, received 2147483649; np.unique",
        ),
        (dict(labels=np.array(list("abcabc"))), r"labels must be whole numbers.*np.unique\(labels"),
        (dict(callback=3), "callback must be callable"),
        (dict(checkpoint=3), "checkpoint must be the path of a folder, received 3"),
        (dict(checkpoint=__file__), "checkpoint must be a folder, received the file"),
        (dict(predict=None), "predict must be callable"),
        (dict(budget=0), "budget must be a whole number of at least 1"),
        (dict(selector="best"), "selector must be one of .*received 'best'"),
        (dict(selector=weakness.thesis), r"selector must be one of .*: call it, thesis\(\)"),
        (dict(selector=["random"]), "selector must be one of"),
        (dict(state=3), "state must be the state of a Result, received int"),
    ],
)
def test_bad_arguments(change, message):
    given = (
        dict(
            predict=lambda x: np.zeros(len(x), int),
            inputs=GOOD[0],
            labels=GOOD[1],
            selector="random",
        )
        | change
    )
    with pytest.raises(ValueError, match="validate: .*" + message):
        validate(KEY, given.pop("predict"), given.pop("inputs"), given.pop("labels"), **given)


@pytest.mark.parametrize(
    ("predict", "message"),
    [
        (
            lambda x: 1 / 0,
            (
                r"raised ZeroDivisionError: division by zero, on the batch of 6 inputs \[\d, \d,"
                r" \d, \d, ...\]"
            ),
        ),
        (
            lambda x: np.zeros((len(x), 3), int),
            r"whole numbers \[6\], received int64 of shape \(6, 3\)",
        ),
        (lambda x: np.zeros((len(x), 3)), r"received float64 of shape \(6, 3\); give the argmax"),
        (lambda x: np.zeros(len(x) - 1, int), r"received int64 of shape \(5,\)"),
        (lambda x: np.zeros(len(x)), "received float64"),
        (lambda x: None, "received object"),
        (lambda x: np.full(len(x), 3), r"labels in 0 ... 2 \(classes=3\), received 3 for input"),
        (lambda x: np.full(len(x), -1), "received -1"),
    ],
)
def test_a_system_that_does_not_answer_at_all(predict, message):
    with pytest.raises(ValueError, match="validate: predict .*" + message):
        validate(KEY, predict, *GOOD, selector="random")


def test_a_state_of_something_else_is_refused():
    inputs, labels, answers = problem(20)
    state = validate(KEY, System(answers), inputs, labels, budget=10, selector=in_turn()).state
    with pytest.raises(ValueError, match="state must .*received Result: give result.state"):
        validate(
            KEY,
            System(answers),
            inputs,
            labels,
            selector=in_turn(),
            state=validate(KEY, System(answers), inputs, labels, selector=in_turn()),
        )
    with pytest.raises(ValueError, match="state is of other inputs or labels"):
        validate(KEY, System(answers), inputs + 1, labels, selector=in_turn(), state=state)
    with pytest.raises(ValueError, match="state is of the selector .*in turn"):
        validate(KEY, System(answers), inputs, labels, selector="random", state=state)
    with pytest.raises(ValueError, match="state is of the selector"):
        validate(KEY, System(answers), inputs, labels, selector=in_turn(8), state=state)


def test_answers_may_be_of_jax():
    inputs, labels, _ = problem(20)
    assert len(
        validate(
            KEY,
            lambda x: jax.numpy.zeros(len(x), jax.numpy.int32),
            inputs,
            labels,
            selector="random",
        ).failures
    ) == np.sum(labels != 0)


@settings(deadline=None, max_examples=100)
@given(st.lists(st.tuples(st.integers(-3, 3), st.booleans()), min_size=1, max_size=40))
def test_the_roc_curve_is_scikit_learns(pairs):
    scores, failed = np.array([p[0] for p in pairs], float), np.array([p[1] for p in pairs])
    if failed.all() or not failed.any():
        assert np.isnan(weakness.auc(scores, failed))
        return
    assert weakness.auc(scores, failed) == pytest.approx(roc_auc_score(failed, scores), abs=1e-12)
    ours, theirs = weakness.roc(scores, failed), roc_curve(failed, scores, drop_intermediate=False)
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b)
    assert weakness.auc(np.exp(scores), failed) == pytest.approx(weakness.auc(scores, failed))


def test_judged_by_the_truth():
    inputs, labels, answers = problem(200, 0.3)
    result = validate(KEY, System(answers), inputs, labels, budget=140, selector=in_turn(70, 1))
    failed = answers != labels
    judged = weakness.judge(result, failed, threshold=0.8)
    for i, s in enumerate(result.history.scores):
        picked = s >= 0.8
        assert judged.candidates[i] == picked.sum()
        assert judged.precision[i] == failed[picked].mean()
        assert judged.recall[i] == failed[picked].sum() / failed.sum()
        assert judged.auc[i] == pytest.approx(roc_auc_score(failed, s))
    top = weakness.judge(result, failed, top=20)
    np.testing.assert_array_equal(top.candidates, [20, 20])
    assert top.precision[0] == failed[np.argsort(-result.history.scores[0])[:20]].mean()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: weakness.judge(r, np.zeros(5, bool)), r"judge: failed must be bool \[20\]"),
        (lambda r: weakness.judge(r, np.zeros(20)), "judge: failed must be bool .*float64"),
        (lambda r: weakness.judge(r, np.ones(20, bool), top=21), "judge: top must be at most 20"),
        (
            lambda r: weakness.judge(r, np.ones(20, bool), top=0),
            "judge: top must be a whole number of at least 1",
        ),
        (
            lambda r: weakness.judge(r, np.ones(20, bool), threshold="a"),
            "judge: threshold must be a number",
        ),
        (
            lambda r: weakness.judge(3, np.ones(20, bool)),
            "judge: result must be a Result, received int",
        ),
        (lambda r: weakness.judge(r, np.zeros(20, bool)), "failed must agree with the result"),
        (lambda r: weakness.roc(np.zeros(3), np.zeros(4, bool)), "roc: scores and failed must be"),
        (
            lambda r: weakness.auc(np.array([0.0, np.nan]), np.zeros(2, bool)),
            "scores must not be NaN, 1 are",
        ),
    ],
)
def test_bad_judgements(call, message):
    inputs, labels, answers = problem(20)
    result = validate(KEY, System(answers), inputs, labels, selector=in_turn())
    with pytest.raises(ValueError, match=message):
        call(result)
