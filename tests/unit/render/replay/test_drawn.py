"""A replay shows what tasks draw: paths, boxes, contacts and alarms, in the page's coordinates."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from support.expected_errors import assert_raises
from support.replay_page import accident_scenario, normal_scenario, read_page_data

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.render import replay
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    Forecast,
    Plan,
    ResultsWriter,
    instances_of,
    read_results,
)
from deepaccident_devkit.evaluation.forecasting.truth import forecasting_truth
from deepaccident_devkit.evaluation.planning import planning_scene
from deepaccident_devkit.evaluation.predictions import labels_at_present
from deepaccident_devkit.motion import MotionLabelConfig, motion_labels
from deepaccident_devkit.render.outcomes.drawings import ROLE_COLORS
from deepaccident_devkit.render.replay import recording_of
from deepaccident_devkit.render.replay.drawn import drawing_entries
from deepaccident_devkit.render.replay.entries import actor_entries
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

CENTIMETRE_ROUNDING = 0.00501  # metres


def written_results(folder: Path, kind: Any, predictions: Mapping[str, Any]) -> Path:
    path = folder / f"{kind}.json"
    with ResultsWriter(path, kind) as writer:
        for token, prediction in predictions.items():
            writer.add(token, prediction)
    return path


def replayed(dataset: DeepAccident, path: Path, task: str | None = None) -> dict[str, Any]:
    """Return the predictions of the page, without the rest of it."""
    recording = recording_of(dataset, accident_scenario(dataset), None)
    return drawing_entries(recording, read_results(path), task)


def world_points(dataset: DeepAccident, points: Any) -> Any:
    """Return the page's points in world, metres."""
    origin = recording_of(dataset, accident_scenario(dataset), None).origin
    return np.array(points) / 100 + origin


def colliding_plan(dataset: DeepAccident, sample: str) -> Plan:
    """Plan to go where the nearest actor is in 0.2 s."""
    later = planning_scene(dataset, sample).footprint[2]
    rows = np.flatnonzero(np.isfinite(later[:, 0]))
    position = later[rows[np.hypot(*later[rows, :2].T).argmin()], :2]
    return Plan(times=np.array([0.2, 3.0]), path=np.stack([position, position + 0.1]))


def test_plans_are_drawn_with_the_time_of_their_contact(
    da: DeepAccident, approach_sample: str, tmp_path: Path
) -> None:
    plan = colliding_plan(da, approach_sample)
    results = written_results(tmp_path, "planning", {approach_sample: [plan]})

    prediction = replayed(da, results)

    (sample,) = prediction["samples"]
    assert (sample["frame"], sample["agent"]) == (2, 0)
    planned = sample["lines"][0]
    assert planned["color"] == ROLE_COLORS["predicted"]
    assert planned["width"] > 1.0
    points = np.column_stack([plan.path, np.zeros(2)])
    expected = da.world_from(approach_sample, "ego").apply(points)[:, :2]
    drawn_points = world_points(da, planned["points"])[1:]  # the plan starts at the agent
    np.testing.assert_allclose(drawn_points, expected, atol=CENTIMETRE_ROUNDING)
    (place,) = sample["places"]
    assert 0 < place["time"] <= 0.2
    assert place["note"] == f"contact in {place['time']:.1f} s"
    assert sample["verdict"] == place["note"]
    assert place["color"] == ROLE_COLORS["collision"]
    boxes = [line for line in sample["lines"] if line["color"] == ROLE_COLORS["collision"]]
    assert [len(box["points"]) for box in boxes] == [5, 5]
    assert ("contact of the plan", ROLE_COLORS["collision"]) in prediction["legend"]


