"""What `jast.check` asks of black boxes: whether an object plays an episode in the same way again,
whether their miss distances point to failures, and whether failures are lost where only the end of
an episode is judged.
"""

import warnings
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jast import distributions as D
from jast._src.core.simulator import Simulator, first_state, next_state
from jast._src.core.typing import ArrayTree
from jast._src.runtime._jax import quick
from jast._src.runtime.host_errors import hosts_of
from jast._src.util.pytrees import select

__all__ = ["check_played_again", "runs_for_objects", "warn_of_lost_failures", "words_on_distances"]

FEWEST = 8  # distances that are equal by more than chance
EPISODES = 16  # half of them drawn from the model, half from its tails, where failures are
TAIL = 0.02  # the probability of both tails together
FIELDS = "event", "distance", "is_terminal", "log p", "what is observed"


def check_played_again(sim: Simulator, x0: ArrayTree) -> None:
    """Have an object play two whole episodes and then the first one again.

    Three runs, four where something differs. Nothing is said where something goes wrong in them.

    Args:
        sim: the simulator.
        x0: the start of the first episode, at whose first state both are drawn.

    Raises:
        ValueError: where the object says something else the second time.
    """
    for host in hosts_of(sim):
        if host.spec.run:
            continue
        found = host.again(*map(jax.tree.leaves, jax.device_get(_draw(sim, x0))))
        if found is None or found[0] == found[2]:
            continue
        first, _, again, anew = found
        if anew == first:
            what = _difference(host, first, again)
            raise ValueError(
                f"initialize: does not reset everything: {what} where the object plays the same"
                " disturbances again, after another episode. What a stress test says of it would be"
                " wrong: initialize brings an object back to its start, whatever it did before"
            )
        what = _difference(host, first, anew)
        raise ValueError(
            f"not deterministic: {what} by a new object: it differs between two runs on the same"
            " input. Randomness belongs in disturbance or start, generators are seeded in"
            " initialize, and nothing is kept outside of the object"
        )


def warn_of_lost_failures(sim: Simulator) -> None:
    """Warn (UserWarning) where episodes of ``sim``, whose objects are judged at the end only, fail
    on the way and no longer at the end.

    Runs `EPISODES` more episodes, looked at after every disturbance. An ``is_event`` that raises
    before the end is not compared.
    """
    for host in hosts_of(sim):
        if host.spec.run or not host.spec.episodic:
            continue
        drawn = jax.device_get(_draw_with_tails(jax.random.key(2), sim))
        if not (lost := host.lost(*map(jax.tree.leaves, drawn))):
            continue
        warnings.warn(
            f"from_python: in {lost} of {EPISODES} episodes is_event() is True during the episode"
            " and False at its end; with episodic=True these do not count as failures. If"
            " is_event says whether the system fails now, leave episodic out: every state is"
            " judged then. If it means something only at the end, all is well",
            stacklevel=3,
        )


def runs_for_objects(sim: Simulator) -> int:
    """How many runs `jast.check` makes of objects beyond those of a function."""
    objects = [host.spec for host in hosts_of(sim) if not host.spec.run]
    return sum(3 + EPISODES * spec.episodic for spec in objects)


def words_on_distances(sim: Simulator) -> Iterator[str]:
    """What the miss distances of all runs so far say against themselves."""
    for host in hosts_of(sim):
        kept = host.answers
        fail, others = (
            [a.distance for a in answers.values() if np.isfinite(a.distance)]
            for answers in (kept.failing, kept.others)
        )
        of = "episodes" if host.spec.episodic else "states"
        if len(others) >= FEWEST and len(set(others)) == 1:
            yield (
                f"the miss distance is {others[0]:g} in all {len(others)} {of} without a failure:"
                " no search can follow it; return a number that falls on the way to a failure"
            )
        elif fail and others and np.median(fail) > np.median(others):
            yield (
                f"the miss distance of {of} that fail is greater than that of others:"
                f" {_range(fail)} against {_range(others)}. Smaller must be nearer to a failure: is"
                " its sign wrong?"
            )


def _range(distances: list[float]) -> str:
    return f"{min(distances):.4g} to {max(distances):.4g}"


def _difference(host: Any, first: list[tuple], again: list[tuple]) -> str:
    """The first difference of two traces of `worker.Runner.again`, in words."""
    t = next(t for t, (a, b) in enumerate(zip(first, again)) if a != b)
    k = next(k for k, (a, b) in enumerate(zip(first[t], again[t])) if a != b)
    a, b = (np.frombuffer(v) if isinstance(v, bytes) else v for v in (first[t][k], again[t][k]))
    return f"at step {host.spec.horizon if host.spec.episodic else t} {FIELDS[k]} is {a}, and {b}"


@quick
def _draw(sim: Simulator, x0: ArrayTree) -> tuple[ArrayTree, ArrayTree]:
    """x0 [2, ...] and disturbances [2, horizon, ...], all drawn as at the first state."""
    key = jax.random.key(3)
    other = D.sample(sim.start(), key)
    starts = jax.tree.map(lambda a, b: jnp.stack([a, jnp.asarray(b, a.dtype)]), x0, other)
    dist = sim.disturbance(first_state(sim, x0))  # which was asked for before: nothing runs
    keys = jax.random.split(key, (2, sim.horizon))
    return starts, jax.vmap(jax.vmap(lambda key: D.sample(dist, key)))(keys)


@jax.jit
def _draw_with_tails(key, sim):
    """x0 [EPISODES, ...] and disturbances [EPISODES, horizon, ...]."""

    def episode(key, wild):
        def choose(key, dist):
            drawn = D.sample(dist, key)
            if not D.has_quantile(dist):
                return drawn
            u = jax.tree.map(
                lambda s: _in_tails(jax.random.uniform(key, s.shape, D.float_dtype(s.dtype))),
                D.event_like(dist),
            )
            return select(wild, D.quantile(dist, u), drawn)

        def step(state, t):
            x = choose(jax.random.fold_in(key, t), sim.disturbance(state))
            return next_state(sim, state, x), x

        x0 = choose(key, sim.start())
        return x0, lax.scan(step, first_state(sim, x0), jnp.arange(1, sim.horizon + 1))[1]

    return jax.vmap(episode)(jax.random.split(key, EPISODES), jnp.arange(EPISODES) >= EPISODES // 2)


def _in_tails(u):
    """``u`` in [0, 1) moved into the tails: below TAIL / 2 or above 1 - TAIL / 2."""
    return jnp.where(u < 0.5, TAIL * u, 1 - TAIL * (1 - u))
