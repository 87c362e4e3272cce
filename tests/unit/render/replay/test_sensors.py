"""The pictures and points of a replay, which keep its size."""

import base64
import io
import itertools
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from replay_page import accident, data_of, picture
from scipy.spatial import cKDTree

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry.camera import IN_FRONT_DEPTH
from deepaccident_devkit.render.replay import render_replay, sensors
from deepaccident_devkit.render.replay.entries import ReplayRecording, actor_entries, recording_of
from deepaccident_devkit.render.replay.sensors import (
    PAGE_CLOUD_BYTES,
    Followed,
    Jpegs,
    PictureSettings,
    camera_files,
    camera_pictures,
    follow_pair,
    max_cloud_points,
    steady_choice,
)
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x.tracks import scenario_tracks


def test_points_lie_on_those_of_the_lidar(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    origin = recording_of(da, scenario, None).origin
    most = max_cloud_points(30, PAGE_CLOUD_BYTES)
    for agent, clouds in zip(AGENTS, data["points"], strict=True):
        for frame, coded in enumerate(clouds, 1):
            shown = np.frombuffer(base64.b64decode(coded), dtype="<i2").reshape(-1, 3) / 10 + [
                *origin,
                0.0,
            ]
            sample = f"{scenario}/{agent}/{frame:03d}"
            height = da.load_point_cloud(sample, "ego").xyz[:, 2]
            raised = da.load_point_cloud(sample, "world").xyz[
                height > np.percentile(height, 5) + 0.2
            ]
            assert 100 < len(shown) <= most
            assert cKDTree(raised).query(shown)[0].max() < 0.0867  # half a decimetre along all axes


def test_each_agent_has_six_cameras(da: DeepAccident, data: dict[str, Any]) -> None:
    shown = {
        f"{accident(da)}/{agent}/006/{channel}": np.asarray(
            picture(camera["pictures"][5]), dtype=float
        )
        for agent, cameras in zip(AGENTS, data["cameras"], strict=True)
        for channel, camera in zip(CAMERAS, cameras, strict=True)
    }
    true = {token: da.load_image(token) for token in shown}
    nearest = {
        token: min(true, key=lambda each: np.abs(true[each] - shown[token]).mean())
        for token in shown
    }
    assert nearest == {token: token for token in shown}


def taken(dataset: DeepAccident, limit: float) -> tuple[PictureSettings | None, Jpegs]:
    """The pictures of a page on which each agent's back camera follows the pair from frame 4 on."""
    files = camera_files(recording_of(dataset, accident(dataset), None))
    channels = (*[CAMERAS[0]] * 3, *["Camera_Back"] * 3)
    followed = Followed(channels=dict.fromkeys(AGENTS, channels), agents=(AGENTS[0],) * 6)
    return camera_pictures(files, followed, limit)


def weight(jpegs: Jpegs) -> int:
    return sum(
        len(each)
        for cameras in jpegs.values()
        for all_ in cameras.values()
        for each in all_
        if each
    )


def test_pictures_keep_the_limit_and_at_last_become_fewer(da: DeepAccident) -> None:
    sizes = []
    for limit in (math.inf, 145_000, 45_000, 20_000, 12_000):
        settings, jpegs = taken(da, limit)
        sizes.append(weight(jpegs))
        assert (set(jpegs), sizes[-1] <= limit) == (set(AGENTS), True)
        given = {
            channel: [each is not None for each in all_]
            for channel, all_ in jpegs["infrastructure"].items()
        }
        follows = [frame % settings.frame_step == 0 for frame in range(6)]
        others = [
            bool(settings.other_frame_step) and frame % settings.other_frame_step == 0
            for frame in range(6)
        ]
        expected = {
            CAMERAS[0]: follows,
            "Camera_BackLeft": others,
            "Camera_Back": others[:3] + follows[3:],
        }
        assert {channel: given.get(channel, [False] * 6) for channel in expected} == expected
    assert sizes == sorted(sizes, reverse=True)
    assert (settings.other_frame_step, settings.frame_step > 1) == (0, True)
    assert taken(da, 10)[1] == {}


def test_a_missing_picture_leaves_a_hole(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "release"
    shutil.copytree(
        da.dataroot, root, copy_function=os.link, ignore=shutil.ignore_patterns(".deepaccident")
    )
    part = DeepAccident("v1", root, verbose=False)
    for gone in ("other_vehicle/003/Camera_Front", "ego_vehicle/002/lidar01"):
        part.get_sample_data_path(f"{accident(part)}/{gone}").unlink()
    data = data_of(render_replay(part, None, tmp_path / "replay.html"))
    shown = data["cameras"][2][0]["pictures"], data["points"][0]
    assert [[each is None for each in row] for row in shown] == [
        [at == gone for at in range(6)] for gone in (2, 1)
    ]
    assert (
        "1 of 30 LiDAR files are missing in the release; unpack the archives of lidar01."
        in data["notes"]
    )
    assert (
        "1 of 180 camera files are missing in the release; unpack the cameras' archives."
        in data["notes"]
    )


@pytest.fixture(scope="module")
def recording(da_motion: DeepAccident) -> ReplayRecording:
    return recording_of(da_motion, accident(da_motion), None)


def followed(recording: ReplayRecording, missing: tuple[str, str] = ("", "")) -> Followed:
    seen = {actor["id"]: actor["seen"] for actor in actor_entries(recording)}
    keys = itertools.product(recording.agents, CAMERAS)
    return follow_pair(
        recording, seen, {key: [key != missing] * len(recording.frames) for key in keys}
    )


def changes(names: tuple[str, ...]) -> int:
    return sum(one != other for one, other in itertools.pairwise(names))


def test_the_pair_is_in_the_picture_at_the_impact(
    da_motion: DeepAccident, recording: ReplayRecording
) -> None:
    found = followed(recording)
    assert {agent: len(channels) for agent, channels in found.channels.items()} == dict.fromkeys(
        AGENTS, 35
    )
    assert (
        max(map(changes, [*found.channels.values(), found.agents])) <= 3
    )  # in 3.5 s: it does not flicker
    for frame in range(26, 36):
        agent = found.agents[frame - 1]
        sample, channel = recording.sample(agent, frame), found.channels[agent][frame - 1]
        boxes, lens = (
            scenario_tracks(da_motion, recording.scenario).at(frame),
            da_motion.camera(sample, channel),
        )
        pair = boxes.select(np.isin(boxes.actor_id, recording.pair))
        centers = pair.transform(da_motion.world_from(sample, channel).inverse(), channel).center
        assert lens.in_image(*lens.project(centers), min_depth=IN_FRONT_DEPTH).any(), (
            frame,
            agent,
            channel,
        )


@pytest.mark.parametrize(
    ("scores", "chosen"),
    [
        (
            [[0.9, 0.1], [0.0, 0.8], [0.9, 0.1], [0.9, 0.1]],
            [0, 0, 0, 0],
        ),  # a change and back would cost more
        ([[0.5, 0.4], *[[0.1, 0.9]] * 3], [1, 1, 1, 1]),  # as good from the beginning on
        ([*[[0.9, 0.1]] * 3, *[[0.1, 0.9]] * 3], [0, 0, 0, 1, 1, 1]),
        ([[0.2, 0.2, 0.7]], [2]),
    ],
)
def test_changes_are_worth_their_cost(scores: list[list[float]], chosen: list[int]) -> None:
    assert steady_choice(np.array(scores)) == chosen


def test_other_cameras_have_smaller_pictures(
    da: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensors, "MIN_OTHER_WIDTH_PX", 8)
    monkeypatch.setattr(sensors, "PICTURE_LADDER", [(40, 60)])
    jpegs = taken(da, math.inf)[1]["other_vehicle"]
    large, small = (40, 22), (20, 11)
    expected = {"Front": [large] * 6, "Back": [small] * 3 + [large] * 3, "FrontRight": [small] * 6}
    sizes = {
        name: [Image.open(io.BytesIO(each)).size for each in jpegs[f"Camera_{name}"]]
        for name in expected
    }
    assert sizes == expected
