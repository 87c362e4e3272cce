"""Boxes are drawn where geometry puts them, from above and in images."""

from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.quiver import Quiver
from support.expected_errors import assert_raises
from support.rendered_pixels import (
    canvas_positions,
    collections_of_kind,
    has_color,
    new_axes,
    render_canvas,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, Box, Boxes, PinholeCamera
from deepaccident_devkit.render import draw_box
from deepaccident_devkit.render.boxes import (
    NEAR_PLANE_M,
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
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    CATEGORY_COLORS,
    CLASS_COLORS,
    COLLIDER_COLOR,
    style,
)
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID

RED = "#e60026"
CAMERA = PinholeCamera.from_field_of_view(400, 300, np.pi / 2)
OPTICAL_FROM_EGO = SE3(np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]))
"""A camera at the origin that looks along x."""


def make_boxes(frame: str = "ego", **columns: Any) -> Boxes:
    """Make a turned car in front, a truck to the left, and the car that the agent drives itself."""
    columns = {
        "center": [[12.0, -2, 0], [20, 9, 1], [0, 0, 0]],
        "size": [[4.5, 1.9, 1.5], [9, 2.5, 3.5], [4, 2, 1.5]],
        "yaw": [0.4, -2.0, 0],
        "category": ["car", "truck", "car"],
        "actor_id": [7, -1, -100],
        "velocity": [[3.0, 1, 0], [0, 0, 0], [np.nan, np.nan, np.nan]],
        **columns,
    }
    center, size, yaw = (columns.pop(name) for name in ("center", "size", "yaw"))
    return Boxes.from_arrays(center, size, yaw, frame=frame, **columns)


def image_axes() -> Any:
    """Make axes that show the pixels of `CAMERA`."""
    ax = new_axes((8, 6))
    ax.set(xlim=(0, CAMERA.width), ylim=(CAMERA.height, 0), aspect="equal")
    return ax


def to_camera_frame(boxes: Boxes) -> Boxes:
    return boxes.transform(OPTICAL_FROM_EGO, "Camera_Front")


def are_red(ax: Any, points: Any) -> list[bool]:
    """Return for each point in data coordinates whether a line on the axes is red there."""
    canvas = render_canvas(ax)
    return [has_color(canvas, position, RED) for position in canvas_positions(ax, points)]


def test_from_above_the_outline_passes_within_two_pixels_of_the_corners() -> None:
    boxes = make_boxes()
    ax = new_axes()
    ax.set(xlim=(-10, 30), ylim=(-15, 25), aspect="equal")

    draw_boxes_from_above(boxes, ax, [RED] * 3)

    corners = boxes.bottom_corners()[..., :2]
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    on_outline = np.concatenate([corners, middles]).reshape(-1, 2)
    off_outline = boxes.center[:, :2] - (0.0, 6.0)
    assert are_red(ax, on_outline) == [True] * len(on_outline)
    assert are_red(ax, off_outline) == [False] * len(off_outline)


def test_in_an_image_the_edges_pass_within_two_pixels_of_the_projected_corners() -> None:
    boxes = to_camera_frame(make_boxes().select([0, 1]))
    ax = image_axes()

    draw_boxes_in_image(boxes, CAMERA, ax, [RED, RED])

    pixels, _ = CAMERA.project(boxes.corners().reshape(-1, 3))
    assert CAMERA.in_image(pixels).all()
    beside_boxes = [200, 290]
    assert are_red(ax, [*pixels, beside_boxes]) == [*[True] * len(pixels), False]


def test_a_line_leads_to_the_front_and_each_box_has_its_colour() -> None:
    boxes = make_boxes()
    ax = new_axes()
    colors = ["#ff0000", "#00ff00", "#0000ff"]

    draw_boxes_from_above(boxes, ax, colors, linestyle="dashed", fill=0.5)

    outlines, headings = ax.collections
    np.testing.assert_allclose(outlines.get_edgecolor(), [[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]])
    directions = np.column_stack([np.cos(boxes.yaw), np.sin(boxes.yaw)])
    centers = boxes.center[:, :2]
    fronts = centers + directions * boxes.size[:, :1] / 2
    np.testing.assert_allclose(headings.get_segments(), np.stack([centers, fronts], axis=1))


