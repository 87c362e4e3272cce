"""Boxes are drawn where geometry says, from above and in images."""

from typing import Any

import numpy as np
import pytest
from drawing import has_color, new_axes, of_kind, on_canvas, rendered
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.quiver import Quiver
from refusals import assert_refused

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
    return Boxes.from_arrays(
        given.pop("center"), given.pop("size"), given.pop("yaw"), frame=frame, **given
    )


def image_axes() -> Any:
    ax = new_axes((8, 6))
    ax.set(xlim=(0, CAMERA.width), ylim=(CAMERA.height, 0), aspect="equal")
    return ax


def in_front(boxes: Boxes) -> Boxes:
    return boxes.transform(OPTICAL_FROM_EGO, "Camera_Front")


def test_from_above_the_outline_passes_within_two_pixels_of_the_corners() -> None:
    drawn, ax = boxes(), new_axes()
    ax.set(xlim=(-10, 30), ylim=(-15, 25), aspect="equal")
    draw_boxes_from_above(drawn, ax, [RED] * 3)
    picture, corners = rendered(ax), drawn.bottom_corners()[..., :2]
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    on, off = np.concatenate([corners, middles]).reshape(-1, 2), drawn.center[:, :2] - (0.0, 6.0)
    found = [
        [has_color(picture, place, RED) for place in on_canvas(ax, places)] for places in (on, off)
    ]
    assert found == [[True] * len(on), [False] * len(off)]


def test_in_an_image_the_edges_pass_within_two_pixels_of_the_projected_corners() -> None:
    seen, ax = in_front(boxes().select([0, 1])), image_axes()
    draw_boxes_in_image(seen, CAMERA, ax, [RED, RED])
    picture = rendered(ax)
    pixels, _ = CAMERA.project(seen.corners().reshape(-1, 3))
    assert CAMERA.in_image(pixels).all()
    found = [has_color(picture, place, RED) for place in on_canvas(ax, [*pixels, [200, 290]])]
    assert found == [*[True] * len(pixels), False]


def test_a_line_leads_to_the_front_and_each_box_has_its_colour() -> None:
    drawn, ax = boxes(), new_axes()
    draw_boxes_from_above(
        drawn, ax, ["#ff0000", "#00ff00", "#0000ff"], linestyle="dashed", fill=0.5
    )
    outlines, headings = ax.collections
    np.testing.assert_allclose(outlines.get_edgecolor(), [[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]])
    ahead = np.column_stack([np.cos(drawn.yaw), np.sin(drawn.yaw)]) * drawn.size[:, :1] / 2
    centers = drawn.center[:, :2]
    np.testing.assert_allclose(
        headings.get_segments(), np.stack([centers, centers + ahead], axis=1)
    )


def test_one_box_is_drawn_in_its_category_s_colour_or_the_one_given() -> None:
    box, ax = Box(boxes().select([1])), new_axes()
    assert draw_box(box, ax) is ax
    assert_refused(
        (lambda: draw_box(ax, box), GeometryError, ("box", "found Axes", "draw_box(box, ax)"))
    )  # type: ignore[arg-type]
    draw_box(box, ax, RED)
    first, second = ax.collections[0], ax.collections[2]
    np.testing.assert_allclose(first.get_paths()[0].vertices[:4], box.bottom_corners()[:2].T)
    assert [to_hex(each.get_edgecolor()[0]) for each in (first, second)] == [
        CATEGORY_COLORS["truck"],
        RED,
    ]


def test_edges_are_cut_off_before_the_camera() -> None:
    through, behind, before = (
        [[0.0, 0, 1.1], [0, 1, -0.9]],
        [[0.0, 0, -1], [0, 0, -2]],
        [[1.0, 1, 2], [1, 1, 4]],
    )
    segments = np.array([through, behind, before, through[::-1]])
    pixels, drawn = segments_in_image(segments, CAMERA)
    assert drawn.tolist() == [True, False, True, True]
    cut = CAMERA.project(np.array([[0, 0.5, NEAR_PLANE_M]]))[0][0]
    np.testing.assert_allclose(
        pixels, [[[200, 150], cut], [[300, 250], [250, 200]], [cut, [200, 150]]]
    )
    assert segments[0, 1, 2] == -0.9


ABOVE = (draw_boxes_from_above, draw_velocities_from_above, draw_ids_from_above)


@pytest.mark.parametrize(
    "draw", [*ABOVE, draw_boxes_in_image, draw_velocities_in_image, draw_ids_in_image]
)
def test_no_box_at_all_draws_nothing(draw: Any) -> None:
    ax, none = image_axes(), boxes().select([])
    draw(*((none, ax) if draw in ABOVE else (in_front(none), CAMERA, ax)), [])
    rendered(ax)
    assert sum(len(one.get_paths()) for one in ax.collections) + len(ax.texts) == 0


