"""The archive of failures: what is kept, how it is ranked and counted, and that a file gives back
exactly what was saved, or says why not.
"""

import csv
import json
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from systems import PUBLISHED

import jast
from jast._src.core import failures as F
from jast._src.io import save_load
from jast.distributions import Bernoulli, Independent, Joint, MultivariateNormalDiag, Normal

FERRY = jast.simulators.ferry()
REWARD = jast.rewards.standard(event_bonus=30.0, density="mode")


class Gust(NamedTuple):
    wind: jax.Array
    push: jax.Array


def _start():
    return Normal(0.0, 1.0)


def _gusts(state):
    return Joint({"wind": Normal(0.0, 1.0), "push": (Independent(Normal(jnp.zeros(2), 1.0), 1),)})


def _named(state):
    return Joint(Gust(Normal(0.0, 1.0), Normal(0.0, 1.0)))


def _far(state):
    return jnp.abs(state) >= 2, jnp.maximum(2 - jnp.abs(state), 0)


WALK = jast.Simulator(
    init=lambda x0: x0,
    step=lambda s, x: s + x["wind"] + x["push"][0].sum(),
    disturbance=_gusts,
    evaluate=_far,
    horizon=6,
    start=_start,
)
NAMED = jast.Simulator(
    init=lambda x0: x0,
    step=lambda s, x: s + x.wind + x.push,
    disturbance=_named,
    evaluate=_far,
    horizon=6,
    start=_start,
)
PLAIN = jast.rewards.standard()


def ferry_episodes(*sequences):
    return jax.tree.map(
        lambda *a: np.stack(a),
        *(jax.device_get(jast.replay(FERRY, jnp.array(s), reward=REWARD)) for s in sequences),
    )


def perturbed(i):
    return PUBLISHED[:5] + [PUBLISHED[5] - 0.001 * i] + PUBLISHED[6:]


def rollouts(sim, n, seed=0):
    return jax.vmap(lambda key: jast.rollout(key, sim, reward=PLAIN))(
        jax.random.split(jax.random.key(seed), n)
    )


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for u, v in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.asarray(u).dtype == np.asarray(v).dtype and np.array_equal(u, v)


@pytest.fixture(scope="module")
def walks():
    return rollouts(WALK, 40)


@pytest.fixture(scope="module")
def archive(walks):
    return F.collect(WALK, PLAIN, walks)


def test_ferry_failures_are_deduplicated_counted_and_ranked():
    candidates = ferry_episodes(
        perturbed(1), PUBLISHED, PUBLISHED, [0.5] * 21, perturbed(2), PUBLISHED
    )
    found = F.collect(
        FERRY, REWARD, candidates, tree=[3, 2, 1, 0, 5, 9], simulation=[7, 8, 8, 0, 1, 9]
    )
    assert found.size == 3
    assert found.seen == 5
    assert found.dropped == 0
    assert list(found.counts) == [3, 1, 1]
    assert list(found.tree) == [1, 3, 5]
    assert list(found.simulation) == [8, 7, 1]
    assert np.all(np.diff(found.episodes.reward) <= 0) and found.episodes.failure.all()
    assert abs(found.best.reward - 29.092054904933118) < 1e-4 and found.best.length == 20
    np.testing.assert_array_equal(
        found.best.disturbances[:20], np.asarray(PUBLISHED, found.best.disturbances.dtype)
    )
    assert not found.best.disturbances[20:].any()


def test_archived_numbers_replay_to_the_bit(archive):
    assert archive.size > 5
    for i in range(archive.size):
        episode = archive.episode(i)
        same(
            jax.device_get(jast.replay(WALK, episode, reward=PLAIN)._replace(states=None)), episode
        )


def test_candidates_that_no_longer_fail_are_dropped_and_counted():
    calm = ferry_episodes([0.5] * 21, [0.5] * 21, PUBLISHED)
    claimed = calm._replace(failure=np.ones(3, bool))
    found = F.collect(FERRY, REWARD, claimed)
    assert (found.size, found.dropped, found.seen) == (1, 2, 3)
    assert "2 did not replay" in str(found)


def test_unused_rows_do_not_distinguish_failures():
    pair = ferry_episodes(PUBLISHED, PUBLISHED)
    disturbances = np.array(pair.disturbances)
    disturbances[1, 20] = 0.3  # beyond the length
    assert list(F.collect(FERRY, REWARD, pair._replace(disturbances=disturbances)).counts) == [2]


