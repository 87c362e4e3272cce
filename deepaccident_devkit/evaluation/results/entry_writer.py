"""Accidents and detected boxes into a JSON file, a sample a line."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation.accident.protocol import checked_prediction
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results.accident_entries import accident_columns, accident_entries
from deepaccident_devkit.evaluation.results.detection_entries import detection_columns, detection_entries
from deepaccident_devkit.evaluation.results.entries import ReadColumns
from deepaccident_devkit.evaluation.results.header import Header


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
            f"expected DetectedBoxes, found {type(prediction).__name__}; DetectedBoxes.from_arrays makes some"
        )
    frame = prediction.boxes.frame
    if frame != "world":
        raise ResultsError(
            f"expected boxes in the world frame, found {frame}; give those of "
            f"boxes.transform(dataset.world_from(token, {frame!r}), 'world')"
        )
    return detection_entries(token, prediction)


_ENTRIES: Final[Mapping[str, tuple[Callable[[str, object], list[dict[str, Any]]], ReadColumns]]] = {
    "accident": (_accidents, accident_columns),
    "detection": (_boxes, detection_columns),
}
"""Task → what makes entries of a prediction, and what would refuse them when they are read."""
