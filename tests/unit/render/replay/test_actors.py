"""Where a replay has actors and agents, and who sees whom."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from replay_page import accident

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.render.replay.entries import recording_of
from deepaccident_devkit.render.styles import AGENT_COLORS, CATEGORY_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x.tracks import scenario_tracks


def test_actors_are_where_their_tracks_say(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    origin = recording_of(da, scenario, None).origin
    tracks = scenario_tracks(da, scenario)
    assert sorted(actor["id"] for actor in data["actors"]) == np.unique(tracks.actor_id).tolist()
    for actor in data["actors"]:
        rows = np.flatnonzero(tracks.actor_id == actor["id"])
        shown = [frame + 1 for frame, state in enumerate(actor["states"]) if state is not None]
        assert shown == tracks.index[rows].tolist()
        states = np.array([state[:3] for state in actor["states"] if state is not None])
        boxes = tracks.boxes.select(rows)
        assert_allclose(states[:, :2] / 100 + origin, boxes.center[:, :2], atol=0.00501)
        assert_allclose(states[:, 2] / 1000, boxes.yaw, atol=0.000501)
        assert_allclose([actor[side] / 100 for side in ("length", "width", "height")], boxes.size[0], atol=0.00501)
        heights = [state[4] / 100 for state in actor["states"] if state is not None]
        assert_allclose(heights, boxes.center[:, 2], atol=0.00501)
        lean = np.array([state[5:] for state in actor["states"] if state is not None])
        assert_allclose(lean / 1000, quaternions.to_matrix(boxes.rotation)[:, :2, 2], atol=0.000501)
        assert actor["title"].startswith(f"{boxes.category_names[0]} {actor['id']}")


def test_agents_are_where_they_drive(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    origin = recording_of(da, scenario, None).origin
    assert [agent["name"] for agent in data["agents"]] == list(AGENTS)
    assert len({agent["short"] for agent in data["agents"]}) == len({agent["color"] for agent in data["agents"]}) == 5
    for agent in data["agents"]:
        for frame, pose in enumerate(agent["poses"], 1):
            there = da.world_from(f"{scenario}/{agent['name']}/{frame:03d}", "ego")
            assert_allclose(np.array(pose[:2]) / 100 + origin, there.translation[:2], atol=0.00501)
            assert pose[2] / 1000 == pytest.approx(math.atan2(there.matrix[1, 0], there.matrix[0, 0]), abs=0.000501)


def test_who_sees_whom_is_the_released_rule(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    for bit, agent in enumerate(AGENTS):
        for frame in range(6):
            seen = {actor["id"] for actor in data["actors"] if actor["seen"][frame] >> bit & 1}
            visible = da.visible_instances(f"{scenario}/{agent}/{frame + 1:03d}", agents=[agent])
            assert seen == {int(token.rsplit("/", 1)[1]) for token in visible}
            assert seen  # or nothing is tested


def test_the_pair_is_red_and_first_and_the_other_agents_have_their_hues(da: DeepAccident, data: dict[str, Any]) -> None:
    pair = da.get("scenario", accident(da))["collision"]["ids"]
    agents = {agent["actor"]: agent for agent in data["agents"]}
    assert [actor["id"] for actor in data["actors"][:2]] == sorted(pair)
    assert [agent["short"] for agent in data["agents"]] == ["E", "EB", "O", "OB", "I"]
    for actor in data["actors"]:
        agent = agents.get(actor["id"])
        assert actor["tag"] == (agent["short"] if agent else "")
        color = AGENT_COLORS[agent["name"]] if agent else CATEGORY_COLORS[actor["category"]]
        assert actor["color"] == (COLLIDER_COLOR if actor["id"] in pair else color)
    behind = {agent["actor"] for agent in data["agents"] if agent["name"].endswith("_behind")}
    assert {actor["id"] for actor in data["actors"] if actor["role"] == "agent"} == behind


def test_cameras_are_where_they_record(da: DeepAccident, data: dict[str, Any]) -> None:
    """A point that is 20 m before a camera has the same pixel with the page's numbers."""
    scenario = accident(da)
    origin = np.array([*recording_of(da, scenario, None).origin, 0.0])
    ahead = np.array([[3.0, -2.0, 20.0]])
    for agent, cameras in zip(AGENTS, data["cameras"], strict=True):
        assert [f"Camera_{camera['title']}" for camera in cameras] == list(CAMERAS)
        for camera in cameras:
            for frame, pose in enumerate(camera["poses"], 1):
                sample, channel = f"{scenario}/{agent}/{frame:03d}", f"Camera_{camera['title']}"
                lens, there = da.camera(sample, channel), da.world_from(sample, channel)
                assert_allclose(np.array(pose[:3]) / 100 + origin, there.translation, atol=0.00501)
                turned = quaternions.to_matrix(np.array(pose[3:]) / 10_000) @ ahead[0]
                assert_allclose(turned, there.rotation @ ahead[0], atol=0.01)
                width, height, fx, fy, cx, cy = camera["lens"]
                assert (width, height) == (lens.width, lens.height)
                pixel = [fx * ahead[0, 0] / ahead[0, 2] + cx, fy * ahead[0, 1] / ahead[0, 2] + cy]
                assert_allclose([pixel], lens.project(ahead)[0], atol=0.01)
