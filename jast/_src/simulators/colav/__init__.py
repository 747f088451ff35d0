"""A ferry that avoids collisions: `jast.simulators.colav`.

`scenarios`: the encounters as data; `vessels`: dynamics and control; `tracker`: the past that
delays refer to, and what the ferry makes of it; `planner`: safety zones and speed; `system`: all of
it as a `jast.Simulator`.
"""
