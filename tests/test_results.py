"""What all results have in common: one vocabulary, how they print, and their files."""

import functools
import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from systems import mark_long

import jast
from jast._src.core.policy import nominal_policy
from jast._src.util import display
from jast.distributions import Normal

KEY = jax.random.key(0)


WALK = jast.simulators.walk1d(threshold=3.0, horizon=8)
"""A walk that fails in about one of 40 episodes."""


def heads():
    policy, value = jast.heads.make_head(KEY, 1, (1, 5)), jast.heads.make_head(KEY, 2)
    return jast.heads.Heads(policy, value)


def predict(inputs):
    return (np.asarray(inputs)[:, 0] > 0.1).astype(int)


def validation():
    inputs = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    labels = (inputs[:, 0] > 0).astype(int)
    return jast.weakness.validate(KEY, predict, inputs, labels, budget=40, selector="random")


def importance():
    e = jast.search.monte_carlo(KEY, WALK, episodes=2000, refine=0).best
    return jast.estimate.importance(KEY, WALK, jast.estimate.trace_proposal(WALK, e), 200)


def small_forest():
    return jast.search.forest(KEY, WALK, trees=3, prunes=3, simulations=20, record=True)


def ce():
    objective = jast.cross_entropy.sierra()
    proposal = jast.cross_entropy.normal(jnp.zeros(2), 10 * jnp.eye(2))
    return jast.cross_entropy.ce_method(KEY, objective, proposal, samples=10, iterations=4)


MAKERS = {
    "monte_carlo": lambda: jast.search.monte_carlo(KEY, WALK, episodes=2000, refine=0, record=True),
    "forest": small_forest,
    "cem": lambda: jast.search.cem(KEY, WALK, samples=50, elites=5, iterations=3),
    "crude": lambda: jast.estimate.monte_carlo(KEY, WALK, 500),
    "importance": importance,
    "ce": ce,
    "nominal": lambda: jast.nominal(KEY, WALK, episodes=500),
    "failure_proposal": lambda: jast.estimate.failure_proposal(KEY, WALK, samples=200),
    "failure_samples": lambda: jast.estimate.failure_samples(
        KEY, WALK, nominal_policy(WALK), 5, moves=1
    ),
    "sac": lambda: jast.policies.sac(KEY, WALK, episodes=400, lanes=16, hidden=(8,)),
    "validation": validation,
}
OTHERS = {
    "episode": lambda: made("monte_carlo").best,
    "failures": lambda: made("monte_carlo").failures,
    "simulator": lambda: WALK,
    "policy": lambda: nominal_policy(WALK),
    "proposal": lambda: jast.estimate.trace_proposal(WALK, made("monte_carlo").best),
    "heads": heads,
    "traces": lambda: jast.estimate.log_weights(KEY, WALK, OTHERS["policy"](), 20),
    "history": lambda: made("monte_carlo").history,
    "roots": lambda: made("forest").roots,
}


@functools.cache
def made(name):
    return (MAKERS | OTHERS)[name]()


