"""A sample from above: positions, colours, layers and frames."""

from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.quiver import Quiver
from support.rendered_pixels import (
    box_footprints,
    canvas_positions,
    collections_of_kind,
    has_color,
    new_axes,
    read_texts,
    render_canvas,
)
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.bev import BevView, draw_bev, render_bev
from deepaccident_devkit.render.boxes import collider_ids, role_colors
from deepaccident_devkit.render.captions import hue_meanings
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    BEV_COLORS,
    CASING_COLOR,
    CATEGORY_COLORS,
    COLLIDER_COLOR,
    OWN_COLOR,
    POINT_COLOR,
)
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, short_name
from deepaccident_devkit.v2x import Link, PoseNoise, cooperative_boxes


def test_the_legend_lists_what_is_within_the_view(da: DeepAccident, approach_sample: str) -> None:
    boxes = da.boxes(approach_sample, "ego")
    corners = boxes.bottom_corners()[..., :2]
    for view_range in (3.0, 12.0, 50.0):
        is_visible = (corners.max(axis=1) > -view_range) & (corners.min(axis=1) < view_range)
        visible_boxes = boxes.select(is_visible.all(axis=1))
        expected = {
            name
            for name, color in {**hue_meanings(), **CATEGORY_COLORS}.items()
            if color in role_colors(da, approach_sample, visible_boxes)
        }
        ax = render_bev(da, approach_sample, layers=["boxes"], view_range=view_range, ax=new_axes())
        legend = ax.get_legend()
        assert {text.get_text() for text in legend.get_texts()} == expected, view_range


def point_positions(ax: Any, cloud: int = 0) -> Any:
    """Return the points (N, 2) drawn of the point cloud with this number."""
    return np.asarray(collections_of_kind(ax, PathCollection)[cloud].get_offsets())


def read_outlines(ax: Any) -> dict[tuple[float, ...], str]:
    """Return the colour of each footprint drawn; the agents' marks are the last collection."""
    boxes = collections_of_kind(ax, PolyCollection)[0]
    footprints = [tuple(np.round(path.vertices[:4].ravel(), 6)) for path in boxes.get_paths()]
    colors = map(to_hex, boxes.get_edgecolor())
    return dict(zip(footprints, colors, strict=True))


LATE_LINK = Link(latency=0.2, pose_noise=PoseNoise(mean=2.0, std=0.0))


def test_boxes_and_points_are_where_the_sample_has_them(
    da: DeepAccident, approach_sample: str
) -> None:
    ax = new_axes()
    assert render_bev(da, approach_sample, view_range=30, ax=ax) is ax

    boxes = da.boxes(approach_sample, "ego")
    near_boxes = boxes.select((np.abs(boxes.center[:, :2]) < 35).all(axis=1))
    assert set(read_outlines(ax)) == box_footprints(near_boxes)

    (points,) = collections_of_kind(ax, PathCollection)
    cloud = da.load_point_cloud(approach_sample, "ego").xyz[:, :2]
    in_view = (np.abs(cloud) < 30).all(axis=1)
    np.testing.assert_allclose(points.get_offsets(), cloud[in_view])
    assert to_hex(points.get_facecolor()[0]) == POINT_COLOR
    np.testing.assert_allclose([ax.get_xlim(), ax.get_ylim()], [(-30, 30), (-30, 30)], atol=1e-9)


def test_the_outline_of_a_collider_is_red_within_two_pixels_of_its_corners(
    da: DeepAccident, approach_sample: str
) -> None:
    ax = render_bev(da, approach_sample, layers=("boxes",), ax=new_axes())
    boxes = da.boxes(approach_sample, "ego")
    (actor_id,) = collider_ids(da, approach_sample) - {OWN_ACTOR_ID}
    corners = boxes.bottom_corners()[boxes.actor_id == actor_id][0, :, :2]

    canvas = render_canvas(ax)

    positions = canvas_positions(ax, corners)
    are_red = [has_color(canvas, position, COLLIDER_COLOR) for position in positions]
    assert are_red == [True] * 4


