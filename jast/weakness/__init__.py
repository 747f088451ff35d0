"""Adversarial weakness recognition (Moss's thesis, chapter 4): which inputs of a labelled data set
a classifier gets wrong, found with few calls of it.
"""

from jast._doors import dir_function
from jast.weakness.contract import Seen, Selector, Step
from jast.weakness.data import Data, digits, from_idx, idx
from jast.weakness.encoded import Encoded, encoded
from jast.weakness.influence import influence
from jast.weakness.measures import Judgement, Roc, auc, judge, roc
from jast.weakness.result import History, Result, State
from jast.weakness.selectors import default, random, thesis
from jast.weakness.storage import load, save
from jast.weakness.validation import validate

__all__ = [
    "Data",
    "Encoded",
    "History",
    "Judgement",
    "Result",
    "Roc",
    "Seen",
    "Selector",
    "State",
    "Step",
    "auc",
    "default",
    "digits",
    "encoded",
    "from_idx",
    "idx",
    "influence",
    "judge",
    "load",
    "random",
    "roc",
    "save",
    "thesis",
    "validate",
]

__dir__ = dir_function(__all__)
