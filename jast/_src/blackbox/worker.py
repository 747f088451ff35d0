"""Runs a system, in this process or in a worker's: a row is an episode, or one transition of an
object that is kept.

This room goes to the workers by value, so that they need neither JAX nor this package: what a
`Runner` is made of imports NumPy and the standard library only.
"""

import contextlib
import inspect
import os
import pickle
import signal
import sys
import threading
import time
import types
from collections import deque

import numpy as np

from jast._src.blackbox.readings import (
    WrongAnswer,
    distance_of,
    event_of,
    log_p_of,
    observed_of,
    said,
    shown,
)
from jast._src.blackbox.rows import FAILED, Reply, blank, fill, history
from jast._src.blackbox.time_limit import Alarm

__all__ = ["END", "HEAD", "METHODS", "NAME", "Runner", "end_group", "install", "takes"]

METHODS = ("initialize", "transition", "miss_distance", "is_event")
KEPT = 8192  # objects that are kept at most for the next transitions of their episodes
NAME = "jast_blackbox_worker"  # the module that a worker process keeps its system in
HEAD = 16  # bytes of a worker's file before its finished rows: when what runs began, and its row
END = pickle.dumps(None)  # behind these rows
MAKING = 60.0  # seconds that the making of an object may take, whatever the time limit of its runs


