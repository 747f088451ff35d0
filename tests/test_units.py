"""Units of work: where they run, and what ended the call before, changes no result; what goes wrong
on the way is told.
"""

import concurrent.futures
import functools
import gc
import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import line

import jast
from jast._src.core.policy import nominal_policy
from jast._src.estimate import importance_sampling
from jast._src.io.fingerprint import describe_differences, fingerprint
from jast._src.runtime import backends, work
from jast._src.runtime.backends import Task
from jast._src.runtime.checkpoints import (
    PARTS,
    Checkpoint,
    RecordFile,
    open_checkpoint,
    read_records,
)
from jast._src.runtime.progress_bar import Watch
from jast.estimate import (
    Estimate,
    failure_probability,
    failure_samples,
    importance,
    policy_proposal,
    splitting,
    subset_simulation,
)
from jast.policies import sac
from jast.search import cem, chain, falsify, forest, go_explore, gradient, mcts, monte_carlo
from jast.simulators import ferry, walk1d
from jast.weakness import default, validate

ROOT = Path(__file__).parents[1]
LINE = line(horizon=3)
EASY = line(horizon=3, evaluate=lambda s: (s >= 1, jnp.maximum(1 - s, 0)))
EPISODES = 3000
CALLS = {
    "nominal": lambda key, **how: jast.nominal(key, walk1d(), EPISODES, **how),
    "monte_carlo": lambda key, **how: monte_carlo(
        key, walk1d(), episodes=EPISODES, refine=0, record=True, **how
    ),
    "forest": lambda key, **how: forest(
        key, walk1d(), trees=6, prunes=2, simulations=20, lanes=2, refine=0, **how
    ),
    "failure_probability": lambda key, **how: failure_probability(key, LINE, 5000, **how),
    "importance": lambda key, **how: importance(
        key, walk1d(), policy_proposal(walk1d(), nominal_policy(walk1d())), EPISODES, **how
    ),
    "splitting": lambda key, **how: splitting(key, LINE, 100, runs=3, **how),
    "subset_simulation": lambda key, **how: subset_simulation(key, LINE, 100, replicates=3, **how),
    "mcts": lambda key, **how: mcts(
        key, walk1d(), trees=3, simulations=30, lanes=1, refine=0, keep_trees=True, **how
    ),
}
"""A call of each kind, of a few units."""
long = lambda name: pytest.param(name, marks=pytest.mark.long)
LATER = ("mcts", "importance", "failure_probability", "splitting")


@pytest.fixture(autouse=True)
def small_units(monkeypatch):
    monkeypatch.setattr(importance_sampling, "LANES", 1000)
    monkeypatch.setattr(sys.modules["jast._src.search.monte_carlo"], "LANES", 512)


class Full:
    """A file on a disk that is full after ten bytes."""

    def __init__(self, file):
        self.file = file

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        self.file.write(data[:10])
        raise OSError(28, "No space left on device")


def parts(folder):
    """The records of a checkpoint; none where it is not there yet."""
    return list(read_records(folder / PARTS)) if (folder / PARTS).exists() else []


@pytest.fixture
def same(equal):
    """Asserts that two results are the same to the bit."""

    def check(a, b):
        about = lambda result: getattr(result, "settings", None)
        assert about(a) == about(b) and str(a) == str(b)
        if isinstance(a, Estimate):
            assert repr(tuple(a)) == repr(tuple(b))  # NaN is NaN
        elif "settings" in getattr(a, "_fields", ()):
            check(getattr(a, "refined", None), getattr(b, "refined", None))
            bare = dict(settings=None) | (dict(refined=None) if hasattr(a, "refined") else {})
            equal(a._replace(**bare), b._replace(**bare))
        else:
            equal(a, b)

    return check


def square(shared, number, context):
    """A unit that needs no simulator."""
    return np.array(number**2)


def fails(shared, number, context):
    """Unit 1 never comes to its end."""
    if number == 1:
        raise ZeroDivisionError("one")
    return square(shared, number, context)