def test_one_box_is_drawn_in_its_category_s_colour_or_the_one_given() -> None:
    box = Box(make_boxes().select([1]))
    ax = new_axes()
    assert draw_box(box, ax) is ax
    assert_raises(
        (lambda: draw_box(ax, box), GeometryError, ("box", "found Axes", "draw_box(box, ax)"))
    )  # type: ignore[arg-type]
    draw_box(box, ax, RED)

    first, second = ax.collections[0], ax.collections[2]
    np.testing.assert_allclose(first.get_paths()[0].vertices[:4], box.bottom_corners()[:2].T)
    assert to_hex(first.get_edgecolor()[0]) == CATEGORY_COLORS["truck"]
    assert to_hex(second.get_edgecolor()[0]) == RED


def test_edges_are_cut_off_before_the_camera() -> None:
    crossing = [[0.0, 0, 1.1], [0, 1, -0.9]]
    behind = [[0.0, 0, -1], [0, 0, -2]]
    ahead = [[1.0, 1, 2], [1, 1, 4]]
    segments = np.array([crossing, behind, ahead, crossing[::-1]])

    pixels, drawn = segments_in_image(segments, CAMERA)

    assert drawn.tolist() == [True, False, True, True]
    cut = CAMERA.project(np.array([[0, 0.5, NEAR_PLANE_M]]))[0][0]
    np.testing.assert_allclose(
        pixels,
        [
            [[200, 150], cut],
            [[300, 250], [250, 200]],
            [cut, [200, 150]],
        ],
    )
    assert segments[0, 1, 2] == -0.9


FROM_ABOVE = (draw_boxes_from_above, draw_velocities_from_above, draw_ids_from_above)


@pytest.mark.parametrize(
    "draw", [*FROM_ABOVE, draw_boxes_in_image, draw_velocities_in_image, draw_ids_in_image]
)
def test_no_box_at_all_draws_nothing(draw: Any) -> None:
    ax = image_axes()
    no_boxes = make_boxes().select([])

    if draw in FROM_ABOVE:
        draw(no_boxes, ax, [])
    else:
        draw(to_camera_frame(no_boxes), CAMERA, ax, [])

    render_canvas(ax)
    assert sum(len(shape.get_paths()) for shape in ax.collections) + len(ax.texts) == 0


def test_tracked_boxes_have_their_ids_beside_them() -> None:
    ax = new_axes()
    draw_ids_from_above(make_boxes(), ax, [RED] * 3)
    labels = [(text.get_text(), text.xy) for text in ax.texts]
    assert labels == [("7", (12, -2)), ("own", (0, 0))]


def test_in_an_image_ids_stand_above_the_boxes_before_the_camera() -> None:
    ax = image_axes()
    boxes = make_boxes(center=[[12.0, -2, 0], [20, 9, 1], [-5, 0, 0]])
    draw_ids_in_image(to_camera_frame(boxes), CAMERA, ax, [RED] * 3)

    (text,) = ax.texts
    top = OPTICAL_FROM_EGO.apply(np.array([[12.0, -2, 0.75]]))
    pixels, _ = CAMERA.project(top)
    assert (text.get_text(), text.xy) == ("7", pytest.approx(tuple(pixels[0])))


def test_velocities_are_arrows_of_a_second_where_they_are_known_and_not_zero() -> None:
    ax = new_axes()
    draw_velocities_from_above(make_boxes(), ax, [RED, "blue", "blue"])
    (arrows,) = collections_of_kind(ax, Quiver)
    np.testing.assert_allclose(np.column_stack([arrows.XY, arrows.U, arrows.V]), [[12, -2, 3, 1]])
    assert to_hex(arrows.get_facecolor()[0]) == RED


