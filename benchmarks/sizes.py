"""How much a benchmark measures: all, less with ``--quick``, or with ``--smoke`` the least that
enters whatever is measured. Figures of the least mean nothing.
"""

import argparse
from typing import TypeVar

__all__ = ["options", "size"]

T = TypeVar("T")


def options(parser: argparse.ArgumentParser, quick: str) -> argparse.ArgumentParser:
    """Add ``--json``, ``--quick`` (``quick``: what it leaves out) and ``--smoke`` to a parser."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    least = parser.add_mutually_exclusive_group()
    least.add_argument("--quick", action="store_true", help=quick)
    least.add_argument(
        "--smoke", action="store_true", help="the least of everything, in seconds: does it run?"
    )
    return parser


def size(args: argparse.Namespace, full: T, quick: T, smoke: T) -> T:
    """What the options of a command line ask for."""
    return smoke if args.smoke else quick if args.quick else full
