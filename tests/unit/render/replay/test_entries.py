"""A replay's actors and agents are where they were, and it lists which agents see which actors."""

import itertools
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from support.replay_page import accident_scenario, normal_scenario, read_page_data

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.replay import recording_of, render_replay
from deepaccident_devkit.render.styles import AGENT_COLORS, CATEGORY_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x.tracks import scenario_tracks

CENTIMETRE_ROUNDING = 0.00501  # metres
MILLI_ROUNDING = 0.000501  # radians, or shares of a unit vector


def test_actors_are_where_their_tracks_have_them(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident_scenario(da)
    origin = recording_of(da, scenario, None).origin
    tracks = scenario_tracks(da, scenario)
    assert sorted(actor["id"] for actor in data["actors"]) == np.unique(tracks.actor_id).tolist()

    for actor in data["actors"]:
        rows = np.flatnonzero(tracks.actor_id == actor["id"])
        boxes = tracks.boxes.select(rows)
        states_by_frame = {
            frame: state
            for frame, state in enumerate(actor["states"], start=1)
            if state is not None
        }
        states = np.array([*states_by_frame.values()])
        assert [*states_by_frame] == tracks.index[rows].tolist()
        assert actor["title"].startswith(f"{boxes.category_names[0]} {actor['id']}")

        centers = np.column_stack([states[:, :2] / 100 + origin, states[:, 4] / 100])
        np.testing.assert_allclose(centers, boxes.center, atol=CENTIMETRE_ROUNDING)
        np.testing.assert_allclose(states[:, 2] / 1000, boxes.yaw, atol=MILLI_ROUNDING)
        size = [actor[side] / 100 for side in ("length", "width", "height")]
        np.testing.assert_allclose(size, boxes.size[0], atol=CENTIMETRE_ROUNDING)
        up_axis = quaternions.to_matrix(boxes.rotation)[:, :2, 2]
        np.testing.assert_allclose(states[:, 5:] / 1000, up_axis, atol=MILLI_ROUNDING)


def test_actors_are_seen_by_the_released_rule(da: DeepAccident, data: dict[str, Any]) -> None:
    for (bit, agent), frame in itertools.product(enumerate(AGENTS), range(6)):
        seen_ids = {actor["id"] for actor in data["actors"] if actor["seen"][frame] >> bit & 1}
        sample = f"{accident_scenario(da)}/{agent}/{frame + 1:03d}"
        visible = da.visible_instances(sample, agents=[agent])
        assert seen_ids == {int(token.rsplit("/", 1)[1]) for token in visible} != set()


def test_the_pair_is_red_and_first_and_the_other_agents_have_their_hues(
    da: DeepAccident, data: dict[str, Any]
) -> None:
    pair = da.get("scenario", accident_scenario(da))["collision"]["ids"]
    assert [actor["id"] for actor in data["actors"][:2]] == sorted(pair)

    agents = {agent["actor"]: agent for agent in data["agents"]}
    for actor in data["actors"]:
        agent = agents.get(actor["id"])
        assert actor["tag"] == (agent["short"] if agent else "")
        if actor["id"] in pair:
            assert actor["color"] == COLLIDER_COLOR
        elif agent:
            assert actor["color"] == AGENT_COLORS[agent["name"]]
        else:
            assert actor["color"] == CATEGORY_COLORS[actor["category"]]


def test_cameras_are_where_they_record(da: DeepAccident, data: dict[str, Any]) -> None:
    """A point 20 m in front of a camera has the same pixel with the page's numbers."""
    scenario = accident_scenario(da)
    origin = np.array([*recording_of(da, scenario, None).origin, 0.0])
    point = np.array([3.0, -2.0, 20.0])
    for agent, cameras in zip(AGENTS, data["cameras"], strict=True):
        assert [camera["title"] for camera in cameras] == [*map(camera_name, CAMERAS)]
        for channel, camera in zip(CAMERAS, cameras, strict=True):
            for frame, pose in enumerate(camera["poses"], start=1):
                sample = f"{scenario}/{agent}/{frame:03d}"
                world_from_camera = da.world_from(sample, channel)
                position = np.array(pose[:3]) / 100 + origin
                np.testing.assert_allclose(
                    position, world_from_camera.translation, atol=CENTIMETRE_ROUNDING
                )
                rotated = quaternions.to_matrix(np.array(pose[3:]) / 10_000) @ point
                np.testing.assert_allclose(rotated, world_from_camera.rotation @ point, atol=0.01)

                expected_camera = da.camera(sample, channel)
                width, height, fx, fy, cx, cy = camera["lens"]
                assert (width, height) == (expected_camera.width, expected_camera.height)
                pixel = np.array([fx, fy]) * point[:2] / point[2] + [cx, cy]
                expected_pixels, _ = expected_camera.project(point[None])
                np.testing.assert_allclose([pixel], expected_pixels, atol=0.01)


def test_the_countdown_ends_at_the_impact(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident_scenario(da)
    assert data["countdown"] == [0.5, 0.4, 0.3, 0.2, 0.1, 0.0]
    impact = np.array(data["impact"]) / 100 + recording_of(da, scenario, None).origin
    np.testing.assert_allclose(impact, da.collision(scenario).point[:2], atol=CENTIMETRE_ROUNDING)


def test_the_pair_is_as_near_as_in_its_interactions(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident_scenario(da)
    pair = da.get("scenario", scenario)["collision"]["ids"]
    table = interactions(da, scenario)
    is_pair = (table.actor_ids == sorted(pair)).all(axis=1)
    rows = table.frame[is_pair] - 1
    gap_cm, ttc_ds = (np.array(data["pair"][name], dtype=float)[rows] for name in ("gap", "ttc"))

    assert len(gap_cm) == len(data["countdown"])
    np.testing.assert_allclose(gap_cm / 100, table.gap[is_pair], atol=CENTIMETRE_ROUNDING)
    ttc = table.ttc[is_pair]
    np.testing.assert_allclose(ttc_ds / 10, np.where(np.isinf(ttc), np.nan, ttc), atol=0.0501)


def test_without_a_collision_nothing_is_red(da_b: DeepAccident, tmp_path: Path) -> None:
    data = read_page_data(render_replay(da_b, normal_scenario(da_b), tmp_path / "normal.html"))
    assert (data["countdown"], data["impact"], data["pair"]) == ([None] * 4, None, None)
    assert {actor["role"] for actor in data["actors"]} == {"agent", "other"}
    assert all(actor["color"] != COLLIDER_COLOR for actor in data["actors"])


def test_labels_are_enough(da_b: DeepAccident, tmp_path: Path) -> None:
    data = read_page_data(render_replay(da_b, None, tmp_path / "replay.html"))
    assert data["scenario"] == accident_scenario(da_b)
    assert (data["cameras"], data["points"]) == ([[]] * 5, None)
    assert all(any(actor["states"]) for actor in data["actors"])


def test_without_labels_there_are_the_agents(own_release: Path, tmp_path: Path) -> None:
    for folder in sorted(own_release.rglob("label")):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    data = read_page_data(render_replay(dataset, None, tmp_path / "replay.html"))

    assert data["actors"] == []
    assert [len(agent["poses"]) for agent in data["agents"]] == [4] * 5
    assert data["countdown"][-1] == 0
