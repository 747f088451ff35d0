"""The cross-entropy methods: against a second implementation in NumPy, their books, their bad
input, and what they reach on sierra.
"""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from jast import cross_entropy as ce
from jast._src.cross_entropy import iterate, surrogates
from jast._src.cross_entropy.gaussian import Gaussian
from jast._src.cross_entropy.mixture import Mixture, em
from jast._src.cross_entropy.plan import MODES, make_plan

METHODS = {"ce_method": ce.ce_method, "ce_surrogate": ce.ce_surrogate, "ce_mixture": ce.ce_mixture}
CASES = {"1A": (0.0, 200.0, 10, 5), "1B": (-50.0, 2000.0, 10, 5), "1C": (0.0, 200.0, 5, 3)}
START = (np.array([3.0, -2.0]), np.array([[4.0, 1.0], [1.0, 2.0]]))


def bowl(x):
    return jnp.sum((x - 1) ** 2)


def batch(method, objective, keys, mean, covariance, **settings):
    return jax.jit(
        jax.vmap(lambda k: METHODS[method](k, objective, (mean, covariance), **settings))
    )(keys)


def asked(method, objective, key, proposal=START, **settings):
    """A run by ask and tell with an objective in NumPy: the searches after each batch, and the
    batches.
    """
    search = ce.start(key, proposal, method, **settings)
    searches, batches = [search], []
    while not search.done:
        x = np.asarray(ce.ask(search))
        value = np.array([objective(row) for row in x])
        search = ce.tell(search, x, value)
        searches.append(search)
        batches.append((x, value))
    return searches, batches


def np_bowl(x):
    return float(np.sum((x - 1) ** 2))


# ---- against NumPy


@pytest.mark.parametrize("mode", ["thesis", "default"])
def test_the_method_is_that_of_algorithm_1(mode, key, x64):
    searches, batches = asked(
        "ce_method", np_bowl, key, samples=12, elites=6, iterations=5, mode=mode
    )
    for i in range(5):
        given = batches[i : i + 1] if mode == "thesis" else batches[: i + 1]
        x, value = (np.concatenate(parts) for parts in zip(*given, strict=True))
        elite = x[np.argsort(value)[:6]]
        proposal = searches[i + 1].state.proposal
        np.testing.assert_allclose(proposal.mean, elite.mean(0), rtol=1e-9)
        np.testing.assert_allclose(proposal.covariance, np.cov(elite.T, bias=True), rtol=1e-9)


@pytest.mark.slow
def test_the_surrogate_sees_what_it_may_remember(key, x64):
    counts = (6, 2, 4, 3, 5)
    for memory, best in ((1, 0), (2, 0), (2, 3), (3, 4), (9, 5)):
        plan, _, _ = make_plan(
            "ce_surrogate",
            START,
            samples=1,
            elites=2,
            iterations=1,
            schedule=counts,
            mode="default",
            memory=memory,
            best=best,
        )
        rng = np.random.default_rng(0)
        x, value = rng.normal(size=(20, 2)), rng.normal(size=20)
        value[[3, 9]] = np.nan
        ends = np.cumsum((0, *counts))
        for k in range(5):
            state = iterate.begin(
                plan,
                key,
                make_plan(
                    "ce_method",
                    START,
                    samples=3,
                    elites=1,
                    iterations=1,
                    schedule=None,
                    mode="thesis",
                )[2],
            )
            log = np.full((20, 2), np.nan), np.full(20, np.inf)
            log[0][: ends[k + 1]], log[1][: ends[k + 1]] = x[: ends[k + 1]], value[: ends[k + 1]]
            x_so_far, value_so_far = map(jnp.asarray, log)
            state = state._replace(x=x_so_far, value=value_so_far, k=jnp.int32(k))
            since = ends[max(0, k + 1 - memory)]
            seen = iterate._surrogate_data(plan, state)
            # NaN sorts last
            older = [i for i in np.argsort(value[:since]) if np.isfinite(value[i])][:best]
            rows = [*range(since, ends[k + 1]), *older]
            got = {
                tuple(row): v for row, v, there in zip(*map(np.asarray, seen), strict=True) if there
            }
            assert {tuple(row) for row in x[rows]} == set(got)
            np.testing.assert_array_equal([got[tuple(x[i])] for i in rows], value[rows])


