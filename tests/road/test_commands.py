"""Train on two dataroots, predict the road, and evaluate by both sets of rules."""

import json
import re
from pathlib import Path

import pytest
from nuscenes import NuScenes
from nuscenes.eval.common.config import config_factory
from nuscenes.eval.detection.evaluate import DetectionEval
from support.command_calls import invoke_command

from deepaccident_devkit.evaluation import DetectedBoxes, ResultsWriter
from deepaccident_devkit.plugins.nuscenes.results import NUSCENES_RESULTS_FILE, write_detections
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

PAGE = Path(__file__).parents[2] / "docs" / "nuscenes.md"
TRAINING_OPTIONS = (
    *("--preset", "tiny", "--labels", "fiery", "--steps", 2, "--validation", "none"),
    *("--focal", 100, "--agents", "single"),
)
VALIDATION_SAMPLES = ("--split", "val", "--samples", "all")


@pytest.fixture(scope="module")
def trained(pair, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training run on both dataroots, and one that continues it on the road only."""
    folder = tmp_path_factory.mktemp("runs")
    both, road = folder / "both", folder / "road"
    mixed = ("--also", pair.folder, "--mix", 0.5)
    invoke_command("train", pair.release.dataroot, *TRAINING_OPTIONS, *mixed, "--out", both)
    invoke_command("train", pair.folder, *TRAINING_OPTIONS, "--from", both, "--out", road)
    return folder


def test_the_code_of_the_page_runs(pair, capsys: pytest.CaptureFixture[str]) -> None:
    [code] = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    runnable_code = code.replace("data/nuscenes", str(pair.folder))
    exec(runnable_code, {})  # noqa: S102 - the page's own
    assert "Box(" in capsys.readouterr().out


def test_both_dataroots_are_trained_on(trained: Path) -> None:
    run = trained / "both"
    notes = json.loads((run / "run.json").read_text())
    assert notes["focal"] == 100.0
    assert notes["labels"] == "fiery"
    assert notes["also"]["mix"] == 0.5
    assert len((run / "log.jsonl").read_text().splitlines()) == 2


def test_the_road_is_predicted_and_evaluated_by_its_rules(
    pair, trained: Path, tmp_path: Path
) -> None:
    road, simulation = pair.folder, pair.release.dataroot
    road_results, simulation_results = tmp_path / "road", tmp_path / "ours"
    options = ("--agents", "single", *VALIDATION_SAMPLES, "--out", road_results)
    predicted = invoke_command("predict", trained / "road", road, *options)
    assert str(road_results / NUSCENES_RESULTS_FILE) in predicted.stdout

    motion = evaluate("motion", road, road_results / "motion", "--switch", "labels=fiery")
    assert "VPQ, 100 m × 100 m" in motion

    detection = evaluate("detection", road, road_results / "detection.json")
    assert "mean_average_precision" in detection or "mAP" in detection

    options = ("--task", "motion", *VALIDATION_SAMPLES, "--out", simulation_results)
    invoke_command("predict", "constant_velocity", simulation, *options)
    bundles = []
    for source, results in ((road, road_results), (simulation, simulation_results)):
        bundles.append(tmp_path / f"{results.name}_bundle")
        options = ("--switch", "labels=fiery", "--out", bundles[-1])
        evaluate("motion", source, results / "motion", *options)
    comparison = invoke_command("evaluate", "compare", *bundles).stdout

    assert f"{road}, v1.0-deepaccident" in comparison
    assert "no sample in common" in comparison

    document = json.loads((road_results / NUSCENES_RESULTS_FILE).read_text())
    assert len(document["results"]) == 7 * len(pair.road.split_scenarios("val"))


def evaluate(task: str, source: Path, results: Path, *options: object) -> str:
    arguments = (source, "--results", results, *VALIDATION_SAMPLES, *options)
    return invoke_command("evaluate", task, *arguments).stdout


def test_true_boxes_have_ap_1_by_nuscenes_own_evaluation(pair, tmp_path: Path) -> None:
    results = tmp_path / "detection.json"
    with ResultsWriter(results, "detection", meta={"method": "truth"}) as writer:
        for token in pair.road.samples("train", "all"):
            boxes = pair.road.boxes(token)
            is_truth = (boxes.actor_id != OWN_ACTOR_ID) & (boxes.num_lidar_pts > 0)
            boxes = boxes.select(is_truth)
            detected = DetectedBoxes.from_arrays(
                boxes.center,
                boxes.size,
                boxes.yaw,
                [0.9] * len(boxes),
                frame="world",
                category=boxes.category,
                velocity=boxes.velocity[:, :2],
            )
            writer.add(token, detected)
    evaluation = DetectionEval(
        NuScenes("v1.0-deepaccident", str(pair.folder), verbose=False),
        config_factory("detection_cvpr_2019"),
        str(write_detections(pair.road, results)),
        "deepaccident_train",
        str(tmp_path / "out"),
        verbose=False,
    )
    metrics, _ = evaluation.evaluate()
    present = {box.detection_name for box in evaluation.gt_boxes.all}

    assert {"car", "pedestrian"} <= present
    for name in present:
        assert metrics.mean_dist_aps[name] == pytest.approx(1.0, abs=1e-6)


def test_sensor_setups_name_what_is_unusual(pair, tmp_path: Path) -> None:
    sources = (pair.release.dataroot, pair.folder)
    picture = tmp_path / "rigs.png"
    result = invoke_command("sensor-setups", *sources, "--json", "--out", picture)
    report = json.loads(result.stdout)
    ours, road = report["sources"]

    assert ours["cameras"] == road["cameras"]
    assert ours["labels_a_second"] == 10.0
    assert road["labels_a_second"] == 2.0
    assert "2 labels per second, not 10" in report["odd"]
    assert picture.stat().st_size > 10_000


def test_either_source_is_rendered(pair, tmp_path: Path) -> None:
    token = pair.road.samples("train", "all")[0]
    for source, sample, name in (
        (pair.folder, token, "road"),
        (pair.release.dataroot, pair.ours[token], "ours"),
    ):
        labels = tmp_path / f"{name}-labels.png"
        invoke_command("render", "sample", source, sample, "--out", tmp_path / f"{name}.png")
        invoke_command("render", "labels", source, sample, "--out", labels)

    assert (tmp_path / "road.png").exists()
