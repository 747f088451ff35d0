"""Proposals that tilt each step's own disturbance by the state and the time: mixtures of
exponential tilts, of normal numbers by their means and of choices by their logits.

The optimal proposal of a rare event of a Markov process is itself Markov, p(x | s, failure still to
come), and tilts by functions of the state and the time to go come near to it (Dupuis and Wang 2004;
Rubinstein and Kroese, The Cross-Entropy Method, 2004). A coin has no normal number behind it here:
its own odds change, and its weight is that of the outcome. A trace is its normal numbers and its
choices; the density of each tilt on it accumulates step by step.
"""

import math
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp, ndtr
from jax.typing import ArrayLike

from jast._src.core.counter_prng import numpy_generator
from jast._src.core.rewards import likelihood
from jast._src.core.signature import per_simulator, signature_of
from jast._src.core.transition import advance, begin, conclude
from jast._src.distributions.independent_parts import Parts, parts
from jast._src.estimate.gaussians.mixture_fit import with_log_shares
from jast._src.normal_space.transform import normal_numbers, outcomes_of
from jast._src.runtime._jax import jit
from jast._src.runtime.checkpoints import answer_once
from jast._src.runtime.host_errors import runs_on_host
from jast._src.util.pytrees import index_tree, join_rows, select

__all__ = [
    "Block",
    "FIRST_STATE_FEATURE",
    "Frame",
    "Shape",
    "Tilts",
    "Trace",
    "assemble",
    "count_rare_before",
    "dimension",
    "draw_tilts",
    "features",
    "interval_starts",
    "shape",
    "simulate_points",
    "simulate_tilts",
    "stack_choices",
    "step_numbers",
    "tilt_inputs",
]

LANES = 512  # episodes that run side by side
SEEN = 16  # numbers of an observation that a tilt looks at, at most
RARE = 0.0917  # probability below which a category is a rare one
FIRST_STATE_FEATURE = 3  # those before it are of the time alone
CROSSED = 3  # numbers seen up to which features hold their products
CUBED = 2  # numbers seen up to which features hold monomials of degree three
UNROLLED = 4  # choices of a step up to which their loop is unrolled


Array = jax.Array | np.ndarray


class Frame(NamedTuple):
    """How features come from what is seen of a state: centred, projected, clipped to the range of
    the traces that it was made of.
    """

    centre: ArrayLike
    """[R]"""
    project: ArrayLike
    """[R, M]"""
    low: ArrayLike
    """[M]"""
    high: ArrayLike
    """[M]"""


class Block(NamedTuple):
    """What features do to the disturbance of one step, or to x0, under K tilts.

    A normal number is drawn from one of G Gaussians, a unit one if G is 1. One that belongs to a
    choice (a mixture's component) has numbers of its own for each category.
    """

    means: ArrayLike
    """[K, F, C', A, G] by which features give the means"""
    gates: ArrayLike
    """[K, F, C', A, G] and the log weights of these Gaussians"""
    shifts: ArrayLike
    """[K, F + 3, B, C] by which the features of a choice, those of its step and three of how many
    choices before it came out rare, give what is added to its log probabilities: so the choices of
    one step depend on each other, and three parts may fail at once"""
    scales: ArrayLike
    """[K, C', A, G] the logs of their deviations; where G is 1, of no effect"""


class Tilts(NamedTuple):
    """A mixture of K tilts, one drawn a trace; the first is the model, whose numbers are 0."""

    log_weights: ArrayLike
    """[K], of sum 1 as probabilities; -inf for one that is not used"""
    floors: ArrayLike
    """[K] log probabilities below which no possible category is left"""
    first: Block
    """Of x0, by one feature that is 1"""
    steps: Block
    frame: Frame
    kept: ArrayLike = 0.0
    """[K] the part of each choice that is left as the model has it"""


class Numbers(NamedTuple):
    """How many numbers a start or a step has, and the choices that its normal numbers belong to."""

    normals: int
    choices: int
    categories: int
    owners: tuple[int, ...]


