"""Adaptive multilevel splitting: its estimate is unbiased whatever the score, ties and all; nothing
is run twice; and where it cannot be right it says so.
"""

import copy
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import jast
from jast import distributions as D
from jast import specs
from jast._src.estimate.splitting import levels
from jast._src.estimate.splitting.levels import FRESH, Played, climb
from jast.estimate import splitting
from jast.simulators import limit_state, walk1d

STEPS, LIMIT = 12, 5.0
MAX_ERRORS = 4.0
"""Standard errors that a mean may be off: by chance one of 16,000 is."""


# systems


def pulled(state, x):
    return 0.8 * state + x


def beyond(state):
    return state >= LIMIT, jnp.maximum(LIMIT - state, 0.0)


def unit(state):
    return D.Normal(jnp.zeros(()), 1.0)


def autoregression(**changed):
    """s += x - s / 5 from 0; failure at 5 or above."""
    fields = dict(init=lambda x0: jnp.zeros(()), step=pulled, disturbance=unit, evaluate=beyond)
    return jast.Simulator(**(fields | dict(horizon=STEPS) | changed))


def autoregression_probability(low=-30.0, spread=0.0, steps=STEPS, nodes=400):
    """By its transition operator on Gauss and Legendre's points between ``low``, below which an
    episode ends without a failure, and the limit; from N(0, spread^2).
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = low + (x + 1) / 2 * (LIMIT - low), w / 2 * (LIMIT - low)
    value = np.zeros(nodes)  # of the probability to fail yet
    at = np.append(x, 0.0)
    for _ in range(steps):
        inside = stats.norm.pdf(x - 0.8 * at[:, None]) * w @ value
        value, first = np.split(stats.norm.sf(LIMIT - 0.8 * at) + inside, [nodes])
    if not spread:
        return float(first[0])
    return float(w @ (stats.norm.pdf(x, scale=spread) * value) + stats.norm.sf(LIMIT / spread))


TRUTH = autoregression_probability()


class Chain:
    """A walk of whole numbers: a step up with probability .3, down else, not below 0; it fails at
    5. As paths in NumPy, for `climb`.
    """

    up, top, steps, first = 0.3, 5, 9, 0

    def __init__(self, seed, n):
        self.rng, self.n, self.rows = np.random.default_rng(seed), n, [None] * n

    def play(self, paths, parents, level):
        for path, parent in zip(paths, parents):
            row = [(0, self.first)]
            if parent != FRESH:
                row = [next((t, s) for t, s in self.rows[parent] if self.score(s) > level)]
            while row[-1][0] < self.steps and row[-1][1] < self.top:
                (t, s), up = row[-1], self.rng.random() < self.up
                row.append((t + 1, s + 1 if up else max(s - 1, 0)))
            self.rows[path] = row
        tops = [max(self.score(s) for _, s in self.rows[path]) for path in paths]
        return Played(np.array(tops), np.zeros(len(paths), bool), 0, 0)

    def score(self, s):
        return math.inf if s >= self.top else float(s // 2)  # three values, and failure

    @classmethod
    def simulator(cls):
        return jast.Simulator(
            init=lambda x0: jnp.int32(cls.first),
            step=lambda s, x: jnp.where(x, s + 1, jnp.maximum(s - 1, 0)),
            disturbance=lambda s: D.Bernoulli(probs=cls.up, dtype=jnp.int32),
            evaluate=lambda s: (s >= cls.top, (jnp.maximum(cls.top - s, 0) // 2).astype(float)),
            horizon=cls.steps,
        )

    @classmethod
    def probability(cls):
        chain = np.zeros((cls.top + 1, cls.top + 1))
        for i in range(cls.top):
            chain[i, i + 1] += cls.up
            chain[i, max(i - 1, 0)] += 1 - cls.up
        chain[cls.top, cls.top] = 1
        return np.linalg.matrix_power(chain, cls.steps)[cls.first, cls.top]


class Walker:
    """`autoregression` in Python; it counts what is done to all of its kind."""

    begun = moved = 0

    def initialize(self):
        type(self).begun += 1
        self.at = np.zeros(1)

    def transition(self, x):
        type(self).moved += 1
        self.at *= 0.8  # in place: what shares it, changes with it
        self.at += float(x)

    def miss_distance(self):
        return max(LIMIT - float(self.at[0]), 0.0)

    def is_event(self):
        return bool(self.at[0] >= LIMIT)


class Saved(Walker):
    def snapshot(self):
        return self.at.copy()

    def restore(self, saved):
        self.at = saved.copy()

    def __deepcopy__(self, memo):
        raise TypeError("is not copied")


def black_box(kind, **more):
    kind.begun = kind.moved = 0
    given = dict(horizon=STEPS, disturbance=D.Normal(0.0, 1.0))
    return jast.blackbox.from_python(kind, **(given | more))


def off(found, truth):
    """How many standard errors the mean of many runs is off."""
    return abs(found.mean - truth) / found.standard_error


# right


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0.01, 0.25, 0.5])
def test_the_levels_are_unbiased_where_scores_tie(killed):
    """Of 8 particles, the whole algorithm without the device."""
    rngs = map(np.random.default_rng, range(1500))
    found = [math.exp(climb(r, Chain(i, 8), killed).log_mean) for i, r in enumerate(rngs)]
    error = np.std(found) / len(found) ** 0.5
    assert abs(np.mean(found) - Chain.probability()) < MAX_ERRORS * error
    assert error < 0.1 * Chain.probability()  # or it says nothing


class Branches(Chain):
    """Checks that no path and no family has more children than its share, but for one."""

    def __init__(self, seed, n):
        super().__init__(seed, n)
        self.family, self.levels = np.arange(n), 0

    def play(self, paths, parents, level):
        if (parents != FRESH).all():
            alive = np.setdiff1d(np.arange(self.n), paths)
            for label in (np.arange(self.n), self.family):
                had = np.bincount(label[parents], minlength=self.n)
                share = np.bincount(label[alive], minlength=self.n) * len(paths) / len(alive)
                assert (np.abs(had - share) < 1).all()
            self.family[paths] = self.family[parents]
            self.levels += 1
        return super().play(paths, parents, level)

    def score(self, s):
        return math.inf if s >= self.top else float(s)  # five values: more levels


@pytest.mark.parametrize("killed", [0.05, 0.25, 0.6])
def test_families_have_children_in_proportion(killed):
    paths = Branches(0, 300)
    run = climb(np.random.default_rng(1), paths, killed)
    assert run.ancestors == len(set(paths.family[[r[-1][1] >= Chain.top for r in paths.rows]]))
    assert paths.levels == len(run.levels) >= 3


def _nan_below(state):
    event, distance = beyond(state)
    return event, jnp.where(state < -1.0, jnp.nan, distance)


CASES = {
    "a maximum": (autoregression, {}, TRUTH),
    "ties": (Chain.simulator, {}, Chain.probability()),
    "a random start": (
        lambda: autoregression(start=lambda: D.Normal(0.0, 1.5), init=lambda x0: x0),
        {},
        autoregression_probability(spread=1.5),
    ),
    "one step from a random start": (
        lambda: autoregression(start=lambda: D.Normal(0.0, 1.5), init=lambda x0: x0, horizon=1),
        {},
        autoregression_probability(spread=1.5, steps=1),
    ),
    "invalid episodes": (
        lambda: autoregression(evaluate=_nan_below),
        {},
        autoregression_probability(low=-1.0),
    ),
    "a specification": (
        lambda: specs.under(
            autoregression(), specs.always(specs.predicate(lambda s: LIMIT - s, "s < 5"))
        ),
        {},
        TRUTH,
    ),
    "a poor score": (autoregression, dict(score=lambda s: jnp.round(s / 2) * 1.0), TRUTH),
    "an end at the last step": (
        lambda: autoregression(episodic=True),
        dict(score=lambda s: s),
        float(stats.norm.sf(LIMIT, scale=np.sqrt(np.sum(0.64 ** np.arange(STEPS))))),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ties", "a random start", "invalid episodes"])
def test_the_mean_of_small_runs_is_right(name, key):
    """Few particles a run, where a bias would be greatest."""
    make, more, truth = CASES[name]
    found = splitting(key, make(), 60, runs=25, **more)
    assert off(found, truth) < MAX_ERRORS
    assert found.relative_error < 0.3
    if name == "invalid episodes":
        assert found.invalid >= found.plain[1] > 0
        assert any("invalid" in text for text in found.warnings)


@pytest.mark.long
@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_the_mean_of_very_many_runs_is_right(name, x64, key):
    with jax.enable_x64(x64):
        make, more, truth = CASES[name]
        found = splitting(key, make(), 60, runs=1500, **more)
        assert off(found, truth) < MAX_ERRORS
        assert found.relative_error < 0.12  # .099 where all hangs on one step


@pytest.mark.long
def test_intervals_cover(key):
    """95 % intervals of 10 runs, 60 times: at least 51 with all but 1e-4."""
    covers = 0
    for k in jax.random.split(key, 60):
        low, high = splitting(k, autoregression(), 200).interval
        covers += low <= TRUTH <= high
    assert covers >= 51


@pytest.mark.slow
def test_float64(key):
    with jax.enable_x64(True):
        found = splitting(key, autoregression(), 60, runs=20)
        assert off(found, TRUTH) < MAX_ERRORS


@pytest.mark.slow
def test_steps_and_episodes_are_counted(key):
    """Every episode of a system that neither ends nor fails before its horizon has all steps, and a
    branch only those after it.
    """
    sim = autoregression(evaluate=lambda s: (s >= 40.0, 40.0 - s))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(levels, "MIN_LOG_PROBABILITY", -1.0)  # three levels, and no more
        found = splitting(key, sim, 100, runs=3)
    assert np.isnan(found.mean)
    assert found.ess == 0
    assert not found.reliable
    assert found.samples == found.plain[2] == 300
    branches = 3 * 3 * 25
    assert 300 * STEPS < found.steps < (300 + branches) * STEPS
    assert found.episodes == math.ceil(found.steps / STEPS)


@pytest.mark.slow
def test_the_same_key_the_same_answer_and_a_checkpoint_goes_on(key, tmp_path):
    first = splitting(key, autoregression(), 100, runs=3, checkpoint=tmp_path)
    told = []
    again = splitting(
        key,
        autoregression(),
        100,
        runs=3,
        checkpoint=tmp_path,
        callback=lambda *a: told.append(a[0]),
    )
    assert str(first) == str(again) == str(splitting(key, autoregression(), 100, runs=3))
    assert told[-1] == 3


# black boxes


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Walker, Saved])
def test_objects_go_on_from_where_they_were(kind, key):
    """Deep copies, and the object's own snapshots: transitions as counted by the object itself."""
    sim = black_box(kind)
    begun = kind.begun  # of the object by which a black box is known
    found = splitting(key, sim, 60, runs=6)
    assert off(found, TRUTH) < MAX_ERRORS
    assert found.steps == kind.moved == jast.blackbox.calls(sim).transitions
    assert kind.begun - begun == jast.blackbox.calls(sim).episodes
    assert kind.begun - begun <= 6 * 60 + 2  # the check begins one, or two
    assert found.episodes == math.ceil(found.steps / STEPS)


