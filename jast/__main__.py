"""``python -m jast``: `jast.stress` of a built-in system, or of one in a file of the user;
or one search of a built-in system.
"""

import argparse
import importlib.util
import inspect
import io
import sys
import tempfile
from functools import partial
from pathlib import Path

import jax
import numpy as np

from jast import plot, replay, save, simulators
from jast._src.core import actions, failures, rewards
from jast._src.core.check import check
from jast._src.core.rewards import likelihood
from jast._src.core.signature import signature_of
from jast._src.core.simulator import Simulator
from jast._src.runtime.compilation_cache import cache
from jast._src.search.cem import cem
from jast._src.search.forest import forest
from jast._src.search.mcts import mcts
from jast._src.search.monte_carlo import monte_carlo
from jast._src.search.result import table
from jast._src.simulators.svg_states import DRAWN
from jast._src.stress_testing.stress import DEFAULT_BUDGET
from jast._src.util.pytrees import index_tree
from jast.explain import cards
from jast.stress_testing import stress

STANDARD = rewards.standard(event_bonus=30.0, density="mode")  # published for the ferry
OF_FERRY = STANDARD, actions.uniform(0.0, 1.0)  # x is in [0, 1]
SYSTEMS = {  # name: the simulator, the reward and the actions of a search
    "ferry": (simulators.ferry, *OF_FERRY),
    "ferry-b": (partial(simulators.ferry, adversary=(17.0, 0.0)), *OF_FERRY),
    "walk1d": (simulators.walk1d, STANDARD, actions.uniform(-1.0, 1.0)),
    "colav": (
        simulators.colav,
        rewards.standard(event_bonus=200.0, density="mode"),
        actions.samples(),
    ),
    "landing": (
        simulators.landing,
        rewards.shaped(100.0, event_bonus=30.0, density="mode"),
        actions.uniform(-0.15, 0.15),
    ),
}
ITERATIONS = 10  # of the cross-entropy method, which keeps a tenth of the samples of each
OPTIONS = [  # the option, and the methods that have it
    ("budget", ("stress",)),
    ("seconds", ("stress",)),
    ("checkpoint", ("stress",)),
    ("prunes", ("forest",)),
    ("heads", ("forest",)),
    ("paper", ("forest", "mcts")),
]
SEARCH_OPTIONS = "trees", "simulations", "prunes", "heads", "paper"  # those of `jast.stress` aside


def main(argv=None):
    """Run the command line ``argv`` (default: the process's) and print what was found; returns the
    exit status.
    """
    parser = _parser()
    options = parser.parse_args(argv)
    a_search = any(getattr(options, name) for name in SEARCH_OPTIONS)
    if options.method is None:
        options.method = "forest" if a_search and not options.system else "stress"
    if options.system and options.simulator is not None:
        parser.error("argument --simulator: of the built-in ones; there is a FILE.py:NAME, too")
    options.simulator = options.simulator or "ferry"
    if options.system and options.method != "stress":
        parser.error("argument --method: a system of your own has stress, no other")
    if options.method == "stress" and a_search:
        parser.error("argument --budget: stress has a budget; the other counts are of searches")
    for name, methods in OPTIONS:
        if getattr(options, name) and options.method not in methods:
            parser.error(
                f"argument --{name}: only of --method {' or '.join(methods)}, not of"
                f" {options.method}"
            )
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # no name of a file ends what was found
            stream.reconfigure(errors="replace")
    try:
        if not options.no_cache:
            _keep_programs()
        own = _load(parser, options.system) if options.system else None
        _make_folder(parser, options.output)
        return _stress(options, own) if options.method == "stress" else _search(options)
    except ValueError as e:
        # a count that the search refuses
        if not str(e).startswith(f"{options.method.replace('-', '_')}: "):
            raise
        parser.error(str(e))
    except KeyboardInterrupt:
        print("\ninterrupted before there was a result", file=sys.stderr)
        return 130