class Shape(NamedTuple):
    """The `Numbers` of a start and of a step, and how many are seen of a state."""

    first: Numbers
    steps: Numbers
    seen: int

    @property
    def has_choices(self) -> bool:
        """Whether the start or a step has."""
        return bool(self.first.choices or self.steps.choices)


class Trace(NamedTuple):
    """What tilts need of episodes [n]; steps after their ends mean nothing."""

    first_normals: jax.Array
    """[n, A0]"""
    first_choices: jax.Array
    """[n, B0] int32"""
    first_log_p: jax.Array
    """[n, B0, C0]"""
    seen: jax.Array
    """[n, T, R] before each step"""
    normals: jax.Array
    """[n, T, A]"""
    choices: jax.Array
    """[n, T, B] int32"""
    log_p: jax.Array
    """[n, T, B, C] of all categories"""


@per_simulator
def shape(sim: Any, start: Any, state: Any, dist: Any) -> Shape:
    """The `Shape` of a simulator."""

    def count(p):
        return Numbers(p.normals, *stack_choices(p).shape, p.owners)

    return Shape(count(parts(start)), count(parts(dist)), len(tilt_inputs(sim, state)))


def stack_choices(p: Parts) -> jax.Array:
    """The log probabilities [B, C] of all choices, with categories of probability 0 where they are
    fewer.
    """
    if not p.choices:
        return jnp.zeros((0, 0))
    most = max(c.shape[1] for c in p.choices)
    return jnp.concatenate(
        [jnp.pad(c, ((0, 0), (0, most - c.shape[1])), constant_values=-jnp.inf) for c in p.choices]
    )


def assemble(p: Parts, z: jax.Array, i: jax.Array) -> Any:
    """The value of normal numbers ``z`` [A] and categories ``i`` [B]."""
    ends = np.cumsum([len(c) for c in p.choices], dtype=int)[:-1]
    return p.value(z, tuple(jnp.split(i, ends)) if p.choices else ())


def tilt_inputs(sim: Any, state: Any) -> jax.Array:
    """What tilts see of a state [R]: its miss distance, where it has one on the way, and what is
    observed.
    """
    dtype = normal_numbers(sim)
    found = [] if sim.episodic else [jnp.asarray(sim.evaluate(state)[1]).reshape(1)]
    if signature_of(sim).observation is not None:
        found.append(jnp.ravel(sim.observe(state))[:SEEN])
    seen = [a.astype(dtype) for a in found] or [jnp.zeros(1, dtype)]
    return jnp.nan_to_num(jnp.concatenate(seen), posinf=0.0, neginf=0.0)


def features(frame: Frame, seen: Array, tau: Array, np: ModuleType = jnp) -> Array:
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
    if m > CROSSED:  # no products but those with the first, the miss distance
        return np.concatenate([one, t, t * t, y, t * y[..., :1], y[..., :1] * y], axis=-1)
    out = [one, t, t * t, y, t * y, *(y[..., i : i + 1] * y[..., i:] for i in range(m))]
    if m <= CUBED:
        out += [y**3, t * y**2, t * t * y]
    return np.concatenate(out, axis=-1)


def choose_categories(log_q: jax.Array, v: jax.Array) -> jax.Array:
    """Categories [B] of the log probabilities ``log_q`` [B, C] at uniform numbers ``v`` [B]; the
    rare ones lie near 0, where floats are fine.
    """
    p = jnp.exp(log_q)
    below = interval_starts(p)
    fits = (p > 0) & (v[:, None] >= below)
    return jnp.argmax(jnp.where(fits, below, -1), axis=1).astype(jnp.int32)


def interval_starts(p: jax.Array) -> jax.Array:
    """Where the intervals [B, C] of uniform numbers begin that `choose_categories` gives to
    categories of the probabilities ``p`` [B, C].
    """
    c = jnp.arange(p.shape[1], dtype=jnp.int32)
    before = (p[:, None, :] < p[:, :, None]) | (
        (p[:, None, :] == p[:, :, None]) & (c[None, None] < c[None, :, None])
    )
    return jnp.sum(jnp.where(before, p[:, None, :], 0), axis=2)


