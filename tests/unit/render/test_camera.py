"""Sensor files as pictures: images with the boxes that the camera sees, the others from above."""

from typing import Any

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex
from support.expected_errors import assert_raises
from support.rendered_pixels import (
    box_footprints,
    canvas_positions,
    collections_of_kind,
    has_color,
    new_axes,
    render_canvas,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render import render_pointcloud_in_image, render_sample_data
from deepaccident_devkit.render.camera import best_view, crop_about
from deepaccident_devkit.render.hidden import hidden_points_filter
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
    da: DeepAccident, follower_sample: str
) -> None:
    camera = f"{follower_sample}/Camera_Front"
    ax = render_sample_data(da, camera, layers=["boxes"], ax=new_axes((8, 4.5)))
    canvas = render_canvas(ax)

    pixels, in_image = project_ego_corners(da, follower_sample)
    assert in_image.sum() >= 4
    for position in canvas_positions(ax, pixels[in_image]):
        assert has_color(canvas, position, COLLIDER_COLOR)


def project_ego_corners(da: DeepAccident, sample: str) -> Any:
    """Return the corners of the ego's box in the front camera of a sample, in pixels, and which of
    them are in the image.
    """
    boxes = da.boxes(sample, "Camera_Front")
    ego_id = da.get("agent", f"{sample.rsplit('/', 2)[0]}/ego_vehicle")["actor_id"]
    camera = camera_of(da, f"{sample}/Camera_Front")
    pixels, _ = camera.project(boxes.corners()[boxes.actor_id == ego_id][0])
    return pixels, camera.in_image(pixels)


def test_the_image_fills_the_pixels_of_its_calibration(
    da: DeepAccident, follower_sample: str
) -> None:
    camera = f"{follower_sample}/Camera_Front"
    ax = render_sample_data(da, camera, ax=new_axes())
    (image,) = ax.images

    np.testing.assert_array_equal(image.get_array(), da.load_image(camera))
    assert (tuple(image.get_extent()), ax.get_xlim(), ax.get_ylim()) == (
        (0, 64, 36, 0),
        (0, 64),
        (36, 0),
    )


def test_the_boxes_drawn_are_the_ones_that_the_camera_sees_without_its_own(
    da: DeepAccident, follower_sample: str
) -> None:
    ax = render_sample_data(da, f"{follower_sample}/Camera_Back", layers="boxes", ax=new_axes())  # type: ignore[arg-type]
    boxes = da.boxes(follower_sample, "Camera_Back", visible="camera")
    depths = boxes.corners()[boxes.actor_id != OWN_ACTOR_ID][..., 2]
    is_before_camera = depths >= 0.1
    num_edges = len(collections_of_kind(ax, LineCollection)[0].get_segments())

    assert (
        0
        < 12 * is_before_camera.all(axis=1).sum()
        <= num_edges
        <= 12 * is_before_camera.any(axis=1).sum()
    )


def test_points_have_the_colour_of_their_depth(da: DeepAccident, follower_sample: str) -> None:
    camera = f"{follower_sample}/Camera_Front"
    ax = render_sample_data(da, camera, layers=["points"], ax=new_axes())
    render_canvas(ax)
    (cloud,) = ax.collections
    depths = np.asarray(cloud.get_array())

    points = map_pointcloud_to_image(da, camera, colors=False)
    drawn_rows = np.column_stack([cloud.get_offsets(), depths]).tolist()
    expected_rows = np.column_stack([points.pixels, points.depth]).tolist()
    assert {*map(tuple, drawn_rows)} <= {*map(tuple, expected_rows)}
    assert len(depths) == points.mask.sum() > 50
    assert (np.diff(depths) <= 0).all()
    np.testing.assert_allclose(cloud.get_facecolor(), colormaps[DEPTH_COLORMAP](depths / 50))


