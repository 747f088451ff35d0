"""from_python: a system that is not written in JAX as a `jast.Simulator`, whose `states` are
records of its disturbances.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jast import distributions as D
from jast._src.blackbox import states
from jast._src.blackbox.host_calls import Calls, Host
from jast._src.blackbox.pool import Pool
from jast._src.blackbox.rows import Spec
from jast._src.blackbox.worker import METHODS, Runner, takes
from jast._src.blackbox.worker_process import pack
from jast._src.core.contract import OBSERVED
from jast._src.core.simulator import Simulator, fixed, translating
from jast._src.core.typing import Array, ArrayTree, DistributionLike, Disturbance, Start
from jast._src.distributions.containers import accepted
from jast._src.distributions.special import Seeds
from jast._src.runtime.host_errors import Asking, hosts_of
from jast._src.util.checks import number, whole_number, wrong
from jast._src.util.pytrees import shapes_text

__all__ = ["calls", "from_python"]

NAME = "from_python"


def from_python(
    system: Any,
    *,
    horizon: int,
    disturbance: DistributionLike | Disturbance | None = None,
    start: DistributionLike | Start = fixed,
    episodic: bool | None = None,
    likelihood: Literal["log_prob", "prob"] | None = None,
    workers: int = 0,
    time_limit: float | None = None,
    observe: Callable[[Any], Array] | None = None,
    like: ArrayTree = None,
) -> Simulator:
    """A system in plain Python, NumPy or another language as a `jast.Simulator`: it is called on
    the host, once for all lanes of a batch.

    The system is one of two kinds:

    - a function ``run(disturbances) -> (event, distance)``, or ``run(disturbances, x0)`` where
      ``start`` is random: a whole episode at once, ``disturbances`` [horizon, ...] in NumPy (a
      pytree where a disturbance is one). `jast.blackbox.program` makes one of an external program.
    - a class, or a function without arguments that makes an object, with the methods
      ``initialize()`` (``initialize(x0)`` where the start is random), ``transition(x)``,
      ``miss_distance() -> float``, ``is_event() -> bool``, and optionally ``evaluate()`` (runs the
      system under test), ``is_terminal() -> bool`` and ``observe() -> vector``: Table 3.1 of Moss's
      thesis. ``initialize`` puts an object back to the start, as it serves many episodes.
      For `jast.estimate.splitting` it may have ``snapshot()``, which returns its state, and
      ``restore(saved)``, which brings it back as often as asked; else it is copied.
      `jast.blackbox.gymnasium_system` makes one of an environment.

    What goes wrong (an exception, no answer in time, a process that dies, another answer than a
    bool and a finite number) makes an episode invalid, never a failure, and does not stop the
    search: see `jast.incidents.incidents`. Outcomes have no gradient: NaN. A simulator is known by
    its identity: make it once.

    No run is made twice: answers are kept by their disturbances for as long as there is the
    simulator (128 MB of them at most), and with ``checkpoint=`` of a call in its folder. Only the
    first failure that is asked for again is run again, and the first other episode. Where that is
    answered otherwise the system is not deterministic: an incident says so, and from then on all
    runs are made. So a call runs no more often than its ``budget`` or ``episodes``; what comes on
    top (these two, the undisturbed episode of `jast.nominal`, the episodes that scale the reward of
    a search) is in its docstring.

    Args:
        system: see above.
        horizon: disturbances of an episode.
        disturbance: a distribution of `jast.distributions`, the same at each step, or a function
            state -> distribution in JAX of the state `Record` or `Standing`. None:
            `jast.distributions.seeds`, one uint32 a step of unknown density.
        start: p(x0), a distribution or a function () -> distribution.
        episodic: when the system is judged. None: a function at the end, an object at every state.
            False, for objects only: ``evaluate``, ``is_event``, ``miss_distance`` and
            ``is_terminal`` are asked after ``initialize`` and after each transition, and the first
            failure ends the episode; one host call a step for all lanes. An object is kept under
            its history for the next disturbance; a tree that comes back to an older state repeats
            the history in another one. True: the system is run once, at the end of an episode,
            which always has ``horizon`` disturbances (fewer are an invalid episode):
            ``initialize``, each ``transition``, then ``evaluate``; one host call an episode. That
            suits an ``is_event`` that means something only at the end, or that remembers what has
            happened. One that says "is it failing now" loses the failures that are over by then:
            `jast.check` looks for some and warns.
        likelihood: what the system says of the probability of its disturbances, on top of the
            density of ``disturbance``. "log_prob": ``transition`` returns log p of its disturbance;
            "prob": p itself (a density may exceed 1). Then it must return a number, and a function
            of whole episodes returns ``(p, event, distance)``, p or log p of all. An ``evaluate``
            may return ``(p, event, distance)`` too, Table 3.1's <p, e, d>: they stand in place of
            ``is_event``, ``miss_distance`` and all p that ``transition`` returned since the last
            ``evaluate``. None: where the density is unknown (``disturbance`` left out, or
            `jast.distributions.seeds`), a number that an object returns is log p; elsewhere only
            ``disturbance`` counts. Give it with a known density only where the object's p is of
            other things: both count.
        workers: 0 runs the system in this process; n >= 1 in n processes of their own (``pip
            install 'jast[blackbox]'``), started on first use and ended with this one.
        time_limit: seconds for a run, or for a transition; needs a worker. One that hangs where
            nothing interrupts it costs its limit, about a second more and the start of a process.
        observe: state -> float vector, 64 numbers at most. Default: what the object's ``observe``
            returns (``seen`` of `Standing`, of any length where ``observe`` chooses from it), else
            t / horizon and the last disturbance (an unsigned integer over its greatest value).
        like: a value of the disturbance, where a function ``disturbance`` cannot tell its shape
            without one.

    Returns:
        `jast.Simulator`.

    Raises:
        ValueError: for a system that is neither kind (what it lacks is named), that cannot be sent
            to a worker, or whose first object cannot be made; for another horizon, disturbance,
            start, number of workers or time limit.
        RuntimeError: inside a search, where a worker process cannot load the system.

    Example:
        >>> import jax, jast
        >>> from jast import distributions as D
        >>> class Tank:
        ...     def initialize(self):
        ...         self.level = 5.0
        ...
        ...     def transition(self, x):
        ...         self.level += float(x)
        ...
        ...     def miss_distance(self):
        ...         return max(self.level, 0.0)
        ...
        ...     def is_event(self):
        ...         return self.level <= 0.0
        >>> sim = jast.blackbox.from_python(Tank, horizon=10, disturbance=D.Normal(0.0, 1.0))
        >>> int(jast.rollout(jax.random.key(0), sim).length) <= 10
        True
    """
    horizon = whole_number(NAME, "horizon", horizon)
    workers = whole_number(NAME, "workers", workers, 0)
    if episodic is not None and not isinstance(episodic, bool):
        raise ValueError(f"{NAME}: episodic must be True, False or None, received {episodic!r}")
    if time_limit is not None:
        expected = "of seconds above 0, or None"
        time_limit = number(NAME, "time_limit", time_limit, lambda s: 0 < s < np.inf, expected)
        if not workers:
            raise ValueError(
                f"{NAME}: time_limit needs workers of at least 1, received workers=0: a run in this"
                " process cannot be stopped"
            )
    if likelihood not in (None, "log_prob", "prob"):
        raise wrong(NAME, "likelihood", 'be "log_prob", "prob" or None', f"{likelihood!r}")
    if observe is not None and not callable(observe):
        raise ValueError(f"{NAME}: observe must be a function of the state, received {observe!r}")
    start = _start(start)
    like0 = jax.eval_shape(lambda: D.sample(start(), jax.random.key(0)))
    random = bool(jax.tree.leaves(like0))
    run = _is_function(system, random, episodic)
    episodic = run if episodic is None else episodic
    disturbance = D.seeds() if disturbance is None else accepted(disturbance)
    tells = likelihood or ("maybe" if isinstance(disturbance, Seeds) and not run else None)
    spec = Spec(run, episodic, horizon, _structure("x0", like0), random, time_limit, tells)
    runner = (
        Pool(pack(system, spec), workers, spec, system=system) if workers else Runner(system, spec)
    )
    size = 0 if run else _observed_numbers(runner, start, limited=observe is None)

    if inspect.isclass(disturbance):
        received = f"the class {disturbance.__name__}; call it, as Normal(0.0, 1.0)"
        raise wrong(NAME, "disturbance", "be a distribution", received)
    constant = D.is_distribution(disturbance)
    if not (constant or callable(disturbance)):
        must = "be a distribution, or a function state -> distribution"
        raise wrong(NAME, "disturbance", must, f"{disturbance!r}")
    blank = partial(states.blank, episodic, horizon, like0, size)
    like = D.event_like(disturbance) if constant else _shape(disturbance, blank, like)
    runner.configure(_structure("disturbance", like), size)
    host = Host(runner, len(jax.tree.leaves(like0)))

    def begin(x0):
        return blank(like)._replace(begun=jnp.ones((), bool), x0=x0)

    fields = dict(
        disturbance=(lambda state: disturbance) if constant else disturbance,
        horizon=horizon,
        start=start,
        episodic=episodic,
        observe=states.observe if observe is None else observe,
    )
    if episodic:
        judge = states.judge if tells is None else states.judge_with_log_p
        return Simulator(begin, states.extend, evaluate=Asking(host, judge), **fields)
    return Simulator(
        lambda x0: states.with_outcome(host, begin(x0)),
        Asking(host, states.transition),
        evaluate=states.outcome if tells is None else states.outcome_and_log_p,
        is_terminal=lambda state: state.terminal,
        **fields,
    )


def calls(sim: Simulator) -> Calls:
    """How often the system behind a black box has run so far, and for how long.

    Args:
        sim: of `from_python`.

    Returns:
        `Calls`.

    Raises:
        ValueError: for a simulator without a black box.

    Example:
        >>> import jax, jast
        >>> from jast import distributions as D
        >>> run = lambda x: (bool(x.sum() > 5.0), float(max(5.0 - x.sum(), 0.0)))
        >>> sim = jast.blackbox.from_python(run, horizon=10, disturbance=D.Normal(0.0, 1.0))
        >>> found = jast.nominal(jax.random.key(0), sim, 50)
        >>> jast.blackbox.calls(sim).episodes >= 50
        True
    """
    counts = [host.done for host in hosts_of(sim)]
    if not counts:
        must = "be a simulator of jast.blackbox.from_python"
        raise wrong("calls", "sim", must, "one that runs nothing on the host")
    return Calls(*map(sum, zip(*counts)))


def _shape(disturbance, blank, like):
    """Shapes and dtypes of a value of ``disturbance``, whose state holds such values: found by
    trying until it returns what it was given.
    """
    hint = "" if like is not None else "; give like=, an example of a disturbance"
    like = jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), 0.0 if hint else like
    )

    def value():
        dist = accepted(disturbance(blank(like)))
        if not D.is_distribution(dist):
            raise TypeError(f"expected a distribution, received {dist!r}")
        return D.sample(dist, jax.random.key(0))

    for _ in range(4):
        try:
            found = jax.eval_shape(value)
        except Exception as error:
            tried = f"on a state with disturbances {shapes_text(blank(like).disturbances)}{hint}"
            raise ValueError(
                f"{NAME}: disturbance: {type(error).__name__}: {error} ({tried})"
            ) from error
        if found == like:
            return like
        like = found
    raise ValueError(
        f"{NAME}: the shape of what disturbance returns changes with the shape of the state's"
        f" disturbances, the last was {shapes_text(like)}; give like=, an example of a disturbance"
    )


def _structure(name, like):
    """``like`` with the place of each leaf in its stead."""
    leaves, tree = jax.tree.flatten(like)

    def plain(s):
        if isinstance(s, dict | tuple | list):
            return all(map(plain, s.values() if isinstance(s, dict) else s))
        return s is None or isinstance(s, int)

    structure = tree.unflatten(range(len(leaves)))
    if not plain(structure):
        raise wrong(NAME, name, "be an array or dicts, lists and tuples of arrays", tree)
    return structure


def _start(start):
    if D.is_distribution(start := accepted(start)):
        return lambda: start
    if not callable(start) or not D.is_distribution(accepted(start())):
        must = "be a distribution, or a function () -> distribution"
        raise wrong(NAME, "start", must, f"{start!r}")
    return translating(start)


def _is_function(system, random, episodic):
    """Whether ``system`` is a function of whole episodes; else it makes objects. ValueError where
    it is neither.
    """
    if inspect.isclass(system):
        missing = [name for name in METHODS if not callable(getattr(system, name, None))]
        if missing:
            raise ValueError(
                f"{NAME}: system must be a class with the methods {', '.join(METHODS)};"
                f" {system.__name__} lacks {', '.join(missing)}"
            )
        return False
    if not callable(system):
        an_object = any(hasattr(system, m) for m in METHODS)
        hint = "; give its class, or a function that makes it" if an_object else ""
        must = "be a function of the disturbances, or a class"
        raise wrong(NAME, "system", must, f"{system!r}{hint}")
    try:
        parameters = inspect.signature(system).parameters.values()
    except (TypeError, ValueError):  # one that Python knows nothing of
        parameters = None
    if parameters is not None and not any(map(_is_needed, parameters)):
        return False
    if not takes(system, 1 + random):
        expected = "(disturbances), since no start distribution was given"
        if random:
            expected = "(disturbances, x0), since start is random"
        must = f"be a function of {expected}"
        raise wrong(NAME, "system", must, f"{_name(system)}{inspect.signature(system)}")
    if episodic is False:
        raise ValueError(
            f"{NAME}: episodic=False needs a class with the methods {', '.join(METHODS)};"
            f" {_name(system)} is a function of whole episodes"
        )
    return True


def _is_needed(p):
    return p.kind == p.VAR_POSITIONAL or (p.default is p.empty and p.kind != p.VAR_KEYWORD)


def _name(system):
    return getattr(system, "__name__", type(system).__name__)


def _observed_numbers(runner, start, limited):
    """The length of an observation, by a first object where all others will be. ValueError where it
    does not work, and where it is ``limited`` and too long.
    """
    x0 = [np.asarray(a) for a in jax.tree.leaves(D.sample(start(), jax.random.key(0)))]
    found = runner.probe(x0)
    if isinstance(found, str):
        raise ValueError(f"{NAME}: system: {found}")
    if limited and found > OBSERVED:
        raise ValueError(
            f"{NAME}: system: observe returns {found} numbers, expected at most {OBSERVED}; pass"
            f" observe=, a function of the state that chooses, as lambda s: s.seen[:{OBSERVED}]"
        )
    return found