def test_the_start_distinguishes_failures():
    one = jax.device_get(
        jast.replay(
            WALK,
            jax.tree.map(lambda s: jnp.zeros((0, *s.shape)), jax.eval_shape(_draw)),
            x0=jnp.asarray(2.5),
            reward=PLAIN,
        )
    )
    pair = jax.tree.map(lambda a: np.stack([a, a]), one)
    pair = pair._replace(x0=np.array([2.5, 3.0], pair.x0.dtype))
    found = F.collect(WALK, PLAIN, pair)
    assert found.size == 2 and list(found.episodes.length) == [0, 0]
    assert found.best.x0 == 2.5  # the likelier start


def _draw():
    return _gusts(0.0).sample(seed=jax.random.key(0))


def test_no_failure_works_and_says_so(tmp_path):
    none = F.collect(FERRY, REWARD, ferry_episodes([0.5] * 21))
    same(none, F.empty(FERRY))
    assert none.size == 0
    assert none.best is None
    assert str(none) == "no failure was found"
    F.save(tmp_path / "none", none, dict(seed=1))
    back, header = F.load(tmp_path / "none", FERRY)
    same(back, none)
    assert header == dict(seed=1)
    some = F.collect(FERRY, REWARD, ferry_episodes(PUBLISHED))
    same(F.merge(none, some), some)
    same(F.merge(some, none), some)
    no_candidates = jax.tree.map(lambda a: a[:0], ferry_episodes(PUBLISHED))
    same(F.collect(FERRY, REWARD, no_candidates), none)


def test_table():
    table = str(F.collect(FERRY, REWARD, ferry_episodes(*(perturbed(i) for i in range(12)))))
    lines = table.splitlines()
    assert lines[0].startswith("12 distinct failures (12 failing episodes")
    assert len(lines) == 13
    assert lines[-1] == "... and 2 more"
    assert "29.092" in lines[2] and max(map(len, lines)) < 100
    assert str(F.collect(FERRY, REWARD, ferry_episodes(PUBLISHED))).startswith(
        "1 distinct failure (1 failing episode simulated)"
    )


def test_access_by_rank(archive):
    same(archive.episode(0), archive.best)
    same(archive.episode(-1), archive.episode(archive.size - 1))
    same(archive[0], archive.best)
    with pytest.raises(IndexError, match="episodes held"):
        archive.episode(archive.size)
    for none in (archive[:0], F.empty(FERRY)):
        with pytest.raises(IndexError, match="no failure was found.* larger budget"):
            none[0]


@given(st.lists(st.integers(0, 39), max_size=30), st.integers(1, 8), st.randoms())
@settings(max_examples=25, deadline=None)
def test_order_of_candidates_does_not_matter(picks, top, random):
    walks = jax.device_get(rollouts(WALK, 40)._replace(states=None))
    simulation = np.arange(len(picks))
    pick = lambda order: jax.tree.map(lambda a: a[np.array(picks, int)[order]], walks)
    order = np.array(random.sample(range(len(picks)), len(picks)), int)
    a = F.collect(WALK, PLAIN, pick(simulation), simulation=simulation, top=top)
    same(a, F.collect(WALK, PLAIN, pick(order), simulation=simulation[order], top=top))
    failing = [p for p in picks if walks.failure[p]]
    assert a.seen == len(failing) and a.size == min(top, len(set(failing)))
    if top >= len(set(failing)):
        assert a.counts.sum() == len(failing)


@given(
    st.lists(st.integers(0, 39), max_size=20),
    st.lists(st.integers(0, 39), max_size=20),
    st.integers(1, 40),
)
@settings(max_examples=25, deadline=None)
def test_merge_is_collect_of_all(left, right, top):
    walks = jax.device_get(rollouts(WALK, 40)._replace(states=None))
    pick = lambda picks: jax.tree.map(lambda a: a[np.array(picks, int)], walks)
    place = lambda picks, tree: dict(
        tree=np.full(len(picks), tree), simulation=np.arange(len(picks))
    )
    a, b = (
        F.collect(WALK, PLAIN, pick(left), **place(left, 0)),
        F.collect(WALK, PLAIN, pick(right), **place(right, 1)),
    )
    places = jax.tree.map(lambda *v: np.concatenate(v), place(left, 0), place(right, 1))
    same(F.merge(a, b, top), F.collect(WALK, PLAIN, pick(left + right), **places, top=top))
    same(F.merge(a, b, top), F.merge(b, a, top))


