"""Which failures are joined by paths, against failure sets of the plane that are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from jast.search.paths import Paths, components


class Plane(Paths):
    """Paths of failures where ``fails`` (points [n, 2]) -> bool [n] says so."""

    def __init__(self, fails, budget=10_000):
        self.budget, self.fails, self.asked = budget, fails, 0

    @property
    def spent(self):
        return self.asked

    def judge(self, points):
        self.asked += len(points)
        return SimpleNamespace(failure=self.fails(points))


def joined(paths, v, n):
    v = np.asarray(v, float)
    owner = components(paths, v, np.ones(len(v), int), (v**2).sum(axis=1) / 2, n)
    return len(set(owner[:n].tolist()))


def around(radius, *degrees):
    """Points at ``radius``."""
    angle = np.radians(degrees)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def dented(points):
    """A ring whose inner edge has a dent at 45 degrees: 3 away from the origin, there 3.31: just
    beyond a tenth of the way, and within a nat.
    """
    norm, angle = np.linalg.norm(points, axis=1), np.arctan2(points[:, 1], points[:, 0])
    return norm >= 3 + 0.31 * (np.abs(np.degrees(angle) - 45) < 10)


def corner(points):
    """Two half-planes, which meet in a corner far out."""
    return (points >= 3).any(axis=1)


def test_a_failure_on_the_way_joins_two_modes():
    ends = around(3.0, 20, 70)
    assert joined(Plane(dented), ends, 2) == 2
    assert joined(Plane(dented), [*ends, *around(3.311, 45)], 2) == 1


def test_a_rare_failure_joins_nothing():
    """The corner is twice as rare, in nats, as the modes beside it."""
    ends = [[3.0, 0.0], [0.0, 3.0]]
    on_the_way = [[3.0, 2.9], [3.0, 3.0], [2.9, 3.0]]
    assert joined(Plane(corner), ends + on_the_way, 2) == 2


def test_opposite_failures_are_never_one_mode():
    assert joined(Plane(lambda points: np.ones(len(points), bool)), around(3.0, 0, 175), 2) == 2


@pytest.mark.parametrize("budget", [0, 100, 1000])
def test_paths_keep_to_their_budget_nearly(budget):
    """Without paths directions decide; a batch may take a little more than is left."""
    paths = Plane(corner, budget)
    many = around(3.0, *range(0, 90, 3))
    found = joined(paths, many, len(many))
    assert paths.spent <= budget + 28 * 64
    assert budget or found == 1  # 3 degrees apart: all alike
