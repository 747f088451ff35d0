"""Between two rounds of trees: heads are made, and learn from the statistics of the trees that are
finished.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jast import distributions as D
from jast._jax import is_traced
from jast.contract import contract
from jast.heads.heads import Heads, Moments, histogram, moments, observed, value
from jast.heads.networks import make_head
from jast.heads.samples import joined, of_edges, of_episodes, of_roots
from jast.heads.training import learn, learner
from jast.outline import ask, outline
from jast.pytrees import count
from jast.simulator import Simulator

__all__ = ["enrol"]


class School(NamedTuple):
    """Heads in training."""

    heads: Heads
    policy: Any
    """`Learner`, or None without such a head."""
    value: Any
    lessons: tuple = ()
    """Of each round, name of the head -> `Lesson`."""


def enrol(key, sim, actions, heads, settings):
    """The `School` of ``heads``: "rollout", "value" or "both" to be made, or `Heads` to be taught
    on. ValueError where they do not fit the simulator.
    """
    n, d = sizes(sim, actions, heads)
    start = sim.init(D.sample(sim.start(), key))
    if not is_traced(start_seen := observed(sim, start)) and not bool(
        jnp.all(jnp.isfinite(start_seen))
    ):
        raise ValueError(
            "observe: must return finite numbers where heads learn from them, received"
            f" {np.asarray(start_seen)} at the start"
        )
    if isinstance(heads, str):
        keys = jax.random.split(key)
        new = lambda i, inputs, outputs: make_head(
            keys[i],
            inputs,
            outputs,
            hidden=settings.hidden,
            activation=settings.activation[i],
            first_activation=settings.first_activation,
        )
        policy = new(0, n, (d, settings.bins)) if heads in ("rollout", "both") else None
        heads = Heads(policy, new(1, n + d, ()) if heads in ("value", "both") else None)
    heads = filled(heads, n, d)
    _check_outputs(heads, n, d)
    return School(
        heads,
        *(None if head is None else learner(head.params) for head in (heads.policy, heads.value)),
    )


def sizes(sim: Simulator, actions: Any, heads: str | Heads) -> tuple[int, int]:
    """The numbers that ``observe`` gives and that a disturbance has; ValueError where heads cannot
    serve.
    """
    if not isinstance(heads, Heads) and heads not in ("rollout", "value", "both"):
        raise ValueError(
            'forest: heads must be None, "rollout", "value", "both" or jast.heads.Heads, received'
            f" {heads!r}"
        )
    if isinstance(heads, Heads) and heads.policy is None and heads.value is None:
        raise ValueError(
            "forest: heads must have a policy or a value head, received Heads(None, None)"
        )

    if heads in ("rollout", "both") if isinstance(heads, str) else heads.policy is not None:
        try:
            ask(sim, lambda _, state, p: actions.locate(D.sample(p, jax.random.key(0)), p))
        except ValueError as e:
            raise ValueError(
                "forest: a rollout head needs disturbances with a distribution function; use"
                f' heads="value", or actions.uniform: {e}'
            ) from e
    about = outline(sim)
    if about.observation is None:
        contract("forest", sim, observed=math.inf)  # raises: it says what is wrong with observe
    return math.prod(about.observation), count(about.x)


def filled(heads, n, d):
    """``heads`` with moments that leave everything as it is, where there are none."""
    inputs = Moments.empty(n + d) if heads.inputs is None else heads.inputs
    if inputs.mean.shape != (n + d,):
        raise ValueError(
            f"forest: heads must take {n + d} numbers ({n} observed, {d} of the disturbance),"
            f" received heads that take {inputs.mean.shape[0]}"
        )
    return Heads(
        heads.policy,
        heads.value,
        inputs,
        Moments.empty() if heads.returns is None else heads.returns,
        heads.levels,
    )


def _check_outputs(heads, n, d):
    zeros = jnp.zeros((n,), jnp.float32), jnp.zeros((d,), jnp.float32)
    for name, run in (
        ("policy", lambda: histogram(heads, zeros[0])),
        ("value", lambda: value(heads, *zeros)),
    ):
        if getattr(heads, name) is None:
            continue
        takes = n if name == "policy" else n + d
        wanted = f"logits of shape ({d}, bins), bins at least 2" if name == "policy" else "a scalar"
        try:
            out = jax.eval_shape(run)
        except Exception as e:  # of whatever framework
            why = (str(e) or type(e).__name__).splitlines()[0]
            raise ValueError(
                f"heads: the {name} head's apply(params, x) failed on x of shape ({takes},)"
                f" float32: {why}"
            ) from e
        shape = getattr(out, "shape", None)
        fits = shape is not None and (
            len(shape) == 2 and shape[0] == d and shape[1] >= 2 if name == "policy" else shape == ()
        )
        if not fits or not jnp.issubdtype(out.dtype, jnp.floating):
            raise ValueError(
                f"heads: the {name} head returned"
                f" {jax.tree.map(lambda s: f'{s.dtype}{list(s.shape)}', out)}, expected {wanted}"
            )


def teach(key, school, sim, actions, settings, harvests):
    """The `School` after the lesson of a round's ``harvests``: what has ``log``, ``roots``,
    ``found`` and, for ``settings.edges="all"``, ``edges``.

    A head whose loss or parameters come out NaN or infinite keeps those from before, and the
    `Lesson` says so.
    """
    heads = school.heads
    shares, edges = _samples(heads, sim, actions, settings, harvests)
    inputs, returns = heads.inputs, heads.returns
    if settings.normalise:
        inputs, returns = (
            moments(inputs, np.concatenate([edges.seen, edges.x], axis=1)),
            moments(returns, edges.target),
        )
    keys, lesson, pupils = jax.random.split(key), {}, dict(policy=school.policy, value=school.value)

    def one(i, name, loss, samples, normalise):
        pick = lambda pair: pair[i]
        pupils[name], lesson[name] = learn(
            keys[i],
            pupils[name],
            getattr(heads, name).apply,
            normalise,
            samples,
            loss=loss,
            rate=pick(settings.learning_rate),
            batch=pick(settings.batch),
            steps=pick(settings.steps),
            capacity=pick(settings.replay),
        )

    if heads.policy is not None:
        one(
            0, "policy", settings.loss, shares, (inputs.first(edges.seen.shape[1]), Moments.empty())
        )
    if heads.value is not None and not (settings.untrained_alone and heads.policy is None):
        one(1, "value", "squared", edges, (inputs, returns))
    levels = heads.levels
    if any(of.steps > 0 and not of.rejected for of in lesson.values()):
        deepest = (
            sim.horizon
            if settings.episodes
            else max(int(np.where(h.roots.valid, h.roots.depth, 0).max()) for h in harvests)
        )
        levels = max(levels, deepest + 1)
    new = (
        None if pupil is None else getattr(heads, name)._replace(params=pupil.params)
        for name, pupil in pupils.items()
    )
    return School(Heads(*new, inputs, returns, levels), **pupils, lessons=(*school.lessons, lesson))


def _samples(heads, sim, actions, settings, harvests):
    """What the policy head (None without one) and the value head learn from."""
    about = outline(sim)
    n, first = heads.inputs.mean.shape[0] - count(about.x), int(about.random_start)
    bins = (
        None
        if heads.policy is None
        else jax.eval_shape(lambda: histogram(heads, jnp.zeros((n,), jnp.float32))).shape[1]
    )
    good = best_trees(harvests, settings.elite)
    shares, edges = zip(
        *(
            of_roots(sim, actions, h.roots, bins, g, first)
            for h, g in zip(harvests, good, strict=True)
        ),
        strict=True,
    )
    if heads.policy is not None and settings.episodes:
        # the best episode of each tree stands first
        best = [
            (jax.tree.map(lambda a, g=g: a[: len(g)], h.found), g)
            for h, g in zip(harvests, good, strict=True)
        ]
        shares = (*shares, *(of_episodes(sim, actions, episodes, bins, g) for episodes, g in best))
    if heads.value is not None and settings.edges == "all":
        edges = [of_edges(h.edges, settings.target) for h in harvests]
    return None if heads.policy is None else joined(shares), joined(edges)


def best_trees(harvests, share):
    """Of each harvest, [B] bool: the trees among this ``share`` of all by the reward of their best
    episode.
    """
    best = [np.where(np.isfinite(h.log), h.log, -np.inf).max(0) for h in harvests]
    least = np.quantile(np.concatenate(best), 1 - share, method="lower")
    return [b >= least for b in best]