def tilt_log_probabilities(
    log_p: jax.Array, shifts: jax.Array, floors: jax.Array, kept: jax.Array
) -> jax.Array:
    """Log probabilities [K, B, C] of choices of ``log_p`` [B, C] under each tilt."""
    log_p, floors, kept = log_p[None], floors[:, None, None], kept[:, None, None]
    lifted = jnp.where(log_p > -jnp.inf, jnp.maximum(log_p, floors), -jnp.inf)
    log_q = jax.nn.log_softmax(lifted + shifts, axis=-1)
    return jnp.logaddexp(jnp.log1p(-kept) + log_q, jnp.log(kept) + log_p)


def count_rare_before(log_p: Array, i: Array, np: ModuleType = jnp) -> Array:
    """How many of the choices [..., B] before each one came out as a category of a probability
    below `RARE`.
    """
    p = np.take_along_axis(log_p, i[..., None], axis=-1)[..., 0]
    each = np.where(p < math.log(RARE), 1.0, 0.0)
    return np.cumsum(each, axis=-1) - each


def _owner_one_hot(owners, size, i):
    """Which category [A, C'] each normal number is of; the first where it belongs to no choice."""
    at = jnp.pad(i, (0, 1))[jnp.asarray(owners, jnp.int32)]
    return at[:, None] == jnp.arange(size, dtype=jnp.int32)[None]


def _draw_step(p, k, f, block, odds, numbers):
    """(x, z [A], i [B], log probabilities [B, C], log q_k - log p [K]) of one draw of tilt k."""
    e, h, v = numbers
    log_p = stack_choices(p).astype(e.dtype)
    ratio = jnp.zeros(len(odds[0]), e.dtype)
    i = jnp.zeros((0,), jnp.int32)
    if p.choices:
        i, gain = _draw_choices(log_p, k, f, block, odds, v)
        ratio = ratio + gain
    z = e
    if p.normals:
        z, gain = _draw_normals(p.owners, i, k, f, block, e, h)
        ratio = ratio + gain
    return assemble(p, z, i), z, i, log_p, ratio


def _draw_choices(log_p, k, f, block, odds, v):
    """Categories [B] by tilt k at uniform numbers ``v`` [B], and log q_k - log p [K]."""
    dtype = log_p.dtype
    y = f[FIRST_STATE_FEATURE] if len(f) > FIRST_STATE_FEATURE else f[0]
    base = jnp.einsum("f,kfbc->kbc", f, block.shifts[:, : len(f)])
    extra = block.shifts[:, len(f) :]

    def choose(r, row):
        b_log_p, b_base, b_extra, b_v = row
        three = jnp.stack([r, r * r, r * y])
        shift = (b_base + three @ b_extra)[None, None]
        log_q = tilt_log_probabilities(b_log_p[None], shift, *(a[k][None] for a in odds))
        c = choose_categories(log_q[0], b_v[None])[0]
        return r + jnp.where(b_log_p[c] < math.log(RARE), 1.0, 0.0).astype(dtype), c

    rows = (log_p, base[k], jnp.moveaxis(extra[k], 1, 0), v)
    _, i = lax.scan(choose, jnp.zeros((), dtype), rows, unroll=len(v) <= UNROLLED)
    r = count_rare_before(log_p, i).astype(dtype)
    three = jnp.stack([r, r * r, r * y])
    shifts = base + jnp.einsum("xb,kxbc->kbc", three, extra)
    log_q = tilt_log_probabilities(log_p, shifts, *odds)

    def at_chosen(a):
        return jnp.take_along_axis(a, i[..., None], axis=-1)[..., 0]

    return i, jnp.sum(jax.vmap(at_chosen)(log_q) - at_chosen(log_p)[None], axis=1)


