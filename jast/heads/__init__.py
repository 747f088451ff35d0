"""Rollout-policy and value networks for tree searches, trained on the statistics of finished
trees.
"""

from jast._doors import dir_function
from jast.heads.heads import Heads, Moments
from jast.heads.histogram import as_policy
from jast.heads.networks import Head, make_head
from jast.heads.settings import MODES, HeadSettings, settings
from jast.heads.storage import load, save
from jast.heads.training import Lesson

__all__ = [
    "MODES",
    "Head",
    "HeadSettings",
    "Heads",
    "Lesson",
    "Moments",
    "as_policy",
    "load",
    "make_head",
    "save",
    "settings",
]

__dir__ = dir_function(__all__)
