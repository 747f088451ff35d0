"""Files of heads: they give back what was saved to the bit, and the very functions of networks that
jast made, or say why not.
"""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jast
from jast._src.core.failures import empty
from jast._src.heads import networks
from jast._src.heads.heads import policy_logits, predicted_value
from jast._src.search.tree import run
from jast.heads import Head, Heads, Moments, make_head

WALK = jast.simulators.walk1d(threshold=4.0)  # one number observed, a disturbance of one
SIZE = dict(trees=4, prunes=2, simulations=30)
INPUTS = Moments(
    np.float32(7), np.array([0.5, -1.0], np.float32), np.array([2.0, 0.25], np.float32)
)
RETURNS = Moments(np.float32(3), np.array(-4.0, np.float32), np.array(1.5, np.float32))


@functools.cache
def made(policy=True, value=True, moments=True, activation="tanh"):
    keys = jax.random.split(jax.random.key(8))
    new = functools.partial(make_head, hidden=(5, 4), activation=activation, first_activation=False)
    heads = Heads(
        new(keys[0], 1, (1, 6)) if policy else None, new(keys[1], 2) if value else None, levels=31
    )
    return Heads(heads.policy, heads.value, INPUTS, RETURNS, 31) if moments else heads


def linear(params, x):
    (a, b), c = params["a"], params["c"]
    return jnp.dot(a, x) + b + 0 * c["sizes"].sum().astype(jnp.float32)


def own(n=2, b=0.5):
    return Head(
        {
            "a": (np.arange(n, dtype=np.float32), np.float32(b)),
            "c": {"sizes": np.arange(3, dtype=np.int32)},
            "none": None,
        },
        linear,
    )


def saved(path, heads, given=None):
    jast.save(path, heads)
    return jast.heads.load(path, given)


def searched(heads):
    return jast.search.forest(
        jax.random.key(2), WALK, heads=heads, head_settings=jast.heads.settings(train=False), **SIZE
    )


def outputs(heads, seen, x):
    return (heads.policy and policy_logits(heads, seen)), (
        heads.value and predicted_value(heads, seen, x)
    )


# --- round trips
# ----------------------------------------------------------------------------


@pytest.mark.parametrize("policy,value", [(True, False), (False, True), (True, True)])
def test_file_gives_back_what_was_saved(tmp_path, equal, policy, value):
    heads = made(policy, value)
    back = saved(tmp_path / "h.jast", heads)
    equal(back, heads)
    assert isinstance(back.levels, int)
    assert (back.policy is None, back.value is None) == (
        not policy,
        not value,
    )
    for name in ("policy", "value"):
        if (head := getattr(heads, name)) is not None:
            assert getattr(back, name).apply is head.apply
            assert all(
                type(leaf) is np.ndarray for leaf in jax.tree.leaves(getattr(back, name).params)
            )
    # over the old one, and with heads that fit
    equal(saved(tmp_path / "h.jast", heads, heads), heads)
    equal(saved(tmp_path / "h.jast", back), heads)
    assert [p.name for p in tmp_path.iterdir()] == ["h.jast"]
    with np.load(tmp_path / "h.jast") as pack:  # no pickle inside
        header = json.loads(pack["header"].tobytes())
    assert header["format"] == "jast result"


def test_untrained_heads_have_no_moments(tmp_path, equal):
    heads = made(moments=False)
    back = saved(tmp_path / "h", heads)
    assert back.inputs is None and back.returns is None
    equal(back, heads)
    one = Heads(heads.policy, inputs=INPUTS, levels=np.int32(3))
    back = saved(tmp_path / "h", one)
    assert back.returns is None
    assert type(back.levels) is int
    assert back.levels == 3
    equal(back.inputs, INPUTS)


@pytest.mark.parametrize("hidden", [(3,), (2,) * 12])
@pytest.mark.parametrize("activation", sorted(networks.ACTIVATIONS))
def test_every_network_is_made_again(tmp_path, equal, hidden, activation):
    policy = make_head(jax.random.key(0), 3, (2, 4), hidden=hidden, activation=activation)
    back = saved(tmp_path / "h", Heads(policy))
    assert back.policy.apply is policy.apply
    equal(back.policy, policy)


