"""Boxes are drawn where geometry says, from above and in images."""

from typing import Any

import numpy as np
import pytest
from drawing import has_color, new_axes, on_canvas, rendered
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.quiver import Quiver
from numpy.testing import assert_allclose

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, Box, Boxes, PinholeCamera
from deepaccident_devkit.render import draw_box
from deepaccident_devkit.render.boxes import (
    NEAREST_DRAWN,
    bounds_in_image,
    draw_boxes_from_above,
    draw_boxes_in_image,
    draw_ids_from_above,
    draw_ids_in_image,
    draw_velocities_from_above,
    draw_velocities_in_image,
    recorder_ids,
    role_colors,
    segments_in_image,
)
from deepaccident_devkit.render.styles import AGENT_COLORS, CATEGORY_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID
from deepaccident_devkit.v2x import cooperative_boxes

RED = "#e60026"
CAMERA = PinholeCamera.from_field_of_view(400, 300, np.pi / 2)
OPTICAL_FROM_EGO = SE3(np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]))
"""A camera at the origin that looks along x."""


def boxes(frame: str = "ego", **columns: Any) -> Boxes:
    """A turned car in front, a truck to the left, and one that the agent drives itself."""
    given = {
        "center": [[12.0, -2, 0], [20, 9, 1], [0, 0, 0]],
        "size": [[4.5, 1.9, 1.5], [9, 2.5, 3.5], [4, 2, 1.5]],
        "yaw": [0.4, -2.0, 0],
        "category": ["car", "truck", "car"],
        "actor_id": [7, -1, -100],
        "velocity": [[3.0, 1, 0], [0, 0, 0], [np.nan, np.nan, np.nan]],
        **columns,
    }
    return Boxes.from_arrays(given.pop("center"), given.pop("size"), given.pop("yaw"), frame=frame, **given)


def image_axes() -> Any:
    ax = new_axes((8, 6))
    ax.set(xlim=(0, CAMERA.width), ylim=(CAMERA.height, 0), aspect="equal")
    return ax


def test_from_above_the_outline_passes_within_two_pixels_of_the_corners() -> None:
    drawn, ax = boxes(), new_axes()
    ax.set(xlim=(-10, 30), ylim=(-15, 25), aspect="equal")
    draw_boxes_from_above(drawn, ax, [RED] * 3)
    picture = rendered(ax)
    corners = drawn.bottom_corners()[..., :2]
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    for place in on_canvas(ax, np.concatenate([corners, middles]).reshape(-1, 2)):
        assert has_color(picture, place, RED)
    for place in on_canvas(ax, drawn.center[:, :2] - (0.0, 6.0)):
        assert not has_color(picture, place, RED)


def test_in_an_image_the_edges_pass_within_two_pixels_of_the_projected_corners() -> None:
    seen, ax = boxes().select([0, 1]).transform(OPTICAL_FROM_EGO, "Camera_Front"), image_axes()
    draw_boxes_in_image(seen, CAMERA, ax, [RED, RED])
    picture = rendered(ax)
    pixels, _ = CAMERA.project(seen.corners().reshape(-1, 3))
    assert CAMERA.in_image(pixels).all()
    for place in on_canvas(ax, pixels):
        assert has_color(picture, place, RED)
    assert not has_color(picture, on_canvas(ax, [[200, 290]])[0], RED)


def test_edges_in_an_image_have_a_pale_casing_on_dark_ground() -> None:
    seen, ax, dark = boxes().select([0]).transform(OPTICAL_FROM_EGO, "Camera_Front"), image_axes(), "#303030"
    ax.set_facecolor(dark)
    assert draw_boxes_in_image(seen, CAMERA, ax, [dark], linestyle="--").tolist() == [True]
    picture = rendered(ax, 200)
    middle = CAMERA.project(seen.corners()[:, :2].mean(axis=1))[0]  # of an edge
    assert has_color(picture, on_canvas(ax, middle)[0], "#979797", within=6, tolerance=30)


def test_a_line_leads_to_the_front_and_each_box_has_its_colour() -> None:
    drawn, ax = boxes(), new_axes()
    draw_boxes_from_above(drawn, ax, ["#ff0000", "#00ff00", "#0000ff"], linestyle="dashed", fill=0.5)
    outlines, headings = ax.collections
    assert isinstance(outlines, PolyCollection)
    assert isinstance(headings, LineCollection)
    assert_allclose(outlines.get_edgecolor(), [[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]])
    assert_allclose(outlines.get_facecolor()[:, 3], 0.5)
    assert outlines.get_linestyle()[0][1] is not None
    for box, line in zip(range(3), headings.get_segments(), strict=True):
        ahead = np.array([np.cos(drawn.yaw[box]), np.sin(drawn.yaw[box])])
        assert_allclose(line, [drawn.center[box, :2], drawn.center[box, :2] + ahead * drawn.size[box, 0] / 2])


