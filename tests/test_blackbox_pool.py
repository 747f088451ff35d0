"""Black boxes in worker processes: what hangs, dies or raises there costs its own row only, and no
process outlives its simulator.
"""

import gc
import os
import resource
import signal
import subprocess
import sys
import threading
import time

import blackboxes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from jast import blackbox
from jast._src.blackbox.pool import Pool
from jast._src.blackbox.rows import Spec
from jast._src.blackbox.worker_process import Worker, pack
from jast._src.runtime.host_errors import hosts_of
from jast.distributions import Normal
from jast.incidents import incidents

pytest.importorskip("loky")
LIMIT = 0.3


def box(system, **settings):
    return blackbox.from_python(
        system,
        **(dict(horizon=2, disturbance=Normal(0.0, 1.0), workers=2, time_limit=LIMIT) | settings),
    )


def ends(sim, first):
    """Distances of episodes that begin with ``first`` [n], in one batch."""
    first = jnp.asarray(first, jnp.zeros(()).dtype)
    n = len(first)
    rows = jnp.stack([first, jnp.zeros(n)], axis=1)
    return np.asarray(
        jax.vmap(sim.evaluate)(
            blackbox.Record(jnp.ones(n, bool), jnp.full(n, 2, jnp.int32), (), rows)
        )[1]
    )


def processes(sim):
    """The numbers of the processes that run at the moment."""
    return [
        pid
        for w in sim.evaluate.func.host.runner.workers
        if w.executor is not None
        for pid in w.executor._processes
    ]


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as f:
            return f.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def gone(pids, seconds=10.0):
    end = time.monotonic() + seconds
    while any(map(alive, pids)) and time.monotonic() < end:
        time.sleep(0.05)
    return not any(map(alive, pids))


@pytest.mark.slow
def test_what_hangs_or_dies_costs_its_own_row_only():
    sim = box(blackboxes.troubled)
    first = np.r_[10.0:17.0, 1, 10.0:13.0, 2, 3, 10.0:20.0, 4, 5]
    started = time.monotonic()
    distance = ends(sim, first)
    np.testing.assert_array_equal(distance, np.where(first < 10, np.nan, first))
    assert time.monotonic() - started < 25
    found = {(i.kind, i.message): i for i in incidents(sim)}
    kinds = ["died", "raised", "timed out", "timed out", "wrong answer"]
    assert sorted(k for k, _ in found) == kinds and all(i.count == 1 for i in found.values())
    assert found["died", "the process ended: EXIT(3)"].disturbances.tolist() == [4, 0]
    assert found["timed out", "no answer within 0.3 s"].disturbances.tolist() == [2, 0]
    assert found[
        "timed out", "no answer within 0.3 s, and could not be interrupted"
    ].disturbances.tolist() == [3, 0]
    assert blackbox.calls(sim).rows == len(first)
    # it ends by itself where every row hangs, and works again after that
    started = time.monotonic()
    assert np.isnan(ends(sim, [3, 3])).all() and time.monotonic() - started < 20
    np.testing.assert_array_equal(ends(sim, [8, 9]), [8, 9])
    # with the simulator its processes go
    pids = processes(sim)
    assert pids and all(map(alive, pids))
    del sim
    jax.clear_caches()
    gc.collect()
    assert gone(pids)


@pytest.mark.parametrize("limit", [None, 1.0])
def test_what_a_worker_had_answered_before_it_died_is_kept(tmp_path, limit):
    """Each run is made once, whoever ends its process: the killer's, too."""
    log = tmp_path / "runs"

    def deadly(disturbances):
        with log.open("a") as file:
            file.write(f"{disturbances[0]:g}\n")
        return blackboxes.troubled(disturbances)

    sim, first = box(deadly, time_limit=limit), np.r_[10.0:17.0, 4, 1, 30.0:42.0, 4.25, 50.0:53.0]
    np.testing.assert_array_equal(ends(sim, first), np.where(first < 10, np.nan, first))
    assert sorted(map(float, log.read_text().split())) == sorted(first)
    assert blackbox.calls(sim).episodes == len(first)
    assert {(i.kind, i.count) for i in incidents(sim)} == {("died", 2), ("raised", 1)}


@pytest.mark.slow
def test_a_hang_costs_one_time_limit_whatever_else_its_worker_was_given():
    sim, first = box(blackboxes.troubled, workers=1), np.r_[10.0:70.0, 3, 10.0:70.0]
    started = time.monotonic()
    np.testing.assert_array_equal(ends(sim, first), np.where(first < 10, np.nan, first))
    # 121 limits are 36 s
    assert time.monotonic() - started < 20
    assert [(i.kind, i.count) for i in incidents(sim)] == [("timed out", 1)]


def slow_or_not(disturbances):
    """The number of its process; the first numbers say how long that takes."""
    blackboxes.time.sleep(0.2 * (disturbances[0] > 0))
    return blackboxes.process(disturbances)


