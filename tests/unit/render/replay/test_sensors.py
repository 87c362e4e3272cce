"""The pictures and points of a replay, which respect its size limit."""

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
from scipy.spatial import cKDTree
from support.replay_page import accident_scenario, decode_image, read_page_data

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry.camera import IN_FRONT_DEPTH
from deepaccident_devkit.render.replay import render_replay, sensors
from deepaccident_devkit.render.replay.entries import ReplayRecording, actor_entries, recording_of
from deepaccident_devkit.render.replay.sensors import (
    Followed,
    Jpegs,
    PictureSettings,
    camera_files,
    camera_pictures,
    cloud_size,
    cloud_text,
    follow_pair,
    steady_choice,
)
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x.tracks import scenario_tracks


def decode_points(encoded: str, origin: list[float]) -> Any:
    """Return the points of an encoded cloud in world, metres."""
    centimetres = np.frombuffer(base64.b64decode(encoded), dtype="<i2").reshape(-1, 3)
    return centimetres / 100 + origin


def test_a_small_page_has_all_lidar_points(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident_scenario(da)
    origin = [*recording_of(da, scenario, None).origin, 0.0]
    for agent, clouds in zip(AGENTS, data["points"], strict=True):
        for frame, encoded in enumerate(clouds, start=1):
            points = decode_points(encoded, origin)
            cloud = da.load_point_cloud(f"{scenario}/{agent}/{frame:03d}", "world").xyz
            assert len(points) == len(cloud)
            distances, _ = cKDTree(cloud).query(points)
            assert distances.max() < 0.0088  # half a centimetre along all axes
    assert not any("points per cloud" in note for note in data["notes"])


def test_a_limited_cloud_has_the_points_above_the_road_first(da: DeepAccident) -> None:
    scenario = accident_scenario(da)
    recording = recording_of(da, scenario, None)
    whole = cloud_text(recording, "ego_vehicle", 1)
    part = cloud_text(recording, "ego_vehicle", 1, 500)
    assert whole is not None
    assert part is not None
    assert whole.startswith(part)
    assert len(part) == cloud_size(500)

    sample = f"{scenario}/ego_vehicle/001"
    height = da.load_point_cloud(sample, "ego").xyz[:, 2]
    raised = da.load_point_cloud(sample, "world").xyz[height > np.percentile(height, 5) + 0.2]
    points = decode_points(part, [*recording.origin, 0.0])
    distances, _ = cKDTree(raised).query(points)
    assert distances.max() < 0.0088


def test_each_agent_has_six_cameras(da: DeepAccident, data: dict[str, Any]) -> None:
    pictures = {}
    for agent, cameras in zip(AGENTS, data["cameras"], strict=True):
        for channel, camera in zip(CAMERAS, cameras, strict=True):
            token = f"{accident_scenario(da)}/{agent}/006/{channel}"
            pictures[token] = np.asarray(decode_image(camera["pictures"][5]), dtype=float)

    images = {token: da.load_image(token) for token in pictures}
    for token, picture in pictures.items():
        differences = {key: np.abs(image - picture).mean() for key, image in images.items()}
        assert min(differences, key=differences.__getitem__) == token


def select_pictures(dataset: DeepAccident, limit: float) -> tuple[PictureSettings | None, Jpegs]:
    """Select the pictures of a page on which each agent's back camera follows the pair from frame 4
    on.
    """
    files = camera_files(recording_of(dataset, accident_scenario(dataset), None))
    channels = (*[CAMERAS[0]] * 3, *["Camera_Back"] * 3)
    followed = Followed(channels=dict.fromkeys(AGENTS, channels), agents=(AGENTS[0],) * 6)
    return camera_pictures(files, followed, limit)


def count_bytes(jpegs: Jpegs) -> int:
    return sum(
        len(jpeg)
        for cameras in jpegs.values()
        for camera_jpegs in cameras.values()
        for jpeg in camera_jpegs
        if jpeg
    )


def test_pictures_keep_the_limit_and_in_the_end_become_fewer(da: DeepAccident) -> None:
    sizes = []
    for limit in (math.inf, 145_000, 45_000, 20_000, 12_000):
        settings, jpegs = select_pictures(da, limit)
        sizes.append(count_bytes(jpegs))
        assert set(jpegs) == set(AGENTS)
        assert sizes[-1] <= limit

        followed_frames = [frame % settings.frame_step == 0 for frame in range(6)]
        other_frames = [
            bool(settings.other_frame_step) and frame % settings.other_frame_step == 0
            for frame in range(6)
        ]
        for channel, expected in (
            (CAMERAS[0], followed_frames),
            ("Camera_BackLeft", other_frames),
            ("Camera_Back", other_frames[:3] + followed_frames[3:]),
        ):
            camera_jpegs = jpegs["infrastructure"].get(channel, [None] * 6)
            assert [jpeg is not None for jpeg in camera_jpegs] == expected
    assert sizes == sorted(sizes, reverse=True)
    assert settings.other_frame_step == 0
    assert settings.frame_step > 1
    assert select_pictures(da, 10)[1] == {}


def test_a_missing_picture_leaves_a_hole(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "release"
    ignore = shutil.ignore_patterns(".deepaccident")
    shutil.copytree(da.dataroot, root, copy_function=os.link, ignore=ignore)
    dataset = DeepAccident("v1", root, verbose=False)
    for file in ("other_vehicle/003/Camera_Front", "ego_vehicle/002/lidar01"):
        dataset.get_sample_data_path(f"{accident_scenario(dataset)}/{file}").unlink()

    data = read_page_data(render_replay(dataset, None, tmp_path / "replay.html"))

    pictures = data["cameras"][2][0]["pictures"]
    assert [frame for frame, picture in enumerate(pictures) if picture is None] == [2]
    assert len(pictures) == 6
    clouds = data["points"][0]
    assert [frame for frame, cloud in enumerate(clouds) if cloud is None] == [1]
    assert len(clouds) == 6
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
    return recording_of(da_motion, accident_scenario(da_motion), None)


def follow_in_recording(recording: ReplayRecording) -> Followed:
    """Choose the cameras that follow the pair where no image is missing."""
    visibility = {actor["id"]: actor["seen"] for actor in actor_entries(recording)}
    has_image = [True] * len(recording.frames)
    cameras = itertools.product(recording.agents, CAMERAS)
    return follow_pair(recording, visibility, dict.fromkeys(cameras, has_image))


def count_changes(names: tuple[str, ...]) -> int:
    return sum(name != next_name for name, next_name in itertools.pairwise(names))


def test_the_pair_is_in_the_picture_at_the_impact(
    da_motion: DeepAccident, recording: ReplayRecording
) -> None:
    followed = follow_in_recording(recording)
    assert list(followed.channels) == list(AGENTS)
    for channels in followed.channels.values():
        assert len(channels) == 35
    for names in (*followed.channels.values(), followed.agents):
        assert count_changes(names) <= 3  # in 3.5 s: it does not flicker

    tracks = scenario_tracks(da_motion, recording.scenario)
    for frame in range(26, 36):
        agent = followed.agents[frame - 1]
        channel = followed.channels[agent][frame - 1]
        sample = recording.sample(agent, frame)
        boxes = tracks.at(frame)
        pair = boxes.select(np.isin(boxes.actor_id, recording.pair))
        camera_from_world = da_motion.world_from(sample, channel).inverse()
        centers = pair.transform(camera_from_world, channel).center
        camera = da_motion.camera(sample, channel)
        in_image = camera.in_image(*camera.project(centers), min_depth=IN_FRONT_DEPTH)
        assert in_image.any(), (frame, agent, channel)


@pytest.mark.parametrize(
    ("scores", "cameras"),
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
def test_changes_are_worth_their_cost(scores: list[list[float]], cameras: list[int]) -> None:
    assert steady_choice(np.array(scores)) == cameras


def test_other_cameras_have_smaller_pictures(
    da: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensors, "MIN_OTHER_WIDTH_PX", 8)
    monkeypatch.setattr(sensors, "PICTURE_LADDER", [(40, 60)])
    _, jpegs = select_pictures(da, math.inf)
    large, small = (40, 22), (20, 11)

    for channel, expected in (
        ("Camera_Front", [large] * 6),
        ("Camera_Back", [small] * 3 + [large] * 3),
        ("Camera_FrontRight", [small] * 6),
    ):
        pictures = [Image.open(io.BytesIO(jpeg)) for jpeg in jpegs["other_vehicle"][channel]]
        assert [picture.size for picture in pictures] == expected
