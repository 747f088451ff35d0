"""What heads are like, how they learn and how a search uses them: the published choices and those
that work, each by its name.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real
from typing import Any, Literal, NamedTuple

from jast._src.util.checks import one_of

__all__ = ["MODES", "HeadSettings", "check_settings", "settings"]


class HeadSettings(NamedTuple):
    """Settings of heads. A pair is (rollout-policy head, value head).

    Example:
        >>> import jast
        >>> chosen = jast.heads.settings(hidden=(16,), steps=(20, 20))
        >>> chosen.hidden, chosen._replace(bins=8).bins
        ((16,), 8)
    """

    round: int | None
    """Trees that grow between two trainings; None: a fifth of all, at most 128."""
    bins: int
    """Cells of the histogram, per number of the disturbance."""
    hidden: tuple[int, ...]
    """Widths of the hidden layers, where jast makes the network (`jast.heads.make_head`)."""
    activation: tuple[str, str]
    """Names, of `make_head`."""
    first_activation: bool
    """Whether there is one after the first layer."""
    normalise: bool
    """Inputs and value targets, by running means and deviations."""
    loss: str
    """Of the policy head: "cross_entropy" of the visits' shares, or "squared_shares", the squared
    error of the probabilities.
    """
    learning_rate: tuple[float, float]
    """Of Adam."""
    batch: tuple[int, int]
    """Samples in a step of Adam."""
    steps: tuple[int | None, int | None]
    """Steps a round; None for one pass over the round's samples and those kept."""
    replay: tuple[int, int]
    """Samples of earlier rounds and this one that are kept to learn from; 0: this round's
    alone.
    """
    elite: float
    """Share of a round's trees that the policy head learns from: those of the best rewards."""
    episodes: bool
    """Whether it learns from their best episodes, step by step, as well as from their roots."""
    target: str
    """Of the value head: "own" for Q(s, a), "parent" for the Q of the edge that leads to s."""
    edges: str
    """That the value head learns from: "roots" or "all"."""
    untrained_alone: bool
    """Whether a value head without a policy head stays untrained."""
    from_start: bool
    """Whether heads that were never trained guide the first round."""
    power: float
    """A rollout's bin is drawn with probability proportional to p^power."""
    share: float
    """Of the rollouts that the policy head draws; the others are drawn as without it."""
    q_weight: float
    """Of Q(s, a) in eq. 3, where there is a value head."""
    v_weight: float
    """c2 of eq. 3, of v(s, a)."""
    candidates: str
    """Unvisited children of a node that compete by their v(s, a): "all" that widening allows, or
    "one": the next comes when the last was tried.
    """
    train: bool
    """False: heads are used as they are given."""
    counted: str = "turn"
    """When the statistics of a root are taken: at the end of its "turn", or of its "tree", when the
    simulations of all later roots have gone through one child of it as well.
    """


TABLE = dict(
    round=(1, None),
    bins=(10, 40),
    hidden=((64, 124, 64), (32,)),
    activation=(("gelu", "relu"), ("relu", "relu")),
    first_activation=(False, True),
    normalise=(False, True),
    loss=("squared_shares", "cross_entropy"),
    learning_rate=((0.005, 0.001), (0.01, 0.01)),
    batch=((1, 1), (64, 128)),
    steps=((None, None), (500, 200)),
    replay=((0, 0), (4096, 65536)),
    elite=(1.0, 0.25),
    episodes=(False, True),
    target=("parent", "own"),
    edges=("all", "roots"),
    untrained_alone=(True, False),
    from_start=(True, False),
    power=(2.0, 3.0),
    share=(1.0, 1.0),
    q_weight=(0.6, 0.5),
    v_weight=(0.4, 0.5),
    candidates=("all", "one"),
    train=(True, True),
)
"""Setting -> (its value in the published code of MCFS-AP, by default)."""
CODE, DEFAULT = (HeadSettings(**{name: v[i] for name, v in TABLE.items()}) for i in range(2))
TEXT = CODE._replace(
    first_activation=True,
    target="own",
    edges="roots",
    untrained_alone=False,
    power=1.0,
    q_weight=1.0,
)
"""The text of MCFS-AP, section 3.3 and eq. 3; what it leaves open is as in the code, c2 too."""
MODES = {"default": DEFAULT, "code": CODE, "text": TEXT, "paper": CODE}
""""paper" is the earlier name of "code"."""


