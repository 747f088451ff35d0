"""MCFS-AP and MCTS-SA on the S0 ferry in plain Python: the baseline of speed and of results that
the JAX engine is compared with.

Algorithm 1 of Lytskjold and Mengshoel (MCFS-AP) without networks, with their settings: one tree is
18 roots of 500 simulations each; MCTS-SA is the same code with one root of 9000. Only the standard
library is used; states are kept in the tree, so a simulation never steps through its prefix again.

    python -m benchmarks.reference [--quick] [--sa] [--json]

Expected share of trees that find a collision: 29.8 % (forest, n = 2000), 40.5 % (--sa, n = 1500).
"""

import argparse
import json
import random
import time
from math import cos, log, pi, sin, sqrt

__all__ = ["forest", "interval"]

FERRY_Y = 50.0  # where the ferry crosses
SPEED = 5.0  # of both vessels, a step
COLLISION = 5.0  # distance of the centres
STEPS = 21  # of an episode
START = (16.0, 0.0)  # of the steered vessel
TURN = pi / 100


class Node:
    """A visited state. ``values`` and ``bonuses`` hold a child's mean reward and 10 / sqrt(1 + N),
    side by side for a fast choice.
    """

    __slots__ = (
        "parent",
        "index",
        "step",
        "x",
        "y",
        "heading",
        "seed",
        "nearest",
        "log_p",
        "ending",
        "visits",
        "seeds",
        "children",
        "values",
        "bonuses",
    )

    def __init__(self, parent, index, step, x, y, heading, seed, nearest, log_p, ending):
        self.parent, self.index, self.step = parent, index, step
        self.x, self.y, self.heading, self.seed = x, y, heading, seed
        self.nearest = nearest  # squared closest approach so far
        # of the step into this state; reward of the episode's end here, or None
        self.log_p, self.ending = log_p, ending
        self.visits = 0
        self.seeds, self.children, self.values, self.bonuses = [], [], [], []


def forest(seed, prunes=18, simulations=500, k=0.5, alpha=0.6, exploration=10.0):
    """Grow one tree: ``(best reward, simulations done, simulator steps)``.

    Each of ``prunes`` roots gets ``simulations``; then its most visited child becomes the root. A
    node gains a child while it has no more than ``k N**alpha``. ``prunes=1, simulations=9000`` is
    MCTS-SA. A reward above 0 is a collision.
    """
    uniform = random.Random(seed).random
    most = prunes * simulations + 2
    limit = [k * n**alpha for n in range(most)]
    spread = [0.0] + [sqrt(log(n)) for n in range(1, most)]
    bonus = [exploration / sqrt(1 + n) for n in range(most)]
    root = Node(None, 0, 0, *START, 0.0, 0.5, START[0] ** 2 + (START[1] - FERRY_Y) ** 2, 0.0, None)
    root.visits = 1
    best, done, steps = -float("inf"), 0, 0

    for _ in range(prunes):
        for _ in range(simulations):
            node = root
            while node.ending is None:
                values, bonuses = node.values, node.bonuses
                if len(values) <= limit[node.visits]:
                    node.seeds.append(uniform())
                    node.children.append(None)
                    values.append(0.0)
                    bonuses.append(exploration)
                c = spread[node.visits]
                scores = [q + c * b for q, b in zip(values, bonuses)]
                i = scores.index(max(scores))
                child = node.children[i]
                if child is None:
                    node.children[i] = node = _first_visit(node, i)
                    steps += 1
                    break
                node = child

            if node.ending is None:
                reward, taken = _rollout(node, uniform)
                steps += taken
            else:
                reward = node.ending
            done += 1

            # the mean reward from each node on, up to the original root: the ancestors of a pruned
            # root learn too
            parent = node.parent
            while parent is not None:
                reward += node.log_p
                node.visits = n = node.visits + 1
                i, values = node.index, parent.values
                values[i] += (reward - values[i]) / n
                parent.bonuses[i] = bonus[n]
                node, parent = parent, parent.parent
            node.visits += 1
            if reward > best:
                best = reward

        visited = [child for child in root.children if child is not None]
        if not visited:  # the root ends its episode
            break
        root = max(visited, key=lambda child: child.visits)  # the first of equals
    return best, done, steps