def test_a_file_of_another_simulator_is_told(tmp_path):
    """One of the same shapes, with other parameters: its failures are not failures, are over at
    another time, or are of another density. What fits is loaded in silence.
    """

    def walk(limit=3.0, scale=1.0):
        return jast.Simulator(
            init=lambda x0: jnp.zeros(()),
            step=lambda s, x: s + x,
            disturbance=Partial(lambda scale, s: Normal(0.0, scale), jnp.asarray(scale)),
            evaluate=Partial(lambda at, s: (s >= at, jnp.maximum(at - s, 0)), jnp.asarray(limit)),
            horizon=5,
        )

    e = jast.replay(walk(), jnp.asarray([0.5, 1.5, 0.6, 0.6]))
    assert e.failure and e.length == 4
    path = tmp_path / "one.npz"
    jast.save(path, e)
    assert jast.load(path, walk()).failure and jast.load(path).failure
    for sim, words in [
        (walk(limit=100.0), "no longer fails"),
        (walk(limit=2.0), "fails after 2 steps, not 4"),
        (walk(scale=2.0), "has log p"),
    ]:
        with pytest.warns(UserWarning, match=f"load: the best failure in .* {words}"):
            jast.load(path, sim)


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long([*MAKERS, *OTHERS], "forest", "sac"))
def test_a_repr_is_short_and_the_table_of_a_notebook_names_every_field(name):
    value = made(name)
    shown, printed, table = repr(value), str(value), value._repr_html_()
    assert len(shown.splitlines()) <= 10 and len(shown) <= 1000
    if len(printed.splitlines()) <= 10:
        assert shown == printed
    else:
        assert shown.splitlines()[:9] == printed.splitlines()[:9] and "more lines" in shown
    fields = value._fields if isinstance(value, tuple) else value.__dataclass_fields__
    for field in fields:
        assert f"<th>{field}</th>" in table
    assert table.count("<tr>") == table.count("</tr>") >= len(fields) and len(table) < 5000


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(MAKERS, "sac"))
def test_every_result_has_the_whole_vocabulary(name):
    value = made(name)
    left = {"failures"} | ({"episodes"} if name == "failure_samples" else set())  # former names
    whole = {word: getattr(value, word) for word in display.VOCABULARY if word not in left}
    assert name == "failure_samples" or whole["episodes"] is not None
    assert np.ndim(whole.get("episodes", 0)) == 0
    assert whole["settings"] is None or isinstance(whole["settings"], dict)
    if name in ("monte_carlo", "forest", "cem"):
        assert whole["failing"] == value.failures.seen == value.failing_share * value.episodes
        assert whole["steps"] == value.simulator_steps and whole["invalid"] == 0
        np.testing.assert_array_equal(value.history.failures, value.history.failing)
    if name in ("monte_carlo", "forest", "cem", "crude", "importance", "nominal"):
        assert whole["settings"]["seed"] == jax.random.key_data(KEY).tolist()
        assert whole["settings"]["method"] == {"crude": "monte_carlo"}.get(name, name)
        json.dumps(whole["settings"])
    if name in ("crude", "importance"):
        assert (whole["failing"], whole["episodes"]) == (value.failures_seen, value.evaluations)
        assert value.failures is None and whole["incidents"] is None
    if name == "validation":
        assert (whole["episodes"], whole["failing"]) == (value.calls, len(value.failures))
        assert whole["settings"] == {"selector": value.state.selector}
    if name == "ce":
        assert whole["episodes"] == 40 and whole["steps"] is None


@pytest.mark.parametrize(
    "name, old, new",
    [
        ("nominal", "failures", "failing"),
        ("failure_proposal", "failures", "failing"),
        ("failure_samples", "episodes", "failures"),
    ],
)
def test_a_former_name_warns(name, old, new):
    value = made(name)
    with pytest.warns(DeprecationWarning, match=rf"\.{old} is {new} now; the old name goes"):
        assert getattr(value, old) is getattr(value, new)


@pytest.mark.slow
def test_a_batched_and_a_traced_result_print_and_say_so():
    seen = []

    def search(key):
        found = jast.search.monte_carlo(key, WALK, episodes=200)
        seen.extend([repr(found), str(found), repr(found.best), found._repr_html_()])
        return found

    batch = jax.jit(jax.vmap(search))(jax.random.split(KEY, 3))
    dtype = jnp.zeros(()).dtype
    assert seen[0].startswith("SearchResult (traced): ") and f"traced {dtype}[]" in seen[2]
    for text in (repr(batch), str(batch)):
        assert text.startswith("SearchResult (a batch of shape (3,)): ")
    assert len(repr(batch).splitlines()) <= 10
    assert f"best_reward_per_tree={dtype}[3, 1]" in repr(batch)


def test_a_repr_does_not_raise_whatever_the_leaves_are():
    value = made("monte_carlo")
    for leaf in (None, "text", object(), jax.ShapeDtypeStruct((2,), jnp.float32)):
        for each in (value, value.best, value.failures):
            other = jax.tree.map(lambda _, leaf=leaf: leaf, each)
            assert repr(other).startswith(type(each).__name__) and other._repr_html_()


def test_html_is_escaped():
    table = display.html_table("a<b", {"x": "<script>"})
    assert "<script>" not in table
    assert "&lt;script&gt;" in table
    assert "a&lt;b" in table


# the archive is a sequence


def test_an_archive_is_a_sequence_of_episodes(equal):
    archive = made("failures")
    assert len(archive) == archive.size == 64 and isinstance(archive[2], jast.Episode)
    equal(archive[2], archive.episode(2))
    equal(archive[-1], archive.episode(63))
    every = list(archive)
    assert len(every) == 64
    equal(every[5], archive[5])
    few = archive[3:7]
    assert isinstance(few, jast.failures.Failures)
    assert len(few) == 4
    assert few.seen == archive.seen
    equal(few[1], archive[4])
    np.testing.assert_array_equal(few.simulation, archive.simulation[3:7])
    with pytest.raises(IndexError, match="within the 64 episodes held, received 64"):
        archive[64]
    with pytest.raises(TypeError):
        archive["best"]