def test_tracked_boxes_have_their_ids_beside_them() -> None:
    ax = new_axes()
    draw_ids_from_above(boxes(), ax, [RED] * 3)
    assert [(one.get_text(), one.xy) for one in ax.texts] == [("7", (12, -2)), ("own", (0, 0))]


def test_in_an_image_ids_stand_above_what_is_before_the_camera() -> None:
    ax = image_axes()
    draw_ids_in_image(
        in_front(boxes(center=[[12.0, -2, 0], [20, 9, 1], [-5, 0, 0]])), CAMERA, ax, [RED] * 3
    )
    (text,) = ax.texts
    top = CAMERA.project(OPTICAL_FROM_EGO.apply(np.array([[12.0, -2, 0.75]])))[0][0]
    assert (text.get_text(), text.xy) == ("7", pytest.approx(tuple(top)))


def test_velocities_are_arrows_of_a_second_where_they_are_known_and_not_zero() -> None:
    ax = new_axes()
    draw_velocities_from_above(boxes(), ax, [RED, "blue", "blue"])
    (arrows,) = of_kind(ax, Quiver)
    np.testing.assert_allclose(np.column_stack([arrows.XY, arrows.U, arrows.V]), [[12, -2, 3, 1]])
    assert to_hex(arrows.get_facecolor()[0]) == RED


def test_small_actors_have_a_mark_of_their_class() -> None:
    ax, hidden = new_axes(), new_axes()
    small = boxes(category=["pedestrian", "car", "cyclist"])
    draw_boxes_from_above(small, ax, [RED, RED, CATEGORY_COLORS["cyclist"]])
    draw_boxes_from_above(small, hidden, [RED] * 3, fill=0)
    marks = ax.collections[-1]
    corners = [path.vertices[:-1] for path in marks.get_paths()]
    assert ([*map(len, corners)], [*map(to_hex, marks.get_facecolor())]) == (
        [16, 4],
        [RED, CATEGORY_COLORS["cyclist"]],
    )
    np.testing.assert_allclose(
        [each.mean(axis=0) for each in corners], small.center[[0, 2], :2], atol=1e-9
    )
    assert len(hidden.collections[-1].get_facecolor()) == 0


def test_velocities_in_an_image_lead_to_where_the_centre_would_be() -> None:
    ax = image_axes()
    draw_velocities_in_image(in_front(boxes()), CAMERA, ax, [RED] * 3)
    places = OPTICAL_FROM_EGO.apply(np.array([[12.0, -2, 0], [15, -1, 0]]))
    np.testing.assert_allclose(ax.collections[0].get_segments(), [CAMERA.project(places)[0]])


def test_a_box_beside_the_camera_is_cut_off_at_the_camera() -> None:
    # 2 m to the right, from 4 m behind the camera to 4 m before it; its front looks at the camera
    both = in_front(
        Boxes.from_arrays(
            [[0.0, -3, 0], [-9, -3, 0]], [[2.0, 8, 1]] * 2, [np.pi / 2] * 2, frame="ego"
        )
    )
    np.testing.assert_allclose(bounds_in_image(both, CAMERA)[0], [200 + 200 * 2 / 4, 0, 400, 300])
    ax = new_axes()
    assert draw_boxes_in_image(both, CAMERA, ax, [RED, RED]).tolist() == [True, False]
    (front,) = next(each for each in ax.collections if isinstance(each, PolyCollection)).get_paths()
    across = front.vertices[:, 0]
    assert (across.min(), across.max()) == pytest.approx((300, 200 + 200 * 2 / NEAR_PLANE_M))


def test_the_pair_is_red_other_recorders_have_hues_and_the_rest_shades(
    da: DeepAccident, approach: str
) -> None:
    boxes, scenario = da.boxes(approach, "ego"), approach.rsplit("/", 2)[0]
    agents = {name: da.get("agent", f"{scenario}/{name}")["actor_id"] for name in AGENTS[:4]}
    recorders = {
        **{actor: name for name, actor in agents.items() if name != "ego_vehicle"},
        OWN_ACTOR_ID: "ego_vehicle",
    }
    assert recorder_ids(da, approach) == recorders
    hues = {
        agents[name]: AGENT_COLORS[name] for name in ("ego_vehicle_behind", "other_vehicle_behind")
    }
    hues |= dict.fromkeys((OWN_ACTOR_ID, agents["other_vehicle"]), COLLIDER_COLOR)
    actors = [*zip(boxes.actor_id.tolist(), boxes.category_names, strict=True)]
    assert role_colors(da, approach, boxes) == [
        hues.get(actor, CATEGORY_COLORS[name]) for actor, name in actors
    ]
    assert len(hues.keys() & {actor for actor, _ in actors}) > 2
    with style(color_by="class"):
        by_class = role_colors(da, approach, boxes)
    red = {actor: color for actor, color in hues.items() if color == COLLIDER_COLOR}
    assert by_class == [red.get(actor, CLASS_COLORS[name]) for actor, name in actors]
