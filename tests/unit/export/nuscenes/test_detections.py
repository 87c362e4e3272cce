"""Detections on a nuScenes export are read back with our tokens, classes and rules."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_calls import invoke_command

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation import DetectedBoxes
from deepaccident_devkit.evaluation.detection import detection_truth
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.results.writer import detection_entries
from deepaccident_devkit.export.nuscenes.detections import OTHER_CLASSES, results_from_nuscenes
from deepaccident_devkit.export.nuscenes.scenes import token

REMEDY = "nuScenes export"
OUR_CLASSES = {
    "car": "car",
    "truck": "truck",
    "bicycle": "cyclist",
    "motorcycle": "motorcycle",
    "pedestrian": "pedestrian",
}


def make_entry(name: str = "car", **changes: object) -> dict[str, Any]:
    """Make a box as the nuScenes devkit writes it."""
    return {
        "translation": [105.0, -33.0, 1.0],
        "size": [2.0, 4.5, 1.5],
        "rotation": [0.6, 0.0, 0.0, 0.8],
        "velocity": [3.0, -4.0],
        "ego_translation": [0, 0, 0],
        "num_pts": -1,
        "detection_name": name,
        "detection_score": 0.75,
        "attribute_name": "vehicle.moving",
        **changes,
    }


def write_detections(path: Path, entries_by_sample: dict[str, list[dict[str, Any]]]) -> Path:
    """Write a detection file as a detector on the export does, with boxes by our samples."""
    results = {}
    for sample, entries in entries_by_sample.items():
        sample_token = token("sample", sample)
        results[sample_token] = [{"sample_token": sample_token, **entry} for entry in entries]
    path.write_text(json.dumps({"meta": {"use_lidar": True}, "results": results}))
    return path


@pytest.fixture
def sample(da_motion: DeepAccident) -> str:
    return da_motion.samples("train", "all")[0]


@pytest.mark.slow
def test_perfect_detections_of_an_export_evaluate_as_perfect(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    """Vans are the exception, because a detector of nuScenes' classes cannot name them."""
    nuscenes_classes = {ours: name for name, ours in OUR_CLASSES.items()}
    truth = {}
    for sample in da_motion.samples("train", "all"):
        world_from_lidar = da_motion.world_from(sample, "lidar")
        boxes = detection_truth(da_motion, sample, "paper").transform(world_from_lidar, "world")
        detected = DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))
        truth[sample] = []
        for entry in detection_entries(token("sample", sample), detected):
            name = nuscenes_classes.get(entry["detection_name"])
            if name:
                truth[sample].append({**make_entry(), **entry, "detection_name": name})
    num_boxes = sum(map(len, truth.values()))
    truth[sample].append(make_entry("barrier"))

    path = write_detections(tmp_path / "nuscenes.json", truth)
    out = tmp_path / "ours.json"
    result = invoke_command("results", path, da_motion.dataroot, "--out", out)

    assert f"({len(truth)} samples, {num_boxes:,} boxes)" in result.output
    assert "excluded: 1 box of class barrier" in result.output
    assert read_results(out).meta == {"use_lidar": True}

    result = invoke_command(
        *("evaluate", "detection", da_motion.dataroot),
        *("--results", out, "--split", "train", "--samples", "all"),
        *("--protocol", "paper", "--resamples", 0, "--json"),
    )
    scores = json.loads(result.stdout)["metrics"]["classes"]
    precisions = {name: row["mean_AP"] for name, row in scores.items() if row["truths"] != [0]}

    assert precisions == {
        "car": 100.0,
        "truck": 100.0,
        "motorcycle": 100.0,
        "pedestrian": 100.0,
        "van": 0.0,
    }


