"""Accidents and detected boxes as results files have them: entries read, and written a sample a line.

Accidents: {"positions", "time", "score", "ids"}, positions in the sample's present ego frame. Boxes: nuScenes' fields,
in the world frame; nuScenes' `size` is width, length, height; ours is length, width, height.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.predictions import Accident, MotionOutput, checked_prediction
from deepaccident_devkit.evaluation.results.columns import (
    ANY_NUMBER,
    FROM_ZERO,
    LARGEST,
    Columns,
    Entries,
    Entry,
    ReadColumns,
    check_entries,
    choices,
    numbers,
    whole_numbers,
    with_value,
)
from deepaccident_devkit.evaluation.results.faults import ContentError, shown
from deepaccident_devkit.evaluation.results.header import Header
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import CATEGORIES, UNTRACKED_ID

_ACCIDENT_REQUIRED: Final = ("positions", "time", "score")
_ACCIDENT_OPTIONAL: Final = ("ids",)


def accident_columns(entries: Sequence[Entry], owners: Sequence[str]) -> Columns:
    """The columns of N accidents; raises ContentError.

    Args:
        entries: as a file has them.
        owners: tokens of their samples, which accidents do not name.

    Returns:
        positions (N, 2, 2) metres, time (N,) seconds, score (N,), ids (N, 2), identified (N,) bool.
    """
    del owners
    check_entries(entries, _ACCIDENT_REQUIRED, _ACCIDENT_OPTIONAL)
    points = f"two points [[x, y], [x, y]] of finite numbers up to {LARGEST:,.0f}, metres"
    rows, named = with_value(entries, "ids")
    ids, identified = np.zeros((len(entries), 2), dtype=np.int64), np.zeros(len(entries), dtype=bool)
    ids[rows] = whole_numbers(named, "ids", (2,), "two whole numbers, or null where they are not known")
    identified[rows] = True
    return {
        "positions": numbers(entries, "positions", (2, 2), points),
        "time": numbers(entries, "time", (), f"a finite number of seconds from 0 to {LARGEST:,.0f}", FROM_ZERO),
        "score": numbers(entries, "score", (), "a finite number", ANY_NUMBER),
        "ids": ids,
        "identified": identified,
    }


def accidents_at(entries: Entries, token: str) -> list[Accident]:
    """The accidents of a sample; KeyError for one that is not here."""
    columns: dict[str, Any] = entries.of(token)
    identified, ids = columns["identified"].tolist(), columns["ids"].tolist()
    return [
        Accident(
            positions=columns["positions"][row],
            time=float(columns["time"][row]),
            score=float(columns["score"][row]),
            ids=(ids[row][0], ids[row][1]) if identified[row] else None,
        )
        for row in range(len(ids))
    ]


def accident_entries(accidents: Iterable[Accident]) -> list[dict[str, Any]]:
    """Accidents as a file has them."""
    return [
        {
            "positions": each.positions.tolist(),
            "time": each.time,
            "score": each.score,
            "ids": None if each.ids is None else list(each.ids),
        }
        for each in accidents
    ]


_BOX_REQUIRED: Final = ("sample_token", "translation", "size", "rotation", "detection_name", "detection_score")
IGNORED: Final = ("attribute_name", "ego_translation", "num_pts")
"""A further field of the nuScenes devkit; this dataset has no attributes."""
_BOX_OPTIONAL: Final = ("velocity", *IGNORED)
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
        `center` (N, 3) metres and rotation (N, 4) unit quaternions w, x, y, z in the world, size (N, 3) length, width,
        height, velocity (N, 3) m/s, NaN where unknown, category (N,), score (N,).
    """
    check_entries(entries, _BOX_REQUIRED, _BOX_OPTIONAL)
    tokens = [entry["sample_token"] for entry in entries]
    if tokens != list(owners):
        raise ContentError(f"sample_token: expected {owners[0]}, under which it stands, found {shown(tokens[0])}")
    rotation = numbers(entries, "rotation", (4,), "a unit quaternion [w, x, y, z]")
    with np.errstate(over="ignore"):
        length = np.linalg.norm(rotation, axis=1)
    if (np.abs(length - 1) > _UNIT_TOLERANCE).any():
        found = f"{shown(rotation[0].tolist())}, {length[0]:.3g} long"
        raise ContentError(f"rotation: expected a unit quaternion [w, x, y, z], found {found}")
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
    columns: dict[str, Any] = entries.of(token)
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


class EntryWriter:
    """Writes the file of accident or detection results from its header to its last sample."""

    def __init__(self, path: Path, header: Header) -> None:
        """Begin a new file."""
        self._entries, self._columns = _ENTRIES[header.task]
        self._count = 0
        self._file = path.open("w", encoding="utf-8", newline="\n")
        for name, value in header.as_dict().items():
            self._file.write(f"{',' if self._file.tell() else '{'}\n{json.dumps(name)}: {json.dumps(value)}")
        self._file.write(',\n"results": {')

    def add(self, token: str, prediction: object) -> None:
        """Write the entries of a sample; raises ResultsError or ContentError, and nothing of it is written then."""
        entries = self._entries(token, prediction)
        self._columns(entries, [token] * len(entries))
        line = f"{json.dumps(token)}: {json.dumps(entries, allow_nan=False)}"
        self._file.write(f"{',' if self._count else ''}\n{line}")
        self._count += 1

    def finish(self) -> None:
        """Write the end; raises ResultsError if nothing was added."""
        if not self._count:
            raise ResultsError("no prediction was added; results of no sample cannot be read")
        self._file.write("\n}\n}\n")
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _accidents(token: str, prediction: object) -> list[dict[str, Any]]:
    del token
    try:
        accidents = checked_prediction(prediction)
    except EvaluationError as error:
        raise ResultsError(str(error)) from error
    if isinstance(accidents, MotionOutput):
        raise ResultsError("expected a list of Accidents, found a MotionOutput; write that to results of task 'motion'")
    return accident_entries(accidents)


def _boxes(token: str, prediction: object) -> list[dict[str, Any]]:
    if not isinstance(prediction, DetectedBoxes):
        raise ResultsError(
            f"expected DetectedBoxes, found {type(prediction).__name__}; make them with "
            "DetectedBoxes.from_arrays(center, size, yaw, scores, frame='world')"
        )
    frame = prediction.boxes.frame
    if frame != "world":
        raise ResultsError(
            f"expected boxes in the world frame, found {frame}; give "
            f"detected.transform(dataset.world_from(token, {frame!r}), 'world')"
        )
    return detection_entries(token, prediction)


_ENTRIES: Final[Mapping[str, tuple[Callable[[str, object], list[dict[str, Any]]], ReadColumns]]] = {
    "accident": (_accidents, accident_columns),
    "detection": (_boxes, detection_columns),
}
"""Task → the functions that make entries of a prediction, and that check them when they are read."""
