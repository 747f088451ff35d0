"""S1's open stand-in: a ferry that avoids collisions by what it senses, an adversary, and delays,
steering and noise between them.

The S1 of Lytskjold and Mengshoel (the mA2 ferry with its collision avoidance) is proprietary. This
system has its shape, not its numbers: the published starts and routes, zones, penalties, gains,
speed range and disturbances, on a published vessel model; what was not published is ours, and says
so where it stands. Measured rates and what the searches find: ``python -m benchmarks.colav``.
"""

from jast._src.simulators.colav.scenarios import SCENARIOS, Scenario
from jast._src.simulators.colav.system import ColavState, colav

__all__ = ["SCENARIOS", "ColavState", "Scenario", "colav"]