def test_each_of_several_agents_has_its_colour_its_name_and_its_place(
    da: DeepAccident, approach_sample: str
) -> None:
    ax = render_bev(da, approach_sample, agents=None, frame="world", view_range=80, ax=new_axes())

    clouds = collections_of_kind(ax, PathCollection)
    marks = collections_of_kind(ax, PolyCollection)[-1]
    colors = list(AGENT_COLORS.values())
    assert [to_hex(cloud.get_facecolor()[0]) for cloud in clouds] == colors
    assert [to_hex(color) for color in marks.get_facecolor()] == colors
    assert [to_hex(color) for color in marks.get_edgecolor()] == [OWN_COLOR, *[CASING_COLOR] * 4]

    scenario, _, number = approach_sample.rsplit("/", 2)
    world_from_ego = [da.world_from(f"{scenario}/{agent}/{number}", "ego") for agent in AGENTS]
    centers = [pose.translation[:2] for pose in world_from_ego]
    tips = [pose.apply([[1.8, 0, 0]])[0, :2] for pose in world_from_ego]
    np.testing.assert_allclose([path.vertices[0] for path in marks.get_paths()], tips)
    np.testing.assert_allclose([text.xy for text in ax.texts], centers)
    assert read_texts(ax) == [short_name(agent) for agent in AGENTS]
    np.testing.assert_allclose(np.mean([ax.get_xlim(), ax.get_ylim()], axis=1), centers[0])


def test_an_actor_that_several_agents_label_is_drawn_once(
    da: DeepAccident, approach_sample: str
) -> None:
    agents = ("ego_vehicle", "infrastructure")
    ax = render_bev(da, approach_sample, agents=agents, layers=["boxes"], ax=new_axes())

    union = cooperative_boxes(da, approach_sample, agents=agents, frame="ego")
    near_boxes = union.select((np.abs(union.center[:, :2]) < 55).all(axis=1))
    assert set(read_outlines(ax)) == box_footprints(near_boxes)


def test_a_link_moves_what_a_partner_sends_and_not_the_partner_s_mark(
    da: DeepAccident, approach_sample: str
) -> None:
    exact, noisy = (
        render_bev(
            da,
            approach_sample,
            agents=("ego_vehicle", "infrastructure"),
            link=link,
            ax=new_axes(),
        )
        for link in (None, Link(pose_noise=PoseNoise(mean=3.0, std=0.0)))
    )

    np.testing.assert_allclose(point_positions(exact), point_positions(noisy))
    exact_points = point_positions(exact, 1)
    noisy_points = point_positions(noisy, 1)
    assert exact_points.shape != noisy_points.shape or np.abs(exact_points - noisy_points).max() > 1
    exact_mark, noisy_mark = (
        collections_of_kind(ax, PolyCollection)[-1].get_paths()[1].vertices for ax in (exact, noisy)
    )
    np.testing.assert_allclose(exact_mark, noisy_mark)


def test_sweeps_add_the_points_of_the_frames_before(da: DeepAccident, approach_sample: str) -> None:
    single, triple = (
        len(point_positions(render_bev(da, approach_sample, sweeps=sweeps, ax=new_axes())))
        for sweeps in (1, 3)
    )
    assert 2.5 * single < triple < 3.5 * single


def test_each_layer_draws_its_own_and_nothing_else(da: DeepAccident, approach_sample: str) -> None:
    kinds = {}
    for layer in ("bev", "points", "boxes", "ids", "velocities", "trajectories"):
        ax = render_bev(da, approach_sample, layers=[layer], ax=new_axes())
        drawn = [*ax.collections[:-1], *ax.images]
        kinds[layer] = {type(artist).__name__ for artist in drawn} | {"text" for _ in ax.texts}

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
    da: DeepAccident, approach_sample: str
) -> None:
    ax = render_bev(
        da,
        approach_sample,
        layers=["trajectories"],
        seconds=(0.2, 0.3),
        view_range=25,
        ax=new_axes(),
    )

    scenario, _, number = approach_sample.rsplit("/", 2)
    actor_id = da.get("agent", f"{scenario}/ego_vehicle")["actor_id"]
    path = da.trajectory(f"{scenario}/actor/{actor_id}", approach_sample, "ego")
    centers = {
        int(index): center[:2] for index, center in zip(path.index, path.center, strict=True)
    }
    past_and_future = ((0, -1, -2), (0, 1, 2, 3))
    for lines, steps in zip(collections_of_kind(ax, LineCollection), past_and_future, strict=True):
        points = [centers[int(number) + step] for step in steps]
        expected = np.stack([points[:-1], points[1:]], axis=1)
        segments = np.array(lines.get_segments())
        start = next(
            row for row, segment in enumerate(segments) if np.allclose(segment, expected[0])
        )
        end = start + len(expected)
        np.testing.assert_allclose(segments[start:end], expected)
        opacity = lines.get_color()[start:end, 3]
        assert opacity[0] == 1
        assert (np.diff(opacity) < 0).all()


