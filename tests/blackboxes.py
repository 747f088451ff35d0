"""Small systems in plain Python that the tests run on the host. Neither jast nor JAX is imported,
so that worker processes need neither.
"""

import os
import signal
import sys
import time

import numpy as np


def walk(disturbances):
    """A walk that fails where it has gone 4 at the end; its miss distance is what is left."""
    s = float(np.sum(disturbances, dtype=np.float64))
    return s >= 4.0, max(4.0 - s, 0.0)


def shifted(disturbances, x0):
    """`walk` from x0."""
    return walk(np.append(disturbances, x0))


def branches(disturbances):
    """The limit state of four branches: a row of two numbers."""
    a, b = map(float, disturbances[0])
    g = min(3 + 0.1 * (a - b) ** 2 - abs(a + b) / 2**0.5, abs(7 / 2**0.5) - abs(a - b))
    return g <= 0, max(g, 0.0)


def troubled(disturbances):
    """What goes wrong is decided by the first number: 1 raises, 2 waits, 3 waits where nothing
    interrupts, 4 ends the process, 5, 6, 7 answer nonsense.
    """
    trouble = int(round(float(disturbances[0])))
    if trouble == 1:
        return True, 1.0 / 0
    if trouble == 2:
        time.sleep(60)
    if trouble == 3:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
        time.sleep(60)
    if trouble == 4:
        os._exit(3)
    return {5: (True, np.zeros(2)), 6: (True, np.nan), 7: False}.get(
        trouble, (False, float(disturbances[0]))
    )


def modules(disturbances):
    """Whether the process has JAX, as a distance of 1; else 0."""
    return False, float("jax" in sys.modules or "jast" in sys.modules)


def process(disturbances):
    """The number of the process."""
    return False, float(os.getpid())


class Walk:
    """`walk` as an object that is looked at after every disturbance; it ends, without a failure,
    below -4.
    """

    def initialize(self, x0=0.0):
        self.s = float(x0)

    def transition(self, x):
        self.s += float(x)

    def is_event(self):
        return self.s >= 4.0

    def miss_distance(self):
        return max(4.0 - self.s, 0.0)

    def is_terminal(self):
        return self.s < -4.0

    def observe(self):
        return np.array([self.s, 1.0])


class Fragile(Walk):
    """Raises beyond 2."""

    def transition(self, x):
        super().transition(x)
        if self.s > 2:
            raise RuntimeError("beyond 2")


class Forgetful(Walk):
    """Draws what it should have been given."""

    def __init__(self):
        self.random = np.random.default_rng()

    def transition(self, x):
        super().transition(x + self.random.normal())

    def miss_distance(self):  # no two are the same, those of failures neither
        return 4.0 - self.s


class Sampled(Walk):
    """`Walk` that draws its own step by a seed, and returns the step's log density."""

    def drawn(self, seed):
        return float(np.random.default_rng(int(seed)).normal())

    def transition(self, seed):
        x = self.drawn(seed)
        super().transition(x)
        return -0.5 * x**2 - 0.5 * np.log(2 * np.pi)


class Likely(Sampled):
    """`Sampled` that returns the density itself."""

    def transition(self, seed):
        return np.exp(super().transition(seed))


class Evaluated(Sampled):
    """`Sampled` by the <p, e, d> of its ``evaluate``."""

    def initialize(self):
        super().initialize()
        self.log_p = 0.0

    def transition(self, seed):
        self.log_p += super().transition(seed)
        return 100.0  # what evaluate returns stands in its place

    def evaluate(self):
        log_p, self.log_p = self.log_p, 0.0
        return log_p, super().is_event(), super().miss_distance()

    def is_event(self):
        raise RuntimeError("not asked for")


class Leaves(Walk):
    """Fails while it is 4 or more away from 0: it may come back."""

    def is_event(self):
        return abs(self.s) >= 4.0

    def miss_distance(self):
        return max(4.0 - abs(self.s), 0.0)

    def is_terminal(self):
        return False


class Left(Leaves):
    """`Leaves` that remembers."""

    def initialize(self):
        super().initialize()
        self.farthest = 0.0

    def transition(self, x):
        super().transition(x)
        self.farthest = max(self.farthest, abs(self.s))

    def is_event(self):
        return self.farthest >= 4.0


class Delivered(Leaves):
    """`Leaves` that knows nothing before its ``evaluate`` at the end, after 8 disturbances."""

    def initialize(self):
        super().initialize()
        self.steps, self.late = 0, None

    def transition(self, x):
        super().transition(x)
        self.steps += 1

    def evaluate(self):
        if self.steps < 8:
            raise RuntimeError("asked before the end")
        self.late = abs(self.s) >= 4.0

    def is_event(self):
        return self.late