def test_an_archive_is_a_pytree(equal):
    archive = made("failures")
    leaves, treedef = jax.tree.flatten(archive)
    equal(treedef.unflatten(leaves), archive)
    assert len(leaves) == len(jax.tree.leaves(archive.episodes)) + 5
    shifted = jax.jit(lambda f: f.replace(seen=f.seen + 1))(archive)
    assert shifted.seen == archive.seen + 1 and archive._replace(dropped=3).dropped == 3


# doors


def test_a_door_lists_its_public_names_only():
    for door in (jast, jast.search, jast.estimate, jast.heads, jast.failures, jast.incidents):
        assert dir(door) == sorted(door.__all__)
        for name in dir(door):
            assert getattr(door, name) is not None
    assert "grow" not in dir(jast.search) and "plot" in dir(jast)


# files


def same(a, b, at="result"):
    """That ``b``, loaded, is ``a`` to the bit; arrays come back as NumPy's."""
    if isinstance(a, jax.Array | np.ndarray | np.generic):
        assert type(b) is (type(a) if isinstance(a, np.generic) else np.ndarray), at
        assert (a.dtype, a.shape) == (b.dtype, b.shape), at
        assert np.asarray(a).tobytes() == b.tobytes(), at
    elif isinstance(a, dict):
        assert list(a) == list(b), at
        for name in a:
            same(a[name], b[name], f"{at}.{name}")
    elif isinstance(a, tuple | list):
        assert type(a) is type(b) and len(a) == len(b), at
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"{at}.{i}")
    elif isinstance(a, jast.failures.Failures | jast.heads.Heads | jast.policies.FailurePolicy):
        assert type(a) is type(b), at
        assert jax.tree.structure(a) == jax.tree.structure(b), at
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            same(np.asarray(x), np.asarray(y), at)
    elif isinstance(a, float) and np.isnan(a):
        assert np.isnan(b), at
    else:
        assert type(a) is type(b) and a == b, at


FILED = [*MAKERS, "episode", "failures", "heads", "traces", "history", "roots"]


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(FILED, "sac"))
def test_a_file_gives_the_result_back_to_the_bit(name, tmp_path):
    value, path = made(name), tmp_path / "result"
    jast.save(path, value)
    back = jast.load(path, WALK)
    assert repr(back) == repr(value) and str(back) == str(value)
    if name == "failure_proposal":  # its policy is functions, made again from its numbers
        keys = jax.random.split(KEY, 4)
        for key in keys:
            same(
                np.asarray(jast.rollout(key, WALK, value.policy).disturbances),
                np.asarray(jast.rollout(key, WALK, back.policy).disturbances),
            )
        value, back = value._replace(policy=None), back._replace(policy=None)
    same(value, back)
    if name not in ("sac", "failure_proposal"):
        same(value, jast.load(path))  # no simulator is needed
    with np.load(path, allow_pickle=False) as pack:
        assert "header" in pack.files
    assert [p.name for p in tmp_path.iterdir()] == ["result"]


def test_a_file_with_former_names_of_fields_is_read(tmp_path):
    from jast._src.io import npz as archive
    from jast._src.io import save_load

    value, path = made("failure_samples"), tmp_path / "r"
    header, arrays = save_load.parts(value)
    fields = header["result"]["record"][1]
    fields["episodes"] = fields.pop("failures")  # as the version before wrote it
    archive.write(path, "jast result", 1, header, arrays)
    same(value, jast.load(path))


class Own(NamedTuple):
    """A state of a simulator's own class."""

    position: jax.Array
    more: dict


def own_simulator():
    return jast.Simulator(
        init=lambda x0: Own(jnp.zeros(()), {"none": None, "pair": (jnp.zeros(2), jnp.int32(1))}),
        step=lambda s, x: s._replace(position=s.position + x["push"]),
        disturbance=lambda s: jast.distributions.Joint(
            {"push": jast.distributions.Normal(jnp.zeros(()), 1.0)}
        ),
        evaluate=lambda s: (s.position > 2, jnp.maximum(2 - s.position, 0)),
        horizon=4,
    )


@pytest.mark.slow
def test_states_of_an_own_class_need_the_simulator(tmp_path):
    own, path = own_simulator(), tmp_path / "s"
    found = jast.search.monte_carlo(KEY, own, episodes=300, top=3)
    jast.save(path, found)
    same(found, jast.load(path, own))
    with pytest.raises(ValueError, match="the class Own, which only its simulator can restore"):
        jast.load(path)
    with pytest.raises(ValueError, match="does not fit sim: "):
        jast.load(path, WALK)


