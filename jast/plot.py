"""Pictures of episodes and searches, with matplotlib (the extra ``jast[plot]``), which is imported
only when something is drawn.

`report` makes one page of a report of `jast.stress`. Every other function draws into the ``ax`` (or
``axes``) it is given, or into a new figure, and returns the axes. What is drawn comes first, then
its simulator where a picture needs it. The colours are Okabe and Ito's, told apart by colour-blind
readers; what matters is told by shape or words as well.

Of any system: `traces`, `phase`, `failure_fan`, `disturbances`, `distances`; of a search `history`,
`trials`, `trial_distances`; of its tree `tree`, and `tree_page`, an HTML file. Of one simulator:
`ferry`; `fms`; `colav`, `colav_published`, `colav_story`, `colav_animation`. Of cross-entropy
methods: `convergence`, `proposal_contours`, `surrogate_samples`. Of failure probabilities:
`probability`, `exceedance`, `weights`, `levels`; against a setting: `sweep`. Of failure policies:
`training`. Of weakness recognition: `failures_found`, `roc`, `first_failures`, `contributions`.
"""

from jast._src.plot.colav import colav, colav_animation, colav_story
from jast._src.plot.colav_published import colav_published
from jast._src.plot.cross_entropy import convergence, proposal_contours, surrogate_samples
from jast._src.plot.curves import exceedance, sweep
from jast._src.plot.episodes import distances, disturbances, history
from jast._src.plot.failing_inputs import contributions, first_failures
from jast._src.plot.failure_fan import failure_fan
from jast._src.plot.ferry import ferry
from jast._src.plot.fms import fms
from jast._src.plot.probability import probability, weights
from jast._src.plot.report import report
from jast._src.plot.style import COLOURS, STYLE
from jast._src.plot.traces import phase, traces
from jast._src.plot.training import levels, training
from jast._src.plot.tree import tree, tree_page
from jast._src.plot.trials import trial_distances, trials
from jast._src.plot.weakness import failures_found, roc
from jast._src.util.doors import dir_function, door

__all__ = [
    "COLOURS",
    "STYLE",
    "colav",
    "colav_animation",
    "colav_published",
    "colav_story",
    "contributions",
    "convergence",
    "disturbances",
    "distances",
    "exceedance",
    "failure_fan",
    "failures_found",
    "first_failures",
    "ferry",
    "fms",
    "history",
    "levels",
    "phase",
    "probability",
    "report",
    "proposal_contours",
    "roc",
    "sweep",
    "surrogate_samples",
    "traces",
    "training",
    "tree",
    "tree_page",
    "trial_distances",
    "trials",
    "weights",
]

_FORMER = {
    "confusion": "is now in benchmarks/weakness_figures.py of the repository",
    "failure_grid": "is now jast.plot.first_failures",
    "influence": "is now jast.plot.contributions",
    "likely_failures": "is now in benchmarks/weakness_figures.py of the repository",
    "pixel_likelihood": "is now in benchmarks/weakness_figures.py of the repository",
    "sierra": "is now in benchmarks/sierra_figure.py of the repository",
    "threshold_sweep": "is now in benchmarks/weakness_figures.py of the repository",
}
__getattr__ = door(__name__, former=_FORMER)
__dir__ = dir_function(__all__)