def test_bad_arguments(walks, archive):
    for top in (0, 1.5, True):
        with pytest.raises(ValueError, match="collect: top must be an int of at least 1"):
            F.collect(WALK, PLAIN, walks, top=top)
    with pytest.raises(ValueError, match="collect: episodes must share one leading axis"):
        F.collect(WALK, PLAIN, jax.tree.map(lambda a: a[0], walks))
    with pytest.raises(ValueError, match="collect: episodes must share one leading axis"):
        F.collect(WALK, PLAIN, walks._replace(reward=walks.reward[:-1]))
    with pytest.raises(ValueError, match=r"collect: tree must have the shape \(40,\)"):
        F.collect(WALK, PLAIN, walks, tree=[0])
    with pytest.raises(ValueError, match="merge: both archives must be of one simulator"):
        F.merge(archive, F.empty(FERRY))


def test_file_gives_back_what_was_saved(tmp_path, archive):
    path = tmp_path / "walk.jast"  # the name is kept as it is
    plan = dict(
        method="forest",
        seed=3,
        trees=np.int32(4),
        widening=(0.5, 0.6),
        nothing=None,
        nested=dict(a=[1, 2]),
        rate=np.float32(0.5),
    )
    F.save(path, archive, plan)
    for sim in (None, WALK):
        back, header = F.load(path, sim)
        same(back, archive)
        assert header == plan and type(header["trees"]) is np.int32
        assert str(back) == str(archive)
    F.save(path, F.empty(WALK))  # over the old one
    assert F.load(path)[0].size == 0 and F.load(path)[1] == {}
    assert [p.name for p in tmp_path.iterdir()] == ["walk.jast"]
    with np.load(path) as pack:  # no pickle inside
        assert json.loads(pack["header"].tobytes())["format"] == "jast result"


def test_named_tuples_need_their_simulator(tmp_path):
    found = F.collect(NAMED, PLAIN, rollouts(NAMED, 20))
    assert found.size
    F.save(tmp_path / "a", found)
    same(F.load(tmp_path / "a", NAMED)[0], found)
    with pytest.raises(ValueError, match=r"holds values of the class Gust.*load\(path, sim\)"):
        F.load(tmp_path / "a")
    with pytest.raises(ValueError, match="does not fit sim: it holds values of the class Gust"):
        F.load(tmp_path / "a", WALK)


def test_settings_that_no_file_can_hold(tmp_path, archive):
    with pytest.raises(ValueError, match="save: settings.sim must be an array, a number or a text"):
        F.save(tmp_path / "a", archive, dict(sim=object()))
    assert not list(tmp_path.iterdir())


def test_interrupted_save_leaves_the_old_file(tmp_path, archive, monkeypatch):
    F.save(tmp_path / "a", archive)
    monkeypatch.setattr(
        np, "savez_compressed", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt())
    )
    with pytest.raises(KeyboardInterrupt):
        F.save(tmp_path / "a", F.empty(WALK))
    monkeypatch.undo()
    same(F.load(tmp_path / "a")[0], archive)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_precision_is_kept(tmp_path):
    single = F.collect(FERRY, REWARD, ferry_episodes(PUBLISHED))
    F.save(tmp_path / "single", single)
    with jax.enable_x64(True):
        sim = jast.simulators.ferry((16.0, 0.0))
        for s in (None, sim):
            same(F.load(tmp_path / "single", s)[0], single)
        replayed = jax.tree.map(
            lambda a: np.asarray(a)[None],
            jax.device_get(jast.replay(sim, jnp.array(PUBLISHED), reward=REWARD)),
        )
        double = F.collect(sim, REWARD, replayed)
        assert double.best.disturbances.dtype == np.float64
        assert abs(double.best.reward - 29.092054904933118) < 1e-12
        F.save(tmp_path / "double", double)
    same(F.load(tmp_path / "double")[0], double)
    half = single._replace(
        episodes=single.episodes._replace(
            disturbances=single.episodes.disturbances.astype(jnp.bfloat16)
        )
    )
    F.save(tmp_path / "half", half)
    same(F.load(tmp_path / "half", FERRY)[0], half)