def test_without_a_time_limit_nobody_is_late():
    sim = box(slow_or_not, time_limit=None)
    before = set(ends(sim, np.zeros(8)))
    pids = ends(sim, np.tile([0.0, 1.0], 8))
    assert np.isfinite(pids).all() and set(pids) <= before | set(processes(sim))
    assert set(processes(sim)) >= set(pids) and incidents(sim) == ()


class Built(blackboxes.Walk):
    """Takes three time limits and more to be made."""

    def __init__(self):
        time.sleep(1.6)


@pytest.mark.slow
def test_what_an_object_takes_to_be_made_is_no_run():
    sim = box(Built, horizon=2)
    keys = jax.random.split(jax.random.key(0), 4)
    many = jax.vmap(jast.rollout, (0, None))(keys, sim)
    assert np.isfinite(many.distance).all() and incidents(sim) == ()


def test_workers_have_neither_jax_nor_this_package_and_share_the_rows():
    sim = box(blackboxes.modules, workers=1)
    np.testing.assert_array_equal(ends(sim, np.zeros(3)), 0)
    # a function of this file, by value
    sim, scale = box(lambda x: (blackboxes.time.sleep(0.02), blackboxes.process(x))[1]), 1.0
    pids = ends(sim, np.arange(16.0))
    assert len(set(pids)) == 2 and os.getpid() not in pids
    assert scale and incidents(sim) == ()


class Windy(blackboxes.Leaves):
    def transition(self, x):
        super().transition(x + vars(self).get("wind", 0.0))
        self.wind = 0.1 * float(x)

    def miss_distance(self):
        return 4.0 - abs(self.s)


class Hangs(blackboxes.Leaves):
    def is_event(self):
        if self.s != 0:
            time.sleep(60)
        return False


@pytest.mark.slow
def test_check_looks_on_the_way_in_a_worker():
    settings = dict(horizon=8, episodic=True, workers=1)
    said = []
    for each in (settings, settings | dict(workers=0, time_limit=None)):
        with pytest.warns(
            UserWarning, match="is True during the episode and False at its end"
        ) as warned:
            jast.check(box(blackboxes.Leaves, **each))
        said.append([str(w.message) for w in warned])
    assert said[0] == said[1]
    carries = box(Windy, **settings)
    with pytest.raises(ValueError, match="initialize: does not reset everything: at step 8"):
        jast.check(carries)
    # what gives no answer is not compared
    host = next(hosts_of(box(Hangs, **settings)))
    assert host.lost([], [np.ones((2, 8))]) == 0


@pytest.mark.long
def test_a_search_with_workers_is_that_without(key, equal):
    sims = [
        box(blackboxes.Walk, episodic=False, horizon=8, workers=n, time_limit=None) for n in (0, 2)
    ]
    found = [jast.search.monte_carlo(key, sim, episodes=64, top=2) for sim in sims]
    equal(found[0].best, found[1].best)
    assert found[0].best.failure and found[0].failing_share == found[1].failing_share
    ours, theirs = (blackbox.calls(sim) for sim in sims)
    # rows stay with their workers, and so do the objects: few histories are repeated
    assert ours.rows == theirs.rows
    assert ours.episodes <= theirs.episodes <= ours.episodes + 10
    assert theirs.transitions <= ours.transitions + 60
    assert incidents(sims[1]) == ()


def test_threads_may_ask_at_once():
    sim = box(lambda x: (False, float(x[0])))
    answers = {}
    threads = [
        threading.Thread(
            target=lambda i=i: answers.update({i: ends(sim, np.arange(10.0 * i, 10.0 * i + 8))})
        )
        for i in range(4)
    ]
    [t.start() for t in threads], [t.join() for t in threads]
    for i in range(4):
        np.testing.assert_array_equal(answers[i], np.arange(10.0 * i, 10.0 * i + 8))
    assert blackbox.calls(sim)[:3] == (4, 32, 32)


def test_a_program_is_ended_with_its_children():
    mark = f"{time.time():.6f}"
    sim = box(blackbox.program(["sh", "-c", f"sleep 60.{mark[-6:]} & wait"]), workers=1)
    assert np.isnan(ends(sim, [0.0]))
    (only,) = incidents(sim)
    assert only.kind == "timed out"
    assert gone(having(f"60.{mark[-6:]}"))


RUNS = """
import sys, jax, jast
run = jast.blackbox.program(["sh", "-c", f"sleep {sys.argv[1]} & wait"])
normal = jast.distributions.Normal(0.0, 1.0)
sim = jast.blackbox.from_python(run, horizon=1, disturbance=normal, workers=1)
jast.rollout(jax.random.key(0), sim)
"""


