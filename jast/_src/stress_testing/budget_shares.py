"""How a stress test divides its budget: by what is to tell the probability."""

from typing import NamedTuple

from jast._src.core.simulator import Simulator
from jast._src.estimate.failure_probability import MAX_SURROGATE_NUMBERS, MIN_BUDGET
from jast._src.normal_space import transform

__all__ = ["DEFAULT_BUDGET", "BudgetShares", "divided"]

DEFAULT_BUDGET = 200_000  # evaluations by default where populations are not the answer


class BudgetShares(NamedTuple):
    """Of the budget; what is left is for the probability."""

    nominal: float
    search: float
    slow_search: float
    refine: float


LARGE_SHARES = BudgetShares(nominal=0.05, search=0.15, slow_search=0.14, refine=0.18)
"""Where the estimate finds its own proposal."""
SURROGATE_SHARES = BudgetShares(nominal=0.05, search=0.3, slow_search=0, refine=0.35)
"""Where a surrogate tells the probability with few evaluations."""
MOMENTS_SHARES = BudgetShares(nominal=0.05, search=0.2, slow_search=0, refine=0.2)
"""Where the moments of an episode of many numbers tell it with few evaluations."""
COUNTING_SHARES = BudgetShares(nominal=0.125, search=0.35, slow_search=0.2, refine=0.325)
"""Where only plain draws tell it."""


def divided(sim: Simulator, budget: int, has_points: bool) -> BudgetShares:
    """The evaluations of each part; ``has_points``: whether disturbances have quantiles."""
    shares = COUNTING_SHARES
    if has_points:
        many_numbers = transform.dimension(sim) > MAX_SURROGATE_NUMBERS
        few = MOMENTS_SHARES if many_numbers else SURROGATE_SHARES
        large = (1 - sum(LARGE_SHARES)) * budget >= MIN_BUDGET
        shares = LARGE_SHARES if large else few
    # what populations do not answer gains little from more
    return BudgetShares(*(int(share * min(budget, DEFAULT_BUDGET)) for share in shares))