def test_forecasts_are_drawn_paler_when_improbable(
    da: DeepAccident, approach_sample: str, tmp_path: Path
) -> None:
    truth = forecasting_truth(da, approach_sample)
    forecasts = [
        Forecast(
            actor_id=actor,
            times=np.array([0.5, 3.0]),
            paths=np.stack([[present, present + 1.0], [present, present + 2.0]]),
            probabilities=np.array([0.2, 0.8]),
        )
        for actor, present in zip(truth.actor_id.tolist(), truth.present, strict=True)
    ]
    other = approach_sample.replace("003", "004")
    results = written_results(tmp_path, "forecasting", {approach_sample: forecasts, other: []})

    sample, empty = replayed(da, results)["samples"]

    predicted = [line for line in sample["lines"] if line["color"] == ROLE_COLORS["predicted"]]
    opacities = [line["opacity"] for line in predicted]
    assert opacities == [1.0] * len(forecasts) + [0.25] * len(forecasts)
    assert any(line["dashed"] for line in sample["lines"])  # the recorded paths
    assert (empty["lines"], empty["text"][-17:]) == ([], "nothing predicted")


def test_detected_boxes_have_the_colours_of_hits_and_misses(
    da: DeepAccident, approach_sample: str, tmp_path: Path
) -> None:
    """One true box is found, one box is false, and all other true boxes are missed."""
    boxes = da.boxes(approach_sample, "ego")
    others = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    nearest = np.argsort(np.linalg.norm(others.center, axis=1))[:1]
    far = np.array([[40.0, 30.0, 0.0]])
    detected = DetectedBoxes.from_arrays(
        np.vstack([others.center[nearest], far]),
        np.vstack([others.size[nearest], [[4.0, 2.0, 1.5]]]),
        np.append(others.yaw[nearest], 0.0),
        frame="ego",
        category=[others.category_names[int(nearest[0])], "car"],
        scores=[0.9, 0.8],
    ).transform(da.world_from(approach_sample, "ego"), "world")
    results = written_results(tmp_path, "detection", {approach_sample: detected})

    (sample,) = replayed(da, results)["samples"]

    by_color = {
        role: [line for line in sample["lines"] if line["color"] == ROLE_COLORS[role]]
        for role in ("right", "false", "missed")
    }
    (hit,) = by_color["right"]
    corners = detected.boxes.bottom_corners()[0, :, :2]
    drawn_corners = world_points(da, hit["points"])
    np.testing.assert_allclose(drawn_corners[:4], corners, atol=CENTIMETRE_ROUNDING)
    np.testing.assert_allclose(drawn_corners[4], corners[0], atol=CENTIMETRE_ROUNDING)
    assert len(by_color["false"]) == 1
    assert all(line["dashed"] and line["frames"] == [2, 2] for line in by_color["missed"])
    missed = len(by_color["missed"])
    assert sample["verdict"] == f"1 TP, 1 FP, {missed} FN"
    assert sample["color"] == ROLE_COLORS["missed"]


