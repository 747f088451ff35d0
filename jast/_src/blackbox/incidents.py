"""incidents: what went wrong in the host code behind a simulator."""

from __future__ import annotations

import jax

from jast._src.core.simulator import Simulator, require_simulator
from jast._src.runtime import host_errors

__all__ = ["incidents"]


def incidents(sim: Simulator) -> tuple[host_errors.Incident, ...]:
    """What has gone wrong so far in the host code behind a simulator, by kind and message.

    Args:
        sim: the simulator, or what holds one, as a report does.

    Returns:
        A tuple of `Incident`; ``()`` for a simulator in JAX.

    Raises:
        ValueError: for what neither is nor holds one.

    Example:
        >>> import jast
        >>> jast.incidents.incidents(jast.simulators.walk1d())
        ()
    """
    parts = jax.tree.leaves(sim, is_leaf=lambda part: isinstance(part, Simulator))
    if not (host_errors.runs_on_host(sim) or any(isinstance(p, Simulator) for p in parts)):
        require_simulator("incidents", sim)
    return host_errors.incidents(sim)
