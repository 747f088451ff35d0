"""Pictures of general systems: the right names, lines and numbers, whatever the states are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import drawn, legend, plt
from systems import ring, walk

import jast
from jast import plot
from jast._src.search.refine.modes import owners
from jast._src.util.leaf_names import named_fields
from jast.distributions import Joint, Normal

FERRY = jast.simulators.ferry()
RING = ring()


def played(sim, n):
    each = jax.vmap(lambda key: jast.rollout(key, sim)._replace(states=None))
    return jax.device_get(each(jax.random.split(jax.random.key(1), n)))


def labels(axes):
    return [ax.get_ylabel() for ax in axes]


def paths(ax):
    """The lines of episodes, without dashed ones and those of the legend."""
    return [line for line in ax.lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 1]


def test_names_of_any_pytree():
    tree = (
        {"a": np.zeros((2, 3))},
        np.ones((2, 1, 2)),
        jax.random.split(jax.random.key(0), 2),
        np.zeros((2, 0)),
    )
    found = named_fields(tree, "s")
    assert [(f.name, f.entries) for f in found] == [
        ("s.0.a", ["[0]", "[1]", "[2]"]),
        ("s.1", ["[0, 0]", "[0, 1]"]),
    ]
    assert found[0].values.shape == (2, 3)
    [whole] = named_fields(np.array([True, False]), "state")
    assert whole.name == "state"
    assert whole.entries == [""]
    assert whole.values.tolist() == [[1], [0]]
    assert named_fields({"deep": {"speed": np.zeros(1)}}, "s")[0].name == "deep.speed"


@pytest.mark.slow
def test_traces_of_a_nested_state_against_nominal_bands():
    few = played(RING, 5)
    axes = plot.traces(few, RING, nominal=40, units={"gusts": "m/s"}, modes=[0, 1, 0, 0, 1])
    assert labels(axes) == ["gusts[0] (m/s)", "gusts[1] (m/s)", "gusts[2] (m/s)", "hits"] + [
        "miss distance"
    ]
    drawn(axes)
    whole = jax.vmap(lambda e: jast.replay(RING, e))(few).states
    for ax, values in zip(axes, np.moveaxis(np.asarray(whole.gusts), -1, 0), strict=False):
        assert len(ax.collections) == 2  # two bands
        own = [line for line in paths(ax)]
        assert len(own) == 5
        for i, line in zip((0, 2, 3, 1, 4), own, strict=True):  # by mode
            n = int(few.length[i])
            np.testing.assert_allclose(line.get_ydata()[: n + 1], values[i][: n + 1], rtol=1e-6)
            assert np.isnan(line.get_ydata()[n + 1 :]).all()
    words = [text.get_text() for text in axes[0].figure.legends[0].get_texts()]
    assert words[:3] == ["90% of 40 nominal episodes", "50% of 40 nominal episodes", "undisturbed"]
    assert words[3].startswith("mode 1: 3") and words[4].startswith("mode 2: 2")


@pytest.mark.slow
def test_the_bands_are_quantiles_of_those_that_still_run():
    usual = played(FERRY, 30)
    [ax] = plot.traces(usual, FERRY, "x", nominal=usual, most=1)
    low, high = (np.quantile(np.asarray(_states(usual).x), q, axis=0) for q in (0.05, 0.95))
    box = ax.collections[0].get_paths()[0].vertices
    for t in (1, 10, 21):
        edges = box[np.isclose(box[:, 0], t), 1]
        assert edges.min() == pytest.approx(low[t], rel=1e-5)
        assert edges.max() == pytest.approx(high[t], rel=1e-5)
    assert len(paths(ax)) == 1


def _states(episodes):
    return jax.vmap(lambda e: jast.replay(FERRY, e))(episodes).states


@pytest.mark.slow
def test_a_phase_portrait():
    few = played(FERRY, 3)
    ax = drawn(plot.phase(few, FERRY, ("x", "y"), nominal=0))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x", "y")
    states = _states(few)
    for line, x, y in zip(paths(ax), states.x, states.y, strict=True):
        np.testing.assert_allclose(line.get_data(), [x, y], rtol=1e-6)
    assert legend(ax) == ["undisturbed", "3 episodes"]
    given = plt.figure().subplots()
    assert plot.phase(few, FERRY, ("x", "heading"), nominal=5, ax=given, units={"x": "m"}) is given
    assert given.get_xlabel() == "x (m)" and len(paths(given)) == 8
    default = plot.phase(few, FERRY, nominal=0)
    assert (default.get_xlabel(), default.get_ylabel()) == ("x", "y")  # ferry_x is as undisturbed


@pytest.mark.slow
def test_a_black_box_shows_its_disturbances_or_what_it_says():
    """Judged at its end it has no state; an object has a distance at each step."""
    kinds = Joint({"gust": Normal(0.0, 1.0), "bias": Normal(0.0, 1.0)})
    calls = []

    def run(x):
        calls.append(1)
        return False, float(np.abs(x["gust"]).min())

    sim = jast.blackbox.from_python(run, horizon=3, disturbance=kinds)
    e = jast.replay(sim, {"gust": jnp.array([1.0, 2.0, 3.0]), "bias": jnp.arange(3.0)})
    calls.clear()
    bare = e._replace(states=None)
    axes = drawn(plot.traces(bare, sim))
    assert labels(axes) == ["disturbance bias", "disturbance gust"]
    assert len(calls) <= 2  # the undisturbed alone
    np.testing.assert_allclose(paths(axes[1])[0].get_ydata(), [np.nan, 1, 2, 3])
    assert not axes[0].collections

    class Walk:
        def initialize(self):
            self.at = 0.0

        def transition(self, x):
            self.at += float(x)

        def is_event(self):
            return self.at > 9

        def miss_distance(self):
            return 9 - self.at

    sim = jast.blackbox.from_python(Walk, horizon=3, disturbance=Normal(0.0, 1.0))
    [ax] = drawn(plot.traces(jast.replay(sim, jnp.ones(3)), sim))
    assert ax.get_ylabel() == "miss distance"
    np.testing.assert_allclose(paths(ax)[0].get_ydata(), [9, 8, 7, 6])


@pytest.mark.slow
def test_what_traces_and_portraits_refuse():
    few = played(FERRY, 2)
    for draw in (plot.traces, plot.phase):
        name = draw.__name__
        with pytest.raises(ValueError, match=f"plot.{name}: samples must be failures"):
            draw(few.length, FERRY)
        with pytest.raises(ValueError, match=f"plot.{name}: sim must be the jast.Simulator"):
            draw(few)
        with pytest.raises(ValueError, match=f"plot.{name}: fields must be among .*'speed'"):
            draw(few, FERRY, ("x", "speed"))
        with pytest.raises(ValueError, match=f"plot.{name}: nominal must be"):
            draw(few, FERRY, nominal=-1)
        with pytest.raises(ValueError, match=f"plot.{name}: modes must be"):
            draw(few, FERRY, modes=[0.5, 1])
    with pytest.raises(ValueError, match="plot.phase: fields must be two names"):
        plot.phase(few, FERRY, "x")
    with pytest.raises(ValueError, match="plot.traces: axes must be at least 2"):
        plot.traces(few, FERRY, ("x", "y"), nominal=0, axes=plt.figure().subplots())


def test_failures_go_to_their_mode_where_they_end_sooner():
    """Pushes to and fro, a step sooner: as they are they point to the other mode."""
    sim = walk(horizon=12)
    push = np.zeros((3, 12), np.float32)
    push[0, 6:] = [1, -1] * 3
    push[1] = -push[0]
    push[2, :11] = push[0, 1:]
    e = jax.device_get(jax.vmap(lambda x: jast.replay(sim, x))(jnp.asarray(push)))
    e = e._replace(length=np.array([12, 12, 11], np.int32), states=None)
    heads = jax.tree.map(lambda a: a[:2], e)
    assert owners(sim, e, heads).tolist() == [0, 1, 0]
    assert owners(sim, e, jax.tree.map(lambda a: a[:1], e)).tolist() == [0, 0, 0]
