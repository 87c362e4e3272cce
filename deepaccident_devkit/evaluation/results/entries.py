"""Accidents and detected boxes of many samples: read as columns over all entries, and written a sample a line.

nuScenes' `size` is width, length, height; ours is length, width, height.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
import numpy as np

from deepaccident_devkit.errors import EvaluationError, ResultsError, shortened
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, checked_prediction
from deepaccident_devkit.evaluation.results.header import ContentError, at, check_token, decoded
from deepaccident_devkit.evaluation.results.records import AccidentEntry, BoxEntry
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.taxonomy import CATEGORIES, UNTRACKED_ID

Columns = dict[str, AnyArray]
Entry = TypeVar("Entry", bound=msgspec.Struct)
_LENGTH_FIRST: Final = [1, 0, 2]
"""From width, length, height to length, width, height, and back."""
_UNIT_TOLERANCE: Final = 1e-3
"""How far from 1 a quaternion's norm may be; `Boxes` brings it there."""
_UNKNOWN: Final = (math.nan, math.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Entries:
    """All entries of a results file.

    Attributes:
        number: token → number of the sample, in the file's order; S of them.
        first: (S + 1,) row of each sample's first entry, and the number of entries, N.
        columns: field → (N, …).
    """

    number: Mapping[str, int]
    first: IntArray
    columns: Columns

    @classmethod
    def read(cls, results: Mapping[str, Sequence[Any]], columns: Callable[[Mapping[str, Any]], Columns]) -> Entries:
        """The entries by token; raises ContentError that names the token, the entry (from 0), and the field."""
        with at("results"):
            for token in results:
                check_token(token)
        first = np.concatenate([[0], np.cumsum([len(given) for given in results.values()])])
        return cls({token: number for number, token in enumerate(results)}, first, columns(results))

    def of(self, token: str) -> Columns:
        """The columns of a sample's entries; KeyError for a sample that is not here."""
        number = self.number[token]
        rows = slice(self.first[number], self.first[number + 1])
        return {name: column[rows] for name, column in self.columns.items()}


def read_entries(content: bytes, record: type[Entry]) -> list[Entry]:
    """A sample's entries; raises ContentError that names the number of the entry and the field."""
    return decoded(content, list[record])  # type: ignore[valid-type]  # msgspec wants it so at run time


def entry_place(token: str, number: int | None = None) -> str:
    """How errors name a sample's entries, or one of them."""
    return f"results of {shortened(token)!r}" + ("" if number is None else f": [{number}]")


def accident_columns(results: Mapping[str, Sequence[AccidentEntry]]) -> Columns:
    """The columns of N accidents.

    Returns:
        positions (N, 2, 2) metres, time (N,) seconds, score (N,), ids (N, 2), identified (N,) bool.
    """
    accidents = list(chain.from_iterable(results.values()))
    return {
        "positions": _floats([(*one, *other) for one, other in (each.positions for each in accidents)], 2, 2),
        "time": np.array([each.time for each in accidents], dtype=np.float64),
        "score": np.array([each.score for each in accidents], dtype=np.float64),
        "ids": np.array([each.ids or (0, 0) for each in accidents], dtype=np.int64).reshape(-1, 2),
        "identified": np.array([bool(each.ids) for each in accidents], dtype=bool),
    }


def accidents_at(entries: Entries, token: str) -> list[Accident]:
    """The accidents of a sample; KeyError for one that is not here."""
    columns = entries.of(token)
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


def detection_columns(results: Mapping[str, Sequence[BoxEntry]]) -> Columns:
    """The columns of N boxes.

    Returns:
        `center` (N, 3) metres and rotation (N, 4) unit quaternions w, x, y, z in the world, size (N, 3) length, width,
        height, velocity (N, 3) m/s, NaN where unknown, category (N,), score (N,).

    Raises:
        ContentError: a box names another sample, or its quaternion has another length than 1.
    """
    for token, given in results.items():
        others = [number for number, box in enumerate(given) if box.sample_token != token]
        if others:
            place, found = entry_place(token, others[0]), shortened(given[others[0]].sample_token)
            raise ContentError(f"{place}.sample_token: expected {token}, under which it stands, found {found!r}")
    boxes = list(chain.from_iterable(results.values()))
    rotation = _floats([box.rotation for box in boxes], 4)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(rotation, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > _UNIT_TOLERANCE)
    if len(wrong):
        row = int(wrong[0])
        places = [entry_place(token, number) for token, given in results.items() for number in range(len(given))]
        found = f"{list(boxes[row].rotation)}, {length[row]:.3g} long"
        raise ContentError(f"{places[row]}.rotation: expected a unit quaternion [w, x, y, z], found {found}")
    velocity = _floats([box.velocity or _UNKNOWN for box in boxes], 2)
    code = {name: number for number, name in enumerate(CATEGORIES)}
    return {
        "center": _floats([box.translation for box in boxes], 3),
        "size": _floats([box.size for box in boxes], 3)[:, _LENGTH_FIRST],
        "rotation": rotation,
        "velocity": np.column_stack([velocity, np.where(np.isnan(velocity[:, :1]), np.nan, 0.0)]),
        "category": np.array([code[box.detection_name] for box in boxes], dtype=np.int8),
        "score": np.array([box.detection_score for box in boxes], dtype=np.float64),
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

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        """Begin a new file."""
        self._kind = ENTRIES[header["task"]]
        self._count = 0
        self._file = path.open("w", encoding="utf-8", newline="\n")
        for name, value in header.items():
            self._file.write(f"{',' if self._file.tell() else '{'}\n{json.dumps(name)}: {json.dumps(value)}")
        self._file.write(',\n"results": {')

    def add(self, token: str, prediction: object) -> None:
        """Write the entries of a sample; raises ResultsError or ContentError, and nothing of it is written then."""
        entries = json.dumps(self._kind.entries(token, prediction))
        read_entries(entries.encode(), self._kind.record)
        self._file.write(f"{',' if self._count else ''}\n{json.dumps(token)}: {entries}")
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


def _floats(values: Sequence[Iterable[float]], *shape: int) -> FloatArray:
    """(N, *shape) float64 of N flat tuples."""
    flat = np.fromiter(chain.from_iterable(values), np.float64, len(values) * math.prod(shape))
    return flat.reshape(len(values), *shape)


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


@dataclass(frozen=True, slots=True)
class EntryKind:
    """What a task's entries are.

    Attributes:
        record: of an entry.
        columns: makes the columns of the records by token.
        prediction: of a sample, from the columns.
        entries: of a sample's token and prediction, as a file has them.
    """

    record: type[msgspec.Struct]
    columns: Callable[[Mapping[str, Any]], Columns]
    prediction: Callable[[Entries, str], list[Accident] | DetectedBoxes]
    entries: Callable[[str, object], list[dict[str, Any]]]


ENTRIES: Final[Mapping[str, EntryKind]] = {
    "accident": EntryKind(AccidentEntry, accident_columns, accidents_at, _accidents),
    "detection": EntryKind(BoxEntry, detection_columns, boxes_at, _boxes),
}
"""By task."""
