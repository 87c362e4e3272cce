"""`Results`: a model's predictions of many samples, read strictly from a results file.

Accidents and detected boxes are read as columns over all entries; motion stays in its shards.
"""

from __future__ import annotations

import copy
import gc
import hashlib
import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.errors import GeometryError, ResultsError, TokenError, shortened
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.forecasting.metrics import Forecast
from deepaccident_devkit.evaluation.planning.scene import Plan
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results.motion import MotionContents, MotionForm
from deepaccident_devkit.evaluation.results.records import (
    LENGTH_FIRST,
    RESULTS_FILE,
    AccidentEntry,
    BoxEntry,
    ContentError,
    ForecastEntry,
    MotionFile,
    PlanEntry,
    ResultsTask,
    check_token,
    entry_place,
    fault_of,
    locate_errors,
    read_document,
)
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.support.reading import NO_NAME, fault_text, irregular_text, read_bytes
from deepaccident_devkit.support.text import counted, path_of
from deepaccident_devkit.taxonomy import CATEGORIES, UNTRACKED_ID

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

Prediction = MotionOutput | list[Accident] | DetectedBoxes | list[Plan] | list[Forecast]
Columns = dict[str, AnyArray]
# Tolerance of a quaternion's norm; `Boxes` normalises it.
_UNIT_TOLERANCE: Final = 1e-3
_UNKNOWN_VELOCITY: Final = (math.nan, math.nan)
# Number of parsed files that a process caches.
_MAX_CACHED_FILES: Final = 4
# Name of the column of plans or forecasts.
_OBJECT: Final = "object"


class Results:
    """Predictions by sample token; `read_results` opens them.

    Cheap to pickle, since copies read the file again, once a process; safe in threads and in forked
    workers.

    Attributes:
        path: Path of the file, or of the folder of motion results.
        task: Kind of the predictions.
        fingerprint: Hash of the file's bytes; the file of motion results holds the shards'
            checksums.
    """

    def __init__(self, path: Path, task: ResultsTask, fingerprint: str) -> None:
        """Store the properties of results that `read_results` has read; call it to open results."""
        self.path = path
        self.task = task
        self.fingerprint = fingerprint
        self._file = path / RESULTS_FILE if task == "motion" else path

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without the contents."""
        return Results, (self.path, self.task, self.fingerprint)

    def __repr__(self) -> str:
        return f"<{self.task} results: {counted(len(self), 'sample')} in {self.path}>"

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._contents.tokens)

    def __contains__(self, token: object) -> bool:
        """Return whether a sample has a prediction."""
        return token in self._contents.tokens

    @property
    def tokens(self) -> tuple[str, ...]:
        """The samples, in the file's order."""
        return tuple(self._contents.tokens)

    @property
    def meta(self) -> dict[str, Any]:
        """The notes of the file's author; a copy."""
        return copy.deepcopy(dict(self._contents.meta))

    @property
    def form(self) -> MotionForm | None:
        """How motion is stored; None for other tasks."""
        return self._contents.form

    def prediction(self, token: str) -> Prediction:
        """Return the prediction of a sample.

        Returns:
            For motion a MotionOutput; for accidents, plans and forecasts a list, empty if there is
            none; for detection the boxes, in the world frame.

        Raises:
            TokenError: the results do not have the sample.
            ResultsError: its arrays are missing or damaged, or the file was changed.
        """
        contents = self._contents
        if token not in contents.tokens:
            raise TokenError(
                f"{self.path}: has no prediction of {token!r}; `tokens` lists those that it has"
            )
        return contents.prediction(token)

    def check(
        self,
        **engine: Unpack[Engine],
    ) -> None:
        """Read and check everything: call it before long work and before publishing.

        Args:
            **engine: `workers` (1 by default), `executor` and `progress`, see `parallel.Engine`.

        Raises:
            ResultsError: names the shard, the token and the array of the first fault, or the file
                was changed.
            WorkerError: a worker was killed, or does not see the results.
        """
        _read_content(self._file, self.fingerprint)
        contents = self._contents
        if isinstance(contents, MotionContents):  # other contents were checked when they were read
            contents.check(**{"workers": 1, **engine})

    @property
    def _contents(self) -> Contents:
        return contents_of(self._file, self.fingerprint)[0]


