"""No run of a black box too many: what each public call runs, counted inside of the system."""

import os
import signal
import subprocess
import sys
import time

import blackboxes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from jast import blackbox
from jast._src.estimate.budgets import measure_budget
from jast._src.runtime.host_errors import hosts_of, in_full_batches
from jast.distributions import Normal
from jast.incidents import incidents

TWICE = 2  # runs that are made twice in the life of a simulator: a failure, and another one
CALIBRATION = 60  # episodes that scale reward and actions of a search, as its docstring says


class Counted(blackboxes.Leaves):
    """Counts its starts: they are its runs."""

    runs = 0

    def initialize(self):
        super().initialize()
        Counted.runs += 1


def counted(disturbances):
    Counted.runs += 1
    away = abs(float(np.sum(disturbances, dtype=np.float64)))
    return away >= 4.0, max(4.0 - away, 0.0)


SYSTEMS = {"function": counted, "steps": Counted}


def box(kind="function", horizon=6, **settings):
    sim = blackbox.from_python(
        SYSTEMS[kind], horizon=horizon, disturbance=Normal(0.0, 1.0), **settings
    )
    Counted.runs = 0  # without the first object, which shows how many numbers it observes
    return sim


def failure(sim, horizon=6):
    """A failing episode, for which something has run."""
    episode = jast.replay(sim, jnp.full(horizon, 1.2))
    assert episode.failure
    Counted.runs = 0
    return episode


@pytest.mark.parametrize("kind", SYSTEMS)
def test_nothing_is_run_twice(kind):
    sim = box(kind)
    x = jnp.full(6, 0.1)
    first = jast.replay(sim, x)
    assert Counted.runs == 1
    # the first that is asked for again is run again, to see that the answer is the same
    jast.replay(sim, x)
    before = Counted.runs
    assert before <= 1 + TWICE
    again = jast.replay(sim, x)
    assert Counted.runs == before and again.distance == first.distance
    assert blackbox.calls(sim).known > 0
    # equal rows of a batch are one run
    jax.vmap(lambda x: jast.replay(sim, x).distance)(jnp.full((5, 6), 0.2))
    assert Counted.runs == before + 1


