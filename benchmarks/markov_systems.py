"""Rare events of many steps, of choices, of heavy tails and of many modes, with truths from Markov
chains, quadrature and closed forms: ``CASES``, name -> (function that makes the simulator, truth).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from scipy import stats

import jast
from jast import distributions as D
from jast.simulators import autoregression, limit_state

__all__ = ["CASES"]


class Sum(NamedTuple):
    """Of the disturbances so far."""

    total: Any
    steps: Any


class Watched(NamedTuple):
    """A quantity that is controlled while its sensor works."""

    value: Any
    dropped: Any


# a queue: one arrives with probability p, else one leaves


def queue(up=0.4, room=20, steps=200):
    """Overflow of a queue that starts empty; x = 1 (one arrives) or 0 (one leaves, if any is
    there).
    """
    return jast.Simulator(
        _empty,
        _queued,
        Partial(_arrives, jnp.asarray(up, float)),
        Partial(_overflows, jnp.asarray(room, jnp.int32)),
        steps,
    )


def _empty(x0):
    return jnp.zeros((), jnp.int32)


def _queued(s, x):
    return jnp.maximum(s + 2 * x - 1, 0)


def _arrives(up, s):
    return D.Bernoulli(probs=up, dtype=jnp.int32)


def _overflows(room, s):
    return s >= room, jnp.maximum(room - s, 0).astype(float)


def queue_probability(up, room, steps):
    chain = np.zeros((room + 1, room + 1))
    for i in range(room):
        chain[i, i + 1] += up
        chain[i, max(i - 1, 0)] += 1 - up
    chain[room, room] = 1
    return float(np.linalg.matrix_power(chain, steps)[0, room])


# components that fail and are repaired


def components(fails=1e-3, repaired=0.3, n=5, down=3, steps=100):
    """``n`` components, each with a coin a step; failure where ``down`` of them are down at
    once.
    """
    return jast.Simulator(
        Partial(_all_up, jnp.zeros(n, bool)),
        _flipped,
        Partial(_coins, jnp.asarray(fails, float), jnp.asarray(repaired, float)),
        Partial(_too_many, jnp.asarray(down, jnp.int32)),
        steps,
    )


def _all_up(none, x0):
    return none


def _flipped(s, x):
    return s ^ (x == 1)


def _coins(fails, repaired, s):
    return D.Independent(D.Bernoulli(probs=jnp.where(s, repaired, fails), dtype=jnp.int32), 1)


def _too_many(down, s):
    count = jnp.sum(s, dtype=jnp.int32)
    return count >= down, jnp.maximum(down - count, 0).astype(float)


def components_probability(fails, repaired, n, down, steps):
    """By the chain of how many are down."""
    chain = np.zeros((n + 1, n + 1))
    for i in range(n + 1):
        back = stats.binom.pmf(np.arange(i + 1), i, repaired)
        more = stats.binom.pmf(np.arange(n - i + 1), n - i, fails)
        for b, p in enumerate(back):
            chain[i, i - b : n - b + 1] += p * more
    kept = chain[:down, :down]
    alive, total = np.eye(down)[0], 0.0
    for _ in range(steps):
        total += alive @ chain[:down, down:].sum(axis=1)
        alive = alive @ kept
    return float(total)


# a rare coin beside a run of one face of a die


def coin_and_run(coin=1e-4, faces=20, run=4, steps=6):
    """A coin and a die a step; failure by one coin, or by ``run`` times face 0 in turn."""
    arrays = jnp.asarray(coin, float), jnp.zeros(faces)
    return jast.Simulator(
        lambda x0: (jnp.zeros((), bool), jnp.zeros((), jnp.int32)),
        _counted,
        Partial(_coin_and_die, *arrays),
        Partial(_tossed_or_long, jnp.asarray(run, jnp.int32)),
        steps,
    )


def _counted(s, x):
    tossed, length = s
    return tossed | (x["coin"] == 1), jnp.where(x["die"] == 0, length + 1, 0)


def _coin_and_die(coin, faces, s):
    return D.Joint({"coin": D.Bernoulli(probs=coin), "die": D.Categorical(faces)})


def _tossed_or_long(run, s):
    tossed, length = s
    fails = tossed | (length >= run)
    return fails, jnp.where(fails, 0, run - length).astype(float)


def coin_and_run_probability(coin, faces, run, steps):
    """By the chain of the length of the run."""
    chain = np.zeros((run + 1, run + 1))
    for i in range(run):
        chain[i, run] += coin
        chain[i, i + 1] += (1 - coin) / faces
        chain[i, 0] += (1 - coin) * (1 - 1 / faces)
    chain[run, run] = 1
    return float(np.linalg.matrix_power(chain, steps)[0, run])


# a sensor that drops out


def dropout(rate=1e-5, limit=8.0, steps=50):
    """A quantity is pulled to 0 while its sensor works, and is a random walk once it dropped
    out.
    """
    return jast.Simulator(
        _watched,
        _pulled,
        Partial(_coin_and_noise, jnp.asarray(rate, float)),
        Partial(_beyond, jnp.asarray(limit, float)),
        steps,
    )


def _watched(x0):
    return Watched(jnp.zeros(()), jnp.zeros((), bool))


def _pulled(s, x):
    dropped = s.dropped | (x["drop"] == 1)
    return Watched(jnp.where(dropped, 1.0, 0.5) * s.value + x["noise"], dropped)


def _coin_and_noise(rate, s):
    noise = D.Normal(jnp.zeros_like(s.value), jnp.ones_like(s.value))
    return D.Joint({"drop": D.Bernoulli(probs=rate, dtype=jnp.int32), "noise": noise})


def _beyond(limit, s):
    return jnp.abs(s.value) >= limit, jnp.maximum(limit - jnp.abs(s.value), 0)


def dropout_probability(rate, limit, steps, nodes=400):
    """By Nystrom on the values inside, with the sensor and without."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = x * limit, w * limit

    def kernel(a):
        return stats.norm.pdf(x[:, None] - a * x) * w

    def passes(a, at):
        return stats.norm.sf(limit - a * at) + stats.norm.cdf(-limit - a * at)

    kept, gone = kernel(0.5), kernel(1.0)
    with_it, without = (1 - rate) * stats.norm.pdf(x), rate * stats.norm.pdf(x)
    total = passes(0.0, 0.0)
    for _ in range(steps - 1):
        to_walk = rate * with_it + without
        total += w @ ((1 - rate) * passes(0.5, x) * with_it + passes(1.0, x) * to_walk)
        with_it, without = (1 - rate) * kept @ with_it, gone @ to_walk
    return float(total)