@pytest.mark.parametrize("k", [0, pytest.param(3, marks=pytest.mark.long)])
def test_true_model_and_sub_elites_make_the_next_proposal(k, key, x64):
    """An iteration of Algorithms 2 to 4 put together again from its parts, with NumPy's least
    squares for the surrogate.
    """
    searches, batches = asked(
        "ce_surrogate",
        np_bowl,
        key,
        samples=20,
        elites=4,
        iterations=4,
        mode="thesis",
        surrogate="polynomial",
    )
    before, after = searches[k], searches[k + 1]
    plan = before.plan
    proposal, first = before.state.proposal, before.state.first
    for_samples, for_searches = jax.random.split(
        jax.random.fold_in(jax.random.fold_in(before.state.key, k), 1)
    )
    judged = np.asarray(iterate.draw(for_samples, proposal, 200))
    np.testing.assert_array_equal(after.state.model_x[k], judged)
    (last, last_value), (x, value) = (
        batches[k],
        (np.concatenate(parts) for parts in zip(*batches[max(0, k - 2) : k + 1], strict=True)),
    )  # three iterations

    scale = np.sqrt(np.trace(first.covariance) / 2)  # the frame of mode "thesis"
    features = lambda p: np.stack(
        [p[:, 0] ** 0, p[:, 0], p[:, 1], p[:, 0] ** 2, p[:, 0] * p[:, 1], p[:, 1] ** 2], 1
    )
    z = lambda p: features((p - np.asarray(first.mean)) / scale)
    m = z(x)
    weights = np.linalg.solve(
        m.T @ m + surrogates.RIDGE * np.trace(m.T @ m) / 6 * np.eye(6),
        m.T @ (value / np.abs(value).max()),
    )
    model = lambda p: z(p) @ weights
    chosen = judged[np.argsort(model(judged))[:40]]  # the share of the true elites

    elites = last[np.argsort(last_value)[:4]]  # of the last batch
    sub = []
    for i, centre in zip(jax.random.split(for_searches, 4), elites, strict=True):
        mean, covariance, tried = centre, np.asarray(first.covariance), []
        for step in jax.random.split(i, 2):
            points = (
                mean
                + np.asarray(jax.random.normal(step, (100, 2))) @ np.linalg.cholesky(covariance).T
            )
            best = points[np.argsort(model(points))[:10]]
            tried.append(best[0])
            mean, covariance = best.mean(0), np.cov(best.T, bias=True)
        sub.append(min(tried, key=lambda p: model(p[None])[0]))
    together = np.concatenate([elites, chosen, sub])
    np.testing.assert_allclose(after.state.proposal.mean, together.mean(0), rtol=1e-6)
    np.testing.assert_allclose(
        after.state.proposal.covariance, np.cov(together.T, bias=True), rtol=1e-6
    )
    assert plan.chosen == (40,) * 4 and plan.evaluated == 0


@pytest.mark.slow
def test_points_of_the_searches_are_evaluated_next(key):
    searches, batches = asked(
        "ce_surrogate",
        np_bowl,
        key,
        samples=20,
        elites=6,
        iterations=4,
        evaluated=0.15,
        optimism=0.0,
    )
    assert searches[0].plan.evaluated == 3
    for search, (x, _) in list(zip(searches, batches, strict=False))[1:]:
        np.testing.assert_array_equal(x[:3], search.state.pending)
    first, late = batches[0], batches[-1]
    assert late[1][:3].max() < np.median(late[1][3:]) < np.median(first[1])


# ---- the books


