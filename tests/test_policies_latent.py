"""The parts of learned failure policies: distributions by their latents, lanes of episodes, the
ring buffer, the tilted start, one update.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from systems import mark_long, ring, walk

import jast
from jast import distributions as D
from jast._src.cross_entropy import mixture
from jast._src.cross_entropy.mixture import Mixture
from jast._src.distributions.mixtures import Blended, Moved, x_of
from jast._src.heads.heads import Moments
from jast._src.policies.actor import (
    Normalisation,
    count_latents,
    entropy_term,
    log_normal,
    make_networks,
)
from jast._src.policies.lanes import Transitions, lane_at, step_lane
from jast._src.policies.soft_actor_critic_training import Rates, init_learner, update
from jast._src.policies.start_fit import _first_components, fit_tilt

DISTRIBUTIONS = dict(
    normal=lambda: D.Normal(jnp.float32(1.0), jnp.float32(2.0)),
    uniform=lambda: D.Uniform(jnp.float32(-1.0), jnp.float32(3.0)),
    tent=lambda: D.tent(jnp.float32(0.4)),
)


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(DISTRIBUTIONS, "uniform", "tent"))
def test_a_moved_and_a_blended_distribution_have_mass_one_and_their_own_samples(name, key):
    """By quadrature in x, and by the share of draws below a point."""
    dist = DISTRIBUTIONS[name]()
    low, high = (
        np.float64(x_of(dist, jnp.full((1,), -8.0))),
        np.float64(x_of(dist, jnp.full((1,), 8.0))),
    )
    x = jnp.asarray(np.linspace(low, high, 20_002)[1:-1], jnp.float32)
    moved = Moved(dist, jnp.array([0.7]), jnp.array([0.6]))
    blended = Blended(
        dist, jnp.array([0.25, 0.75]), jnp.array([[0.0], [-1.0]]), jnp.array([[1.0], [0.5]])
    )
    for q in (moved, blended):
        density = np.exp(np.float64(jax.vmap(q.log_prob)(x)))
        mass = np.cumsum(density) * (high - low) / len(x)
        np.testing.assert_allclose(mass[-1], 1, atol=2e-3)
        draws = np.sort(
            np.asarray(jax.vmap(lambda k, q=q: q.sample(seed=k))(jax.random.split(key, 4000)))
        )
        expected = np.interp(draws, np.asarray(x), mass)
        assert stats.kstest(expected, "uniform").pvalue > 1e-3
    np.testing.assert_allclose(D.mode(moved), x_of(dist, jnp.array([0.7])), rtol=1e-6)
    np.testing.assert_allclose(D.mode(blended), x_of(dist, jnp.array([-1.0])), rtol=1e-6)


def test_a_joint_disturbance_is_moved_number_by_number(key):
    dist = D.Joint(
        {"a": D.Normal(jnp.zeros(()), 1.0), "b": D.Independent(D.Normal(jnp.zeros(2), 2.0), 1)}
    )
    q = Moved(dist, jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 0.5, 0.1]))
    x = q.sample(seed=key)
    assert (x["a"].shape, x["b"].shape) == ((), (2,))
    np.testing.assert_allclose(q.mode()["b"], [4, 6])
    expected = stats.norm.logpdf(x["a"], 1, 1) + stats.norm.logpdf(x["b"], [4, 6], [1.0, 0.2]).sum()
    np.testing.assert_allclose(q.log_prob(x), expected, rtol=1e-5)


def test_sizes_count_floats_and_name_what_cannot_be_tilted():
    start = lambda: D.Normal(jnp.zeros(3), 1.0)
    assert count_latents(walk(), "sac") == (1, 0)
    assert count_latents(
        walk(lambda x0: x0.sum(), start=lambda: D.Independent(start(), 1)), "sac"
    ) == (
        1,
        3,
    )
    assert count_latents(
        walk(
            lambda x0: x0.astype(jnp.zeros(()).dtype),
            start=lambda: D.Categorical(probs=jnp.array([0.5, 0.5])),
        ),
        "sac",
    ) == (1, 0)
    with pytest.raises(ValueError, match="sac: disturbance: expected floats, received float.*int"):
        count_latents(ring(), "sac")
    beta = jast.Simulator(
        lambda x0: jnp.zeros(()),
        lambda s, x: s + x,
        lambda s: D.VonMises(2.0, 2.0),
        lambda s: (s > 3, 3 - s),
        4,
    )
    with pytest.raises(ValueError, match="sac: disturbance: VonMises cannot be tilted"):
        count_latents(beta, "sac")


def play(sim, x0, zs, dense=True):
    """The lane, its rows [steps] and flags once the latents ``zs`` were played."""

    def body(lane, z):
        lane, row, valid, invalid = step_lane(sim, dense, lane, z[None])
        return lane, (row, valid, invalid)

    lane, (rows, valid, invalid) = jax.jit(
        lambda x0, zs: jax.lax.scan(body, lane_at(sim, dense, x0), zs)
    )(x0, jnp.asarray(zs, jnp.float32))
    return (
        lane,
        rows,
        list(zip(np.asarray(valid).tolist(), np.asarray(invalid).tolist(), strict=True)),
    )


def test_the_shaping_telescopes_and_a_failure_counts_as_no_distance():
    """walk: distance 3 - s, cut at 0; a failure that has a distance of its own counts 0."""
    lane, rows, flags = play(walk(), (), [1.0, -0.5, 1.5])
    np.testing.assert_allclose(rows.approach, [1.0, -0.5, 1.5])
    assert flags == [(True, False)] * 3 and not lane.over
    np.testing.assert_allclose([lane.gain, lane.log_p, lane.nearest], [2.0, -1.75, 1.0])
    far = walk()
    far = jast.Simulator(
        far.init, far.step, far.disturbance, lambda s: (s > 3.0, jnp.abs(10.0 - s)), far.horizon
    )
    lane, rows, _ = play(far, (), [3.5])
    assert lane.failed
    assert lane.over
    assert float(rows.approach[0]) == 10.0
    assert rows.done[0]


def test_only_the_last_distance_counts_where_shaping_is_at_the_end():
    lane, rows, _ = play(walk(), (), [1.0, -0.5, 0.0, 0.0, 0.0, 0.0], dense=False)
    np.testing.assert_allclose(rows.approach, [0, 0, 0, 0, 0, -2.5])
    assert lane.over and not lane.failed


@pytest.mark.slow
def test_an_episode_is_judged_as_a_rollout_is(key):
    """Outcome, length and miss distance of lanes are those of `jast.replay`, on systems with and
    without an early end.
    """
    terminal = walk(is_terminal=lambda s: s < -1.0)
    landing = jast.simulators.landing(0.1)
    for sim, x0 in ((terminal, ()), (landing, jnp.zeros(()))):
        z = 1.5 * jax.random.normal(key, (12, sim.horizon), jnp.float32)
        x = (z * (0.03 if sim.episodic else 1.0)).astype(jnp.zeros(()).dtype)
        own, _, flags = zip(*(play(sim, x0, row) for row in z), strict=True)
        ends = set()
        for lane, row, valid in zip(own, x, flags, strict=True):
            e = jast.replay(sim, row, *([x0] if sim.episodic else []))
            assert (bool(lane.failed), int(lane.t), sum(v for v, _ in valid)) == (
                bool(e.failure),
                int(e.length),
                int(e.length),
            )
            np.testing.assert_allclose(lane.nearest, e.distance, rtol=1e-4, atol=1e-6)
            ends.add((bool(e.failure), int(e.length)))
        assert len(ends) > 1


def test_a_start_that_ends_the_episode_gives_no_transition():
    sim = walk(lambda x0: x0, start=lambda: D.Normal(jnp.zeros(()), 1.0))
    lane, _, flags = play(sim, jnp.asarray(4.0), [1.0])
    assert lane.over
    assert lane.failed
    assert flags == [(False, False)]
    assert int(lane.t) == 0


@pytest.mark.parametrize("where", ["step", "evaluate", "observe", "init"])
def test_what_is_not_finite_is_invalid_and_ends_the_episode(where):
    bad = lambda s: jnp.where(s > 1.0, jnp.nan, s)
    fields = dict(
        step=dict(step=lambda s, x: bad(s + x)),
        observe=dict(observe=lambda s: bad(s)[None]),
        init=dict(init=lambda x0: jnp.full((), jnp.nan)),
        evaluate={},
    )[where]
    sim = walk(**fields)
    if where == "evaluate":
        sim = jast.Simulator(
            sim.init, sim.step, sim.disturbance, lambda s: (s > 3.0, bad(3.0 - bad(s))), sim.horizon
        )
    lane, _, flags = play(sim, (), [2.0])
    assert flags == [(False, True)]
    assert lane.over
    assert not lane.failed


def test_the_ring_buffer_holds_the_latest_valid_rows():
    buffer, stored = Transitions.empty(5, 1, 1), jnp.int32(0)
    kept = []
    for i in range(4):
        number = jnp.arange(3 * i, 3 * i + 3)
        new = jax.tree.map(
            lambda a, number=number: jnp.broadcast_to(
                number.reshape(-1, *(1,) * (a.ndim - 1)), (3, *a.shape[1:])
            ).astype(a.dtype),
            buffer,
        )
        valid = jnp.array([True, i % 2 == 0, True])
        kept += [3 * i + j for j in range(3) if valid[j]]
        buffer, stored = buffer.put(stored, new, valid)
    assert int(stored) == len(kept) == 10
    assert sorted(np.asarray(buffer.t).tolist()) == kept[-5:]
    np.testing.assert_array_equal(buffer.z[:, 0], buffer.t)


@pytest.mark.slow
def test_the_fit_of_a_start_finds_unequal_modes(key):
    """log_value such that p exp(value) is a known mixture, far out and without symmetry; the first
    component is the model itself.
    """
    parts = [0.8, 0.2], [[4.0, 0.0], [-5.0, 1.0]], [[0.5, 1.0], [0.7, 0.6]]
    weights, means, deviations = (jnp.array(part, jnp.float32) for part in parts)
    truth = Mixture(weights, means, jax.vmap(jnp.diag)(deviations**2))
    value = lambda z: mixture.log_prob(truth, z) - log_normal(z, 0.0 * z, 1.0 + 0.0 * z) - 40.0
    tilt = jax.jit(lambda k: fit_tilt(k, value, 2))(key)
    np.testing.assert_allclose(tilt.weights.sum(), 1, rtol=1e-5)
    np.testing.assert_allclose(
        [tilt.weights[0], *tilt.means[0], *tilt.deviations[0]], [0.05, 0, 0, 1, 1], rtol=1e-5
    )
    right = np.asarray(tilt.means[1:, 0]) > 0
    w, m = np.asarray(tilt.weights[1:] / 0.95), np.asarray(tilt.means[1:])
    assert abs(w[right].sum() - 0.8) < 0.06
    np.testing.assert_allclose((w[right] @ m[right]) / w[right].sum(), [4, 0], atol=0.15)
    np.testing.assert_allclose((w[~right] @ m[~right]) / w[~right].sum(), [-5, 1], atol=0.3)


@pytest.mark.parametrize("seed", range(3))
def test_first_components_are_far_apart_in_deviations(seed):
    """A few points are 4 deviations off in a narrow direction, the others 2 apart in a wide one:
    those few are among the first two components.
    """
    z = jnp.array([[-5.0, 0.0]] * 15 + [[5.0, 0.0]] * 15 + [[0.0, 2.0]] * 2, jnp.float32)
    first = _first_components(jax.random.key(seed), z, jnp.ones(32, jnp.float32), 2)
    assert sorted(first.means[:, 1].tolist()) == [0, 2]


@pytest.mark.slow
@pytest.mark.parametrize("value", [-jnp.inf, jnp.nan])
def test_where_nothing_is_known_the_start_is_the_model(value, key):
    tilt = fit_tilt(key, lambda z: jnp.full((), value, jnp.float32), 1, samples=64, rounds=1)
    np.testing.assert_allclose(tilt.weights[0], 1, atol=1e-6)
    assert all(bool(jnp.all(jnp.isfinite(a))) for a in tilt)


def test_the_entropy_of_the_model_neither_gains_nor_loses():
    """Under pi = N(0, I) the reward of a step and its entropy at temperature 1 cancel on average:
    E[-|z|^2 / 2 - term] = 0, for each z.
    """
    z = jnp.array([0.3, -1.2], jnp.float32)
    np.testing.assert_allclose(
        -0.5 * jnp.sum(z**2)
        - entropy_term(
            z, jnp.zeros((1,), z.dtype), jnp.zeros_like(z)[None], jnp.ones_like(z)[None]
        ),
        0,
        atol=1e-6,
    )


@pytest.mark.slow
def test_networks_start_as_those_of_heads(key):
    """Uniform in +-1/sqrt(fan-in), all arrays different."""
    new = init_learner(key, 2, 1, (64, 32), 2, jnp.float32(1.0))
    layers = [new.actor["params"][f"Dense_{i}"] for i in range(3)]
    assert [layer["kernel"].shape for layer in layers] == [(4, 64), (64, 32), (32, 6)]
    for layer in layers:
        bound = 1 / np.sqrt(layer["kernel"].shape[0])
        for a in layer.values():
            assert float(jnp.abs(a).max()) <= bound
        np.testing.assert_allclose(jnp.std(layer["kernel"]), bound / np.sqrt(3), rtol=0.25)
    one, other = (jax.tree.map(lambda a, i=i: a[i], new.critic) for i in range(2))
    assert not np.allclose(one["params"]["Dense_0"]["kernel"], other["params"]["Dense_0"]["kernel"])
    assert jax.tree.structure(new.actor) == jax.tree.structure(
        jax.eval_shape(make_networks(1, (64, 32), 2)[0][0], key, jnp.zeros(4, jnp.float32))
    )


@pytest.mark.long  # the quick compiler makes NaN of the actor's gradient
@pytest.mark.parametrize("acting", [0.0, 1.0])
def test_an_update_moves_all_by_the_learning_rate(acting, key):
    """Adam's first step is the rate in the sign of each gradient: the critics take it, and where
    they do not learn alone the actor and the temperature too, which rises while more entropy is
    wanted; averages follow by ``polyak`` of it.
    """
    rates = Rates(*(jnp.float32(v) for v in (0.01, 0.25, 1.0, 10.0, 0.0, 1.0, 0.0, 1.0)))
    _, applies = make_networks(1, (8,), 2)
    old = init_learner(key, 2, 1, (8,), 2, rates.alpha)
    net = Normalisation(Moments(*(jnp.asarray(a) for a in Moments.empty(2))), jnp.float32(1.0))
    columns = jax.random.normal(key, (8, 4), jnp.float32)
    no = jnp.zeros(4, bool)
    rows = Transitions(
        columns[:2].T, jnp.zeros(4), columns[2], columns[3:4].T, columns[4], no, no, columns[5:7].T
    )
    noise = jnp.broadcast_to(columns[7][:, None], (2, 4, 1))
    one = jnp.float32(1.0)
    step = jax.jit(update, static_argnums=(2, 8))
    new, loss = step(noise, old, applies, net, rates, jnp.float32(acting), one, rows, 5)
    assert loss > 0
    moved = jax.tree.map(lambda a, b: a - b, new, old)
    most = lambda tree: max(float(jnp.abs(a).max()) for a in jax.tree.leaves(tree))
    rate = dict(rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(most(moved.critic), 0.01, **rate)
    np.testing.assert_allclose(most(moved.target), 0.25 * 0.01, **rate)
    np.testing.assert_allclose(most(moved.actor), acting * 0.01, **rate)
    np.testing.assert_allclose(most(moved.average), acting * 0.25 * 0.01, **rate)
    np.testing.assert_allclose(moved.log_alpha, acting * 0.01, **rate)
