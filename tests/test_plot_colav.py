"""Pictures of encounters: that each shows what the states say, at the moments and times that it
names, and refuses what it cannot draw.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import animation as mpl_animation
from pictures import drawn, matplotlib, plt

import jast
from jast import plot
from jast._src.plot.colav_log import zone_outline
from jast._src.simulators.colav import planner
from jast._src.simulators.colav.tracker import PERIOD
from jast.simulators.colav import SCENARIOS, colav

SIM = colav("sharp turn")
EPISODE = jast.replay(SIM, jnp.linspace(0.1, 0.6, 25))
N = int(EPISODE.length)
NEAREST = int(np.argmin(EPISODE.states.near[: N + 1]))
KINDS = ("delay", "steering", "noise")
SHORT = jast.replay(SIM, jnp.linspace(0.1, 0.3, 4))


@pytest.fixture(scope="module")
def three():
    """A simulator with every kind of disturbance and an episode of it."""
    sim = colav("crossing", KINDS)
    return sim, jast.rollout(jax.random.key(1), sim)


def labelled(ax):
    """The lines and shapes of a panel by their words in the legend."""
    return {
        artist.get_label(): artist
        for artist in (*ax.lines, *ax.patches)
        if not (artist.get_label() or "_").startswith("_")
    }


def ways(episode, t):
    """[steps, 2] (east, north) of the ferry, the adversary and the track up to step ``t``."""
    s = jax.tree.map(lambda a: np.asarray(a)[: t + 1], episode.states)
    return [np.stack([p.e, p.n], -1) for p in (s.pose, s.adversary.pose, s.track)]


def at(episode, t):
    return jax.tree.map(lambda a: np.asarray(a)[t], episode.states)


def test_a_panel_shows_the_ways_up_to_its_moment():
    moments = [0, 7, N]
    axes = drawn(plot.colav(EPISODE, moments=moments))
    assert len(axes) == 3
    for ax, t in zip(axes, moments, strict=True):
        shown = labelled(ax)
        for name, way in zip(
            ("ferry", "adversary (a dot a step)", "adversary as believed"),
            ways(EPISODE, t),
            strict=True,
        ):
            np.testing.assert_allclose(shown[name].get_xydata(), way, rtol=1e-6)
        _, true, believed = (way[-1] for way in ways(EPISODE, t))
        np.testing.assert_allclose(
            shown["from belief to truth"].get_xydata(), np.stack([true, believed]), rtol=1e-6
        )
        np.testing.assert_array_equal(shown["the ferry's route"].get_xydata(), [[0, 0], [0, 100]])
        assert shown["adversary as believed"].is_dashed() and ax.get_aspect() == 1


def test_the_zones_are_those_of_the_believed_adversary():
    [ax] = plot.colav(EPISODE, moments=[12])
    track = at(EPISODE, 12).track
    course = np.arctan2(track.v_e, track.v_n)
    for zone in planner.ZONES:
        edge = labelled(ax)[zone.name].get_xy()
        np.testing.assert_allclose(
            edge[:200], zone_outline(zone, track.n, track.e, course), atol=1e-4
        )
        ahead = (edge - [track.e, track.n]) @ [np.sin(course), np.cos(course)]
        right = (edge - [track.e, track.n]) @ [np.cos(course), -np.sin(course)]
        np.testing.assert_allclose(
            [ahead.max(), right.max(), -ahead.min(), -right.min()],
            [zone.forward, zone.starboard, zone.aft, zone.port],
            rtol=1e-3,
        )
    looks = {(p.get_linestyle(), p.get_facecolor()) for p in ax.patches[:3]}
    # told apart without colour too
    assert len(looks) == 3 and len({line for line, _ in looks}) == 3


def test_the_zones_of_a_track_at_rest_point_north():
    still = SCENARIOS["crossing"]._replace(route=np.zeros((3, 3)))
    episode = jast.replay(colav(still), jnp.zeros(3))
    [ax] = plot.colav(episode, moments=[3])
    np.testing.assert_allclose(
        labelled(ax)["region of collision"].get_xy()[0],
        [50, 20 + planner.ZONES[0].forward],
        atol=1e-4,
    )


def test_ships_point_where_they_head():
    [ax] = plot.colav(EPISODE, moments=[9])
    s = at(EPISODE, 9)
    headings = (s.pose.psi, s.adversary.pose.psi, np.arctan2(s.track.v_e, s.track.v_n))
    for hull, way, psi in zip(ax.patches[3:], ways(EPISODE, 9), headings, strict=True):
        np.testing.assert_allclose(
            hull.get_xy()[0], way[-1] + 4 * np.array([np.sin(psi), np.cos(psi)]), atol=1e-4
        )  # the bow, of 8 m
        assert np.ptp(hull.get_xy(), 0).max() < 9
    assert ax.patches[5].get_facecolor()[3] == 0  # what is only believed is hollow


def test_moments():
    def times(axes):
        return [ax.get_title(loc="left").split(" s,")[0] for ax in axes]

    expected = [f"t = {3 * round(NEAREST * share):g}" for share in (1 / 3, 2 / 3, 1)]
    assert times(plot.colav(EPISODE)) == expected
    assert times(plot.colav(EPISODE, moments=1)) == expected[2:]
    assert times(plot.colav(EPISODE, moments=np.array([3, 1]))) == ["t = 9", "t = 3"]
    assert len(plot.colav(SHORT, moments=9)) == 5  # an episode of 4 steps has no more
    # closest at the start: it is shown as it went on
    soon = EPISODE._replace(states=EPISODE.states._replace(near=jnp.arange(26.0)))
    assert times(plot.colav(soon)) == ["t = 24", "t = 51", "t = 75"]


def test_titles_tell_the_orders_and_the_outcome():
    axes = plot.colav(EPISODE, moments=[*range(N + 1)])
    orders = planner.SPEEDS[np.asarray(EPISODE.states.choice)]
    assert len(set(orders[1:].round(2))) > 2
    for t, ax in enumerate(axes):  # what is ordered on a picture is in force in the next step
        assert ax.get_title(loc="left") == f"t = {3 * t} s, ordered {orders[min(t + 1, N)]:.2f} m/s"
    title = axes[0].figure.get_suptitle()
    assert "no failure, steps: 25" in title
    assert f"log p {float(EPISODE.log_prob):.3f}" in title
    assert "reward" in title
    assert f"closest approach {float(EPISODE.distance):.2f} m by t = {3 * NEAREST} s" in title
    assert (
        "failure at step 25"
        in plot.colav(EPISODE._replace(failure=jnp.array(True)))[0].figure.get_suptitle()
    )


def test_all_panels_have_the_same_limits_that_hold_the_ways():
    axes = drawn(plot.colav(EPISODE, moments=(4, N)))
    assert axes[0].get_xlim() == axes[1].get_xlim() and axes[0].get_ylim() == axes[1].get_ylim()
    points = np.concatenate(ways(EPISODE, N))
    (left, right), (bottom, top) = axes[0].get_xlim(), axes[0].get_ylim()
    assert (points > [left, bottom]).all() and (points < [right, top]).all()


def test_the_legend_stands_beside_the_panels():
    axes = drawn(plot.colav(EPISODE))
    legend = axes[-1].get_legend()
    assert {t.get_text() for t in legend.get_texts()} == set(labelled(axes[-1]))
    assert len(legend.get_texts()) == 8
    assert legend.get_window_extent().x0 >= axes[-1].get_window_extent().x1


def test_given_axes_are_drawn_into():
    given = plt.figure(layout="constrained", figsize=(14, 5)).subplots(1, 4)
    axes = drawn(plot.colav(EPISODE, moments=3, axes=given))
    assert all(a is b for a, b in zip(axes, given[:3], strict=True)) and not given[3].lines
    given = plt.figure(layout="constrained").subplots(3)
    axes = drawn(plot.colav_story(EPISODE, axes=given))
    assert all(a is b for a, b in zip(axes, given, strict=True))
    assert {ax.get_xlim() for ax in axes} == {(0, 75)}
    for draw in (plot.colav, plot.colav_story):
        with pytest.raises(
            ValueError,
            match=f"plot.{draw.__name__}: axes must be at least 3, one for each .*, received 1",
        ):
            draw(EPISODE, axes=given[0])


def test_an_archived_episode_is_replayed():
    bare = jax.device_get(EPISODE._replace(states=None))
    for draw, axes in (
        (plot.colav, plot.colav(EPISODE)),
        (plot.colav_story, plot.colav_story(EPISODE)),
    ):
        for ax, same in zip(axes, draw(bare, SIM), strict=True):
            for a, b in zip(ax.lines, same.lines, strict=True):
                np.testing.assert_array_equal(a.get_xydata(), b.get_xydata())


def test_an_episode_that_fails_at_the_start_is_drawn():
    here = SCENARIOS["crossing"]._replace(adversary=(10.5, 0.0, 0.0))
    episode = jast.replay(colav(here), jnp.zeros(0))
    assert bool(episode.failure) and int(episode.length) == 0
    [ax] = drawn(plot.colav(episode))
    assert ax.get_title(loc="left").startswith("t = 0 s")
    drawn(plot.colav_story(episode))
    assert plot.colav_animation(episode).to_jshtml().count("data:image/png") == 1


def test_the_story_in_time():
    delay, apart, speed = drawn(plot.colav_story(EPISODE, SIM))
    s = jax.tree.map(lambda a: np.asarray(a)[: N + 1], EPISODE.states)
    values, edges, _ = delay.patches[0].get_data()
    np.testing.assert_allclose(values, 40 * np.linspace(0.1, 0.6, 25), rtol=1e-6)
    np.testing.assert_array_equal(edges, PERIOD * np.arange(N + 1))
    assert delay.get_ylabel() == "delay (s)" and "closest approach" in delay.get_title(loc="left")
    ferry, true, believed = ways(EPISODE, N)
    for line, way in zip(apart.lines, (true, believed), strict=False):
        np.testing.assert_array_equal(line.get_xdata(), edges)
        np.testing.assert_allclose(line.get_ydata(), np.linalg.norm(ferry - way, axis=1), rtol=1e-5)
    assert set(apart.lines[2].get_ydata()) == {1.0}
    np.testing.assert_allclose(speed.patches[0].get_data()[0], planner.SPEEDS[s.choice[1:]])
    np.testing.assert_allclose(speed.lines[0].get_ydata(), s.velocity.u)


@pytest.mark.slow
def test_the_story_tells_the_kinds_of_disturbance(three):
    sim, episode = three
    x = {kind: np.asarray(a, float) for kind, a in episode.disturbances.items()}
    axes = drawn(plot.colav_story(episode, sim))
    assert [ax.get_ylabel() for ax in axes] == [
        "delay (s)",
        "steering (rad/s)",
        "size of noise",
        "distance (m)",
        "speed (m/s)",
    ]
    shown = [patch.get_data()[0] for ax in axes[:3] for patch in ax.patches]

    def size(a):
        return np.linalg.norm(a, axis=1)

    for values, expected in zip(
        shown,
        (40 * x["delay"], x["steering"] - 0.5, size(x["noise"][:, :2]), size(x["noise"][:, 2:])),
        strict=True,
    ):
        np.testing.assert_allclose(values, expected[: int(episode.length)], rtol=1e-5)
    assert [t.get_text() for t in axes[2].get_legend().get_texts()] == [
        "position (m)",
        "velocity (m/s)",
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "x", "label"),
    [
        ("delay", 0.5, "delay (share)"),
        ("steering", 0.5, "steering (rad/s)"),
        ("steering", 0.0, "steering (rad/s)"),
        ("noise", [0.1] * 4, "size of noise"),
    ],
)
def test_the_story_tells_a_single_kind_by_itself(kind, x, label):
    episode = jast.replay(colav("sharp turn", kind), jnp.tile(jnp.array(x), (2, *[1] * np.ndim(x))))
    assert plot.colav_story(episode)[0].get_ylabel() == label


def test_the_story_takes_the_longest_delay_of_the_simulator():
    [delay, *_] = plot.colav_story(EPISODE, colav(longest_delay=10.0))
    np.testing.assert_allclose(delay.patches[0].get_data()[0], np.linspace(1, 6, 25), rtol=1e-6)
    # it cannot say
    assert plot.colav_story(EPISODE, jast.simulators.walk1d())[0].get_ylabel() == "delay (share)"


@pytest.mark.slow
def test_animation_goes_from_the_first_state_to_the_last():
    animation = plot.colav_animation(SHORT, smooth=2)
    assert not plt.get_fignums()  # or a notebook would show its figure too
    [ax] = animation._fig.axes
    frames = list(animation.new_frame_seq())
    np.testing.assert_array_equal(frames, np.arange(9) / 2)

    def believed():
        return labelled(ax)["adversary as believed"].get_xydata()

    for t in (0, 2, 4):
        animation._func(frames[2 * t])
        np.testing.assert_allclose(believed(), ways(SHORT, t)[2], rtol=1e-6)
        [still] = plot.colav(SHORT, moments=[t])
        for moving, standing in zip(
            (*ax.lines, *ax.patches), (*still.lines, *still.patches), strict=True
        ):

            def get(artist):
                return artist.get_xydata() if hasattr(artist, "get_xydata") else artist.get_xy()

            np.testing.assert_array_equal(get(moving), get(standing))
        assert ax.get_title(loc="left") == still.get_title(loc="left")
    animation._func(1.5)
    path = ways(SHORT, 2)[2]
    np.testing.assert_allclose(believed(), [path[0], path[1], (path[1] + path[2]) / 2], rtol=1e-6)
    position = ax.get_position().bounds
    html = animation.to_jshtml()
    assert html.count("data:image/png") == 9 and len(html) < 9 * 25_000 + 50_000
    assert ax.get_position().bounds == position  # it does not tremble


@pytest.mark.slow
def test_headings_turn_the_short_way():
    states = SHORT.states._replace(
        adversary=SHORT.states.adversary._replace(
            pose=SHORT.states.adversary.pose._replace(psi=jnp.array([3.1, -3.1, 3.1] + [3.1] * 23))
        )
    )
    animation = plot.colav_animation(SHORT._replace(states=states), smooth=2)
    animation._func(0.5)
    bow, centre = (
        animation._fig.axes[0].patches[4].get_xy()[0],
        labelled(animation._fig.axes[0])["adversary (a dot a step)"].get_xydata()[-1],
    )
    np.testing.assert_allclose(bow - centre, [0, -4], atol=1e-6)  # south, between the two
    animation.to_jshtml()


@pytest.mark.slow
def test_animation_is_saved(tmp_path):
    short = SHORT._replace(length=jnp.int32(2))
    plot.colav_animation(short, path=tmp_path / "a.html", smooth=1)
    assert (tmp_path / "a.html").read_text().count("data:image/png") == 3
    plot.colav_animation(short, path=str(tmp_path / "a.GIF"), smooth=1, fps=4.0)
    from PIL import Image

    with Image.open(tmp_path / "a.GIF") as image:
        assert image.n_frames == 3 and image.info["duration"] == 250


@pytest.mark.skipif(
    not mpl_animation.writers.is_available("ffmpeg"), reason="ffmpeg is not installed"
)
def test_animation_is_saved_as_a_film(tmp_path):
    plot.colav_animation(SHORT, path=tmp_path / "a.mp4", smooth=1)
    assert b"ftyp" in (tmp_path / "a.mp4").read_bytes()[:16]


def test_a_format_without_its_writer_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(mpl_animation.writers, "is_available", lambda name: name == "html")
    for name in ("a.mp4", "a.gif", "a.webm", "a"):
        with pytest.raises(
            ValueError, match=rf"plot.colav_animation: path must .*'.html'.* received '.*{name}'"
        ):
            plot.colav_animation(SHORT, path=tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("draw", [plot.colav, plot.colav_story, plot.colav_animation])
def test_one_episode_of_the_right_system_is_asked_for(draw):
    name = f"plot.{draw.__name__}: episode must"
    many = jax.tree.map(lambda a: jnp.stack([a, a]), EPISODE)
    with pytest.raises(
        ValueError, match=rf"{name} be one Episode, received Episode with leading axes \(2,\)"
    ):
        draw(many)
    with pytest.raises(ValueError, match=f"{name} be one Episode, received NoneType"):
        draw(None)
    with pytest.raises(ValueError, match=f"{name} have states, or sim .*received neither"):
        draw(EPISODE._replace(states=None))
    with pytest.raises(
        ValueError, match=f"{name} be of jast.simulators.colav, received states of FerryState"
    ):
        draw(jast.replay(jast.simulators.ferry(), jnp.full(21, 0.5)))


@pytest.mark.parametrize("moments", [0, -1, 2.5, "last", None, [], [0, 26], [-1], [1.5], [[1]]])
def test_moments_outside_the_episode_are_refused(moments):
    with pytest.raises(ValueError, match="plot.colav: moments must be at least 1, or .* 0 .. 25"):
        plot.colav(EPISODE, moments=moments)


@pytest.mark.parametrize(
    "bad",
    [
        dict(fps=0),
        dict(fps=-1.0),
        dict(fps="8"),
        dict(fps=np.inf),
        dict(fps=np.nan),
        dict(smooth=0),
        dict(smooth=1.5),
        dict(smooth=True),
    ],
)
def test_bad_paces_of_an_animation_are_refused(bad):
    [name] = bad
    with pytest.raises(ValueError, match=f"plot.colav_animation: {name} must be"):
        plot.colav_animation(SHORT, **bad)


def test_settings_of_matplotlib_are_left_alone():
    before = dict(matplotlib.rcParams)
    plot.colav(SHORT)
    plot.colav_story(SHORT)
    plot.colav_animation(SHORT._replace(length=jnp.int32(1)), smooth=1).to_jshtml()
    assert dict(matplotlib.rcParams) == before


def test_the_published_view_shows_what_is_perceived():
    """Figures 2 and 3 of Lytskjold and Mengshoel: the zones, the circle and the heading are those
    of the perceived adversary, and both tails end where the vessels are.
    """
    axes = drawn(plot.colav_published(EPISODE, moments=[7, N]))
    for ax, t in zip(axes, (7, N), strict=True):
        shown, track = labelled(ax), at(EPISODE, t).track
        ferry, adversary, believed = ways(EPISODE, t)
        np.testing.assert_allclose(shown["ferry, its path"].get_xydata(), ferry, rtol=1e-6)
        np.testing.assert_allclose(shown["adversary, its path"].get_xydata(), adversary, rtol=1e-6)
        np.testing.assert_allclose(shown["perceived position"].get_xydata(), believed[-1:])
        start, end = shown["perceived heading"].get_xydata()
        course = np.arctan2(track.v_e, track.v_n)
        np.testing.assert_allclose(start, believed[-1])
        np.testing.assert_allclose(end - start, 15 * np.array([np.sin(course), np.cos(course)]))
        for zone in planner.ZONES:
            edge = zone_outline(zone, track.n, track.e, course)
            np.testing.assert_allclose(shown[zone.name].get_xy()[:200], edge, atol=1e-4)
        assert shown["the ferry's desired path"].is_dashed()
        assert ax.get_title(loc="left") == f"t = {3 * t} s"
    assert len(plot.colav_published(EPISODE, moments=1)) == 1
    with pytest.raises(ValueError, match="plot.colav_published: moments must be at least 1"):
        plot.colav_published(EPISODE, moments=0)
