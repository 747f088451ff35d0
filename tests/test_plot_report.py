"""The picture of a report: it says what the page says, and draws its modes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictures import drawn, plt
from reports import EVIL, SIM, estimate, made

import jast
from jast import plot
from jast._src.core.failures import empty
from jast._src.search.refine.modes import Mode, Modes
from jast.distributions import seeds


def said(figure):
    figure.canvas.draw()
    return [text.get_text() for text in figure.texts]


@pytest.mark.slow
def test_a_report_on_one_page(tmp_path):
    figure = plot.report(made(probability=estimate()), nominal=20, units={"speed": "m/s"})
    words = said(figure)
    said_first = "The system fails in 2 ways, in about one of 99,000 runs. The likeliest failure"
    assert f"{said_first} takes 3 steps" in " ".join(words)
    for word in (
        "1e-05",
        "95% interval 8e-06 to 2e-05",
        "reliable: no known reason against it",
        "Mode 1",
        "Mode 2",
        "What was tried",
        EVIL,
        "in all",
    ):
        assert word in words, word
    assert any("share 75 % [70, 81]" in word for word in words)
    assert any("share not known" in word for word in words)
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert len(labels) == 6 and labels.count("disturbance (sd)") == 2
    assert labels.count("speed (m/s)") == 2
    pushes = [ax for ax in figure.axes if ax.get_ylabel() == "disturbance (sd)"]
    np.testing.assert_allclose(pushes[0].lines[0].get_ydata(), np.array([1.1, 0.1, 2.5]) / 0.5)
    # nothing hangs over the page
    box = figure.get_tightbbox().get_points()
    assert (box[0] >= 0).all() and (box[1] <= figure.get_size_inches()).all()
    figure.savefig(tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    plt.close(figure)


@pytest.mark.slow
def test_what_must_not_be_believed_says_so_and_why():
    doubt = estimate(reliable=False, warnings=("18% of what was found costs $5 " + "or so " * 30,))
    figure = plot.report(made(probability=doubt), nominal=0)
    words = said(figure)
    assert "UNRELIABLE: do not believe it" in words
    assert " ".join(words).count("or so") == 30
    assert max(map(len, words)) < 130
    plt.close(figure)
    figure = plot.report(made(probability=doubt._replace(plain=(2, 0, 30_000))), nominal=0)
    words = said(figure)
    assert "between 8.07e-06 and 0.000241" in words and "doubtful" in words
    assert words.index("at 0.95: 2 of 30000 plain draws fail") < words.index("doubtful")
    assert "1e-05" not in words and "not to be believed" in " ".join(filter(None, words))
    # nothing hangs over the facts on the right
    look = figure.canvas.get_renderer()
    [value] = [t for t in figure.texts if t.get_text().startswith("between ")]
    [fact] = [t for t in figure.texts if t.get_text() == "undisturbed"]
    assert value.get_window_extent(look).x1 < fact.get_window_extent(look).x0
    plt.close(figure)


def test_without_its_simulator_a_failure_or_an_estimate():
    bare = plot.report(made(sim=None))
    assert [ax.get_ylabel() for ax in bare.axes] == ["disturbance"] * 2
    assert "not estimated" in said(bare)
    none = plot.report(made(failures=empty(SIM), modes=Modes()))
    assert not none.axes and any("No failure was found in 14" in word for word in said(none))
    many = Modes(list(made().modes) * 3)
    figure = plot.report(made(modes=many), nominal=0)
    assert "Failure modes (4 of 6)" in said(figure) and len(figure.axes) == 12
    with pytest.raises(ValueError, match="plot.report: report must be of jast.stress, received a"):
        plot.report(SIM)
    plt.close("all")


def test_a_system_of_seeds_has_its_disturbances_as_they_are():
    """Without a quantile function there are no standard deviations, and no modes to sort by."""
    sim = jast.Simulator(
        init=lambda x0: jnp.zeros(()),
        step=lambda s, x: s + (x % 6).astype(float),
        disturbance=lambda s: seeds(),
        evaluate=lambda s: (s >= 3, jnp.maximum(3 - s, 0)),
        horizon=4,
    )
    e = jax.device_get(jast.replay(sim, jnp.array([1, 1, 1, 1], jnp.uint32)))
    found = jast.failures.collect(
        sim, jast.rewards.standard(), jax.tree.map(lambda a: np.asarray(a)[None], e)
    )
    quiet = made().nominal._replace(undisturbed=None)
    r = made(nominal=quiet, failures=found, modes=Modes([Mode(found[0], 1, 1.0)]), sim=sim)
    figure = plot.report(r, nominal=5)
    assert [ax.get_ylabel() for ax in figure.axes] == ["state", "miss distance", "disturbance"]
    said(figure)
    plt.close(figure)


def test_names_with_a_dollar_are_no_formula():
    figure = plt.figure()
    ax = figure.subplots()
    few = jax.tree.map(lambda a: np.asarray(a)[None], made().failures[0])
    plot.traces(few, SIM, "speed", nominal=0, units={"speed": "$/$"}, axes=ax)
    drawn(ax)
    plt.close(figure)