class Flaky:
    """An executor of this process, in which all units fail the first times."""

    def __init__(self, times):
        self.pool, self.times, self.tries = ThreadPoolExecutor(1), times, {}

    def submit(self, function, *args):
        number = args[-1]
        self.tries[number] = self.tries.get(number, 0) + 1
        if self.tries[number] <= self.times:
            return self.pool.submit(lambda: 1 / 0)
        return self.pool.submit(function, *args)


class Closing:
    """One that is shut down after a few units."""

    def __init__(self, after):
        self.pool, self.left = ThreadPoolExecutor(1), after

    def submit(self, function, *args):
        self.left -= 1
        if self.left == 0:
            self.pool.shutdown()
        return self.pool.submit(function, *args)


def squares(n=5, function=square, executor=None, **how):
    watch = Watch("squares", n, "unit", False, how.pop("callback", None))
    placement = work.placement("squares", executor, how.pop("devices", None))
    like = lambda: 0
    fold = lambda state, number, result: (*state, int(result))
    return work.run(Task(function, None, like), n, fold, (), watch, placement, **how)


# --- where units run, and from where they go on


@pytest.mark.parametrize("name", [long(n) if n in LATER else n for n in CALLS])
def test_no_place_changes_a_result(name, key, same, tmp_path):
    call = CALLS[name]
    alone = call(key)
    same(call(key, checkpoint=tmp_path / "run.jast"), alone)
    log, kept = tmp_path / "run.jast" / PARTS, parts(tmp_path / "run.jast")
    assert len(kept) > 2
    data = bytearray(log.read_bytes())
    data[kept[1].begin] ^= 1  # damaged, and the last one cut: both are done again
    log.write_bytes(data[:-1])
    with ThreadPoolExecutor(2) as executor:
        same(call(key, checkpoint=tmp_path / "run.jast", executor=executor), alone)
        same(call(key, checkpoint=tmp_path / "run.jast"), alone)
    same(call(key, devices=jax.devices()), alone)


def test_what_is_done_is_not_done_again(key, tmp_path, monkeypatch, same):
    call, done = CALLS["nominal"], []
    real = sys.modules["jast._src.core.nominal"]._unit

    def unit(job, number, context):
        done.append(number)
        return real(job, number, context)

    monkeypatch.setattr(sys.modules["jast._src.core.nominal"], "_unit", unit)

    def stop(done, total, _):
        raise KeyboardInterrupt

    part = call(key, checkpoint=tmp_path, callback=stop)
    assert part.episodes < EPISODES and "interrupted" in part.settings
    on_disk = len(parts(tmp_path))
    done.clear()
    whole = call(key, checkpoint=tmp_path)
    assert len(done) == 3 - on_disk < 3
    same(whole, call(key))


