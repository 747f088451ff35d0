"""Does `jast.explain` say what is so? ``python -m benchmarks.explain [--json] [--quick | --smoke]
[--parts ...] [--seeds N]``.

Systems with planted causes (`benchmarks.explain_systems`): whether `minimal` finds exactly the
planted disturbances, and how precise the rules are on fresh episodes, drawn in closed form:
failures as probable as in the model; ordinary episodes; and near misses, in which the disturbances
that matter are anywhere between 0 and a quarter beyond their limits. Closed forms for
`criticality`, `sensitivity` and `differential`; finite differences for `sensitivity` where there
are none; the area under the ROC curve of monitors; the CPU time of explaining a failure of the
ferry.
"""

import contextlib
import math
import time
import warnings
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jast
from benchmarks import stress_systems
from benchmarks.explain_systems import PLANTED, SIDE, lane, planted, version, walk
from benchmarks.sizes import add_choices, options, print_report, size
from jast import explain
from jast.distributions import Normal

__all__ = ["PARTS", "run"]

GIVEN = 400  # failures that rules learn from
FRESH = 1000  # failures of each cause that judge them, and others


def minimal(seeds, budget):
    """Seeds in which exactly the planted disturbances are needed."""
    out = {}
    for name in PLANTED:
        right, spent, begin = 0, [], time.process_time()
        for seed in range(seeds):
            p, rng = planted(name, seed), np.random.default_rng(seed)
            cause = seed % len(p.causes)
            x = p.failing(rng, cause, 1)
            e = jax.tree.map(lambda a: a[0], p.episodes(x))
            found = explain.minimal(p.sim, e)
            step = int(e.length) if p.causes[cause].keys() & ANY else None
            wanted = {(step if t is None else t, field) for t, field in p.causes[cause]}
            right += {(t, field) for t, field, *_ in found.parts} == wanted
            spent.append(found.evaluations)
        out[name] = dict(
            right=right,
            seeds=seeds,
            evaluations=float(np.mean(spent)),
            cpu_seconds=(time.process_time() - begin) / seeds,
        )
    return out


ANY = {(None, "gust"), (None, "delay")}


def rules(seeds, budget):
    """Precision and recall of the rules for each planted cause, on fresh episodes."""
    return _rules_of_causes(
        seeds, lambda p, seed: p.episodes(p.sample(np.random.default_rng(seed), GIVEN))
    )


def rules_of_estimates(seeds, budget):
    """The same where the failures are those of an estimate, whose proposal may lack a cause."""
    estimate = jast.estimate.failure_probability
    return _rules_of_causes(seeds, lambda p, seed: estimate(jax.random.key(seed), p.sim, budget))


def _rules_of_causes(seeds, given):
    out = {}
    for name in PLANTED:
        rows = {}
        for seed in range(seeds):
            p, key = planted(name, seed), jax.random.key(seed)
            failures = given(p, seed)
            begin, found = time.process_time(), None
            with contextlib.suppress(ValueError):  # an estimate that met no failure
                found = explain.rules(p.sim, failures, key=key)
            cost = time.process_time() - begin
            for cause in range(len(p.causes)):
                told = (0.0, 0.0, False) if found is None else _on_fresh(found, p, cause, seed)
                row = dict(zip(("precision", "recall", "named"), told))
                row |= dict(cpu_seconds=cost, rules=0 if found is None else len(found.rules))
                rows.setdefault(cause, []).append(row)
        for cause, each in rows.items():
            label = name if len(rows) == 1 else f"{name}: {'the rarer' if cause else 'the other'}"
            columns = {k: [float(row[k]) for row in each] for k in each[0]}
            out[label] = dict(
                both_95=sum(r["precision"] >= 0.95 and r["recall"] >= 0.95 for r in each),
                named=int(sum(columns["named"])),
                seeds=seeds,
                precision=float(np.median(columns["precision"])),
                worst_precision=min(columns["precision"]),
                recall=float(np.median(columns["recall"])),
                worst_recall=min(columns["recall"]),
                rules=float(np.mean(columns["rules"])),
                cpu_seconds=float(np.median(columns["cpu_seconds"])),
            )
    return out