def _draw_normals(owners, i, k, f, block, e, h):
    """Normal numbers [A] by tilt k, of normal numbers ``e`` and of uniform ones ``h`` that choose
    their Gaussians, and log q_k - log p [K].
    """
    size = block.means.shape[2]
    if size > 1:
        own = _owner_one_hot(owners, size, i).astype(e.dtype)
        scales = jnp.einsum("kcag,ac->kag", block.scales, own)
    else:
        scales = block.scales[:, 0]

    def by_features(a):
        if size > 1:
            return jnp.einsum("f,kfcag,ac->kag", f, a, own)
        return jnp.einsum("f,kfag->kag", f, a[:, :, 0])

    means = by_features(block.means)
    if means.shape[2] == 1:
        z = means[k, :, 0] + e
        return z, jnp.sum(means[..., 0] * (z[None] - means[..., 0] / 2), axis=1)
    log_g = jax.nn.log_softmax(by_features(block.gates), axis=-1)
    edges = jnp.cumsum(jnp.exp(log_g[k]), axis=-1)[:, :-1]
    g = jnp.sum(h[:, None] >= edges, axis=-1, dtype=jnp.int32)

    def at_chosen(a):
        return jnp.take_along_axis(a[k], g[:, None], axis=-1)[:, 0]

    z = at_chosen(means) + jnp.exp(at_chosen(scales)) * e
    gap = (z[None, :, None] - means) * jnp.exp(-scales)
    each = log_g - scales + (z[None, :, None] ** 2 - gap**2) / 2
    return z, jnp.sum(logsumexp(each, axis=-1), axis=1)


def simulate_tilts(sim, q, u, first, noise):
    """Episodes [n] of the `Tilts` ``q`` by uniform numbers ``u`` [n]; ``first``, ``noise``: normal
    numbers, uniform ones of their Gaussians and uniform ones of choices, of x0 [n, A0], [n, A0],
    [n, B0] and of the steps [T, n, A], [T, n, A], [T, n, B].

    (`Outcomes`, log q_k - log p [n, K], `Trace`), on the host.
    """
    u, first, noise = jax.device_get((u, first, noise))

    def run(rows):
        of_first = tuple(a[rows] for a in first)
        return _simulate(sim, q, u[rows], of_first, tuple(a[:, rows] for a in noise))

    return _run_in_lanes(sim, len(u), run, (q, u))


def _run_in_lanes(sim, n, run, given):
    """Of episodes that are ``given``: what ``run(rows)`` returns of all ``n`` rows, `LANES` at a
    time, so that one program serves every n; of a black box, which no row may run in vain, all at
    once.
    """
    lanes, out = n if runs_on_host(sim) else LANES, []
    for i in range(0, n, lanes):
        rows = np.minimum(np.arange(i, i + lanes), n - 1)
        out.append(answer_once(lambda rows, _: run(rows), rows, given))
    return index_tree(join_rows(*out), np.s_[:n])


@jit
def _simulate(sim, q, u, first, noise):
    edges = jnp.cumsum(jnp.exp(q.log_weights))
    live = jnp.sum(jnp.isfinite(q.log_weights))
    k = jnp.minimum(jnp.sum(u[:, None] >= edges[None], axis=1), live - 1)
    horizon, density, about = sim.horizon, likelihood(sim), shape(sim)
    odds = q.floors, jnp.broadcast_to(q.kept, jnp.shape(q.floors))

    def start(k, *numbers):
        one = jnp.ones(1, u.dtype)
        x0, *row, ratio = _draw_step(parts(sim.start()), k, one, q.first, odds, numbers)
        return begin(sim, density, x0), ratio, row

    def advance_one(progress, ratio, length, k, numbers, t):
        seen = tilt_inputs(sim, progress.state)
        f = features(q.frame, seen, t.astype(u.dtype) / horizon)
        p = parts(sim.disturbance(progress.state))
        x, *row, gain = _draw_step(p, k, f, q.steps, odds, numbers)
        after = advance(sim, density, progress, x, t + 1 >= horizon)
        done = progress.done
        after, ratio = select(done, (progress, ratio), (after, ratio + gain))
        return after, ratio, length + jnp.where(done, 0, 1), (seen, *row)

    progress, ratio, first_rows = jax.vmap(start)(k, *first)
    n = len(u)
    normals, choices, categories, _ = about.steps
    rows = (
        jnp.zeros((horizon, n, about.seen), u.dtype),
        jnp.zeros((horizon, n, normals), u.dtype),
        jnp.zeros((horizon, n, choices), jnp.int32),
        jnp.zeros((horizon, n, choices, categories), u.dtype),
    )

    def body(carry):
        progress, ratio, length, t, rows = carry
        progress, ratio, length, row = jax.vmap(advance_one, (0, 0, 0, 0, 0, None))(
            progress, ratio, length, k, tuple(a[t] for a in noise), t
        )
        rows = tuple(a.at[t].set(b) for a, b in zip(rows, row, strict=True))
        return progress, ratio, length, t + 1, rows

    first_carry = progress, ratio, jnp.zeros(n, jnp.int32), jnp.zeros((), jnp.int32), rows
    progress, ratio, length, _, rows = lax.while_loop(
        lambda c: jnp.any(~c[0].done) & (c[3] < horizon), body, first_carry
    )
    end = jax.vmap(lambda p: conclude(sim, density, p))(progress)
    trace = Trace(*first_rows, *(jnp.swapaxes(a, 0, 1) for a in rows))
    return outcomes_of(sim, end, length), ratio, trace


