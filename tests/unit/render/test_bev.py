"""A moment from above: places, colours, layers and frames."""

from typing import Any

import numpy as np
import pytest
from drawing import footprints, has_color, new_axes, of_kind, on_canvas, rendered, texts
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.quiver import Quiver
from wording import lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.bev import BevView, draw_bev, render_bev
from deepaccident_devkit.render.boxes import collider_ids
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    BEV_COLORS,
    CASING_COLOR,
    COLLIDER_COLOR,
    OWN_COLOR,
    POINT_COLOR,
)
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, short_name
from deepaccident_devkit.v2x import Link, PoseNoise, cooperative_boxes


def places(ax: Any, cloud: int = 0) -> Any:
    """The points that are drawn of a cloud."""
    return np.asarray(of_kind(ax, PathCollection)[cloud].get_offsets())


def outlines(ax: Any) -> dict[tuple[float, ...], str]:
    """The footprints drawn → their colours; agents' marks are the last collection."""
    boxes = of_kind(ax, PolyCollection)[0]
    corners = [tuple(np.round(path.vertices[:4].ravel(), 6)) for path in boxes.get_paths()]
    return dict(zip(corners, map(to_hex, boxes.get_edgecolor()), strict=True))


def test_boxes_and_points_are_where_the_sample_has_them(da: DeepAccident, approach: str) -> None:
    ax = new_axes()
    assert render_bev(da, approach, view_range=30, ax=ax) is ax
    boxes, cloud = da.boxes(approach, "ego"), da.load_point_cloud(approach, "ego").xyz
    near = boxes.select((np.abs(boxes.center[:, :2]) < 35).all(axis=1))
    assert set(outlines(ax)) == footprints(near)
    (points,) = of_kind(ax, PathCollection)
    np.testing.assert_allclose(
        points.get_offsets(), cloud[(np.abs(cloud[:, :2]) < 30).all(axis=1), :2]
    )
    assert to_hex(points.get_facecolor()[0]) == POINT_COLOR
    np.testing.assert_allclose([ax.get_xlim(), ax.get_ylim()], [(-30, 30), (-30, 30)], atol=1e-9)


def test_the_outline_of_a_collider_is_red_within_two_pixels_of_its_corners(
    da: DeepAccident, approach: str
) -> None:
    ax, boxes = (
        render_bev(da, approach, layers=("boxes",), ax=new_axes()),
        da.boxes(approach, "ego"),
    )
    (actor,) = collider_ids(da, approach) - {OWN_ACTOR_ID}
    corners = boxes.bottom_corners()[boxes.actor_id == actor][0, :, :2]
    picture = rendered(ax)
    assert [has_color(picture, place, COLLIDER_COLOR) for place in on_canvas(ax, corners)] == [
        True
    ] * 4


def test_of_several_agents_each_has_its_colour_its_name_and_its_place(
    da: DeepAccident, approach: str
) -> None:
    ax = render_bev(da, approach, agents=None, frame="world", view_range=80, ax=new_axes())
    scenario, _, number = approach.rsplit("/", 2)
    marks, colors = of_kind(ax, PolyCollection)[-1], list(AGENT_COLORS.values())
    assert [to_hex(one.get_facecolor()[0]) for one in of_kind(ax, PathCollection)] == colors
    assert [to_hex(color) for color in marks.get_facecolor()] == colors
    assert [to_hex(color) for color in marks.get_edgecolor()] == [OWN_COLOR, *[CASING_COLOR] * 4]
    world_from_ego = [da.world_from(f"{scenario}/{agent}/{number}", "ego") for agent in AGENTS]
    tips = [pose.apply([[1.8, 0, 0]])[0, :2] for pose in world_from_ego]
    np.testing.assert_allclose([path.vertices[0] for path in marks.get_paths()], tips)
    np.testing.assert_allclose(
        [text.xy for text in ax.texts], [pose.translation[:2] for pose in world_from_ego]
    )
    assert texts(ax) == [short_name(agent) for agent in AGENTS]
    np.testing.assert_allclose(
        np.mean([ax.get_xlim(), ax.get_ylim()], axis=1), world_from_ego[0].translation[:2]
    )


