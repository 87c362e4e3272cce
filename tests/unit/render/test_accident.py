"""The countdown to an impact: its cameras and moments, what is drawn where, and its words."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from support.rendered_pixels import read_texts, read_title
from support.replay_page import accident_scenario, normal_scenario
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.accident import (
    CollidingPair,
    accident_words,
    draw_countdown,
    render_accident,
)
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.styles import COLLIDER_COLOR
from deepaccident_devkit.render.video import render_scenario_video
from deepaccident_devkit.taxonomy import AGENTS, short_name
from deepaccident_devkit.v2x.tracks import scenario_tracks

pytestmark = pytest.mark.slow


def find_accident(da: DeepAccident) -> Any:
    return da.get("scenario", accident_scenario(da))


def draw_accident(da: DeepAccident, scenario: Any, **options: Any) -> Any:
    figure = detached_figure((8, 8))
    assert render_accident(da, scenario, fig=figure, **options) is figure
    return figure


def draw_countdown_figure(
    da: DeepAccident, frame: str, agents: Sequence[str], layers: Sequence[str] | None
) -> Any:
    fig = detached_figure((12.8, 7.2))
    draw_countdown(da, frame, agents=agents, layers=layers, fig=fig)
    return fig


@pytest.fixture(scope="module")
def accident(da: DeepAccident) -> str:
    return accident_scenario(da)


def first_polygons(ax: Any, *, min_colors: int = 0) -> Any:
    """Return the first polygons on the axes that have at least this many edge colours."""
    polygons = [shape for shape in ax.collections if isinstance(shape, PolyCollection)]
    return next(shape for shape in polygons if len(shape.get_edgecolor()) >= min_colors)


def are_red(polygons: Any) -> list[bool]:
    return [to_hex(color) == COLLIDER_COLOR for color in polygons.get_edgecolor()]


def test_each_moment_has_a_column_and_each_agent_a_row(da: DeepAccident) -> None:
    figure = draw_accident(
        da,
        find_accident(da),
        seconds=(2.0, 0.4, 0.0),
        agents=["infrastructure", "ego_vehicle"],
    )
    cameras = figure.axes[:4]

    assert len(figure.axes) == 2 * 3  # 2 s before was not recorded
    assert [ax.get_title() for ax in cameras[:2]] == ["0.4 s before", "the impact"]
    assert [read_texts(ax)[-1] for ax in cameras[::2]] == ["ego", "infrastructure"]
    assert [len(ax.images) for ax in cameras] == [1] * 4


@pytest.mark.parametrize("name", ["cvpr-column", "ieee-column"])
def test_a_column_has_two_title_lines(da: DeepAccident, name: Any) -> None:
    with style(name):
        title = draw_accident(da, find_accident(da)).get_suptitle()
    assert len(title.splitlines()) == 2


def test_the_title_says_that_a_recording_is_cut_short(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    root = tmp_path / "cut"
    shutil.copytree(
        da_motion.dataroot,
        root,
        ignore=shutil.ignore_patterns(".deepaccident", "*_02?.*", "*_03?.*"),
    )
    token = accident_scenario(da_motion)
    cut = DeepAccident(dataroot=root, verbose=False)

    title = read_title(draw_accident(cut, token, seconds=[0.5, 0.0], agents=[]))

    gap_m = cut.collision(token).gap
    assert not missing_parts(title, f"{gap_m:.1f} m apart", "frame 19 of 19")


def test_the_pair_is_where_it_is_and_red(da_motion: DeepAccident) -> None:
    scenario = find_accident(da_motion)
    contact = da_motion.collision(scenario)
    tracks = scenario_tracks(da_motion, scenario["token"])
    panels = draw_accident(da_motion, scenario, agents=[]).axes

    for seconds_left, ax in zip((2.0, 1.0, 0.5, 0.0), panels, strict=True):
        boxes = tracks.at(scenario["num_frames"] - round(seconds_left * 10))
        corners = boxes.bottom_corners()[..., :2]
        in_pair = np.isin(boxes.actor_id, contact.actor_ids)

        shapes = first_polygons(ax)
        np.testing.assert_allclose([path.vertices[:4] for path in shapes.get_paths()], corners)
        assert are_red(shapes) == in_pair.tolist()

        crosses = [line for line in ax.lines if line.get_marker() == "x"]
        np.testing.assert_allclose(crosses[0].get_xydata(), [contact.point[:2]])

        low, high = ax.viewLim.get_points()
        pair_corners = corners[in_pair]
        assert ((pair_corners >= low) & (pair_corners <= high)).all()


def test_trails_lead_from_where_the_pair_was_to_the_impact(da_motion: DeepAccident) -> None:
    scenario = find_accident(da_motion)
    trails, no_trails = (
        draw_accident(da_motion, scenario, agents=[], seconds=[1.0], layers=layers)
        .axes[0]
        .collections
        for layers in (["trajectories"], [])
    )
    tracks = scenario_tracks(da_motion, scenario["token"])

    segments = [segment for trail in trails for segment in trail.get_segments()]
    points = np.concatenate(segments)
    for actor_id in scenario["collision"]["ids"]:
        last_center = tracks.boxes.center[tracks.actor_id == actor_id][-1, :2]
        assert np.linalg.norm(points - last_center, axis=1).min() < 1e-9
    assert len(no_trails) == 0


def test_the_camera_is_the_one_that_shows_the_pair_best(da: DeepAccident) -> None:
    scenario = find_accident(da)
    panel = draw_accident(
        da,
        scenario,
        seconds=[0.0],
        agents=["ego_vehicle_behind"],
        layers=["boxes"],
    ).axes[0]

    sample = da.get_sample(scenario, "ego_vehicle_behind", scenario["num_frames"])["token"]
    boxes = scenario_tracks(da, scenario["token"]).at(scenario["num_frames"])
    pair = boxes.select(np.isin(boxes.actor_id, scenario["collision"]["ids"]))
    view = best_view(da, [sample], pair)
    channel = view.camera.rsplit("/", 1)[1]
    assert camera_name(channel) in read_texts(panel)

    left, top, right, bottom = view.bounds
    assert panel.get_xlim()[0] <= left < right <= panel.get_xlim()[1]
    assert panel.get_ylim()[1] <= top < bottom <= panel.get_ylim()[0]


def test_the_words_say_who_hits_whom(da_motion: DeepAccident) -> None:
    contact = da_motion.collision(accident_scenario(da_motion))
    words = accident_words(da_motion, contact)

    assert ("hits" in words) == ("front" in contact.sides)
    actors = [f" {actor_id})" for actor_id in contact.actor_ids]
    assert not missing_parts(
        words,
        *actors,
        f"{contact.closing_speed:.1f} m/s",
        f"{np.degrees(contact.impact_angle):.0f}°",
    )


def test_the_countdown_has_five_cameras_and_the_pair_at_its_place(
    da: DeepAccident, accident: str
) -> None:
    frame = f"{accident}/004"
    fig = draw_countdown_figure(da, frame, AGENTS, None)
    titles = [ax.get_title() for ax in fig.axes]
    agents = [title.split(":")[0] for title in titles if ":" in title]
    assert agents == ["ego", "ego behind", "other", "other behind", "infrastructure"]

    above = next(ax for ax in fig.axes if ax.get_title().startswith("from above"))
    boxes = first_polygons(above, min_colors=2)
    red_centers = [
        tuple(path.vertices[:4].mean(axis=0))
        for path, is_red in zip(boxes.get_paths(), are_red(boxes), strict=True)
        if is_red
    ]
    expected_centers = []
    for actor_id in da.collision(accident).actor_ids:
        track = da.track.get(f"{frame}/actor/{actor_id}")
        expected_centers.append(tuple(track["translation"][:2]))
    np.testing.assert_allclose(sorted(red_centers), sorted(expected_centers), atol=0.05)


def test_an_agent_that_is_not_asked_for_has_an_empty_place(da: DeepAccident, accident: str) -> None:
    fig = draw_countdown_figure(da, f"{accident}/006", ["infrastructure"], ["boxes"])
    assert sum(ax.axison for ax in fig.axes) == 3  # a camera, from above, speeds


def measure_red_lines(ax: Any) -> Any:
    """Return the width and height, in pixels, that the red lines cover within a panel."""
    red_lines = []
    for lines in ax.collections:
        if isinstance(lines, LineCollection):
            for segment, color in zip(lines.get_segments(), lines.get_color(), strict=True):
                if to_hex(color) == COLLIDER_COLOR:
                    red_lines.append(segment)
    if not red_lines:
        return np.zeros(2)

    low, high = ax.get_window_extent().get_points()
    pixels = ax.transData.transform(np.concatenate(red_lines))
    return np.ptp(pixels.clip(low, high), axis=0)


def assert_pair_is_seen(
    da: DeepAccident, scenario: Any, seconds: Sequence[float], width: float
) -> None:
    """Check that at every moment at least three agents' cameras show the pair, and the view from
    above both of its tags; no tag is left out. `width` is a column's width in inches.
    """
    tags = {*CollidingPair.of(da, da.collision(scenario)).tags.values()}
    figure = detached_figure((width * len(seconds), 4.2 * width))
    render_accident(da, scenario, seconds=seconds, agents=AGENTS, fig=figure)
    figure.draw_without_rendering()

    for *cameras, above in np.array(figure.axes).reshape(6, len(seconds)).T:
        assert sum(measure_red_lines(ax).min() > 4 * width for ax in cameras) >= 3
        assert tags <= {*read_texts(above)}
        assert measure_red_lines(above).max() > 9 * width

    for ax in figure.axes:
        drawn_tags = [text for text in ax.texts if text.get_text() in tags]
        hidden_tags = [
            tag
            for tag in drawn_tags
            if not tag.get_visible() or not ax.bbox.overlaps(tag.get_window_extent())
        ]
        assert hidden_tags == []
        assert len(drawn_tags) >= (measure_red_lines(ax).min() > 4 * width)


def test_the_pair_of_each_design_is_seen_up_to_the_impact(da_designs: DeepAccident) -> None:
    """The figure is as narrow as two columns of a paper."""
    accidents = [scenario for scenario in da_designs.scenario if scenario["collision"]]
    for scenario in accidents:
        assert_pair_is_seen(da_designs, scenario, (0.4, 0.2, 0.1, 0.0), width=1.8)


def test_where_there_is_little_room_the_agents_that_see_the_pair_best_are_shown(
    da: DeepAccident, accident: str
) -> None:
    small_figure, full_figure = (
        render_accident(
            da,
            accident,
            seconds=(0.3, 0.2, 0.1, 0.0),
            agents=agents,
            fig=detached_figure((8.0, 4.5)),
        )
        for agents in (None, AGENTS)
    )
    *shown_agents, above = [read_texts(ax)[-1] for ax in small_figure.axes[::4]]

    pair = CollidingPair.of(da, da.collision(accident))
    shares = {}
    for agent in AGENTS:
        views = [pair.view(agent, index)[1] for index in (3, 4, 5, 6)]
        shares[short_name(agent)] = sum(view.total_share for view in views if view)
    assert (len(shown_agents), shown_agents[0], above) == (2, "ego", "from above")
    assert shares[shown_agents[1]] == max(share for name, share in shares.items() if name != "ego")
    assert len(full_figure.axes) == 4 * 6


def test_a_scenario_without_an_accident_has_no_countdown(da: DeepAccident, tmp_path: Path) -> None:
    path = tmp_path / "v.gif"
    with pytest.raises(NotAvailableError, match="'frame'"):
        render_scenario_video(
            da,
            normal_scenario(da),
            path,
            views="accident",
            workers=1,
            progress=False,
        )

    assert not path.exists()
