"""Pictures of one state: small SVG that a browser can read, with what moves where it is."""

from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import browsed

import jast
from jast import simulators
from jast._src.simulators.svg import BLUE, VERMILION, Plane


def states(sim, key=0):
    e = jast.rollout(jax.random.key(key), sim)
    return [jax.tree.map(lambda a, t=t: np.asarray(a)[t], e.states) for t in (0, int(e.length))]


def shapes(picture):
    """Fill -> corners of each polygon, after the whole was read as XML."""
    found = {}
    for part in ElementTree.fromstring(picture).iter("{http://www.w3.org/2000/svg}polygon"):
        corners = [[float(v) for v in p.split(",")] for p in part.get("points").split()]
        found[part.get("fill")] = np.array(corners)
    return found


def test_a_plane_has_y_up():
    plane = Plane((-10.0, 0.0), (10.0, 5.0), 200)
    assert 'points="0.0,50.0 200.0,0.0"' in plane.line([(-10, 0), (10, 5)], BLUE)
    assert 'viewBox="0 0 200 50"' in plane.picture()
    assert "a &lt; b" in plane.words((0, 0), "a < b", BLUE)


def test_both_vessels_of_the_ferry_are_where_they_are():
    sim = simulators.ferry()
    for state in states(sim):
        found = shapes(simulators.draw(state))
        scale = 360 / 136
        for fill, x, y in (
            (BLUE, state.ferry_x, state.ferry_y),
            (VERMILION, state.x, state.y),
        ):
            # the third corner is the stern's: the bow is opposite
            bow, stern = found[fill][0], found[fill][2:4].mean(axis=0)
            middle = (bow + stern) / 2
            np.testing.assert_allclose(middle, [(x + 22) * scale, (112 - y) * scale], atol=0.2)
    first = simulators.draw(states(sim)[0])
    assert "distance 52.50" in first and len(first) < 2000


@pytest.mark.parametrize("name", ["colav", "pendulum"])
def test_others_are_drawn(name):
    for state in states(getattr(simulators, name)()):
        picture = simulators.draw(state)
        assert ElementTree.fromstring(picture).tag.endswith("svg") and len(picture) < 2000


def test_what_has_no_picture_is_refused():
    with pytest.raises(ValueError, match="draw: state must be one of .*FerryState.*received a"):
        simulators.draw(jnp.zeros(2))


def test_a_browser_shows_it(tmp_path):
    first, last = (simulators.draw(s) for s in states(simulators.ferry()))
    check = """
      const boxes = [...document.querySelectorAll("polygon")].map((p) => p.getBBox());
      found.count = boxes.length;
      found.inside = boxes.every((b) => b.x > -1 && b.y > -1 && b.width > 5);
    """
    found = browsed(f"<html><body>{first}{last}</body></html>", check, tmp_path)
    assert found == {"count": 4, "inside": True}


@pytest.mark.parametrize("name, places", [("ferry", 2), ("colav", 2), ("pendulum", 1)])
def test_what_moves_has_a_trail(name, places):
    """From where it was first to where it is, through at most 60 places between."""
    sim = getattr(simulators, name)()
    e = jax.device_get(jast.rollout(jax.random.key(0), sim))
    part = lambda rows: jax.tree.map(lambda a: a[rows], e.states)
    last = int(e.length)
    first, bare = simulators.draw(part(0), past=part(slice(0))), simulators.draw(part(last))
    drawn = ElementTree.fromstring(simulators.draw(part(last), past=part(slice(last))))
    trails = [
        [place.split(",") for place in line.get("points").split()]
        for line in drawn.iter("{http://www.w3.org/2000/svg}polyline")
        if line.get("stroke-opacity") == "0.5"
    ]
    assert len(trails) == places and "stroke-opacity" not in bare
    for trail in trails:
        assert 2 < len(trail) <= 61
        assert f'points="{",".join(trail[0])}"' in first  # there it has come no way yet
