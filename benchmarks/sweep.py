"""A sweep of `failure_probability` over a gain against as many separate calls:
``python -m benchmarks.sweep [--json] [--quick | --smoke]``.

The calls are on simulators that are built one by one, each of new functions, as a loop would. CPU
seconds hold the compilation. The sweep goes first, so that it pays for what both share. `filter`
has a known probability: its rows say how many intervals hold it, and where it crosses a level.

`joined` are sweeps of cheap systems of known probability, whose rows are joined: root mean square
errors of log P and of the log ratio of neighbours, by the rows alone, joined, and by plain draws
with common random numbers for as many CPU seconds; how many intervals hold the truth; and the
programs that the first sweep compiles.
"""

import math
import time
from functools import partial
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np

import jast
from benchmarks.closed_loops import system
from benchmarks.sizes import options, print_report, printer, size, timed
from benchmarks.stress_systems import lane
from jast._src.normal_space.evaluate_points import evaluate_points
from jast._src.normal_space.transform import dimension
from jast.distributions import Normal
from jast.estimate import failure_probability

__all__ = ["run"]

STEPS = 10  # of the filter and of the walk
LIMIT = 7.0  # of the filter
LEVEL = 1e-5  # the probability whose crossing is looked for
NUMBERS = 200  # that are squared and added


def filtered(decay):
    """A filter of white noise, which must be below a limit at the end."""
    return system(0.0, lambda y, x: decay * y + x, lambda y: LIMIT - y, 1, STEPS, episodic=True)


def of_filter(decay):
    """The probability that it is not."""
    return NormalDist().cdf(-LIMIT / math.sqrt(sum(decay ** (2 * i) for i in range(STEPS))))


CASES = {
    "lane": (lane, "gain", 0.25, 0.4, None),
    "filter": (filtered, "decay", 0.5, 0.8, of_filter),
}


def run(name, n, budget):
    """Numbers of one case: CPU seconds, and what the rows are worth."""
    make, setting, low, high, truth = CASES[name]
    values, key = np.linspace(low, high, n), jax.random.key(0)
    swept = partial(jast.sweep, key, make, {setting: values}, budget=budget)
    table, seconds, _ = timed(swept)

    def calls():
        return [
            failure_probability(jax.random.fold_in(key, i), make(v), budget)
            for i, v in enumerate(values)
        ]

    apart, of_calls, _ = timed(calls)
    report = dict(
        values=n,
        budget=budget,
        sweep_seconds=seconds,
        calls_seconds=of_calls,
        times=of_calls / seconds,
        **_quality("sweep", table.results, values, truth),
        **_quality("calls", apart, values, truth),
    )
    if truth is not None and truth(low) < LEVEL < truth(high):
        found = table.crossing(LEVEL, unreliable=True)
        exact = _root_of(truth, low, high)
        report |= dict(crossing=found.value, crossing_interval=found.interval, exact=exact)
    return report


def walked(limit, scale=1.0):
    """The sum of ten steps leaves [-limit, limit] at the end."""
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + x,
        disturbance=lambda s: Normal(0.0, scale),
        evaluate=lambda s: (jnp.abs(s) > limit, jnp.maximum(limit - jnp.abs(s), 0.0)),
        horizon=STEPS,
        episodic=True,
    )


def of_walk(limit):
    """The probability that it does."""
    return 2 * NormalDist().cdf(-limit / math.sqrt(STEPS))


def squared(limit):
    """The sum of the squares of so many normal numbers is above ``limit``: no Gaussians serve."""
    return system(0.0, lambda s, x: s + x * x, lambda s: limit - s, 1, NUMBERS, episodic=True)