@pytest.mark.parametrize(
    "method, schedule",
    [
        pytest.param("ce_method", None, marks=pytest.mark.long),
        ("ce_surrogate", (7, 0, 1, 4, 3)),
        pytest.param("ce_mixture", None, marks=pytest.mark.long),
    ],
)
def test_one_program_is_ask_and_tell(method, schedule, key, x64):
    settings = dict(samples=5, elites=3, iterations=3, schedule=schedule)
    result = METHODS[method](key, bowl, START, **settings)
    searches, batches = asked(method, np_bowl, key, **settings)
    x, value = (np.concatenate(parts) for parts in zip(*batches, strict=True))
    sizes = [n for n in schedule or (5, 5, 5) if n]
    assert [len(v) for _, v in batches] == sizes
    # the same arithmetic, compiled otherwise; a rounding grows from iteration to iteration
    np.testing.assert_allclose(result.history.x, x, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(result.history.value, value, rtol=1e-6, atol=1e-8)
    other = ce.finish(searches[-1])
    assert jax.tree.structure(other) == jax.tree.structure(result)
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(other), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)

    best = np.minimum.accumulate(value)
    ends = np.cumsum(sizes) - 1
    h = result.history
    np.testing.assert_array_equal(h.iteration, np.repeat(np.arange(len(sizes)), sizes))
    np.testing.assert_allclose(h.best_value, best[ends], rtol=1e-6)
    for k, end in enumerate(ends):
        np.testing.assert_array_equal(h.best_x[k], h.x[np.argmin(h.value[: end + 1])])
    assert (result.best_value, result.invalid) == (h.value.min(), 0)
    last = jax.tree.map(lambda a: a[-1], h.proposals)
    for a, b in zip(jax.tree.leaves(last), jax.tree.leaves(result.proposal), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_the_objective_is_asked_for_exactly_the_budget(key):
    calls = []
    schedule = ce.schedules.geometric(0.3)
    asked(
        "ce_surrogate",
        lambda x: calls.append(1) or np_bowl(x),
        key,
        samples=10,
        elites=3,
        iterations=10,
        schedule=schedule,
    )
    assert len(calls) == 100


@pytest.mark.parametrize(
    "method", ["ce_method", pytest.param("ce_mixture", marks=pytest.mark.long)]
)
def test_a_search_can_stop_early_and_go_on(method, key):
    search = ce.start(key, START, method, samples=4, elites=3, iterations=3)
    nothing = ce.finish(search)
    assert nothing.best_value == np.inf
    assert np.isnan(nothing.best_x).all()
    assert nothing.invalid == 0
    x = ce.ask(search)
    np.testing.assert_array_equal(x, ce.ask(search))
    search = ce.tell(search, x, [np_bowl(row) for row in np.asarray(x)])
    part = ce.finish(search)
    assert part.best_value == pytest.approx(min(np_bowl(row) for row in np.asarray(x)), rel=1e-5)
    assert np.isinf(part.history.value[4:]).all()
    leaves, treedef = jax.tree.flatten(search)  # as a checkpoint does
    again = jax.tree.unflatten(
        treedef,
        [a if jnp.issubdtype(a.dtype, jax.dtypes.prng_key) else np.asarray(a) for a in leaves],
    )
    np.testing.assert_array_equal(ce.ask(again), ce.ask(search))


def test_points_may_be_moved_before_they_are_evaluated(key):
    search = ce.start(key, START, samples=6, elites=3, iterations=2)
    clipped = np.clip(ce.ask(search), -1, 1)
    search = ce.tell(search, clipped, [np_bowl(row) for row in clipped])
    np.testing.assert_array_equal(ce.finish(search).history.x[:6], clipped)


@pytest.mark.slow
def test_proposals_and_objectives_share_one_program(key, traced):
    f = ce.sierra()
    ce.ce_surrogate(key, f, (np.zeros(2), 200.0), samples=4, elites=2, iterations=2)
    traced.clear()
    ce.ce_surrogate(key, f, (np.full(2, -50.0), 2000.0), samples=4, elites=2, iterations=2)
    ce.ce_surrogate(
        key,
        ce.sierra(mean=(1.0, 2.0), variance=2.0),
        (np.zeros(2), 1.0),
        samples=4,
        elites=2,
        iterations=2,
        alpha=2.0,
    )
    assert iterate.run.__name__ not in traced
    runs = jax.vmap(
        lambda m: ce.ce_method(key, f, (m, jnp.eye(2)), samples=4, elites=3, iterations=2)
    )(jnp.arange(6.0).reshape(3, 2))
    for i in range(3):
        one = ce.ce_method(
            key,
            f,
            (jnp.arange(6.0).reshape(3, 2)[i], jnp.eye(2)),
            samples=4,
            elites=3,
            iterations=2,
        )
        np.testing.assert_allclose(runs.history.x[i], one.history.x, rtol=1e-4, atol=1e-5)


def test_ratchet_and_empty_iterations():
    kept = lambda **more: make_plan(
        "ce_method",
        START,
        samples=1,
        elites=5,
        iterations=1,
        schedule=(8, 3, 0, 6),
        mode="thesis",
        **more,
    )[0]
    assert (kept().counts, kept().elites) == ((8, 3, 6), (5, 3, 5))
    assert kept(ratchet=True).elites == (5, 3, 3)


def test_selection():
    plan = lambda d, **more: make_plan(
        "ce_surrogate",
        (np.zeros(d), 1.0),
        samples=20,
        elites=10,
        iterations=2,
        schedule=None,
        **more,
    )[0]
    assert plan(2, mode="thesis").chosen == plan(8, mode="thesis").chosen == (100, 100)
    assert [plan(d, mode="default").chosen[0] for d in (1, 2, 5, 10, 20)] == [100, 100, 40, 20, 40]
    assert plan(2, mode="default", selection=0.25).chosen == (50, 50)
    assert [
        plan(2, mode="default", evaluated=share).evaluated for share in (0, 0.05, 0.1, 0.35, 0.5)
    ] == [0, 1, 2, 7, 10]


@pytest.mark.slow
def test_float32_and_float64(key, x64):
    for dtype in (np.float32, np.float64):
        mean, covariance = (a.astype(dtype) for a in START)
        result = ce.ce_mixture(key, bowl, (mean, covariance), samples=10, elites=5, iterations=6)
        floats = [a for a in jax.tree.leaves(result) if jnp.issubdtype(a.dtype, jnp.floating)]
        assert all(a.dtype == dtype for a in floats) and result.best_value < np_bowl(mean) / 20


@pytest.mark.long
def test_units_do_not_matter(key, x64):
    """Lengths times 4 and an increasing function of the values are the same search."""
    settings = dict(samples=8, elites=4, iterations=5)
    one = ce.ce_surrogate(key, bowl, START, **settings).history
    other = ce.ce_surrogate(
        key, lambda x: jnp.log(8 * bowl(x / 4)), (4 * START[0], 16 * START[1]), **settings
    ).history
    np.testing.assert_allclose(other.x, 4 * one.x, rtol=1e-9)
    np.testing.assert_allclose(other.value, np.log(8 * one.value), rtol=1e-9)


@pytest.mark.long
def test_mixtures_stay_proper(key):
    result = ce.ce_mixture(
        key, ce.sierra(), (np.zeros(2), 200.0), samples=10, elites=5, iterations=6
    )
    weights, means, covariances = result.history.proposals
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-5)
    assert weights.shape == (7, 2)
    assert np.isfinite(means).all()
    assert (np.linalg.eigvalsh(covariances) > 0).all()
    start = ce.Mixture(*jax.tree.map(lambda a: a[-1], (weights, means, covariances)))
    again = ce.ce_mixture(key, ce.sierra(), start, samples=10, elites=5, iterations=2)
    np.testing.assert_array_equal(again.history.proposals.means[0], start.means)
    twice = ce.ce_mixture(
        key,
        ce.sierra(),
        ce.Mixture(2 * np.asarray(start.weights), *start[1:]),
        samples=10,
        elites=5,
        iterations=2,
    )
    # weights are shares
    np.testing.assert_allclose(twice.history.x, again.history.x, rtol=1e-4, atol=1e-4)
    few = make_plan(
        "ce_mixture", START, samples=10, elites=5, iterations=1, schedule=None, mode="thesis"
    )
    assert few[0].components == 5 and few[2].weights.tolist() == pytest.approx([0.2] * 5)


