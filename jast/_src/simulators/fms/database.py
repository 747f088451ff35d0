"""Named radio beacons (VORs) between San Francisco and Los Angeles: the waypoints of the baseline
that flies from a navigation database.

Positions are public and approximate, to about a minute of arc: good for a baseline, not for
navigation.
"""

import numpy as np

__all__ = ["APART", "FIXES", "KLAX", "KSFO", "POSITIONS"]

# latitude and longitude (degrees): where all routes begin and end
KSFO, KLAX = (37.6188, -122.3750), (33.9425, -118.4081)
NEAR = 5.0  # nmi: no leg to a beacon or from one is shorter

FIXES = {
    "PYE": (38.080, -122.868),
    "OAK": (37.726, -122.224),
    "SFO": (37.619, -122.374),
    "OSI": (37.392, -122.281),
    "SJC": (37.375, -121.945),
    "MOD": (37.627, -120.958),
    "CZQ": (36.884, -119.815),
    "PXN": (36.715, -120.779),
    "SNS": (36.664, -121.603),
    "BSR": (36.181, -121.642),
    "PRB": (35.672, -120.627),
    "AVE": (35.647, -119.979),
    "EHF": (35.485, -119.097),
    "MQO": (35.252, -120.760),
    "FLW": (35.093, -119.866),
    "GMN": (34.804, -118.861),
    "LHS": (34.683, -118.577),
    "PMD": (34.631, -118.064),
    "GVO": (34.531, -120.091),
    "RZS": (34.510, -119.771),
    "FIM": (34.357, -118.881),
    "VNY": (34.223, -118.492),
    "VTU": (34.115, -119.050),
    "LAX": (33.933, -118.432),
    "SLI": (33.783, -118.055),
    "SXC": (33.375, -118.420),
}
"""Name -> (latitude, longitude) in degrees."""


POSITIONS = np.array(list(FIXES.values()))


def _apart(points, others):
    """bool [n, m]: whether points lie further apart than ``NEAR``, on a sphere (a minute of arc is
    a nautical mile).
    """
    (phi, lam), (theta, mu) = np.radians(points).T[..., None], np.radians(others).T
    cosine = np.sin(phi) * np.sin(theta) + np.cos(phi) * np.cos(theta) * np.cos(lam - mu)
    return np.degrees(np.arccos(np.minimum(cosine, 1))) * 60 > NEAR


APART = _apart(np.concatenate([POSITIONS, [KSFO, KLAX]]), POSITIONS)
"""bool [beacons + 2, beacons]: where a leg may lead from each beacon, from KSFO and from KLAX (the
way back counts as the way there).
"""
