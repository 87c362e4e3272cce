"""Predicted boxes of one sample: what a detector finds (`DetectedBoxes`), and tracks (`Tracks`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import ConfigError, GeometryError, shortened
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnBoxes, Role
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.geometry.boxes import checked_boxes
from deepaccident_devkit.support.arrays import (
    AnyArray,
    FloatArray,
    FrozenArrays,
    as_numbers,
    checked,
)
from deepaccident_devkit.taxonomy import CATEGORIES

if TYPE_CHECKING:
    from typing_extensions import Self

# Possible numbers of characters of the id of a track.
_ID_LENGTHS = set(range(1, 101))


def check_classes(classes: tuple[tuple[str, tuple[str, ...]], ...]) -> None:
    """Raise ConfigError if a category is unknown or belongs to two classes."""
    used_categories: list[str] = []
    for _, categories in classes:
        used_categories.extend(categories)
    distinct_categories = set(used_categories)
    is_repeated = len(distinct_categories) < len(used_categories)
    if not used_categories or is_repeated or not distinct_categories <= set(CATEGORIES):
        raise ConfigError(
            f"classes: expected names of classes with categories from {', '.join(CATEGORIES)}, "
            f"each category at most once, found {classes}"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectedBoxes(FrozenArrays):
    """Detections of one sample; arrays are read-only.

    Attributes:
        boxes: N right-handed boxes in the frame `boxes.frame`; velocities are NaN if the detector
            does not predict them.
        scores: (N,) float64 confidences; higher means more certain.
    """

    boxes: Boxes
    scores: FloatArray

    def __post_init__(self) -> None:
        """Check and freeze the arrays.

        Raises:
            GeometryError: If `boxes` is not a `Boxes`, or a score is invalid.
        """
        checked_boxes("detected boxes", self.boxes)
        scores = checked("scores", self.scores, (len(self.boxes),)).copy()
        if not np.isfinite(scores).all():
            raise GeometryError("scores: not all numbers are finite; remove boxes without a score")
        object.__setattr__(self, "scores", scores)
        FrozenArrays.__post_init__(self)

    @classmethod
    def from_arrays(
        cls,
        center: ArrayLike,
        size: ArrayLike,
        yaw: ArrayLike,
        scores: ArrayLike,
        *,
        frame: str,
        category: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        **fields: Any,
    ) -> Self:
        """Create predictions from boxes that are upright in `frame` (right-handed, y to the left).

        Args:
            center: (N, 3) centres, metres.
            size: (N, 3) full length, width, height, metres.
            yaw: (N,) headings, radians, counter-clockwise.
            scores: (N,) confidences; higher means more certain.
            frame: Frame of all values: `lidar` for evaluators, `world` for results files.
            category: (N,) indices or names of categories; None if all are cars.
            velocity: (N, 2) or (N, 3) velocities over the ground, m/s; None if unknown.
            **fields: Further fields, such as the `ids` of `Tracks`.

        Raises:
            GeometryError: If a shape or a value is invalid.
        """
        columns: dict[str, Any] = {}
        if velocity is not None:
            vectors = as_numbers("velocity", velocity)
            if vectors.ndim == 2 and vectors.shape[1] == 2:
                vectors = np.column_stack([vectors, np.zeros(len(vectors))])
            columns["velocity"] = vectors
        boxes = Boxes.from_arrays(center, size, yaw, frame=frame, category=category, **columns)
        return cls(boxes=boxes, scores=scores, **fields)  # type: ignore[arg-type]  # checked in __post_init__

    def transform(self, target_from_source: SE3, frame: str) -> Self:
        """Transform the boxes to another frame, such as `world` for results files."""
        return replace(self, boxes=self.boxes.transform(target_from_source, frame))

    def drawing(self) -> Drawing:
        """Describe the detections for a picture."""
        detected = DrawnBoxes(
            boxes=self.boxes, scores=self.scores, role="predicted", label="detected"
        )
        return Drawing(boxes=(detected,))

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.boxes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks(DetectedBoxes):
    """The tracks of one agent at one sample, one box each; arrays are read-only.

    Attributes:
        ids: (N,) different texts of 1 to 100 characters, or numbers; equal ids in the samples of a
            recording (a scenario and an agent) are one track.
        past_times: (T,) float64 seconds of earlier samples, negative and ascending.
        past: (N, T, 3) float64 centres at these times, in the world, metres; NaN where the track
            has no box. Only pictures use them.
    """

    ids: AnyArray
    past_times: FloatArray = field(default_factory=lambda: np.zeros(0))
    past: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 3)))

    def __post_init__(self) -> None:
        """Check and freeze the arrays; numbers become texts.

        Raises:
            GeometryError: If an array or an id is invalid.
        """
        ids = np.array([str(name) for name in self.ids], dtype=object)
        lengths = set(map(len, ids))
        if not len(set(ids)) == len(ids) == len(self.boxes) or not lengths <= _ID_LENGTHS:
            raise GeometryError(
                f"ids: expected {len(self.boxes)} different texts of 1 to 100 characters, found "
                f"{shortened(str(ids.tolist()))}"
            )
        object.__setattr__(self, "ids", ids)
        if not len(self.past_times):
            object.__setattr__(self, "past", np.zeros((len(ids), 0, 3)))
        DetectedBoxes.__post_init__(self)


def drawn_matches(
    predicted: DetectedBoxes,
    truth: Boxes,
    true_rows: Mapping[Role, AnyArray],
    predicted_rows: Mapping[Role, AnyArray],
    label: str = "detected",
) -> Drawing:
    """Describe boxes by outcome for a picture.

    Args:
        predicted: Predicted boxes.
        truth: True boxes in any frame.
        true_rows: `truth` for matched and `missed` for other true boxes → indices.
        predicted_rows: `right` and `false` → indices of predicted boxes.
        label: Word for boxes that are right.
    """
    labels: dict[Role, str] = {"truth": "found", "right": label}
    true = [
        DrawnBoxes(boxes=truth.select(rows), role=role, label=labels.get(role, role))
        for role, rows in true_rows.items()
    ]
    drawn = [
        DrawnBoxes(
            boxes=predicted.boxes.select(rows),
            scores=predicted.scores[rows],
            role=role,
            label=labels.get(role, role),
        )
        for role, rows in predicted_rows.items()
    ]
    counts = []
    for part in (*drawn, *true):
        if part.role != "truth":
            counts.append(f"{len(part.boxes)} {part.label}")
    return Drawing(boxes=(true[0], *drawn, true[1]), words=", ".join(counts))
