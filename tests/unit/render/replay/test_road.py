"""The road beneath a replay."""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ImageColor
from support.replay_page import accident_scenario, decode_image, read_page_data

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.maps import town_map
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.replay import recording_of, render_replay
from deepaccident_devkit.render.replay.road import road_picture
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA


def link_release(da: DeepAccident, root: Path, *ignored_names: str) -> DeepAccident:
    """Copy the release as hard links, without some files and with an index of its own."""
    ignore = shutil.ignore_patterns(".deepaccident", *ignored_names)
    shutil.copytree(da.dataroot, root, copy_function=os.link, ignore=ignore)
    return DeepAccident("v1", root, verbose=False)


def read_road(road: dict[str, Any], origin: Any) -> tuple[Any, Any, float]:
    """Return the picture (H, W, 3), its upper left corner in world, and the side of its cells in
    metres.
    """
    assert len(road["png"]) < 300_000
    picture = np.asarray(decode_image(road["png"]).convert("RGB"))
    corner = origin + np.array([road["left"], road["top"]]) / 100
    cell_m = road["width"] / 100 / picture.shape[1]
    return picture, corner, cell_m


def share_of_color(cells: Any, name: str) -> float:
    """Return the share of cells (N, 3) that have the colour of this kind of ground."""
    color = ImageColor.getrgb(BEV_COLORS[name])
    return float((cells == color).all(axis=1).mean())


def test_the_road_is_where_the_bev_cameras_see_it(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident_scenario(da)
    picture, corner, cell_m = read_road(data["road"], recording_of(da, scenario, None).origin)
    points = np.random.default_rng(0).uniform(-40, 40, (2000, 2))
    bev_rows, bev_columns = np.rint(599.5 - points.T / 0.1).astype(int)

    for agent in AGENTS:
        sample = f"{scenario}/{agent}/001"
        tags = da.load_bev(sample).semantic[bev_rows, bev_columns]
        pose = da.world_from(sample, "ego")
        yaw = np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0])
        rotation = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        positions = points @ rotation + pose.translation[:2]
        columns, rows = ((positions - corner) * [1, -1] / cell_m).astype(int).T
        for name in ("road", "sidewalk"):
            cells = picture[rows, columns][tags == TAGS[name]]
            assert len(cells) > 20
            # a cell at an edge may have the colour of its neighbour
            assert share_of_color(cells, name) > 0.95, (agent, name)


def test_without_bev_files_there_is_no_road(da: DeepAccident, tmp_path: Path) -> None:
    dataset = link_release(da, tmp_path / "release", BEV_CAMERA)
    page = render_replay(dataset, None, tmp_path / "a.html")
    assert read_page_data(page)["road"] is None


def test_without_bev_files_a_stored_map_of_the_town_is_the_road(
    da: DeepAccident, tmp_path: Path
) -> None:
    """Scenarios of the test split have no BEV camera, but others were recorded in the same town."""
    dataset = link_release(da, tmp_path / "release")
    scenario = accident_scenario(dataset)
    for agent in AGENTS:
        bev_image = dataset.get_sample_data_path(f"{scenario}/{agent}/001/{BEV_CAMERA}")
        shutil.rmtree(bev_image.parent)
    recording = recording_of(dataset, scenario, None)
    assert road_picture(recording) is None
    stored_map = town_map(dataset, recording.scenario["town"], workers=1)

    road: Any = road_picture(recording)

    picture, corner, cell_m = read_road(road, recording.origin)
    rows, columns = np.indices(picture.shape[:2])[:, 5:-5:9, 5:-5:9].reshape(2, -1)
    positions = corner + np.column_stack([columns + 0.5, -rows - 0.5]) * cell_m
    classes = stored_map.classes_at(positions)
    for code, name in ((1, "road"), (3, "sidewalk")):
        is_class = classes == code
        assert share_of_color(picture[rows[is_class], columns[is_class]], name) > 0.95