def test_fields_mean_what_they_mean_in_nuscenes(
    da_motion: DeepAccident, tmp_path: Path, sample: str
) -> None:
    other = sample.replace("ego_vehicle", "infrastructure")
    names = [*OUR_CLASSES, "van", "cyclist", *OTHER_CLASSES, "bus"]
    entries = [make_entry(name, detection_score=index / 16) for index, name in enumerate(names)]
    entries[1]["velocity"] = [float("nan"), float("nan")]
    entries[1]["ego_translation"] = [float("nan")] * 3
    path = write_detections(tmp_path / "nuscenes.json", {other: entries, sample: []})
    results = results_from_nuscenes(da_motion, path)

    assert list(results.boxes) == [other, sample]

    boxes = results.boxes[other].boxes
    assert boxes.frame == "world"
    assert boxes.category_names == [*OUR_CLASSES.values(), "van", "cyclist"]
    assert results.boxes[other].scores.tolist() == [index / 16 for index in range(7)]
    assert boxes.center[0].tolist() == [105.0, -33.0, 1.0]
    assert boxes.size[0].tolist() == [4.5, 2.0, 1.5]
    assert boxes.yaw[0] == pytest.approx(2 * np.arctan2(0.8, 0.6))
    assert boxes.velocity[0].tolist() == [3.0, -4.0, 0.0]
    assert np.isnan(boxes.velocity[1]).any()
    assert results.left_out == {
        "barrier": 1,
        "bus": 2,
        "construction_vehicle": 1,
        "traffic_cone": 1,
        "trailer": 1,
    }
    assert not len(results.boxes[sample])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not JSON"),
        ("[]", r"\[\]"),
        ('{"meta": {}}', "results: .*null"),
        ('{"meta": 3, "results": {}}', "meta: .*3"),
        ('{"results": {}}', "results: .*{}"),
        ('{"format": "DeepAccident results"}', "`deepaccident evaluate`"),
        (
            '{"results": {"fd84": []}}',
            "fd84",
        ),
        ('{"results": {"fd84": {}}}', "'fd84'"),
        ('{"results": {"fd84": [3]}}', r"'fd84'.*\[0\]"),
    ],
)
def test_files_of_another_kind_are_refused(
    da_motion: DeepAccident, tmp_path: Path, content: str, message: str
) -> None:
    path = tmp_path / "nuscenes.json"
    path.write_text(content)
    with pytest.raises(ResultsError, match=f"nuscenes.json: .*{message}.*{REMEDY}"):
        results_from_nuscenes(da_motion, path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"translation": [0.0, float("nan"), 0.0]}, "entry 2: translation: entry 1"),
        ({"rotation": [2.0, 0.0, 0.0, 0.0]}, r"\[2\].rotation"),
        (
            {"detection_name": "tram"},
            r"\[2\].detection_name: expected one of car, .*, found \"tram\"",
        ),
        (
            {"detection_name": ["car"]},
            r"\[2\].detection_name: expected one of car, .*, found \[\"car\"\]",
        ),
        ({"velocity": "fast"}, r"\[2\].velocity"),
        ({"sample_token": "another"}, r"\[2\].sample_token"),
        ({"tracking_id": 3}, r"\[2\].*`tracking_id`"),
    ],
)
def test_the_first_wrong_box_is_named(
    da_motion: DeepAccident, tmp_path: Path, sample: str, change: dict[str, object], message: str
) -> None:
    entries = [make_entry("bus"), make_entry(), make_entry(**change)]
    path = write_detections(tmp_path / "nuscenes.json", {sample: entries})
    prefix = f"results of '{token('sample', sample)}'"
    with pytest.raises(ResultsError, match=f"{prefix}: {message}.*{REMEDY}"):
        results_from_nuscenes(da_motion, path)


def test_only_keyframes_are_samples_of_the_export(
    da_motion: DeepAccident, tmp_path: Path, sample: str
) -> None:
    keyframes = da_motion.samples("train", "all")
    path = write_detections(tmp_path / "a.json", {keyframe: [] for keyframe in keyframes})
    assert list(results_from_nuscenes(da_motion, path).boxes) == keyframes

    between = f"{sample[:-3]}{int(sample[-3:]) + 1:03d}"
    path = write_detections(tmp_path / "b.json", {between: []})
    with pytest.raises(ResultsError, match=f"{token('sample', between)}: "):
        results_from_nuscenes(da_motion, path)


def test_the_command_refuses_an_existing_file_before_it_indexes(tmp_path: Path) -> None:
    existing = tmp_path / "there.json"
    existing.write_text("{}")
    with pytest.raises(ResultsError, match=r"there\.json: already exists"):
        invoke_command("results", existing, tmp_path / "no release", "--out", existing)