@pytest.mark.slow
def test_a_batch_nested_none_and_texts_are_kept(tmp_path):
    keys = jax.random.split(KEY, 2)
    batch = jax.vmap(lambda key: jast.search.monte_carlo(key, WALK, episodes=100))(keys)
    deep = made("nominal")._replace(
        undisturbed=None, interval=(None, [("é", {"a": True, "b": (1, float("inf"))})], np.int8(3))
    )
    for value in (batch, deep):
        jast.save(tmp_path / "r", value)
        same(value, jast.load(tmp_path / "r"))


def test_a_search_can_be_run_again_from_its_file(tmp_path, equal):
    reward = jast.rewards.standard(event_bonus=30.0, density="mode")
    box = jast.actions.uniform(-1.5, 1.5)
    found = jast.search.monte_carlo(KEY, WALK, episodes=300, reward=reward, actions=box)
    jast.save(tmp_path / "r", found)
    s = jast.load(tmp_path / "r", WALK).settings
    assert (s["reward"], s["actions"]) == ("rewards.standard", "actions.uniform")
    assert s["reward_settings"] == {"event_bonus": 30.0, "density": "mode"}
    assert s["action_settings"] == {"low": -1.5, "high": 1.5}
    again = jast.search.monte_carlo(
        jax.random.wrap_key_data(jnp.asarray(s["seed"], jnp.uint32), impl=jax.random.key_impl(KEY)),
        WALK,
        episodes=s["episodes"],
        reward=jast.rewards.standard(**s["reward_settings"]),
        actions=jast.actions.uniform(**s["action_settings"]),
    )
    equal(again.failures, found.failures)
    assert again.settings == found.settings


def test_what_a_file_cannot_hold_is_named(tmp_path):
    value = made("nominal")
    for bad, match in (
        (value._replace(rate=object()), "save: result.rate must be an array, a number or a text"),
        (value._replace(rate=KEY), "save: result.rate must be numbers, received a key"),
        (value._replace(rate=np.array(["a"])), "save: result.rate must be an array of numbers"),
    ):
        with pytest.raises(ValueError, match=match):
            jast.save(tmp_path / "r", bad)
    assert not list(tmp_path.iterdir())

    def inside(x):
        jast.save(tmp_path / "r", value._replace(rate=x))

    with pytest.raises(ValueError, match="save: result.rate must have a value, received a traced"):
        jax.jit(inside)(1.0)


