"""Sensor files as pictures: images with boxes where the camera sees them, the others from above."""

from typing import Any

import numpy as np
import pytest
from drawing import footprints, has_color, new_axes, of_kind, on_canvas, rendered
from matplotlib import colormaps
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render import render_pointcloud_in_image, render_sample_data
from deepaccident_devkit.render.camera import best_view, crop_about
from deepaccident_devkit.render.hidden import hiding
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    COLLIDER_COLOR,
    DEPTH_COLORMAP,
    HEIGHT_COLORMAP,
)
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from deepaccident_devkit.v2x import map_pointcloud_to_image, project_to_image
from deepaccident_devkit.v2x.poses import camera_of


def test_the_box_of_a_collider_passes_within_two_pixels_of_its_corners(
    da: DeepAccident, behind: str
) -> None:
    ax = render_sample_data(da, f"{behind}/Camera_Front", layers=["boxes"], ax=new_axes((8, 4.5)))
    picture, (pixels, seen) = rendered(ax), corners_of_ego(da, behind)
    assert seen.sum() >= 4
    assert {has_color(picture, place, COLLIDER_COLOR) for place in on_canvas(ax, pixels[seen])} == {
        True
    }


def corners_of_ego(da: DeepAccident, behind: str) -> Any:
    """The corners of the ego's box in the front camera of who drives behind it, pixels, and which
    are in the image.
    """
    boxes, camera = da.boxes(behind, "Camera_Front"), camera_of(da, f"{behind}/Camera_Front")
    ego = da.get("agent", f"{behind.rsplit('/', 2)[0]}/ego_vehicle")["actor_id"]
    pixels, _ = camera.project(boxes.corners()[boxes.actor_id == ego][0])
    return pixels, camera.in_image(pixels)


def test_the_image_fills_the_pixels_of_its_calibration(da: DeepAccident, behind: str) -> None:
    ax = render_sample_data(da, f"{behind}/Camera_Front", ax=new_axes())
    (image,) = ax.images
    np.testing.assert_array_equal(image.get_array(), da.load_image(f"{behind}/Camera_Front"))
    assert (tuple(image.get_extent()), ax.get_xlim(), ax.get_ylim()) == (
        (0, 64, 36, 0),
        (0, 64),
        (36, 0),
    )


def test_boxes_are_those_a_camera_of_the_agent_sees_but_its_own(
    da: DeepAccident, behind: str
) -> None:
    ax = render_sample_data(da, f"{behind}/Camera_Back", layers="boxes", ax=new_axes())  # type: ignore[arg-type]
    boxes = da.boxes(behind, "Camera_Back", visible="camera")
    before = boxes.corners()[boxes.actor_id != OWN_ACTOR_ID][..., 2] >= 0.1
    whole, partly = before.all(axis=1).sum(), before.any(axis=1).sum()
    assert 0 < 12 * whole <= len(of_kind(ax, LineCollection)[0].get_segments()) <= 12 * partly


def test_points_have_the_colour_of_their_depth(da: DeepAccident, behind: str) -> None:
    ax = render_sample_data(da, f"{behind}/Camera_Front", layers=["points"], ax=new_axes())
    rendered(ax)
    (drawn,) = ax.collections
    points = map_pointcloud_to_image(da, f"{behind}/Camera_Front", colors=False)
    depths = np.asarray(drawn.get_array())
    shown = np.column_stack([drawn.get_offsets(), depths]).tolist()
    assert {*map(tuple, shown)} <= {
        *map(tuple, np.column_stack([points.pixels, points.depth]).tolist())
    }
    assert len(depths) == points.mask.sum() > 50
    assert (np.diff(depths) <= 0).all()
    np.testing.assert_allclose(drawn.get_facecolor(), colormaps[DEPTH_COLORMAP](depths / 50))


