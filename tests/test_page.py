"""Pages: what stands in the file, that nothing of a user's gets out of its place, and that what is
copied from a page replays. In a browser, where one is installed.
"""

import json
import sys
from base64 import b64decode
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import Page, browsed
from reports import EVIL, SIM, estimate, made

import jast
from jast._src.core.failures import empty
from jast._src.page import document, episode_data, report
from jast._src.search.refine.modes import Modes
from jast._src.stress_testing.report_words import advice, share_of_runs, two_digits
from jast.distributions import Normal
from jast.explain import Criticality, Minimal


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    p = np.array([0.1, 0.2, 0.4, 1.0])
    risk = Criticality(p, np.stack([p / 2, np.ones(4)], 1), 0.95, 2, 3, 3, 9, 0, 36)
    least = Minimal(
        {EVIL: np.arange(8) == 2}, (), made().failures[0], ((3, EVIL, 2.5, 5.0),), 3, 70
    )
    told = [[EVIL, risk, None, least]]
    made().html(path, draw=lambda s: f"<svg>{float(s.speed)}|{EVIL}", explanations=told)
    return path.read_text(encoding="utf-8")


def test_advice_fits_a_black_box():
    """Subset simulation takes some ten thousand runs."""
    doubtful = made(probability=estimate(reliable=False, warnings=("few",)))
    box = jast.blackbox.from_python(lambda x: (False, 1.0), horizon=1, disturbance=Normal(0.0, 1.0))
    assert "larger budget, or jast.estimate.subset_simulation, for" in advice(doubtful)
    assert advice(doubtful._replace(sim=box)).endswith("; a larger budget for the probability")


def test_a_page_stands_alone_and_lets_nothing_out(page):
    """Two scripts, both our own; no address; what a user wrote is text."""
    seen = Page(page)
    names = [tag for tag, _ in seen.tags]
    assert names.count("script") == 2
    assert "b" not in names
    assert names.count("article") == 2
    assert names.count("style") == 1
    assert "link" not in names
    assert len(page) < 60_000
    assert not any({"src", "href"} & set(attributes) for _, attributes in seen.tags)
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "")  # the name of a language
    assert page.count("&lt;script&gt;fail()&lt;/script&gt;") >= 3  # explanation, tried, settings
    assert EVIL in seen.data["modes"][0]["pictures"]["fragments"][0]
    assert "75 % [70, 81]" in page and "not known" in page


def test_explanations_are_told_drawn_and_marked(page):
    first, second = Page(page).data["modes"]
    assert first["risk"] == [0.1, 0.2, 0.4, 1.0] and first["interval"][1] == [1.0] * 4
    assert first["needed"] == {EVIL: [3]}
    assert "risk" not in second
    assert "needed" not in second
    assert "1 of 3 disturbances is needed" in page
    assert "it stays at 0.95 or more from step 3" in page


def test_traces_have_the_fields_and_numbers_of_the_system(page):
    mode = Page(page).data["modes"][1]
    states = {group["name"]: group for group in mode["states"]}
    assert list(states) == ["position", "speed"] and states["position"]["entries"] == ["[0]", "[1]"]
    speed = made().failures[1].disturbances[EVIL][:2].cumsum() + 1
    assert states["speed"]["columns"][0] == pytest.approx([1, *speed], rel=1e-5)
    assert mode["steps"] == [0, 1, 2] and mode["length"] == 2
    assert mode["quiet"][1] == [[1.0, 1.0, 1.0]] and mode["distance"][-1] == 0
    assert mode["x"][0]["name"] == EVIL and mode["x"][0]["columns"][0][0] == "NaN"
    assert mode["pictures"]["at"] == [0, 1, 2] and len(mode["pictures"]["fragments"]) == 3


def test_the_headline_says_how_it_fails(page):
    """And how many times less likely its disturbances are than the likeliest ones."""
    best = made().failures.best
    rare = float(f"{np.exp(-float(best.reward)):.2g}")
    assert f"disturbances that are {rare:,.0f} times less likely than the likeliest ones" in page
    end = 1 + best.disturbances[EVIL].sum()
    assert f"speed is {end:.4g} (undisturbed 1)" in page


@pytest.mark.parametrize(
    "log10, words",
    [(0.18, "1.5"), (1, "10"), (4.687, "49,000"), (8.999, "1,000,000,000"), (12.6, "10^13")],
)
def test_large_numbers_are_read_at_a_glance(log10, words):
    assert two_digits(log10) == words


def test_a_share_of_the_runs():
    assert share_of_runs(np.log10(0.25)) == "25 % of the runs"
    assert share_of_runs(-2) == "one of 100 runs"


