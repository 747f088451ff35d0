"""What no function can use is refused with a ValueError that names the argument and what came."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from jast.simulators import walk1d

SIM = walk1d()


def made(gain):
    return SIM


def judged(key):
    inputs = np.arange(8.0)[:, None]
    return jast.weakness.validate(
        key, lambda x: x[:, 0] > 5, inputs, inputs[:, 0] > 4, budget=4, selector="random"
    )


def swept(values, *args, **options):
    return lambda key: jast.sweep(key, made, values, *args, **options)


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda key: jast.rollout(key, SIM, policy=3), "policy must be a jast.Policy, received 3"),
        (lambda key: jast.rollout(key, SIM, reward=3), "reward must be one of .*, received 3"),
        (lambda key: jast.replay(SIM, jnp.ones(3), reward=3), "reward must be .*, received 3"),
        (lambda key: jast.search.mcts(key, SIM, reward=3), "reward must be .*, received 3"),
        (lambda key: jast.rewards.standard("a"), "event_bonus must be a number, received 'a'"),
        (lambda key: jast.rewards.standard(np.nan), "event_bonus must be a number, received nan"),
        (lambda key: jast.rewards.episodic("a"), "bonus must be a number, received 'a'"),
        (lambda key: jast.rewards.shaped(None), "scale must be a number, received None"),
        (lambda key: jast.rewards.lexicographic("a", 1), "near must be a number, received 'a'"),
        (lambda key: jast.actions.wide("a"), "width must be a number, received 'a'"),
        (lambda key: jast.actions.wide(np.inf), "width must be finite, received inf"),
        (lambda key: jast.actions.uniform("a", 1.0), "low must be a number, received 'a'"),
        (lambda key: jast.actions.uniform(0.0, np.nan), "high must be a number, received nan"),
        (swept({"zz": [1, 2]}), "simulators must take 'zz', received made: missing"),
        (swept({3: [1, 2]}), "names of values must be texts, received 3"),
        (swept({"gain": [1]}, len), "function must take key, simulator, received len"),
        (swept({"gain": [1]}, jast.nominal, follow=True), "must take key, simulator, 'near'"),
        (swept({"gain": [1]}, jast.nominal, budgets=3), "must take key, simulator, 'budgets'"),
        (lambda key: jast.blackbox.program(None), "command must name a program, .*, received None"),
        (lambda key: jast.blackbox.program(["ls", 3]), "command must name a program, as a text"),
        (lambda key: jast.blackbox.program("ls 'a"), "command must name a program, as a text"),
        (
            lambda key: jast.blackbox.program(["ls", "a\0"]),
            "command must name a program, as a text",
        ),
        (lambda key: jast.blackbox.program("ls", folder=3.5), "folder must be a directory"),
        (lambda key: jast.load(None), "load: path must be that of a file, received None"),
        (lambda key: jast.save(None, 3), "save: path must be that of a file, received None"),
        (
            lambda key: jast.save("unused.npz", {1: 2}),
            "keys of result must be texts",
        ),
        (lambda key: jast.failures.to_csv(None, None), "to_csv: path must be"),
        (lambda key: jast.failures.from_json(None, SIM), "from_json: path must be"),
        (lambda key: jast.failures.save("unused.npz", None), "failures must be an archive"),
        (
            lambda key: jast.failures.collect(SIM, jast.rewards.standard(), None),
            "episodes must be a batch of jast.Episode, received NoneType",
        ),
        (
            lambda key: jast.explain.minimal(walk1d(horizon=5), jast.rollout(key, SIM)),
            "minimal: disturbances of episode",
        ),
        (
            lambda key: jast.distributions.Bernoulli(probs=1.5),
            "Bernoulli: probs must lie between 0 and 1, received 1.5",
        ),
        (
            lambda key: jast.distributions.Geometric(np.array([0.5, -0.1])),
            "Geometric: probs must lie between 0 and 1",
        ),
        (lambda key: jast.distributions.Binomial(3.0, jnp.asarray(2.0)), "Binomial: probs must"),
        *(
            (
                lambda key, family=family, given=given: getattr(jast.distributions, family)(*given),
                words,
            )
            for family, given, words in [
                ("Poisson", (-1.0,), "Poisson: rate must be at least 0, received -1.0"),
                ("Normal", (0.0, np.array([1.0, -2.0])), "Normal: scale must be at least 0"),
                ("Laplace", (0.0, -1.0), "Laplace: scale must"),
                ("StudentT", (-2.0,), "StudentT: df must"),
                ("Exponential", (jnp.asarray(-1.0),), "Exponential: rate must"),
                ("Weibull", (-1.0, 1.0), "Weibull: concentration must"),
                ("Gamma", (2.0, -1.0), "Gamma: rate must"),
                ("Beta", (-2.0, 1.0), "Beta: alpha must"),
                ("Binomial", (-3.0, 0.5), "Binomial: total_count must"),
                ("Categorical", (None, np.array([1.5, -0.5])), "Categorical: probs must"),
                ("Uniform", (1.0, 0.0), "Uniform: high must be at least 1.0, received 0.0"),
                ("TruncatedNormal", (0.0, 1.0, 2.0, 1.0), "TruncatedNormal: high must"),
            ]
        ),
        (lambda key: jast.explain.criticality(key, SIM, 3), "criticality: episode cannot be"),
        (lambda key: jast.explain.differential(key, SIM, 3), "differential: sim must be a"),
        (lambda key: jast.nominal(key, SIM, devices="cpu"), "devices must be .*received .'cpu'"),
        (
            lambda key: jast.blackbox.from_python(
                lambda x: x, horizon=1, disturbance=jast.distributions.Normal
            ),
            r"disturbance must be a distribution, received the class Normal; call it",
        ),
        (lambda key: jast.plot.history(3), "plot.history: results must be .*, received int"),
        (lambda key: jast.plot.history({}, ax="x"), "plot: ax must be Axes of .*, received 'x'"),
        (lambda key: jast.weakness.idx(None), "idx: path must be that of a file, received None"),
        (lambda key: jast.weakness.from_idx(None), "from_idx: folder must be .*, received None"),
        (lambda key: jast.weakness.auc("a", "b"), "auc: scores and failed must be"),
        (lambda key: jast.weakness.auc([[1.0], 2.0], [True]), "auc: scores and failed must be"),
        (lambda key: jast.weakness.judge(judged(key), judged(key)), "judge: failed must be bool"),
        (lambda key: jast.incidents.incidents(None), "incidents: sim must be a jast.Simulator"),
        (lambda key: jast.explain.cards(key, SIM, None), "modes must be .*, received NoneType"),
        (lambda key: jast.explain.cards(key, SIM, [3]), "modes must be .*, received list"),
    ],
)
def test_it_is_named(key, tmp_path, monkeypatch, call, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=words):
        call(key)
    assert not list(tmp_path.iterdir())


def test_what_is_plainly_meant_is_taken(key):
    assert type(dataclasses.replace(SIM, horizon=np.int64(3)).horizon) is int
    answers = iter([0, 1, np.array([True]), 2])
    sim = jast.blackbox.from_python(
        lambda x: (next(answers), 1.0), horizon=1, disturbance=jast.distributions.Normal(0.0, 1.0)
    )
    found = [jast.replay(sim, jnp.full(1, float(i))) for i in range(4)]
    assert [bool(e.failure) for e in found] == [False, True, True, False]
    assert np.isfinite([e.distance for e in found]).tolist() == [True, True, True, False]


def test_arrays_and_traced_numbers_are_numbers():
    assert jast.rewards.standard(jnp.arange(3.0)).event_bonus.shape == (3,)
    paid = jax.jit(lambda b: jast.rewards.standard(b)(-1.0, True, 0.0, True))(2.0)
    assert float(paid) == 1.0
    assert float(jax.jit(lambda w: jast.actions.wide(w).width)(3.0)) == 3.0
