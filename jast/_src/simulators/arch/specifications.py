"""The requirements of the falsification category of ARCH-COMP, as formulas.

CC4's inner window differs between tools: 5 s in FalStar and the report of 2024 ("CC4"), 20 s in
stgem and FReaK ("CC4-20", which asks for 115 s of 100: windows are clipped at the end). CC3 has the
inequality of the category's reports. AT1 to AT6c as in the reports of 2019 to 2024; AT6abc is all
three of AT6. The robustness of "in gear i" is half a gear where it holds. F16: the altitude stays
above the ground, in feet.
"""

from collections.abc import Mapping
from types import MappingProxyType

import jax.numpy as jnp

from jast._src.util.checks import wrong
from jast.specs import Formula, always, eventually, implies, predicate

__all__ = ["SPECIFICATIONS", "named"]


def _wider(i: int, metres: float) -> Formula:
    """Car i + 2 is more than that ahead of car i + 1; i from 0."""
    return predicate(lambda s: s.gaps[i] - metres, f"y{i + 2} - y{i + 1} >= {metres:g}")


def _narrower(i: int, metres: float) -> Formula:
    return predicate(lambda s: metres - s.gaps[i], f"y{i + 2} - y{i + 1} <= {metres:g}")


def _cc4(inner: float) -> Formula:
    return always(eventually(always(_wider(3, 8.0), 0, inner), 0, 30), 0, 65)


def _ccx() -> Formula:
    apart = [always(predicate(lambda s, i=i: s.gaps[i] - 7.5, f"y{i + 2} - y{i + 1} > 7.5"), 0, 50)
             for i in range(4)]  # fmt: skip
    return apart[0] & apart[1] & apart[2] & apart[3]


def _slower(mph: float) -> Formula:
    return predicate(lambda s: mph - s.speed, f"v < {mph:g}")


def _calmer(rpm: float) -> Formula:
    return predicate(lambda s: rpm - s.rpm, f"omega < {rpm:g}")


def _at5(i: int) -> Formula:
    """Who shifts into gear i stays in it."""
    in_gear = predicate(lambda s: 0.5 - jnp.abs(s.gear - i).astype(s.rpm.dtype), f"gear = {i}")
    shifts = ~in_gear & eventually(in_gear, 0.001, 0.1)
    return always(implies(shifts, eventually(always(in_gear, 0, 2.5), 0.001, 0.1)), 0, 30)


def _at6(mph: float, until: float) -> Formula:
    return implies(always(_calmer(3000), 0, 30), always(_slower(mph), 0, until))


SPECIFICATIONS: Mapping[str, Formula] = MappingProxyType(
    {
        "CC1": always(_narrower(3, 40.0), 0, 100),
        "CC2": always(eventually(_wider(3, 15.0), 0, 30), 0, 70),
        "CC3": always(
            always(_narrower(0, 20.0), 0, 20) | eventually(_wider(3, 40.0), 0, 20), 0, 80
        ),
        "CC4": _cc4(5.0),
        "CC4-20": _cc4(20.0),
        "CC5": always(
            eventually(implies(always(_wider(0, 9.0), 0, 5), always(_wider(3, 9.0), 5, 20)), 0, 8),
            0,
            72,
        ),
        "CCx": _ccx(),
        "AT1": always(_slower(120), 0, 20),
        "AT2": always(_calmer(4750), 0, 10),
        **{f"AT5{i}": _at5(i) for i in (1, 2, 3, 4)},
        "AT6a": _at6(35, 4),
        "AT6b": _at6(50, 8),
        "AT6c": _at6(65, 20),
        "AT6abc": _at6(35, 4) & _at6(50, 8) & _at6(65, 20),
        "F16": always(predicate(lambda s: s.altitude, "altitude > 0"), 0, 15),
    }
)
"""Name -> formula of the trace of its model, at seconds."""


def named(function: str, prefix: str, requirement: str | Formula) -> Formula:
    """The formula of a name in `SPECIFICATIONS` that begins with ``prefix``; a formula as it is."""
    if isinstance(requirement, Formula):
        return requirement
    names = [name for name in SPECIFICATIONS if name.startswith(prefix)]
    if requirement not in names:
        raise wrong(function, "requirement", f"be a formula or one of {names}", f"{requirement!r}")
    return SPECIFICATIONS[requirement]