def test_alarms_are_marked_where_they_expect_the_accident(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    recording = recording_of(da_motion, accident_scenario(da_motion), None)

    prediction = drawing_entries(recording, predictions, None)

    right, silent, far = prediction["samples"]
    verdicts = [
        (sample["frame"], sample["agent"], sample["verdict"]) for sample in (right, silent, far)
    ]
    assert verdicts == [(19, 0, "alarm"), (29, 0, "no alarm"), (29, 4, "alarm")]
    assert right["color"] == ROLE_COLORS["collision"] != silent["color"]
    places = {place["label"]: place for place in right["places"]}
    predicted = places["predicted collision"]
    assert predicted["points"] == places["actual collision"]["points"]
    assert predicted["note"] == "in 1.5 s, score 0.75"
    # the pair's last positions on the page's own ground, in centimetres; a slope takes a few
    pair = [
        actor["states"][-1][:2] for actor in actor_entries(recording) if actor["role"] == "pair"
    ]
    np.testing.assert_allclose(sorted(predicted["points"]), sorted(pair), atol=8)
    assert len(far["places"]) == 4
    results = written_results(tmp_path, "accident", predictions)
    assert drawing_entries(recording, read_results(results), None) == prediction


def test_motion_is_drawn_when_it_is_predicted(da_motion: DeepAccident) -> None:
    """The prediction is the pair as the labels draw it, so its shapes move with the pair."""
    scenario = da_motion.get("scenario", accident_scenario(da_motion))
    token = f"{scenario['token']}/infrastructure/020"
    label = labels_at_present(motion_labels(da_motion, token, MotionLabelConfig()))
    pair = [label.id_map[actor] for actor in scenario["collision"]["ids"]]
    instance = np.where(np.isin(label.instance, pair), label.instance, 0)
    prediction = {token: instances_of(instance, label.config.grid)}
    recording = recording_of(da_motion, scenario, None)

    (sample,) = drawing_entries(recording, prediction, None)["samples"]
    (foreseen,) = drawing_entries(recording, prediction, "accident")["samples"]

    states = [actor["states"] for actor in actor_entries(recording) if actor["role"] == "pair"]
    shapes = [line for line in sample["lines"] if line.get("filled")]
    starts = [19, 24, 29, 34]  # until the recording ends
    assert [shape["frames"] for shape in shapes] == [
        [frame, frame + 4] for frame in starts for _ in pair
    ]
    for shape in shapes:
        assert shape["color"] == ROLE_COLORS["right"]
        center = np.mean(shape["points"][1:], axis=0)
        positions = np.array([actor[shape["frames"][0]][:2] for actor in states])
        assert np.linalg.norm(positions - center, axis=1).min() < 100  # centimetres
    assert sample["verdict"].startswith(f"{len(shapes)} TP, ")
    assert foreseen["verdict"] == "alarm"


@pytest.mark.parametrize(("score", "verdict"), [(0.9, "alarm"), (0.0, "no alarm")])
def test_warnings_are_a_strip_of_alarms(
    da: DeepAccident, approach_sample: str, tmp_path: Path, score: float, verdict: str
) -> None:
    alarm = Accident(positions=np.array([[8.0, 0.0], [9.0, 1.0]]), time=0.3, score=score)
    results = written_results(tmp_path, "accident", {approach_sample: [alarm]})

    prediction = replayed(da, results, "warning")

    (sample,) = prediction["samples"]
    assert "warning" in prediction["rule"]
    assert sample["verdict"] == verdict
    assert sample["alarm"] == {"score": score, "fires": verdict == "alarm"}
    assert {"actual collision"} <= {place["label"] for place in sample["places"]}


def test_the_command_draws_the_results_by_the_chosen_task(
    da_b: DeepAccident, tmp_path: Path
) -> None:
    token = f"{accident_scenario(da_b)}/ego_vehicle/002"
    alarm = Accident(positions=np.array([[8.0, 0.0], [9.0, 1.0]]), time=0.2, score=0.9)
    results = written_results(tmp_path, "accident", {token: [alarm]})
    out = tmp_path / "replay.html"
    options = ["--out", str(out), "--results", str(results), "--task", "warning"]

    result = CliRunner().invoke(replay, [str(da_b.dataroot), *options])

    assert result.exit_code == 0, result.output
    data = read_page_data(out)
    assert data["prediction"]["samples"][0]["verdict"] == "alarm"
    assert all(re.fullmatch("#[0-9a-f]{6}", color) for _, color in data["prediction"]["legend"])


def test_a_first_sample_without_predictions_is_of_any_task(
    da: DeepAccident, approach_sample: str
) -> None:
    recording = recording_of(da, accident_scenario(da), None)
    plan = colliding_plan(da, approach_sample)
    before = approach_sample.replace("003", "002")

    empty, planned = drawing_entries(recording, {before: [], approach_sample: [plan]}, None)[
        "samples"
    ]

    assert empty["text"].endswith("nothing predicted")
    assert planned["lines"]


def test_predictions_of_something_else_are_refused(
    da: DeepAccident, approach_sample: str, tmp_path: Path
) -> None:
    plans = {approach_sample: [colliding_plan(da, approach_sample)]}
    normal = normal_scenario(da)

    def render(prediction: Any, task: str | None = None, scenario: str | None = None) -> Any:
        path = tmp_path / "a.html"
        return lambda: da.render_replay(scenario, path, prediction=prediction, task=task)

    assert_raises(
        (render(plans, "forecasting"), ChoiceError, ("forecasting", "found planning")),
        (render(plans, "parking"), ChoiceError, ("parking",)),
        (render({approach_sample: [7]}), ChoiceError, ("found list",)),
        (render(plans, scenario=normal), NotAvailableError, ("prediction", normal, "ego_vehicle")),
    )
