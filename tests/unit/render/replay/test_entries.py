"""Where a replay has actors and agents, and who sees whom."""

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import assert_refused
from replay_page import accident, data_of, normal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation import Accident, instances_of
from deepaccident_devkit.evaluation.detection.boxes import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import labels_at_present
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, motion_labels
from deepaccident_devkit.render.replay import render_replay
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


def test_the_countdown_ends_at_the_impact(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    assert data["countdown"] == [0.5, 0.4, 0.3, 0.2, 0.1, 0.0]
    contact = da.collision(scenario)
    assert contact is not None
    origin = recording_of(da, scenario, None).origin
    assert_allclose(np.array(data["impact"]) / 100 + origin, contact.point[:2], atol=0.00501)
    facts = dict(data["facts"])
    collision = da.get("scenario", scenario)["collision"]
    first, second = collision["ids"]
    first_role, second_role = (agent.removesuffix("_vehicle") for agent in collision["agents"])
    kind, other_kind = collision["classes"]
    assert facts["Ends"] == f"{kind} {first} ({first_role}) and {other_kind} {second} ({second_role}) collide"
    assert facts["Speeds"].startswith(f"{kind} {first} {contact.speeds[0]:.1f} m/s")
    assert facts["Weather"].startswith(da.get("scenario", scenario)["weather"])


def test_where_nobody_collides_nothing_is_red(da_b: DeepAccident, tmp_path: Path) -> None:
    data = data_of(render_replay(da_b, normal(da_b), tmp_path / "normal.html"))
    assert data["countdown"] == [None] * 4
    assert data["impact"] is None
    assert dict(data["facts"])["Ends"] == "without a collision"
    assert {actor["role"] for actor in data["actors"]} == {"agent", "other"}
    assert COLLIDER_COLOR not in {actor["color"] for actor in data["actors"]}


def test_labels_alone_are_enough(da_b: DeepAccident, tmp_path: Path) -> None:
    data = data_of(render_replay(da_b, None, tmp_path / "replay.html"))
    assert data["scenario"] == accident(da_b)
    assert (data["cameras"], data["points"]) == ([[]] * 5, None)
    assert any(note.startswith("No pictures: none of the 120 camera files is here") for note in data["notes"])
    assert any(note.startswith("No LiDAR points: no file of ego is here") for note in data["notes"])
    assert all(any(state for state in actor["states"]) for actor in data["actors"])


def test_without_labels_there_are_the_agents(own_release: Path, tmp_path: Path) -> None:
    for folder in sorted(own_release.rglob("label")):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    data = data_of(render_replay(dataset, None, tmp_path / "replay.html"))
    assert data["actors"] == []
    assert [len(agent["poses"]) for agent in data["agents"]] == [4] * 5
    assert (
        data["notes"][0]
        == "The release has no labels of this scenario: the page has no boxes and does not show who sees whom."
    )
    assert any(note.startswith("How the accident happened is not known: ") for note in data["notes"])
    assert data["countdown"][-1] == 0


def test_each_sample_has_its_verdict(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    data = data_of(render_replay(da_motion, None, tmp_path / "a.html", prediction=predictions))
    samples = data["prediction"]["samples"]
    assert [(each["frame"], each["agent"], each["verdict"]) for each in samples] == [
        (19, 0, "TP"),
        (24, 0, "FP + FN"),
        (29, 0, "FN"),
        (29, 4, "4 FP + FN"),
    ]
    right, far, missed, many = samples
    assert [alarm["right"] for alarm in (*right["alarms"], *far["alarms"])] == [True, False]
    assert right["alarms"][0]["text"] == (
        "foreseen in 1.5 s, score 0.75: places off by 0.0 m, time by +0.0 s; names "
        f"{' and '.join(str(each) for each in da_motion.get('scenario', accident(da_motion))['collision']['ids'])}"
        ", who collide"
    )
    assert "places off by 40.0 m" in far["alarms"][0]["text"]
    assert missed["text"] == "ego at frame 30: an accident comes in 0.5 s"
    assert (len(many["alarms"]), many["more"]) == (3, 1)
    assert "names an unknown actor" in many["alarms"][0]["text"]
    # the foreseen places are those of the pair at the end, in the page's own ground: centimetres; a slope takes a few
    pair = [actor["states"][-1][:2] for actor in data["actors"] if actor["role"] == "pair"]
    assert_allclose(sorted(right["alarms"][0]["places"]), sorted(pair), atol=8)
    assert right["alarms"][0]["time"] == 1.5


def test_alarms_without_an_accident_are_false_or_not_judged(da_motion: DeepAccident, tmp_path: Path) -> None:
    ego = f"{normal(da_motion)}/ego_vehicle"
    anywhere = np.array([[1.0, 2.0], [3.0, 4.0]])
    given = {
        f"{ego}/010": [Accident(positions=anywhere, time=1.0)],
        f"{ego}/030": [Accident(positions=anywhere, time=1.9)],
        f"{ego}/031": [],
    }
    path = render_replay(da_motion, normal(da_motion), tmp_path / "a.html", prediction=given)
    samples = data_of(path)["prediction"]["samples"]
    assert [each["verdict"] for each in samples] == ["FP", "not judged", "TN"]
    assert samples[1]["alarms"][0]["text"].startswith(
        "foreseen in 1.9 s, score 1: it would be after the end of the recording"
    )


def test_results_files_give_the_same_page(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    with ResultsWriter(tmp_path / "results.json", "accident") as writer:
        for token, alarms in predictions.items():
            writer.add(token, alarms)
    by_token = render_replay(da_motion, None, tmp_path / "a.html", prediction=predictions)
    by_file = render_replay(da_motion, None, tmp_path / "b.html", prediction=read_results(tmp_path / "results.json"))
    assert by_file.read_bytes() == by_token.read_bytes()


def test_motion_is_read_for_accidents(da_motion: DeepAccident, tmp_path: Path) -> None:
    """The pair as the labels draw it, and nobody else, as prediction: the true accident is foreseen."""
    config = MotionLabelConfig()
    ego = f"{accident(da_motion)}/ego_vehicle"
    (other,) = set(da_motion.get("scenario", accident(da_motion))["collision"]["ids"]) - {
        da_motion.get("agent", ego)["actor_id"]
    }
    given = {}
    with ResultsWriter(tmp_path / "motion", "motion", grid=config.grid) as writer:
        for frame in (20, 30):
            token = f"{ego}/{frame:03d}"
            label = labels_at_present(motion_labels(da_motion, token, config))
            pair = np.isin(label.instance, [label.id_map[OWN_BOX_ID], label.id_map[other]])
            given[token] = instances_of(np.where(pair, label.instance, 0), config.grid)
            writer.add(token, given[token])
    by_token = render_replay(da_motion, None, tmp_path / "a.html", prediction=given)
    by_file = render_replay(da_motion, None, tmp_path / "b.html", prediction=read_results(tmp_path / "motion"))
    assert [each["verdict"] for each in data_of(by_token)["prediction"]["samples"]] == ["TP", "TP"]
    assert by_file.read_bytes() == by_token.read_bytes()


def test_predictions_of_something_else_are_refused(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    with pytest.raises(NotAvailableError, match=r"prediction: has no sample of .* and ego_vehicle, ego_vehicle_b"):
        render_replay(da_motion, normal(da_motion), tmp_path / "a.html", prediction=predictions)
    token = next(iter(predictions))
    boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame="world")
    with ResultsWriter(tmp_path / "boxes.json", "detection") as writer:
        writer.add(token, DetectedBoxes(boxes=boxes, scores=np.zeros(0)))
    assert_refused(
        (
            lambda: render_replay(
                da_motion, None, tmp_path / "a.html", prediction=read_results(tmp_path / "boxes.json")
            ),
            EvaluationError,
            "holds detection results; accident is evaluated from motion or accident",
        ),
        (
            lambda: render_replay(da_motion, None, tmp_path / "a.html", prediction={token: [7]}),
            EvaluationError,
            "expected a MotionOutput or a list of Accidents, found list with int",
        ),
    )