@pytest.mark.parametrize(
    ("channel", "frame"), [("lidar01", "lidar"), ("BEV_instance_camera", "ego")]
)
def test_the_other_sensors_are_drawn_from_above_in_their_frame(
    da: DeepAccident, follower_sample: str, channel: str, frame: str
) -> None:
    ax = render_sample_data(da, f"{follower_sample}/{channel}", ax=new_axes())
    boxes = da.boxes(follower_sample, frame)
    center = np.mean([ax.get_xlim(), ax.get_ylim()], axis=1)
    near_boxes = boxes.select((np.abs(boxes.center[:, :2] - center) < 55).all(axis=1))

    assert box_footprints(collections_of_kind(ax, PolyCollection)[0]) == box_footprints(near_boxes)
    assert (len(collections_of_kind(ax, PathCollection)), len(ax.images)) == (
        (1, 0) if channel == "lidar01" else (0, 1)
    )


def test_points_of_another_agent_lie_in_the_image_where_they_project(
    da: DeepAccident, follower_sample: str
) -> None:
    camera = f"{follower_sample}/Camera_Front"
    pole = follower_sample.replace("ego_vehicle_behind", "infrastructure")
    ax = render_pointcloud_in_image(da, camera, pole, color_by="height", ax=new_axes())
    render_canvas(ax)

    cloud = da.load_point_cloud(pole, "world")
    points = hidden_points_filter(da, camera)(
        project_to_image(da, cloud, pole, camera, colors=False)
    )
    ego_from_world = da.world_from(follower_sample, "ego").inverse()
    heights = ego_from_world.apply(cloud.xyz)[:, 2]
    farthest_first = np.flatnonzero(points.mask)[np.argsort(-points.depth[points.mask])]
    assert len(farthest_first) > 20
    drawn = ax.collections[0]
    np.testing.assert_allclose(drawn.get_offsets(), points.pixels[farthest_first])
    np.testing.assert_allclose(drawn.get_array(), heights[farthest_first])
    assert drawn.get_cmap().name == HEIGHT_COLORMAP


def test_points_of_all_agents_can_have_the_colours_of_their_agents(
    da: DeepAccident, follower_sample: str
) -> None:
    camera = f"{follower_sample}/Camera_Front"
    colors = []
    for sample in (None, follower_sample):
        ax = render_pointcloud_in_image(da, camera, sample, color_by="agent", ax=new_axes())
        colors.append([to_hex(cloud.get_facecolor()[0]) for cloud in ax.collections])
    assert colors == [list(AGENT_COLORS.values()), [AGENT_COLORS["ego_vehicle_behind"]]]


def test_points_are_rendered_only_in_images(da: DeepAccident, follower_sample: str) -> None:
    lidar = f"{follower_sample}/lidar01"
    assert_raises(
        (lambda: render_pointcloud_in_image(da, lidar), ChoiceError, ("camera", "Camera_Front"))
    )


def test_the_best_view_of_the_vehicle_ahead_is_the_front_camera(
    da: DeepAccident, follower_sample: str
) -> None:
    boxes = da.boxes(follower_sample, "world")
    ego_id = da.get("agent", f"{follower_sample.rsplit('/', 2)[0]}/ego_vehicle")["actor_id"]
    view = best_view(da, [follower_sample], boxes.select(boxes.actor_id == ego_id))

    image_size = (64, 36)
    pixels, _ = project_ego_corners(da, follower_sample)
    low = pixels.min(axis=0).clip(0, image_size)
    high = pixels.max(axis=0).clip(0, image_size)
    assert view.camera == f"{follower_sample}/Camera_Front"
    np.testing.assert_allclose([*view.bounds, view.area], [*low, *high, np.prod(high - low)])


def test_a_box_that_no_camera_sees_has_no_best_view(da: DeepAccident, follower_sample: str) -> None:
    boxes = da.boxes(follower_sample, "world")
    assert best_view(da, [follower_sample], boxes.select(boxes.actor_id == OWN_ACTOR_ID)) is None


@pytest.mark.parametrize(
    "bounds", [(10.0, 10, 14, 12), (0.0, 0, 5, 5), (0.0, 0, 64, 36), (60.0, 30, 64, 36)]
)
def test_a_crop_has_the_image_s_shape_holds_the_bounds_and_stays_inside(bounds: Any) -> None:
    left, top, right, bottom = crop_about(bounds, width=64, height=36)
    inner_left, inner_top, inner_right, inner_bottom = bounds
    assert (right - left) / (bottom - top) == pytest.approx(64 / 36)
    assert 0 <= left <= inner_left < inner_right <= right <= 64
    assert 0 <= top <= inner_top < inner_bottom <= bottom <= 36