def test_a_system_that_answers_otherwise_is_no_longer_remembered(key):
    """It is said after two runs that differ, and from then on every run is made."""
    draws = iter(range(100))
    sim = blackbox.from_python(
        lambda x: (False, float(next(draws))), horizon=2, disturbance=Normal(0.0, 1.0)
    )
    found = [float(jast.replay(sim, jnp.ones(2)).distance) for _ in range(4)]
    assert found == [0, 1, 2, 3]
    (only,) = incidents(sim)
    assert only.kind == "not deterministic" and only.message.endswith("gave two distances")
    assert only.disturbances.tolist() == [1, 1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", SYSTEMS)
def test_nominal_runs_what_it_was_asked(key, kind):
    """And the undisturbed episode, which is the one that is made twice."""
    sim = box(kind)
    jast.nominal(key, sim, episodes=30)
    assert 30 < Counted.runs <= 30 + TWICE


@pytest.mark.parametrize("kind", SYSTEMS)
def test_plain_draws_are_counted(key, kind):
    sim = box(kind)
    found = jast.estimate.monte_carlo(key, sim, 100)
    assert found.episodes == 100 and Counted.runs <= 100


def test_falsify_runs_what_it_was_asked(key):
    sim = box()
    found = jast.search.falsify(key, sim, simulations=100, stop=False)
    assert found.episodes == 100 and found.settings["batch"] == 10
    assert Counted.runs <= 100 + TWICE


def test_batches_fill_the_workers():
    """Which are started on first use: here none is."""
    assert [in_full_batches(box(workers=n), 10) for n in (1, 3, 16)] == [10, 12, 16]
    assert in_full_batches(box(), 10) == in_full_batches(jast.simulators.walk1d(), 10) == 10


def test_what_prints_and_writes_into_its_arrays_is_run_all_the_same(key, capsys):
    def careless(disturbances):
        print("a line")
        answer = counted(disturbances)
        disturbances[:] = np.nan
        return answer

    sim = blackbox.from_python(careless, horizon=6, disturbance=Normal(0.0, 1.0))
    ours, theirs = (jast.estimate.monte_carlo(key, s, 50) for s in (sim, box()))
    assert ours.failing == theirs.failing > 0 and incidents(sim) == ()
    assert capsys.readouterr().out.count("a line") == 50


SEARCHES = {
    "monte_carlo": lambda key, sim: jast.search.monte_carlo(key, sim, episodes=300),
    "chain": lambda key, sim: jast.search.chain(key, sim, episodes=300),
    "cem": lambda key, sim: jast.search.cem(key, sim, samples=100, elites=10, iterations=3),
    "go_explore": lambda key, sim: jast.search.go_explore(key, sim, episodes=300),
    "forest": lambda key, sim: jast.search.forest(key, sim, trees=2, prunes=3, simulations=50),
    "mcts": lambda key, sim: jast.search.mcts(key, sim, simulations=300),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", SYSTEMS)
@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_runs_its_episodes_and_those_that_scale_it(key, name, kind):
    sim = box(kind)
    found = SEARCHES[name](key, sim)
    # what a search draws again, by another program, may differ in the last digit: the failures
    # that it archives
    assert Counted.runs <= 300 + CALIBRATION + TWICE + len(found.failures) // 4


@pytest.mark.long
@pytest.mark.parametrize("kind", SYSTEMS)
@pytest.mark.parametrize("budget", [300, 1000])
def test_stress_runs_its_budget_with_all_that_it_does(key, kind, budget):
    sim = box(kind)
    report = jast.stress(key, sim, budget)
    # the parts of the work state what they need, never less than they run
    assert 0.9 * budget < Counted.runs <= report.episodes <= budget
    assert report.episodes == sum(report.spent.values())
    assert "falsify" in report.spent and report.failures.best.failure
    assert report.probability is not None


@pytest.mark.long
def test_an_estimate_runs_its_budget(key):
    for budget in (300, 1000):
        sim = box()
        jast.estimate.failure_probability(key, sim, budget)
        assert Counted.runs <= budget


@pytest.mark.long
@pytest.mark.parametrize("kind", SYSTEMS)
def test_a_refinement_runs_its_budget(key, kind):
    sim = box(kind)
    episode = failure(sim)
    given = jax.tree.map(lambda a: np.asarray(a)[None], episode._replace(states=None))
    found = jast.search.refine(key, sim, given, budget=500)
    assert Counted.runs <= 500 and len(found.failures) == 1
    assert found.failures.best.reward >= episode.reward


def test_minimal_runs_its_budget():
    sim = box()
    episode = failure(sim)
    found = jast.explain.minimal(sim, episode, budget=60)
    assert Counted.runs <= 60 and found.episode.failure and not found.complete
    assert "budget was used up" in str(found)
    with pytest.raises(ValueError, match="minimal: budget must be"):
        jast.explain.minimal(sim, episode, budget=3)


@pytest.mark.long
def test_minimal_says_that_it_is_complete():
    sim = box()
    episode = failure(sim)
    found = jast.explain.minimal(sim, episode, orders=2, budget=5000)
    assert found.complete and Counted.runs <= found.evaluations + 5


@pytest.mark.parametrize("kind", SYSTEMS)
def test_criticality_runs_its_budget(key, kind):
    """Continuations that end early are not played on."""
    sim = box(kind)
    episode = failure(sim)
    states = int(episode.length) + 1
    found = jast.explain.criticality(key, sim, episode, budget=100)
    assert Counted.runs <= 100 and found.draws == (100 - 3) // states
    assert found.probability[-1] == 1
    said = f"budget must be at least {states + 3}, 1 continuations of {states} states"
    with pytest.raises(ValueError, match=said):
        jast.explain.criticality(key, sim, episode, budget=5)
    with pytest.raises(ValueError, match=f"50 continuations of {states} states"):
        jast.explain.criticality(key, sim, episode, budget=100, draws=50)


@pytest.mark.long
def test_what_learns_from_failures_runs_its_budget(key):
    pytest.importorskip("sklearn")
    sim = box()
    given = jast.search.monte_carlo(key, sim, episodes=300, refine=0)
    Counted.runs = 0
    told = jast.explain.rules(sim, given, budget=1000)
    assert Counted.runs <= 1000 and told.evaluations <= 1000
    with pytest.raises(ValueError, match="rules: budget must be at least"):
        jast.explain.rules(sim, given, budget=100)
    Counted.runs = 0
    jast.explain.monitor(sim, given, model="logistic", budget=2000)
    assert Counted.runs <= 2000


def test_attribution_runs_its_budget():
    sim = box()
    episode = failure(sim)
    found = jast.explain.attribution(sim, episode, budget=50)
    assert Counted.runs <= 50 and found.evaluations <= 50
    with pytest.raises(ValueError, match="attribution: budget must be at least"):
        jast.explain.attribution(sim, episode, budget=10)


@pytest.mark.long
def test_a_failing_run_is_never_lost(key):
    """Whoever makes it: all failing runs of a call are among the failures of its report."""
    sim = box()
    report = jast.stress(key, sim, 300, top=1000)
    host = sim.evaluate.func.host
    kept = {e.disturbances.tobytes() for e in report.failures}
    runs = host.failing()
    assert len(runs) > 10 and {run.xs[0].tobytes() for run in runs} <= kept


@pytest.mark.long
def test_a_report_says_what_went_wrong(key):
    def broken(x):
        if x[0] > 1.5:
            raise RuntimeError("no solution")
        return counted(x)

    Counted.runs = 0
    sim = blackbox.from_python(broken, horizon=6, disturbance=Normal(0.0, 1.0))
    report = jast.stress(key, sim, 300)
    (only,) = incidents(sim)
    assert only.disturbances[0] > 1.5 and only.count > 1
    assert f"went wrong   {only.count} x raised RuntimeError: no solution" in str(report)
    assert Counted.runs <= 300


def refuses_early(disturbances):
    """The first runs end at once; the others take a twentieth of a second."""
    if disturbances[0] < 0.5:
        raise ValueError("not here")
    time.sleep(0.05)
    return False, float(disturbances[0])


class Slow(blackboxes.Leaves):
    """Begins at once, and each step takes a twentieth of a second."""

    def transition(self, x):
        time.sleep(0.05)
        super().transition(x)


@pytest.mark.parametrize("system", [refuses_early, Slow])
def test_a_checkpoint_has_the_runs_a_few_at_a_time(system):
    sim = blackbox.from_python(system, horizon=2, disturbance=Normal(0.0, 1.0))
    (host,), stored = hosts_of(sim), []
    host.store = lambda part: stored.append(len(part[0]))
    x = jnp.stack([jnp.linspace(0.4, 0.9, 20), jnp.zeros(20)], axis=1)
    jax.vmap(lambda x: jast.replay(sim, x).distance)(x).block_until_ready()
    assert sum(stored) >= 15 and max(stored) <= 4


KILLED = """
import sys, time
sys.path.insert(0, {tests!r})
import jax, jast
from jast.distributions import Normal

def system(x):
    with open({log!r}, "a") as file:
        file.write(x.tobytes().hex() + "\\n")
    time.sleep(0.02)
    s = float(abs(x.sum()))
    return s >= 4.0, max(4.0 - s, 0.0)

sim = jast.blackbox.from_python(system, horizon=6, disturbance=Normal(0.0, 1.0))
found = jast.{call}(jax.random.key(1), sim, {settings}, checkpoint={folder!r})
print({said})
"""
CHECKED = 9  # runs of `jast.check`
CALLS = {
    "search.falsify": ("simulations=150, batch=5, stop=False", "found.episodes, found.failing"),
    "search.monte_carlo": ("episodes=150", "found.episodes, found.failing"),
    "estimate.failure_probability": ("budget=150", "found.evaluations, found.mean"),
    "stress": ("budget=300", "found.episodes, found.probability.mean"),
}


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_a_killed_call_goes_on_without_running_anything_twice(tmp_path, call):
    """A call that is killed amid its runs, and made again, says what one says that was not. Made
    again are a tenth of a second's runs, those by which a call begins, and two of each process that
    tell whether the answers are the same.
    """

    def command(name):
        log, folder, tests = tmp_path / f"{name}.log", tmp_path / name, os.path.dirname(__file__)
        settings, said = CALLS[call]
        about = dict(call=call, settings=settings, said=said, tests=tests)
        code = KILLED.format(log=str(log), folder=str(folder), **about)
        lines = lambda: log.read_text().split() if log.exists() else []
        return [sys.executable, "-c", code], lines

    (killed, lines), (whole, _) = command("killed"), command("whole")
    first = subprocess.Popen(killed)
    while len(lines()) < 60 and first.poll() is None:
        time.sleep(0.02)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert 60 <= len(lines()) < 150
    again, once = (
        subprocess.run(c, capture_output=True, text=True, check=True).stdout
        for c in (killed, whole)
    )
    assert again == once
    runs = lines()
    assert len(runs) - len(set(runs)) <= 5 + CHECKED + 2 * TWICE


def test_seconds_of_a_cheap_black_box_are_not_those_of_compilation(key):
    """At 4 microseconds a run five seconds gave the least budget; jast's own work takes 1 ms."""
    assert 2000 < measure_budget("stress", key, box(), 5.0, 300) <= 5000


@pytest.mark.parametrize("seed", range(3))
def test_the_likeliest_failure_is_that_of_a_mode(seed):
    """Whoever ran it: the estimate's runs may be likelier than what refinement came to."""
    report = jast.stress(jax.random.key(seed), box(), 300)
    assert report.failures.best.reward == report.modes[0].failure.reward


@pytest.mark.parametrize("name", ["stress", "failure_probability"])
def test_ctrl_c_in_a_run_keeps_what_was_found(key, name):
    """It comes out of a compiled program as an error of JAX."""
    made = []

    def run(disturbances):
        made.append(0)
        if len(made) == 250:
            raise KeyboardInterrupt  # as its signal does, in whichever thread runs the system
        return counted(disturbances)

    sim = blackbox.from_python(run, horizon=6, disturbance=Normal(0.0, 1.0))
    if name == "stress":
        assert "interrupted" in jast.stress(key, sim, 400).settings
    else:
        found = jast.estimate.failure_probability(key, sim, budget=300)
        assert any("interrupted" in text for text in found.warnings)


def test_an_error_that_cannot_say_what_it_is(key):
    class Silent(Exception):
        def __str__(self):
            raise RuntimeError("no words")

    def run(disturbances):
        raise Silent

    sim = blackbox.from_python(run, horizon=2, disturbance=Normal(0.0, 1.0))
    jast.rollout(key, sim)
    assert incidents(sim)[0].message.startswith("raised Silent")