def test_what_is_copied_replays_to_the_bit(page, tmp_path, monkeypatch, capsys):
    (tmp_path / "failure-1.json").write_text(Page(page).data["modes"][0]["exact"])
    monkeypatch.chdir(tmp_path)
    room = {"sim": SIM}
    exec(report.SNIPPET, room)
    episode, best = room["episode"], made().failures[0]
    assert episode.failure and int(episode.length) == int(best.length)
    assert np.asarray(episode.disturbances[EVIL]).tobytes() == best.disturbances[EVIL].tobytes()
    assert capsys.readouterr().out.startswith("True")
    met = []
    mine = SimpleNamespace(step=lambda **x: met.append(x[EVIL]))
    exec(report.OWN, {"mine": mine})
    assert np.stack(met).tobytes() == best.disturbances[EVIL][: int(best.length)].tobytes()
    assert max(len(code.splitlines()) for code in (report.SNIPPET, report.OWN)) <= 10


def test_what_is_no_failure_of_the_system_is_refused(page, tmp_path):
    path = tmp_path / "failure-1.json"
    path.write_text(Page(page).data["modes"][0]["exact"])
    with pytest.raises(
        ValueError, match="from_json: sim must be the simulator of the failure, whose"
    ):
        jast.failures.from_json(path, jast.simulators.walk1d())
    for words in ("3", "{}", "no json"):
        path.write_text(words)
        with pytest.raises(ValueError, match="from_json: path must be a file from the page"):
            jast.failures.from_json(path, SIM)


def test_numbers_that_json_does_not_have():
    values = dict(
        a=np.array([np.nan, -np.inf, -0.0, 0.1], np.float32), b=[np.inf], c=np.int64(2**60)
    )
    back = json.loads(document.embedded(values))
    assert back["a"][:2] == ["NaN", "-Infinity"] and back["b"] == ["Infinity"]
    assert np.array(back["a"], np.float32).tobytes() == values["a"].tobytes()
    assert back["c"] == 2**60


@pytest.mark.parametrize("steps, width", [(50_000, 3), (3, 5000)])
def test_long_and_wide_episodes_are_thinned(steps, width):
    x = np.random.default_rng(0).normal(size=(steps, width))
    e = jast.Episode((), x, 0.0, 0.0, True, steps, 0.0)
    found = episode_data.trace(None, e, None, 1000)
    shown = found["x"][0]
    assert sum(map(len, shown["columns"])) <= 1000 and found["steps"][-1] == steps
    assert len(shown["columns"]) == min(width, 24) and shown["more"] == max(0, width - 24)
    for t, v in zip(found["steps"][1:], shown["columns"][0][1:], strict=True):
        assert v == pytest.approx(x[t - 1, 0], rel=1e-5)


def test_keys_are_no_numbers_and_x0_is_shown():
    """A state may hold random keys; what chose the start stands there, too."""
    sim = jast.Simulator(
        init=lambda x0: {"key": jax.random.key(0), "at": x0},
        step=lambda s, x: s | {"at": s["at"] + x},
        disturbance=lambda s: Normal(0.0, 1.0),
        evaluate=lambda s: (s["at"] > 2, jnp.maximum(2 - s["at"], 0)),
        start=lambda: Normal(0.0, 1.0),
        horizon=2,
    )
    e = jast.replay(sim, jnp.ones(2), jnp.asarray(0.25))
    found = episode_data.trace(sim, e, None, 1000)
    assert [group["name"] for group in found["states"]] == ["at"]
    assert found["states"][0]["columns"] == [[0.25, 1.25, 2.25]]
    assert found["x0"][0]["name"] == "x0" and found["x0"][0]["columns"] == [[0.25]]
    assert found["distance"] == [1.75, 0.75, 0.0]


def test_pictures_keep_to_their_room():
    states, steps = np.arange(40), list(range(0, 40, 2))
    found = episode_data.pictures("html", lambda s: "x" * int(s), states, steps, 200)
    assert sum(map(len, found["fragments"])) <= 200 and len(found["at"]) == len(steps)
    assert len(found["fragments"]) > 3 and len(found["fragments"][-1]) == steps[-1]
    assert found["at"] == sorted(found["at"])
    for draw, match in (
        (lambda s: 3, "must return a str.*int"),
        (lambda s: "x" * 999, "up to 200"),
    ):
        with pytest.raises(ValueError, match=match):
            episode_data.pictures("html", draw, states, steps, 200)


def test_a_picture_may_have_a_trail():
    states, steps = np.arange(6), list(range(6))
    draw = lambda s, past=None: f"{past.tolist()} {s}"
    found = episode_data.pictures("html", draw, states, steps, 999)["fragments"]
    assert found[0] == "[] 0" and found[3] == "[0, 1, 2] 3"


def test_a_report_from_a_file_has_a_page(tmp_path):
    """Without its simulator there are no states; with it all is as before."""
    whole = made(nominal=made().nominal._replace(undisturbed=None))
    jast.save(tmp_path / "r.npz", whole)
    bare = jast.load(tmp_path / "r.npz")
    assert bare.sim is None and jast.load(tmp_path / "r.npz", SIM).sim is SIM
    bare.html(tmp_path / "bare.html")
    words = (tmp_path / "bare.html").read_text()
    assert "has no states" in words and "states" not in Page(words).data["modes"][0]
    bare.html(tmp_path / "given.html", SIM)
    assert "states" in Page((tmp_path / "given.html").read_text()).data["modes"][0]
    with pytest.raises(ValueError, match="Report.html: draw needs the simulator"):
        bare.html(tmp_path / "no.html", draw=str)
    with pytest.raises(ValueError, match="Report.html: explanations must be at most 2"):
        bare.html(tmp_path / "no.html", explanations=["a"] * 3)
    assert not (tmp_path / "no.html").exists()


