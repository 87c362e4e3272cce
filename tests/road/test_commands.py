"""From two dataroots to numbers by both rules: train on both, predict the road, and evaluate."""

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner
from nuscenes import NuScenes
from nuscenes.eval.common.config import config_factory
from nuscenes.eval.detection.evaluate import DetectionEval

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.evaluation import DetectedBoxes, ResultsWriter
from deepaccident_devkit.plugins.nuscenes.results import NUSCENES_RESULTS_FILE, write_detections
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

PAGE = Path(__file__).parents[2] / "docs" / "nuscenes.md"
TRAIN = ["--preset", "tiny", "--labels", "fiery", "--steps", "2", "--validation", "none"]


def run(*words: object) -> str:
    result = CliRunner().invoke(deepaccident, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def trained(pair, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on both, and one that goes on from it on the road alone."""
    folder = tmp_path_factory.mktemp("runs")
    both = ["--also", pair.folder, "--mix", "0.5", "--focal", "100", "--agents", "single"]
    run("train", pair.release.dataroot, *TRAIN, *both, "--out", folder / "both")
    run("train", pair.folder, *TRAIN, "--focal", "100", "--agents", "single", "--from", folder / "both",  # noqa: E501
        "--out", folder / "road")  # fmt: skip
    return folder


def test_the_code_of_the_page_runs(pair, capsys: pytest.CaptureFixture[str]) -> None:
    [code] = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    exec(code.replace("data/nuscenes", str(pair.folder)), {})  # noqa: S102 - the page's own
    assert "Box(" in capsys.readouterr().out


def test_both_are_learned_from(trained: Path) -> None:
    notes = json.loads((trained / "both" / "run.json").read_text())
    assert (notes["focal"], notes["labels"], notes["also"]["mix"]) == (100.0, "fiery", 0.5)
    assert len((trained / "both" / "log.jsonl").read_text().splitlines()) == 2


def test_the_road_is_predicted_and_evaluated_by_its_rules(
    pair, trained: Path, tmp_path: Path
) -> None:
    out = tmp_path / "results"
    told = run("predict", trained / "road", pair.folder, "--agents", "single", "--samples", "all", "--split", "val",  # noqa: E501
               "--out", out)  # fmt: skip
    assert str(out / NUSCENES_RESULTS_FILE) in told
    fiery = ["--split", "val", "--samples", "all", "--switch", "labels=fiery"]
    assert "vpq 100x100" in run(
        "evaluate", "motion", pair.folder, "--results", out / "motion", *fiery
    )
    ours = run(
        "evaluate", "detection", pair.folder, "--results", out / "detection.json", *fiery[:4]
    )
    assert "mean_average_precision" in ours or "mAP" in ours
    for name, source, results in (
        ("road", pair.folder, out),
        ("ours", pair.release.dataroot, tmp_path / "ours"),
    ):
        if name == "ours":
            run(
                "predict",
                "constant_velocity",
                source,
                "--task",
                "motion",
                *fiery[:4],
                "--out",
                results,
            )
        run(
            "evaluate",
            "motion",
            source,
            "--results",
            results / "motion",
            *fiery,
            "--out",
            tmp_path / f"of_{name}",
        )
    both = run("evaluate", "compare", tmp_path / "of_road", tmp_path / "of_ours")
    assert f"{pair.folder}, v1.0-deepaccident" in both
    assert "no sample in common" in both
    document = json.loads((out / NUSCENES_RESULTS_FILE).read_text())
    assert len(document["results"]) == 7 * len(pair.road.split_scenarios("val"))


def test_what_is_true_has_ap_1_by_nuscenes_own_evaluation(pair, tmp_path: Path) -> None:
    tokens = pair.road.samples("train", "all")
    with ResultsWriter(
        tmp_path / "detection.json", "detection", meta={"method": "truth"}
    ) as writer:
        for token in tokens:
            boxes = pair.road.boxes(token)
            boxes = boxes.select(
                (boxes.actor_id != OWN_ACTOR_ID) & (boxes.num_lidar_pts > 0)
            )  # others are no truth
            arrays = (boxes.center, boxes.size, boxes.yaw, [0.9] * len(boxes))
            how = {"frame": "world", "category": boxes.category, "velocity": boxes.velocity[:, :2]}
            writer.add(token, DetectedBoxes.from_arrays(*arrays, **how))
    path = write_detections(pair.road, tmp_path / "detection.json")
    nusc = NuScenes("v1.0-deepaccident", str(pair.folder), verbose=False)
    config = config_factory("detection_cvpr_2019")
    evaluation = DetectionEval(
        nusc, config, str(path), "deepaccident_train", str(tmp_path / "out"), verbose=False
    )
    metrics, _ = evaluation.evaluate()
    present = {box.detection_name for box in evaluation.gt_boxes.all}
    assert {"car", "pedestrian"} <= present
    for name in present:
        assert metrics.mean_dist_aps[name] == pytest.approx(1.0, abs=1e-6)


def test_rigs_say_what_is_odd(pair, tmp_path: Path) -> None:
    told = json.loads(
        run(
            "sensor-setups",
            pair.release.dataroot,
            pair.folder,
            "--json",
            "--out",
            tmp_path / "rigs.png",
        )
    )
    ours, road = told["sources"]
    assert ours["cameras"] == road["cameras"]
    assert (ours["labels_a_second"], road["labels_a_second"]) == (10.0, 2.0)
    assert "2 labels a second, not 10" in told["odd"]
    assert (tmp_path / "rigs.png").stat().st_size > 10_000


def test_either_source_is_rendered(pair, tmp_path: Path) -> None:
    token = pair.road.samples("train", "all")[0]
    for source, of, name in (
        (pair.folder, token, "road"),
        (pair.release.dataroot, pair.ours[token], "ours"),
    ):
        run("render", "sample", source, of, "--out", tmp_path / f"{name}.png")
        run("render", "labels", source, of, "--out", tmp_path / f"{name}-labels.png")
    assert (tmp_path / "road.png").exists()