def test_load_refuses_what_does_not_fit(tmp_path, archive):
    F.save(tmp_path / "walk", archive)
    with pytest.raises(ValueError, match="does not fit sim: x0 has the structure"):
        F.load(tmp_path / "walk", FERRY)
    F.save(tmp_path / "ferry", F.empty(FERRY))
    longer = jast.Simulator(FERRY.init, FERRY.step, FERRY.disturbance, FERRY.evaluate, horizon=22)
    with pytest.raises(
        ValueError, match=r"disturbances has float\d+\[21\], expected float\d+\[22\]"
    ):
        F.load(tmp_path / "ferry", longer)
    seeded = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s,
        lambda s: jast.distributions.seeds(),
        _far,
        horizon=21,
    )
    with pytest.raises(ValueError, match=r"disturbances has float\d+\[21\], expected uint32\[21\]"):
        F.load(tmp_path / "ferry", seeded)


def test_load_refuses_other_files_and_versions(tmp_path, archive, monkeypatch):
    path = tmp_path / "a"
    path.write_text("reward,29.1")
    with pytest.raises(ValueError, match="is not a file of jast.save"):
        F.load(path)
    with open(path, "wb") as file:
        np.savez(file, reward=np.zeros(3))
    with pytest.raises(ValueError, match="is not a file of jast.save"):
        F.load(path)
    with pytest.raises(FileNotFoundError):
        F.load(tmp_path / "b")
    for version in (0, 2):
        with monkeypatch.context() as patch:
            patch.setattr(save_load, "VERSION", version)
            F.save(path, archive)
        with pytest.raises(
            ValueError, match=f"has version {version}, and this jast reads version 1"
        ):
            F.load(path)


def test_load_refuses_missing_and_changed_arrays(tmp_path, archive):
    path = tmp_path / "a"
    F.save(path, archive, dict(seed=1))
    with np.load(path) as pack:
        arrays = dict(pack)
    other = arrays["header"].tobytes().replace(b'"seed": 1', b'"seed": 2')
    assert other != arrays["header"].tobytes()
    for change in (
        lambda a: a.pop("result.episodes.reward"),
        lambda a: a.update({"result.episodes.reward": a["result.episodes.reward"] + 1}),
        lambda a: a.update(extra=np.zeros(1)),
        lambda a: a.update(header=np.frombuffer(other, np.uint8)),
    ):
        changed = dict(arrays)
        change(changed)
        with open(path, "wb") as file:
            np.savez(file, **changed)
        with pytest.raises(ValueError, match="is damaged"):
            F.load(path)


@pytest.mark.parametrize("seed", range(3))
def test_damaged_files_are_refused_or_harmless(tmp_path, archive, seed):
    path = tmp_path / "a"
    F.save(path, archive, dict(seed=seed))
    whole = path.read_bytes()
    rng = np.random.default_rng(seed)
    refused = 0
    for at in rng.choice(len(whole), 100, replace=False):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            back, header = F.load(path)
        except ValueError as error:
            assert "damaged" in str(error) or "not a file of jast.save" in str(error)
            refused += 1
        else:  # a date or another byte without meaning
            same(back, archive)
            assert header == dict(seed=seed)
    assert refused > 50
    for length in rng.choice(len(whole), 20, replace=False):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="damaged|not a file of jast.save"):
            F.load(path)


@pytest.mark.slow
def test_failures_as_plain_numbers(tmp_path):
    """A stranger's program gets the same failure from the table: ten lines of plain Python."""
    sim = jast.Simulator(
        init=lambda x0: x0,
        step=lambda s, x: s + x["gust"].sum() - x["pull"],
        disturbance=lambda s: Joint(
            dict(
                gust=MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2)),
                pull=Normal(jnp.asarray(0.0), 1.0),
            )
        ),
        evaluate=lambda s: (s >= 4, jnp.maximum(4 - s, 0.0)),
        horizon=6,
        start=lambda: Normal(jnp.asarray(0.0), 1.0),
    )
    found = jast.search.monte_carlo(jax.random.key(0), sim, episodes=500, refine=0).failures
    arrays = jast.failures.to_numpy(found)
    n = len(found)
    assert arrays["x.gust"].shape == (n, 6, 2) and arrays["x0"].shape == (n,)
    np.testing.assert_array_equal(arrays["length"], found.episodes.length)

    path = tmp_path / "failures.csv"
    jast.failures.to_csv(path, found)
    with open(path, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["failure"] == "3"]
    state = float(rows[0]["x0"])
    for row in rows[1:]:
        state += float(row["x.gust[0]"]) + float(row["x.gust[1]"]) - float(row["x.pull"])
    assert len(rows) == 1 + int(found[2].length) and state == pytest.approx(4, abs=4)
    assert state >= 4 - 1e-5
    assert float(rows[1]["x.pull"]) == float(found[2].disturbances["pull"][0])


