"""How what draws failures was learned: the training of a policy, and the levels of a proposal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jast._src.plot import style
from jast._src.plot.style import Axes
from jast.estimate import FailureProposal
from jast.policies import FailurePolicy

__all__ = ["levels", "training"]


def training(
    policies: FailurePolicy | dict[str, FailurePolicy], axes: Sequence[Axes] | None = None
) -> list[Axes]:
    """The training of a failure policy over its episodes: the share of them that fail, and the mean
    log p of those in the latent numbers, relative to the mode, a panel each.

    Args:
        policies: of `jast.policies.sac` or `ppo`, or a dict of name -> policy.
        axes: two, to draw into.

    Raises:
        ValueError: for what is no failure policy, and for too few axes.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.walk1d()
        >>> small = dict(episodes=32, lanes=4, hidden=(8,), batch=16, updates=1)
        >>> len(jast.plot.training(jast.policies.sac(jax.random.key(0), sim, **small)))
        2
    """
    policies = style.by_name(policies)
    words = "a FailurePolicy or a dict of name -> one"
    style.checked_kinds("training", "policies", policies.values(), FailurePolicy, words)
    with style.panels("training", axes, (6.8, 5.4), 2, "quantity") as axes:
        share, log_p = axes
        for i, (name, policy) in enumerate(policies.items()):
            h, look = policy.history, dict(color=style.colour(i), label=name)
            share.plot(h.episodes, h.failing_share, **look)
            log_p.plot(h.episodes, h.log_p, **look)  # NaN where none failed: not drawn
        share.set(ylabel="share that fails", ylim=(0, None))
        log_p.set(ylabel="mean log p of failures", xlabel="episodes")
        share.figure.align_ylabels(axes)
        _legend(share, policies)
    return axes


def levels(proposals: FailureProposal | dict[str, FailureProposal], ax: Axes | None = None) -> Axes:
    """The miss distance that the elites of each iteration of `jast.estimate.failure_proposal`
    reached; 0 is a failure.

    Args:
        proposals: one run, or a dict of name -> run.
        ax: to draw into.

    Raises:
        ValueError: for what is no such result, and a batch of runs.

    Example:
        >>> import jax, jast
        >>> sim = jast.simulators.landing()
        >>> found = jast.estimate.failure_proposal(jax.random.key(0), sim, samples=200)
        >>> ax = jast.plot.levels(found)
    """
    proposals = style.by_name(proposals)
    words = "a FailureProposal or a dict of name -> one"
    style.checked_kinds("levels", "proposals", proposals.values(), FailureProposal, words)
    with style.axes(ax, (6.8, 3.8)) as ax:
        for i, (name, found) in enumerate(proposals.items()):
            reached = np.asarray(found.levels, float)
            if reached.ndim != 1:
                raise style.wrong("levels", "proposals", "be one run each", reached.shape[:-1])
            at = np.arange(1, len(reached) + 1)
            look = dict(color=style.colour(i), marker=style.marker(i))
            ax.plot(at, np.where(np.isfinite(reached), reached, np.nan), label=name, **look)
        ax.set(xlabel="iteration", ylabel="miss distance of the elites", ylim=(0, None))
        style.whole_steps(ax.xaxis)
        _legend(ax, proposals)
    return ax


def _legend(ax: Any, named: dict) -> None:
    if set(named) != {""}:
        style.legend_above(ax)
