"""A town's map beneath what is seen from above."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from support.expected_errors import assert_raises
from support.rendered_pixels import (
    canvas_positions,
    ground_colors,
    has_color,
    new_axes,
    render_canvas,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.maps import town_map
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.bev import render_bev
from deepaccident_devkit.render.captions import missing_words
from deepaccident_devkit.render.styles import BEV_COLORS, MAP_COLORS
from deepaccident_devkit.render.town_map import render_town_map
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR


@pytest.fixture(scope="module")
def unmapped_da(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """The release without images and points; in its first scenario the ego has no BEV camera."""
    root = tmp_path_factory.mktemp("mapped") / "release"
    ignore = shutil.ignore_patterns(".deepaccident", *CAMERAS, LIDAR)
    shutil.copytree(release_root, root, copy_function=os.link, ignore=ignore)
    da = DeepAccident("v1", root, verbose=False)
    bev_image = f"{da.scenario[0]['token']}/ego_vehicle/001/{BEV_CAMERA}"
    shutil.rmtree(da.get_sample_data_path(bev_image).parent)
    return da


def read_ground_colors(ax: Axes) -> list[set[str]]:
    """Return the colours of each picture drawn, the lowest picture first."""
    images = sorted(ax.images, key=lambda image: image.get_zorder())
    return [ground_colors(image) for image in images]


def test_a_stored_map_replaces_a_missing_bev_camera_but_none_is_made_for_it(
    unmapped_da: DeepAccident,
) -> None:
    scenario = unmapped_da.scenario[0]
    sample = f"{scenario['token']}/ego_vehicle/003"

    ax = render_bev(unmapped_da, sample, layers=("bev", "boxes"), ax=new_axes())
    assert read_ground_colors(ax) == []
    assert missing_words(ax) == [f"{BEV_CAMERA}: not downloaded"]

    town_map(unmapped_da, scenario["town"], workers=1)
    ax = render_bev(unmapped_da, sample, layers=("bev", "boxes"), ax=new_axes())
    assert (len(read_ground_colors(ax)), missing_words(ax)) == (1, [])

    other_sample = sample.replace("ego_vehicle", "other_vehicle")
    ax = render_bev(unmapped_da, other_sample, ax=new_axes())
    assert [image.get_zorder() for image in ax.images] == [-0.5]  # only the camera's own picture


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["ego", "world"])
def test_the_map_lies_where_the_bev_camera_sees_the_ground(
    unmapped_da: DeepAccident, frame: str
) -> None:
    sample = f"{unmapped_da.scenario[0]['token']}/other_vehicle/003"
    ax = render_bev(unmapped_da, sample, layers=("map",), frame=frame, view_range=40, ax=new_axes())
    canvas = render_canvas(ax)

    tags = unmapped_da.load_bev(sample).semantic
    points = np.random.default_rng(2).uniform(-27, 27, (1500, 2))
    corners = np.rint(599.5 - points / 0.1).astype(int) - 12
    tags_around_points = [
        np.unique(tags[row : row + 25, column : column + 25]).tolist()
        for row, column in corners.tolist()
    ]
    frame_from_world = unmapped_da.world_from(sample, frame).inverse()
    frame_from_ego = frame_from_world @ unmapped_da.world_from(sample, "ego")
    positions = frame_from_ego.apply(np.column_stack([points, np.zeros(len(points))]))[:, :2]
    for name in ("road", "sidewalk"):
        is_inside = [tags_around == [TAGS[name]] for tags_around in tags_around_points]
        pixels = canvas_positions(ax, positions[is_inside])
        assert len(pixels) > 8
        for pixel in pixels:
            assert has_color(canvas, pixel, BEV_COLORS[name], tolerance=2.0)


def test_where_no_agent_has_a_bev_camera_the_picture_says_so(da_b: DeepAccident) -> None:
    ax = render_bev(da_b, da_b.sample[0], layers=("map", "boxes"), ax=new_axes())
    assert read_ground_colors(ax) == []
    assert missing_words(ax) == [f"no {BEV_CAMERA} for a map of the town"]


def test_a_town_as_a_picture(unmapped_da: DeepAccident) -> None:
    town = unmapped_da.scenario[0]["town"]
    ax = unmapped_da.render_town_map(town, ax=new_axes())
    extent = town_map(unmapped_da, town, workers=1).extent
    assert (*ax.get_xlim(), *ax.get_ylim()) == extent
    assert {*MAP_COLORS.values()} <= read_ground_colors(ax)[0]
    assert_raises((lambda: render_town_map(unmapped_da, "Town99"), ChoiceError, ("'Town99'", town)))
