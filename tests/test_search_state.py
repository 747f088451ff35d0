"""What a search knows: weights by all batches, and what a proposal promises."""

import ast
import inspect

import jax
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from jast._src.estimate.gaussians.family import GaussianFamily, Points
from jast._src.estimate.gaussians.mixture_fit import as_latent, unit_gaussians
from jast._src.estimate.proposal_search import settings
from jast._src.estimate.proposal_search.adapt import adapt_proposal
from jast._src.estimate.proposal_search.search_state import (
    SearchState,
    add_batch,
    efficiency,
    failure_log_ratios,
    is_efficient,
    search_context,
)
from jast._src.estimate.proposal_search.settings import SETTINGS
from jast._src.estimate.tilts.family import TiltFamily
from jast._src.estimate.tilts.tilts import simulate_points
from jast._src.util.pytrees import index_tree
from jast.simulators import limit_state, ruin

D, BETA = 3, 3.0


def _first(z):
    return BETA - z[0]


@pytest.fixture
def family(key):
    """Failures where the first of three numbers is above 3, by batches of 4000."""
    return GaussianFamily(limit_state(_first, D), 100_000, search_context(key))


def at(family, mean):
    """A unit Gaussian around ``mean`` in the first number."""
    return as_latent([(1.0, unit_gaussians(np.array([[mean, 0.0, 0.0]])))], family.dtype)


def searched(family, *means):
    state = SearchState()
    for mean in means:
        state = add_batch(family, state, family.draw(at(family, mean)))
    return state


def test_failures_are_weighted_by_all_proposals(family):
    """p over the mean density of the proposals, each by its share of the episodes (Veach and Guibas
    1995), by SciPy; and the probability by these within 4 of its standard errors.
    """
    state = searched(family, 3.0, 2.0, 3.5)
    z = np.concatenate([b.points.z for b in state.batches]).astype(float)
    density = lambda m: multivariate_normal([m, 0, 0]).pdf(z)
    expected = density(0.0) / np.mean([density(m) for m in (3.0, 2.0, 3.5)], axis=0)
    np.testing.assert_allclose(np.exp(state.log_weight), expected, rtol=1e-4)
    error = np.sqrt((expected**2).sum()) / expected.sum()
    assert abs(state.log_mean - norm.logsf(BETA)) < 4 * error < 0.1
    assert state.size == 3 * family.batch and len(state.log_weight) == len(z)


def test_a_proposal_promises_what_its_draws_are_worth(family):
    """Effective draws of a draw of N(m, 1): P^2 over E_q[w^2] = e^(m^2) Phi(-3 - m); and the one
    that promises most is the proposal.
    """
    state = searched(family, 3.0, 2.0)
    for mean in (3.0, 2.0, 2.5):
        true = norm.sf(BETA) ** 2 / (np.exp(mean**2) * norm.sf(BETA + mean))
        said = efficiency(state, failure_log_ratios(family, state, at(family, mean)))
        assert said == pytest.approx(true, rel=0.1)
    assert state.q is state.batches[0].q
    assert is_efficient(state, 0.2) and not is_efficient(state, 0.5)


def test_the_model_itself_does_not_serve(key):
    """Its draws are worth what plain draws are."""
    family = GaussianFamily(limit_state(_half, D), 100_000, search_context(key))
    state = add_batch(family, SearchState(), family.draw(family.model()))
    assert state.efficiency == pytest.approx(0.5, abs=0.04) and not is_efficient(state, 0.0)


def _half(z):
    return z[0]


def test_a_batch_without_failures_changes_the_weights_alone(family):
    """It counts among the episodes."""
    one = searched(family, 3.0)
    two = add_batch(family, one, family.draw(at(family, -3.0)))
    assert len(two.log_weight) == len(one.log_weight) and two.q is one.q
    assert two.size == 2 * one.size
    # its density at these failures is next to nothing, so that half of the weight stays
    np.testing.assert_allclose(two.log_weight - one.log_weight, np.log(2), atol=1e-3)
    assert two.log_mean == pytest.approx(one.log_mean, abs=1e-3)


def test_adapting_ends_where_nothing_fails(family):
    start = SearchState(q=at(family, -5.0))
    state = adapt_proposal(family, start, 5, np.inf)
    assert state.spent == family.batch and state.history[-1].startswith("Gaussians: no failure")


def test_adapting_keeps_to_its_end(family):
    start = SearchState(q=at(family, 3.0))
    assert adapt_proposal(family, start, 8, family.batch - 1) == start
    state = adapt_proposal(family, start, 8, 2 * family.batch)
    assert state.spent <= 2 * family.batch and state.efficiency > 0.1


def test_a_state_goes_on_to_another_family(family):
    state = searched(family, 3.0).note("a", 7).with_reason("b")._replace(plain=(1, 2, 3))
    new = state.for_next_family()
    assert new.spent == 7
    assert new.history == ("a, 7 evaluations",)
    assert new.plain == (1, 2, 3)
    assert new.q is None
    assert not new.batches
    assert not new.reasons


@pytest.mark.parametrize("kind", [GaussianFamily, TiltFamily])
def test_families_agree_with_themselves(kind, key):
    """The weights of a batch are the densities of its points, and points that are found again have
    them too.
    """
    sim = ruin(goal=5, horizon=12) if kind is TiltFamily else limit_state(_first, D)
    f = kind(sim, 10_000, search_context(key))
    q = f.untilted() if kind is TiltFamily else at(f, 3.0)
    b = f.draw(q)
    assert len(b.log_weight) > 20
    np.testing.assert_allclose(f.log_ratio(q, b.points), -b.log_weight, atol=1e-4)
    some = index_tree(b.points, np.arange(5))
    np.testing.assert_allclose(f.log_ratio(q, some), -b.log_weight[:5], atol=1e-4)


def test_points_of_tilts_are_played_again(key):
    """Those that fail, and what that costs."""
    f = TiltFamily(ruin(goal=4, horizon=8), 10_000, search_context(key))
    z = np.random.default_rng(0).standard_normal((300, 8)).astype(np.float32)
    state, points = f.as_points(SearchState(), z, None)
    o, *_ = simulate_points(f.sim, f.on_device(f.untilted()), z)
    assert state.spent == 300 and len(points.length) == o.failure.sum() > 10
    np.testing.assert_array_equal(points.length, np.asarray(o.length)[np.asarray(o.failure)])
    gaussians = GaussianFamily(f.sim, 10_000, search_context(key))
    state, same = gaussians.as_points(SearchState(), z, z[:, 0])
    assert state.spent == 0
    assert isinstance(same, Points)
    assert len(same.z) == 300


def test_every_number_of_the_search_has_its_reason():
    """A string under each field."""
    [body] = [
        n.body for n in ast.parse(inspect.getsource(settings)).body if isinstance(n, ast.ClassDef)
    ]
    fields = [i for i, n in enumerate(body) if isinstance(n, ast.AnnAssign)]
    assert len(fields) == len(SETTINGS)
    told = lambda n: isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)
    assert all(told(body[i + 1]) and len(body[i + 1].value.value) > 12 for i in fields)


def test_a_search_draws_from_its_key_alone(key):
    one, two = (search_context(key) for _ in range(2))
    data = lambda k: jax.random.key_data(k).tolist()
    assert [data(one.next_key()) for _ in range(2)] == [data(two.next_key()) for _ in range(2)]
    assert one.rng.random() == two.rng.random() and not one.latest
