"""Detected boxes in results files: nuScenes' fields, in the world frame.

nuScenes' `size` is width, length, height; ours is length, width, height.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.results.columns import (
    ANY_NUMBER,
    FROM_ZERO,
    LARGEST,
    Entry,
    check_entries,
    choices,
    numbers,
    with_value,
)
from deepaccident_devkit.evaluation.results.entries import Columns, Entries
from deepaccident_devkit.evaluation.results.faults import ContentError, shown
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import CATEGORIES, UNTRACKED_ID

REQUIRED: Final = ("sample_token", "translation", "size", "rotation", "detection_name", "detection_score")
IGNORED: Final = ("attribute_name", "ego_translation", "num_pts")
"""What the nuScenes devkit writes beside; this dataset has no attributes."""
OPTIONAL: Final = ("velocity", *IGNORED)
_LENGTH_FIRST: Final = [1, 0, 2]
"""From width, length, height to length, width, height, and back."""
_UNIT_TOLERANCE: Final = 1e-3
"""How far from 1 a quaternion's norm may be; `Boxes` brings it there."""


def detection_columns(entries: Sequence[Entry], owners: Sequence[str]) -> Columns:
    """The columns of N boxes; raises ContentError.

    Args:
        entries: as a file has them.
        owners: tokens of the samples that they stand under.

    Returns:
        center (N, 3) metres and rotation (N, 4) unit quaternions w, x, y, z in the world, size (N, 3) length, width,
        height, velocity (N, 3) m/s, NaN where unknown, category (N,), score (N,).
    """
    check_entries(entries, REQUIRED, OPTIONAL)
    tokens = [entry["sample_token"] for entry in entries]
    if tokens != list(owners):
        raise ContentError(f"sample_token: expected {owners[0]}, under which it stands, found {shown(tokens[0])}")
    rotation = numbers(entries, "rotation", (4,), "a unit quaternion [w, x, y, z]")
    with np.errstate(over="ignore"):
        off = np.abs(np.linalg.norm(rotation, axis=1) - 1)
    if (off > _UNIT_TOLERANCE).any():
        raise ContentError(f"rotation: expected a unit quaternion [w, x, y, z], found {shown(rotation[0].tolist())}")
    rows, moving = with_value(entries, "velocity")
    velocity = np.full((len(entries), 3), np.nan)
    known = numbers(
        moving, "velocity", (2,), f"[vx, vy] of finite numbers up to {LARGEST:,.0f}, m/s, or null where it is not known"
    )
    velocity[rows] = np.column_stack([known, np.zeros(len(rows))])
    size = numbers(
        entries, "size", (3,), f"[width, length, height] of finite numbers from 0 to {LARGEST:,.0f}, metres", FROM_ZERO
    )
    return {
        "center": numbers(entries, "translation", (3,), f"[x, y, z] of finite numbers up to {LARGEST:,.0f}, metres"),
        "size": size[:, _LENGTH_FIRST],
        "rotation": rotation,
        "velocity": velocity,
        "category": choices(entries, "detection_name", CATEGORIES),
        "score": numbers(entries, "detection_score", (), "a finite number", ANY_NUMBER),
    }


def boxes_at(entries: Entries, token: str) -> DetectedBoxes:
    """The boxes of a sample, in the world; KeyError for one that is not here."""
    columns = entries.of(token)
    scores = columns.pop("score")
    count = len(scores)
    boxes = Boxes(
        frame="world",
        **columns,
        actor_id=np.full(count, UNTRACKED_ID),
        num_lidar_pts=np.zeros(count, dtype=np.int64),
        camera_visible=np.zeros(count, dtype=bool),
        row=np.arange(count),
    )
    return DetectedBoxes(boxes=boxes, scores=scores)


def detection_entries(token: str, detected: DetectedBoxes) -> list[dict[str, Any]]:
    """A sample's boxes as a file has them; they are in the world frame."""
    boxes = detected.boxes
    return [
        {
            "sample_token": token,
            "translation": center,
            "size": size,
            "rotation": rotation,
            "velocity": moving if all(map(math.isfinite, moving)) else None,
            "detection_name": CATEGORIES[category],
            "detection_score": score,
        }
        for center, size, rotation, moving, category, score in zip(
            boxes.center.tolist(),
            boxes.size[:, _LENGTH_FIRST].tolist(),
            boxes.rotation.tolist(),
            boxes.velocity[:, :2].tolist(),
            boxes.category.tolist(),
            detected.scores.tolist(),
            strict=True,
        )
    ]