class Runner:
    """A system and the objects that it has made."""

    def __init__(self, system, spec, x=0, size=0):
        """``x``, ``size``: as `configure` has them."""
        self.system, self.spec = system, spec
        self.kept: dict[tuple, list] = {}  # history -> objects that have it
        self.count = 0  # of these
        self.spare: deque = deque()  # objects for new episodes, the longest unused first
        self.episodes = self.transitions = 0
        self.alarm, self.finished = Alarm(spec.limit), None
        self.configure(x, size)

    def __reduce__(self):  # another process makes objects of its own
        return Runner, (self.system, self.spec, self.x, self.size)

    def configure(self, x, size, at=None):
        """``x``: the structure of a disturbance, like ``x0`` of `Spec`; ``size``: how many numbers
        ``observe`` returns; ``at``: a file that is told where the work is, and what each row came
        to, if anybody waits.
        """
        self.x, self.size = x, size
        if at is not None:
            self.alarm.at = np.memmap(at, np.float64, "r+", shape=2)
            self.finished = open(at, "r+b", buffering=0)  # what is written outlives this process

    def probe(self, x0):
        """How many numbers ``observe`` returns, or a sentence (str) that says what is wrong with
        the objects.
        """
        size = 0
        try:
            thing = self._fresh()
            missing = [name for name in METHODS if not callable(getattr(thing, name, None))]
            if missing:
                return (
                    f"expected an object with the methods {', '.join(METHODS)};"
                    f" {type(thing).__name__} lacks {', '.join(missing)}"
                )
            if not takes(thing.initialize, int(self.spec.random)):
                one = "x0, since start is random"
                none = "no argument, since no start distribution was given"
                return f"initialize must take {one if self.spec.random else none}"
            if not takes(thing.transition, 1):
                return "transition must take one argument, a disturbance"
            if not self.spec.episodic and callable(getattr(thing, "observe", None)):
                with self.alarm:
                    self._initialize(thing, x0)
                    size = len(observed_of(thing.observe(), None))
            self.spare.append(thing)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            return f"the first object could not be made: {said(error)[1]}"
        return size

    def __call__(self, t, x0, xs, lanes=None):
        """`Reply` for rows of ``t`` [n] disturbances each; ``x0``: leaves [n, ...], ``xs``: leaves
        [n, >= t, ...].
        """
        outcomes, problems = blank(len(t), self.size), []
        begin = time.perf_counter()
        self.episodes = self.transitions = 0
        one = self._episode if self.spec.episodic else self._step
        if self.finished is not None:
            self.finished.seek(HEAD)
        for i in range(len(t)):
            self.alarm.row, problem = i, []
            try:
                found = one(
                    int(t[i]), [np.array(a[i]) for a in x0], [np.array(a[i, : t[i]]) for a in xs]
                )
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # SystemExit too: the system's, not ours
                found, problem = FAILED, [said(error)]
            for array, value in zip(outcomes, found):
                array[i] = value
            problems += [(i, *words) for words in problem]
            if self.finished is not None:
                row = i, found, problem, self.episodes, self.transitions
                self._keep(pickle.dumps(row) + END)
        seconds = time.perf_counter() - begin
        return Reply(*outcomes, problems, self.episodes, self.transitions, seconds)

    def _keep(self, written):
        """Write to the file of finished rows; what comes next stands in the place of its end."""
        with contextlib.suppress(OSError):
            if self.finished.write(written) == len(written):
                self.finished.seek(-len(END), os.SEEK_CUR)
                return
        self.finished = None  # the disk is full: a torn row is not read, and no other is written

    def judge(self, x0, xs):
        """[n, 2] bool of whole episodes of objects: whether ``is_event`` holds at a state before
        the last, and at the last; neither where something goes wrong, as where it cannot be asked
        before the end.
        """
        found = np.zeros((len(xs[0]), 2), bool)
        for i in range(len(found)):
            try:
                thing = self._fresh()
                with self.alarm:
                    self._initialize(thing, [np.array(a[i]) for a in x0])
                    events = [event_of(thing.is_event())]
                    for k in range(self.spec.horizon):
                        thing.transition(fill(self.x, [np.array(a[i, k]) for a in xs]))
                        _evaluate(thing)
                        events.append(event_of(thing.is_event()))
            except KeyboardInterrupt:
                raise
            except BaseException:
                continue
            found[i] = any(events[:-1]), events[-1]
            self.spare.append(thing)
        return found

    def again(self, x0, xs):
        """What a new object says on the way (`_trace`) in the first of two episodes; one that has
        played others in the second, and in the first again; and where that is not the same, another
        new one. None where something goes wrong. Then how many episodes and transitions that took.
        """
        self.episodes = self.transitions = 0
        first, second = ([[np.array(a[i]) for a in leaves] for leaves in (x0, xs)] for i in (0, 1))
        try:
            thing = self._new()
            found = [self._trace(thing, *first)]
            thing = self.spare.pop() if self.spare else thing  # the more it has done the better
            found += [self._trace(thing, *given) for given in (second, first)]
            self.spare.append(thing)
            if found[0] != found[2]:
                found.append(self._trace(self._new(), *first))
        except KeyboardInterrupt:
            raise
        except BaseException:
            found = None
        return found, self.episodes, self.transitions

    def _trace(self, thing, x0, xs):
        """Event, distance, terminal, log p and observation of an object at every state of an
        episode; at the last where it is judged there.
        """
        self.episodes += 1
        if self.spec.episodic:
            return [self._play(thing, self.spec.horizon, x0, xs)]
        found, log_p, answer = [], 0.0, None
        for k in range(self.spec.horizon + 1):
            if k:
                log_p, answer = self._move(thing, fill(self.x, [a[k - 1] for a in xs]))
            else:
                with self.alarm:
                    answer = self._initialize(thing, x0)
            *said, seen = self._look(thing, log_p, answer)
            found.append((*said, np.asarray(seen, float).tobytes()))
            if said[0] or said[2]:
                break
        return found

    def _episode(self, t, x0, xs):
        self.episodes += 1
        if self.spec.run:
            with self.alarm:
                answer = self.system(fill(self.x, xs), *self._given(x0))
            self.transitions += t
            told = self.spec.tells in ("log_prob", "prob")
            if not isinstance(answer, tuple | list) or len(answer) != 2 + told:
                expected = ("the pair (event, distance)", "(p, event, distance)")[told]
                raise WrongAnswer(f"expected {expected}, received {shown(answer)}")
            log_p = log_p_of(answer[0], "p", self.spec.tells) if told else 0.0
            return event_of(answer[-2]), distance_of(answer[-1]), False, log_p, ()
        thing = self._fresh()
        found = self._play(thing, t, x0, xs)
        self.spare.append(thing)
        return found

    def _play(self, thing, t, x0, xs):
        """Event, distance, terminal, log p and observation of an object at the end of an episode
        that is judged there.
        """
        with self.alarm:
            thing.initialize(*self._given(x0))
            log_p = 0.0
            for k in range(t):
                log_p += self._transition(thing, fill(self.x, [a[k] for a in xs]))
            log_p, *outcome = self._outcome(thing, log_p, _evaluate(thing))
        return *outcome, False, log_p, ()

    def _step(self, t, x0, xs):
        """Event, distance, terminal and observation of the object with this history, which is moved
        on from the last one where it is kept.
        """
        log_p, answer = 0.0, None
        thing, at = self._take(history(x0, xs, t - 1)) if t else None, t - 1
        if thing is None:
            thing, at = self._fresh(), 0
            self.episodes += 1
            with self.alarm:
                answer = self._initialize(thing, x0)
        for k in range(at, t):
            log_p, answer = self._move(thing, fill(self.x, [a[k] for a in xs]))
        seen = self._look(thing, log_p, answer)
        event, _, ended, *_ = seen
        if event or ended or t >= self.spec.horizon:
            self.spare.append(thing)
        else:
            self.kept.setdefault(history(x0, xs, t), []).append(thing)
            self.count += 1
            if self.count > KEPT:
                self.spare.append(self._take(next(iter(self.kept))))
        return seen

    def _move(self, thing, x):
        """log p of a disturbance and what ``evaluate`` returned after it."""
        with self.alarm:
            return self._transition(thing, x), _evaluate(thing)

    def _look(self, thing, log_p, answer):
        """Event, distance, terminal, log p and observation of an object at its state."""
        with self.alarm:
            log_p, *outcome = self._outcome(thing, log_p, answer)
            ended = hasattr(thing, "is_terminal") and event_of(thing.is_terminal(), "is_terminal")
            observed = observed_of(thing.observe(), self.size) if self.size else ()
        return *outcome, ended, log_p, observed

    def _initialize(self, thing, x0):
        thing.initialize(*self._given(x0))
        return _evaluate(thing)

    def _transition(self, thing, x):
        """log p of one disturbance, by what ``transition`` returns."""
        self.transitions += 1
        return log_p_of(thing.transition(x), "transition", self.spec.tells)

    def _outcome(self, thing, log_p, answer):
        """log p, event and distance; ``answer``: what ``evaluate`` returned, whose (p, event,
        distance) stand in place of the others.
        """
        if isinstance(answer, tuple | list) and len(answer) == 3:
            log_p = log_p_of(answer[0], "evaluate", self.spec.tells)
            return log_p, event_of(answer[1]), distance_of(answer[2])
        return log_p, event_of(thing.is_event()), distance_of(thing.miss_distance())

    def _given(self, x0):
        return (fill(self.spec.x0, x0),) if self.spec.random else ()

    def _fresh(self):
        return self.spare.popleft() if self.spare else self._new()

    def _new(self):
        self.alarm.tell(MAKING)
        return self.system()

    def _take(self, history):
        things = self.kept.get(history)
        if things is None:
            return None
        self.count -= 1
        thing = things.pop()
        if not things:
            del self.kept[history]
        return thing