def test_functions_of_ones_own_come_from_heads(tmp_path, equal):
    heads = Heads(value=own(), inputs=INPUTS, returns=RETURNS, levels=9)
    other = Heads(value=own(b=7.0))
    back = saved(tmp_path / "h", heads, other)
    equal(back, heads)
    assert back.value.apply is other.value.apply
    abstract = Heads(value=(jax.eval_shape(lambda: own()._replace(apply=None)).params, linear))
    equal(jast.heads.load(tmp_path / "h", abstract), heads)


def test_networks_beside_functions_of_ones_own(tmp_path, equal):
    heads = Heads(made().policy, own())
    back = saved(tmp_path / "h", heads, Heads(value=own(b=1.0)))
    equal(back, heads)
    assert back.policy.apply is heads.policy.apply


def test_functions_around_a_network_are_ones_own(tmp_path, equal):
    policy = made().policy
    doubled = lambda params, x: 2 * policy.apply(params, x)
    stacked = jax.tree.map(lambda a: jnp.stack([a, a]), policy.params)
    for head in (
        (policy.params, doubled),
        (policy.params, Partial(policy.apply.func, mutable=False)),
        (policy.params, policy.apply.func.__self__.init),
        (stacked, policy.apply),
        (policy.params["params"], policy.apply),
        ((), policy.apply),
    ):
        heads = Heads(head)
        jast.save(tmp_path / "h", heads)
        with pytest.raises(
            ValueError, match="holds a policy head with a function that is not in the file"
        ):
            jast.heads.load(tmp_path / "h")
        equal(jast.heads.load(tmp_path / "h", heads), heads)
    jast.save(tmp_path / "h", Heads(policy))
    assert (
        jast.heads.load(tmp_path / "h", Heads((policy.params, doubled))).policy.apply.func
        is doubled
    )  # whoever gives a function gets it


def test_heads_that_passed_through_jit_are_still_networks(tmp_path, equal):
    heads = jax.jit(lambda h: h)(made())
    assert heads.policy.apply is not made().policy.apply
    back = saved(tmp_path / "h", heads)
    assert back.policy.apply is made().policy.apply and back.levels == 31
    equal(back, made())


@pytest.mark.parametrize(
    "dtype",
    ["bfloat16", "float16", "float64", "float8_e4m3fn", "int4", "uint8", "bool", "complex64"],
)
def test_precision_is_kept(tmp_path, equal, dtype):
    dtype = jnp.dtype(dtype)
    numbers = np.arange(6).reshape(2, 3).T.astype(dtype)
    head = ([numbers, numbers[0, 0]], linear)
    equal(saved(tmp_path / "h", Heads(head), Heads(head)).policy.params, head[0])
    if jnp.issubdtype(dtype, jnp.floating):
        single = Heads(([numbers.astype(np.float32), np.float32(1)], linear))
        equal(jast.heads.load(tmp_path / "h", single).policy.params, head[0])


def test_networks_made_in_double_precision_keep_theirs(tmp_path, equal):
    head = make_head(jax.random.key(0), 3, (2, 4))
    double = Heads(
        head._replace(params=jax.tree.map(lambda a: np.asarray(a, np.float64) / 3, head.params))
    )
    back = saved(tmp_path / "h", double)
    equal(back, double)
    assert back.policy.apply is head.apply


# --- in use
# ----------------------------------------------------------------------------


@pytest.mark.parametrize("policy,value", [(True, False), (False, True), (True, True)])
def test_loaded_heads_say_the_same_without_compiling(tmp_path, equal, policy, value):
    heads = made(policy, value)
    back = saved(tmp_path / "h", heads)
    traces = []

    @jax.jit
    def out(heads, seen, x):
        traces.append(1)
        return outputs(heads, seen, x)

    seen, x = jnp.ones((1,), jnp.float32), jnp.full((1,), 0.3, jnp.float32)
    equal(out(back, seen, x), out(heads, seen, x))
    assert len(traces) == 1
    equal(outputs(back, seen, x), outputs(heads, seen, x))


@pytest.mark.long
def test_a_search_goes_on_with_loaded_heads(tmp_path, equal, traced):
    heads = made()
    first = searched(heads)
    traced.clear()
    again = searched(saved(tmp_path / "h", heads))
    assert not {f.__name__ for f in (run._grow, run._prune, run._rebuild)} & set(traced)
    equal(again._replace(settings=None, heads=None), first._replace(settings=None, heads=None))
    assert again.settings == first.settings
    equal(saved(tmp_path / "h", again.heads), first.heads)