# ---- bad input, and evaluations that fail


def walled(limit, x):
    """NaN or minus infinity beyond the limit."""
    return jnp.where(x[0] > limit, jnp.where(x[1] > 0, jnp.nan, -jnp.inf), bowl(x))


EACH_METHOD = [
    ("ce_method", "default"),
    pytest.param("ce_surrogate", "thesis", marks=pytest.mark.long),
    pytest.param("ce_mixture", "default", marks=pytest.mark.long),
]


@pytest.mark.parametrize("method, mode", EACH_METHOD)
def test_what_is_not_finite_is_counted_and_never_an_elite(method, mode, key):
    search = lambda limit: METHODS[method](
        key,
        Partial(walled, jnp.asarray(limit)),
        (np.zeros(2), 4.0),
        samples=20,
        elites=5,
        iterations=5,
        mode=mode,
    )
    result = search(1.5)
    x, value = np.asarray(result.history.x), np.asarray(result.history.value)
    wrong = x[:, 0] > 1.5
    np.testing.assert_array_equal(np.isfinite(value), ~wrong)
    assert 0 < int(result.invalid) == wrong.sum() < 100
    assert np.isfinite(result.best_value)
    assert result.best_value == value[~wrong].min()
    assert result.best_x[0] <= 1.5
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(result.history.proposals))
    assert f"{wrong.sum()} evaluations gave NaN or infinity" in str(result)

    nothing = search(-np.inf)  # an honest nothing
    assert nothing.best_value == np.inf
    assert np.isnan(nothing.best_x).all()
    assert nothing.invalid == 100
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(nothing.history.proposals))