def of_squares(limit):
    """The probability that it is, of an even number of them."""
    x = limit / 2
    return sum(math.exp(k * math.log(x) - x - math.lgamma(k + 1)) for k in range(NUMBERS // 2))


JOINED = {
    "limit of a walk": (walked, "limit", 12.0, 14.0, of_walk),
    "scale of its noise": (partial(walked, 13.0), "scale", 0.93, 1.08, lambda v: of_walk(13.0 / v)),
    "sum of 200 squares": (squared, "limit", 280.0, 296.0, of_squares),
}


def run_joined(name, n, keys, budget):
    """Numbers of one case, over so many ``keys``."""
    make, setting, low, high, truth = JOINED[name]
    values = np.linspace(low, high, n)
    log_p, compiled = np.log([truth(v) for v in values]), []

    def heard(name, *_, **__):
        return compiled.append(name) if "backend_compile" in name else None

    def swept(i):
        return timed(lambda: jast.sweep(jax.random.key(i), make, {setting: values}, budget=budget))

    jax.monitoring.register_event_duration_secs_listener(heard)
    first = swept(0)
    jax.monitoring.clear_event_listeners()
    tables, spent, _ = zip(first, *map(swept, range(1, keys)), strict=True)
    seconds = float(np.median(spent))  # the first one compiles
    plain = [_plain_shares(tables[0].simulators, i, seconds) for i in range(keys)]
    alone = np.array([[r.log_mean for r in t.results] for t in tables])
    own = np.array([[r.interval for r in t.results] for t in tables])
    curve, ratios = (
        np.array([getattr(t, of) for t in tables if t.curve is not None])
        for of in ("curve", "ratios")
    )
    steps = np.diff(log_p)
    return dict(
        values=n,
        keys=keys,
        budget=budget,
        joined=int(np.isfinite(curve[..., 0]).sum()),
        log_error_alone=_rms(alone - log_p),
        log_error_joined=_rms(np.log(curve[..., 0]) - log_p),
        log_error_plain=_rms(np.log(plain) - log_p),
        ratio_error_alone=_rms(np.diff(alone) - steps),
        ratio_error_joined=_rms(np.log(ratios[..., 0]) - steps),
        ratio_error_plain=_rms(np.diff(np.log(plain)) - steps),
        hold_alone=_coverage(own[..., 0], own[..., 1], np.exp(log_p)),
        hold_joined=_coverage(curve[..., 1], curve[..., 2], np.exp(log_p)),
        hold_ratios=_coverage(ratios[..., 1], ratios[..., 2], np.exp(steps)),
        apart=sum(len(t.settings.get("apart", ())) for t in tables),
        seconds=seconds,
        first_seconds=spent[0],
        programs=len(compiled),
    )


def _plain_shares(sims, seed, seconds):
    """The share of plain draws that fail, the same for all systems, within so many CPU seconds."""
    rng, failing, n, d = np.random.default_rng(seed), np.zeros(len(sims)), 0, dimension(sims[0])
    [evaluate_points(s, np.zeros((1, d), np.float32)) for s in sims[:1]]  # compiled
    begun = time.process_time()
    while not n or time.process_time() - begun < seconds:
        z = rng.standard_normal((8192, d), np.float32)
        failing += [evaluate_points(s, z).failure.sum() for s in sims]
        n += len(z)
    return np.maximum(failing, 0.5) / n  # none at all counts as half a failure


def _rms(errors):
    return float(np.sqrt(np.nanmean(np.square(errors))))


def _coverage(low, high, truth):
    """Share of the intervals, of those that there are, that hold the truth."""
    return float(((low <= truth) & (truth <= high)).sum() / np.isfinite(low).sum())


def _quality(who, results, values, truth):
    """How many rows are reliable, the median of their standard errors, and how many intervals hold
    the truth: of all rows, and of the reliable ones.
    """
    good = [r.reliable for r in results]
    out = {
        f"{who}_reliable": sum(good),
        f"{who}_relative_error": float(np.nanmedian([r.relative_error for r in results])),
    }
    if truth is not None:
        held = [r.interval[0] <= truth(v) <= r.interval[1] for r, v in zip(results, values)]
        out[f"{who}_hold"] = sum(held)
        out[f"{who}_reliable_hold"] = sum(h for h, g in zip(held, good) if g)
    return out


def _root_of(rising, low, high):
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if rising(middle) < LEVEL else (low, middle)
    return low


def main(argv=None):
    args = options(__doc__, "4 values; 3 keys of one joined case").parse_args(argv)
    n, budget = size(args, 50, 4, 2), size(args, 10_000, 10_000, 5000)
    names = size(args, list(CASES), list(CASES), ["filter"])
    report = {name: run(name, n, budget) for name in names}
    n, keys = size(args, (10, 20), (8, 3), (3, 1))
    for name in size(args, list(JOINED), list(JOINED)[:1], list(JOINED)[:1]):
        report[name] = run_joined(name, n, keys, 300_000)
    say = printer(args)
    for name, numbers in report.items():
        say(name)
        for what, value in numbers.items():
            say(f"  {what:<24}{value if isinstance(value, tuple) else f'{value:.5g}'}")
    print_report(args, report)


if __name__ == "__main__":
    main()