@pytest.mark.parametrize("ended_by", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_a_call_with_what_is_done(key, ended_by):
    episodes = 200 * EPISODES  # many units, as those that run beside the interrupted one are kept
    end = lambda *_: os.kill(os.getpid(), ended_by)
    # a shell that starts the tests in the background has them ignore Ctrl-C
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        found = jast.nominal(key, walk1d(), episodes, callback=end)
    finally:
        signal.signal(signal.SIGINT, before)
    assert 0 < found.episodes < episodes and found.settings["interrupted"].startswith("after ")
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def taught(key, **how):
    """A forest whose heads learn between two rounds, without the heads' functions."""
    found = forest(
        key, ferry(), trees=6, prunes=3, simulations=60, lanes=2, refine=0, heads="rollout", **how
    )
    heads = found.heads
    return found._replace(heads=(heads.policy.params, heads.inputs, heads.returns))


def learned(key, **how):
    """A policy that was taught, without its functions."""
    policy = sac(
        key, walk1d(horizon=3), episodes=800, lanes=8, hidden=(16,), batch=32, updates=1, **how
    )
    return policy.learned, policy.history


def guessed(inputs):
    """A classifier that takes a while."""
    time.sleep(0.01)
    return (inputs.sum(axis=1) > 0).astype(int)


def validated(key, **how):
    inputs = np.random.default_rng(0).normal(size=(300, 3))
    labels = (inputs[:, 0] > 0).astype(int)
    found = validate(key, guessed, inputs, labels, selector=default(first=30, growth=0.0), **how)
    return found[: found._fields.index("incidents")]


KILLED = CALLS | {"heads": taught, "sac": learned, "validate": validated}


def child(name, folder):
    """A process that makes a call of `KILLED` with a checkpoint."""
    code = (
        "import sys; sys.path.insert(0, 'tests'); import conftest, jax, test_units as t;"
        f"t.EPISODES = {EPISODES};"
        f"t.KILLED[{name!r}](jax.random.key(7), checkpoint={str(folder)!r})"
    )
    env = os.environ | dict(PYTHONPATH=str(ROOT))
    return subprocess.Popen([sys.executable, "-W", "ignore", "-c", code], cwd=ROOT, env=env)


def killed(name, folder, delay):
    """How many parts a call had kept when its process was killed, ``delay`` seconds after it had
    begun to; None where it had come to its end.
    """
    process = child(name, folder)
    begun = lambda: parts(folder) or (folder / "state.jast").exists()
    while not begun() and process.poll() is None:
        time.sleep(0.002)
    time.sleep(delay)
    process.kill()
    return None if process.wait() == 0 else len(parts(folder))


def test_a_killed_call_goes_on_to_the_same_result(tmp_path, same, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "EPISODES", 400_000)
    folder = tmp_path / "run.jast"
    folder.mkdir()
    units_done = killed("nominal", folder, 0.05)
    assert units_done is None or units_done >= 1
    key = jax.random.key(7)
    same(CALLS["nominal"](key, checkpoint=folder), CALLS["nominal"](key))


@functools.cache
def estimated():
    return failure_probability(jax.random.key(0), LINE, 5000)


def sampled(source, key, sim, **how):
    return failure_samples(key, sim, source, 50, moves=4, **how)


SEQUENTIAL = {
    "cem": lambda key, **how: cem(
        key, walk1d(), samples=40, elites=8, iterations=4, refine=0, record=True, **how
    ),
    "chain": lambda key, **how: chain(key, EASY, episodes=600, **how),
    "go_explore": lambda key, **how: go_explore(key, EASY, episodes=1200, **how),
    "falsify": lambda key, **how: falsify(key, LINE, simulations=50, stop=False, **how),
    "gradient": lambda key, **how: gradient(key, EASY, starts=4, **how),
    "failure_probability": CALLS["failure_probability"],
    "few calls": lambda key, **how: failure_probability(key, LINE, 60, **how),
    "failure_samples": lambda key, **how: sampled(estimated(), key, LINE, **how),
    "samples of a policy": lambda key, **how: sampled(nominal_policy(EASY), key, EASY, **how),
}
"""Calls whose steps depend on one another."""
SHORT = "failure_probability", "falsify"


@pytest.mark.parametrize("name", [n if n in SHORT else long(n) for n in sorted(SEQUENTIAL)])
def test_a_system_is_not_asked_again(name, key, same, tmp_path, monkeypatch):
    """A journal with its second half gone is the same as none, and so is one with other answers."""
    call, folder = SEQUENTIAL[name], tmp_path / "run.jast"
    alone = call(key)
    same(call(key, checkpoint=folder), alone)
    answers = [r for r in parts(folder) if r.header["name"].startswith("answer")]
    assert len(answers) > 3
    os.truncate(folder / PARTS, answers[len(answers) // 2].end)
    with RecordFile(folder / PARTS) as ledger:
        ledger.put("answer-1", *ledger.get("answer-0"))
    same(call(key, checkpoint=folder), alone)
    assert {r.header["name"] for r in parts(folder)} >= {r.header["name"] for r in answers}
    monkeypatch.setattr(Checkpoint, "put", lambda *_: pytest.fail("asked again"))
    same(call(key, checkpoint=folder), alone)


# --- what goes wrong


def test_a_unit_that_fails_elsewhere_is_tried_again():
    flaky = Flaky(2)
    ran = squares(executor=flaky)
    assert ran.state == (0, 1, 4, 9, 16)
    assert ran.left_out == ()
    assert ran.incidents == ()
    assert set(flaky.tries.values()) == {3}


def test_a_unit_that_goes_on_failing_is_left_out_and_told():
    with ThreadPoolExecutor(2) as executor:
        ran = squares(function=fails, executor=executor)
    assert ran.state == (0, 4, 9, 16)
    assert ran.left_out == (1,)
    assert ran.done == 5
    (incident,) = ran.incidents
    assert "ZeroDivisionError: one" in str(incident) and "make the same call again" in str(incident)
    assert "units 1 are left out" in work.describe_missing("units", ran, 4, 5)


def test_where_all_units_fail_the_call_says_why():
    with pytest.raises(RuntimeError, match="squares: every unit of work failed .*, 3 times.*Zero"):
        squares(executor=Flaky(9))
    with pytest.raises(ZeroDivisionError):  # in this process, at once
        squares(function=fails)


def test_an_executor_that_is_shut_down_leaves_what_is_done():
    ran = squares(n=600, executor=Closing(after=300))
    assert 0 < len(ran.state) < 600 and list(ran.state) == [i**2 for i in range(len(ran.state))]
    assert "cannot schedule new futures" in work.describe_missing("units", ran, ran.done, 600)
    with pytest.raises(RuntimeError, match="squares: the executor takes no more work"):
        squares(executor=Closing(after=1))


def test_an_executor_with_other_versions_is_refused(monkeypatch):
    here = backends.versions()
    answers = iter([here, here | {"jax": "0.1.0"}])
    monkeypatch.setattr(backends, "versions", lambda: next(answers))
    with ThreadPoolExecutor(1) as executor:
        with pytest.raises(ValueError, match="squares: .*other versions.*jax is 0.1.0 there"):
            squares(n=1, executor=executor)


def test_what_cannot_be_sent_is_named(monkeypatch):
    held = threading.Lock()
    with ThreadPoolExecutor(1) as executor:
        with pytest.raises(ValueError, match="squares: .*cannot be sent.*lock.*in a module"):
            squares(function=lambda *_: held, executor=executor)
        assert squares(function=lambda s, n, p: np.array(n), n=2, executor=executor).state == (0, 1)
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(ValueError, match="lambda.*define the simulator's.*install cloudpickle"):
            squares(function=lambda s, n, p: np.array(n), executor=executor)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in CALLS if n not in LATER])
def test_bad_places_are_named(name, key, tmp_path):
    call, other = CALLS[name], CALLS["monte_carlo" if name == "nominal" else "nominal"]
    other(key, checkpoint=tmp_path / "other")
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/thesis.tex").write_text("")
    for how, match in [
        (dict(executor=3), "executor must have submit"),
        (dict(devices=[]), "devices must be of jax.devices"),
        (dict(devices="cpu"), "devices must be of jax.devices"),
        (dict(devices=jax.devices(), executor=Flaky(0)), "devices must be None where"),
        (dict(checkpoint=3), "checkpoint must be the path of a folder, received 3"),
        (dict(checkpoint=tmp_path / "file"), "checkpoint must be a folder, received the file"),
        (dict(checkpoint=tmp_path / "full"), ".* holds other files, such as thesis.tex"),
        (
            dict(checkpoint=tmp_path / "other"),
            f".* another call: function is '.*' there, '{name}'",
        ),
    ]:
        with pytest.raises(ValueError, match=f"{name}: {match}"):
            call(key, **how)
    with pytest.raises(OSError, match=f"{name}: checkpoint .* cannot be written: Not a directory"):
        call(key, checkpoint=tmp_path / "file/run.jast")


def test_a_checkpoint_of_another_key_or_in_use_is_refused(key, tmp_path):
    call = CALLS["nominal"]

    def again(*_):
        with pytest.raises(ValueError, match=f"in use by another call .process {os.getpid()}."):
            call(key, checkpoint=tmp_path)

    call(key, checkpoint=tmp_path, callback=again)
    with pytest.raises(ValueError, match="another call: key is .* there, .* here; give another"):
        call(jax.random.fold_in(key, 1), checkpoint=tmp_path)


def test_a_full_disk_is_told(key, tmp_path, monkeypatch, same):
    def full(self, *args):
        self._file = Full(self._file)
        real(self, *args)

    real = RecordFile.put
    with monkeypatch.context() as patch:
        patch.setattr(RecordFile, "put", full)
        match = "nominal: checkpoint .* cannot be written: No space left"
        with pytest.raises(OSError, match=match):
            CALLS["nominal"](key, checkpoint=tmp_path)
    assert (tmp_path / PARTS).stat().st_size == 0  # nothing of what was begun
    same(CALLS["nominal"](key, checkpoint=tmp_path), CALLS["nominal"](key))


def test_a_state_that_cannot_be_written_leaves_the_last_one(key, tmp_path, monkeypatch):
    def full(file, **entries):
        file.write(b"a half")
        raise OSError(28, "No space left on device")

    with open_checkpoint("sac", tmp_path, key) as store:
        store.replace({"at": 1, "a": np.arange(3)})
        with monkeypatch.context() as patch:
            patch.setattr(np, "savez", full)
            with pytest.raises(OSError, match="sac: checkpoint .* No space left"):
                store.replace({"at": 2, "a": np.arange(4)})
    with open_checkpoint("sac", tmp_path, key) as store:
        state = store.state()
        assert state["at"] == 1 and state["a"].tolist() == [0, 1, 2]
        (tmp_path / "state.jast").write_bytes(b"PK damaged")
        assert store.state() is None  # the chain begins anew


def test_a_call_goes_on_with_another_executor(key, tmp_path, same):
    executor = ThreadPoolExecutor(1)
    close = lambda *_: executor.shutdown(wait=False, cancel_futures=True)
    call = lambda **how: jast.nominal(key, walk1d(), 20 * EPISODES, **how)
    part = call(checkpoint=tmp_path, executor=executor, callback=close)
    assert 0 < part.episodes < 20 * EPISODES
    assert "the executor takes no more work" in part.settings["interrupted"]
    with ThreadPoolExecutor(1) as another:
        same(call(checkpoint=tmp_path, executor=another), call())


def test_places_are_refused_inside_of_transformations(key, tmp_path):
    run = lambda key: monte_carlo(key, walk1d(), episodes=8, refine=0, checkpoint=tmp_path).steps
    with pytest.raises(ValueError, match="checkpoint must be None inside of jax.jit"):
        jax.jit(run)(key)


def test_a_fingerprint_tells_functions_and_numbers_apart():
    def made(gain):
        return lambda x: gain * x

    same = fingerprint(sim=walk1d(), f=made(2.0)), fingerprint(sim=walk1d(), f=made(2.0))
    assert describe_differences(*same) == ""
    assert "f.gain is 2.0 there, 3.0 here" == describe_differences(
        same[0], fingerprint(sim=walk1d(), f=made(3.0))
    )
    assert "code" in describe_differences(
        fingerprint(f=lambda x: x + 1), fingerprint(f=lambda x: x - 1)
    )
    assert "sim" in describe_differences(fingerprint(sim=walk1d()), fingerprint(sim=ferry()))


def test_a_fingerprint_tells_what_functions_are_given():
    class Plant:
        def __init__(self, gain):
            self.gain = gain
            self.calls = 0

        def step(self, x):
            self.calls += 1
            return self.gain * x

    class Other:
        def step(self, x):
            return x

    def made(gain):
        def step(x, gain=gain, *, offset=gain):
            return gain * x + offset

        return step

    def unlike(a, b):
        return describe_differences(fingerprint(f=a), fingerprint(f=b))

    assert "f.0 is 2.0 there, 3.0 here" in unlike(made(2.0), made(3.0))
    used = Plant(2.0)
    used.step(1.0)
    assert not unlike(Plant(2.0).step, used.step)
    assert unlike(Plant(2.0).step, Plant(3.0).step) == "f.gain is 2.0 there, 3.0 here"
    plants = [type("Plant", (), dict(step=step)) for step in (Plant.step, Other.step)]
    assert "f.step" in unlike(*plants)
    words = [f"def f(x): return x in {{{names}}}" for names in ("'a', 'b', 'c'", "'c', 'b', 'a'")]
    sets = [{}, {}]
    for text, names in zip(words, sets, strict=True):
        exec(text, names)
    assert not unlike(*(names["f"] for names in sets))


def test_a_black_box_of_another_system_is_another_call(key, tmp_path):
    def box(limit):
        run = lambda x: (bool(x.sum() > limit), float(max(limit - x.sum(), 0.0)))
        return jast.blackbox.from_python(
            run, horizon=3, disturbance=jast.distributions.Normal(0.0, 1.0)
        )

    jast.nominal(key, box(5.0), 20, checkpoint=tmp_path)
    with pytest.raises(ValueError, match="another call: .*system"):
        jast.nominal(key, box(2.0), 20, checkpoint=tmp_path)


def test_nothing_is_deleted_from_a_folder_of_other_files(key, tmp_path):
    (tmp_path / "film.part").write_text("mine")
    with pytest.raises(ValueError, match="holds other files"):
        jast.nominal(key, walk1d(), 20, checkpoint=tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["film.part"]


# --- long: processes, devices, many kills


@pytest.mark.long
@pytest.mark.parametrize("name", ["nominal", "forest"])
def test_four_devices_are_as_good_as_one(name, tmp_path, same):
    """And a checkpoint that was begun on four goes on where there is one."""
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=4"
    code = (
        "import sys; sys.path.insert(0, 'tests'); import jax, test_units as t;"
        "assert len(jax.devices()) == 4;"
        f"t.CALLS[{name!r}](jax.random.key(7), checkpoint={str(tmp_path)!r},"
        " devices=jax.devices())"
    )
    env = os.environ | dict(PYTHONPATH=str(ROOT), XLA_FLAGS=flags)
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], cwd=ROOT, env=env, check=True)
    key = jax.random.key(7)
    same(CALLS[name](key, checkpoint=tmp_path), CALLS[name](key))