@pytest.mark.parametrize("method, mode", EACH_METHOD)
def test_a_budget_of_one(method, mode, key):
    result = METHODS[method](key, bowl, START, samples=1, elites=1, iterations=1, mode=mode)
    assert (
        result.best_value
        == result.history.value[0]
        == pytest.approx(float(bowl(result.best_x)), rel=1e-5)
    )
    np.testing.assert_array_equal(result.best_x, result.history.x[0])
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(result.proposal))


@pytest.mark.slow
def test_singular_elites_leave_the_proposal(key):
    # two points of a plane have no covariance
    result = ce.ce_method(key, bowl, START, samples=10, elites=2, iterations=3, mode="thesis")
    for k in range(4):
        np.testing.assert_allclose(result.history.proposals.mean[k], START[0])
    assert result.best_value <= result.history.value[0]
    flat = ce.ce_surrogate(key, lambda x: jnp.zeros(()), START, samples=10, iterations=3)
    assert flat.best_value == 0
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(flat.history.proposals))


@pytest.mark.slow
def test_the_call_that_the_thesis_prints(key, x64):
    """``ce_surrogate(paraboloid, M; basis=:squared)`` finds the bottom: squared distances to
    points span a paraboloid.
    """
    proposal = ce.normal(jnp.zeros(2), 200 * jnp.eye(2))
    run = lambda **how: ce.ce_surrogate(key, ce.paraboloid, proposal, mode="thesis", **how)
    squared = run(basis="squared")
    assert squared.best_value < 2
    assert squared.best_value == run(surrogate="radial basis", basis="squared").best_value
    assert squared.best_value != run(basis="linear").best_value


