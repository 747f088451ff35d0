"""A simulator as a function to minimise: failures first, the likelier the lower, every point an
exact replay.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import S0, ring, walk

import jast
from jast import actions, rewards
from jast import distributions as D
from jast.cross_entropy import ask, ce_method, ce_surrogate, finish, over, start, tell

METHOD = dict(samples=50, elites=15, iterations=6)


@pytest.mark.slow
def test_points_of_a_walk(dtype):
    """z is the disturbance where it is N(0, 1): the miss distance, or -1 / (1 + c) with c = sum z^2
    / 2 up to the failure.
    """
    s = over(walk())
    assert s.proposal.mean.shape == (6,)
    assert s.proposal.mean.dtype == dtype
    assert (s.proposal.covariance == np.eye(6)).all()
    z = jnp.asarray(
        [
            [0.5, 0.5, 0.0, -3.0, 0.0, 0.0],
            [2.0, 1.5, 9.0, 9.0, 9.0, 9.0],
            [1.0, 1.0, 1.5, 0.0, 0.0, 0.0],
            [9.0, 0, 0, 0, 0, 0],
        ],
        dtype,
    )
    value = jax.jit(jax.vmap(s.objective))(z)
    np.testing.assert_allclose(value, [2, -1 / 4.125, -1 / 3.125, -1 / 41.5], rtol=1e-5)
    assert value.dtype == dtype
    assert [float(s.objective(row)) for row in z] == pytest.approx(value.tolist(), rel=1e-5)
    e = s.episode(z[1])
    assert e.failure
    assert e.length == 2
    assert e.disturbances[:3].tolist() == [2, 1.5, 0]
    assert float(e.reward) == pytest.approx(-3.125)
    assert e.states is not None


def test_failures_before_the_rest_whatever_the_units(key):
    """A failure of tiny likelihood is below a miss of 1e-6, and of the failures the likelier is
    lower.
    """
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: D.Normal(jnp.zeros(()), 1.0),
        lambda s: (s > 1, 1e-6 * jnp.abs(s - 5)),
        3,
    )
    value = jax.vmap(over(sim).objective)(
        jnp.asarray([[0.9, 0, 0], [60.0, 0, 0], [1.5, 0, 0], [0.4, 0.4, 0.4]])
    )
    assert value[0] > 0 > value[1] > value[2] > value[3]


@pytest.mark.slow
def test_start_and_structures(key):
    """Random start, dicts, integers: D counts them all, and quantiles make draws of the model (its
    failing share, within 4 standard errors).
    """
    sim, n = ring(), 4000
    s = over(sim)
    assert s.proposal.mean.shape == (2 + 8 * 3,)
    value = jax.jit(jax.vmap(s.objective))(jax.random.normal(key, (n, 26)))
    share = jax.jit(jax.vmap(lambda k: jast.rollout(k, sim).failure))(
        jax.random.split(key, n)
    ).mean()
    assert abs((value < 0).mean() - share) < 4 * np.sqrt(2 * share * (1 - share) / n)
    e = s.episode(jnp.zeros(26))
    assert float(e.x0["gust"]) == 0 and e.disturbances["gust"].shape == (8, 2)


def test_a_box():
    """u = Phi(z) is the place in the box."""
    s = over(jast.simulators.ferry(), actions=actions.uniform(0.0, 1.0))
    z = jnp.linspace(-3.0, 3.0, 21)
    np.testing.assert_allclose(
        s.episode(z).disturbances[:20], jax.scipy.stats.norm.cdf(z)[:20], rtol=1e-5
    )


def test_a_reward(key):
    s = over(jast.simulators.ferry(), **S0)
    z = jax.random.normal(key, (21,))
    assert (
        float(s.objective(z))
        == -float(s.episode(z).reward)
        == -float(jast.replay(s.sim, s.episode(z), reward=S0["reward"]).reward)
    )


def test_no_mode_and_no_density():
    """Less the raw log density where there is no mode; seeds of unknown density by a box, all
    failures equal.
    """

    class Plain(D.Distribution):
        """Exponential with a quantile function, and no mode or median that distrax names."""

        event_shape = ()

        def _sample_n(self, key, n):
            return jax.random.exponential(key, (n,))

        def log_prob(self, x):
            return jnp.where(x >= 0, jnp.log(10.0) - 10 * x, -jnp.inf)

    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: x,
        lambda s: Plain(),
        lambda s: (s > 0.1, jnp.maximum(0.1 - s, 0)),
        1,
    )
    s = over(sim, actions=actions.uniform(0.0, 1.0))
    u = jnp.asarray([0.5, 0.2, 0.05])
    value = jax.vmap(s.objective)(jax.scipy.stats.norm.ppf(u)[:, None])
    c = 10 * np.asarray(u) - np.log(10)  # 2.70, -0.30
    np.testing.assert_allclose(value, [-1 / (1 + c[0]), c[1] - 1, 0.05], rtol=1e-4)
    sim = jast.Simulator(
        lambda x0: jnp.uint32(0),
        lambda s, x: x,
        lambda s: D.seeds(),
        lambda s: (s > 9, (10 - s.astype(float)) / 10),
        1,
    )
    value = jax.vmap(over(sim, actions=actions.uniform(0, 10)).objective)(
        jnp.asarray([[0.0], [3.0]])
    )
    np.testing.assert_allclose(value, [0.5, -1], rtol=1e-6)


def test_what_is_not_finite_is_nan_and_counted(key):
    s = over(walk(step=lambda s, x: jnp.where(x > 1.0, jnp.nan, s + x)))
    r = ce_method(key, s.objective, s.proposal, **METHOD)
    assert 0 < int(r.invalid) == np.isnan(np.asarray(r.history.value)).sum() < 300
    assert np.isfinite(r.best_value)
    with_reward = over(s.sim, reward=rewards.standard())
    assert np.isnan(with_reward.objective(jnp.full(6, 2.0)))
    assert np.isnan(s.objective(jnp.full(6, 2.0)))
    outside = over(jast.simulators.ferry(), actions=actions.uniform(2.0, 3.0))  # p(x | s) = 0 there
    assert np.isnan(outside.objective(jnp.zeros(21)))


@pytest.mark.long
def test_surrogate_beats_random_search_on_the_ferry(key, equal):
    """Of four seeds with 1000 evaluations each, all come closer than random search and three or
    more find a collision; that has none in two million.
    """
    s = over(jast.simulators.ferry(), actions=actions.uniform(0.0, 1.0))
    random = jax.jit(lambda k: jax.vmap(s.objective)(jax.random.normal(k, (1000, 21))).min())
    runs = []
    for k in jax.random.split(key, 4):
        runs.append(ce_surrogate(k, s.objective, s.proposal, samples=100, elites=30, iterations=10))
        assert runs[-1].best_value < random(k) - 1 and random(k) > 5
    assert sum(bool(r.best_value < 0) for r in runs) >= 3
    r = min(runs, key=lambda r: float(r.best_value))
    e = s.episode(r.best_x)
    assert e.failure and float(r.best_value) == pytest.approx(-1 / (1 - float(e.reward)), rel=1e-4)
    found = s.failures(r, top=5)
    assert found.size == 5
    assert found.seen == (np.asarray(r.history.value) < 0).sum()
    assert (np.diff(found.episodes.reward) <= 0).all()
    assert r.history.value[found.simulation[0]] == r.best_value
    again = jax.device_get(jast.replay(s.sim, found.best, reward=s.reward)._replace(states=None))
    equal(again, found.best)


@pytest.mark.long
def test_batches_of_runs(key):
    """Runs and simulators side by side; ``tree`` is the run."""
    s = over(walk())
    r = jax.vmap(lambda k: ce_method(k, s.objective, s.proposal, **METHOD))(
        jax.random.split(key, 3)
    )
    found = s.failures(r, top=100)
    assert found.seen == (np.asarray(r.history.value) < 0).sum()
    assert set(found.tree) <= {0, 1, 2}
    assert found.simulation.max() < 300
    assert float(found.best.reward) == pytest.approx(float(1 + 1 / r.best_value.min()), rel=1e-4)
    sims = jax.vmap(lambda a: jast.simulators.walk1d("one-sided", threshold=a))(
        jnp.asarray([2.0, 8.0])
    )
    values = jax.vmap(lambda sim: over(sim).objective(jnp.full(10, 0.5)))(sims)
    np.testing.assert_allclose(values, [-1 / (1 + 4 * 0.125), 3], rtol=1e-5)


def test_ask_and_tell(key, equal):
    """The same as in one program, and failures of a search that goes on."""
    s = over(walk())
    search = start(key, s.proposal, "ce_method", **METHOD)
    assert s.failures(finish(search)).size == 0
    while not search.done:
        x = ask(search)
        search = tell(search, x, jax.vmap(s.objective)(x))
    r = ce_method(key, s.objective, s.proposal, **METHOD)
    np.testing.assert_allclose(finish(search).best_value, r.best_value, rtol=1e-4)
    assert s.failures(r).size > 0


def test_bad_input():
    with pytest.raises(ValueError, match="over: actions must .*received Samples"):
        over(walk(), actions=actions.samples())
    lacking = lambda s=None: D.VonMises(jnp.asarray(2.0), jnp.asarray(3.0))
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: D.Joint((D.Normal(s, 1.0), lacking())),
        lambda s: (s > 1, s),
        2,
    )
    with pytest.raises(ValueError, match="step"):  # the simulator itself first
        over(sim)
    sim = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x[0],
        lambda s: D.Joint((D.Normal(s, 1.0), lacking())),
        lambda s: (s > 1, s),
        2,
    )
    with pytest.raises(
        ValueError, match="over: disturbance: VonMises .*give actions=jast.actions.uni"
    ):
        over(sim)
    assert over(sim, actions=actions.uniform(0.0, 1.0)).proposal.mean.shape == (4,)
    sim = jast.Simulator(
        lambda x0: x0,
        lambda s, x: s + x,
        lambda s: D.Normal(jnp.zeros(()), 1.0),
        lambda s: (s > 1, s),
        2,
        start=lacking,
    )
    with pytest.raises(ValueError, match="over: start: VonMises has no quantile function"):
        over(sim, actions=actions.uniform(0.0, 1.0))
    with pytest.raises(ValueError, match="actions.uniform: low"):
        over(walk(), actions=actions.uniform(jnp.zeros(3), 1.0))
    with pytest.raises(ValueError, match="a point must have the shape \\(6,\\), received \\(5,\\)"):
        over(walk()).objective(jnp.zeros(5))
