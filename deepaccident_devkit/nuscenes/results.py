"""Detections as nuScenes' own evaluation reads them: one JSON file, boxes in the world."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation import DetectedBoxes, read_results
from deepaccident_devkit.nuscenes.classes import DETECTION_NAMES
from deepaccident_devkit.nuscenes.source import NuScenesRelease
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.taxonomy import CATEGORIES

NAME: Final = "nuscenes_detections.json"
_MOST: Final = 500
"""Boxes of a sample; nuScenes refuses more."""
_MOVING: Final = 0.2
"""m/s, from which on an attribute says so."""
_ATTRIBUTES: Final = {
    "pedestrian": ("pedestrian.standing", "pedestrian.moving"),
    **dict.fromkeys(("bicycle", "motorcycle"), ("cycle.without_rider", "cycle.with_rider")),
    **dict.fromkeys(("car", "truck"), ("vehicle.parked", "vehicle.moving")),
}


def write_detections(release: NuScenesRelease, results: Path) -> Path:
    """Write our detection results of keyframes beside them, as `nuscenes_detections.json`; the path.

    nuScenes' evaluation wants all samples of its split: predict all of them.

    Raises:
        ResultsError: they are of another task.
        ConfigError: a sample is no keyframe.
        DeepAccidentError: as of `read_results`.
    """
    read = read_results(results)
    if read.task != "detection":
        raise ResultsError(f"{results}: has results of {read.task}; nuScenes evaluates detections")
    found: dict[str, Any] = {release.nuscenes_token(token): read.prediction(token) for token in read.tokens}
    sensors = {f"use_{name}": False for name in ("camera", "lidar", "radar", "map", "external")}
    preset = str(read.meta.get("model", {}).get("preset", "tiny"))
    seen = {"use_camera": preset != "tiny_lidar", "use_lidar": preset in ("tiny_lidar", "tiny_both")}
    document = {
        "meta": sensors | seen,
        "results": {token: _entries(token, boxes) for token, boxes in found.items()},
    }
    path = results.parent / NAME
    write_bytes(path, json.dumps(document).encode())
    return path


def _entries(token: str, found: DetectedBoxes) -> list[dict[str, Any]]:
    """The best boxes of a sample."""
    entries = []
    for row in (-found.scores).argsort(kind="stable")[:_MOST].tolist():
        box, velocity = found.boxes[row], found.boxes.velocity[row, :2]
        name = DETECTION_NAMES[CATEGORIES[int(found.boxes.category[row])]]
        moving = bool((velocity**2).sum() > _MOVING**2)
        entries.append(
            {
                "sample_token": token,
                "translation": box.center.tolist(),
                "size": box.wlh.tolist(),
                "rotation": box.orientation.elements.tolist(),
                "velocity": velocity.tolist(),
                "detection_name": name,
                "detection_score": float(found.scores[row]),
                "attribute_name": _ATTRIBUTES[name][moving],
            }
        )
    return entries
