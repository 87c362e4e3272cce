"""Measure nuscenes-devkit's part of `beside`, in an environment without ours: `python
beside_nuscenes.py FOLDER`.

FOLDER holds `export/`. `detections.json` is written there, with true boxes about a metre off. The
measured times and the memory are printed as JSON.
"""

import json
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
from nuscenes import NuScenes
from nuscenes.eval.common.config import config_factory
from nuscenes.eval.detection.evaluate import DetectionEval
from nuscenes.eval.detection.utils import category_to_detection_name
from nuscenes.prediction import PredictHelper
from nuscenes.utils.data_classes import LidarPointCloud
from nuscenes.utils.geometry_utils import points_in_box

VERSION, SPLIT = "v1.0-deepaccident", "deepaccident_train"
CLOUDS = 10
META = {
    name: name == "use_lidar"
    for name in ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")
}


def main(folder: Path) -> dict[str, float]:
    bytes_before = resident_bytes()
    start = time.process_time()
    nusc = NuScenes(VERSION, str(folder / "export"), verbose=False)
    for sample in nusc.sample:
        nusc.get_sample_data(sample["data"]["LIDAR_TOP"])
    tables = time.process_time() - start
    memory = resident_bytes() - bytes_before
    write_detections(nusc, folder / "detections.json")
    boxes_and_clouds = []
    for sample in nusc.sample[:CLOUDS]:
        token = sample["data"]["LIDAR_TOP"]
        _, boxes, _ = nusc.get_sample_data(token)
        cloud = LidarPointCloud.from_file(nusc.get_sample_data_path(token))
        boxes_and_clouds.append((boxes, cloud))
    start = time.process_time()
    for boxes, cloud in boxes_and_clouds:
        for box in boxes:
            points_in_box(box, cloud.points[:3])
    points = (time.process_time() - start) / CLOUDS
    windows = [time_windows(nusc, in_agent_frame=in_frame) for in_frame in (True, False)]
    start = time.process_time()
    config = config_factory("detection_cvpr_2019")
    DetectionEval(
        nusc, config, str(folder / "detections.json"), SPLIT, str(folder / "out"), verbose=False
    ).evaluate()
    evaluation = time.process_time() - start
    return {
        "tables_and_boxes": 1e3 * tables,
        "tables_and_boxes_memory": memory / 1e6,
        "points_in_boxes": 1e3 * points,
        "windows_of_tracks": 1e3 * windows[0],
        "windows_of_tracks_in_world": 1e3 * windows[1],
        "detection_evaluation": 1e3 * evaluation,
    }


def time_windows(nusc: NuScenes, *, in_agent_frame: bool) -> float:
    """Return the seconds for the past 2 s and the future 3 s of all actors of a sample, at 2 Hz.

    With `in_agent_frame`, each actor's states are in its own frame, otherwise in the world.
    """
    helper = PredictHelper(nusc)
    start = time.process_time()
    for sample in nusc.sample:
        helper.get_past_for_sample(sample["token"], 2, in_agent_frame=in_agent_frame)
        helper.get_future_for_sample(sample["token"], 3, in_agent_frame=in_agent_frame)
    return (time.process_time() - start) / len(nusc.sample)


def resident_bytes() -> int:
    """Return the resident memory of this process, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def write_detections(nusc: NuScenes, path: Path) -> None:
    """Write the true boxes of the split as detections, about a metre off."""
    source = np.random.default_rng(0)
    splits = json.loads((Path(nusc.table_root) / "splits.json").read_text())
    scenes = set(splits[SPLIT])
    results = {}
    for sample in nusc.sample:
        if nusc.get("scene", sample["scene_token"])["name"] not in scenes:
            continue
        results[sample["token"]] = boxes = []
        for token in sample["anns"]:
            record = nusc.get("sample_annotation", token)
            name = category_to_detection_name(record["category_name"])
            if name is None:
                continue
            center = np.array(record["translation"]) + source.normal(0, 0.6, 3)
            velocity = nusc.box_velocity(token)[:2]
            attribute = nusc.get("attribute", record["attribute_tokens"][0])
            boxes.append(
                {
                    "sample_token": sample["token"],
                    "translation": center.tolist(),
                    "size": record["size"],
                    "rotation": record["rotation"],
                    "velocity": np.nan_to_num(velocity).tolist(),
                    "detection_name": name,
                    "detection_score": float(source.random()),
                    "attribute_name": attribute["name"],
                }
            )
    path.write_text(json.dumps({"meta": META, "results": results}))


if __name__ == "__main__":
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        measured = main(Path(sys.argv[1]))
    print(json.dumps(measured))