def spawned():
    import multiprocessing

    context = multiprocessing.get_context("spawn")
    return concurrent.futures.ProcessPoolExecutor(2, mp_context=context)


def of_loky():
    return pytest.importorskip("loky").ProcessPoolExecutor(2)


def dask():
    distributed = pytest.importorskip("distributed")
    return distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ).get_client()


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # of other packages
@pytest.mark.parametrize("make", [spawned, of_loky, dask])
def test_processes_of_an_executor_are_as_good_as_this_one(make, key, same, tmp_path):
    with make() as made:
        executor = made.get_executor() if make is dask else made
        for call in CALLS.values():
            same(call(key, executor=executor), call(key))
        if make is dask:
            made.cluster.close()


# Python 3.11's pool raises in a thread of its own where futures of a broken pool are cancelled
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.long
def test_a_pool_that_breaks_leaves_what_is_done(key, tmp_path, same):
    """The system kills a process, as it does where memory is short."""
    call = lambda **how: jast.nominal(key, walk1d(), 100 * EPISODES, checkpoint=tmp_path, **how)
    with spawned() as executor:
        ended = call(executor=executor, callback=lambda *_: _kill_one(executor))
    assert ended.episodes < 100 * EPISODES
    assert "BrokenProcessPool" in ended.settings["interrupted"]
    same(call(), jast.nominal(key, walk1d(), 100 * EPISODES))


def _kill_one(executor):
    os.kill(next(iter(executor._processes)), signal.SIGKILL)


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["nominal", "forest", "heads", "failure_probability", "sac", "validate"]
)
def test_killed_calls_go_on_to_the_same_result(name, tmp_path, same, monkeypatch):
    """At random moments; each is a process of its own, which takes seconds to start."""
    monkeypatch.setattr(sys.modules[__name__], "EPISODES", 2_000_000)
    key, rng = jax.random.key(7), np.random.default_rng(0)
    whole, lasting = KILLED[name](key), 0
    for i, delay in enumerate(rng.uniform(0, 0.3, 4)):
        folder = tmp_path / str(i)
        folder.mkdir()
        lasting += killed(name, folder, delay) is not None
        same(KILLED[name](key, checkpoint=folder), whole)
    assert lasting > 0


@pytest.mark.slow
def test_the_settings_of_the_caller_stay_as_they_are(key):
    """Also when what the threads held is freed."""
    with jax.enable_x64(True):
        jast.nominal(key, jast.simulators.walk1d(), episodes=64)
        gc.collect()
        assert jax.config.jax_enable_x64
    assert not jax.config.jax_enable_x64