def test_several_agents_boxes_are_drawn_once_an_actor(da: DeepAccident, approach: str) -> None:
    agents = ("ego_vehicle", "infrastructure")
    ax = render_bev(da, approach, agents=agents, layers=["boxes"], ax=new_axes())
    union = cooperative_boxes(da, approach, agents=agents, frame="ego")
    assert set(outlines(ax)) == footprints(
        union.select((np.abs(union.center[:, :2]) < 55).all(axis=1))
    )


def test_a_link_moves_what_a_partner_sends_and_not_the_partner_s_mark(
    da: DeepAccident, approach: str
) -> None:
    both, link = ("ego_vehicle", "infrastructure"), Link(pose_noise=PoseNoise(mean=3.0, std=0.0))
    true, wrong = (
        render_bev(da, approach, agents=both, link=one, ax=new_axes()) for one in (None, link)
    )
    np.testing.assert_allclose(places(true), places(wrong))
    first, second = places(true, 1), places(wrong, 1)
    assert first.shape != second.shape or np.abs(first - second).max() > 1
    marks = [of_kind(ax, PolyCollection)[-1].get_paths()[1].vertices for ax in (true, wrong)]
    np.testing.assert_allclose(marks[0], marks[1])


def test_sweeps_add_the_points_of_the_frames_before(da: DeepAccident, approach: str) -> None:
    one, three = (
        len(places(render_bev(da, approach, sweeps=sweeps, ax=new_axes()))) for sweeps in (1, 3)
    )
    assert 2.5 * one < three < 3.5 * one


def test_each_layer_draws_its_own_and_nothing_else(da: DeepAccident, approach: str) -> None:
    kinds = {}
    for layer in ("bev", "points", "boxes", "ids", "velocities", "trajectories"):
        ax = render_bev(da, approach, layers=[layer], ax=new_axes())
        drawn = {type(one).__name__ for one in ax.collections[:-1]} | {
            type(one).__name__ for one in ax.images
        }
        kinds[layer] = drawn | {"text" for _ in ax.texts}
    assert kinds == {
        "bev": {"AxesImage"},
        "points": {PathCollection.__name__},
        "boxes": {
            PolyCollection.__name__,
            LineCollection.__name__,
            "text",
        },  # the colliding pair's names
        "ids": {"text"},
        "velocities": {Quiver.__name__},
        "trajectories": {LineCollection.__name__},
    }


def test_trajectories_fade_from_the_present_to_where_the_actors_were_and_will_be(
    da: DeepAccident, approach: str
) -> None:
    ax = render_bev(
        da, approach, layers=["trajectories"], seconds=(0.2, 0.3), view_range=25, ax=new_axes()
    )
    scenario, _, number = approach.rsplit("/", 2)
    own = da.get("agent", f"{scenario}/ego_vehicle")["actor_id"]
    path = da.trajectory(f"{scenario}/actor/{own}", approach, "ego")
    there = {int(index): center[:2] for index, center in zip(path.index, path.center, strict=True)}
    ways = [[there[int(number) + step] for step in steps] for steps in ((0, -1, -2), (0, 1, 2, 3))]
    for lines, ends in zip(of_kind(ax, LineCollection), ways, strict=True):
        expected, segments = np.stack([ends[:-1], ends[1:]], axis=1), np.array(lines.get_segments())
        start = next(row for row in range(len(segments)) if np.allclose(segments[row], expected[0]))
        np.testing.assert_allclose(segments[start : start + len(expected)], expected)
        opacity = lines.get_color()[start : start + len(expected), 3]
        assert (opacity[0], (np.diff(opacity) < 0).all()) == (1, True)


