"""A flight management system with a defect: `jast.simulators.fms`.

`geodesic`: the shortest ways on an ellipsoid; `lateral`: the path through a list of waypoints, and
the defect; `events`: what may be wrong with it; `database`: named waypoints; `system`: all of it as
a `jast.Simulator`.
"""
