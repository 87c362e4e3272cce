"""nuscenes-devkit's part of `beside`, in an environment without ours: `python beside_nuscenes.py
FOLDER`.

FOLDER holds `export/`. Writes `detections.json` there: true boxes a metre off. Prints what took how
long.
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
from nuscenes.utils.data_classes import LidarPointCloud
from nuscenes.utils.geometry_utils import points_in_box

VERSION, SPLIT = "v1.0-deepaccident", "deepaccident_train"
CLOUDS = 10
META = {
    name: name == "use_lidar"
    for name in ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")
}


def main(folder: Path) -> dict[str, float]:
    before, start = resident(), time.process_time()
    nusc = NuScenes(VERSION, str(folder / "export"), verbose=False)
    for sample in nusc.sample:
        nusc.get_sample_data(sample["data"]["LIDAR_TOP"])
    tables, memory = time.process_time() - start, resident() - before
    write_detections(nusc, folder / "detections.json")
    clouds = [sample["data"]["LIDAR_TOP"] for sample in nusc.sample[:CLOUDS]]
    read = [
        (
            nusc.get_sample_data(token)[1],
            LidarPointCloud.from_file(nusc.get_sample_data_path(token)),
        )
        for token in clouds
    ]
    start = time.process_time()
    for boxes, cloud in read:
        for box in boxes:
            points_in_box(box, cloud.points[:3])
    points = (time.process_time() - start) / CLOUDS
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
        "detection_evaluation": 1e3 * evaluation,
    }


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def write_detections(nusc: NuScenes, path: Path) -> None:
    source = np.random.default_rng(0)
    scenes = set(json.loads((Path(nusc.table_root) / "splits.json").read_text())[SPLIT])
    results = {}
    for sample in nusc.sample:
        if nusc.get("scene", sample["scene_token"])["name"] not in scenes:
            continue
        results[sample["token"]] = boxes = []
        for record in (nusc.get("sample_annotation", token) for token in sample["anns"]):
            name = category_to_detection_name(record["category_name"])
            if name is None:
                continue
            boxes.append(
                {
                    "sample_token": sample["token"],
                    "translation": (
                        np.array(record["translation"]) + source.normal(0, 0.6, 3)
                    ).tolist(),
                    "size": record["size"],
                    "rotation": record["rotation"],
                    "velocity": np.nan_to_num(nusc.box_velocity(record["token"])[:2]).tolist(),
                    "detection_name": name,
                    "detection_score": float(source.random()),
                    "attribute_name": nusc.get("attribute", record["attribute_tokens"][0])["name"],
                }
            )
    path.write_text(json.dumps({"meta": META, "results": results}))


if __name__ == "__main__":
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        found = main(Path(sys.argv[1]))
    print(json.dumps(found))