@pytest.mark.parametrize(
    ("x", "y", "yaw"),
    [(20.0, 0.0, 0.0), (0.0, 20.0, 0.0), (-15.0, 10.0, 0.0), (18.0, 7.0, 0.5), (12.0, -20.0, -2.2)],
)
def test_the_bev_camera_lies_under_the_picture_the_right_way_round(
    x: float, y: float, yaw: float
) -> None:
    semantic = np.zeros((1200, 1200), dtype=np.uint8)
    row = round(599.5 - x / 0.1)
    column = round(599.5 - y / 0.1)
    semantic[row - 15 : row + 16, column - 15 : column + 16] = TAGS["vehicle"]
    image = BevImage(semantic, np.zeros((1200, 1200), dtype=np.uint16))
    world_from_ego = SE3.from_yaw(yaw, (100.0, -50.0, 2.0))
    ax = new_axes()
    ax.set(xlim=(70, 130), ylim=(-80, -20), aspect="equal")

    draw_underlay(image, ax, target_from_ego=world_from_ego)

    assert (ax.get_xlim(), ax.get_ylim()) == ((70, 130), (-80, -20))
    canvas = render_canvas(ax)
    inside = [(-1, -1), (-1, 1), (1, -1), (1, 1)]
    outside = [(3, 0), (0, -3)]
    points = world_from_ego.apply([[x + dx, y + dy, 0] for dx, dy in (*inside, *outside)])
    are_vehicle = [
        has_color(canvas, position, BEV_COLORS["vehicle"], within=1.0, tolerance=3)
        for position in canvas_positions(ax, points[:, :2])
    ]
    assert are_vehicle == [True] * 4 + [False] * 2


def test_a_picture_can_be_centred_elsewhere(da: DeepAccident, approach_sample: str) -> None:
    ax = new_axes()
    view = BevView(view_range=8, center=(20.0, 5.0))
    drawn = draw_bev(da, approach_sample, view, frozenset(("bev", "boxes")), ax)

    assert (ax.get_xlim(), ax.get_ylim()) == ((12, 28), (-3, 13))
    assert drawn == (set(read_outlines(ax).values()), ())


def test_a_release_without_sensor_files_is_drawn_from_its_labels(da_b: DeepAccident) -> None:
    ax = render_bev(da_b, da_b.sample[0], agents=None, ax=new_axes())
    assert [*ax.images, *collections_of_kind(ax, PathCollection)] == []
    assert len(read_outlines(ax)) > 5


def test_the_receiver_s_own_box_is_where_it_is_and_not_where_a_partner_s_message_has_it(
    da: DeepAccident, approach_sample: str
) -> None:
    agents = ("ego_vehicle", "other_vehicle")
    ax = render_bev(
        da,
        approach_sample,
        agents=agents,
        link=LATE_LINK,
        sweeps=2,
        layers=["boxes"],
        ax=new_axes(),
    )

    boxes = da.boxes(approach_sample, "ego")
    own_box = boxes.select(boxes.actor_id == OWN_ACTOR_ID)
    assert box_footprints(own_box) <= set(read_outlines(ax))

    received = cooperative_boxes(da, approach_sample, agents=agents, frame="ego", link=LATE_LINK)
    own_id = da.get("agent", approach_sample.replace("/003", ""))["actor_id"]
    sent_box = received.select(received.actor_id == own_id)
    assert np.linalg.norm(sent_box.center[0, :2] - own_box.center[0, :2]) > 1


def test_the_title_says_what_the_link_does(da: DeepAccident, approach_sample: str) -> None:
    agents = ("ego_vehicle", "other_vehicle")
    linked = render_bev(da, approach_sample, agents=agents, link=LATE_LINK, ax=new_axes())
    alone = render_bev(da, approach_sample, link=LATE_LINK, ax=new_axes())
    assert not missing_parts(linked.get_title(), "0.2 s", "2 m")
    assert "0.2 s" not in alone.get_title()
