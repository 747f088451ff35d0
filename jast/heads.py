"""Rollout-policy and value networks for tree searches, trained on the statistics of finished
trees.
"""

from jast._src.heads.heads import Heads, Moments
from jast._src.heads.heads_policy import as_policy
from jast._src.heads.networks import Head, make_head
from jast._src.heads.settings import MODES, HeadSettings, settings
from jast._src.heads.storage import load
from jast._src.heads.train_head import Lesson
from jast._src.io.save_load import save
from jast._src.util.doors import dir_function

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
