"""The time limit of what a black box runs. Goes to the workers by value: the standard library
only.
"""

import contextlib
import signal
import time

from jast._src.blackbox.readings import TimedOut

__all__ = ["Alarm"]


class Alarm(contextlib.AbstractContextManager):
    """Raises `TimedOut` in what runs for longer than ``seconds``, where signals exist and the code
    can be interrupted; None: never. The file ``at``, if there is one, is told when what runs began,
    and the row that it is of.
    """

    def __init__(self, seconds):
        self.at, self.row = None, 0
        self.seconds = seconds if seconds is not None and hasattr(signal, "setitimer") else None
        self.on = self.rang = False

    def tell(self, later=0.0):
        """What runs now may take its time limit from then on."""
        if self.at is not None:
            self.at[:] = time.monotonic() + later, self.row

    def __enter__(self):
        self.tell()
        if self.seconds is not None:
            signal.signal(signal.SIGALRM, self._ring)
            self.on, self.rang = True, False
            signal.setitimer(signal.ITIMER_REAL, self.seconds, self.seconds)

    def __exit__(self, *error):
        self.on = False  # first: a signal that is already on its way no longer raises
        if self.seconds is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)
            if self.rang:  # even where the system caught it
                raise TimedOut(f"no answer within {self.seconds:g} s") from None

    def _ring(self, *_):
        if self.on:
            self.rang = True
            raise TimedOut