@pytest.mark.slow
def test_a_program_is_ended_where_the_process_that_asks_is_killed():
    mark = f"{time.time():.6f}"
    command = f"61.{mark[-6:]}"
    with subprocess.Popen([sys.executable, "-c", RUNS, command]) as asks:
        deadline = time.monotonic() + 60
        while not (pids := having(f"sleep\0{command}")) and time.monotonic() < deadline:
            time.sleep(0.1)
        asks.kill()
    assert pids and gone(pids)


def having(text):
    """The processes with ``text`` in their command."""
    pids = filter(str.isdigit, os.listdir("/proc"))
    return [pid for pid in pids if text.encode() in _command(pid)]


def _command(pid):
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as f:
            return f.read()
    except OSError:
        return b""


def far(disturbances):
    away = abs(float(disturbances.sum()))
    return away > 2.0, max(2.0 - away, 0.0)


def test_a_worker_that_dies_while_it_has_nothing_to_do_is_replaced():
    sim = box(far)
    before = ends(sim, [0.0, 1.0, 0.5, 0.25])
    for pid in processes(sim):
        os.kill(pid, 9)
    assert gone(processes(sim))
    time.sleep(0.5)  # until loky knows
    assert ends(sim, [1.5, 0.75]).tolist() == [0.5, 1.25]
    assert before.tolist() == [2.0, 1.0, 1.5, 1.75] and not incidents(sim)


class Fragile(blackboxes.Walk):
    """Raises at 5, and where it is made anew after that."""

    made = 0

    def __init__(self):
        Fragile.made += 1
        if Fragile.made > 1:
            raise RuntimeError("no second object")

    def transition(self, x):
        self.x = float(x)
        if self.x == 5:
            raise RuntimeError("five")
        if self.x == 9:
            os._exit(1)

    def is_event(self):
        return False

    def miss_distance(self):
        return self.x


class OnSmallDisk(Fragile):
    """Its worker's file of finished rows has room for few."""

    def __init__(self):
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))


def asked(pool, first):
    """Distances of episodes of one disturbance, and what went wrong."""
    rows = np.asarray(first, float)[:, None]
    reply = pool(np.ones(len(rows), int), [], [rows], np.arange(len(rows)))
    return reply.distance, [(i, kind) for i, kind, _ in reply.problems]


def alone(system, limit=None):
    spec = Spec(run=False, episodic=True, horizon=1, x0=(), random=False, limit=limit)
    return Pool(pack(system, spec), 1, spec, 0, 0)


def test_what_a_worker_said_before_is_no_answer():
    one = alone(Fragile, 1.0)
    first, problems = asked(one, [1, 2, 5, 6])  # the last one as no object can be made
    np.testing.assert_array_equal(first, [1, 2, np.nan, np.nan])
    assert problems == [(2, "raised"), (3, "raised")]
    (pid,) = one.workers[0].executor._processes
    os.kill(pid, signal.SIGSTOP)
    ends = threading.Timer(0.5, os.kill, (pid, signal.SIGKILL))  # before it begins the next
    ends.start()
    second, problems = asked(one, [10, 20, 30, 40, 50])
    assert second.tolist() == [10, 20, 30, 40, 50] and not problems
    one.workers[0].kill()


def test_a_full_disk_costs_answers_of_a_worker_that_ends_and_no_more():
    one = alone(OnSmallDisk)
    said, problems = asked(one, [*range(10, 50), 9, 7])
    np.testing.assert_array_equal(said, [*range(10, 50), np.nan, 7])
    assert problems == [(40, "died")]
    one.workers[0].kill()


class Broken(blackboxes.Walk):
    def initialize(self):
        os._exit(1)


@pytest.mark.slow
def test_bad_input_is_named(monkeypatch):
    lock = threading.Lock()
    with pytest.raises(ValueError, match="system cannot be sent to a worker process: .*lock"):
        box(lambda x: (lock.locked(), 1.0))
    with pytest.raises(ValueError, match="from_python: system: the process ended"):
        box(Broken, episodic=False)
    with pytest.raises(ValueError, match="lacks is_event"):
        box(lambda: type("Mute", (blackboxes.Walk,), {"is_event": None})())
    monkeypatch.setitem(sys.modules, "loky", None)
    with pytest.raises(ImportError, match=r"pip install 'jast\[blackbox\]'"):
        Pool(b"", 1, None)._start([Worker(b"")])


def test_a_system_that_no_worker_can_load_ends_the_search(tmp_path, monkeypatch):
    (tmp_path / "only_here.py").write_text("def run(x):\n    return False, 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    import only_here

    sim = box(only_here.run, workers=1)
    (tmp_path / "only_here.py").write_text("raise OSError('no licence')\n")
    with pytest.raises(RuntimeError, match="could not load the system: OSError: no licence"):
        ends(sim, [0.0])
    with pytest.raises(ValueError, match="^check: .* could not load the system: OSError: no lic"):
        jast.check(sim)  # in the first line
