"""Measure our part of what `beside_nuscenes.py` does: `python -m benchmarks.beside_devkit FOLDER`.

FOLDER holds `release/`, and `detections.json` with what nuscenes-devkit evaluated. The measured
times and the memory are printed as JSON.
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
    bytes_before = resident_bytes()
    start = time.process_time()
    da = DeepAccident(dataroot=folder / "release", verbose=False)
    keyframe_numbers = {
        scenario["token"]: set(keyframes(scenario["num_frames"])) for scenario in da.scenario
    }
    tokens = []
    for sample in da.sample:
        frame = int(sample["token"][-3:])
        if frame in keyframe_numbers[sample["scenario_token"]]:
            tokens.append(sample["token"])
    for token in tokens:
        da.get_boxes(token, "lidar")
    tables = time.process_time() - start
    memory = resident_bytes() - bytes_before
    boxes_and_clouds = [
        (da.boxes(token, "lidar"), da.load_point_cloud(token)) for token in tokens[:CLOUDS]
    ]
    start = time.process_time()
    for boxes, cloud in boxes_and_clouds:
        boxes.contains(cloud.points[:, :3])
    points = (time.process_time() - start) / CLOUDS
    da.window(tokens[0])
    start = time.process_time()
    for token in tokens:
        da.window(token, past=2.0, future=3.0, step=0.1)
    windows = (time.process_time() - start) / len(tokens)
    results = folder / "results.json"
    if not results.exists():
        detections = str(folder / "detections.json")
        release = str(folder / "release")
        arguments = ["results", detections, release, "--out", str(results)]
        deepaccident.main(arguments, standalone_mode=False)
    setup = EvaluationSetup(task="detection", protocol="paper", switches={"thresholds": THRESHOLDS})
    selection = SampleSelection(split="train", samples="all", scope="all")
    start = time.process_time()
    evaluate_results(da, results, setup, selection, workers=1)
    evaluation = time.process_time() - start
    return {
        "tables_and_boxes": 1e3 * tables,
        "tables_and_boxes_memory": memory / 1e6,
        "points_in_boxes": 1e3 * points,
        # the same call beside two of nuscenes-devkit's
        "windows_of_tracks": 1e3 * windows,
        "windows_of_tracks_in_world": 1e3 * windows,
        "detection_evaluation": 1e3 * evaluation,
    }


def resident_bytes() -> int:
    """Return the resident memory of this process, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]))))