def read_results(path: str | os.PathLike[str]) -> Results:
    """Open results (schema/results/README.md).

    All accidents and boxes are checked; of motion only the manifest.

    Args:
        path: A JSON file, or a folder with a results.json, as for motion results.

    Raises:
        ResultsError: there is none, it is of another version, or against its format; the message
            names the first wrong entry by its token and field.
    """
    file = _file_of(path_of(path, error=ResultsError).absolute())
    contents, fingerprint = contents_of(file)
    task = contents.task
    if task == "motion" and file.name != RESULTS_FILE:
        raise ResultsError(
            f"{file}: is the manifest of motion results; call it {RESULTS_FILE}, as others look "
            "for it"
        )
    return Results(file.parent if task == "motion" else file, task, fingerprint)


def _file_of(path: Path) -> Path:
    """Return the JSON file of results at a path; raises ResultsError."""
    file = path
    try:
        file = path / RESULTS_FILE if path.is_dir() else path
        irregular = irregular_text(file.stat().st_mode)
    except FileNotFoundError:
        fault = "no such file or folder" if file == path else f"holds no {RESULTS_FILE}"
        raise ResultsError(f"{path}: {fault}; give the results that ResultsWriter made") from None
    except (OSError, ValueError) as error:
        fault = fault_text(error) if isinstance(error, OSError) else NO_NAME
        raise ResultsError(f"{path}: {fault}; give results that can be read") from error
    if irregular:
        raise ResultsError(f"{file}: {irregular}; give a results file")
    return file


@dataclass(frozen=True, slots=True, eq=False)
class EntryContents:
    """Accidents or detected boxes, all in memory and checked.

    Attributes:
        task: Kind of the predictions.
        meta: Notes of the file's author.
        tokens: The samples.
        prediction: Returns the prediction of a token.
        form: None, since only motion has a form.
    """

    task: ResultsTask
    meta: Mapping[str, Any]
    tokens: Collection[str]
    prediction: Callable[[str], Prediction]
    form: MotionForm | None = None


# The content of a file; callers ask only for tokens that it has.
Contents = EntryContents | MotionContents
# Path and fingerprint → contents of the files that this process parsed most recently.
cached_contents: Final[dict[tuple[Path, str], Contents]] = {}


def contents_of(path: Path, fingerprint: str = "") -> tuple[Contents, str]:
    """Return the contents of a file and its fingerprint.

    A process parses a file once for all copies of `Results`.

    Args:
        path: Path of the file.
        fingerprint: Fingerprint that the bytes must have, not read again if they were parsed; empty
            for any.

    Raises:
        ResultsError: the file cannot be read, violates its format, or has other bytes now.
    """
    contents = cached_contents.get((path, fingerprint))
    if contents is not None:
        return contents, fingerprint
    content, actual_fingerprint = _read_content(path, fingerprint)
    contents = cached_contents.get((path, actual_fingerprint))
    if contents is None:
        with _collector_paused():
            contents = _parse(content, path)
        while len(cached_contents) >= _MAX_CACHED_FILES:
            cached_contents.pop(next(iter(cached_contents)), None)
        cached_contents[path, actual_fingerprint] = contents
    return contents, actual_fingerprint


def _read_content(path: Path, fingerprint: str) -> tuple[bytes, str]:
    """Return a file's bytes, and their hash of 32 hexadecimal digits.

    Raises ResultsError if the file cannot be read, or has another fingerprint than expected.
    """
    try:
        content = read_bytes(path, "results")
    except OSError as error:
        raise fault_of(path, error) from error
    digest = hashlib.blake2b(content, digest_size=16).hexdigest()
    if fingerprint not in ("", digest):
        raise ResultsError(f"{path}: was changed after it was opened; open it again")
    return content, digest


def _parse(content: bytes, path: Path) -> Contents:
    """Return the contents of a file's bytes; raises ResultsError."""
    try:
        document, meta = read_document(content, path)
        if isinstance(document, MotionFile):
            return MotionContents(path, meta, document)
        make_columns, make_prediction = ENTRIES[document.task]
        entries = Entries.read(document.results, make_columns)
    except (ContentError, OSError) as error:
        raise fault_of(path, error) from error
    prediction = partial(make_prediction, entries)
    return EntryContents(document.task, meta, entries.number.keys(), prediction)


