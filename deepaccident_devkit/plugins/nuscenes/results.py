"""Detections in the format of nuScenes' own evaluation: a JSON file of boxes in the world frame."""

import json
import math
from pathlib import Path
from typing import Final

from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError, ResultsError
from deepaccident_devkit.evaluation import DetectedBoxes, read_results
from deepaccident_devkit.evaluation.results.writer import detection_entries
from deepaccident_devkit.plugins.nuscenes.classes import DETECTION_NAMES
from deepaccident_devkit.plugins.nuscenes.source import NuScenesRelease
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.values import NamedValues

NUSCENES_RESULTS_FILE: Final = "nuscenes_detections.json"
# Largest number of boxes for a sample that nuScenes accepts.
_MAX_BOXES = 500
# Speed above which the attribute of an actor says that it moves.
_MIN_MOVING_SPEED_MPS = 0.2
# Attributes of standing and of moving actors, by nuScenes' detection class.
_ATTRIBUTES = {
    "pedestrian": ("pedestrian.standing", "pedestrian.moving"),
    **dict.fromkeys(("bicycle", "motorcycle"), ("cycle.without_rider", "cycle.with_rider")),
    **dict.fromkeys(("car", "truck"), ("vehicle.parked", "vehicle.moving")),
}


def write_detections(release: DeepAccident, results: Path) -> Path:
    """Write our detections at keyframes to `nuscenes_detections.json` next to the results file.

    nuScenes' evaluation requires results for all samples of its split, so predict all of them.

    Args:
        release: The nuScenes release, from `open_nuscenes`.
        results: Path of our results file.

    Returns:
        The path of the new file.

    Raises:
        ResultsError: If the results belong to another task.
        ConfigError: If the release is not from nuScenes, or a sample is not a keyframe.
        DeepAccidentError: If `read_results` raises it.
    """
    if not isinstance(release, NuScenesRelease):
        raise ConfigError(
            f"{release.dataroot}: is not a nuScenes dataroot; open one with open_nuscenes"
        )
    content = read_results(results)
    if content.task != "detection":
        raise ResultsError(
            f"{results}: has results of {content.task}; nuScenes evaluates detections"
        )
    detections: NamedValues = {
        release.nuscenes_token(token): content.prediction(token) for token in content.tokens
    }
    preset = content.meta.get("model", {}).get("preset", "tiny")
    document = {
        "meta": {
            "use_camera": preset != "tiny_lidar",
            "use_lidar": preset in ("tiny_lidar", "tiny_both"),
            **dict.fromkeys(("use_radar", "use_map", "use_external"), False),
        },
        "results": {token: _make_entries(token, boxes) for token, boxes in detections.items()},
    }
    path = results.parent / NUSCENES_RESULTS_FILE
    write_bytes(path, json.dumps(document).encode())
    return path


def _make_entries(token: str, detections: DetectedBoxes) -> list[NamedValues]:
    """Return a sample's highest-scoring boxes, with nuScenes' classes and attributes."""
    best_rows = (-detections.scores).argsort(kind="stable")[:_MAX_BOXES]
    best_boxes = DetectedBoxes(
        boxes=detections.boxes.select(best_rows), scores=detections.scores[best_rows]
    )
    entries = detection_entries(token, best_boxes)
    for entry in entries:
        name = DETECTION_NAMES[entry["detection_name"]]
        velocity = entry["velocity"] or [math.nan, math.nan]
        is_moving = math.hypot(*velocity) > _MIN_MOVING_SPEED_MPS
        entry["detection_name"] = name
        entry["velocity"] = velocity
        entry["attribute_name"] = _ATTRIBUTES[name][is_moving]
    return entries