@pytest.mark.slow
def test_the_example_of_a_table_runs(tmp_path, monkeypatch, key, capsys):
    """What the docstring shows, with a walk of our own."""
    import textwrap

    sim = jast.simulators.walk1d(threshold=3.0)
    found = jast.search.monte_carlo(key, sim, episodes=2000, refine=0, top=4).failures
    monkeypatch.chdir(tmp_path)
    jast.failures.to_csv("failures.csv", found)

    class MySimulator:
        at = 0.0

        def step(self, x):
            self.at += x

        def failed(self):
            return abs(self.at) >= 3.0 - 1e-5

    words = jast.failures.to_csv.__doc__.split("``x``::")[1].split("Args:")[0]
    code = textwrap.dedent(words)
    assert len(code.strip().splitlines()) <= 10
    exec(code, dict(MySimulator=MySimulator))
    assert capsys.readouterr().out == "True\n"


def test_what_is_no_archive_is_named(key, tmp_path):
    sim = jast.simulators.walk1d()
    report = jast.stress(key, sim, 1000)
    with pytest.raises(ValueError, match="replay: episode must be one Episode, .*received Report"):
        jast.replay(sim, report)
    with pytest.raises(ValueError, match="replay: episode must be one .*received Failures"):
        jast.replay(sim, report.failures)
    with pytest.raises(ValueError, match="failures must be an archive .*received Report"):
        jast.failures.to_csv(tmp_path / "table.csv", report)
    with pytest.raises(ValueError, match="merge: b must be an archive .*received int"):
        jast.failures.merge(report.failures, 3)


def fair(horizon):
    """Steps of +-1 by a fair coin, which fail at 3: each is as likely as the mode."""
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + jnp.where(x == 1, 1.0, -1.0),
        disturbance=lambda s: Bernoulli(probs=0.5),
        evaluate=lambda s: (s >= 3, jnp.maximum(3.0 - s, 0.0)),
        horizon=horizon,
    )


def test_of_as_likely_relative_to_the_mode_the_likeliest_is_first():
    """Of 2^9 sequences of a fair coin the likeliest has three steps: log p is 3 log(1/2)."""
    sim = fair(9)
    coins = (np.arange(2**9)[:, None] >> np.arange(9) & 1).astype(np.int32)
    all_of = jax.vmap(lambda x: jast.replay(sim, x, reward=jast.rewards.likelihood(sim)))(coins)
    longest_first = np.argsort(-all_of.length, stable=True)
    all_of = jax.tree.map(lambda a: a[longest_first], all_of._replace(states=None))
    found = F.collect(sim, jast.rewards.likelihood(sim), all_of)
    assert not found.episodes.reward.any()
    assert list(found.episodes.length[:2]) == [3, 5] and (np.diff(found.episodes.length) >= 0).all()
    np.testing.assert_allclose(found.best.log_prob, 3 * np.log(0.5), rtol=1e-6)
    for top in (1, 4):
        both = F.merge(found[4:], found[:4], top=top)
        same(both.episodes, found[:top].episodes)


def test_equal_rewards_are_ranked_by_log_p():
    """Whatever their order; infinite ones stay apart."""
    reward = np.float32([-4, -4, -4 + 1e-6, -np.inf, -np.inf, 5])
    log_p = np.float32([-2, -1, -9, -3, -2, -9])
    blank = F.empty(WALK).episodes
    episodes = blank._replace(reward=reward, log_prob=log_p)
    assert list(F.rank(episodes)) == [3, 2, 1, 5, 4, 0]
    backwards = episodes._replace(reward=reward[::-1], log_prob=log_p[::-1])
    assert list(F.rank(backwards)) == [0, 4, 5, 1, 2, 3]
    assert len(F.rank(blank)) == 0
