"""What rules and monitors learn from: episodes of known kinds, given by the user or simulated."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jast._src.core.episode import Episode
from jast._src.core.simulator import Simulator
from jast._src.explain.episodes import distinct_rows, gather_episodes, named_kinds
from jast._src.explain.held_out import DISTINCT
from jast._src.explain.variants import EACH, draw_variants, find_seeds
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.pytrees import index_tree, join_rows

__all__ = ["given_cases", "simulate_cases"]

OTHERS = "does not fail"  # what the others are called
HOSTED_BUDGET = 3000  # evaluations of a black box by default
DRAWS = 4  # of an estimate, that are looked at for each episode wanted


class Cases(NamedTuple):
    """Episodes [n], failures first."""

    episodes: Episode
    kind: np.ndarray
    """[n] int: 0 does not fail, else a kind of failure."""
    group: np.ndarray
    """[n] int: what is held out together."""
    names: tuple
    """Of the kinds."""
    evaluations: int
    asked: int = 0
    """Failures that were to be simulated."""


def simulate_cases(
    function: str,
    key: jax.Array,
    sim: Simulator,
    failures: Any,
    labels: Sequence | None,
    episodes: int,
    most: int | None = None,
    budget: int | None = None,
    after: int = 0,
) -> Cases:
    """Variants of ``failures``: ``episodes`` that fail and at most ``most`` near misses; fewer
    where the ``budget`` affords no more, of which each takes ``after`` evaluations afterwards.
    """
    seeds = find_seeds(function, sim, failures, labels, DRAWS * episodes)
    if budget is None and runs_on_host(sim):
        budget = HOSTED_BUDGET
    if budget is not None:
        # one run of a black box is made twice
        each, spent = EACH + after, seeds.evaluations + 1
        episodes = min(episodes, (budget - spent) // each)
        if episodes < 2 * DISTINCT:
            raise ValueError(
                f"{function}: budget must be at least {spent + 2 * DISTINCT * each}, {each}"
                f" evaluations for each of {2 * DISTINCT} failures, received {budget}"
            )
    e, kind, group, cost = draw_variants(key, sim, seeds, episodes)
    failing = np.count_nonzero(kind)
    if failing < 2 * DISTINCT:
        raise ValueError(
            f"{function}: failures must be such that small changes of them still fail, received"
            f" ones of which {failing} of {episodes} changed episodes fail"
        )
    near = len(kind) - failing
    near = near if most is None else min(most, near)
    if near < 2 * DISTINCT:
        raise ValueError(
            f"{function}: others: expected {2 * DISTINCT} or more changed failures that no longer"
            f" fail, received {near}: nearly everything fails"
        )
    n = failing + near
    return Cases(
        episodes=index_tree(e, np.s_[:n]),
        kind=kind[:n],
        group=group[:n],
        names=(OTHERS, *seeds.names),
        evaluations=seeds.evaluations + cost,
        asked=episodes,
    )


def given_cases(
    function: str, sim: Simulator, failures: Any, others: Any, labels: Sequence | None, least: int
) -> Cases:
    """The episodes that the user has, each once; ``least`` or more of each kind."""
    parts, kind, names = [], [], ("fails",)
    for argument, given, wanted in (("failures", failures, True), ("others", others, False)):
        e = gather_episodes(function, argument, sim, given)
        if wrong := int((e.failure != wanted).sum()):
            raise ValueError(
                f"{function}: {argument} must {'all' if wanted else 'not'} fail, received"
                f" {len(e.length)} episodes, of which {wrong} do{' not' if wanted else ''}"
            )
        each = np.full(len(e.length), int(wanted))
        if wanted and labels is not None:
            names, each = named_kinds(function, labels, len(e.length))
            each = each + 1
        rows = distinct_rows(e)
        parts.append(index_tree(e, rows))
        kind.append(each[rows])
        few = min((int(np.sum(kind[-1] == k)) for k in np.unique(each)), default=0)
        if few < least:
            raise ValueError(
                f"{function}: {argument} must hold at least {least} distinct episodes of each"
                f" kind, received {few}; leave others out and {function} simulates more"
            )
    e = join_rows(*parts)
    owner = np.concatenate(kind)
    return Cases(
        episodes=e, kind=owner, group=np.arange(len(owner)), names=(OTHERS, *names), evaluations=0
    )
