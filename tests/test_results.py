"""What all results have in common: one vocabulary, how they print, and their files."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from jast import results

KEY = jax.random.key(0)


@functools.cache
def sim():
    """A walk that fails in about one of 40 episodes."""
    return jast.simulators.walk1d(threshold=3.0, horizon=8)


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
    e = jast.search.monte_carlo(KEY, sim(), episodes=2000).best
    return jast.estimate.importance(KEY, sim(), jast.estimate.trace_proposal(sim(), e), 200)


def small_forest():
    return jast.search.forest(KEY, sim(), trees=3, prunes=3, simulations=20, record=True)


def ce():
    objective = jast.cross_entropy.sierra()
    proposal = jast.cross_entropy.normal(jnp.zeros(2), 10 * jnp.eye(2))
    return jast.cross_entropy.ce_method(KEY, objective, proposal, samples=10, iterations=4)


MAKERS = {
    "monte_carlo": lambda: jast.search.monte_carlo(KEY, sim(), episodes=2000, record=True),
    "forest": small_forest,
    "cem": lambda: jast.search.cem(KEY, sim(), samples=50, elites=5, iterations=3),
    "crude": lambda: jast.estimate.monte_carlo(KEY, sim(), 500),
    "importance": importance,
    "ce": ce,
    "nominal": lambda: jast.nominal(KEY, sim(), episodes=500),
    "failure_proposal": lambda: jast.estimate.failure_proposal(KEY, sim(), samples=200),
    "failure_samples": lambda: jast.estimate.failure_samples(
        KEY, sim(), jast.policy.nominal_policy(sim()), 5, moves=1
    ),
    "sac": lambda: jast.policies.sac(KEY, sim(), episodes=400, lanes=16, hidden=(8,)),
    "validation": validation,
}
OTHERS = {
    "episode": lambda: made("monte_carlo").best,
    "failures": lambda: made("monte_carlo").failures,
    "simulator": sim,
    "policy": lambda: jast.policy.nominal_policy(sim()),
    "proposal": lambda: jast.estimate.trace_proposal(sim(), made("monte_carlo").best),
    "heads": heads,
    "traces": lambda: jast.estimate.log_weights(KEY, sim(), OTHERS["policy"](), 20),
    "history": lambda: made("monte_carlo").history,
    "roots": lambda: made("forest").roots,
}


@functools.cache
def made(name):
    return (MAKERS | OTHERS)[name]()


@pytest.mark.parametrize("name", [*MAKERS, *OTHERS])
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


@pytest.mark.parametrize("name", MAKERS)
def test_every_result_has_the_whole_vocabulary(name):
    value = made(name)
    for word in results.VOCABULARY:
        getattr(value, word)


def test_a_batched_and_a_traced_result_print_and_say_so():
    seen = []

    def search(key):
        found = jast.search.monte_carlo(key, sim(), episodes=200)
        seen.extend([repr(found), str(found), repr(found.best), found._repr_html_()])
        return found

    batch = jax.jit(jax.vmap(search))(jax.random.split(KEY, 3))
    assert seen[0].startswith("SearchResult (traced): ") and "traced float32[]" in seen[2]
    for text in (repr(batch), str(batch)):
        assert text.startswith("SearchResult (a batch of shape (3,)): ")
    assert len(repr(batch).splitlines()) <= 10
    assert "best_reward_per_tree=float32[3, 1]" in repr(batch)


def test_a_repr_does_not_raise_whatever_the_leaves_are():
    value = made("monte_carlo")
    for leaf in (None, "text", object(), jax.ShapeDtypeStruct((2,), jnp.float32)):
        for each in (value, value.best, value.failures):
            other = jax.tree.map(lambda _, leaf=leaf: leaf, each)
            assert repr(other).startswith(type(each).__name__) and other._repr_html_()


def test_html_is_escaped():
    table = results.html_table("a<b", {"x": "<script>"})
    assert "<script>" not in table and "&lt;script&gt;" in table and "a&lt;b" in table


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
    assert isinstance(few, jast.failures.Failures) and len(few) == 4 and few.seen == archive.seen
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
