"""The road beneath a replay."""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ImageColor
from replay_page import accident, data_of, picture

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.maps import town_map
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.replay import recording_of, render_replay
from deepaccident_devkit.render.replay.road import road_picture
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA


def linked(da: DeepAccident, root: Path, *gone: str) -> DeepAccident:
    """The release again, without some files and with an index of its own."""
    ignored = shutil.ignore_patterns(".deepaccident", *gone)
    shutil.copytree(da.dataroot, root, copy_function=os.link, ignore=ignored)
    return DeepAccident("v1", root, verbose=False)


def ground(road: dict[str, Any], origin: Any) -> tuple[Any, Any, float]:
    """The picture (H, W, 3), its upper left corner in world, and the side of its cells, metres."""
    assert len(road["png"]) < 300_000
    shown = np.asarray(picture(road["png"]).convert("RGB"))
    return (
        shown,
        origin + np.array([road["left"], road["top"]]) / 100,
        road["width"] / 100 / shown.shape[1],
    )


def share_of(shown: Any, name: str) -> float:
    """How many of some cells (N, 3) have the colour of a kind of ground."""
    return float((shown == ImageColor.getrgb(BEV_COLORS[name])).all(axis=1).mean())


def test_the_road_is_where_the_bev_cameras_see_it(da: DeepAccident, data: dict[str, Any]) -> None:
    shown, corner, cell = ground(data["road"], recording_of(da, accident(da), None).origin)
    points = np.random.default_rng(0).uniform(-40, 40, (2000, 2))
    rows, columns = np.rint(599.5 - points.T / 0.1).astype(int)
    for agent in AGENTS:
        sample = f"{accident(da)}/{agent}/001"
        pose, tags = da.world_from(sample, "ego"), da.load_bev(sample).semantic[rows, columns]
        yaw = np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0])
        turned = points @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        across, down = ((turned + pose.translation[:2] - corner) * [1, -1] / cell).astype(int).T
        for name in ("road", "sidewalk"):
            cells = shown[down, across][tags == TAGS[name]]
            assert len(cells) > 20
            assert share_of(cells, name) > 0.95, (
                agent,
                name,
            )  # a cell at an edge may have what is beside it


def test_without_bev_files_there_is_no_road(da: DeepAccident, tmp_path: Path) -> None:
    page = render_replay(linked(da, tmp_path / "release", BEV_CAMERA), None, tmp_path / "a.html")
    assert data_of(page)["road"] is None


def test_without_bev_files_a_kept_map_of_the_town_is_the_road(
    da: DeepAccident, tmp_path: Path
) -> None:
    """As of the test split, whose scenarios have no BEV camera, in a town that others were recorded
    in.
    """
    opened = linked(da, tmp_path / "release")
    token = accident(opened)
    for agent in AGENTS:
        shutil.rmtree(opened.get_sample_data_path(f"{token}/{agent}/001/{BEV_CAMERA}").parent)
    recording = recording_of(opened, token, None)
    assert road_picture(recording) is None
    made = town_map(opened, recording.scenario["town"], workers=1)
    road: Any = road_picture(recording)
    shown, corner, cell = ground(road, recording.origin)
    rows, columns = np.indices(shown.shape[:2])[:, 5:-5:9, 5:-5:9].reshape(2, -1)
    classes = made.classes_at(corner + np.column_stack([columns + 0.5, -rows - 0.5]) * cell)
    for code, name in ((1, "road"), (3, "sidewalk")):
        assert share_of(shown[rows[classes == code], columns[classes == code]], name) > 0.95