# sums of steps


def total(disturbance, limit, steps):
    """Failure where the sum of all ``steps`` is at least ``limit``."""
    return jast.Simulator(
        _nothing,
        _added,
        disturbance,
        Partial(_too_great, jnp.asarray(limit, float), jnp.asarray(steps, jnp.int32)),
        steps,
    )


def _nothing(x0):
    return Sum(jnp.zeros(()), jnp.zeros((), jnp.int32))


def _added(s, x):
    return Sum(s.total + x, s.steps + 1)


def _too_great(limit, steps, s):
    gap = jnp.maximum(limit - s.total, 0)
    return (s.total >= limit) & (s.steps == steps), gap


def _two_normals(weights, means, deviations, s):
    return D.MixtureSameFamily(D.Categorical(probs=weights), D.Normal(means, deviations))


def two_normals(weights, means, deviations):
    return Partial(_two_normals, *(jnp.asarray(v, float) for v in (weights, means, deviations)))


def two_normals_probability(weights, means, deviations, limit, steps):
    """By how many of the steps are of the second kind."""
    k = np.arange(steps + 1)
    mean = means[0] * (steps - k) + means[1] * k
    variance = deviations[0] ** 2 * (steps - k) + deviations[1] ** 2 * k
    tails = stats.norm.sf((limit - mean) / np.sqrt(variance))
    return float(stats.binom.pmf(k, steps, weights[1]) @ tails)


