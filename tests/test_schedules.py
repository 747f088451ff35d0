import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jast.cross_entropy import schedules

# of the published code, by the era of its library (reference section 3): (p, normaliser, budget)
TABLE = {
    (0.1, "before", 100): (15, 13, 12, 11, 10, 9, 8, 7, 6, 9),
    (0.2, "before", 100): (22, 17, 14, 11, 9, 7, 5, 4, 3, 8),
    (0.3, "before", 100): (30, 21, 15, 10, 7, 5, 3, 2, 1, 6),
    (0.3, "before", 50): (15, 10, 7, 5, 3, 2, 1, 1, 0, 6),
    (0.1, "after", 100): (13, 11, 10, 9, 8, 7, 6, 6, 5, 25),
    (0.2, "after", 100): (17, 14, 11, 8, 7, 5, 4, 3, 2, 29),
    (0.3, "after", 100): (21, 14, 10, 7, 5, 3, 2, 1, 1, 36),
    (0.3, "after", 50): (10, 7, 5, 3, 2, 1, 1, 0, 0, 21),
}


@pytest.mark.parametrize("p, normaliser, budget", list(TABLE))
def test_geometric_is_the_published_one(p, normaliser, budget):
    expected = TABLE[p, normaliser, budget]
    assert sum(expected) == budget
    assert schedules.geometric(p, normaliser)(budget, 10) == expected
    assert schedules.counts(schedules.geometric(p, normaliser), budget // 10, 10) == expected


def test_defaults():
    assert schedules.geometric()(100, 10) == TABLE[0.1, "before", 100]
    assert (
        schedules.counts(None, 10, 3)
        == schedules.counts("uniform", 10, 3)
        == schedules.counts(schedules.uniform(), 10, 3)
        == (10, 10, 10)
    )
    assert schedules.uniform()(10, 4) == (3, 3, 2, 2)


@settings(deadline=None)
@given(
    budget=st.integers(1, 5000),
    iterations=st.integers(1, 60),
    p=st.floats(1e-6, 1 - 1e-6),
    normaliser=st.sampled_from(["before", "after"]),
)
def test_a_schedule_spends_its_budget(budget, iterations, p, normaliser):
    for schedule in (schedules.uniform(), schedules.geometric(p, normaliser)):
        sizes = schedule(budget, iterations)
        assert len(sizes) == iterations
        assert sum(sizes) == budget
        assert min(sizes) >= 0
        assert all(type(n) is int for n in sizes)
        assert list(sizes[:-1]) == sorted(sizes[:-1], reverse=True)


@settings(deadline=None)
@given(budget=st.integers(1, 1000), iterations=st.integers(2, 30), p=st.floats(0.01, 0.9))
def test_geometric_before_and_after(budget, iterations, p):
    """Each share is the floor of the budget times its probability; the last one of "before" makes
    up for the floors alone.
    """
    k = np.arange(1, iterations + 1)
    for normaliser, start in (("before", 1), ("after", 0)):
        total = sum(p * (1 - p) ** j for j in range(start, iterations + 1))
        exact = budget * p * (1 - p) ** k / total
        sizes = schedules.geometric(p, normaliser)(budget, iterations)
        assert (np.abs(np.array(sizes[:-1]) - (exact[:-1] - 0.5)) <= 0.5 + 1e-6).all()
        if normaliser == "before":
            assert exact[-1] - 1e-6 <= sizes[-1] <= exact[-1] + iterations - 1 + 1e-6


def test_whole_shares_are_not_rounded_down():
    # 7 iterations "before" with p = 1/2: pmf 64/127, 32/127, ...
    assert schedules.geometric(0.5)(127, 7) == (64, 32, 16, 8, 4, 2, 1)
    assert schedules.geometric(0.5)(127 * 9, 7) == tuple(9 * 2**i for i in range(6, -1, -1))
    assert schedules.geometric(0.5, "after")(255, 7) == (64, 32, 16, 8, 4, 2, 129)


def test_one_iteration_gets_all():
    for schedule in (
        schedules.uniform(),
        schedules.geometric(),
        schedules.geometric(0.3, "after"),
        schedules.manual([12]),
    ):
        assert schedule(12, 1) == (12,)


def test_manual():
    published = (20, 15, 9, *[8] * 7)
    assert schedules.manual(published)(100, 10) == published
    assert schedules.counts(schedules.manual(np.array(published)), 10, 10) == published
    assert (
        schedules.counts(list(published), 3, 2)
        == schedules.counts(np.array(published), 3, 2)
        == published
    )  # they say themselves how many
    for budget, iterations in ((99, 10), (100, 9)):
        with pytest.raises(
            ValueError,
            match=f"expected {iterations} counts .* {budget}, received 10 that sum to 100",
        ):
            schedules.manual(published)(budget, iterations)


def test_a_function_of_the_users_own():
    assert schedules.counts(lambda budget, iterations: [budget] + [0] * (iterations - 1), 5, 3) == (
        15,
        0,
        0,
    )
    with pytest.raises(
        ValueError, match="schedule: expected 3 counts .*, received 3 that sum to 12"
    ):
        schedules.counts(lambda budget, iterations: (4,) * iterations, 5, 3)
    with pytest.raises(
        ValueError, match="schedule: expected 3 counts .*, received 2 that sum to 15"
    ):
        schedules.counts(lambda budget, iterations: (10, 5), 5, 3)
    with pytest.raises(ValueError, match="schedule: counts must .*received 7"):
        schedules.counts(lambda budget, iterations: 7, 5, 3)


@pytest.mark.parametrize("given", [(), (0, 0), (3, -1), (1.0, 2), (True, 2), 7, object()])
def test_bad_counts(given):
    with pytest.raises(ValueError, match="schedule: counts must be whole numbers"):
        schedules.counts(given, 10, 10)
    with pytest.raises(ValueError, match="schedule: counts must be"):
        schedules.manual(given)


def test_bad_settings():
    with pytest.raises(ValueError, match="schedule: expected None, .*, received 'geometric'"):
        schedules.counts("geometric", 10, 10)
    for samples in (0, -1, 2.0, True, None):
        with pytest.raises(
            ValueError, match=f"samples must be a whole number of at least 1, received {samples}"
        ):
            schedules.counts(None, samples, 10)
        with pytest.raises(
            ValueError, match=f"iterations must be a whole number of at least 1, received {samples}"
        ):
            schedules.counts(None, 10, samples)
    for p in (0, 1, -0.1, np.nan, "half", True):
        with pytest.raises(
            ValueError, match="geometric: p must be a number between 0 and 1, received"
        ):
            schedules.geometric(p)
    with pytest.raises(ValueError, match="geometric: normaliser must .*received None"):
        schedules.geometric(normaliser=None)
