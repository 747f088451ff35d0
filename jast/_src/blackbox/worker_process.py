"""A worker process: a loky executor of one process, which has the system and says in a file what it
is at.
"""

import contextlib
import io
import os
import pickle
import pkgutil
import tempfile
from functools import partial

import numpy as np

from jast._src.blackbox import environment, programs, readings, rows, time_limit, worker
from jast._src.blackbox.worker import END, HEAD, NAME, install
from jast._src.util.checks import import_library

__all__ = ["AGAIN", "JUDGE", "PROBE", "START", "Worker", "pack"]

NEEDS = "jast.blackbox with workers >= 1"
OF_WORKERS = environment, programs, readings, rows, time_limit, worker
"""What runs in a worker."""
START = 60.0  # seconds that a worker may take to start, and to load the system


class _Remote:
    """A function of the module that a worker keeps its system in, by name."""

    def __init__(self, name):
        self.name = name

    def __reduce__(self):
        return pkgutil.resolve_name, (f"{NAME}:{self.name}",)

    def __call__(self, *args):
        raise RuntimeError("only a worker has this function")


class _Install:
    """Unpickled in a worker, it is there."""

    def __init__(self, system, spec):
        self.parts = system, spec

    def __reduce__(self):
        return install, self.parts


SERVE, PROBE, CONFIGURE, JUDGE, AGAIN = map(
    _Remote, ("serve", "probe", "configure", "judge", "again")
)


def pack(system, spec):
    """The system as bytes; what a worker runs of this room by value, so that it need not import
    jast. Raises ValueError for one that cannot be sent.
    """
    cloudpickle = import_library(NEEDS, "cloudpickle", "blackbox")
    registered = cloudpickle.list_registry_pickle_by_value()
    own = [m for m in OF_WORKERS if m.__name__ not in registered]
    for module in own:
        cloudpickle.register_pickle_by_value(module)
    try:
        return cloudpickle.dumps(_Install(system, spec))
    except Exception as error:
        raise ValueError(
            f"from_python: system cannot be sent to a worker process: {type(error).__name__}:"
            f" {error}; define it at the top of a module, and open files, locks and connections"
            " inside of it, not around it"
        ) from error
    finally:
        for module in own:
            cloudpickle.unregister_pickle_by_value(module)


class Worker:
    """One process, started on first use and started anew after its end."""

    def __init__(self, payload):
        self.payload, self.executor, self.at, self.file = payload, None, None, None
        self.unbegun = 0  # pieces that it was given and lost before it began any, in a row

    def start(self):
        """A future that is done when the process has the system."""
        if self.executor is None:
            loky = import_library(NEEDS, "loky", "blackbox")
            self.executor = loky.ProcessPoolExecutor(max_workers=1, timeout=None)
            return self.executor.submit(pickle.loads, self.payload)

    def configure(self, x, size):
        """It is to say in a file when what it runs began, and what each row came to."""
        if self.file is not None:
            self.executor.submit(CONFIGURE, x, size)
            return
        self.file = tempfile.NamedTemporaryFile(prefix="jast-", buffering=0, delete=False)
        self.file.write(bytes(HEAD) + END)
        self.at = np.memmap(self.file, np.float64, "r+", shape=2)
        self.executor.submit(CONFIGURE, x, size, self.file.name).result(timeout=START)
        self._forget_file()  # both have it open

    def serve(self, *rows):
        """A future of the answers of rows, of which the file says nothing yet."""
        self.at[:] = 0.0, -1.0
        self.file.seek(HEAD)
        self.file.write(END)
        return self.executor.submit(SERVE, *rows)

    def finished(self):
        """(place, outcome, problems, episodes, transitions so far) of each row that it has finished
        of what it was given last.
        """
        self.file.seek(HEAD)
        written, found = io.BytesIO(self.file.read()), []
        with contextlib.suppress(Exception):  # the last one may be torn
            for row in iter(partial(pickle.load, written), None):
                if row[0] != len(found):
                    break
                found.append(row)
        return found

    def kill(self):
        executor, self.executor = self.executor, None
        if executor is not None:
            executor.shutdown(wait=False, kill_workers=True)
        if self.file is not None:
            self.at = None
            self.file.close()
            self._forget_file()
            self.file = None

    def _forget_file(self):
        with contextlib.suppress(OSError):  # Windows lets no mapped file go, until its end
            os.unlink(self.file.name)