def _first_visit(node, index):
    """The new child of ``node``, one step on."""
    seed, step = node.seeds[index], node.step + 1
    heading = node.heading + (10 * seed - 5) * TURN
    x, y = node.x + SPEED * sin(heading), node.y + SPEED * cos(heading)
    square = (x - SPEED * step) ** 2 + (y - FERRY_Y) ** 2
    nearest = min(node.nearest, square)
    log_p = log(1 - abs(seed - node.seed)) if node.step else 0.0
    ending = 30.0 if square < COLLISION**2 else -sqrt(nearest) if step == STEPS else None
    return Node(node, index, step, x, y, heading, seed, nearest, log_p, ending)


def _rollout(node, uniform):
    """Random seeds from ``node`` to the end: the reward after ``node``, and the steps taken."""
    x, y, heading, last, nearest, likelihood = (
        node.x,
        node.y,
        node.heading,
        node.seed,
        node.nearest,
        1.0,
    )
    for step in range(node.step + 1, STEPS + 1):
        seed = uniform()
        likelihood *= 1 - abs(seed - last)
        heading += (10 * seed - 5) * TURN
        x += SPEED * sin(heading)
        y += SPEED * cos(heading)
        square = (x - SPEED * step) ** 2 + (y - FERRY_Y) ** 2
        if square < nearest:
            nearest = square
            if square < COLLISION**2:
                return 30.0 + log(likelihood), step - node.step
        last = seed
    return log(likelihood) - sqrt(nearest), STEPS - node.step


def interval(successes, n, z=1.959963984540054):
    """Wilson's score interval of a share, 95 % by default: ``(low, high)``."""
    share, square = successes / n, z * z
    middle, half = (
        share + square / (2 * n),
        z * sqrt(share * (1 - share) / n + square / (4 * n * n)),
    )
    return (middle - half) / (1 + square / n), (middle + half) / (1 + square / n)


def main(arguments=None):
    parser = argparse.ArgumentParser(description="MCFS-AP on the S0 ferry in plain Python.")
    parser.add_argument("--trees", type=int, help="how many (default 60)")
    parser.add_argument("--quick", action="store_true", help="10 trees")
    parser.add_argument("--seed", type=int, default=0, help="of the first tree; the others follow")
    parser.add_argument("--sa", action="store_true", help="MCTS-SA: one root of 9000 simulations")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(arguments)
    settings = dict(prunes=1, simulations=9000) if args.sa else dict(prunes=18, simulations=500)

    start = time.process_time()
    count = args.trees or (10 if args.quick else 60)
    trees = [forest(args.seed + i, **settings) for i in range(count)]
    seconds = time.process_time() - start

    best, done, steps = (list(column) for column in zip(*trees))
    failing = sum(b > 0 for b in best)
    low, high = interval(failing, len(best))
    report = dict(
        method="MCTS-SA" if args.sa else "MCFS-AP",
        seed=args.seed,
        trees=len(best),
        failing=failing,
        rate=failing / len(best),
        interval=[low, high],
        mean_best=sum(best) / len(best),
        best=max(best),
        simulations=sum(done),
        steps=sum(steps),
        cpu_seconds=seconds,
        simulations_per_second=sum(done) / seconds,
    )
    if args.json:
        print(json.dumps(report))
    else:
        print(
            f"{report['method']}, plain Python, {len(best)} trees: {failing} fail,"
            f" {100 * failing / len(best):.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
        )
        print(
            f"mean best {report['mean_best']:.2f}, best {max(best):.3f}; {sum(done)} simulations,"
            f" {sum(steps)} steps"
        )
        print(f"{seconds:.1f} CPU s: {report['simulations_per_second']:.0f} simulations a second")


if __name__ == "__main__":
    main()
