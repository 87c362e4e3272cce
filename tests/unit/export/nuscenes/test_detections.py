"""Detections of a nuScenes export: read back under our tokens, classes and rules."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from refusals import assert_refused
from wording import lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation import DetectedBoxes
from deepaccident_devkit.evaluation.detection import detection_truth
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.results.writer import detection_entries
from deepaccident_devkit.export.nuscenes.detections import OTHER_CLASSES, results_from_nuscenes
from deepaccident_devkit.export.nuscenes.scenes import token

OURS = {
    "car": "car",
    "truck": "truck",
    "bicycle": "cyclist",
    "motorcycle": "motorcycle",
    "pedestrian": "pedestrian",
}


def entry(name: str = "car", **changes: object) -> dict[str, Any]:
    """A box as the nuScenes devkit writes it."""
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


def written(path: Path, boxes: dict[str, list[dict[str, Any]]], **more: object) -> Path:
    """A detection file of our samples → boxes, as a detector on the export writes it."""
    results = {
        token("sample", sample): [
            {"sample_token": token("sample", sample), **each} for each in given
        ]
        for sample, given in boxes.items()
    }
    path.write_text(json.dumps({"meta": {"use_lidar": True}, "results": results, **more}))
    return path


def verb(*words: object) -> Result:
    return CliRunner().invoke(deepaccident, list(map(str, words)), catch_exceptions=False)


@pytest.fixture
def sample(da_motion: DeepAccident) -> str:
    return da_motion.samples("train", "all")[0]


@pytest.mark.slow
def test_perfect_detections_of_an_export_evaluate_as_perfect(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    """Except vans, which a detector of nuScenes' classes cannot name."""
    theirs = {ours: name for name, ours in OURS.items()}
    truth = {}
    for sample in da_motion.samples("train", "all"):
        there = detection_truth(da_motion, sample, "paper").transform(
            da_motion.world_from(sample, "lidar"), "world"
        )
        entries = detection_entries(
            token("sample", sample), DetectedBoxes(boxes=there, scores=np.ones(len(there)))
        )
        named = [(theirs.get(each["detection_name"]), each) for each in entries]
        truth[sample] = [
            {**entry(), **each, "detection_name": name} for name, each in named if name
        ]
    count = sum(map(len, truth.values()))
    truth[sample].append(entry("barrier"))
    file, out = written(tmp_path / "nuscenes.json", truth), tmp_path / "ours.json"
    done = verb("results", file, da_motion.dataroot, "--out", out)
    assert not lacking(
        done.output,
        f"{count:,} boxes of {len(truth)} samples",
        "left out: 1 boxes of the class barrier",
    )
    assert read_results(out).meta == {"use_lidar": True}
    listed = (
        "--split",
        "train",
        "--samples",
        "all",
        "--protocol",
        "paper",
        "--resamples",
        "0",
        "--json",
    )
    summary = json.loads(
        verb("evaluate", "detection", da_motion.dataroot, "--results", out, *listed).stdout
    )
    found = {
        name: each["mean_AP"]
        for name, each in summary["metrics"]["classes"].items()
        if each["truths"] != [0]
    }
    assert found == {
        **dict.fromkeys(("car", "truck", "motorcycle", "pedestrian"), 100.0),
        "van": 0.0,
    }


def test_fields_mean_what_they_mean_in_nuscenes(
    da_motion: DeepAccident, tmp_path: Path, sample: str
) -> None:
    other = sample.replace("ego_vehicle", "infrastructure")
    names = [*OURS, "van", "cyclist", *OTHER_CLASSES, "bus"]
    given = [entry(name, detection_score=number / 16) for number, name in enumerate(names)]
    given[1]["velocity"] = [float("nan"), float("nan")]
    given[1]["ego_translation"] = [float("nan")] * 3
    found = results_from_nuscenes(
        da_motion, written(tmp_path / "nuscenes.json", {other: given, sample: []})
    )
    assert list(found.boxes) == [other, sample]
    boxes, scores = found.boxes[other].boxes, found.boxes[other].scores
    assert (boxes.frame, boxes.category_names) == ("world", [*OURS.values(), "van", "cyclist"])
    assert scores.tolist() == [number / 16 for number in range(7)]
    assert (boxes.center[0].tolist(), boxes.size[0].tolist()) == (
        [105.0, -33.0, 1.0],
        [4.5, 2.0, 1.5],
    )
    assert (boxes.yaw[0], boxes.velocity[0].tolist()) == (
        pytest.approx(2 * np.arctan2(0.8, 0.6)),
        [3.0, -4.0, 0.0],
    )
    assert np.isnan(boxes.velocity[1]).any()
    assert found.left_out == {
        "barrier": 1,
        "bus": 2,
        "construction_vehicle": 1,
        "traffic_cone": 1,
        "trailer": 1,
    }
    assert not len(found.boxes[sample])


REMEDY = "nuScenes export"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", "no JSON"),
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
def test_what_is_no_file_of_this_export(
    da_motion: DeepAccident, tmp_path: Path, content: str, told: str
) -> None:
    path = tmp_path / "nuscenes.json"
    path.write_text(content)
    assert_refused(
        (
            lambda: results_from_nuscenes(da_motion, path),
            ResultsError,
            f"nuscenes.json: .*{told}.*{REMEDY}",
        )
    )


@pytest.mark.parametrize(
    ("change", "told"),
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
    da_motion: DeepAccident, tmp_path: Path, sample: str, change: dict[str, object], told: str
) -> None:
    path = written(
        tmp_path / "nuscenes.json",
        {sample: [entry("bus"), entry(), entry(**{"name": "car", **change})]},
    )
    assert_refused(
        (
            lambda: results_from_nuscenes(da_motion, path),
            ResultsError,
            f"results of '{token('sample', sample)}': {told}.*{REMEDY}",
        )
    )


def test_only_keyframes_are_samples_of_the_export(
    da_motion: DeepAccident, tmp_path: Path, sample: str
) -> None:
    keys = da_motion.samples("train", "all")
    assert (
        list(
            results_from_nuscenes(
                da_motion, written(tmp_path / "a.json", {key: [] for key in keys})
            ).boxes
        )
        == keys
    )
    between = f"{sample[:-3]}{int(sample[-3:]) + 1:03d}"
    assert_refused(
        (
            lambda: results_from_nuscenes(da_motion, written(tmp_path / "b.json", {between: []})),
            ResultsError,
            f"{token('sample', between)}: ",
        )
    )


def test_the_verb_refuses_before_it_indexes(tmp_path: Path) -> None:
    (tmp_path / "there.json").write_text("{}")
    words = ("results",)
    assert_refused(
        (
            lambda: verb(
                *words,
                tmp_path / "there.json",
                tmp_path / "no release",
                "--out",
                tmp_path / "there.json",
            ),
            ResultsError,
            r"there\.json: is there already",
        )
    )
