"""to_dataframe and to_xarray: pandas, xarray and arviz have the numbers that the results have."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jast
from jast import failures as F
from jast.distributions import Independent, Joint, Normal

SIM = jast.Simulator(
    init=lambda x0: {"at": x0, "turns": jnp.zeros((), jnp.int32)},
    step=lambda s, x: {"at": s["at"] + x["gust"].sum() - x["pull"], "turns": s["turns"] + 1},
    disturbance=lambda s: Joint(
        {"gust": Independent(Normal(jnp.zeros(2), 1.0), 1), "pull": Normal(0.0, 0.5)}
    ),
    evaluate=lambda s: (s["at"] >= 4, jnp.maximum(4 - s["at"], 0)),
    start=lambda: Normal(0.0, 1.0),
    horizon=6,
)


@pytest.fixture(scope="module")
def found():
    return jast.search.monte_carlo(
        jax.random.key(0), SIM, episodes=600, refine=0, top=5, record=True
    )


@pytest.mark.slow
def test_failures_row_by_row(found):
    pytest.importorskip("pandas")
    table = found.failures.to_dataframe()
    assert table.index.name == "failure" and table.index.tolist() == [1, 2, 3, 4, 5]
    for i, e in enumerate(found.failures, 1):
        row = table.loc[i]
        assert row["log_prob"] == e.log_prob and row["length"] == e.length
    assert table["counts"].tolist() == found.failures.counts.tolist()


@pytest.mark.slow
def test_failures_step_by_step_are_what_the_file_has(found, tmp_path):
    pandas = pytest.importorskip("pandas")
    table = found.failures.to_dataframe(steps=True)
    assert table.index.names == ["failure", "step"]
    assert list(table.columns) == ["x0", "x.gust[0]", "x.gust[1]", "x.pull"]
    third = table.loc[3]
    assert len(third) == 1 + int(found.failures[2].length)
    assert third["x0"].isna().tolist() == [False] + [True] * (len(third) - 1)
    np.testing.assert_array_equal(
        third["x.gust[1]"].to_numpy()[1:],
        found.failures[2].disturbances["gust"][: len(third) - 1, 1],
    )
    F.to_csv(tmp_path / "failures.csv", found.failures)
    read = pandas.read_csv(tmp_path / "failures.csv", index_col=["failure", "step"])
    pandas.testing.assert_frame_equal(read, table, check_exact=True)


@pytest.mark.slow
def test_modes_trials_and_sweeps(found):
    pytest.importorskip("pandas")
    ways = jast.search.modes(
        SIM, jast.search.refine(jax.random.key(1), SIM, found.failures).failures
    )
    table = ways.to_dataframe()
    assert table.index.tolist() == list(range(1, len(ways) + 1))
    assert table["members"].tolist() == [m.members for m in ways]
    assert table["log_prob_from_mode"].iloc[0] == ways[0].failure.reward
    assert table["share_low"].isna().all()

    trials = found.trials.to_dataframe()
    assert trials.index.names == ["tree", "episode"]
    assert trials["failure"].sum() == found.failing and len(trials) == found.trials.ran.size
    tree, episode = trials.index[-7]
    assert trials["distance"].iloc[-7] == found.trials.distance[episode, tree]

    make = lambda threshold: jast.simulators.walk1d(threshold=threshold)
    values = {"threshold": [8.0, 12.0, -1.0]}
    swept = jast.sweep(jax.random.key(0), make, values, jast.nominal, episodes=500)
    table = swept.to_dataframe()
    assert table["threshold"].tolist() == values["threshold"] and table.index.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(table["probability"], swept.probability)
    np.testing.assert_array_equal(table[["interval_low", "interval_high"]], swept.interval)
    assert table["episodes"].tolist() == [getattr(r, "episodes", 0) for r in swept.results]
    assert table["error"].fillna("").tolist() == ["", "", swept.errors[2]]
    assert table["best_log_prob"].isna().all()


def test_a_setting_may_have_the_name_of_an_answer():
    pytest.importorskip("pandas")
    make = lambda probability: jast.simulators.walk1d(threshold=probability)
    swept = jast.sweep(
        jax.random.key(0), make, {"probability": [8.0]}, jast.search.monte_carlo, episodes=100
    )
    table = swept.to_dataframe()
    assert table["probability"].to_numpy()[0, 0] == 8.0 and table.shape == (1, 8)
    assert table["best_log_prob"][0] == swept.results[0].best.log_prob


@pytest.mark.parametrize("batch", [False, True])
def test_replayed_episodes(found, batch):
    pytest.importorskip("xarray")
    given = found.failures.episodes if batch else found.failures[1]
    e = jax.vmap(lambda e: jast.replay(SIM, e))(given) if batch else jast.replay(SIM, given)
    data = e.to_xarray()
    n, at, length = (5, 1, int(found.failures[1].length)) if batch else (1, 0, int(e.length))
    assert dict(data.sizes) == {"chain": 1, "draw": n, "step": 7, "x.gust_place": 2}
    assert data["x.gust"].dims == ("chain", "draw", "step", "x.gust_place")
    assert data["state.at"].dims == ("chain", "draw", "step")
    one = data.isel(chain=0, draw=at)
    rows = found.failures[1].disturbances
    np.testing.assert_array_equal(one["x.pull"][1 : length + 1], rows["pull"][:length])
    np.testing.assert_array_equal(one["x.gust"][1 : length + 1], rows["gust"][:length])
    assert one["x0"] == found.failures[1].x0 == one["state.at"][0]
    assert np.isnan(one["x.pull"][0]) and np.isnan(one["x.pull"][length + 1 :]).all()
    assert one["state.turns"][: length + 1].to_numpy().tolist() == list(range(length + 1))
    assert np.isnan(one["state.turns"][length + 1 :]).all() and bool(one["failure"])
    assert one["log_prob"] == found.failures[1].log_prob and one["length"] == length


def test_what_has_more_axes_is_refused(found):
    pytest.importorskip("xarray")
    e = jax.tree.map(lambda a: np.asarray(a)[None], found.failures.episodes)
    with pytest.raises(ValueError, match=r"to_xarray: expected one episode or .* \(1, 5\)"):
        e.to_xarray()


@pytest.mark.slow
def test_arviz_reads_samples_of_failures(key):
    """Its mean of the sum of a walk that fails above 3.5 of its standard deviations is that of a
    truncated normal number; its effective size sees that copies which never move are neighbours.
    """
    arviz = pytest.importorskip("arviz")
    sim = jast.simulators.limit_state(lambda x: 3.5 - x.sum() / 2, 4)
    estimate = jast.estimate.failure_probability(key, sim, 20_000)
    drawn = jast.estimate.failure_samples(key, sim, estimate, 400)
    data = drawn.to_xarray()
    assert data.attrs["ess"] == drawn.ess and "states" not in data
    data = data.sel(step=1)
    data["sum"] = data["x"].sum("x_place") / 2
    table = arviz.summary(data[["sum", "x"]], round_to="none")
    hazard = 0.0008726826950457602 / 0.00023262907903552504  # phi(3.5) / Phi(-3.5)
    mean, error = table.loc["sum", "mean"], table.loc["sum", "sd"] / 20
    assert abs(mean - hazard) < 5 * error * np.sqrt(400 / table.loc["sum", "ess_bulk"])
    assert list(table.index) == ["sum", *(f"x[[{i}]]" for i in range(4))]
    still = jast.estimate.failure_samples(key, sim, estimate, 4000, moves=0)
    few = still.to_xarray().sel(step=1)["x"].isel(x_place=0).to_dataset(name="x")
    assert float(arviz.ess(few)["x"]) < 2 * still.distinct + 400


@pytest.mark.parametrize("library", ["pandas", "xarray"])
def test_without_the_library(found, library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf"needs {library}: pip install 'jast\[tables\]'"):
        found.failures.to_dataframe() if library == "pandas" else found.best.to_xarray()