def test_one_box_is_drawn_in_its_category_s_colour_or_the_one_given() -> None:
    box, ax = Box(boxes().select([1])), new_axes()
    assert draw_box(box, ax) is ax
    with pytest.raises(GeometryError, match=r"box: expected a Box, found Axes; .*: draw_box\(box, ax\)"):
        draw_box(ax, box)  # type: ignore[arg-type]
    draw_box(box, ax, RED)
    first, second = ax.collections[0], ax.collections[2]
    assert_allclose(first.get_paths()[0].vertices[:4], box.bottom_corners()[:2].T)
    assert to_hex(first) == CATEGORY_COLORS["truck"]
    assert to_hex(second) == RED


def to_hex(collection: Any) -> str:
    from matplotlib.colors import to_hex as hexed

    return hexed(collection.get_edgecolor()[0])


def test_edges_are_cut_off_before_the_camera() -> None:
    segments = np.array(
        [
            [[0.0, 0, 1.1], [0, 1, -0.9]],
            [[0, 0, -1], [0, 0, -2]],
            [[1, 1, 2], [1, 1, 4]],
            [[0, 1, -0.9], [0, 0, 1.1]],
        ]
    )
    pixels, drawn = segments_in_image(segments, CAMERA)
    assert drawn.tolist() == [True, False, True, True]
    cut = CAMERA.project(np.array([[0, 0.5, NEAREST_DRAWN]]))[0][0]
    assert_allclose(pixels[0], [[200, 150], cut])
    assert_allclose(pixels[1], [[300, 250], [250, 200]])
    assert_allclose(pixels[2], pixels[0][::-1])
    assert segments[0, 1, 2] == -0.9


def test_a_box_about_the_camera_is_drawn_as_far_as_it_lies_before_it() -> None:
    around, ax = boxes(center=[[0.0, 0, 0]] * 3).transform(OPTICAL_FROM_EGO, "Camera_Front"), image_axes()
    draw_boxes_in_image(around, CAMERA, ax, [RED] * 3)
    edges, fronts = ax.collections
    assert np.isfinite(np.concatenate(edges.get_segments())).all()
    assert 0 < len(edges.get_segments()) < 3 * 12
    assert len(fronts.get_paths()) < 3


@pytest.mark.parametrize("draw", [draw_boxes_from_above, draw_velocities_from_above, draw_ids_from_above])
def test_no_box_at_all_draws_nothing_from_above(draw: Any) -> None:
    ax = new_axes()
    draw(boxes().select([]), ax, [])
    rendered(ax)
    assert sum(len(one.get_paths()) for one in ax.collections) + len(ax.texts) == 0


@pytest.mark.parametrize("draw", [draw_boxes_in_image, draw_velocities_in_image, draw_ids_in_image])
def test_no_box_at_all_draws_nothing_in_an_image(draw: Any) -> None:
    ax = image_axes()
    draw(boxes().select([]).transform(OPTICAL_FROM_EGO, "Camera_Front"), CAMERA, ax, [])
    rendered(ax)
    assert sum(len(one.get_paths()) for one in ax.collections) + len(ax.texts) == 0


def test_tracked_boxes_have_their_ids_beside_them() -> None:
    ax = new_axes()
    draw_ids_from_above(boxes(), ax, [RED] * 3)
    assert [(one.get_text(), one.xy) for one in ax.texts] == [("7", (12, -2)), ("own", (0, 0))]
    assert all(one.get_fontsize() >= 7 for one in ax.texts)


def test_in_an_image_ids_stand_above_what_is_before_the_camera() -> None:
    ax = image_axes()
    seen = boxes(center=[[12.0, -2, 0], [20, 9, 1], [-5, 0, 0]]).transform(OPTICAL_FROM_EGO, "Camera_Front")
    draw_ids_in_image(seen, CAMERA, ax, [RED] * 3)
    assert [one.get_text() for one in ax.texts] == ["7"]
    top = np.array([[12.0, -2, 0.75]])
    assert_allclose(ax.texts[0].xy, CAMERA.project(OPTICAL_FROM_EGO.apply(top))[0][0])


def test_velocities_are_arrows_of_a_second_where_they_are_known_and_not_zero() -> None:
    ax = new_axes()
    draw_velocities_from_above(boxes(), ax, [RED, "blue", "blue"])
    (arrows,) = ax.collections
    assert isinstance(arrows, Quiver)
    assert_allclose(np.column_stack([arrows.XY, arrows.U, arrows.V]), [[12, -2, 3, 1]])
    assert_allclose(arrows.get_facecolor(), [[0xE6 / 255, 0, 0x26 / 255, 1]])


