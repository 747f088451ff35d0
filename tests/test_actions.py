"""`at` and `locate` of the three kinds of action: a point of the unit cube, and the disturbance
there.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm
from systems import mark_long

import jast
from jast import actions
from jast import distributions as D
from jast._src.core.rewards import STANDARD


def kinds(dtype):
    return dict(
        samples=actions.samples(),
        quantiles=actions.quantiles(),
        uniform=actions.uniform(jnp.asarray(0, dtype), 3.0),
    )


def models(dtype):
    f = lambda v: jnp.asarray(v, dtype)
    vector, integer = (
        D.MultivariateNormalDiag(f([0, 1, 1.5]), f([1, 1, 2])),
        D.Categorical(probs=f([0.1, 0.4, 0.2, 0.3])),
    )
    return dict(
        vector=vector,
        integer=integer,
        joint=D.Joint({"v": vector, "n": integer, "t": D.tent(f(0.7))}),
        nothing=D.Fixed(),
    )


@pytest.mark.slow
@pytest.mark.parametrize("model", list(models("float32")))
@pytest.mark.parametrize("kind", list(kinds("float32")))
def test_locate_inverts_at(kind, model, dtype, key):
    choice, dist = kinds(dtype)[kind], models(dtype)[model]

    @jax.vmap
    def there_and_back(key):
        x = choice.draw(key, dist)
        u = choice.locate(x, dist)
        return x, u, choice.at(u, dist)

    x, u, again = jax.jit(there_and_back)(jax.random.split(key, 300))
    assert jax.tree.structure(u) == jax.tree.structure(x)
    for a, v, b in zip(*map(jax.tree.leaves, (x, u, again)), strict=True):
        assert v.shape == a.shape == b.shape
        assert v.dtype == dtype
        assert a.dtype == b.dtype
        assert ((v >= 0) & (v <= 1)).all()
        if jnp.issubdtype(a.dtype, jnp.floating):
            np.testing.assert_allclose(
                b,
                a,
                rtol=2e-3 if dtype == "float32" else 1e-9,
                atol=1e-4 if dtype == "float32" else 1e-12,
            )
        else:
            np.testing.assert_array_equal(a, b)
            assert np.unique(a).size == 4


def test_at_is_place_where_there_is_one():
    u, dist = jnp.asarray(0.25), D.Normal(0.0, 1.0)
    for choice in (actions.quantiles(), actions.uniform(0.0, 2.0)):
        assert choice.at(u, dist) == choice.place(u, dist)
    assert actions.samples().at(u, dist) == D.quantile(dist, u)
    assert not hasattr(actions.samples(), "place")
    # of the box, not of the model
    assert actions.uniform(0.0, 2.0).locate(jnp.asarray(0.5), dist) == 0.25


def test_locate_outside_of_a_box_and_in_one_of_no_width(dtype):
    x, n = (
        D.MultivariateNormalDiag(jnp.zeros(3, dtype), jnp.ones(3, dtype)),
        D.Categorical(probs=jnp.ones(9, dtype)),
    )
    box = actions.uniform(jnp.asarray([0, 1, 2], dtype), jnp.asarray([2, 1, 4], dtype))
    assert box.locate(jnp.asarray([-1, 1, 5], dtype), x).tolist() == [0, 0.5, 1]
    assert box.locate(jnp.asarray([np.inf, 1, -np.inf], dtype), x).tolist() == [1, 0.5, 0]
    assert box.at(box.locate(jnp.asarray([0.5, 1, 3], dtype), x), x).tolist() == [0.5, 1, 3]
    ints = actions.uniform(2, 5)
    u = [float(ints.locate(jnp.asarray(i), n)) for i in range(8)]
    # middles of four cells; a whole number outside has that of the nearest one
    assert u == [0.125, 0.125, 0.125, 0.375, 0.625, 0.875, 0.875, 0.875]
    assert actions.uniform(4, 4).locate(jnp.asarray(4), n) == 0.5


@settings(max_examples=60, deadline=None)
@given(
    low=st.integers(-1000, 1000),
    width=st.integers(0, 1000),
    part=st.integers(0, 1000),
    double=st.booleans(),
)
def test_every_whole_number_of_a_box_is_at_its_point(low, width, part, double):
    with jax.enable_x64(double):
        box, dist = actions.uniform(low, low + width), D.Categorical(probs=jnp.ones(2))
        x = jnp.asarray(low + min(part, width))
        assert box.at(box.locate(x, dist), dist) == x


def test_locate_names_the_distribution_that_cannot():
    lacking = D.VonMises(jnp.asarray(2.0), jnp.asarray(1.0))
    for choice in (actions.samples(), actions.quantiles()):
        with pytest.raises(ValueError, match="cdf: VonMises has no quantile function"):
            choice.locate(jnp.asarray(1.0), lacking)
    assert actions.uniform(0.0, 4.0).locate(jnp.asarray(1.0), lacking) == 0.25


def test_a_box_with_ends_for_each_part_is_the_boxes_of_its_parts(key):
    a, b = D.Normal(0.0, 1.0), D.MultivariateNormalDiag(jnp.zeros(2), jnp.ones(2))
    dist = D.Joint({"a": a, "b": b})
    low, high = {"a": -1.0, "b": jnp.array([0.0, 2.0])}, {"a": 1.0, "b": 4.0}
    box, parts = (
        actions.uniform(low, high),
        {name: actions.uniform(low[name], high[name]) for name in low},
    )
    u = {"a": jnp.asarray(0.75), "b": jnp.array([0.5, 0.25])}
    x = box.place(u, dist)
    assert x["a"] == 0.5 and x["b"].tolist() == [2.0, 2.5]
    assert all(
        (box.locate(x, dist)[name] == parts[name].locate(x[name], d)).all()
        for name, d in dict(a=a, b=b).items()
    )
    assert (
        box.log_prob(x, dist)
        == parts["a"].log_prob(x["a"], a) + parts["b"].log_prob(x["b"], b)
        == -jnp.log(2.0 * 4.0 * 2.0)
    )
    near = box.near(x, dist, 0.5)
    assert all(
        (near[name] == parts[name].near(x[name], d, 0.5)).all()
        for name, d in dict(a=a, b=b).items()
    )
    draws = jax.vmap(lambda k: box.draw(k, dist))(jax.random.split(key, 500))
    assert (jnp.abs(draws["a"]) < 1).all()
    assert (draws["b"].min(0) > jnp.array([0.0, 2.0])).all()
    assert (draws["b"].max(0) > 3.9).all()


@pytest.mark.slow
def test_check_says_what_is_wrong_with_the_ends_of_a_box():
    joint = lambda s: D.Joint({"a": D.Normal(0.0, 1.0), "b": D.Normal(0.0, 1.0)})
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x["a"] + x["b"],
        joint,
        lambda s: (s > 9, 9 - s),
        horizon=4,
    )
    jast.check(sim, actions.uniform({"a": -1.0, "b": -2.0}, 2.0))
    with pytest.raises(
        ValueError, match=r"actions.uniform: low is PyTreeDef\({'a'.*expected an array"
    ):
        jast.check(sim, actions.uniform({"a": -1.0}, 2.0))
    with pytest.raises(
        ValueError, match=r"actions.uniform: high has shape \(3,\), expected .* \(\)"
    ):
        jast.check(sim, actions.uniform(0.0, {"a": 1.0, "b": jnp.ones(3)}))


# --- a proposal of the search's own
# ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "low, high",
    [
        (1.0, -1.0),
        (np.array([0.0, 2.0]), 1.0),
        ({"a": 0.0, "b": 1.0}, {"a": 1.0, "b": 0.5}),
        (0.5, {"a": 1.0, "b": 0.0}),
    ],
)
def test_a_box_with_its_ends_swapped_is_refused(low, high):
    with pytest.raises(ValueError, match="actions.uniform: low must not be above high, received"):
        actions.uniform(low, high)


def test_a_box_may_have_no_width_or_traced_ends():
    assert actions.uniform(1.0, 1.0).high == 1.0
    width = jax.jit(lambda low: actions.uniform(low, 0.0).high - actions.uniform(low, 0.0).low)
    assert width(1.0) == -1.0


@pytest.mark.slow
@pytest.mark.parametrize("search", mark_long(["monte_carlo", "cem", "mcts"], "cem", "mcts"))
def test_searches_draw_from_the_proposal_and_score_by_the_model(key, search):
    """Of landing: drifts from N(.2, .01^2), so that all fail; offsets at the start from the
    model.
    """
    sim, near = (
        jast.simulators.landing(),
        actions.quantiles(D.Normal(jnp.full((), 0.2), jnp.full((), 0.01))),
    )
    sizes = dict(
        monte_carlo=dict(episodes=200),
        cem=dict(samples=40, elites=10, iterations=2),
        mcts=dict(simulations=100),
    )[search]
    found = getattr(jast.search, search)(key, sim, actions=near, reward=STANDARD, **sizes)
    assert found.failing_share == 1
    e = found.failures.episodes
    assert (abs(e.disturbances - 0.2) < 0.06).all() and (abs(e.x0) < 0.5).all()
    log_p = norm.logpdf(e.x0, 0, 0.1) + norm.logpdf(e.disturbances, 0, 0.03).sum(1)
    np.testing.assert_allclose(e.log_prob, log_p, rtol=1e-4)


def test_a_proposal_without_quantiles_is_refused():
    for wrong in (D.seeds(), 3.0):
        with pytest.raises(ValueError, match="actions.quantiles: proposal must be .* quantile"):
            actions.quantiles(wrong)
