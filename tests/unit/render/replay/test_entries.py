"""Where a replay has actors and agents, and who sees whom."""

import itertools
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from refusals import assert_refused
from replay_page import accident, data_of, normal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    Results,
    ResultsWriter,
    instances_of,
    read_results,
)
from deepaccident_devkit.evaluation.predictions import labels_at_present
from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, motion_labels
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.replay import recording_of, render_replay
from deepaccident_devkit.render.styles import AGENT_COLORS, CATEGORY_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x.tracks import scenario_tracks


def test_actors_are_where_their_tracks_say(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    origin, tracks = recording_of(da, scenario, None).origin, scenario_tracks(da, scenario)
    assert sorted(actor["id"] for actor in data["actors"]) == np.unique(tracks.actor_id).tolist()
    for actor in data["actors"]:
        rows = np.flatnonzero(tracks.actor_id == actor["id"])
        boxes, states = (
            tracks.boxes.select(rows),
            np.array([state for state in actor["states"] if state is not None]),
        )
        shown = [frame + 1 for frame, state in enumerate(actor["states"]) if state is not None]
        assert shown == tracks.index[rows].tolist()
        assert actor["title"].startswith(f"{boxes.category_names[0]} {actor['id']}")
        places = np.column_stack([states[:, :2] / 100 + origin, states[:, 4] / 100])
        np.testing.assert_allclose(places, boxes.center, atol=0.00501)
        np.testing.assert_allclose(states[:, 2] / 1000, boxes.yaw, atol=0.000501)
        np.testing.assert_allclose(
            [actor[side] / 100 for side in ("length", "width", "height")],
            boxes.size[0],
            atol=0.00501,
        )
        np.testing.assert_allclose(
            states[:, 5:] / 1000, quaternions.to_matrix(boxes.rotation)[:, :2, 2], atol=0.000501
        )


def test_who_sees_whom_is_the_released_rule(da: DeepAccident, data: dict[str, Any]) -> None:
    for (bit, agent), frame in itertools.product(enumerate(AGENTS), range(6)):
        seen = {actor["id"] for actor in data["actors"] if actor["seen"][frame] >> bit & 1}
        visible = da.visible_instances(f"{accident(da)}/{agent}/{frame + 1:03d}", agents=[agent])
        assert seen == {int(token.rsplit("/", 1)[1]) for token in visible} != set()


def test_the_pair_is_red_and_first_and_the_other_agents_have_their_hues(
    da: DeepAccident, data: dict[str, Any]
) -> None:
    pair = da.get("scenario", accident(da))["collision"]["ids"]
    agents = {agent["actor"]: agent for agent in data["agents"]}
    assert [actor["id"] for actor in data["actors"][:2]] == sorted(pair)
    for actor in data["actors"]:
        agent = agents.get(actor["id"])
        color = AGENT_COLORS[agent["name"]] if agent else CATEGORY_COLORS[actor["category"]]
        expected = agent["short"] if agent else "", COLLIDER_COLOR if actor["id"] in pair else color
        assert (actor["tag"], actor["color"]) == expected


def test_cameras_are_where_they_record(da: DeepAccident, data: dict[str, Any]) -> None:
    """A point that is 20 m before a camera has the same pixel with the page's numbers."""
    scenario, ahead = accident(da), np.array([[3.0, -2.0, 20.0]])
    origin = np.array([*recording_of(da, scenario, None).origin, 0.0])
    for agent, cameras in zip(AGENTS, data["cameras"], strict=True):
        assert [camera["title"] for camera in cameras] == [*map(camera_name, CAMERAS)]
        moments = (
            (*each, *at)
            for each in zip(CAMERAS, cameras, strict=True)
            for at in enumerate(each[1]["poses"], 1)
        )
        for channel, camera, frame, pose in moments:
            sample = f"{scenario}/{agent}/{frame:03d}"
            lens, there = da.camera(sample, channel), da.world_from(sample, channel)
            np.testing.assert_allclose(
                np.array(pose[:3]) / 100 + origin, there.translation, atol=0.00501
            )
            turned = quaternions.to_matrix(np.array(pose[3:]) / 10_000) @ ahead[0]
            np.testing.assert_allclose(turned, there.rotation @ ahead[0], atol=0.01)
            width, height, fx, fy, cx, cy = camera["lens"]
            assert (width, height) == (lens.width, lens.height)
            pixel = np.array([fx, fy]) * ahead[0, :2] / ahead[0, 2] + [cx, cy]
            np.testing.assert_allclose([pixel], lens.project(ahead)[0], atol=0.01)


def test_the_countdown_ends_at_the_impact(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = da.get("scenario", accident(da))
    contact = da.collision(scenario)
    assert data["countdown"] == [0.5, 0.4, 0.3, 0.2, 0.1, 0.0]
    origin = recording_of(da, scenario["token"], None).origin
    np.testing.assert_allclose(
        np.array(data["impact"]) / 100 + origin, contact.point[:2], atol=0.00501
    )


def test_the_pair_is_as_near_as_its_interactions_say(
    da: DeepAccident, data: dict[str, Any]
) -> None:
    found, pair = (
        interactions(da, accident(da)),
        da.get("scenario", accident(da))["collision"]["ids"],
    )
    own = (found.actor_ids == sorted(pair)).all(axis=1)
    gap, ttc = (
        np.array(data["pair"][name], dtype=float)[found.frame[own] - 1] for name in ("gap", "ttc")
    )
    assert len(gap) == len(data["countdown"])
    np.testing.assert_allclose(gap / 100, found.gap[own], atol=0.00501)
    np.testing.assert_allclose(
        ttc / 10, np.where(np.isinf(found.ttc[own]), np.nan, found.ttc[own]), atol=0.0501
    )


def test_where_nobody_collides_nothing_is_red(da_b: DeepAccident, tmp_path: Path) -> None:
    data = data_of(render_replay(da_b, normal(da_b), tmp_path / "normal.html"))
    assert (data["countdown"], data["impact"], data["pair"]) == ([None] * 4, None, None)
    roles, colors = ({actor[name] for actor in data["actors"]} for name in ("role", "color"))
    assert (roles, COLLIDER_COLOR in colors) == ({"agent", "other"}, False)


def test_labels_alone_are_enough(da_b: DeepAccident, tmp_path: Path) -> None:
    data = data_of(render_replay(da_b, None, tmp_path / "replay.html"))
    assert (data["scenario"], data["cameras"], data["points"]) == (accident(da_b), [[]] * 5, None)
    assert all(any(state for state in actor["states"]) for actor in data["actors"])


def test_without_labels_there_are_the_agents(own_release: Path, tmp_path: Path) -> None:
    for folder in sorted(own_release.rglob("label")):
        shutil.rmtree(folder)
    data = data_of(
        render_replay(
            DeepAccident("v1", own_release, verbose=False), None, tmp_path / "replay.html"
        )
    )
    assert (data["actors"], [len(agent["poses"]) for agent in data["agents"]]) == ([], [4] * 5)
    assert data["countdown"][-1] == 0


def test_each_sample_has_its_verdict(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    data = data_of(render_replay(da_motion, None, tmp_path / "a.html", prediction=predictions))
    right, far, _, many = samples = data["prediction"]["samples"]
    assert [(each["frame"], each["agent"], each["verdict"]) for each in samples] == [
        (19, 0, "TP"),
        (24, 0, "FP + FN"),
        (29, 0, "FN"),
        (29, 4, "4 FP + FN"),
    ]
    (hit,), (miss,), (unknown, *others) = right["alarms"], far["alarms"], many["alarms"]
    assert (hit["right"], hit["time"]) == (True, 1.5)
    assert (miss["right"], "places off by 40.0 m" in miss["text"]) == (False, True)
    assert (len(others), many["more"], "names an unknown actor" in unknown["text"]) == (2, 1, True)
    # the foreseen places are those of the pair at the end, in the page's own ground: centimetres; a
    # slope takes a few
    pair = [actor["states"][-1][:2] for actor in data["actors"] if actor["role"] == "pair"]
    np.testing.assert_allclose(sorted(hit["places"]), sorted(pair), atol=8)


def stored(path: Path, task: Any, given: Mapping[str, Any], **how: Any) -> Results:
    with ResultsWriter(path, task, **how) as writer:
        for token, prediction in given.items():
            writer.add(token, prediction)
    return read_results(path)


def test_results_files_give_the_same_page(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    results = stored(tmp_path / "results.json", "accident", predictions)
    by_token = render_replay(da_motion, None, tmp_path / "a.html", prediction=predictions)
    by_file = render_replay(da_motion, None, tmp_path / "b.html", prediction=results)
    assert by_file.read_bytes() == by_token.read_bytes()


def test_motion_is_read_for_accidents(da_motion: DeepAccident, tmp_path: Path) -> None:
    """The pair as the labels draw it, and nobody else, as prediction: the true accident is
    foreseen.
    """
    config, ego, given = MotionLabelConfig(), f"{accident(da_motion)}/ego_vehicle", {}
    ids = da_motion.get("scenario", accident(da_motion))["collision"]["ids"]
    for token in (f"{ego}/020", f"{ego}/030"):
        label = labels_at_present(motion_labels(da_motion, token, config))
        pair = [label.id_map[each] for each in (OWN_BOX_ID, *ids) if each in label.id_map]
        shown = np.where(np.isin(label.instance, pair), label.instance, 0)
        given[token] = instances_of(shown, config.grid)
    by_token = render_replay(da_motion, None, tmp_path / "a.html", prediction=given)
    assert [each["verdict"] for each in data_of(by_token)["prediction"]["samples"]] == ["TP", "TP"]


def test_predictions_of_something_else_are_refused(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    token = next(iter(predictions))
    boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame="world")
    detected = DetectedBoxes(boxes=boxes, scores=np.zeros(0))
    detection = stored(tmp_path / "boxes.json", "detection", {token: detected})

    def replay(prediction: Any, scenario: str | None = None) -> Callable[[], object]:
        return lambda: render_replay(
            da_motion, scenario, tmp_path / "a.html", prediction=prediction
        )

    assert_refused(
        (
            replay(predictions, normal(da_motion)),
            NotAvailableError,
            ("prediction", normal(da_motion), "ego_vehicle"),
        ),
        (replay(detection), EvaluationError, ("holds detection results", "motion or accident")),
        (
            replay({token: [7]}),
            EvaluationError,
            ("a MotionOutput or a list of Accidents", "list with int"),
        ),
    )