def _on_fresh(found, p, cause, seed):
    """(precision, recall, whether a rule speaks of just what was planted)."""
    rng = np.random.default_rng([seed, 1 + cause])
    bad = p.episodes(p.failing(rng, cause, FRESH))
    near = p.episodes(p.near(rng, cause, FRESH))
    shape = FRESH, 50
    plain = p.episodes(dict(delay=rng.exponential(0.2, shape), gust=rng.standard_normal(shape)))
    calm = [
        jax.tree.map(lambda a, e=e: a[np.flatnonzero(~np.asarray(e.failure))[: FRESH // 2]], e)
        for e in (near, plain)
    ]

    def fails(e):
        return found.predict(e) == "fails"

    assert np.asarray(bad.failure).all()
    hits, wrong = int(fails(bad).sum()), sum(int(fails(e).sum()) for e in calm)
    speaks = [{what for what, *_ in rule.conditions} for rule in found.rules]
    others = [p.named(k) for k in range(len(p.causes)) if k != cause]
    # beside what was planted a rule may say that it is not about the other cause
    named = any(p.named(cause) <= s <= p.named(cause).union(*others) for s in speaks)
    return hits / max(hits + wrong, 1), hits / FRESH, named


def criticality(seeds, budget):
    """How many of the 95 % intervals, one for each state of each episode, hold the closed form."""
    held, total, off = 0, 0, []
    sim, steps = walk(10.0), 20
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        x = rng.standard_normal(steps)
        x += max(10.0 - x.sum(), 0) / steps + 0.01
        c = explain.criticality(jax.random.key(seed), sim, jast.replay(sim, jnp.asarray(x, "f4")))
        so_far = np.concatenate([[0.0], np.cumsum(x)])
        left = np.sqrt(steps - np.arange(steps))
        truth = [NormalDist().cdf(v) for v in (so_far[:-1] - 10.0) / left] + [1.0]
        held += sum(a <= t <= b for (a, b), t in zip(c.interval, truth, strict=True))
        total += len(truth)
        off.append(float(np.abs(c.probability - truth).max()))
    return dict(held=int(held), intervals=total, seeds=seeds, worst_error=max(off))


def sensitivity(seeds, budget):
    """How many derivatives are within 2 standard errors of the truth."""

    def hazard(b):
        return NormalDist().pdf(b) / NormalDist().cdf(-b)

    beta = 4.0
    spread = math.sqrt(0.1**2 + 10 * 0.03**2)
    cases = {
        "hyperplane": (_hyperplane(beta), {"disturbance[0]": hazard(beta) * beta}),
        "landing": (
            jast.simulators.landing(),
            {
                "start[0]": hazard(1 / spread) * 0.1 / spread**3,
                "disturbance[0]": hazard(1 / spread) * 10 * 0.03 / spread**3,
            },
        ),
    }
    out = {name: _within_2(*case, seeds, budget) for name, case in cases.items()}
    out["lane (finite differences)"] = _within_2(
        lane(0.1, 0.1), _finite_differences(budget), seeds, budget
    )
    return out


def _hyperplane(beta):
    """Ten numbers of spread s: P = Phi(-beta / s) at s = 1."""
    return jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + x / math.sqrt(10),
        disturbance=Partial(_of_spread, jnp.asarray(1.0)),
        evaluate=Partial(_above, jnp.asarray(beta)),
        horizon=10,
        episodic=True,
    )


def _of_spread(spread, s):
    return Normal(jnp.zeros_like(spread), spread)


def _above(limit, s):
    return s >= limit, jnp.maximum(limit - s, 0.0)


def _finite_differences(budget):
    """(d log P, its standard error) of the lane, by central differences of large estimates."""
    h, out = 0.03, {}
    for i, name in enumerate(("disturbance[0]", "disturbance[1]")):
        ends = []
        for way in (1, -1):
            at = [0.1, 0.1]
            at[i] *= 1 + way * h
            key, sim = jax.random.key(100 + i), lane(*at)
            ends.append(jast.estimate.failure_probability(key, sim, 8 * budget))
        slope = (ends[0].log_mean - ends[1].log_mean) / (2 * h * 0.1)
        error = math.hypot(*(e.relative_error for e in ends)) / (2 * h * 0.1)
        out[name] = slope, error
    return out


def _within_2(sim, truths, seeds, budget):
    names, z = list(truths), []
    for seed in range(seeds):
        key = jax.random.key(seed)
        estimate = jast.estimate.failure_probability(key, sim, budget)
        found = explain.sensitivity(sim, estimate, key=key)
        rows = {name: (slope, error) for name, _, slope, error, _ in found.rows}
        for name in names:
            truth, known = truths[name] if isinstance(truths[name], tuple) else (truths[name], 0.0)
            slope, error = rows[name]
            z.append((slope - truth) / math.hypot(error, known))
    z = np.array(z)
    return dict(
        within_2=int(np.sum(np.abs(z) <= 2)),
        of=len(z),
        seeds=seeds,
        worst=float(np.abs(z).max()),
        mean=float(z.mean()),
        spread=float(z.std()),
    )


def differential(seeds, budget):
    """A regression on one branch: P = 1e-6, and the likeliest costs SIDE^2 / 2."""
    near, covered, reliable, logs, begin = 0, 0, 0, [], time.process_time()
    before, after = version(False), version(True)
    for seed in range(seeds):
        report = explain.differential(jax.random.key(seed), before, after, 3 * budget)
        best = float(report.failures.best.reward) if len(report.failures) else -math.inf
        near += abs(best + SIDE**2 / 2) <= 0.1
        p = report.probability
        low, high = p.interval
        covered += low <= 1e-6 <= high
        reliable += p.reliable
        logs.append(p.log_mean - math.log(1e-6))
    return dict(
        within_a_tenth_nat=near,
        covered=covered,
        reliable=reliable,
        seeds=seeds,
        spread_log_p=float(np.std(logs)),
        mean_log_p=float(np.mean(logs)),
        cpu_seconds=(time.process_time() - begin) / seeds,
    )


MONITORED = {
    "walk": (lambda: walk(14.0), 3),
    "pendulum": (jast.simulators.pendulum, 3),
    "relay": (stress_systems.relay, 5),
    "drone": (stress_systems.drone, 5),
}


def monitor(seeds, budget):
    """Area under the ROC curve of episodes held out, and how many steps ahead it warns at 1 % of
    false alarms.
    """
    out = {}
    for name, (make, within) in MONITORED.items():
        sim, rows = make(), []
        for seed in range(seeds):
            key = jax.random.key(seed)
            estimate = jast.estimate.failure_probability(key, sim, budget)
            if estimate.proposal is None:
                rows.append(None)
                continue
            begin = time.process_time()
            m = explain.monitor(sim, estimate, within=within, key=key)
            rows.append((m.auc, m.warned[0], m.ahead[1], m.false_alarms[0]))
            rows[-1] += (time.process_time() - begin,)
        told = np.array([row for row in rows if row is not None])
        names = "auc", "warned", "ahead", "false_alarms", "cpu_seconds"
        out[name] = dict(zip(names, np.median(told, axis=0).tolist())) if len(told) else {}
        out[name] |= dict(within=within, told=len(told), seeds=seeds)
    return out


def ferry(seeds, budget):
    """CPU seconds of explaining one failure of S0, once everything is compiled."""
    sim = jast.simulators.ferry()
    found = jast.search.cem(jax.random.key(0), sim)
    e = found.failures[0]
    calls = dict(
        minimal=lambda: explain.minimal(sim, e),
        criticality=lambda: explain.criticality(jax.random.key(1), sim, e, draws=200),
        attribution=lambda: explain.attribution(sim, e, permutations=20),
        rules=lambda: explain.rules(sim, e, episodes=300),
    )
    out = {}
    for name, call in calls.items():
        call()
        begin = time.process_time()
        call()
        out[name] = time.process_time() - begin
    return out


PARTS = (minimal, rules, rules_of_estimates, criticality, sensitivity, differential, monitor, ferry)
PARTS = {f.__name__: f for f in PARTS}


def run(parts, seeds, budget):
    with warnings.catch_warnings(action="ignore"):
        return {name: PARTS[name](seeds, budget) for name in parts}


def lines(report, name=""):
    """The report as text, a line for each case."""
    if not any(isinstance(v, dict) for v in report.values()):

        def number(v):
            return f"{v:.4g}" if isinstance(v, float) else str(v)

        yield f"{name:<52} " + ", ".join(f"{k} {number(v)}" for k, v in report.items())
        return
    for key, value in report.items():
        yield from lines(value, f"{name}: {key}" if name else key)


QUICK = [part for part in PARTS if part not in ("rules_of_estimates", "sensitivity")]
"""Those that need no estimate of a system each, which takes a while to compile."""


def main(argv=None):
    parser = options(__doc__, "two seeds, fewer evaluations")
    add_choices(parser, "--parts", PARTS)
    parser.add_argument("--seeds", type=int, help="default: 20")
    args = parser.parse_args(argv)
    parts = args.parts or size(args, list(PARTS), QUICK, ["criticality"])
    seeds = args.seeds or size(args, 20, 2, 1)
    budget = size(args, 20_000, 10_000, 2000)
    report = run(parts, seeds, budget)
    settings = dict(budget=budget, seeds=seeds)
    print_report(args, dict(settings=settings, parts=report), "\n".join(lines(report)))


if __name__ == "__main__":
    main()
