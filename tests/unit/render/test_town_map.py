"""A town's map beneath what is seen from above."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from drawing import has_color, new_axes, on_canvas, rendered
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from refusals import assert_refused

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
def mapped(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """The release without images and points; of its first scenario the ego has no BEV camera."""
    root, ignored = (
        tmp_path_factory.mktemp("mapped") / "release",
        (".deepaccident", *CAMERAS, LIDAR),
    )
    shutil.copytree(
        release_root, root, copy_function=os.link, ignore=shutil.ignore_patterns(*ignored)
    )
    da = DeepAccident("v1", root, verbose=False)
    shutil.rmtree(
        da.get_sample_data_path(f"{da.scenario[0]['token']}/ego_vehicle/001/{BEV_CAMERA}").parent
    )
    return da


def ground_of(ax: Axes) -> list[set[str]]:
    """The colours of the pictures drawn, the lowest first."""
    pictures = [
        np.asarray(one.get_array())
        for one in sorted(ax.images, key=lambda image: image.get_zorder())
    ]
    return [
        {to_hex(color / 255) for color in np.unique(each.reshape(-1, 3), axis=0)}
        for each in pictures
    ]


def test_a_kept_map_takes_the_place_of_a_missing_bev_camera_and_is_not_made_for_it(
    mapped: DeepAccident,
) -> None:
    sample, how = f"{mapped.scenario[0]['token']}/ego_vehicle/003", {"layers": ("bev", "boxes")}
    ax = render_bev(mapped, sample, ax=new_axes(), **how)
    assert (ground_of(ax), missing_words(ax)) == ([], [f"{BEV_CAMERA}: not downloaded"])
    town_map(mapped, mapped.scenario[0]["town"], workers=1)
    ax = render_bev(mapped, sample, ax=new_axes(), **how)
    assert (len(ground_of(ax)), missing_words(ax)) == (1, [])
    there = render_bev(mapped, sample.replace("ego_vehicle", "other_vehicle"), ax=new_axes())
    assert [image.get_zorder() for image in there.images] == [0]  # the camera's own picture alone


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["ego", "world"])
def test_the_map_lies_where_the_bev_camera_sees_the_ground(
    mapped: DeepAccident, frame: str
) -> None:
    sample = f"{mapped.scenario[0]['token']}/other_vehicle/003"
    ax = render_bev(mapped, sample, layers=("map",), frame=frame, view_range=40, ax=new_axes())
    picture, tags = rendered(ax), mapped.load_bev(sample).semantic
    points = np.random.default_rng(2).uniform(-27, 27, (1500, 2))
    corners = np.rint(599.5 - points / 0.1).astype(int) - 12
    inner = [
        np.unique(tags[row : row + 25, column : column + 25]).tolist()
        for row, column in corners.tolist()
    ]
    axes_from_ego = mapped.world_from(sample, frame).inverse() @ mapped.world_from(sample, "ego")
    places = axes_from_ego.apply(np.column_stack([points, np.zeros(len(points))]))[:, :2]
    for name in ("road", "sidewalk"):
        alone = on_canvas(ax, places[[kinds == [TAGS[name]] for kinds in inner]])
        assert len(alone) > 8
        assert {has_color(picture, place, BEV_COLORS[name], tolerance=2.0) for place in alone} == {
            True
        }


def test_where_no_agent_has_a_bev_camera_the_picture_says_so(da_b: DeepAccident) -> None:
    ax = render_bev(da_b, da_b.sample[0], layers=("map", "boxes"), ax=new_axes())
    assert (ground_of(ax), missing_words(ax)) == ([], [f"no {BEV_CAMERA} for a map of the town"])


def test_a_town_as_a_picture(mapped: DeepAccident) -> None:
    town = mapped.scenario[0]["town"]
    ax, made = mapped.render_town_map(town, ax=new_axes()), town_map(mapped, town, workers=1)
    assert (*ax.get_xlim(), *ax.get_ylim()) == made.extent
    assert {*MAP_COLORS.values()} <= ground_of(ax)[0]
    assert_refused((lambda: render_town_map(mapped, "Town99"), ChoiceError, ("'Town99'", town)))
