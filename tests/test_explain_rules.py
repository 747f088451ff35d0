"""jast.explain.rules and monitor: planted causes in the words of the user's fields, on episodes
that they have not seen.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import above

import jast
from benchmarks.explain_systems import planted
from benchmarks.stress_systems import slips
from jast import explain
from jast._src.explain.held_out import hold_out
from jast.distributions import Joint, Normal, Uniform
from jast.search import Mode, Modes

pytest.importorskip("sklearn", reason="rules and monitors learn with scikit-learn")

STEPS = 8


def late_gust(at=4, **changes):
    """Fails at step ``at`` + 1, where the gust is above 2 and the delay above 1."""

    def step(s, x):
        t, _ = s
        short = jnp.maximum(2.0 - x["gust"], 1.0 - x["delay"])
        return t + 1, jnp.where(t == at, jnp.maximum(short, 0.0), 3.0)

    given = dict(
        init=lambda x0: (jnp.zeros((), jnp.int32), jnp.full((), 3.0)),
        step=step,
        disturbance=lambda s: Joint(dict(delay=Normal(0.0, 1.0), gust=Normal(0.0, 1.0))),
        evaluate=lambda s: (s[1] <= 0, s[1]),
        horizon=STEPS,
    )
    return jast.Simulator(**given | changes)


def drawn(seed, n, sim, **decisive):
    """Episodes of the model, in which some disturbances at step 5 are fixed."""
    rng = np.random.default_rng(seed)
    x = {name: rng.standard_normal((n, STEPS)).astype(np.float32) for name in ("delay", "gust")}
    for name, value in decisive.items():
        x[name][:, 4] = value + 0.3 * rng.exponential(size=n)
    return jax.vmap(lambda x: jast.replay(sim, x))(jax.tree.map(jnp.asarray, x))


SIM = late_gust()


@pytest.fixture(scope="module")
def found():
    return explain.rules(SIM, drawn(0, 12, SIM, gust=2.0, delay=1.0), episodes=400)


@pytest.mark.slow
def test_the_planted_rule_in_the_words_of_the_user(found):
    (rule,) = found.rules
    bounds = {what: (low, high) for what, _, low, high in rule.conditions}
    assert set(bounds) == {"gust at step 5", "delay at step 5"}
    assert bounds["gust at step 5"][0] == pytest.approx(2, abs=0.2)
    assert bounds["delay at step 5"][0] == pytest.approx(1, abs=0.2)
    text = str(found)
    assert "gust at step 5 > " in text
    assert "-> fails" in text
    assert "recall" in text
    low, high = rule.precision_interval
    assert low <= rule.precision == found.precision["fails"] <= high
    assert found.evaluations > 10 * 400 and found.settings["method"] == "rules"


@pytest.mark.slow
def test_a_rule_is_right_about_fresh_episodes(found):
    bad, calm = drawn(1, 400, SIM, gust=2.0, delay=1.0), drawn(2, 400, SIM)
    said = found.predict(bad)
    assert bad.failure.all() and np.mean(said == "fails") > 0.95
    missed = found.predict(calm)[~np.asarray(calm.failure)] == "fails"
    assert missed.mean() < 0.02
    # near misses: one of the two alone does nothing
    assert np.mean(found.predict(drawn(3, 200, SIM, gust=2.5)) == "fails") < 0.25
    assert found.predict(jax.tree.map(lambda a: a[0], bad)).shape == (1,)


TWO = late_gust(
    step=lambda s, x: (
        s[0] + 1,
        jnp.where(
            s[0] == 4,
            jnp.maximum(jnp.minimum(3.2 - x["gust"], 3.0 - x["delay"]), 0.0),
            3.0,
        ),
    )
)
"""Fails at step 5 where the gust is above 3.2, or the delay above 3."""


def test_rules_tell_kinds_of_failures_apart():
    a, b = drawn(0, 8, TWO, gust=3.2), drawn(1, 8, TWO, delay=3.0)
    both = jax.tree.map(lambda u, v: jnp.concatenate([u, v]), a, b)
    labels = ["wind"] * 8 + ["lag"] * 8
    r = explain.rules(TWO, both, labels=labels, episodes=400)
    assert r.classes == ("does not fail", "lag", "wind")
    names = {rule.label: {what for what, *_ in rule.conditions} for rule in r.rules}
    assert "gust at step 5" in names["wind"] and "delay at step 5" in names["lag"]
    assert min(r.recall.values()) > 0.9 and min(r.precision.values()) > 0.9


def test_rules_of_modes_and_of_an_archive(key):
    """Each mode has rules of its own; an archive is as good as a batch."""
    e = [drawn(i, 1, TWO, **{name: 3.2}) for i, name in enumerate(("gust", "delay"))]
    one = [jax.tree.map(lambda a: a[0], each) for each in e]
    r = explain.rules(TWO, Modes(Mode(failure, 1, 0.5) for failure in one), episodes=200)
    assert r.classes == ("does not fail", "mode 1", "mode 2")
    assert {rule.label for rule in r.rules} == {"mode 1", "mode 2"}
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *e)
    archive = jast.failures.collect(TWO, jast.rewards.standard(), both)
    a, b = (explain.rules(TWO, given, episodes=100) for given in (archive, archive.episodes))
    assert str(a) == str(b)


def test_rules_of_many_modes_tell_failures_from_others(key):
    """Failures are balls around six points. Near misses count as much as all kinds of failures, not
    as much as each: then there was a rule for each mode, and nothing was said not to fail.
    """
    centre = 4.0 * np.concatenate([np.eye(3, 4), -np.eye(3, 4)]).astype(np.float32)
    sim = jast.simulators.limit_state(
        lambda z: jnp.sqrt(jnp.min(jnp.sum((z[None] - centre) ** 2, axis=1)) + 1e-9) - 1.5, 4
    )
    rng = np.random.default_rng(0)
    near = np.repeat(centre, 12, axis=0) + 0.3 * rng.standard_normal((72, 4)).astype(np.float32)
    x = jax.vmap(lambda x: jast.replay(sim, x))(jnp.asarray(near)[:, None])
    r = explain.rules(sim, x, labels=np.repeat(list("abcdef"), 12), most=6)
    assert r.recall["does not fail"] > 0.5 and r.precision["does not fail"] > 0.5
    assert "nan" not in str(r)


def test_few_failures_are_no_reason_to_judge_by_what_was_never_seen():
    """Failures go two ways, three of them each way: where one way was held out as a whole, rules of
    the other knew nothing of it.
    """
    short = lambda x: jnp.maximum(2.5 - jnp.abs(x["gust"]), 0)
    sim = late_gust(step=lambda s, x: (s[0] + 1, jnp.where(s[0] == 4, short(x), 3.0)))
    e = [drawn(0, 3, sim, gust=2.5), drawn(1, 3, sim, gust=-3.5)]
    bad = jax.tree.map(lambda *a: jnp.concatenate(a), *e)
    for seed in range(4):
        r = explain.rules(sim, bad, episodes=100, key=jax.random.key(seed))
        assert r.recall["fails"] > 0.8 and "nan" not in str(r)


def test_what_is_not_known_of_a_rule_is_said_in_words():
    r = explain.rules(SIM, drawn(0, 12, SIM, gust=2.0, delay=1.0), episodes=40)
    rule = r.rules[0]._replace(precision=float("nan"))
    text = str(r._replace(rules=(rule,), precision=r.precision | {"fails": float("nan")}))
    assert text.count("precision unknown") == 2 and "nan" not in text


@pytest.mark.long
def test_rules_and_a_monitor_of_an_estimate(key):
    """Failures of its proposal, with their weights."""
    p = planted("one step of 50", 5)
    estimate = jast.estimate.failure_probability(key, p.sim, 10_000)
    r = explain.rules(p.sim, estimate, key=key)
    assert p.named(0) == {what for what, *_ in r.rules[0].conditions}
    bad = p.episodes(p.failing(np.random.default_rng(0), 0, 500))
    assert np.mean(r.predict(bad) == "fails") > 0.95
    sim = jast.simulators.pendulum()
    m = explain.monitor(sim, jast.estimate.failure_probability(key, sim, 10_000), within=3)
    assert m.auc > 0.9


def test_what_is_held_out_was_not_learned_from():
    """Episodes that differ in nothing but their flag: a tree tells those apart that it has seen,
    and no others.
    """
    noise = drawn(0, 240, SIM)
    flag = jnp.arange(240) % 2 == 0
    part = lambda keep, fails: jax.tree.map(lambda a: a[keep], noise)._replace(
        failure=jnp.full(120, fails)
    )
    bad, calm = part(flag, True), part(~flag, False)
    r = explain.rules(SIM, bad, calm)
    assert r.held_out == {"does not fail": 36, "fails": 36}
    assert r.recall["fails"] + r.recall["does not fail"] < 1.35
    every = np.concatenate([r.predict(bad) == "fails", r.predict(calm) == "does not fail"])
    assert np.mean(every) > 0.5
    # the same episode many times is one
    few = jax.tree.map(lambda a: jnp.concatenate([a[:10]] * 12), bad)
    assert explain.rules(SIM, few, calm).held_out["fails"] == 3


def test_groups_are_held_out_as_a_whole():
    """Also where a group has episodes of several classes."""
    rng = np.random.default_rng(0)
    owner, group = rng.integers(0, 3, 300), rng.integers(0, 20, 300)
    out = hold_out(rng, owner, group, 0.3)
    assert not set(group[out]) & set(group[~out])
    assert all(0.1 < out[owner == k].mean() < 0.5 for k in range(3))
    # one great group among small ones stays where it is learned from
    group[:200] = 7
    assert 0 < hold_out(rng, owner, group, 0.3).mean() < 0.35


@pytest.mark.slow
def test_an_early_end_tells_nothing():
    """The system fails at the first great gust and ends there; others go on. Neither the length nor
    what is behind the end may serve as a rule.
    """
    sim = late_gust(
        step=lambda s, x: (s[0] + 1, jnp.maximum(2.5 - x["gust"], 0.0)),
    )
    e = jax.vmap(lambda k: jast.rollout(k, sim))(jax.random.split(jax.random.key(3), 3000))
    bad = jax.tree.map(lambda a: a[e.failure], e)
    assert len(set(np.asarray(bad.length).tolist())) == STEPS
    calm = jax.tree.map(lambda a: a[~e.failure][:200], e)
    for r in (explain.rules(sim, bad, calm), explain.rules(sim, bad, episodes=200)):
        (rule,) = r.rules
        ((what, _, low, high),) = rule.conditions
        assert what == "greatest gust"
        assert low == pytest.approx(2.5, abs=0.1)
        assert high == np.inf
        assert r.precision["fails"] > 0.95 and r.recall["fails"] > 0.95


@pytest.mark.slow
def test_rules_of_choices():
    """Three slips in a row."""
    sim = slips()
    e = jax.vmap(lambda k: jast.rollout(k, sim))(jax.random.split(jax.random.key(0), 20_000))
    bad = jax.tree.map(lambda a: a[e.failure], e)
    r = explain.rules(sim, bad, episodes=300)
    assert r.rules
    assert "x = 1" in str(r)
    assert r.recall["fails"] > 0.8


@pytest.mark.slow
def test_a_start_and_states_have_their_names():
    sim = late_gust(
        start=lambda: Joint(dict(load=Uniform(0.0, 1.0))),
        init=lambda x0: (jnp.zeros((), jnp.int32), 2.0 - x0["load"]),
        step=lambda s, x: (s[0] + 1, s[1] - 0.1 * jnp.maximum(x["gust"], 0.0)),
        evaluate=lambda s: (s[1] <= 0.9, jnp.maximum(s[1] - 0.9, 0.0)),
    )
    e = jax.vmap(lambda k: jast.rollout(k, sim))(jax.random.split(jax.random.key(0), 2000))
    bad, calm = (jax.tree.map(lambda a, k=k: a[k], e) for k in (e.failure, ~e.failure))
    assert "load at the start > " in str(explain.rules(sim, bad, calm))
    r = explain.rules(sim, bad, calm, of="states", lead=1)
    assert "1 step before the end" in str(r)
    assert r.predict(bad).shape == bad.length.shape


@pytest.mark.slow
def test_one_failure_and_float64(x64):
    """Variants of a single failure are enough."""
    sim = late_gust()
    one = jax.tree.map(lambda a: a[0], drawn(0, 1, sim, gust=2.0, delay=1.0))
    r = explain.rules(sim, one, 200, episodes=200)
    assert "gust" in str(r)
    assert "delay" in str(r)
    assert r.recall["fails"] > 0.9
    assert sum(r.held_out.values()) < 0.35 * 400


def test_a_black_box_is_called_as_often_as_is_said():
    calls = []

    def run(x):
        calls.append(1)
        near = 1.5 - float(x[1])
        return near <= 0, max(near, 0.0)

    sim = jast.blackbox.from_python(run, horizon=3, disturbance=Normal(0.0, 1.0))
    bad = [jast.replay(sim, jnp.array([a, 1.6, -a])) for a in (0.1, -0.5, 0.9, 0.3)]
    calls.clear()
    r = explain.rules(sim, bad, episodes=40)
    assert "x at step 2 > " in str(r) and len(calls) <= r.evaluations + 10


@pytest.mark.slow
def test_bad_rules():
    bad, calm = drawn(0, 6, SIM, gust=2.0, delay=1.0), drawn(1, 20, SIM)
    with pytest.raises(ValueError, match="rules: failures must all fail"):
        explain.rules(SIM, calm)
    with pytest.raises(ValueError, match="rules: others must not fail"):
        explain.rules(SIM, bad, bad)
    with pytest.raises(ValueError, match="rules: failures must be episodes .* received str"):
        explain.rules(SIM, "failures")
    with pytest.raises(ValueError, match="rules: failures must hold"):
        explain.rules(SIM, [])
    with pytest.raises(ValueError, match="rules: failures must be episodes of sim"):
        explain.rules(slips(), bad)
    with pytest.raises(ValueError, match="rules: labels must be one for each of the 6"):
        explain.rules(SIM, bad, labels=["a"])
    with pytest.raises(ValueError, match="distinct episodes of each kind"):
        explain.rules(SIM, jax.tree.map(lambda a: jnp.stack([a[0]] * 6), bad), calm)
    with pytest.raises(ValueError, match="received one by monte_carlo that did not"):
        explain.rules(SIM, jast.estimate.monte_carlo(jax.random.key(0), SIM, 100))
    with pytest.raises(ValueError, match="rules: of must be"):
        explain.rules(SIM, bad, of="everything")
    always = late_gust(evaluate=lambda s: (s[0] >= 0, jnp.zeros(())))
    failing = drawn(0, 6, always)
    with pytest.raises(ValueError, match="rules: others: expected .* received 0: nearly"):
        explain.rules(always, failing, episodes=40)


def test_without_scikit_learn(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn", None)
    for part in ("tree", "ensemble"):
        monkeypatch.setitem(sys.modules, f"sklearn.{part}", None)
    bad = drawn(0, 6, SIM, gust=2.0, delay=1.0)
    for call in (explain.rules, explain.monitor):
        with pytest.raises(ImportError, match=r"pip install 'jast\[explain\]'"):
            call(SIM, bad)


def walk(limit=5.0, steps=20):
    return above(limit, steps, disturbance=lambda s: Normal(0.0, 0.5))


@pytest.fixture(scope="module")
def walked():
    sim = walk()
    e = jax.vmap(lambda k: jast.rollout(k, sim))(jax.random.split(jax.random.key(0), 4000))
    bad, calm = (jax.tree.map(lambda a, k=k: a[k], e) for k in (e.failure, ~e.failure))
    return sim, bad, jax.tree.map(lambda a: a[:400], calm)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["boosted", "logistic"])
def test_a_monitor_warns_before_a_walk_fails(walked, model):
    sim, bad, calm = walked
    m = explain.monitor(sim, bad, calm, within=3, model=model, false_alarms=0.1)
    assert m.auc > 0.9 and m.auc_interval[0] < m.auc < m.auc_interval[1]
    assert m.roc.area == pytest.approx(m.auc)
    assert m.warned[0] > 0.7
    assert m.ahead[1] >= 1
    # of 120 others held out, within 4 standard errors of a tenth, that of the threshold included
    assert m.false_alarms[0] < 0.1 + 4 * np.sqrt(0.09 / 120 + 0.09 / 84)
    p = m.probability(np.linspace(-1, 4.9, 8)[:, None])
    assert p.shape == (8,)
    assert p[-1] > p[0]
    assert m.probability([4.9]) == pytest.approx(p[-1])
    assert m.warns([4.9])
    assert not m.warns([0.0])
    assert m.threshold_for(0.0) >= m.threshold
    assert "area under the ROC curve" in str(m) and m.evaluations == len(bad.length) + 400


@pytest.mark.slow
def test_a_monitor_of_what_the_user_observes(walked):
    """Simulated near misses and ordinary episodes, and an observation of the user's own."""
    sim, bad, _ = walked
    m = explain.monitor(
        sim, bad, within=3, observe=lambda s: jnp.stack([5 - s, s**2]), episodes=100
    )
    assert m.probability([0.2, 23.0]) > m.probability([4.0, 1.0]) and len(m.held_out) == 3
    assert m.auc > 0.8 and m.held_out[1] > 10


def test_bad_monitors(walked):
    sim, bad, calm = walked
    with pytest.raises(ValueError, match="monitor: within"):
        explain.monitor(sim, bad, calm, within=0)
    with pytest.raises(ValueError, match="monitor: model must be"):
        explain.monitor(sim, bad, calm, model="deep")
    with pytest.raises(ValueError, match="monitor: others must not fail"):
        explain.monitor(sim, bad, bad)
    with pytest.raises(ValueError, match="monitor: failures must hold at least 12 distinct"):
        explain.monitor(sim, jax.tree.map(lambda a: a[:5], bad), calm)
    with pytest.raises(ValueError, match="observe must return a vector"):
        explain.monitor(sim, bad, calm, observe=lambda s: s)
    m = explain.monitor(sim, bad, calm, model="logistic")
    with pytest.raises(ValueError, match=r"observation must be \[1\]"):
        m.probability([1.0, 2.0])