def _make_folder(parser, folder):
    """Make ``folder``; a usage error where that cannot be, or where it takes no files."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()  # whether it takes files
    except OSError as e:
        parser.error(f"argument --output: {e}")


def _parser():
    parser = argparse.ArgumentParser(
        "python -m jast",
        description="Find the likeliest failures of a system, their modes and their probability.",
    )
    add = parser.add_argument
    add(
        "system",
        nargs="?",
        metavar="FILE.py:NAME",
        help="a simulator of your own: NAME in the file, or a function of no arguments that makes"
        " it; default: the built-in one of --simulator",
    )
    add(
        "--simulator",
        choices=SYSTEMS,
        help="system under test (default: ferry; ferry-b is its easier variant S0b; colav avoids"
        " collisions with late sensors)",
    )
    add(
        "--method",
        choices=["stress", "forest", "mcts", "cem", "monte-carlo"],
        help="jast.stress, or one search (default: stress; forest"
        " where a count of a search is given)",
    )
    for name, text in [
        ("--budget", "evaluations of stress (default: what some four CPU seconds simulate)"),
        ("--trees", "independent searches (default: 200)"),
        (
            "--simulations",
            "simulations per root (forest, default: 500) or per tree (the others, default: 9000)",
        ),
        ("--prunes", "roots of a tree of the forest (default: 18)"),
    ]:
        add(name, type=_count, metavar="N", help=text)
    add(
        "--seconds",
        type=float,
        metavar="S",
        help="in place of --budget: what so many CPU seconds simulate (a black box: seconds)",
    )
    add(
        "--checkpoint",
        type=Path,
        metavar="FOLDER",
        help="keeps what stress has done: the same command goes on where it was stopped",
    )
    add("--seed", type=_seed, default=0, metavar="N", help="random seed (default: 0)")
    add(
        "--output",
        type=Path,
        default=Path("jast-output"),
        metavar="FOLDER",
        help="folder for the archive and the pictures (default: jast-output)",
    )
    add(
        "--heads",
        choices=["rollout", "value", "both"],
        help="forest: networks that learn from the trees before (default: none)",
    )
    for name, text in [
        ("--paper", "forest and mcts: the published widening in place of the better-tuned one"),
        (
            "--no-cache",
            "compile everything anew; else compiled programs are kept for the next call"
            " (jast.cache)",
        ),
        ("--quiet", "no progress bars"),
    ]:
        add(name, action="store_true", help=text)
    return parser


def _keep_programs():
    """Compiled programs stay for the next call, where there is a place for them."""
    try:
        cache()
    except ValueError as e:
        print(f"{e}; compiled programs are not kept", file=sys.stderr)


def _count(text):
    if not text.isdecimal() or not 1 <= int(text) < 2**31:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, received {text!r}")
    return int(text)


def _seed(text):
    try:
        jax.random.key(int(text))
    except (OverflowError, ValueError):
        message = f"must be a whole number of 32 bits, received {text!r}"
        raise argparse.ArgumentTypeError(message) from None
    return int(text)


def _load(parser, place):
    """The simulator at FILE.py:NAME."""
    file, _, name = place.rpartition(":")
    if not file:
        parser.error(f"argument FILE.py:NAME: name the simulator, too, as in {place}:sim")
    if not Path(file).is_file():
        parser.error(f"argument FILE.py:NAME: there is no file {file!r}")
    spec = importlib.util.spec_from_file_location(Path(file).stem, file)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.insert(0, str(Path(file).resolve().parent))  # its neighbours, as Python has it
    spec.loader.exec_module(module)
    if not hasattr(module, name):
        held = [key for key, value in vars(module).items() if isinstance(value, Simulator)]
        parser.error(
            f"argument FILE.py:NAME: {file} has no jast.Simulator {name}; it has"
            f" {', '.join(held) or 'none'}"
        )
    found = getattr(module, name)
    if callable(found) and not isinstance(found, Simulator):
        try:
            inspect.signature(found).bind()
        except ValueError:  # it says nothing of itself
            pass
        except TypeError as e:
            parser.error(f"argument FILE.py:NAME: {name} must need no arguments: {e}")
        found = found()
    if not isinstance(found, Simulator):
        parser.error(f"argument FILE.py:NAME: {name} in {file} is no jast.Simulator: {found!r}")
    return found


def _stress(options, own):
    """The report of `jast.stress`, the likeliest failure, files, a page to hand on."""
    name = options.system or options.simulator
    sim = SYSTEMS[name][0]() if own is None else own
    key = jax.random.key(options.seed)
    report = stress(
        key,
        sim,
        options.budget,
        seconds=options.seconds,
        checkpoint=options.checkpoint,
        progress=not options.quiet,
    )
    path = options.output / "report.npz"
    save(path, report)  # before anything is printed: a pipe may be closed
    print(f"{name}, seed {options.seed}\n{report}\n", flush=True)
    best = report.failures.best
    if best is not None:
        best = replay(sim, best, reward=likelihood(sim))
        print(f"{_episode(best)}\n")
    print(f"saved {path}")
    _save_archive(options, report)
    page = options.output / "report.html"
    draw = simulators.draw if isinstance(signature_of(sim).state, tuple(DRAWN)) else None
    report.html(page, draw=draw, explanations=_explained(options, sim, report))
    print(f"saved {page}")
    if best is not None:
        _save_pictures(options, {"episode": lambda: _draw_episode(options, own, best, sim)})
    return 130 if "interrupted" in report.settings else 0


def _explained(options, sim, report):
    """What the page says of the modes: a tenth of what the search for them took, on top."""
    signature = signature_of(sim)
    if not (report.modes and signature.disturbance.quantile and signature.start.quantile):
        return ()
    budget = min(report.settings["budget"], DEFAULT_BUDGET) // 10
    found = cards(jax.random.key(options.seed), sim, report, budget)
    print(f"{found[0][0]}\n")
    return found


def _search(options):
    """One search of a built-in system: its numbers, its best episode, an archive, pictures."""
    make, reward, chosen = SYSTEMS[options.simulator]
    sim, key = check(make(), chosen), jax.random.key(options.seed)
    trees = options.trees or 200
    each = options.simulations or (500 if options.method == "forest" else 9000)
    common = dict(reward=reward, actions=chosen, progress=not options.quiet)
    of_trees = dict(trees=trees, simulations=each, mode="paper" if options.paper else "default")
    if options.method == "monte-carlo":
        found = monte_carlo(key, sim, episodes=trees * each, **common)
    elif options.method == "cem":
        samples = -(-each // ITERATIONS)
        counts = dict(samples=samples, elites=-(-samples // 10), iterations=ITERATIONS)
        found = cem(key, sim, trees=trees, **counts, **common)
    elif options.method == "mcts":
        found = mcts(key, sim, **of_trees, **common)
    else:
        prunes = options.prunes or 18
        found = forest(key, sim, prunes=prunes, heads=options.heads, **of_trees, **common)
    print(f"{options.simulator}, seed {options.seed}\n{table({options.method: found})}\n")
    print(f"{_episode(found.best)}\n\n{found.failures}\n")
    _save_archive(options, found)
    draw = {
        "episode": lambda: _draw_episode(options, None, found.best, sim),
        "history": lambda: plot.history(found),
    }
    _save_pictures(options, draw)
    return 130 if "interrupted" in found.settings else 0


def _save_archive(options, found):
    """The failures of a search or a report."""
    path = options.output / "failures.npz"
    name = options.system or options.simulator
    failures.save(path, found.failures, found.settings | dict(simulator=name))
    print(f"saved {path}")


def _episode(episode):
    """The episode in numbers: what happened, and the disturbances that brought it about."""
    title = "likeliest failure" if episode.failure else "no failure was found; the best episode"
    numbers = dict(reward=episode.reward, log_p=episode.log_prob, distance=episode.distance)
    said = ", ".join(f"{k.replace('_', ' ')} {float(v):.4f}" for k, v in numbers.items())
    lines = [f"{title}: {said}, {int(episode.length)} steps"]
    x = index_tree(episode.disturbances, np.s_[: int(episode.length)])
    style = dict(precision=4, max_line_width=120, suppress_small=True, threshold=300, prefix="    ")
    for path, a in jax.tree_util.tree_leaves_with_path({"x0": episode.x0, "x": x}):
        name = f"{path[0].key}{jax.tree_util.keystr(path[1:])}"
        lines.append(f"  {name}: {np.array2string(np.asarray(a), **style)}")
    return "\n".join(lines)


def _draw_episode(options, own, best, sim):
    """Axes with the episode ``best``: the system's own picture, or its disturbances."""
    if own is None and options.simulator in ("ferry", "ferry-b"):
        return plot.ferry(best, sim)
    if own is None and options.simulator == "colav":
        return plot.colav(best, sim)[0]
    return plot.disturbances(best)[0]


def _save_pictures(options, draw):
    """A file for each of ``draw``: name -> function that returns axes."""
    try:
        import matplotlib
    except ImportError:
        print("no pictures: matplotlib is not installed; to have them: pip install 'jast[plot]'")
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    for name, axes in draw.items():
        ax, path = axes(), options.output / f"{name}.png"
        ax.figure.savefig(path, dpi=120)
        plt.close(ax.figure)
        print(f"saved {path}")


if __name__ == "__main__":
    sys.exit(main())