def _laplace(s):
    return D.Laplace(jnp.zeros_like(s.total), jnp.ones_like(s.total))


def _student(s):
    return D.StudentT(jnp.full_like(s.total, 4.0), jnp.zeros_like(s.total), jnp.ones_like(s.total))


def sum_probability(pdf, limit, steps, reach=4000.0, n=2**22):
    """By the power of the characteristic function (fast Fourier transform) of a symmetric
    density.
    """
    h = 2 * reach / n
    x = (np.arange(n) - n // 2) * h
    mass = np.fft.rfft(np.fft.ifftshift(pdf(x) * h))
    density = np.fft.fftshift(np.fft.irfft(mass**steps, n))
    at = x >= limit
    return float(density[at].sum() - density[np.argmax(at)] * (x[at][0] - limit + h / 2 - h) / h)


# many modes in one step


def _second_greatest(beta, x):
    return beta - jnp.sort(x)[-2]


def _greatest(beta, x):
    return beta - jnp.max(x)


def _greatest_along(directions, beta, x):
    return beta - jnp.max(directions @ x)


def _planes(d):
    return np.linalg.qr(np.random.default_rng(0).standard_normal((d, d)))[0]


def _of(make: Callable, probability: Callable, *args: Any) -> tuple[Callable, float]:
    return partial(make, *args), probability(*args)


CONTAMINATED = ((0.95, 0.05), (0.0, 0.0), (1.0, 5.0))
BIMODAL = ((0.5, 0.5), (-1.0, 1.0), (0.3, 0.3))
CASES: dict[str, tuple[Callable, float]] = {
    "autoregression 1000": (partial(autoregression, horizon=1000), 2.0208837842648e-4),
    "queue": _of(queue, queue_probability, 0.33, 20, 200),
    "components": _of(components, components_probability, 1e-3, 0.2, 5, 3, 100),
    "components 1e-6": _of(components, components_probability, 5e-4, 0.5, 5, 3, 100),
    "coin and run": _of(coin_and_run, coin_and_run_probability, 1e-4, 20, 4, 6),
    "dropout": _of(dropout, dropout_probability, 1e-5, 8.0, 50),
    "dropout 1e-7": _of(dropout, dropout_probability, 1e-7, 8.0, 50),
    "contaminated": (
        lambda: total(two_normals(*CONTAMINATED), 28.0, 10),
        two_normals_probability(*CONTAMINATED, 28.0, 10),
    ),
    "bimodal": (
        lambda: total(two_normals(*BIMODAL), 11.0, 10),
        two_normals_probability(*BIMODAL, 11.0, 10),
    ),
    "Laplace": (lambda: total(_laplace, 20.0, 10), sum_probability(stats.laplace.pdf, 20.0, 10)),
    "t4": (lambda: total(_student, 30.0, 10), sum_probability(stats.t(4).pdf, 30.0, 10)),
    "2 of 10": (
        lambda: limit_state(Partial(_second_greatest, jnp.asarray(3.3)), 10),
        float(stats.binom.sf(1, 10, stats.norm.sf(3.3))),
    ),
    "series 60": (
        lambda: limit_state(Partial(_greatest, jnp.asarray(5.0)), 60),
        float(-np.expm1(60 * np.log1p(-stats.norm.sf(5.0)))),
    ),
    "series 60, turned": (
        lambda: limit_state(
            Partial(_greatest_along, jnp.asarray(_planes(60)), jnp.asarray(5.0)), 60
        ),
        float(-np.expm1(60 * np.log1p(-stats.norm.sf(5.0)))),
    ),
}