def draw_tilts(sim, q, key, size, n):
    """The first ``n`` of ``size`` episodes of ``q``: (`Outcomes`, log p - log q [n], log shares of
    the components [n, K], `Trace`), on the host; ``key`` as in `random_numbers`.
    """
    u, first, noise = random_numbers(key, size, shape(sim), sim.horizon, normal_numbers(sim))
    some = u[:n], tuple(a[:n] for a in first), tuple(a[:, :n] for a in noise)
    o, ratio, trace = simulate_tilts(sim, q, *some)
    return o, *log_weight(q, ratio), trace


def random_numbers(key, n, about, horizon, dtype):
    """What `simulate_tilts` needs of chance for ``n`` episodes: (u, first, noise); ``key``: of JAX,
    or a NumPy generator.
    """
    rng = numpy_generator(key)
    u = rng.random(n).astype(dtype)
    first = step_numbers(rng, dtype, about.first, n)
    return u, first, step_numbers(rng, dtype, about.steps, horizon, n)


def step_numbers(rng, dtype, numbers, *size, precision=np.float64):
    """Normal numbers, uniform ones of their Gaussians, and uniform ones of choices, which are drawn
    of 64 bits: fine near 0, where rare categories lie.
    """
    drawn = (
        rng.standard_normal((*size, numbers.normals), precision),
        rng.random((*size, numbers.normals), precision),
        rng.random((*size, numbers.choices)),
    )
    return tuple(v.astype(dtype) for v in drawn)


def dimension(about: Shape, horizon: int) -> int:
    """How many numbers of chance an episode has at most."""
    first, steps, _ = about
    return first.normals + first.choices + horizon * (steps.normals + steps.choices)


def simulate_points(sim, q, z):
    """Episodes of the model by normal numbers ``z`` [n, `dimension`], those of choices too:
    (`Outcomes`, log q - log p [n], `Trace`), on the host.
    """
    z = np.asarray(z)
    return _run_in_lanes(sim, len(z), lambda rows: _simulate_points(sim, q, z[rows]), (q, z))


@jit
def _simulate_points(sim, q, z):
    about = shape(sim)

    def numbers_of(z, normals):
        e = z[..., :normals]
        return e, jnp.zeros_like(e), ndtr(z[..., normals:])

    n = about.first.normals + about.first.choices
    first = numbers_of(z[:, :n], about.first.normals)
    rest = jnp.moveaxis(z[:, n:].reshape(len(z), sim.horizon, -1), 0, 1)
    noise = numbers_of(rest, about.steps.normals)
    o, ratio, trace = _simulate(sim, q, jnp.zeros(len(z), z.dtype), first, noise)
    return o, logsumexp(ratio + q.log_weights[None], axis=1), trace


def log_weight(q: Tilts, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log p - log q [n], and log shares of the components [n, K]. On the host."""
    joint = ratio.astype(np.float64) + np.asarray(q.log_weights, np.float64)
    log_q, shares = with_log_shares(joint)
    return -log_q, shares