def test_the_verdict_says_whether_to_believe_it(tmp_path):
    p = estimate(warnings=(EVIL,))
    blank = p._replace(log_mean=np.nan, reliable=False, relative_error=np.nan, interval=(0, 0.003))
    quiet = made().nominal.undisturbed._replace(failure=np.True_)
    none = made(failures=empty(SIM), modes=Modes())
    cases = {
        "No failure was found in 14": none,
        "fails without any disturbance": made(nominal=made().nominal._replace(undisturbed=quiet)),
        "<p>not estimated</p>": made(),
        "1e-05</p><p>95% interval 8e-06 to 2e-05</p><p class='badge good'>reliable": made(
            probability=p
        ),
        "below 0.02 at 95%: failures that nothing led to": made(probability=p),
        "fails in 2 ways, in about one of 99,000 runs": made(probability=p),
        "fails in 2 ways, in at most one of 100 runs": made(
            probability=p._replace(reliable=False, plain=(0, 0, 367))
        ),
        "UNRELIABLE: do not believe it<ul><li>&lt;/script": made(
            probability=p._replace(reliable=False)
        ),
        "below 0.003</p><p>no failure in 99 draws": none._replace(probability=blank),
        "value'>between 0 and 3.69e-06</p><p>at 0.95: 0 of 1000000 plain draws fail</p><div": made(
            probability=p._replace(reliable=False, plain=(0, 0, 1_000_000))
        ),
        "<dt>doubtful</dt><dd>1e-05, 95% interval 8e-06 to 2e-05, not to be believed</dd>": made(
            probability=p._replace(reliable=False, plain=(0, 0, 1_000_000))
        ),
        "value'>between 0 and 0.0366</p><p>at 0.95: 0 of 99 plain": none._replace(
            probability=blank._replace(plain=(0, 0, 99))
        ),
    }
    for words, case in cases.items():
        case.html(tmp_path / "r.html")
        assert words in (tmp_path / "r.html").read_text(), words


def test_the_slider_moves_in_a_browser(page, tmp_path):
    check = """
      const card = document.querySelector("#mode-1"), slider = card.querySelector(".slider");
      const look = () => ({
        step: card.querySelector(".step").textContent,
        speed: [...card.querySelectorAll(".numbers tr")].filter(
          (row) => row.cells[0].textContent === "speed").map((row) => row.cells[1].textContent)[0],
        picture: card.querySelector(".picture").shadowRoot.textContent,
        cursor: card.querySelector(".cursor").getAttribute("x1"),
      });
      found.last = look();
      slider.value = 1;
      slider.dispatchEvent(new Event("input"));
      found.first = look();
      found.needed = card.querySelectorAll(".needed").length;
      found.panels = card.querySelectorAll(".traces svg").length;
      found.json = JSON.parse(card.querySelector(".json").textContent).length;
      card.querySelector(".play").click();
      found.play = card.querySelector(".play").textContent;
    """
    found = browsed(page, check, tmp_path)
    assert "error" not in found, found
    assert found["last"]["step"] == "3 of 3" and found["first"]["step"] == "1 of 3"
    assert float(found["first"]["speed"]) == pytest.approx(2.1, rel=1e-5)
    assert float(found["first"]["picture"].split("|")[0]) == pytest.approx(2.1, rel=1e-5)
    assert found["first"]["cursor"] != found["last"]["cursor"]
    assert found["panels"] == 5
    assert found["needed"] == 1
    assert found["json"] == 3
    assert found["play"] == "Stop"


@pytest.mark.slow
def test_a_report_in_a_cell_of_a_notebook(monkeypatch):
    """Words are text, each mode has a small picture; without matplotlib there are the words."""
    pytest.importorskip("matplotlib", reason="needs the extra `plot`")
    whole = made()._repr_html_()
    seen = Page(whole)
    names = [tag for tag, _ in seen.tags]
    assert names.count("img") == 2
    assert "script" not in names
    assert len(whole) < 60_000
    assert "The system fails in 2 ways" in whole
    assert "75 % [70, 81]" in whole
    assert "not estimated" in whole
    for _, attributes in [t for t in seen.tags if t[0] == "img"]:
        png = b64decode(attributes["src"].removeprefix("data:image/png;base64,"))
        assert png.startswith(b"\x89PNG") and len(png) < 20_000
    doubt = estimate(reliable=False, warnings=(EVIL,), unseen=None)
    doubtful = made(probability=doubt)._repr_html_()
    assert "UNRELIABLE" in doubtful
    assert "&lt;script&gt;fail()" in doubtful
    assert EVIL not in doubtful
    none = made(failures=empty(SIM), modes=Modes())._repr_html_()
    assert "No failure was found in 14" in none and "<img" not in none
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    words = made()._repr_html_()
    assert "<img" not in words
    assert "Mode 2" in words
    assert "75 % [70, 81]" in words