@pytest.mark.parametrize(
    ("channel", "frame"), [("lidar01", "lidar"), ("BEV_instance_camera", "ego")]
)
def test_the_other_sensors_are_drawn_from_above_in_their_frame(
    da: DeepAccident, behind: str, channel: str, frame: str
) -> None:
    ax, boxes = (
        render_sample_data(da, f"{behind}/{channel}", ax=new_axes()),
        da.boxes(behind, frame),
    )
    center = np.mean([ax.get_xlim(), ax.get_ylim()], axis=1)
    near = boxes.select((np.abs(boxes.center[:, :2] - center) < 55).all(axis=1))
    assert footprints(of_kind(ax, PolyCollection)[0]) == footprints(near)
    assert (len(of_kind(ax, PathCollection)), len(ax.images)) == (
        (1, 0) if channel == "lidar01" else (0, 1)
    )


def test_points_of_another_agent_lie_in_the_image_where_they_project(
    da: DeepAccident, behind: str
) -> None:
    camera, pole = f"{behind}/Camera_Front", behind.replace("ego_vehicle_behind", "infrastructure")
    ax = render_pointcloud_in_image(da, camera, pole, color_by="height", ax=new_axes())
    rendered(ax)
    drawn, cloud = ax.collections[0], da.load_point_cloud(pole, "world")
    points = hiding(da, camera)(project_to_image(da, cloud, pole, camera, colors=False))
    height = da.world_from(behind, "ego").inverse().apply(cloud.xyz)[:, 2]
    order = np.flatnonzero(points.mask)[np.argsort(-points.depth[points.mask])]
    assert len(order) > 20
    np.testing.assert_allclose(drawn.get_offsets(), points.pixels[order])
    np.testing.assert_allclose(drawn.get_array(), height[order])
    assert drawn.get_cmap().name == HEIGHT_COLORMAP


def test_by_agent_all_points_of_the_moment_have_their_agents_colours(
    da: DeepAccident, behind: str
) -> None:
    every, alone = (
        render_pointcloud_in_image(
            da, f"{behind}/Camera_Front", sample, color_by="agent", ax=new_axes()
        )
        for sample in (None, behind)
    )
    colors = [[to_hex(one.get_facecolor()[0]) for one in ax.collections] for ax in (every, alone)]
    assert colors == [list(AGENT_COLORS.values()), [AGENT_COLORS["ego_vehicle_behind"]]]


def test_points_are_rendered_in_images_alone(da: DeepAccident, behind: str) -> None:
    lidar = f"{behind}/lidar01"
    assert_refused(
        (lambda: render_pointcloud_in_image(da, lidar), ChoiceError, ("camera", "Camera_Front"))
    )


def test_the_best_view_of_the_vehicle_ahead_is_the_front_camera(
    da: DeepAccident, behind: str
) -> None:
    boxes, ego = (
        da.boxes(behind, "world"),
        da.get("agent", f"{behind.rsplit('/', 2)[0]}/ego_vehicle")["actor_id"],
    )
    view = best_view(da, [behind], boxes.select(boxes.actor_id == ego))
    pixels, _ = corners_of_ego(da, behind)
    low, high = pixels.min(axis=0).clip(0, (64, 36)), pixels.max(axis=0).clip(0, (64, 36))
    assert view.camera == f"{behind}/Camera_Front"
    np.testing.assert_allclose([*view.bounds, view.area], [*low, *high, np.prod(high - low)])


def test_what_no_camera_sees_has_no_best_view(da: DeepAccident, behind: str) -> None:
    boxes = da.boxes(behind, "world")
    assert best_view(da, [behind], boxes.select(boxes.actor_id == OWN_ACTOR_ID)) is None


@pytest.mark.parametrize(
    "bounds", [(10.0, 10, 14, 12), (0.0, 0, 5, 5), (0.0, 0, 64, 36), (60.0, 30, 64, 36)]
)
def test_a_crop_has_the_image_s_shape_holds_the_bounds_and_stays_inside(bounds: Any) -> None:
    left, top, right, bottom = crop_about(bounds, width=64, height=36)
    assert (right - left) / (bottom - top) == pytest.approx(64 / 36)
    assert 0 <= left <= bounds[0] < bounds[2] <= right <= 64
    assert 0 <= top <= bounds[1] < bounds[3] <= bottom <= 36