@pytest.mark.parametrize(
    ("x", "y", "yaw"),
    [(20.0, 0.0, 0.0), (0.0, 20.0, 0.0), (-15.0, 10.0, 0.0), (18.0, 7.0, 0.5), (12.0, -20.0, -2.2)],
)
def test_the_bev_camera_lies_under_the_picture_the_right_way_round(
    x: float, y: float, yaw: float
) -> None:
    semantic = np.zeros((1200, 1200), dtype=np.uint8)
    row, column = round(599.5 - x / 0.1), round(599.5 - y / 0.1)
    semantic[row - 15 : row + 16, column - 15 : column + 16] = TAGS["vehicle"]
    world_from_ego, ax = SE3.from_yaw(yaw, (100.0, -50.0, 2.0)), new_axes()
    ax.set(xlim=(70, 130), ylim=(-80, -20), aspect="equal")
    image = BevImage(semantic, np.zeros((1200, 1200), dtype=np.uint16))
    draw_underlay(image, ax, target_from_ego=world_from_ego, view_range=30)
    assert (ax.get_xlim(), ax.get_ylim()) == ((70, 130), (-80, -20))
    picture, corners = rendered(ax), [(-1, -1), (-1, 1), (1, -1), (1, 1)]
    places = world_from_ego.apply([[x + dx, y + dy, 0] for dx, dy in (*corners, (3, 0), (0, -3))])[
        :, :2
    ]
    vehicle = {"color": BEV_COLORS["vehicle"], "within": 1.0, "tolerance": 3}
    found = [has_color(picture, place, **vehicle) for place in on_canvas(ax, places)]
    assert found == [True] * 4 + [False] * 2


def test_a_picture_can_be_centred_elsewhere(da: DeepAccident, approach: str) -> None:
    ax, view = new_axes(), BevView(view_range=8, center=(20.0, 5.0))
    drawn = draw_bev(da, approach, view, frozenset(("bev", "boxes")), ax)
    assert (ax.get_xlim(), ax.get_ylim()) == ((12, 28), (-3, 13))
    assert drawn == (set(outlines(ax).values()), ())


def test_a_release_without_sensor_files_is_drawn_from_its_labels(da_b: DeepAccident) -> None:
    ax = render_bev(da_b, da_b.sample[0], agents=None, ax=new_axes())
    assert [*ax.images, *of_kind(ax, PathCollection)] == []
    assert len(outlines(ax)) > 5


def test_the_receiver_s_own_box_is_where_it_is_and_not_where_a_partner_s_message_has_it(
    da: DeepAccident, approach: str
) -> None:
    both, link = (
        ("ego_vehicle", "other_vehicle"),
        Link(latency=0.2, pose_noise=PoseNoise(mean=2.0, std=0.0)),
    )
    ax = render_bev(da, approach, agents=both, link=link, sweeps=2, layers=["boxes"], ax=new_axes())
    own, moved = (
        da.boxes(approach, "ego"),
        cooperative_boxes(da, approach, agents=both, frame="ego", link=link),
    )
    own = own.select(own.actor_id == OWN_ACTOR_ID)
    assert footprints(own) <= set(outlines(ax))
    sent = moved.select(moved.actor_id == da.get("agent", approach.replace("/003", ""))["actor_id"])
    assert np.linalg.norm(sent.center[0, :2] - own.center[0, :2]) > 1


def test_the_title_says_what_the_link_does(da: DeepAccident, approach: str) -> None:
    both, link = (
        ("ego_vehicle", "other_vehicle"),
        Link(latency=0.2, pose_noise=PoseNoise(mean=2.0, std=0.0)),
    )
    assert not lacking(
        render_bev(da, approach, agents=both, link=link, ax=new_axes()).get_title(), "0.2 s", "2 m"
    )
    assert "0.2 s" not in render_bev(da, approach, link=link, ax=new_axes()).get_title()