@contextmanager
def _collector_paused() -> Iterator[None]:
    """Pause the garbage collector.

    Parsing makes millions of objects, none in a cycle; scanning them repeatedly would double the
    time.
    """
    is_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if is_enabled:
            gc.enable()


@dataclass(frozen=True, slots=True, eq=False)
class Entries:
    """All entries of a results file.

    Attributes:
        number: Token → number of the sample, in the file's order; S samples.
        first: Row of each sample's first entry, then the number of entries N; shape (S + 1,).
        columns: Field → values, shape (N, …).
    """

    number: Mapping[str, int]
    first: IntArray
    columns: Columns

    @classmethod
    def read(
        cls,
        results: Mapping[str, Sequence[Any]],
        make_columns: Callable[[Mapping[str, Any]], Columns],
    ) -> Entries:
        """Return the entries by token; raises ContentError with token, entry (from 0), and field.

        Args:
            results: Token → records of the sample.
            make_columns: Returns the columns of the records.
        """
        with locate_errors("results"):
            for token in results:
                check_token(token)
        counts = list(map(len, results.values()))
        first = np.concatenate([[0], np.cumsum(counts)])
        numbers = {token: number for number, token in enumerate(results)}
        return cls(numbers, first, make_columns(results))

    def of(self, token: str) -> Columns:
        """Return the columns of a sample's entries; raises KeyError for an unknown sample."""
        number = self.number[token]
        rows = slice(self.first[number], self.first[number + 1])
        return {name: column[rows] for name, column in self.columns.items()}


def accident_columns(results: Mapping[str, Sequence[AccidentEntry]]) -> Columns:
    """Return the columns of N accidents.

    These are positions (N, 2, 2) metres, time (N,) seconds, score (N,), ids (N, 2), identified
    (N,) bool.
    """
    accidents = list(chain.from_iterable(results.values()))
    positions = [(*accident.positions[0], *accident.positions[1]) for accident in accidents]
    scores = [accident.score for accident in accidents]
    ids = [accident.ids or (0, 0) for accident in accidents]
    is_identified = [bool(accident.ids) for accident in accidents]
    return {
        "positions": _floats(positions, 2, 2),
        "time": np.array([accident.time for accident in accidents], dtype=np.float64),
        "score": np.array(scores, dtype=np.float64),
        "ids": np.array(ids, dtype=np.int64).reshape(-1, 2),
        "identified": np.array(is_identified, dtype=bool),
    }


def accidents_at(entries: Entries, token: str) -> list[Accident]:
    """Return the accidents of a sample; raises KeyError for an unknown sample."""
    columns = entries.of(token)
    is_identified, ids = columns["identified"].tolist(), columns["ids"].tolist()
    accidents = []
    for row, (first_id, second_id) in enumerate(ids):
        accidents.append(
            Accident(
                positions=columns["positions"][row],
                time=float(columns["time"][row]),
                score=float(columns["score"][row]),
                ids=(first_id, second_id) if is_identified[row] else None,
            )
        )
    return accidents


def detection_columns(results: Mapping[str, Sequence[BoxEntry]]) -> Columns:
    """Return the columns of N boxes in the world frame.

    These are center (N, 3) metres, rotation (N, 4) unit quaternions w, x, y, z, size (N, 3)
    length, width, height in metres, velocity (N, 3) m/s, NaN where unknown, category (N,), score
    (N,). Raises ContentError: a box names another sample, or its quaternion has another length
    than 1.
    """
    _check_sample_tokens(results)
    boxes = list(chain.from_iterable(results.values()))
    rotation = _floats([box.rotation for box in boxes], 4)
    _check_unit_length(rotation, results)
    velocity = _floats([box.velocity or _UNKNOWN_VELOCITY for box in boxes], 2)
    velocity_z = np.where(np.isnan(velocity[:, :1]), np.nan, 0.0)
    codes = {name: number for number, name in enumerate(CATEGORIES)}
    scores = [box.detection_score for box in boxes]
    return {
        "center": _floats([box.translation for box in boxes], 3),
        "size": _floats([box.size for box in boxes], 3)[:, LENGTH_FIRST],
        "rotation": rotation,
        "velocity": np.column_stack([velocity, velocity_z]),
        "category": np.array([codes[box.detection_name] for box in boxes], dtype=np.int8),
        "score": np.array(scores, dtype=np.float64),
    }