def test_small_actors_have_a_mark_of_their_class() -> None:
    ax = new_axes()
    small = boxes(category=["pedestrian", "car", "cyclist"])
    draw_boxes_from_above(small, ax, [RED, RED, CATEGORY_COLORS["cyclist"]])
    marks = {line.get_marker(): (tuple(line.get_xydata()[0]), line.get_markerfacecolor()) for line in ax.lines}
    first, last = (tuple(small.center[row, :2]) for row in (0, 2))
    assert marks == {"o": (first, RED), "D": (last, CATEGORY_COLORS["cyclist"])}
    assert all(line.get_markersize() >= 6 for line in ax.lines)
    hidden = new_axes()
    draw_boxes_from_above(small, hidden, [RED] * 3, fill=0)
    assert {line.get_markerfacecolor() for line in hidden.lines} == {"none"}


def test_velocities_in_an_image_lead_to_where_the_centre_would_be() -> None:
    ax = image_axes()
    draw_velocities_in_image(boxes().transform(OPTICAL_FROM_EGO, "Camera_Front"), CAMERA, ax, [RED] * 3)
    places = OPTICAL_FROM_EGO.apply(np.array([[12.0, -2, 0], [15, -1, 0]]))
    assert_allclose(ax.collections[0].get_segments(), [CAMERA.project(places)[0]])


def test_a_box_beside_the_camera_is_cut_off_at_the_camera() -> None:
    # 2 m to the right, from 4 m behind the camera to 4 m before it; its front looks at the camera
    standing = Boxes.from_arrays([[0.0, -3, 0], [-9, -3, 0]], [[2.0, 8, 1]] * 2, [np.pi / 2] * 2, frame="ego")
    both = standing.transform(OPTICAL_FROM_EGO, "Camera_Front")
    assert_allclose(bounds_in_image(both, CAMERA)[0], [200 + 200 * 2 / 4, 0, 400, 300])
    ax = new_axes()
    assert draw_boxes_in_image(both, CAMERA, ax, [RED, RED]).tolist() == [True, False]
    (front,) = next(each for each in ax.collections if isinstance(each, PolyCollection)).get_paths()
    reach = front.vertices[:, 0].min(), front.vertices[:, 0].max()
    assert reach == pytest.approx((300, 200 + 200 * 2 / NEAREST_DRAWN))


def test_the_pair_is_red_other_recorders_have_hues_and_the_rest_shades(da: DeepAccident, approach: str) -> None:
    boxes = da.boxes(approach, "ego")
    colors = dict(zip(boxes.actor_id.tolist(), role_colors(da, approach, boxes), strict=True))
    scenario = da.get("scenario", approach.rsplit("/", 2)[0])
    agents = {name: da.get("agent", f"{scenario['token']}/{name}")["actor_id"] for name in AGENTS[:4]}
    assert colors[OWN_ACTOR_ID] == COLLIDER_COLOR
    assert {actor for actor, color in colors.items() if color == COLLIDER_COLOR} == {
        OWN_ACTOR_ID,
        agents["other_vehicle"],
    }
    labels = {**agents, "ego_vehicle": OWN_ACTOR_ID}
    assert recorder_ids(da, approach) == {actor: agent for agent, actor in labels.items()}
    for agent in ("ego_vehicle_behind", "other_vehicle_behind"):
        assert colors.get(agents[agent], AGENT_COLORS[agent]) == AGENT_COLORS[agent]
    assert colors.keys() & {agents["ego_vehicle_behind"], agents["other_vehicle_behind"]}
    for actor, category, color in zip(
        boxes.actor_id.tolist(), boxes.category_names, role_colors(da, approach, boxes), strict=True
    ):
        if actor not in {OWN_ACTOR_ID, *agents.values()}:
            assert color == CATEGORY_COLORS[category]


def test_an_agent_has_its_part_s_colour_in_its_own_label_and_in_the_union(da: DeepAccident, approach: str) -> None:
    sample = approach.replace("ego_vehicle/", "ego_vehicle_behind/")
    own = da.boxes(sample, "ego")
    own = own.select(own.actor_id == OWN_ACTOR_ID)
    assert role_colors(da, sample, own) == [AGENT_COLORS["ego_vehicle_behind"]]
    union = cooperative_boxes(da, approach, frame="ego")
    colors = dict(zip(union.actor_id.tolist(), role_colors(da, approach, union), strict=True))
    pair = set(da.get("scenario", approach.rsplit("/", 2)[0])["collision"]["ids"])
    assert {actor for actor, color in colors.items() if color == COLLIDER_COLOR} == pair