@pytest.mark.long
def test_objects_and_arrays_come_to_the_same_in_the_mean(key):
    """A start and disturbances that depend on the state, a score of the state, and an early end."""

    class Box(Walker):
        def initialize(self, x0):
            self.at = np.array([float(x0)])

        def is_terminal(self):
            return bool(self.at[0] < -1.0)

    def wide(state):
        return D.Normal(0.0, jnp.where(state.distance < 3.0, 1.0, 1.3))

    start = D.Normal(0.0, 0.5)
    box = black_box(Box, start=start, disturbance=wide)
    sim = autoregression(
        start=lambda: start,
        init=lambda x0: x0,
        disturbance=lambda s: D.Normal(0.0, jnp.where(LIMIT - s < 3.0, 1.0, 1.3)),
        is_terminal=lambda s: s < -1.0,
    )
    ours = splitting(key, sim, 100, runs=10)
    theirs = splitting(key, box, 60, runs=6, score=lambda s: -(s.distance**2))
    apart = abs(ours.mean - theirs.mean)
    assert apart < MAX_ERRORS * math.hypot(ours.standard_error, theirs.standard_error)


@pytest.mark.slow
def test_what_goes_wrong_in_an_object_is_an_invalid_episode(key):
    class Raises(Walker):
        def miss_distance(self):
            if self.at[0] < -1.0:
                raise OSError("lost")
            return super().miss_distance()

    found = splitting(key, black_box(Raises), 50, runs=6)
    assert off(found, autoregression_probability(low=-1.0)) < MAX_ERRORS
    assert found.invalid > 0
    assert any("OSError: lost" in text for text in found.warnings)


