"""What each number of a population is worth: ``python -m benchmarks.populations [--json]
[--quick | --smoke] [--systems NAME ...]``.

The figure is the relative variance of one population's estimate over keys, times its evaluations:
what a reader pays for a given error. It stands for the settings as they are, and with one of them
changed, on systems that settings may be chosen on. Beside it stands what the genealogies say. A
figure over n keys has a relative standard error of about sqrt(2 / n).
"""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from benchmarks.sizes import options, print_report, printer, size
from benchmarks.time_to_answer import SYSTEMS
from jast._src.estimate.population.descents import DESCENTS, SETTINGS
from jast._src.estimate.population.particle_moves import SMALL, WINDOW

__all__ = ["CHANGES", "work"]

CHANGES = {
    "as they are": {},
    "small moves": dict(kinds=(SMALL, SMALL)),
    "and windows": dict(kinds=(SMALL, WINDOW)),
    "half the moves": dict(moves=0.5),
    "twice the moves": dict(moves=2),
    "quantile .1": dict(level_share=0.1),
    "quantile .5": dict(level_share=0.5),
    "effective .3": dict(effective_share=0.3),
    "effective .8": dict(effective_share=0.8),
}
CASES = (
    ("toy, z 3, 100", "distance"),
    ("cart-pole", "distance"),
    ("tank", "distance"),
    ("oven", "distance"),
    ("Gayton of 8", "width"),
    ("piecewise", "width"),
    ("breaker", "width"),
)


def work(name: str, way: str, keys: int, particles: int, changes: dict[str, Any]) -> dict[str, Any]:
    """The figure of a system and a way down with these settings, and the mean over the truth."""
    changes, about = dict(changes), SYSTEMS[name]
    moves = int(changes.pop("moves", 1) * getattr(SETTINGS, f"moves_by_{way}"))
    if "kinds" in changes:
        changes[f"kinds_by_{way}"] = changes.pop("kinds")
    settings = replace(SETTINGS, **changes)
    runs = [
        DESCENTS[way](key, about.simulator, particles, moves, particles, settings)
        for key in jax.random.split(jax.random.key(0), keys)
    ]
    p = np.exp([float(r.log_mean) for r in runs])
    evaluations = float(np.mean([r.evaluations for r in runs]))
    spread = float(p.var(ddof=1) / p.mean() ** 2) if keys > 1 and p.mean() > 0 else None
    told = float(np.nanmean([r.variance for r in runs])) if p.any() else None
    return dict(
        work=None if spread is None else spread * evaluations,
        told=None if told is None else told * evaluations,
        of_truth=float(p.mean() / about.truth),
        evaluations=evaluations,
    )


def main(argv: list[str] | None = None) -> None:
    parser = options(__doc__, "8 keys of 1024 points")
    parser.add_argument("--systems", nargs="+", help="default: all")
    args = parser.parse_args(argv)
    keys, particles = size(args, (40, 2048), (8, 1024), (2, 128))
    say, rows = printer(args), []
    for name, way in size(args, CASES, CASES[4:6], CASES[5:6]):
        if args.systems and name not in args.systems:
            continue
        for words, changes in CHANGES.items():
            other = "effective_share" if way == "distance" else "level_share"
            as_it_is = changes.get("kinds") == getattr(SETTINGS, f"kinds_by_{way}")
            if other in changes or as_it_is:
                continue
            row = dict(system=name, way=way, settings=words)
            rows.append(row | work(name, way, keys, particles, changes))
            r = rows[-1]
            say(
                f"{name:14s} by {way:8s} {words:16s} variance x evaluations"
                f" {r['work'] or 0:8.0f}  by genealogy {r['told'] or 0:8.0f}"
                f"  mean / truth {r['of_truth']:.3f}"
            )
    print_report(args, dict(keys=keys, particles=particles, rows=rows))


if __name__ == "__main__":
    main()