def _evaluate(thing):
    return thing.evaluate() if hasattr(thing, "evaluate") else None


def takes(function, count):
    """Whether ``function`` can be called with so many arguments; True where Python does not
    know.
    """
    try:
        inspect.signature(function).bind(*[None] * count)
    except TypeError:
        return False
    except ValueError:
        pass
    return True


def install(system, spec):
    """Keep the system in this worker process, where calls of `NAME` find it."""
    if hasattr(signal, "SIGINT"):
        # a search that is interrupted ends its workers itself
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    module = types.ModuleType(NAME)
    module.running = set()  # processes of external programs
    args = os.getppid(), module.running
    threading.Thread(target=_end_with, args=args, daemon=True).start()
    module.runner = runner = Runner(system, spec)
    # a plain tuple: the class would travel with it
    module.serve = lambda *rows: tuple(runner(*rows))
    for name in ("probe", "configure", "judge", "again"):
        setattr(module, name, getattr(runner, name))
    sys.modules[NAME] = module


def _end_with(parent, running):
    """End this process, and first what it runs, once ``parent`` has: one that was killed could not
    end its workers.
    """
    while os.getppid() == parent:
        time.sleep(1)
    for process in list(running):
        end_group(process)
    os._exit(1)


def end_group(process):
    """End a process that leads a session, with what it has started."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except (AttributeError, OSError):  # no sessions on this system, or it has just ended
        process.kill()