@pytest.mark.slow
def test_an_object_that_does_not_begin_is_an_invalid_episode(key):
    class Picky(Walker):
        def initialize(self, x0):
            if x0 > 0.5:
                raise OSError("no such start")
            self.at = np.array([float(x0)])

    sim = black_box(Picky, start=D.Normal(0.0, 0.5))
    found = splitting(key, sim, 50, runs=6)
    assert found.invalid > 0
    assert any("OSError: no such start" in text for text in found.warnings)
    (incident,) = jast.incidents.incidents(sim)
    assert incident.x0 > 0.5 and incident.disturbances == ()


# wrong


class Forgets(Saved):
    """Its snapshot is the array itself, which the object goes on to change."""

    def snapshot(self):
        return self.at


class Shares(Saved):
    """What is restored is the saved array itself."""

    def restore(self, saved):
        self.at = saved


class Half(Saved):
    restore = None


class Neither(Walker):
    def __deepcopy__(self, memo):
        raise TypeError("cannot be copied")


class Global(Walker):
    """A part of its state is outside of it."""

    rest = np.zeros(1)

    def initialize(self):
        super().initialize()
        self.at = Global.rest
        self.at[:] = 0

    def __deepcopy__(self, memo):
        return copy.copy(self)


class Dice(Walker):
    def transition(self, x):
        super().transition(float(x) + np.random.normal())