def _check_sample_tokens(results: Mapping[str, Sequence[BoxEntry]]) -> None:
    """Raise ContentError if a box names another sample than its own."""
    for token, boxes in results.items():
        for number, box in enumerate(boxes):
            if box.sample_token != token:
                raise ContentError(
                    f"{entry_place(token, number)}.sample_token: expected {token}, under which it "
                    f"stands, found {shortened(box.sample_token)!r}"
                )


def _check_unit_length(rotation: FloatArray, results: Mapping[str, Sequence[BoxEntry]]) -> None:
    """Raise ContentError if one of N quaternions, shape (N, 4), has another length than 1."""
    with np.errstate(over="ignore"):
        length = np.linalg.norm(rotation, axis=1)
    wrong_rows = np.flatnonzero(np.abs(length - 1) > _UNIT_TOLERANCE)
    if not len(wrong_rows):
        return
    row = int(wrong_rows[0])
    entries = [
        (token, number, box) for token, boxes in results.items() for number, box in enumerate(boxes)
    ]
    token, number, box = entries[row]
    raise ContentError(
        f"{entry_place(token, number)}.rotation: expected a unit quaternion [w, x, y, z], found "
        f"{list(box.rotation)}, {length[row]:.3g} long"
    )


def boxes_at(entries: Entries, token: str) -> DetectedBoxes:
    """Return the boxes of a sample, in the world frame; raises KeyError for an unknown sample."""
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


def _floats(values: Sequence[Iterable[float]], *shape: int) -> FloatArray:
    """Return the float64 array (N, *shape) of N flat tuples."""
    flat = np.fromiter(chain.from_iterable(values), np.float64, len(values) * math.prod(shape))
    return flat.reshape(len(values), *shape)


def plan_columns(results: Mapping[str, Sequence[PlanEntry]]) -> Columns:
    """Return the column of N plans.

    Raises ContentError for a plan with lists of different lengths, or a sample without plans.
    """
    for token, plans in results.items():
        if not plans:
            raise ContentError(
                f"{entry_place(token)}: expected one plan or more, found none; leave the sample out"
            )
    return _objects(results, _plan)


def _plan(entry: Any) -> Plan:
    return Plan(times=entry.times, path=entry.path, score=entry.score, yaw=entry.yaw or None)


def forecast_columns(results: Mapping[str, Sequence[ForecastEntry]]) -> Columns:
    """Return the column of N forecasts.

    Raises ContentError for a forecast with lists of different lengths, or a repeated actor.
    """
    for token, forecasts in results.items():
        ids: set[int] = set()
        for number, forecast in enumerate(forecasts):
            if forecast.id in ids:
                raise ContentError(
                    f"{entry_place(token, number)}.id: actor {forecast.id} comes twice"
                )
            ids.add(forecast.id)
    return _objects(results, _forecast)


def _forecast(entry: Any) -> Forecast:
    return Forecast(
        actor_id=entry.id,
        times=entry.times,
        paths=entry.paths,
        probabilities=entry.probabilities,
    )


def _objects(results: Mapping[str, Sequence[Any]], make_object: Callable[[Any], Any]) -> Columns:
    """Return a column of objects made from records; raises ContentError that names the entry."""
    objects = []
    for token, records in results.items():
        for number, record in enumerate(records):
            try:
                objects.append(make_object(record))
            except GeometryError as error:  # noqa: PERF203 - which entry it is
                raise ContentError(f"{entry_place(token, number)}: {error}") from error
    column = np.empty(len(objects), dtype=object)
    column[:] = objects
    return {_OBJECT: column}


def objects_at(entries: Entries, token: str) -> list[Any]:
    """Return the plans or forecasts of a sample; raises KeyError for an unknown sample."""
    objects: list[Any] = entries.of(token)[_OBJECT].tolist()
    return objects


# Task → function that makes the columns of its records, and function that makes a sample's
# prediction from them.
ENTRIES: Final[Mapping[str, tuple[Callable[..., Columns], Callable[[Entries, str], Any]]]] = {
    "accident": (accident_columns, accidents_at),
    "detection": (detection_columns, boxes_at),
    "planning": (plan_columns, objects_at),
    "forecasting": (forecast_columns, objects_at),
}