def test_bad_files_are_refused(tmp_path, monkeypatch):
    from jast._src.io import npz as archive
    from jast._src.io import save_load

    path = tmp_path / "r"
    jast.save(path, made("monte_carlo"))
    whole = path.read_bytes()
    with pytest.raises(ValueError, match="does not fit sim: .*30"):
        jast.load(path, jast.simulators.walk1d(horizon=30))
    for bad, match in (
        (b"text", "is not a file of jast.save"),
        (whole[: len(whole) // 2], "damaged"),
        (whole[:-40], "damaged"),
    ):
        path.write_bytes(bad)
        with pytest.raises(ValueError, match=match):
            jast.load(path)
    with open(path, "wb") as file:
        np.savez(file, a=np.zeros(2))
    with pytest.raises(ValueError, match="not a file of jast.save"):
        jast.load(path)
    archive.write(path, "jast result", 2, {}, {})
    with pytest.raises(ValueError, match="has version 2, and this jast reads version 1"):
        jast.load(path)
    archive.write(path, "jast sac checkpoint", 1, {}, {})
    with pytest.raises(ValueError, match="its format is 'jast sac checkpoint'"):
        jast.load(path)
    archive.write(path, "jast result", 1, {"result": {"record": ["Unknown", {}]}}, {})
    with pytest.raises(ValueError, match="holds a Unknown, which this jast does not know"):
        jast.load(path)
    with pytest.raises(FileNotFoundError):
        jast.load(tmp_path / "none")
    archive.write(path, "jast result", 1, *save_load.parts(made("nominal")))
    monkeypatch.setattr(archive, "_checksum", lambda *_: "other")
    with pytest.raises(ValueError, match="its checksum does not match"):
        jast.load(path)


@pytest.mark.long
def test_a_failure_policy_needs_its_simulator(tmp_path):
    jast.save(tmp_path / "p", made("sac"))
    with pytest.raises(ValueError, match="only its simulator can restore: load"):
        jast.load(tmp_path / "p")


def test_files_of_the_former_functions_are_the_same(tmp_path, equal):
    archive, path = made("failures"), tmp_path / "f"
    settings = {"method": "forest", "n": np.int64(3), "widening": (0.5, [0.6])}
    jast.failures.save(path, archive, settings)
    equal(jast.load(path), archive)
    equal(jast.load(path, WALK), archive)
    back, kept = jast.failures.load(path)
    equal(back, archive)
    same(settings, kept)
    jast.save(path, archive)
    assert jast.failures.load(path)[1] == {}
    state = made("validation").state
    jast.weakness.save(path, state)
    same(state, jast.weakness.load(path))
    jast.save(path, heads())
    equal(jast.heads.load(path), jast.load(path))


# files of 0.2.0, in which four kinds of result had formats of their own


def former(name):
    """The path of a file that 0.2.0 wrote, and its arrays."""
    path = Path(__file__).parent / "files_of_0_2_0" / f"{name}.npz"
    with np.load(path) as pack:
        return path, dict(pack)


class Gust(NamedTuple):
    wind: jax.Array
    push: jax.Array


def gusts(state):
    push = jast.distributions.Independent(jast.distributions.Normal(jnp.zeros(2), 1.0), 1)
    return jast.distributions.Joint({"w": Gust(jast.distributions.Normal(0.0, 1.0), push)})


def test_an_archive_of_0_2_0_is_read(tmp_path):
    sim = jast.Simulator(
        init=lambda x0: x0,
        step=lambda s, x: s + x["w"].wind + x["w"].push.sum(),
        disturbance=gusts,
        evaluate=lambda s: (jnp.abs(s) >= 2, jnp.maximum(2 - jnp.abs(s), 0)),
        horizon=3,
        start=lambda: jast.distributions.Normal(0.0, 1.0),
    )
    path, arrays = former("failures")
    found, settings = jast.failures.load(path, sim)
    assert settings == {"seed": 0, "nested": {"a": [1, 2]}}
    header = json.loads(arrays["header"].tobytes())
    assert (len(found), found.seen, found.dropped) == (3, header["seen"], header["dropped"])
    same(found.episodes.reward, arrays["reward.0"])
    same(found.episodes.x0, arrays["x0.0"])
    same(found.episodes.disturbances["w"].push, arrays["disturbances.1"])
    for episode in found:
        again = jast.replay(sim, episode)
        assert again.failure and abs(float(again.log_prob) - episode.log_prob) < 1e-4
    with pytest.raises(ValueError, match="values of the class Gust, which only its simulator can"):
        jast.load(path)
    jast.save(tmp_path / "now", found)
    same(found, jast.load(tmp_path / "now", sim))


def test_heads_of_0_2_0_are_read():
    path, arrays = former("heads")
    found = jast.load(path)
    assert found.levels == 5 and found.returns is None
    same(found.inputs.deviation, arrays["inputs.2"])
    leaves = jax.tree.leaves(found.policy.params)
    for i, leaf in enumerate(leaves):
        same(leaf, arrays[f"policy.{i}"])
    assert found.policy.apply(found.policy.params, jnp.ones(1)).shape == (1, 3)
    assert found.value.apply(found.value.params, jnp.ones(2)).shape == ()


def test_a_policy_of_0_2_0_is_read():
    sim = jast.simulators.landing()
    path, arrays = former("policy")
    found = jast.load(path, sim)
    for name in ("actor", "critic", "net", "tilt", "alpha", "scale"):
        for i, leaf in enumerate(jax.tree.leaves(getattr(found.learned, name))):
            same(leaf, arrays[f"{name}.{i}"])
    same(found.history.invalid, arrays["history.8"])
    assert np.isfinite(jast.rollout(KEY, sim, found).log_prob)
    with pytest.raises(ValueError, match="does not fit sim: its horizon is 10, expected 8"):
        jast.load(path, WALK)


def test_a_validation_of_0_2_0_goes_on():
    inputs = np.random.default_rng(0).normal(size=(30, 2)).astype(np.float32)
    labels = (inputs[:, 0] > 0).astype(int)
    path, arrays = former("state")
    state = jast.load(path)
    same(state.order, arrays["order"])
    same(state.history.scores, arrays["history.scores"])
    found = jast.weakness.validate(
        KEY, predict, inputs, labels, budget=25, selector="random", state=state
    )
    assert found.calls == 25 and list(found.order[:20]) == list(arrays["order"])


def test_a_folder_that_is_missing_is_named(tmp_path, key):
    episode = jast.rollout(key, jast.simulators.walk1d())
    with pytest.raises(FileNotFoundError, match="no such folder.*nowhere'"):
        jast.save(tmp_path / "nowhere" / "episode.npz", episode)


def test_names_with_points_keep_their_own_arrays(tmp_path):
    path, result = tmp_path / "points", {"a.b": np.zeros(1), "a": {"b": np.ones(1)}}
    jast.save(path, result)
    found = jast.load(path)
    assert found["a.b"] == 0 and found["a"]["b"] == 1
