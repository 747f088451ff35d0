"""pyTAMS (pip install pytams) on the two channels of benchmarks.splitting, in plain Python as its
models are. It draws from NumPy's own entropy, so no key repeats it.
"""

import math
import os
import tempfile
from pathlib import Path

import numpy as np
import toml
from pytams.fmodel import ForwardModelBaseClass
from pytams.tams import TAMS

__all__ = ["run"]


class Channels(ForwardModelBaseClass):
    """`benchmarks.splitting.channels_step`, a step at a time."""

    def _init_model(self, m_id, params):
        self.at, self.drawn, self.rng = (-0.9, 0.1), [], np.random.default_rng()

    def _advance(self, step, t, dt, noise, need_end_state):
        (x, y), exp = self.at, math.exp
        hill, dip = exp(-(x**2) - (y - 1 / 3) ** 2), exp(-(x**2) - (y - 5 / 3) ** 2)
        right, left = exp(-((x - 1) ** 2) - y**2), exp(-((x + 1) ** 2) - y**2)
        along = 0.8 * x**3 - 6 * x * (hill - dip) + 10 * ((x - 1) * right + (x + 1) * left)
        across = 0.8 * (y - 1 / 3) ** 3 - 6 * (y - 1 / 3) * hill + 6 * (y - 5 / 3) * dip
        across += 10 * y * (right + left)
        width = math.sqrt(2 * dt / 5.67)
        self.at = x - dt * along + width * noise[0], y - dt * across + width * noise[1]
        return dt

    def get_current_state(self):
        return self.at

    def set_current_state(self, state):
        self.at = state

    def score(self):
        return math.hypot(self.at[0] + 1, self.at[1]) / 2.1

    def make_noise(self):
        if not self.drawn:
            self.drawn = self.rng.standard_normal((256, 2)).tolist()
        return self.drawn.pop()


def run(trajectories: int) -> tuple[float, int]:
    """Its estimate with so many trajectories, and the steps that it took."""
    settings = dict(
        tams=dict(ntrajectories=trajectories, nsplititer=50 * trajectories, loglevel="ERROR"),
        runner=dict(type="asyncio", nworker_init=1, nworker_iter=1),
        trajectory=dict(end_time=20.0, step_size=0.01, targetscore=1.0, sparse_freq=1),
    )
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            Path("input.toml").write_text(toml.dumps(settings))
            tams = TAMS(Channels, [])
            try:
                mean = float(tams.compute_probability())
            except RuntimeError:  # all of them tie: they died out
                mean = 0.0
            return mean, int(tams._tdb.count_computed_steps())
        finally:
            os.chdir(here)