@pytest.mark.parametrize(
    "kind, said",
    [
        (Forgets, "restore.saved. of its snapshot.. must bring back"),
        (Shares, "restore.saved. of its snapshot.. must bring back"),
        (Global, "a copy by copy.deepcopy must bring back"),
        (Half, "both methods"),
        (Neither, "cannot be copied"),
        (Dice, "must be deterministic"),
    ],
)
def test_objects_that_cannot_be_resumed(kind, said, key):
    with pytest.raises(ValueError, match=f"splitting: .*{said}"):
        splitting(key, black_box(kind), 10, runs=3)


@pytest.mark.parametrize(
    "sim, more, said",
    [
        (limit_state(lambda u: 3 - u[0], 2), {}, "states on the way"),
        (autoregression(episodic=True), {}, "give score="),
        (walk1d(), dict(particles=9), "particles must be a whole number of at least 10"),
        (walk1d(), dict(runs=2), "runs must be a whole number of at least 3"),
        (walk1d(), dict(level=1.0), "level"),
        (walk1d(), dict(score=3.0), "score must be a function"),
        (walk1d(), dict(score=lambda s: jnp.ones(2)), "float scalar"),
        (walk1d(), dict(score=lambda s: s.speed), "score raised AttributeError"),
        ("walk", {}, "jast.Simulator"),
    ],
)
def test_bad_input(sim, more, said, key):
    with pytest.raises(ValueError, match=f"splitting: .*{said}"):
        splitting(key, sim, **more)


def test_black_boxes_that_cannot_branch(key):
    run = jast.blackbox.from_python(
        lambda x: (bool(x.sum() > 5), float(max(5 - x.sum(), 0))),
        horizon=4,
        disturbance=D.Normal(0.0, 1.0),
    )
    with pytest.raises(ValueError, match="splitting: .*cannot be resumed"):
        splitting(key, run)


@pytest.mark.long
def test_objects_in_other_processes_cannot_branch(key):
    with pytest.raises(ValueError, match="splitting: .*workers=0"):
        splitting(key, black_box(Walker, workers=1))


@pytest.mark.slow
def test_a_score_that_says_nothing_is_flagged(key):
    """All particles tie, and no level can be set; where one fails, plain draws are what is left."""
    found = splitting(key, autoregression(), 50, runs=3, score=lambda s: jnp.zeros(()))
    assert not found.reliable
    assert "reached no failure" in str(found)
    undefined = splitting(key, autoregression(), 50, runs=3, score=lambda s: jnp.log(s))
    assert not undefined.reliable
    assert any("scores are NaN" in text for text in undefined.warnings)


@pytest.mark.parametrize("value", [1j, True, "far", np.zeros(2)])
def test_a_score_is_a_real_number(key, value):
    with pytest.raises(ValueError, match="splitting: score"):
        splitting(key, autoregression(), 50, runs=3, score=lambda s: value)


def test_failures_of_one_ancestor_are_flagged(key):
    """Ten particles and a rare failure: each run is the story of one episode."""
    sim = autoregression(evaluate=lambda s: (s >= 9.0, jnp.maximum(9.0 - s, 0.0)))
    found = splitting(key, sim, 10, runs=5)
    assert not found.reliable
    assert any("descend from" in text or "reached no failure" in text for text in found.warnings)
