"""Proposals that tilt each step's own disturbance by the state and the time: mixtures of
exponential tilts, of normal numbers by their means and of choices by their logits.

The optimal proposal of a rare event of a Markov process is itself Markov, p(x | s, failure still to
come), and tilts by functions of the state and the time to go come near to it (Dupuis and Wang 2004;
Rubinstein and Kroese, The Cross-Entropy Method, 2004). A coin has no normal number behind it here:
its own odds change, and its weight is that of the outcome. A trace is its normal numbers and its
choices; the density of each tilt on it accumulates step by step.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp, ndtr

from jast.distributions.parts import Parts, parts
from jast.limit_state import Outcomes, normal_numbers
from jast.outline import ask, outline
from jast.progress import advance, begin, conclude
from jast.pytrees import count
from jast.rewards import log_likelihood

__all__ = ["Frame", "Tilts", "features", "of_the_model", "played", "shape"]

SEEN = 16
"""Numbers of an observation that a tilt looks at, at most."""


class Frame(NamedTuple):
    """How features come from what is seen of a state: centred, projected, kept within what was
    met.
    """

    centre: Any
    """[R]"""
    project: Any
    """[R, M]"""
    low: Any
    """[M]"""
    high: Any
    """[M]"""


class Tilts(NamedTuple):
    """A mixture of K tilts, one drawn a trace; the first is the model, whose numbers are 0."""

    log_weights: Any
    """[K], of sum 1 as probabilities; -inf for one that is not used"""
    floors: Any
    """[K] log probabilities below which no possible category is left"""
    first_means: Any
    """[K, A0] of the normal numbers of x0"""
    first_shifts: Any
    """[K, B0, C0] of the log probabilities of its choices"""
    means: Any
    """[K, F, A] by which features give the means of a step's normal numbers"""
    shifts: Any
    """[K, F, B, C] by which they give what is added to the log probabilities of its choices"""
    frame: Frame


class Shape(NamedTuple):
    """How many numbers a start and a step have: normals, choices, categories; and what is seen."""

    normals0: int
    choices0: int
    categories0: int
    normals: int
    choices: int
    categories: int
    seen: int


class Trace(NamedTuple):
    """What tilts need of episodes [n]; steps after their ends mean nothing."""

    first_normals: Any
    """[n, A0]"""
    first_choices: Any
    """[n, B0] int32"""
    first_log_p: Any
    """[n, B0, C0]"""
    seen: Any
    """[T, n, R] before each step"""
    normals: Any
    """[T, n, A]"""
    choices: Any
    """[T, n, B] int32"""
    log_p: Any
    """[T, n, B, C] of all categories"""


def shape(sim: Any) -> Shape:
    """The `Shape` of ``sim``."""

    def sizes(start: Any, state: Any, dist: Any) -> Shape:
        a, b = parts(start), parts(dist)
        return Shape(
            *(a.normals, *stacked(a).shape), *(b.normals, *stacked(b).shape), len(look(sim, state))
        )

    return ask(sim, sizes)


def stacked(p: Parts) -> jax.Array:
    """The log probabilities [B, C] of all choices, with categories of probability 0 where they are
    fewer.
    """
    if not p.choices:
        return jnp.zeros((0, 0))
    most = max(c.shape[1] for c in p.choices)
    pad = lambda c: jnp.pad(c, ((0, 0), (0, most - c.shape[1])), constant_values=-jnp.inf)
    return jnp.concatenate([pad(c) for c in p.choices])


def assembled(p: Parts, z: jax.Array, i: jax.Array) -> Any:
    """The value of normal numbers ``z`` [A] and categories ``i`` [B]."""
    split, at = [], 0
    for c in p.choices:
        split.append(i[at : at + len(c)])
        at += len(c)
    return p.value(z, tuple(split))


def look(sim: Any, state: Any) -> jax.Array:
    """What tilts see of a state [R]: its miss distance, where it has one on the way, and what is
    observed.
    """
    dtype = normal_numbers(sim)
    found = [] if sim.episodic else [jnp.asarray(sim.evaluate(state)[1]).reshape(1)]
    if outline(sim).observation is not None:
        found.append(jnp.ravel(sim.observe(state))[:SEEN])
    seen = [a.astype(dtype) for a in found] or [jnp.zeros(1, dtype)]
    return jnp.nan_to_num(jnp.concatenate(seen), posinf=0.0, neginf=0.0)


