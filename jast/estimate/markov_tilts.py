"""Proposals that tilt each step's own disturbance by the state and the time: mixtures of
exponential tilts, of normal numbers by their means and of choices by their logits.

The optimal proposal of a rare event of a Markov process is itself Markov, p(x | s, failure still to
come), and tilts by functions of the state and the time to go come near to it (Dupuis and Wang 2004;
Rubinstein and Kroese, The Cross-Entropy Method, 2004). A coin has no normal number behind it here:
its own odds change, and its weight is that of the outcome. A trace is its normal numbers and its
choices; the density of each tilt on it accumulates step by step.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp, ndtr

from jast._jax import jit
from jast.checkpoints import answer_once
from jast.counter import numpy_generator
from jast.distributions.parts import Parts, parts
from jast.estimate.gaussians import log_sum
from jast.incidents import runs_on_host
from jast.limit_state import Outcomes, normal_numbers
from jast.outline import outline, per_simulator
from jast.progress import advance, begin, conclude
from jast.pytrees import count_numbers
from jast.rewards import likelihood

__all__ = ["Frame", "Tilts", "features", "of_the_model", "played", "shape"]

LANES = 512
"""Episodes that run side by side."""
SEEN, RARE = 16, 0.0917
"""Numbers of an observation that a tilt looks at, at most; probability below which a category is a
rare one."""
Y = 3
"""Which feature is the first that is no time."""


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


class Block(NamedTuple):
    """What features do to the disturbance of one step, or to x0, under K tilts.

    A normal number is drawn from one of G Gaussians, a unit one if G is 1. One that belongs to a
    choice (a mixture's component) has numbers of its own for each category.
    """

    means: Any
    """[K, F, C', A, G] by which features give the means"""
    gates: Any
    """[K, F, C', A, G] and the log weights of these Gaussians"""
    shifts: Any
    """[K, F + 3, B, C] by which features, and those of `surprise`, give what is added to the log
    probabilities of choices"""
    scales: Any
    """[K, C', A, G] the logs of their deviations; where G is 1, of no effect"""


class Tilts(NamedTuple):
    """A mixture of K tilts, one drawn a trace; the first is the model, whose numbers are 0."""

    log_weights: Any
    """[K], of sum 1 as probabilities; -inf for one that is not used"""
    floors: Any
    """[K] log probabilities below which no possible category is left"""
    first: Block
    """Of x0, by one feature that is 1"""
    steps: Block
    frame: Frame


class Shape(NamedTuple):
    """How many numbers a start and a step have: normals, choices, categories, and the choices that
    normals belong to; and what is seen.
    """

    normals0: int
    choices0: int
    categories0: int
    owners0: tuple[int, ...]
    normals: int
    choices: int
    categories: int
    owners: tuple[int, ...]
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


@per_simulator
def shape(sim: Any, start: Any, state: Any, dist: Any) -> Shape:
    """The `Shape` of a simulator."""
    a, b = parts(start), parts(dist)
    return Shape(
        *(a.normals, *stacked(a).shape, a.owners),
        *(b.normals, *stacked(b).shape, b.owners),
        len(look(sim, state)),
    )


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
    if m > 3:  # what is many is looked at singly, and beside the first, the miss distance
        return np.concatenate([one, t, t * t, y, t * y[..., :1], y[..., :1] * y], axis=-1)
    out = [one, t, t * t, y, t * y, *(y[..., i : i + 1] * y[..., i:] for i in range(m))]
    if m <= 2:
        out += [y**3, t * y**2, t * t * y]
    return np.concatenate(out, axis=-1)


def chosen(log_q: jax.Array, v: jax.Array) -> jax.Array:
    """Categories [B] of the log probabilities ``log_q`` [B, C] at uniform numbers ``v`` [B]; the
    rare ones lie near 0, where floats are fine.
    """
    p = jnp.exp(log_q)
    below = starts(p)
    fits = (p > 0) & (v[:, None] >= below)
    return jnp.argmax(jnp.where(fits, below, -1), axis=1).astype(jnp.int32)


def starts(p: jax.Array) -> jax.Array:
    """Where the intervals [B, C] of uniform numbers begin that `chosen` gives to categories of the
    probabilities ``p`` [B, C].
    """
    c = jnp.arange(p.shape[1], dtype=jnp.int32)
    before = (p[:, None, :] < p[:, :, None]) | (
        (p[:, None, :] == p[:, :, None]) & (c[None, None] < c[None, :, None])
    )
    return jnp.sum(jnp.where(before, p[:, None, :], 0), axis=2)


def tilted_log(log_p: jax.Array, shifts: jax.Array, floors: jax.Array) -> jax.Array:
    """Log probabilities [K, B, C] of choices of ``log_p`` [B, C] under each tilt."""
    log_p = log_p[None]
    lifted = jnp.where(log_p > -jnp.inf, jnp.maximum(log_p, floors[:, None, None]), -jnp.inf)
    return jax.nn.log_softmax(lifted + shifts, axis=-1)


def surprise(x: Any, y: Any, rare: Any, np: Any = jnp) -> Any:
    """Features [..., F + 3] of a choice: those of its step ``x`` [..., F], and how many of the
    choices before it came out ``rare`` [...]; ``y``: the second feature of ``x`` that is no time.

    So choices of one step lean on each other: three parts that fail at once are no accident.
    """
    r = rare[..., None]
    return np.concatenate([x, r, r * r, r * y[..., None]], axis=-1)


def rarity(log_p: Any, i: Any, np: Any = jnp) -> Any:
    """How many of the choices [..., B] before each one came out as a category of a probability
    below `RARE`.
    """
    p = np.take_along_axis(log_p, i[..., None], axis=-1)[..., 0]
    each = np.where(p < math.log(RARE), 1.0, 0.0)
    return np.cumsum(each, axis=-1) - each


def owned(owners: tuple[int, ...], size: int, i: Any, np: Any = jnp) -> Any:
    """Which category [..., A, C'] each normal number is of, as 0 and 1; all of the first where it
    belongs to no choice.
    """
    none = np.zeros((*i.shape[:-1], 1), i.dtype)
    at = np.concatenate([i, none], axis=-1)[..., np.asarray(owners, np.int32)]
    each = np.arange(size, dtype=np.int32)[(None,) * at.ndim]
    return np.where(at[..., None] == each, 1.0, 0.0)


def _drawn(p, k, f, block, floors, chance):
    """(x, z [A], i [B], log probabilities [B, C], log q_k - log p [K]) of one draw of tilt k."""
    e, h, v = chance
    dtype = e.dtype
    log_p = stacked(p).astype(dtype)
    ratio = jnp.zeros(len(floors), dtype)
    i = jnp.zeros((0,), jnp.int32)
    y = f[Y] if len(f) > Y else f[0]
    if p.choices:
        base = jnp.einsum("f,kfbc->kbc", f, block.shifts[:, : len(f)])
        extra = block.shifts[:, len(f) :]

        def choose(r, row):
            b_log_p, b_base, b_extra, b_v = row
            three = jnp.stack([r, r * r, r * y])
            log_q = tilted_log(
                b_log_p[None], (b_base + three @ b_extra)[None, None], floors[k][None]
            )
            c = chosen(log_q[0], b_v[None])[0]
            return r + jnp.where(b_log_p[c] < math.log(RARE), 1.0, 0.0).astype(dtype), c

        rows = (log_p, base[k], jnp.moveaxis(extra[k], 1, 0), v)
        _, i = lax.scan(choose, jnp.zeros((), dtype), rows, unroll=len(v) <= 4)
        r = rarity(log_p, i).astype(dtype)
        three = jnp.stack([r, r * r, r * y])
        log_q = tilted_log(log_p, base + jnp.einsum("xb,kxbc->kbc", three, extra), floors)
        at = lambda a: jnp.take_along_axis(a, i[..., None], axis=-1)[..., 0]
        ratio = ratio + jnp.sum(jax.vmap(at)(log_q) - at(log_p)[None], axis=1)
    z = e
    if p.normals:
        size = block.means.shape[2]
        if size > 1:
            own = owned(p.owners, size, i).astype(dtype)
            of = lambda a: jnp.einsum("f,kfcag,ac->kag", f, a, own)
            scales = jnp.einsum("kcag,ac->kag", block.scales, own)
        else:
            of = lambda a: jnp.einsum("f,kfag->kag", f, a[:, :, 0])
            scales = block.scales[:, 0]
        means = of(block.means)
        if means.shape[2] == 1:
            z = means[k, :, 0] + e
            ratio = ratio + jnp.sum(means[..., 0] * (z[None] - means[..., 0] / 2), axis=1)
        else:
            log_g = jax.nn.log_softmax(of(block.gates), axis=-1)
            edges = jnp.cumsum(jnp.exp(log_g[k]), axis=-1)[:, :-1]
            g = jnp.sum(h[:, None] >= edges, axis=-1, dtype=jnp.int32)
            at = lambda a: jnp.take_along_axis(a[k], g[:, None], axis=-1)[:, 0]
            z = at(means) + jnp.exp(at(scales)) * e
            gap = (z[None, :, None] - means) * jnp.exp(-scales)
            each = log_g - scales + (z[None, :, None] ** 2 - gap**2) / 2
            ratio = ratio + jnp.sum(logsumexp(each, axis=-1), axis=1)
    return assembled(p, z, i), z, i, log_p, ratio


def played(sim, q, u, first, noise):
    """Episodes [n] of the `Tilts` ``q`` by uniform numbers ``u`` [n]; ``first``, ``noise``: normal
    numbers, uniform ones of their Gaussians and uniform ones of choices, of x0 [n, A0], [n, A0],
    [n, B0] and of the steps [T, n, A], [T, n, A], [T, n, B].

    (`Outcomes`, log q_k - log p [n, K], `Trace`), on the host.
    """
    u, first, noise = jax.device_get((u, first, noise))

    def run(rows):
        at = lambda a: a[rows]
        of_steps = tuple(a[:, rows] for a in noise)
        return _played(sim, q, at(u), tuple(map(at, first)), of_steps)

    return _in_lanes(sim, len(u), run, (q, u))


def _in_lanes(sim, n, run, given):
    """Of episodes that are ``given``: what ``run(rows)`` returns of all ``n`` rows, `LANES` at a
    time, so that one program serves every n; of a black box, which no row may run in vain, all at
    once.
    """
    lanes, out = n if runs_on_host(sim) else LANES, []
    for i in range(0, n, lanes):
        m = min(lanes, n - i)
        o, x, trace = answer_once(
            lambda rows, _: run(rows), np.minimum(np.arange(i, i + lanes), n - 1), given
        )
        of_steps = (a[:, :m] for a in trace[3:])
        out.append(((*(a[:m] for a in o), x[:m], *(a[:m] for a in trace[:3])), (*of_steps,)))
    rows = [np.concatenate(a) for a in zip(*(a for a, _ in out), strict=True)]
    of_steps = (np.concatenate(a, axis=1) for a in zip(*(a for _, a in out), strict=True))
    size = len(Outcomes._fields)
    return Outcomes(*rows[:size]), rows[size], Trace(*rows[size + 1 :], *of_steps)


@jit
def _played(sim, q, u, first, noise):
    edges = jnp.cumsum(jnp.exp(q.log_weights))
    live = jnp.sum(jnp.isfinite(q.log_weights))
    k = jnp.minimum(jnp.sum(u[:, None] >= edges[None], axis=1), live - 1)
    length_of, density = sim.horizon, likelihood(sim)

    def start(k, *chance):
        one = jnp.ones(1, u.dtype)
        x0, z, i, log_p, ratio = _drawn(parts(sim.start()), k, one, q.first, q.floors, chance)
        return begin(sim, density, x0), ratio, (z, i, log_p)

    def one(progress, ratio, length, k, chance, t):
        seen = look(sim, progress.state)
        f = features(q.frame, seen, t.astype(u.dtype) / length_of)
        p = parts(sim.disturbance(progress.state))
        x, z, i, log_p, gain = _drawn(p, k, f, q.steps, q.floors, chance)
        after = advance(sim, density, progress, x, t + 1 >= length_of)
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
        progress, ratio, length, row = jax.vmap(one, (0, 0, 0, 0, 0, None))(
            progress, ratio, length, k, tuple(a[t] for a in noise), t
        )
        rows = tuple(a.at[t].set(b) for a, b in zip(rows, row, strict=True))
        return progress, ratio, length, t + 1, rows

    zero = jnp.zeros((), jnp.int32)
    progress, ratio, length, _, rows = lax.while_loop(
        lambda c: jnp.any(~c[0].done) & (c[3] < length_of),
        body,
        (progress, ratio, jnp.zeros(n, jnp.int32), zero, rows),
    )
    end = jax.vmap(lambda p: conclude(sim, density, p))(progress)
    about = outline(sim)
    used = count_numbers(about.x0) + length * count_numbers(about.x)
    outcome = Outcomes(end.failure, end.distance, used, length, end.invalid, end.reward)
    return outcome, ratio, Trace(z0, i0, log_p0, *rows)


def numbers(key, n, about, horizon, dtype):
    """What `played` needs of chance for ``n`` episodes: (u, first, noise); ``key``: of JAX, or a
    NumPy generator.
    """
    rng = numpy_generator(key)

    # uniform numbers of 64 bits: fine near 0, where rare categories lie
    def of(a, b, *size):
        drawn = rng.standard_normal((*size, a)), rng.random((*size, a)), rng.random((*size, b))
        return tuple(v.astype(dtype) for v in drawn)

    u = rng.random(n).astype(dtype)
    first = of(about.normals0, about.choices0, n)
    return u, first, of(about.normals, about.choices, horizon, n)


def dimension(about: Shape, horizon: int) -> int:
    """How many numbers of chance an episode has at most."""
    return about.normals0 + about.choices0 + horizon * (about.normals + about.choices)


def of_the_model(sim, q, z):
    """Episodes of the model by normal numbers ``z`` [n, `dimension`], those of choices too:
    (`Outcomes`, log q - log p [n], `Trace`), on the host.
    """
    z = np.asarray(z)
    run = lambda rows: _of_the_model(sim, q, z[rows])
    return _in_lanes(sim, len(z), run, (q, z))


@jit
def _of_the_model(sim, q, z):
    about, n = shape(sim), len(z)
    a, b = about.normals0, about.choices0
    first = z[:, :a], jnp.zeros_like(z[:, :a]), ndtr(z[:, a : a + b])
    rest = jnp.moveaxis(z[:, a + b :].reshape(n, sim.horizon, -1), 0, 1)
    e = rest[..., : about.normals]
    noise = e, jnp.zeros_like(e), ndtr(rest[..., about.normals :])
    o, ratio, trace = _played(sim, q, jnp.zeros(n, z.dtype), first, noise)
    return o, logsumexp(ratio + q.log_weights[None], axis=1), trace


def log_weight(q, ratio):
    """log p - log q [n], and log shares of the components [n, K]. On the host."""
    joint = ratio.astype(np.float64) + np.asarray(q.log_weights, np.float64)
    log_q = log_sum(joint)
    return -log_q, joint - log_q[:, None]
