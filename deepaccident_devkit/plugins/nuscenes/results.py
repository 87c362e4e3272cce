"""Detections as nuScenes' own evaluation reads them: one JSON file, boxes in the world."""

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
# Boxes of a sample; nuScenes refuses more.
_MOST: Final = 500
# m/s, from which on an attribute says so.
_MOVING: Final = 0.2
_ATTRIBUTES: Final = {
    "pedestrian": ("pedestrian.standing", "pedestrian.moving"),
    **dict.fromkeys(("bicycle", "motorcycle"), ("cycle.without_rider", "cycle.with_rider")),
    **dict.fromkeys(("car", "truck"), ("vehicle.parked", "vehicle.moving")),
}


def write_detections(release: DeepAccident, results: Path) -> Path:
    """Write our detection results of keyframes beside them, as `nuscenes_detections.json`; the path.

    nuScenes' evaluation wants all samples of its split: predict all of them.

    Raises:
        ResultsError: they are of another task.
        ConfigError: the release is not of nuScenes, or a sample is no keyframe.
        DeepAccidentError: as of `read_results`.
    """
    if not isinstance(release, NuScenesRelease):
        raise ConfigError(
            f"{release.dataroot}: is no dataroot of nuScenes; open one with open_nuscenes"
        )
    read = read_results(results)
    if read.task != "detection":
        raise ResultsError(f"{results}: has results of {read.task}; nuScenes evaluates detections")
    found: dict[str, Any] = {
        release.nuscenes_token(token): read.prediction(token) for token in read.tokens
    }
    preset = read.meta.get("model", {}).get("preset", "tiny")
    document = {
        "meta": {
            "use_camera": preset != "tiny_lidar",
            "use_lidar": preset in ("tiny_lidar", "tiny_both"),
            **dict.fromkeys(("use_radar", "use_map", "use_external"), False),
        },
        "results": {token: _entries(token, boxes) for token, boxes in found.items()},
    }
    path = results.parent / NUSCENES_RESULTS_FILE
    write_bytes(path, json.dumps(document).encode())
    return path


def _entries(token: str, found: DetectedBoxes) -> list[dict[str, Any]]:
    """Return the best boxes of a sample, with nuScenes' classes and attributes."""
    best = (-found.scores).argsort(kind="stable")[:_MOST]
    entries = detection_entries(
        token, DetectedBoxes(boxes=found.boxes.select(best), scores=found.scores[best])
    )
    for entry in entries:
        name, velocity = (
            DETECTION_NAMES[entry["detection_name"]],
            entry["velocity"] or [math.nan, math.nan],
        )
        moving = math.hypot(*velocity) > _MOVING
        entry |= {
            "detection_name": name,
            "velocity": velocity,
            "attribute_name": _ATTRIBUTES[name][moving],
        }
    return entries