def features(frame: Frame, seen: Any, tau: Any, np: Any = jnp) -> Any:
    """Features [..., F] of what is ``seen`` [..., R] at ``tau`` [...], the part of the horizon that
    has gone: monomials of the time and of the projected numbers, and what rises near the end.
    """
    # on the host of many steps, in a program of one
    lead = (None,) * (np.ndim(seen) - 1)
    y = np.clip((seen - frame.centre[lead]) @ frame.project, frame.low[lead], frame.high[lead])
    t = np.broadcast_to(tau, y.shape[:-1])[..., None] * 2 - 1
    m = y.shape[-1]
    one = np.ones_like(t)
    if m == 0:
        return np.concatenate([one, t, t * t], axis=-1)
    cross = [y[..., i : i + 1] * y[..., i:] for i in range(m if m <= 3 else 1)]
    out = [one, t, t * t, y, t * y, *cross]
    if m > 3:
        out.append(y[..., 1:] ** 2)
    if m <= 2:
        out += [y**3, t * y**2, t * t * y]
    return np.concatenate(out, axis=-1)


def chosen(log_q: jax.Array, v: jax.Array) -> jax.Array:
    """Categories [B] of the log probabilities ``log_q`` [B, C] at uniform numbers ``v`` [B]; the
    rare ones lie near 0, where floats are fine.
    """
    p = jnp.exp(log_q)
    c = jnp.arange(p.shape[1], dtype=jnp.int32)
    before = (p[:, None, :] < p[:, :, None]) | (
        (p[:, None, :] == p[:, :, None]) & (c[None, None] < c[None, :, None])
    )
    below = jnp.sum(jnp.where(before, p[:, None, :], 0), axis=2)
    fits = (p > 0) & (v[:, None] >= below)
    return jnp.argmax(jnp.where(fits, below, -1), axis=1).astype(jnp.int32)


def tilted_log(log_p: jax.Array, shifts: jax.Array, floors: jax.Array) -> jax.Array:
    """Log probabilities [K, B, C] of choices of ``log_p`` [B, C] under each tilt."""
    log_p = log_p[None]
    lifted = jnp.where(log_p > -jnp.inf, jnp.maximum(log_p, floors[:, None, None]), -jnp.inf)
    return jax.nn.log_softmax(lifted + shifts, axis=-1)


def _drawn(p, k, means, shifts, floors, e, v):
    """(x, z [A], i [B], log probabilities [B, C], log q_k - log p [K]) of one draw of tilt k."""
    log_p = stacked(p)
    z = means[k] + e
    ratio = jnp.sum(means * (z[None] - means / 2), axis=1)
    if not p.choices:
        none = jnp.zeros((0,), jnp.int32)
        return assembled(p, z, none), z, none, log_p, ratio
    log_p = log_p.astype(e.dtype)
    log_q = tilted_log(log_p, shifts, floors)
    i = chosen(log_q[k], v)
    at = lambda a: jnp.take_along_axis(a, i[..., None], axis=-1)[..., 0]
    gain = jax.vmap(at)(log_q) - at(log_p)[None]
    return assembled(p, z, i), z, i, log_p, ratio + jnp.sum(gain, axis=1)


