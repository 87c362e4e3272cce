"""Detections in the format of nuScenes' own evaluation: one JSON file, boxes in the world frame."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError, ResultsError
from deepaccident_devkit.evaluation import DetectedBoxes, read_results
from deepaccident_devkit.evaluation.results.writer import detection_entries
from deepaccident_devkit.plugins.nuscenes.classes import DETECTION_NAMES
from deepaccident_devkit.plugins.nuscenes.source import NuScenesRelease
from deepaccident_devkit.support.files import write_bytes

NUSCENES_RESULTS_FILE: Final = "nuscenes_detections.json"
# Largest number of boxes of a sample that nuScenes accepts.
_MAX_BOXES: Final = 500
# Speed in m/s above which an attribute calls an actor moving.
_MIN_MOVING_SPEED: Final = 0.2
_ATTRIBUTES: Final = {
    "pedestrian": ("pedestrian.standing", "pedestrian.moving"),
    **dict.fromkeys(("bicycle", "motorcycle"), ("cycle.without_rider", "cycle.with_rider")),
    **dict.fromkeys(("car", "truck"), ("vehicle.parked", "vehicle.moving")),
}


def write_detections(release: DeepAccident, results: Path) -> Path:
    """Write our detection results of keyframes to `nuscenes_detections.json` beside them.

    Returns the path. nuScenes' evaluation requires all samples of its split: predict all of them.

    Raises:
        ResultsError: The results are of another task.
        ConfigError: The release is not of nuScenes, or a sample is no keyframe.
        DeepAccidentError: `read_results` raises it.
    """
    if not isinstance(release, NuScenesRelease):
        raise ConfigError(
            f"{release.dataroot}: is no dataroot of nuScenes; open one with open_nuscenes"
        )
    content = read_results(results)
    if content.task != "detection":
        raise ResultsError(
            f"{results}: has results of {content.task}; nuScenes evaluates detections"
        )
    detections: dict[str, Any] = {
        release.nuscenes_token(token): content.prediction(token) for token in content.tokens
    }
    preset = content.meta.get("model", {}).get("preset", "tiny")
    document = {
        "meta": {
            "use_camera": preset != "tiny_lidar",
            "use_lidar": preset in ("tiny_lidar", "tiny_both"),
            **dict.fromkeys(("use_radar", "use_map", "use_external"), False),
        },
        "results": {token: _entries(token, boxes) for token, boxes in detections.items()},
    }
    path = results.parent / NUSCENES_RESULTS_FILE
    write_bytes(path, json.dumps(document).encode())
    return path


def _entries(token: str, detections: DetectedBoxes) -> list[dict[str, Any]]:
    """Return the best boxes of a sample, with nuScenes' classes and attributes."""
    best = (-detections.scores).argsort(kind="stable")[:_MAX_BOXES]
    best_boxes = DetectedBoxes(boxes=detections.boxes.select(best), scores=detections.scores[best])
    entries = detection_entries(token, best_boxes)
    for entry in entries:
        name = DETECTION_NAMES[entry["detection_name"]]
        velocity = entry["velocity"] or [math.nan, math.nan]
        is_moving = math.hypot(*velocity) > _MIN_MOVING_SPEED
        entry["detection_name"] = name
        entry["velocity"] = velocity
        entry["attribute_name"] = _ATTRIBUTES[name][is_moving]
    return entries