BAD = {
    "elites must be at most the number of samples in an iteration, 10, received 11": dict(
        elites=11
    ),
    "elites must be a whole number of at least 1, received 0": dict(elites=0),
    "schedule: samples must be a whole number of at least 1, received 0": dict(samples=0),
    "mode must be one of ['default', 'thesis'], received 'paper'": dict(mode="paper"),
    "surrogate must be one of ['gaussian process', 'linear', 'polynomial', 'radial basis'],"
    " received 'forest'": dict(surrogate="forest"),
    "kernel must be one of ": dict(kernel="cubic"),
    "basis must be one of ['gaussian', 'linear', 'squared', 'multiquadratic']": dict(basis="cubic"),
    "degree must be a whole number of at least 1, received 0": dict(
        surrogate="polynomial", degree=0
    ),
    "warp must be one of ['raw', 'standard', 'rank'], received 'log'": dict(warp="log"),
    "frame must be one of ": dict(frame=3),
    "evaluated must be a share from 0 to 0.5, received 0.7": dict(evaluated=0.7),
    "memory must be a whole number of at least 1, received 0": dict(memory=0),
    "best must be a whole number of at least 0, received -1": dict(best=-1),
    'selection must be "elites", "dimension", or a share above 0 and at most 1, received 2': dict(
        selection=2
    ),
    "alpha must be a number above 0, received 0": dict(alpha=0),
    "optimism must be a number of at least 0, received -1.0": dict(optimism=-1.0),
    "schedule: counts must be whole numbers": dict(schedule=(3, -1)),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_settings_are_named(message, key):
    with pytest.raises(ValueError) as error:
        ce.ce_surrogate(key, bowl, START, **BAD[message])
    assert message in str(error.value)


def test_bad_proposals_and_objectives_are_named(key):
    def raises(message, *arguments, method=ce.ce_method, **settings):
        with pytest.raises(ValueError, match=message):
            method(key, *arguments, **settings)

    raises("proposal: covariance must be positive definite", bowl, (np.zeros(2), np.ones((2, 2))))
    raises("proposal: expected a Gaussian", bowl, 3.0)
    raises("ce_method: objective must be a function", 3.0, START)
    raises(
        r"ce_method: objective must return one real number for x of shape \(2,\)",
        lambda x: x,
        START,
    )
    raises(
        "ce_method: objective must be written in JAX; for any other program use start, ask and"
        " tell",
        lambda x: float(x[0]),
        START,
    )
    raises("ce_method: objective must be written in JAX", lambda x: np.sum(np.asarray(x)), START)
    raises(r"objective must return one real number for x of shape \(2,\)", lambda x: (x[0],), START)
    raises("proposal: mean must be finite in float32", bowl, ([1e300, 0.0], np.float32(1.0)))
    raises(
        "proposal: covariance must be positive, received 0.0", bowl, ([0.0, 0.0], np.float32(1e-50))
    )
    raises("ce_method: elitism must be True or False, received 'no'", bowl, START, elitism="no")
    raises(
        r"schedule: expected a function \(budget, iterations\) -> counts, received",
        bowl,
        START,
        schedule=lambda budget: (budget,),
    )
    unit = np.broadcast_to(np.eye(2), (2, 2, 2))
    for message, mixture in {
        r"proposal: weights must be at least 0 and not all 0, received \[-1": (
            [-1, 2],
            np.zeros((2, 2)),
            unit,
        ),
        "proposal: means must be finite": ([0.5, 0.5], np.full((2, 2), np.nan), unit),
        "proposal: covariance must be positive definite": (
            [0.5, 0.5],
            np.zeros((2, 2)),
            np.zeros((2, 2, 2)) + 1,
        ),
        r"proposal: weights must be \[k\], means \[k, d\] and covariances \[k, d, d\], received": (
            [1.0],
            np.zeros((2, 2)),
            unit,
        ),
    }.items():
        raises(message, bowl, ce.Mixture(*mixture), method=ce.ce_mixture)
    raises(
        "ce_mixture: components must be at most the number of elites, 5",
        bowl,
        START,
        method=ce.ce_mixture,
        components=6,
    )
    raises(
        "ce_method: expected settings among .* received warp",
        bowl,
        START,
        warp="rank",
        method=lambda *a, **s: ce.start(a[0], a[2], "ce_method", **s),
    )
    raises(
        r"ce_surrogate: expected settings among .* received components, keep",
        START,
        method=ce.start,
        keep=3,
        components=2,
    )
    raises("start: method must be one of", START, "annealing", method=ce.start)


def test_bad_answers_are_named(key):
    search = ce.start(key, START, samples=4, elites=2, iterations=1)
    x = np.asarray(ce.ask(search))
    with pytest.raises(ValueError, match=r"tell: expected x of shape \(4, 2\) .*received \(3, 2\)"):
        ce.tell(search, x[:3], np.zeros(3))
    for beyond in (np.nan, 1e300 if x.dtype == np.float32 else np.inf):
        with pytest.raises(ValueError, match="tell: x must be finite"):
            ce.tell(search, np.full(x.shape, beyond), np.zeros(4))
    for words in (["a"] * 4, np.full(4, 1j), [1.0, [2.0], 3.0, 4.0]):
        with pytest.raises(ValueError, match="tell: x and values must be arrays of real numbers"):
            ce.tell(search, x, words)
    search = ce.tell(search, x, np.zeros(4))
    for call in (lambda: ce.ask(search), lambda: ce.tell(search, x, np.zeros(4))):
        with pytest.raises(ValueError, match="the search is over: all 4 evaluations are spent"):
            call()


# ---- what is printed, and scores


@pytest.mark.slow
def test_a_result_prints_as_a_table(key):
    result = ce.ce_method(key, bowl, START, samples=4, elites=3, iterations=3)
    lines = str(result).splitlines()
    assert lines[0].split() == ["iteration", "evaluations", "best", "value", "at"]
    assert [line.split()[1] for line in lines[1:]] == ["4", "8", "12"]
    assert float(lines[-1].split()[2]) == pytest.approx(float(result.best_value), rel=1e-5)
    search = ce.start(key, START, "ce_method", samples=4, elites=3, iterations=3)
    assert str(ce.finish(search)).splitlines() == lines[:1]  # nothing done, nothing told
    search = ce.tell(search, x := np.asarray(ce.ask(search)), [np_bowl(row) for row in x])
    assert len(str(ce.finish(search)).splitlines()) == 2
    several = batch(
        "ce_method", bowl, jax.random.split(key, 5), *START, samples=4, elites=3, iterations=3
    )
    value = np.asarray(several.best_value, float)
    assert (
        str(several) == f"5 runs of 12 evaluations: best value {value.mean():.6g} +-"
        f" {value.std(ddof=1) / 5**0.5:.2g} (mean and its standard error), the best of them"
        f" {value.min():.6g}"
    )


def test_scores(key):
    runs = batch(
        "ce_method", bowl, jax.random.split(key, 8), *START, samples=4, elites=3, iterations=3
    )
    s = ce.scores(runs, [1.0, 1.0])
    x, value = np.asarray(runs.history.best_x, float), np.asarray(runs.history.best_value, float)
    far = np.linalg.norm(x - 1, axis=2)
    np.testing.assert_allclose(s.best_value, value.mean(0))
    np.testing.assert_allclose(s.standard_error, [np.std(v, ddof=1) / np.sqrt(8) for v in value.T])
    np.testing.assert_allclose(s.mean_distance, far.mean(0))
    np.testing.assert_allclose(
        s.frobenius, [np.linalg.norm(x[:, k] - 1) * np.sqrt(50 / 8) for k in range(3)]
    )
    np.testing.assert_allclose(s.rms_distance, s.frobenius / np.sqrt(50))
    with pytest.raises(ValueError, match=r"scores: result must be a batch of runs"):
        ce.scores(jax.tree.map(lambda a: a[0], runs), [1.0, 1.0])
    with pytest.raises(ValueError, match=r"scores: optimum must be \[2\]"):
        ce.scores(runs, [1.0])


# ---- what they reach (thesis, Table 2.1; standard errors of the published means of 50 runs are
# 0.0004 to 0.0007)

# means of 256 runs that `python -m benchmarks.cross_entropy` found on 1A, 1B and 1C, with standard
# errors of 0.0002 to 0.0004
REACHED = {
    ("ce_surrogate", "thesis"): (-0.0178, -0.0114, -0.0144),
    ("ce_mixture", "thesis"): (-0.0165, -0.0082),
    ("ce_surrogate", "default"): (-0.0200, -0.0185, -0.0165),
}


@pytest.mark.long
@pytest.mark.parametrize("method, mode", REACHED)
def test_sierra(method, mode, x64):
    for (case, (mean, variance, samples, elites)), expected in zip(
        CASES.items(), REACHED[method, mode], strict=False
    ):
        keys = jax.random.split(jax.random.key(2024), 128)
        runs = batch(
            method,
            ce.sierra(),
            keys,
            np.full(2, mean),
            variance * np.eye(2),
            samples=samples,
            elites=elites,
            mode=mode,
        )
        s = ce.scores(runs, [0.0, 0.0])
        # the difference of the two means within four of its standard errors, those of 128 and of
        # 256 runs
        assert abs(s.best_value[-1] - expected) < 4 * np.sqrt(1.5) * s.standard_error[-1], (
            case,
            s.best_value[-1],
        )
        if (case, mode) == ("1B", "default"):
            assert s.frobenius[-1] < 16


@pytest.mark.slow
def test_the_plain_method_is_the_published_one(x64):
    for (_, (mean, variance, samples, elites)), (published, slack) in zip(
        CASES.items(), ((-0.0134, 0.001), (-0.0031, 0.0006), (-0.0069, 0.0006)), strict=True
    ):
        keys = jax.random.split(jax.random.key(7), 512)
        runs = batch(
            "ce_method",
            ce.sierra(),
            keys,
            np.full(2, mean),
            variance * np.eye(2),
            samples=samples,
            elites=elites,
            mode="thesis",
        )
        s = ce.scores(runs, [0.0, 0.0])
        assert abs(s.best_value[-1] - published) < slack + 3 * s.standard_error[-1]


@pytest.mark.long
def test_the_default_is_not_for_the_plane_alone(key):
    """In ten dimensions, a rotated ellipsoid of condition 100: far below the plain method, for each
    of 8 seeds (the means differ by more than ten times).
    """
    d = 10
    axes = np.linalg.qr(np.random.default_rng(d).normal(size=(d, d)))[0]
    f = lambda x: jnp.sum(
        jnp.asarray(10 ** (2 * np.arange(d) / (d - 1))) * (jnp.asarray(axes) @ (x - 1)) ** 2
    )
    keys, settings = jax.random.split(key, 8), dict(samples=4 * d, elites=2 * d, iterations=10)
    plain = batch("ce_method", f, keys, np.zeros(d), 9.0, mode="thesis", **settings).best_value
    assert (
        batch("ce_surrogate", f, keys, np.zeros(d), 9.0, **settings).best_value < 0.5 * plain.mean()
    ).all()


def test_mode_thesis_is_the_published_code():
    """The silent choices of the published code, each of which changes little enough on sierra to go
    unseen in a mean.
    """
    published = dict(
        elitism=False,
        memory=3,
        best=0,
        evaluated=0.0,
        current=False,
        warp="raw",
        frame="initial",
        optimism=0.0,
        selection="elites",
        alpha=1.0,
        surrogate="gaussian process",
        kernel="squared exponential",
        basis="gaussian",
        degree=2,
    )
    assert MODES["ce_method"]["thesis"] == dict(elitism=False)
    assert MODES["ce_surrogate"]["thesis"] == published
    assert MODES["ce_mixture"]["thesis"] == published | dict(
        components=None, start="searches", regularisation=0.0
    )
    plan = make_plan(
        "ce_mixture", START, samples=10, elites=5, iterations=10, schedule=None, mode="thesis"
    )[0]
    assert (plan.judged, plan.chosen[0], plan.sub, plan.components) == (100, 50, (100, 10, 2), 5)
    assert inspect.signature(em).parameters["iterations"].default == 10
    assert all(set(modes["thesis"]) == set(modes["default"]) for modes in MODES.values())


@pytest.mark.parametrize("d", [pytest.param(10, marks=pytest.mark.long), 20])
def test_proposals_move_in_many_dimensions(d, key):
    """Ten samples an iteration are fewer than a covariance needs; the judged ones must make up for
    it.
    """
    result = ce.ce_surrogate(key, lambda x: jnp.sum(x**2), (np.ones(d), 1.0), iterations=5)
    steps = np.linalg.norm(np.diff(result.history.proposals.mean, axis=0), axis=1)
    assert (steps > 0).all() and result.best_value < result.history.best_value[0]


@pytest.mark.long
def test_coordinates_of_very_different_size(key):
    """In float32, the units of one coordinate a million times those of the other: as good as with
    equal ones.
    """
    f = lambda scale, x: jnp.sum((x / scale - 1) ** 2 * jnp.array([1.0, 3.0]))
    keys = jax.random.split(key, 16)
    median = lambda scale: np.median(
        batch(
            "ce_surrogate",
            Partial(f, scale),
            keys,
            np.zeros(2),
            np.diag(9 * np.asarray(scale) ** 2),
        ).best_value
    )
    assert median(jnp.array([1e6, 1.0])) < 10 * median(jnp.ones(2))


def test_moments_of_a_mixture():
    """Those of two points a side of 1 with shares 1 and 3, and their own spread."""
    m = Mixture(
        jnp.array([1.0, 3.0]),
        jnp.array([[-1.0, 0.0], [1.0, 2.0]]),
        jnp.stack([jnp.eye(2), 2 * jnp.eye(2)]),
    )
    g = iterate.moments(m)
    np.testing.assert_allclose(g.mean, [0.5, 1.5])
    np.testing.assert_allclose(g.covariance, 1.75 * np.eye(2) + [[0.75, 0.75], [0.75, 0.75]])
    assert iterate.moments(g) is g


def test_a_short_search_returns_the_best_that_it_drew(key):
    drawn = []

    def model(x):
        value = jnp.sum((x - 3.0) ** 2, axis=-1)
        jax.debug.callback(lambda x: drawn.append(np.asarray(x)), x)
        return value

    centres = jnp.array([[0.0, 0.0], [9.0, 9.0]])
    x, value, fitted = iterate.search_around(
        key, model, centres, jnp.eye(2), samples=40, elites=8, iterations=6
    )
    jax.effects_barrier()
    drawn = np.concatenate([d.reshape(-1, 2) for d in drawn])
    assert len(drawn) == 2 * 6 * 40
    for i in range(2):
        np.testing.assert_allclose(value[i], np.sum((np.asarray(x[i]) - 3) ** 2), rtol=1e-5)
    # the searches overlap, so the best of all is the best of one of them
    np.testing.assert_allclose(np.min(value), ((drawn - 3) ** 2).sum(-1).min(), rtol=1e-4)
    away = lambda x: np.linalg.norm(np.asarray(x) - 3.0, axis=-1)
    assert (away(fitted.mean) < away(centres) - 1).all()  # it has moved there


def test_the_frame_of_one_scale():
    frame = iterate._spherical_frame(
        Gaussian(jnp.array([1.0, 2.0, 3.0]), jnp.diag(jnp.array([1.0, 4.0, 7.0])))
    )
    np.testing.assert_allclose(frame[1], 2 * np.eye(3))
    np.testing.assert_array_equal(frame[0], [1, 2, 3])
