"""Our part of what `beside_nuscenes.py` does: `python -m benchmarks.beside_devkit FOLDER`.

FOLDER holds `release/`, and in `detections.json` what nuscenes-devkit evaluated. Prints what took
how long.
"""

import json
import sys
import time
from pathlib import Path

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.export.frames import keyframes

THRESHOLDS = (0.5, 1.0, 2.0, 4.0)
CLOUDS = 10


def main(folder: Path) -> dict[str, float]:
    before, start = resident(), time.process_time()
    da = DeepAccident(dataroot=folder / "release", verbose=False)
    keys = {scenario["token"]: set(keyframes(scenario["num_frames"])) for scenario in da.scenario}
    tokens = [
        each["token"]
        for each in da.sample
        if int(each["token"][-3:]) in keys[each["scenario_token"]]
    ]
    for token in tokens:
        da.get_boxes(token, "lidar")
    tables, memory = time.process_time() - start, resident() - before
    read = [(da.boxes(token, "lidar"), da.load_point_cloud(token)) for token in tokens[:CLOUDS]]
    start = time.process_time()
    for boxes, cloud in read:
        boxes.contains(cloud.points[:, :3])
    points = (time.process_time() - start) / CLOUDS
    results = folder / "results.json"
    if not results.exists():
        made = [
            "results",
            str(folder / "detections.json"),
            str(folder / "release"),
            "--out",
            str(results),
        ]
        deepaccident.main(made, standalone_mode=False)
    setup = EvaluationSetup(task="detection", protocol="paper", switches={"thresholds": THRESHOLDS})
    selection = SampleSelection(split="train", samples="all", scope="all")
    start = time.process_time()
    evaluate_results(da, results, setup, selection, workers=1)
    evaluation = time.process_time() - start
    return {
        "tables_and_boxes": 1e3 * tables,
        "tables_and_boxes_memory": memory / 1e6,
        "points_in_boxes": 1e3 * points,
        "detection_evaluation": 1e3 * evaluation,
    }


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]))))
