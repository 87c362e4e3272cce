"""`Drawing`: what a picture shows of a sample's prediction and its truth.

A task describes its pictures by these records (`Evaluator.drawing`). Views draw the records, and do
not know the task.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import BevGrid, Boxes
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, FrozenArrays, ShortRepr
from deepaccident_devkit.v2x.cooperation import cooperative_boxes

Role = Literal["truth", "past", "predicted", "right", "false", "missed", "collision"]
"""What a thing in a picture is, which decides its colour.

`predicted` has no verdict; predictions with a verdict are `right` or `false`, and true things
without a prediction are `missed`.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnPath(FrozenArrays):
    """A path on the ground; arrays are read-only.

    Attributes:
        xy: (T, 2) positions, x forward, y left, metres in the current ego frame.
        times: (T,) seconds after the current frame; negative in the past.
        role: What the path is.
        width: Width of the ribbon that a vehicle on the path covers, metres; 0 for a line.
        probability: Probability of the path; improbable paths are paler.
        label: Words for the legend.
    """

    xy: FloatArray
    times: FloatArray
    role: Role
    width: float = 0.0
    probability: float = 1.0
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnBoxes(FrozenArrays):
    """Boxes of one kind, in any frame of the sample.

    Attributes:
        boxes: N boxes.
        role: What the boxes are.
        scores: (N,) confidences; None for boxes without scores.
        time: Seconds after the current frame.
        label: Words for the legend.
    """

    boxes: Boxes
    role: Role
    scores: FloatArray | None = None
    time: float = 0.0
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnCells(FrozenArrays):
    """Cells of instances of one kind over time; arrays are read-only.

    Attributes:
        instance: (T, H, W) ids from 1 that stay the same over time, 0 for other cells; all maps are
            in the current ego frame.
        grid: Cells of the maps, in the devkit's orientation.
        times: (T,) seconds after the current frame.
        role: What the instances are.
        label: Words for the legend.
    """

    instance: AnyArray
    grid: BevGrid
    times: FloatArray
    role: Role
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnPlaces(FrozenArrays):
    """Positions at which something happens at one time; arrays are read-only.

    Attributes:
        xy: (N, 2) positions, x forward, y left, metres in the current ego frame.
        time: Seconds after the current frame.
        role: What the positions are.
        note: Words beside the positions, such as `contact in 1.5 s`.
        label: Words for the legend.
    """

    xy: FloatArray
    time: float
    role: Role
    note: str = ""
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnAlarm:
    """The alarm of a sample.

    Attributes:
        score: Confidence from 0 (no alarm) to 1.
        fires: Whether the score raises an alarm.
    """

    score: float
    fires: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing(ShortRepr):
    """What is drawn of a sample's prediction and its truth.

    Attributes:
        paths: Paths on the ground.
        boxes: Boxes by kind.
        cells: Cells of instances by kind, all on the same grid and at the same times.
        places: Marked positions.
        alarm: Alarm of the sample; None for tasks without alarms.
        words: Summary for the title, such as `contact in 1.5 s`; if it is empty, views print the
            sample's main numbers.
    """

    paths: tuple[DrawnPath, ...] = ()
    boxes: tuple[DrawnBoxes, ...] = ()
    cells: tuple[DrawnCells, ...] = ()
    places: tuple[DrawnPlaces, ...] = ()
    alarm: DrawnAlarm | None = None
    words: str = ""

    @property
    def is_judged(self) -> bool:
        """Whether predicted boxes or cells are right or false, or true ones are missed."""
        roles = {drawn.role for drawn in self.boxes} | {drawn.role for drawn in self.cells}
        return not roles.isdisjoint(("right", "false", "missed"))

    @property
    def truth(self) -> Drawing:
        """What is drawn of the truth. The collision of a plan is not true, but the plan's own."""
        roles = {"truth", "past", "missed"}
        if self.alarm is not None or self.is_judged:
            roles.add("collision")
        return self._part(roles)

    @property
    def prediction(self) -> Drawing:
        """What is drawn of the prediction, and the true things that it misses."""
        roles = {"predicted", "right", "false", "missed", "collision"}
        return replace(self._part(roles), alarm=self.alarm)

    def _part(self, roles: Collection[str]) -> Drawing:
        """Return the things with some roles, without the alarm and the words."""
        return Drawing(
            paths=tuple(drawn for drawn in self.paths if drawn.role in roles),
            boxes=tuple(drawn for drawn in self.boxes if drawn.role in roles),
            cells=tuple(drawn for drawn in self.cells if drawn.role in roles),
            places=tuple(drawn for drawn in self.places if drawn.role in roles),
        )


def joined_drawing(predictions: Iterable[Any]) -> Drawing:
    """Join what predictions draw of themselves, by their methods `drawing`.

    Predictions without the method add nothing.
    """
    paths: list[DrawnPath] = []
    boxes: list[DrawnBoxes] = []
    cells: list[DrawnCells] = []
    places: list[DrawnPlaces] = []
    for prediction in predictions:
        if hasattr(prediction, "drawing"):
            drawing: Drawing = prediction.drawing()
            paths += drawing.paths
            boxes += drawing.boxes
            cells += drawing.cells
            places += drawing.places
    return Drawing(paths=tuple(paths), boxes=tuple(boxes), cells=tuple(cells), places=tuple(places))


def drawn_pair(dataset: Dataset, token: str, frame: str = "ego") -> tuple[DrawnBoxes, ...]:
    """Describe the colliding pair of a sample's scenario, in the current frame.

    Args:
        dataset: The release.
        token: Token of the sample.
        frame: Coordinate frame of the boxes.

    Returns:
        The pair's boxes, wherever an agent labels them; empty without a collision.
    """
    record = dataset.get("sample", token)
    collision = dataset.get("scenario", record["scenario_token"])["collision"]
    if collision is None:
        return ()
    boxes = cooperative_boxes(dataset, record, frame=frame)
    pair = boxes.select(np.isin(boxes.actor_id, collision["ids"]))
    return (DrawnBoxes(boxes=pair, role="collision", label="colliding pair"),)


def drawn_paths(paths: FloatArray, times: FloatArray, role: Role, label: str) -> list[DrawnPath]:
    """Describe paths (A, T, 2) at times (T,) for a picture, without their missing positions."""
    drawn_paths = []
    for path in paths:
        is_known = np.isfinite(path[:, 0])
        known_path = path[is_known]
        if len(known_path) > 1:
            drawn_path = DrawnPath(xy=known_path, times=times[is_known], role=role, label=label)
            drawn_paths.append(drawn_path)
    return drawn_paths
