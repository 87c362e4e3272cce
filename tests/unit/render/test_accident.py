"""The countdown to an impact: which cameras, which moments, what is at which place, and the
words.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawing import texts, title_of
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from wording import lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.render import detached_figure
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


def accident_of(da: DeepAccident) -> Any:
    return next(scenario for scenario in da.scenario if scenario["collision"])


def drawn(da: DeepAccident, scenario: Any, **how: Any) -> Any:
    figure = detached_figure((8, 8))
    assert render_accident(da, scenario, fig=figure, **how) is figure
    return figure


def countdown(
    da: DeepAccident, frame: str, agents: Sequence[str], layers: Sequence[str] | None
) -> Any:
    fig = detached_figure((12.8, 7.2))
    draw_countdown(da, frame, agents=agents, layers=layers, fig=fig)
    return fig


@pytest.fixture(scope="module")
def accident(da: DeepAccident) -> str:
    token: str = accident_of(da)["token"]
    return token


def test_a_column_a_moment_and_a_row_an_agent(da: DeepAccident) -> None:
    figure = drawn(
        da, accident_of(da), seconds=(2.0, 0.4, 0.0), agents=["infrastructure", "ego_vehicle"]
    )
    cameras = figure.axes[:4]
    assert len(figure.axes) == 2 * 3  # 2 s before was not recorded
    assert [ax.get_title() for ax in cameras[:2]] == ["0.4 s before", "the impact"]
    assert [texts(ax)[-1] for ax in cameras[::2]] == ["ego", "infrastructure"]
    assert [len(ax.images) for ax in cameras] == [1] * 4


def test_the_title_says_that_a_recording_is_cut_short(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    root, token = tmp_path / "cut", accident_of(da_motion)["token"]
    shutil.copytree(
        da_motion.dataroot,
        root,
        ignore=shutil.ignore_patterns(".deepaccident", "*_02?.*", "*_03?.*"),
    )
    cut = DeepAccident(dataroot=root, verbose=False)
    title = title_of(drawn(cut, token, seconds=[0.5, 0.0], agents=[]))
    assert not lacking(title, f"{cut.collision(token).gap:.1f} m apart", "frame 19 of 19")


def test_the_pair_is_where_it_is_and_red(da_motion: DeepAccident) -> None:
    scenario = accident_of(da_motion)
    contact, tracks = da_motion.collision(scenario), scenario_tracks(da_motion, scenario["token"])
    for left, ax in zip(
        (2.0, 1.0, 0.5, 0.0), drawn(da_motion, scenario, agents=[]).axes, strict=True
    ):
        boxes = tracks.at(scenario["num_frames"] - round(left * 10))
        corners, pair = boxes.bottom_corners()[..., :2], np.isin(boxes.actor_id, contact.actor_ids)
        shapes = next(each for each in ax.collections if isinstance(each, PolyCollection))
        np.testing.assert_allclose([path.vertices[:4] for path in shapes.get_paths()], corners)
        assert [
            to_hex(color) == COLLIDER_COLOR for color in shapes.get_edgecolor()
        ] == pair.tolist()
        crosses = [line for line in ax.lines if line.get_marker() == "x"]
        np.testing.assert_allclose(crosses[0].get_xydata(), [contact.point[:2]])
        low, high = ax.viewLim.get_points()
        assert ((corners[pair] >= low) & (corners[pair] <= high)).all()


def test_trails_lead_from_where_the_pair_was_to_the_impact(da_motion: DeepAccident) -> None:
    scenario = accident_of(da_motion)
    trails, none = (
        drawn(da_motion, scenario, agents=[], seconds=[1.0], layers=layers).axes[0].collections
        for layers in (["trajectories"], [])
    )
    tracks = scenario_tracks(da_motion, scenario["token"])
    ends = np.concatenate([segment for each in trails for segment in each.get_segments()])
    for actor in scenario["collision"]["ids"]:
        last = tracks.boxes.center[tracks.actor_id == actor][-1, :2]
        assert np.linalg.norm(ends - last, axis=1).min() < 1e-9
    assert len(none) == 0


def test_images_are_those_that_show_the_pair_best(da: DeepAccident) -> None:
    scenario = accident_of(da)
    (panel, *_) = drawn(
        da, scenario, seconds=[0.0], agents=["ego_vehicle_behind"], layers=["boxes"]
    ).axes
    sample = da.get_sample(scenario, "ego_vehicle_behind", scenario["num_frames"])["token"]
    boxes = scenario_tracks(da, scenario["token"]).at(scenario["num_frames"])
    view = best_view(
        da, [sample], boxes.select(np.isin(boxes.actor_id, scenario["collision"]["ids"]))
    )
    assert camera_name(view.camera.rsplit("/", 1)[1]) in texts(panel)
    left, top, right, bottom = view.bounds
    assert panel.get_xlim()[0] <= left < right <= panel.get_xlim()[1]
    assert panel.get_ylim()[1] <= top < bottom <= panel.get_ylim()[0]


def test_the_words_say_who_hits_whom(da_motion: DeepAccident) -> None:
    contact = da_motion.collision(accident_of(da_motion))
    words = accident_words(da_motion, contact)
    assert ("hits" in words) == ("front" in contact.sides)
    actors = [f" {actor})" for actor in contact.actor_ids]
    assert not lacking(
        words,
        *actors,
        f"{contact.closing_speed:.1f} m/s",
        f"{np.degrees(contact.impact_angle):.0f}°",
    )


def test_the_countdown_has_five_cameras_and_the_pair_at_its_place(
    da: DeepAccident, accident: str
) -> None:
    fig = countdown(da, f"{accident}/004", AGENTS, None)
    agents = [ax.get_title().split(":")[0] for ax in fig.axes if ":" in ax.get_title()]
    assert agents == ["ego", "ego behind", "other", "other behind", "infrastructure"]
    above = next(ax for ax in fig.axes if ax.get_title().startswith("from above"))
    boxes = [each for each in above.collections if isinstance(each, PolyCollection)]
    boxes = next(each for each in boxes if len(each.get_edgecolor()) > 1)
    red = [to_hex(color) == COLLIDER_COLOR for color in boxes.get_edgecolor()]
    places = [
        path.vertices[:4].mean(axis=0)
        for path, is_red in zip(boxes.get_paths(), red, strict=True)
        if is_red
    ]
    ids = da.collision(accident).actor_ids
    wanted = [da.track.get(f"{accident}/004/actor/{actor}")["translation"][:2] for actor in ids]
    np.testing.assert_allclose(sorted(map(tuple, places)), sorted(map(tuple, wanted)), atol=0.05)


def test_an_agent_that_is_not_asked_for_has_an_empty_place(da: DeepAccident, accident: str) -> None:
    fig = countdown(da, f"{accident}/006", ["infrastructure"], ["boxes"])
    assert sum(ax.axison for ax in fig.axes) == 3  # a camera, from above, speeds


def red_size(ax: Any) -> Any:
    """Width and height, in pixels, of the red lines that a panel shows."""
    low, high = ax.get_window_extent().get_points()
    lines = [each for each in ax.collections if isinstance(each, LineCollection)]
    kinds = [
        kind for each in lines for kind in zip(each.get_segments(), each.get_color(), strict=True)
    ]
    red = [ends for ends, color in kinds if to_hex(color) == COLLIDER_COLOR]
    return (
        np.ptp(ax.transData.transform(np.concatenate(red)).clip(low, high), axis=0)
        if red
        else np.zeros(2)
    )


def assert_pair_is_seen(
    da: DeepAccident, scenario: Any, seconds: Sequence[float], width: float
) -> None:
    """At every moment: in the cameras of three agents or more, and from above with both tags; no
    tag is left out.
    """
    tags = {*CollidingPair.of(da, da.collision(scenario)).tags.values()}
    figure = detached_figure((width * len(seconds), 4.2 * width))
    render_accident(da, scenario, seconds=seconds, agents=AGENTS, fig=figure)
    figure.draw_without_rendering()
    for *cameras, above in np.array(figure.axes).reshape(6, len(seconds)).T:
        assert sum(red_size(ax).min() > 4 * width for ax in cameras) >= 3
        assert tags <= {*texts(above)}
        assert red_size(above).max() > 9 * width
    for ax in figure.axes:
        named = [text for text in ax.texts if text.get_text() in tags]
        hidden = [
            each
            for each in named
            if not each.get_visible() or not ax.bbox.overlaps(each.get_window_extent())
        ]
        assert hidden == []
        assert len(named) >= (red_size(ax).min() > 4 * width)


def test_the_pair_of_each_design_is_seen_up_to_the_impact(da_designs: DeepAccident) -> None:
    """In two columns of a paper."""
    for scenario in [scenario for scenario in da_designs.scenario if scenario["collision"]]:
        assert_pair_is_seen(da_designs, scenario, (0.4, 0.2, 0.1, 0.0), width=1.8)


def test_where_there_is_little_room_the_agents_that_see_the_pair_best_are_shown(
    da: DeepAccident, accident: str
) -> None:
    pair, seconds = CollidingPair.of(da, da.collision(accident)), (0.3, 0.2, 0.1, 0.0)
    few, asked = (
        render_accident(
            da, accident, seconds=seconds, agents=agents, fig=detached_figure((8.0, 4.5))
        )
        for agents in (None, AGENTS)
    )
    *named, above = [texts(ax)[-1] for ax in few.axes[::4]]
    views = {agent: [pair.view(agent, index)[1] for index in (3, 4, 5, 6)] for agent in AGENTS}
    shares = {
        short_name(agent): sum(each.total_share for each in seen if each)
        for agent, seen in views.items()
    }
    assert (len(named), named[0], above) == (2, "ego", "from above")
    assert shares[named[1]] == max(share for name, share in shares.items() if name != "ego")
    assert len(asked.axes) == 4 * 6


def test_a_scenario_without_an_accident_has_no_countdown(da: DeepAccident, tmp_path: Path) -> None:
    normal, path = (
        next(record["token"] for record in da.scenario if not record["collision"]),
        tmp_path / "v.gif",
    )
    with pytest.raises(NotAvailableError, match="'frame'"):
        render_scenario_video(da, normal, path, views="accident", workers=1, progress=False)
    assert not path.exists()
