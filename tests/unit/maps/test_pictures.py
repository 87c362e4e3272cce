"""A town's map beneath what is seen from above."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from drawing import has_color, new_axes, on_canvas, rendered, title_of
from matplotlib.colors import to_hex

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.maps import town_map
from deepaccident_devkit.maps.pictures import draw_town_map, render_town_map
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.bev import render_bev
from deepaccident_devkit.render.captions import missing_words
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR


@pytest.fixture(scope="module")
def mapped(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """The release without images and points; of its first scenario the ego has no BEV camera."""
    root = tmp_path_factory.mktemp("mapped") / "release"
    shutil.copytree(
        release_root, root, copy_function=os.link, ignore=shutil.ignore_patterns(".deepaccident", *CAMERAS, LIDAR)
    )
    da = DeepAccident("v1", root, verbose=False)
    shutil.rmtree(da.get_sample_data_path(f"{da.scenario[0]['token']}/ego_vehicle/001/{BEV_CAMERA}").parent)
    return da


def ground_of(ax) -> list[str]:
    """The colours of the pictures drawn, the lowest first."""
    return [
        ", ".join(
            sorted({to_hex(color / 255) for color in np.unique(np.asarray(one.get_array()).reshape(-1, 3), axis=0)})
        )
        for one in sorted(ax.images, key=lambda image: image.get_zorder())
    ]


def test_a_kept_map_takes_the_place_of_a_missing_bev_camera_and_is_not_made_for_it(mapped: DeepAccident) -> None:
    sample = f"{mapped.scenario[0]['token']}/ego_vehicle/003"
    ax = render_bev(mapped, sample, layers=("bev", "boxes"), ax=new_axes())
    assert ground_of(ax) == []
    assert missing_words(ax) == [f"{BEV_CAMERA}: not downloaded"]
    town_map(mapped, mapped.scenario[0]["town"], workers=1)
    ax = render_bev(mapped, sample, layers=("bev", "boxes"), ax=new_axes())
    assert len(ground_of(ax)) == 1
    assert missing_words(ax) == []
    there = render_bev(mapped, sample.replace("ego_vehicle", "other_vehicle"), ax=new_axes())
    assert len(ground_of(there)) == 1
    assert there.images[0].get_zorder() == 0  # the camera's own picture alone


@pytest.mark.parametrize("frame", ["ego", "world"])
def test_the_map_lies_where_the_bev_camera_sees_the_ground(mapped: DeepAccident, frame: str) -> None:
    sample = f"{mapped.scenario[0]['token']}/other_vehicle/003"
    ax = render_bev(mapped, sample, layers=("map",), frame=frame, view_range=40, ax=new_axes())
    picture, tags = rendered(ax), mapped.load_bev(sample).semantic
    points = np.random.default_rng(2).uniform(-27, 27, (1500, 2))
    rows, columns = np.rint(599.5 - points.T / 0.1).astype(int)
    inner = [
        np.unique(tags[row - 12 : row + 13, column - 12 : column + 13]).tolist()
        for row, column in zip(rows, columns, strict=True)
    ]
    axes_from_ego = mapped.world_from(sample, frame).inverse() @ mapped.world_from(sample, "ego")
    places = axes_from_ego.apply(np.column_stack([points, np.zeros(len(points))]))[:, :2]
    for name in ("road", "sidewalk"):
        alone = np.array([kinds == [TAGS[name]] for kinds in inner])
        assert alone.sum() > 8
        for place in on_canvas(ax, places[alone]):
            assert has_color(picture, place, BEV_COLORS[name], tolerance=2.0)


def test_the_map_lies_beneath_the_bev_camera(mapped: DeepAccident) -> None:
    ax = render_bev(
        mapped, f"{mapped.scenario[0]['token']}/other_vehicle/003", layers=("map", "bev"), view_range=80, ax=new_axes()
    )
    assert [image.get_zorder() for image in sorted(ax.images, key=lambda one: one.get_zorder())] == [-1, 0]
    np.testing.assert_allclose([ax.get_xlim(), ax.get_ylim()], [(-80, 80), (-80, 80)], atol=1e-9)


def test_where_no_agent_has_a_bev_camera_the_picture_says_so(da_b: DeepAccident) -> None:
    ax = render_bev(da_b, da_b.sample[0], layers=("map", "boxes"), ax=new_axes())
    assert ground_of(ax) == []
    assert missing_words(ax) == [f"no {BEV_CAMERA} for a map of the town"]


def test_a_picture_far_from_the_map_has_none(mapped: DeepAccident) -> None:
    """And its limits stay."""
    ax = new_axes()
    ax.set(xlim=(5000, 5010), ylim=(0, 10))
    draw_town_map(town_map(mapped, mapped.scenario[0]["town"], workers=1), ax, target_from_world=SE3.identity())
    assert not ax.images
    assert ax.get_xlim() == (5000, 5010)


def test_a_town_as_a_picture(mapped: DeepAccident) -> None:
    town = mapped.scenario[0]["town"]
    ax = mapped.render_town_map(town, ax=new_axes())
    made = town_map(mapped, town, workers=1)
    assert (*ax.get_xlim(), *ax.get_ylim()) == made.extent
    assert title_of(ax) == f"{town}: {made.looks} pictures of 2 scenarios"
    shown = ground_of(ax)[0]
    for name in ("road", "road_line", "sidewalk"):
        assert BEV_COLORS[name] in shown
    with pytest.raises(ChoiceError, match="found 'Town99'"):
        render_town_map(mapped, "Town99")
