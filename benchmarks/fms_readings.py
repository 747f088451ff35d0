"""Algorithm 9 of Moss's thesis in the readings that its text allows: what the modified tree search
finds on the stand-in for a flight management system.

``python -m benchmarks.fms_readings [--json] [--quick | --smoke] [--seeds N]``. With half of its
depth to go a rollout takes the best action so far, a*, "updated based on updated Q-values". The
search of Algorithms 7 to 11 is written out here in plain Python, apart from the engine, with the
thesis's settings (Table 3.2: exploration 10, widening 10 and 0.3, eq. 3.2 as printed) and these a*:

- episode: the action that the best episode took there, which `jast.search` does;
- root: the action at the root of the greatest Q, which Algorithm 7 returns;
- level: of all edges where half of the depth is to go, the action of the greatest Q;
- edge: of all edges of the tree, the action of the greatest Q;
- visited: the last of them that has been visited twice or more, else any;
- none: no a*.

Shares are of the simulations of a seed, repetitions included, as the thesis counts.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.fms import quantiles, spread
from benchmarks.sizes import options, print_report, printer, size
from jast.simulators.fms import MEANS, SIGMAS, fms

READINGS = ("episode", "root", "level", "edge", "visited", "none")
DEPTH = 12  # waypoints of a route
EXPLORATION = 10.0  # Table 3.2
WIDENING = (10.0, 0.3)  # Table 3.2
BONUS = 100.0  # of a failure: eq. 3.2


class Node:
    """A state of the tree: its visits and its edges, each (action [4], visits, Q, child)."""

    def __init__(self, value=None):
        self.visits, self.edges, self.value = 0, [], value


class Edge:
    """An action of a node."""

    def __init__(self, action):
        self.action, self.visits, self.q, self.child = action, 0, 0.0, None


class Tree:
    """One search by the readings of a*."""

    def __init__(self, judge, seed, reading):
        self.judge, self.reading = judge, reading
        self.rng, self.root = np.random.default_rng(seed), Node()
        self.edges, self.best, self.failures = [], (-math.inf, None), set()

    def draw(self):
        return self.rng.normal(MEANS, SIGMAS)

    def simulate(self):
        """One simulation of Algorithm 8; whether its episode failed."""
        node, path, route = self.root, [], []
        while node.value is None and (not path or path[-1].visits):
            node.visits += 1
            k, alpha = WIDENING
            if len(node.edges) <= k * node.visits**alpha:
                node.edges.append(Edge(self.draw()))
                self.edges.append((len(path), node.edges[-1]))
            edge = max(node.edges, key=lambda e: score(e, node.visits))
            path.append(edge)
            route.append(edge.action)
            if edge.child is None:
                edge.child = Node()
            node = edge.child
        if node.value is None:
            reward, failed = self.rollout(route)
            if len(path) == DEPTH:
                node.value = reward, failed
        else:
            reward, failed = node.value
        for edge in path:
            edge.visits += 1
            edge.q += (reward - edge.q) / edge.visits
        return failed

    def rollout(self, route):
        """Algorithm 9 from the end of ``route``: the episode's reward, and whether it fails."""
        route = list(route)
        while len(route) < DEPTH:
            fed = self.fed() if DEPTH - len(route) == DEPTH // 2 else None
            route.append(self.draw() if fed is None else fed)
        route = np.stack(route)
        distance = float(self.judge(route))
        z = (route - np.asarray(MEANS)) / np.asarray(SIGMAS)
        log_p = float(-0.5 * np.sum(z**2) - DEPTH * np.sum(np.log(SIGMAS) + 0.5 * LOG_2PI))
        failed = distance <= 0
        reward = (log_p - distance) * (BONUS if failed else 1.0)
        if reward > self.best[0]:
            self.best = reward, route[DEPTH - DEPTH // 2]
        if failed:
            self.failures.add(route.tobytes())
        return reward, failed

    def fed(self):
        """a*, or None where there is none yet."""
        if self.reading == "none":
            return None
        if self.reading == "episode":
            return self.best[1]
        edges = [e for _, e in self.edges if e.visits]
        if self.reading == "root":
            edges = [e for e in self.root.edges if e.visits]
        if self.reading == "level":
            edges = [e for depth, e in self.edges if e.visits and depth == DEPTH - DEPTH // 2]
        if self.reading == "visited":
            edges = [e for e in edges if e.visits > 1] or edges
        return max(edges, key=lambda e: e.q).action if edges else None


LOG_2PI = math.log(2 * math.pi)


def score(edge, visits):
    """Algorithm 10: an action that was never tried comes first."""
    if not edge.visits:
        return math.inf
    return edge.q + EXPLORATION * math.sqrt(math.log(visits) / edge.visits)


def judge_of(sim):
    """Route [12, 4] -> miss distance, compiled."""

    @jax.jit
    def judge(route):
        state, _ = jax.lax.scan(lambda s, x: (sim.step(s, x), None), sim.init(()), route)
        return sim.evaluate(state)[1]

    return lambda route: judge(jnp.asarray(route))


def run(reading, judge, seeds, simulations):
    """A row: shares with repetitions, and distinct failures."""
    shares, distinct = [], []
    for seed in range(seeds):
        tree = Tree(judge, seed, reading)
        shares.append(np.mean([tree.simulate() for _ in range(simulations)]))
        distinct.append(len(tree.failures))
    return {
        "with_repetitions": quantiles(np.array(shares)),
        "distinct_mean": float(np.mean(distinct)),
        "distinct_median": float(np.median(distinct)),
    }


def main(argv=None):
    parser = options(__doc__, "4 seeds of 1000 simulations, in under two minutes")
    parser.add_argument("--seeds", type=int, help="default 24")
    args = parser.parse_args(argv)
    say, out = printer(args), {}
    seeds, simulations = args.seeds or size(args, 24, 4, 1), size(args, 5000, 1000, 40)
    say(f"{simulations} simulations, {seeds} seeds: share that fails with repetitions, mean; 10,")
    say("50, 90 % of seeds, the greatest; distinct failures, mean, median")
    with jax.enable_x64(True):
        judge = judge_of(fms())
        for reading in READINGS:
            row = out[reading] = run(reading, judge, seeds, simulations)
            say(
                f"  {reading:8} {spread(row['with_repetitions'])}   {row['distinct_mean']:.0f},"
                f" {row['distinct_median']:.0f}"
            )
    print_report(args, out)


if __name__ == "__main__":
    main()
