"""Adversarial weakness recognition (Moss's thesis, chapter 4): which inputs of a labelled data set
a classifier gets wrong, found with few calls of it.
"""

from jast._src.io.save_load import load, save
from jast._src.util.doors import dir_function
from jast._src.weakness.data import Data, digits, from_idx, idx
from jast._src.weakness.encoded import Encoded, encoded
from jast._src.weakness.influence import influence
from jast._src.weakness.measures import Judgement, Roc, auc, judge, roc
from jast._src.weakness.result import History, Result, State
from jast._src.weakness.selector_contract import Seen, Selector, Step
from jast._src.weakness.selectors import default, random, thesis
from jast._src.weakness.validation import validate

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