@jax.jit
def played(sim, q, u, first, noise):
    """Episodes [n] of the `Tilts` ``q`` by uniform numbers ``u`` [n]; ``first``, ``noise``: normal
    and uniform numbers of x0 [n, A0], [n, B0] and of the steps [T, n, A], [T, n, B].

    (`Outcomes`, log q_k - log p [n, K], `Trace`).
    """
    edges = jnp.cumsum(jnp.exp(q.log_weights))
    live = jnp.sum(jnp.isfinite(q.log_weights))
    k = jnp.minimum(jnp.sum(u[:, None] >= edges[None], axis=1), live - 1)
    length_of = sim.horizon

    def start(k, e, v):
        x0, z, i, log_p, ratio = _drawn(
            parts(sim.start()), k, q.first_means, q.first_shifts, q.floors, e, v
        )
        return begin(sim, log_likelihood, x0), ratio, (z, i, log_p)

    def one(progress, ratio, length, k, e, v, t):
        seen = look(sim, progress.state)
        f = features(q.frame, seen, t.astype(e.dtype) / length_of)
        means = jnp.einsum("f,kfa->ka", f, q.means)
        shifts = jnp.einsum("f,kfbc->kbc", f, q.shifts)
        x, z, i, log_p, gain = _drawn(
            parts(sim.disturbance(progress.state)), k, means, shifts, q.floors, e, v
        )
        after = advance(sim, log_likelihood, progress, x, t + 1 >= length_of)
        done = progress.done
        keep = lambda a, b: jnp.where(done, a, b)
        after = jax.tree.map(keep, progress, after)
        return after, keep(ratio, ratio + gain), length + jnp.where(done, 0, 1), (seen, z, i, log_p)

    progress, ratio, (z0, i0, log_p0) = jax.vmap(start)(k, *first)
    n, dtype, about = len(u), u.dtype, shape(sim)
    empty = lambda *size, of=dtype: jnp.zeros((length_of, n, *size), of)
    rows = (
        empty(about.seen),
        empty(about.normals),
        empty(about.choices, of=jnp.int32),
        empty(about.choices, about.categories),
    )

    def body(carry):
        progress, ratio, length, t, rows = carry
        progress, ratio, length, row = jax.vmap(one, (0, 0, 0, 0, 0, 0, None))(
            progress, ratio, length, k, noise[0][t], noise[1][t], t
        )
        rows = tuple(a.at[t].set(b) for a, b in zip(rows, row, strict=True))
        return progress, ratio, length, t + 1, rows

    zero = jnp.zeros((), jnp.int32)
    progress, ratio, length, _, rows = lax.while_loop(
        lambda c: jnp.any(~c[0].done) & (c[3] < length_of),
        body,
        (progress, ratio, jnp.zeros(n, jnp.int32), zero, rows),
    )
    end = jax.vmap(lambda p: conclude(sim, log_likelihood, p))(progress)
    about = outline(sim)
    used = count(about.x0) + length * count(about.x)
    outcome = Outcomes(end.failure, end.distance, used, length, end.invalid)
    return outcome, ratio, Trace(z0, i0, log_p0, *rows)


@partial(jax.jit, static_argnums=(1, 2, 3, 4))
def numbers(key, n, about, horizon, dtype):
    """What `played` needs of chance for ``n`` episodes: (u, first, noise)."""
    keys = jax.random.split(key, 5)
    normal = lambda k, *size: jax.random.normal(k, size, dtype)
    return (
        jax.random.uniform(keys[0], (n,), dtype),
        (normal(keys[1], n, about.normals0), _fine(keys[2], (n, about.choices0), dtype)),
        (
            normal(keys[3], horizon, n, about.normals),
            _fine(keys[4], (horizon, n, about.choices), dtype),
        ),
    )


def _fine(key, size, dtype):
    """Uniform numbers whose grid is 2^-32 near 0."""
    bits = jax.random.bits(key, size, jnp.uint32)
    return (bits.astype(dtype) + 0.5) * 2.0**-32


def dimension(about: Shape, horizon: int) -> int:
    """How many numbers of chance an episode has at most."""
    return about.normals0 + about.choices0 + horizon * (about.normals + about.choices)


@jax.jit
def of_the_model(sim, q, z):
    """Episodes of the model by normal numbers ``z`` [n, `dimension`], those of choices too:
    (`Outcomes`, log q - log p [n], `Trace`).
    """
    about, n = shape(sim), len(z)
    a, b = about.normals0, about.choices0
    first = z[:, :a], ndtr(z[:, a : a + b])
    rest = jnp.moveaxis(z[:, a + b :].reshape(n, sim.horizon, -1), 0, 1)
    noise = rest[..., : about.normals], ndtr(rest[..., about.normals :])
    o, ratio, trace = played(sim, q, jnp.zeros(n, z.dtype), first, noise)
    return o, logsumexp(ratio + q.log_weights[None], axis=1), trace


def log_weight(q, ratio):
    """log p - log q [n], and log shares of the components [n, K]."""
    joint = ratio + q.log_weights[None]
    log_q = logsumexp(joint, axis=1)
    return -log_q, joint - log_q[:, None]
