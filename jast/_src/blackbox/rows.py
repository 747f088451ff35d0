"""Rows of a black box, episodes or transitions: what a `worker.Runner` knows of them, and what it
answers. Goes to the workers by value: NumPy and the standard library only.
"""

from typing import NamedTuple

import numpy as np

__all__ = ["FAILED", "Reply", "Spec", "blank", "fill", "history"]

FAILED = (False, np.nan, True, 0.0, 0.0)  # event, distance, terminal, log p and what is seen


class Spec(NamedTuple):
    """What a `Runner` knows beside the system."""

    run: bool
    """The system is a function of whole episodes, not a class"""
    episodic: bool
    horizon: int
    x0: object
    """The structure of x0, with the place of each leaf"""
    random: bool
    """x0 is given to the system"""
    limit: float | None
    """Seconds"""
    tells: str | None = None
    """What the system says of the probability of its disturbances: "log_prob" or "prob"; "maybe",
    log p where it says a number; None: nothing that counts
    """


class Reply(NamedTuple):
    """The outcome of n rows."""

    event: np.ndarray
    """[n] bool"""
    distance: np.ndarray
    """[n] float64; NaN where something went wrong"""
    terminal: np.ndarray
    """[n] bool"""
    log_p: np.ndarray
    """[n] float64: what the system said of the last disturbance; of the whole episode where
    episodic; 0 where it said nothing
    """
    seen: np.ndarray
    """[n, k] float64: what ``observe`` returned"""
    problems: list
    """(row, kind, message)"""
    episodes: int = 0
    """Starts of the system"""
    transitions: int = 0
    seconds: float = 0.0


def fill(structure, leaves):
    """The tree of ``structure``, whose leaves are places in ``leaves``."""
    if isinstance(structure, dict):
        return {k: fill(v, leaves) for k, v in structure.items()}
    if isinstance(structure, tuple | list):
        parts = [fill(v, leaves) for v in structure]
        return type(structure)(*parts) if hasattr(structure, "_fields") else type(structure)(parts)
    return None if structure is None else leaves[structure]


def blank(n, size):
    """Event, distance, terminal, log p and observation of n rows that have no answer yet."""
    no = np.zeros(n, bool)
    return no, np.full(n, np.nan), no.copy(), np.zeros(n), np.zeros((n, size))


def history(x0, xs, t):
    """What tells episodes of ``t`` disturbances apart."""
    return t, *(a.tobytes() for a in x0), *(a[:t].tobytes() for a in xs)
