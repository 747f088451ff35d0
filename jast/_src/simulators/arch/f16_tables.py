"""The tables of the F-16 in Stevens and Lewis, Aircraft Control and Simulation, appendix A.

A smaller version of the wind-tunnel data of Nguyen and others (1979), NASA TP-1538, without the
leading edge flap. The numbers, in `f16.json`, were taken from FlightMechanicsSimulator.jl (A. Saez,
MIT licence), which marks two misprints of the book as Morelli corrected them (CYp at 45 degrees is
-.227, Cmq at -5 degrees is -5.40). Angles of attack are -10, -5, .. 45 degrees.
"""

import numpy as np

from jast._src.simulators.arch._table import read

__all__ = ["DAMPING", "LIFT", "PITCHING", "SLIPPING", "STEERING", "THRUST"]

_TABLES = read("f16.json")


def _side_by_side(name: str) -> np.ndarray:
    """Tables [m, n] of one place in the file, as one [n, m, tables]"""
    return np.stack([table.T for table in _TABLES[name].values()], axis=-1)


DAMPING = np.stack(list(_TABLES["damping"].values()), axis=-1)
"""[12, 9]: CX by q, CY by r and p, CZ by q, Cl by r and p, Cm by q, Cn by r and p."""
LIFT = _TABLES["lift"]
PITCHING = _side_by_side("pitching") / 1000
"""[12, 5, 2]: CX and Cm, by the elevator at -24, -12, .. 24 degrees."""
_RIGHT = _side_by_side("slipping") / 1000
SLIPPING = np.concatenate([0 - _RIGHT[:, :0:-1], _RIGHT], axis=1)
"""[12, 13, 2]: Cl and Cn, by a sideslip of -30, -25, .. 30 degrees."""
STEERING = _side_by_side("steering") / 1000
"""[12, 7, 4]: Cl and Cn by the aileron at 20 degrees, then by the rudder at 30; by a sideslip of
-30, -20, .. 30 degrees."""
THRUST = np.stack(list(_TABLES["thrust"].values()), axis=-1)
"""[6, 6, 3] lb, by Mach 0, .2, .. 1 and altitude of 0, 10,000, .. 50,000 ft: idle, military,
maximum."""