Holds = Callable[[Any], bool]


def _whole(least: int) -> Holds:
    return lambda v: isinstance(v, int) and not isinstance(v, bool) and v >= least


def _number(low: float, high: float = math.inf) -> Holds:
    return lambda v: isinstance(v, Real) and low <= v <= high


def _several(holds: Holds) -> Holds:
    return lambda v: isinstance(v, tuple | list) and all(map(holds, v))


def _pair(holds: Holds) -> Holds:
    return lambda v: _several(holds)(v) and len(v) == 2


CHOICES = dict(
    loss=("cross_entropy", "squared_shares"),
    target=("own", "parent"),
    edges=("roots", "all"),
    counted=("turn", "tree"),
    candidates=("one", "all"),
)
RULES = {name: (allowed.__contains__, f"one of {allowed}") for name, allowed in CHOICES.items()}
RULES |= dict(
    round=(lambda v: v is None or _whole(1)(v), "None or an integer of at least 1"),
    bins=(_whole(2), "an integer of at least 2"),
    hidden=(_several(_whole(1)), "integers of at least 1"),
    learning_rate=(_pair(lambda r: _number(0)(r) and r > 0), "a pair of numbers above 0"),
    batch=(_pair(_whole(1)), "a pair of integers of at least 1"),
    steps=(_pair(lambda n: n is None or _whole(0)(n)), "a pair of integers of at least 0, or None"),
    replay=(_pair(_whole(0)), "a pair of integers of at least 0"),
    elite=(lambda v: _number(0, 1)(v) and v > 0, "above 0 and at most 1"),
    power=(_number(0), "at least 0"),
    share=(_number(0, 1), "from 0 to 1"),
    q_weight=(_number(-math.inf), "a number"),
    v_weight=(_number(-math.inf), "a number"),
)
"""Setting -> (what holds for it, in words)."""


def settings(
    mode: Literal["default", "code", "text", "paper"] = "default", **changes: Any
) -> HeadSettings:
    """The settings of heads in a mode, with changes.

    "default" is what works. "code" is the published code of MCFS-AP, of which "paper" is the
    earlier name; "text" is what its text says (section 3.3, eq. 3), which departs from the code:

    | | "code" | "text" |
    |---|---|---|
    | ``target`` of the value head | "parent": the Q of the edge that leads to s | "own": Q(s, a) |
    | ``edges`` that it learns from | "all" of the tree | "roots" |
    | it is trained without a policy head | no (``untrained_alone``) | yes |
    | weights in eq. 3 | 0.6 Q + 0.4 v | Q + 0.4 v (the text has c2 and no number) |
    | a bin is drawn in proportion to | p^2 (``power``) | p |
    | activation after the first layer | no (``first_activation``) | yes |
    | the networks see | five numbers, `jast.simulators.ferry` | six, its ``observation="text"`` |

    Both sum the logs of likelihoods where eq. 1 has a product.

    Args:
        mode: see above.
        changes: fields of `HeadSettings`, by name.

    Returns:
        `HeadSettings`.

    Raises:
        ValueError: that names an unknown mode or setting, or one that is out of range.

    Example:
        >>> import jast
        >>> jast.heads.settings("code", round=8).round
        8
    """
    one_of("heads.settings", "mode", mode, MODES)
    if unknown := sorted(set(changes) - set(HeadSettings._fields)):
        raise ValueError(
            f"heads.settings: expected settings among {', '.join(HeadSettings._fields)}, received"
            f" {', '.join(unknown)}"
        )
    return check_settings(MODES[mode]._replace(**changes))


def check_settings(settings: HeadSettings) -> HeadSettings:
    """``settings`` themselves, or a ValueError that names the one that is out of range."""
    if not isinstance(settings, HeadSettings):
        raise ValueError(
            "head_settings must be those of jast.heads.settings(...), received"
            f" {type(settings).__name__}"
        )
    for name, (holds, wanted) in RULES.items():
        if not holds(value := getattr(settings, name)):
            raise ValueError(f"heads.settings: {name} must be {wanted}, received {value!r}")
    return settings
