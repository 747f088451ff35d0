"""What jast exports: the rooms' doors, and the functions and classes at each."""

import importlib
import inspect

import jast

DOORS = ["jast"]
DOORS += [f"jast.{name}" for name in jast.__all__ if inspect.ismodule(getattr(jast, name))]
DOORS += ["jast.cross_entropy.schedules", "jast.simulators.arch"]
DOORS += ["jast.stress_testing", "jast.sweeping"]


def exported():
    """(door.name, object) of every function and class of jast at a door; each object once."""
    seen = set()
    for door in DOORS:
        room = importlib.import_module(door)
        for name in room.__all__:
            value = getattr(room, name)
            ours = getattr(value, "__module__", "").startswith("jast")
            if ours and (inspect.isfunction(value) or inspect.isclass(value)) and value not in seen:
                seen.add(value)
                yield f"{door}.{name}", value


def functions():
    """`exported`, of functions alone."""
    return [(name, value) for name, value in exported() if inspect.isfunction(value)]
