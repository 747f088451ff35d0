"""Between two rounds of trees: heads are made, and learn from the statistics of the trees that are
finished.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import distributions as D
from jast._src.core.contract import contract, first_line
from jast._src.core.signature import ask, signature_of
from jast._src.core.simulator import Simulator
from jast._src.heads.heads import (
    Heads,
    Moments,
    observation,
    policy_logits,
    predicted_value,
    update_moments,
)
from jast._src.heads.networks import make_head
from jast._src.heads.samples import Samples, samples_of_edges, samples_of_episodes, samples_of_roots
from jast._src.heads.train_head import HeadState, init_head, train_head
from jast._src.runtime._jax import is_traced
from jast._src.util.checks import wrong
from jast._src.util.pytrees import count_numbers, index_tree, shapes_text

__all__ = ["HeadTraining", "init_heads", "train_heads", "with_moments"]


class HeadTraining(NamedTuple):
    """Heads, and where their training stands."""

    heads: Heads
    policy: HeadState | None
    value: HeadState | None
    lessons: tuple[dict, ...] = ()
    """Of each round, name of the head -> `Lesson`."""


def init_heads(key, sim, actions, heads, settings):
    """The `HeadTraining` of ``heads``: "rollout", "value" or "both" to be made, or `Heads` to be
    trained further. ValueError where they do not fit the simulator.
    """
    n, d = count_inputs(sim, actions, heads)
    start = sim.init(D.sample(sim.start(), key))
    seen = observation(sim, start)
    if not is_traced(seen) and not bool(jnp.all(jnp.isfinite(seen))):
        raise ValueError(
            "observe: must return finite numbers where heads learn from them, received"
            f" {np.asarray(seen)} at the start"
        )
    if isinstance(heads, str):
        keys = jax.random.split(key)

        def make(i, inputs, outputs):
            shape = dict(hidden=settings.hidden, activation=settings.activation[i])
            first = settings.first_activation
            return make_head(keys[i], inputs, outputs, **shape, first_activation=first)

        policy = make(0, n, (d, settings.bins)) if heads in ("rollout", "both") else None
        heads = Heads(policy, make(1, n + d, ()) if heads in ("value", "both") else None)
    heads = with_moments(heads, n, d)
    _check_outputs(heads, n, d)
    both = heads.policy, heads.value
    return HeadTraining(heads, *(head and init_head(head.params) for head in both))


def count_inputs(sim: Simulator, actions: Any, heads: str | Heads) -> tuple[int, int]:
    """The numbers that ``observe`` gives and that a disturbance has; ValueError where heads cannot
    serve.
    """
    if not isinstance(heads, Heads) and heads not in ("rollout", "value", "both"):
        must = 'be None, "rollout", "value", "both" or jast.heads.Heads'
        raise wrong("forest", "heads", must, f"{heads!r}")
    if isinstance(heads, Heads) and heads.policy is None and heads.value is None:
        raise wrong("forest", "heads", "have a policy or a value head", "Heads(None, None)")

    if heads in ("rollout", "both") if isinstance(heads, str) else heads.policy is not None:
        try:
            ask(sim, lambda _, state, p: actions.locate(D.sample(p, jax.random.key(0)), p))
        except ValueError as e:
            raise ValueError(
                "forest: a rollout head needs disturbances with a distribution function; use"
                f' heads="value", or actions.uniform: {e}'
            ) from e
    signature = signature_of(sim)
    if signature.observation is None:
        contract("forest", sim, observed=math.inf)  # raises: it says what is wrong with observe
    return math.prod(signature.observation), count_numbers(signature.x)


def with_moments(heads: Heads, n: int, d: int) -> Heads:
    """``heads`` with moments that leave everything as it is, where there are none."""
    inputs = Moments.empty(n + d) if heads.inputs is None else heads.inputs
    if inputs.mean.shape != (n + d,):
        must = f"take {n + d} numbers ({n} observed, {d} of the disturbance)"
        raise wrong("forest", "heads", must, f"heads that take {inputs.mean.shape[0]}")
    returns = Moments.empty() if heads.returns is None else heads.returns
    return dataclasses.replace(heads, inputs=inputs, returns=returns)


def _check_outputs(heads, n, d):
    """ValueError unless the heads return what they must."""
    seen, x = jnp.zeros((n,), jnp.float32), jnp.zeros((d,), jnp.float32)
    logits = f"logits of shape ({d}, bins), bins at least 2"
    for name, takes, wanted, run in (
        ("policy", n, logits, lambda: policy_logits(heads, seen)),
        ("value", n + d, "a scalar", lambda: predicted_value(heads, seen, x)),
    ):
        if getattr(heads, name) is None:
            continue
        try:
            out = jax.eval_shape(run)
        except Exception as e:  # of whatever framework
            raise ValueError(
                f"heads: the {name} head's apply(params, x) failed on x of shape ({takes},)"
                f" float32: {first_line(e)}"
            ) from e
        shape = getattr(out, "shape", None)
        fits = shape is not None and (
            len(shape) == 2 and shape[0] == d and shape[1] >= 2 if name == "policy" else shape == ()
        )
        if not fits or not jnp.issubdtype(out.dtype, jnp.floating):
            raise ValueError(
                f"heads: the {name} head returned {shapes_text(out)}, expected {wanted}"
            )


def train_heads(key, training, sim, actions, settings, batches):
    """The `HeadTraining` after learning from a round's ``batches`` of trees, which have ``log``,
    ``roots``, ``found`` and, for ``settings.edges="all"``, ``edges``.

    A head whose loss or parameters come out NaN or infinite keeps those from before, and the
    `Lesson` says so.
    """
    heads = training.heads
    shares, edges = _samples(heads, sim, actions, settings, batches)
    inputs, returns = heads.inputs, heads.returns
    if settings.normalise:
        inputs = update_moments(inputs, np.concatenate([edges.seen, edges.x], axis=1))
        returns = update_moments(returns, edges.target)
    observed = inputs.first(edges.seen.shape[1]), Moments.empty()
    work = (settings.loss, observed, shares), ("squared", (inputs, returns), edges)
    keys, new, trained, lesson = jax.random.split(key), {}, {}, {}
    for i, name in enumerate(("policy", "value")):
        head, state = getattr(heads, name), getattr(training, name)
        alone = name == "value" and heads.policy is None
        if head is not None and not (alone and settings.untrained_alone):
            loss, moments, samples = work[i]
            state, lesson[name] = train_head(
                keys[i],
                state,
                head.apply,
                moments,
                samples,
                loss=loss,
                rate=settings.learning_rate[i],
                batch=settings.batch[i],
                steps=settings.steps[i],
                capacity=settings.replay[i],
            )
        trained[name] = state
        new[name] = state and head._replace(params=state.params)
    levels = heads.levels
    if any(of.steps > 0 and not of.rejected for of in lesson.values()):
        deepest = sim.horizon
        if not settings.episodes:
            deepest = max(int(np.where(b.roots.valid, b.roots.depth, 0).max()) for b in batches)
        levels = max(levels, deepest + 1)
    heads = Heads(**new, inputs=inputs, returns=returns, levels=levels)
    return HeadTraining(heads, **trained, lessons=(*training.lessons, lesson))


def _samples(heads, sim, actions, settings, batches):
    """What the policy head (None without one) and the value head learn from."""
    signature = signature_of(sim)
    n, first = heads.inputs.mean.shape[0] - count_numbers(signature.x), int(signature.random_start)
    bins = None
    if heads.policy is not None:
        seen = jnp.zeros((n,), jnp.float32)
        bins = jax.eval_shape(lambda: policy_logits(heads, seen)).shape[1]
    good = list(zip(batches, best_trees(batches, settings.elite), strict=True))
    pairs = [samples_of_roots(sim, actions, b.roots, bins, g, first) for b, g in good]
    shares, edges = map(list, zip(*pairs, strict=True))
    if heads.policy is not None and settings.episodes:
        for b, g in good:
            # the best episode of each tree stands first
            best = index_tree(b.found, np.s_[: len(g)])
            shares.append(samples_of_episodes(sim, actions, best, bins, g))
    if heads.value is not None and settings.edges == "all":
        edges = [samples_of_edges(b.edges, settings.target) for b in batches]
    return None if heads.policy is None else Samples.joined(shares), Samples.joined(edges)


def best_trees(batches, share):
    """Of each batch, [B] bool: the trees among this ``share`` of all by the reward of their best
    episode.
    """
    best = [np.where(np.isfinite(b.log), b.log, -np.inf).max(0) for b in batches]
    least = np.quantile(np.concatenate(best), 1 - share, method="lower")
    return [rewards >= least for rewards in best]
