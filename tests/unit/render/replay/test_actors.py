"""Where a replay has actors and agents, and who sees whom."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from replay_page import accident

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.colors import AGENT_COLORS, CATEGORY_COLORS, COLLIDER_COLOR
from deepaccident_devkit.render.replay.recording import recording_of
from deepaccident_devkit.taxonomy import AGENTS
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
        assert_allclose([actor["length"] / 100, actor["width"] / 100], boxes.size[0, :2], atol=0.00501)
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


def test_the_pair_is_red_and_first_and_its_companions_have_their_agents_hues(
    da: DeepAccident, data: dict[str, Any]
) -> None:
    pair = da.get("scenario", accident(da))["collision"]["ids"]
    behind = {agent["actor"]: agent["name"] for agent in data["agents"] if agent["name"].endswith("_behind")}
    assert [actor["id"] for actor in data["actors"][:2]] == sorted(pair)
    for actor in data["actors"]:
        color = CATEGORY_COLORS[actor["category"]]
        color = AGENT_COLORS[behind[actor["id"]]] if actor["id"] in behind else color
        assert actor["color"] == (COLLIDER_COLOR if actor["id"] in pair else color)
    assert {actor["id"] for actor in data["actors"] if actor["role"] == "companion"} == set(behind)