def test_small_actors_have_a_mark_of_their_class() -> None:
    ax = new_axes()
    unfilled_ax = new_axes()
    boxes = make_boxes(category=["pedestrian", "car", "cyclist"])

    draw_boxes_from_above(boxes, ax, [RED, RED, CATEGORY_COLORS["cyclist"]])
    draw_boxes_from_above(boxes, unfilled_ax, [RED] * 3, fill=0)

    marks = ax.collections[-1]
    corners = [path.vertices[:-1] for path in marks.get_paths()]
    assert [*map(len, corners)] == [16, 4]
    assert [*map(to_hex, marks.get_facecolor())] == [RED, CATEGORY_COLORS["cyclist"]]
    mark_centers = [mark_corners.mean(axis=0) for mark_corners in corners]
    np.testing.assert_allclose(mark_centers, boxes.center[[0, 2], :2], atol=1e-9)
    assert len(unfilled_ax.collections[-1].get_facecolor()) == 0


def test_velocities_in_an_image_lead_to_where_the_centre_would_be() -> None:
    ax = image_axes()
    draw_velocities_in_image(to_camera_frame(make_boxes()), CAMERA, ax, [RED] * 3)

    now_and_later = OPTICAL_FROM_EGO.apply(np.array([[12.0, -2, 0], [15, -1, 0]]))
    pixels, _ = CAMERA.project(now_and_later)
    np.testing.assert_allclose(ax.collections[0].get_segments(), [pixels])


def test_a_box_beside_the_camera_is_cut_off_at_the_camera() -> None:
    # 2 m to the right, from 4 m behind the camera to 4 m before it; its front looks at the camera
    centers = [[0.0, -3, 0], [-9, -3, 0]]
    sizes = [[2.0, 8, 1]] * 2
    yaws = [np.pi / 2] * 2
    boxes = to_camera_frame(Boxes.from_arrays(centers, sizes, yaws, frame="ego"))
    np.testing.assert_allclose(bounds_in_image(boxes, CAMERA)[0], [200 + 200 * 2 / 4, 0, 400, 300])

    ax = new_axes()
    assert draw_boxes_in_image(boxes, CAMERA, ax, [RED, RED]).tolist() == [True, False]

    polygons = next(shape for shape in ax.collections if isinstance(shape, PolyCollection))
    (front,) = polygons.get_paths()
    columns = front.vertices[:, 0]
    assert (columns.min(), columns.max()) == pytest.approx((300, 200 + 200 * 2 / NEAR_PLANE_M))


def test_the_pair_is_red_other_recorders_have_hues_and_the_rest_shades(
    da: DeepAccident, approach_sample: str
) -> None:
    boxes = da.boxes(approach_sample, "ego")
    scenario = approach_sample.rsplit("/", 2)[0]
    agents = {name: da.get("agent", f"{scenario}/{name}")["actor_id"] for name in AGENTS[:4]}
    recorders = {actor_id: name for name, actor_id in agents.items() if name != "ego_vehicle"}
    recorders[OWN_ACTOR_ID] = "ego_vehicle"
    assert recorder_ids(da, approach_sample) == recorders

    pair_colors = dict.fromkeys((OWN_ACTOR_ID, agents["other_vehicle"]), COLLIDER_COLOR)
    followers = ("ego_vehicle_behind", "other_vehicle_behind")
    hues = {agents[name]: AGENT_COLORS[name] for name in followers} | pair_colors
    actors = [*zip(boxes.actor_id.tolist(), boxes.category_names, strict=True)]
    assert role_colors(da, approach_sample, boxes) == [
        hues.get(actor_id, CATEGORY_COLORS[category]) for actor_id, category in actors
    ]
    assert len(hues.keys() & {actor_id for actor_id, _ in actors}) > 2

    with style(color_by="class"):
        colors_by_class = role_colors(da, approach_sample, boxes)
    assert colors_by_class == [
        pair_colors.get(actor_id, CLASS_COLORS[category]) for actor_id, category in actors
    ]
