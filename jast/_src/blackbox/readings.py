"""What a system says, read: an event, a distance, log p, an observation, or an error that says
what came in its place. Goes to the workers by value: NumPy and the standard library only.
"""

import os
import traceback

import numpy as np

__all__ = [
    "NotANumber",
    "TimedOut",
    "WrongAnswer",
    "distance_of",
    "event_of",
    "line_of",
    "log_p_of",
    "observed_of",
    "said",
    "shown",
]


class WrongAnswer(Exception):
    """The system answered something else than what was asked."""

    kind = "wrong answer"


class NotANumber(Exception):
    """The system answered NaN or infinity."""

    kind = "NaN"


class TimedOut(BaseException):
    """Not an Exception, so that the system's own ``except Exception`` does not stop it."""

    kind = "timed out"


def event_of(value, name="event"):
    a = _array(value)
    if a.shape == () and a.dtype.kind == "f" and not np.isfinite(a):
        raise NotANumber(f"{name} is {a}")
    if a.size != 1 or a.dtype.kind not in "biu" or int(a.item()) not in (0, 1):
        raise WrongAnswer(f"{name} must be True or False, received {shown(value)}")
    return bool(a.item())  # of 0 and 1, too, and of one in an array


def distance_of(value):
    a = _array(value)
    if a.shape != () or a.dtype.kind not in "fiu":
        raise WrongAnswer(f"distance must be one number, received {shown(value)}")
    if not np.isfinite(a):
        raise NotANumber(f"distance is {a}")
    return float(a)


def log_p_of(value, name, tells):
    """log p by ``value``, what the system says of it; ``tells``: as of `Spec`."""
    if tells is None:
        return 0.0
    a = _array(value)
    if a.shape != () or a.dtype.kind not in "fiu":
        if tells == "maybe":
            return 0.0
        expected = "log p" if tells == "log_prob" else "p"
        raise WrongAnswer(f"{name} must give {expected}, one number, received {shown(value)}")
    if np.isnan(a) or a == np.inf or (tells == "prob" and a < 0):
        raise NotANumber(f"{name} gives {a} as {'p' if tells == 'prob' else 'log p'}")
    with np.errstate(divide="ignore"):
        return float(np.log(a) if tells == "prob" else a)


def observed_of(value, size):
    a = _array(value)
    if a.ndim != 1 or a.dtype.kind not in "fiub" or (size is not None and len(a) != size):
        raise WrongAnswer(
            f"observe must return a vector of {'' if size is None else f'{size} '}numbers, received"
            f" {shown(value)}"
        )
    return a


def _array(value):
    try:
        return np.asarray(value)
    except ValueError:  # rows of different lengths
        return np.array(None)


def shown(value):
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{type(value).__name__} {text[:70]} ..."


def said(error):
    """(kind, message) of what the system raised."""
    if isinstance(error, TimedOut | WrongAnswer | NotANumber):
        return error.kind, str(error)
    try:
        text = " ".join(str(error).split())[:200]
    except Exception:  # the system's own exception cannot say what it is
        text = ""
    return "raised", f"raised {type(error).__name__}{f': {text}' if text else ''}{line_of(error)}"


def line_of(error):
    """ " (system.py:12)": the last line of the system's own code that ``error`` went through."""
    here = os.path.join(os.path.dirname(os.path.dirname(os.path.dirname(__file__))), "")
    frames = traceback.extract_tb(error.__traceback__)
    frames = [f for f in frames if not f.filename.startswith(here)]
    libraries = os.path.dirname(os.__file__), "<frozen"
    own = [f for f in frames if "site-packages" not in f.filename]
    own = [f for f in own if not f.filename.startswith(libraries)] or frames
    return f" ({os.path.basename(own[-1].filename)}:{own[-1].lineno})" if own else ""
