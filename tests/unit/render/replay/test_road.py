"""The road beneath a replay."""

import base64
import io
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageColor
from replay_page import accident, data_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.maps import town_map
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.replay import recording_of, render_replay
from deepaccident_devkit.render.replay.road import road_picture
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA


def test_the_road_is_where_the_bev_cameras_see_it(da: DeepAccident, data: dict[str, Any]) -> None:
    road = data["road"]
    assert len(road["png"]) < 300_000
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(road["png"]))).convert("RGB"))
    cell = road["width"] / 100 / picture.shape[1]
    corner = recording_of(da, accident(da), None).origin + np.array([road["left"], road["top"]]) / 100
    points = np.random.default_rng(0).uniform(-40, 40, (2000, 2))
    for agent in AGENTS:
        sample = f"{accident(da)}/{agent}/001"
        rows, columns = np.rint(599.5 - points.T / 0.1).astype(int)
        tags = da.load_bev(sample).semantic[rows, columns]
        pose = da.world_from(sample, "ego")
        yaw = np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0])
        turned = points @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        across, down = ((turned + pose.translation[:2] - corner) * [1, -1] / cell).astype(int).T
        shown = picture[down, across]
        for name in ("road", "sidewalk"):
            same = (shown[tags == TAGS[name]] == ImageColor.getrgb(BEV_COLORS[name])).all(axis=1)
            assert len(same) > 20
            assert same.mean() > 0.95, (agent, name)  # a cell at an edge may have what is beside it


def test_without_bev_files_there_is_no_road(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "release"
    ignored = shutil.ignore_patterns(".deepaccident", BEV_CAMERA)
    shutil.copytree(da.dataroot, root, copy_function=os.link, ignore=ignored)
    assert data_of(render_replay(DeepAccident("v1", root, verbose=False), None, tmp_path / "a.html"))["road"] is None


def test_without_bev_files_a_kept_map_of_the_town_is_the_road(da: DeepAccident, tmp_path: Path) -> None:
    """As of the test split, whose scenarios have no BEV camera, in a town that others were recorded in."""
    root = tmp_path / "release"
    shutil.copytree(da.dataroot, root, copy_function=os.link, ignore=shutil.ignore_patterns(".deepaccident"))
    opened = DeepAccident("v1", root, verbose=False)
    token = accident(opened)
    twin = next(
        each["token"]
        for each in opened.scenario
        if each["name"] == opened.get("scenario", token)["name"] and each["token"] != token
    )
    for agent in AGENTS:
        shutil.rmtree(opened.get_sample_data_path(f"{token}/{agent}/001/{BEV_CAMERA}").parent)
    recording = recording_of(opened, token, None)
    assert road_picture(recording) is None
    made = town_map(opened, recording.scenario["town"], workers=1)
    assert made.missing == 10
    road, of_twin = road_picture(recording), road_picture(recording_of(opened, twin, None))
    assert of_twin is not None
    assert len(road["png"]) < 300_000
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(road["png"]))).convert("RGB"))
    cell = road["width"] / 100 / picture.shape[1]
    corner = recording.origin + np.array([road["left"], road["top"]]) / 100
    rows, columns = np.indices(picture.shape[:2])[:, 5:-5:9, 5:-5:9].reshape(2, -1)
    classes = made.classes_at(corner + np.column_stack([columns + 0.5, -rows - 0.5]) * cell)
    for code, name, least in ((1, "road", 0.95), (2, "road_line", 0.5), (3, "sidewalk", 0.95)):  # a line is a cell wide
        shown = picture[rows[classes == code], columns[classes == code]]
        assert (shown == ImageColor.getrgb(BEV_COLORS[name])).all(axis=1).mean() > least
        assert len(shown) > 50