@pytest.mark.long
def test_what_a_search_trained_can_be_saved(tmp_path, equal):
    settings = jast.heads.settings(hidden=(4,), bins=4, steps=(2, 2), round=2)
    found = jast.search.forest(
        jax.random.key(2), WALK, heads="both", head_settings=settings, **SIZE
    )
    back = saved(tmp_path / "h", found.heads)
    equal(back, found.heads)
    assert back.policy.apply is found.heads.policy.apply and back.inputs.count > 0
    equal(searched(back).best, searched(found.heads).best)


# --- refused
# ----------------------------------------------------------------------------


def test_save_refuses_what_no_file_can_hold(tmp_path):
    head = made().policy
    for heads, reason in (
        (Heads("rollout"), r"save: the policy head must be a pair \(params, apply\), received str"),
        (
            Heads(head, levels=2.5),
            "save: levels must be a whole number of at least 0, received 2.5",
        ),
        (
            Heads((np.array([None]), linear)),
            "save: result.policy.params must be an array of numbers, received object",
        ),
        (
            Heads((jax.random.key(0), linear)),
            "save: result.policy.params must be numbers, received a key",
        ),
    ):
        with pytest.raises(ValueError, match=reason):
            jast.save(tmp_path / "h", heads)
    with pytest.raises(ValueError, match=r"save: result.policy.params\..* must .* a traced"):
        jax.jit(lambda p: jast.save(tmp_path / "h", Heads((p, linear))))(head.params)
    assert not list(tmp_path.iterdir())


def test_load_refuses_heads_that_do_not_fit(tmp_path):
    path = tmp_path / "h"
    jast.save(path, Heads(value=own()))
    with pytest.raises(ValueError, match="load: .*h holds a value head with a function"):
        jast.heads.load(path)
    kept = own().params
    for params, reason in (
        (own(3).params, r"value\.params\['a'\]\[0\] has float32\[2\], expected float32\[3\]"),
        (
            kept | {"c": {"sizes": np.zeros(3, np.float32)}},
            r"value\.params\['c'\]\['sizes'\] has int32\[3\], expected float32\[3\]",
        ),
        (
            kept | {"c": [np.zeros(3, np.int32)]},
            r"value.params has the structure .*'sizes'.*, expected .*'c': \[\*\]",
        ),
        (kept | {"d": kept["a"][0]}, "value.params has the structure .*, expected .*'d'"),
    ):
        with pytest.raises(ValueError, match="load: .*h does not fit heads: " + reason):
            jast.heads.load(path, Heads(value=(params, linear)))
    with pytest.raises(
        ValueError, match="does not fit heads: it holds no policy head, expected one"
    ):
        jast.heads.load(path, Heads(made().policy, own()))
    jast.save(path, Heads(made().policy, own()))
    with pytest.raises(ValueError, match="load: .*h holds a value head with a function"):
        jast.heads.load(path, Heads(made().policy))
    with pytest.raises(ValueError, match="load: heads must be jast.heads.Heads, received Head"):
        jast.heads.load(path, own())


def test_load_refuses_another_network(tmp_path):
    jast.save(tmp_path / "h", made())
    with pytest.raises(
        ValueError, match="does not fit heads: policy .*'tanh'.*, expected .*'relu'"
    ):
        jast.heads.load(tmp_path / "h", made(activation="relu"))


def test_load_refuses_an_unknown_activation(tmp_path, monkeypatch):
    monkeypatch.setitem(networks.ACTIVATIONS, "mish", jax.nn.mish)
    jast.save(tmp_path / "h", made(activation="mish"))
    monkeypatch.undo()
    with pytest.raises(ValueError, match="has the activation 'mish', .* that wrote the file"):
        jast.heads.load(tmp_path / "h")


def test_load_refuses_other_files(tmp_path):
    path = tmp_path / "h"
    path.write_text("levels,3")
    with pytest.raises(ValueError, match="load: .*h is not a file of jast.save"):
        jast.heads.load(path)
    jast.save(path, empty(WALK))
    with pytest.raises(ValueError, match="load: .*h holds Failures, expected Heads"):
        jast.heads.load(path)
    with pytest.raises(FileNotFoundError):
        jast.heads.load(tmp_path / "none")
    jast.save(path, made())
    with pytest.raises(ValueError, match="load: .*h holds Heads, expected Failures"):
        jast.failures.load(path)
