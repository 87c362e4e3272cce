"""`Results`: a model's predictions for many samples, read strictly from a results file.

Entries are read into columns of all entries; maps stay in their shards until they are needed.
"""

from __future__ import annotations

import copy
import gc
import hashlib
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.errors import GeometryError, ResultsError, TokenError, shortened
from deepaccident_devkit.evaluation.forecasting.metrics import Forecast
from deepaccident_devkit.evaluation.planning.scene import Plan
from deepaccident_devkit.evaluation.predicted_boxes import DetectedBoxes, Tracks
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results.records import (
    FOLDER_TASKS,
    LENGTH_FIRST,
    RESULTS_FILE,
    AccidentEntry,
    BoxEntry,
    ContentError,
    ForecastEntry,
    MotionFile,
    PlanEntry,
    ResultsTask,
    SegmentationFile,
    TrackEntry,
    check_token,
    entry_place,
    fault_of,
    locate_errors,
    read_document,
)
from deepaccident_devkit.evaluation.results.shards import Form, ShardContents
from deepaccident_devkit.evaluation.segmentation import SegmentationOutput
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.support.reading import NO_NAME, fault_text, irregular_text, read_bytes
from deepaccident_devkit.support.text import PathType, counted, path_of
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import CATEGORIES, UNTRACKED_ID

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

Prediction = (
    MotionOutput | list[Accident] | DetectedBoxes | list[Plan] | list[Forecast] | SegmentationOutput
)
Columns = dict[str, AnyArray]
# Token → records of the sample's boxes.
_BoxRecords = Mapping[str, Sequence[BoxEntry | TrackEntry]]
# The length of a quaternion may differ from 1 by this much, since `Boxes` normalises quaternions.
_UNIT_TOLERANCE = 1e-3
_UNKNOWN_VELOCITY = (math.nan, math.nan)
# Largest number of parsed files that a process caches.
_MAX_CACHED_FILES = 4
# Name of the column that holds plans or forecasts as objects.
_OBJECT = "object"


class Results:
    """Predictions by sample token; `read_results` opens them.

    Results are cheap to pickle, because each process reads the file itself, once. They can be used
    in threads and in forked workers.

    Attributes:
        path: Path of the file, or of the folder of results in shards.
        task: Kind of the predictions.
        fingerprint: Hash of the file's bytes. It covers shards, too, since the file holds their
            checksums.
    """

    def __init__(self, path: Path, task: ResultsTask, fingerprint: str) -> None:
        """Store the fields; call `read_results` to open results."""
        self.path = path
        self.task = task
        self.fingerprint = fingerprint
        self._file = path / RESULTS_FILE if task in FOLDER_TASKS else path

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what pickle stores: everything but the contents."""
        return Results, (self.path, self.task, self.fingerprint)

    def __repr__(self) -> str:
        """Return the task, the number of samples and the path."""
        samples = counted(len(self), "sample")
        return f"<{self.task} results: {samples} in {self.path}>"

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._contents.tokens)

    def __contains__(self, token: object) -> bool:
        """Return whether a sample has a prediction."""
        return token in self._contents.tokens

    @property
    def tokens(self) -> tuple[str, ...]:
        """Tokens of the samples, in the file's order."""
        return tuple(self._contents.tokens)

    @property
    def meta(self) -> dict[str, Any]:
        """A copy of the author's notes in the file."""
        return copy.deepcopy(dict(self._contents.meta))

    @property
    def form(self) -> Form | None:
        """How maps are stored; None for tasks without maps."""
        return self._contents.form

    def prediction(self, token: str) -> Prediction:
        """Return the prediction for a sample.

        Returns:
            For motion, a MotionOutput; for segmentation, a SegmentationOutput. For detection and
            tracking, boxes in the world frame. For accidents, plans and forecasts, a list; it is
            empty if nothing is predicted.

        Raises:
            TokenError: If the results do not contain the sample.
            ResultsError: If arrays of the sample are missing or damaged, or the file was changed.
        """
        contents = self._contents
        if token not in contents.tokens:
            raise TokenError(
                f"{self.path}: has no prediction for {token!r}; `tokens` lists all samples "
                "that have one"
            )
        return contents.prediction(token)

    def check(self, **engine: Unpack[Engine]) -> None:
        """Read and check everything; do this before a long job or before you publish the results.

        Args:
            **engine: `workers` (1 by default), `executor` and `progress`; see `parallel.Engine`.

        Raises:
            ResultsError: If an array is invalid (the message names the shard, the token and the
                array of the first fault), or if the file was changed.
            WorkerError: If a worker was killed, or cannot see the results.
        """
        _read_content(self._file, self.fingerprint)
        contents = self._contents
        if isinstance(contents, ShardContents):  # other contents were checked when they were read
            contents.check(**{"workers": 1, **engine})

    @property
    def _contents(self) -> Contents:
        """Contents of the file, parsed on first use; raises ResultsError if they are invalid."""
        contents, _ = contents_of(self._file, self.fingerprint)
        return contents


def read_results(path: PathType) -> Results:
    """Open results in the format that schema/results/README.md describes.

    All entries are checked; for results in shards, only the manifest is checked.

    Args:
        path: Path of a JSON file, or of a folder that contains a results.json, as results in
            shards do.

    Raises:
        ResultsError: If there are no results at the path, their version is not supported, or they
            violate the format; the message names the token and field of the first invalid entry.
    """
    file = _find_file(path_of(path, error=ResultsError).absolute())
    contents, fingerprint = contents_of(file)
    if contents.task not in FOLDER_TASKS:
        return Results(file, contents.task, fingerprint)
    if file.name != RESULTS_FILE:
        raise ResultsError(
            f"{file}: is the manifest of {contents.task} results; rename it to {RESULTS_FILE}, "
            "the name that all readers expect"
        )
    return Results(file.parent, contents.task, fingerprint)


def _find_file(path: Path) -> Path:
    """Return the path of the JSON file, for the path of a file or of a folder with results.

    Raise ResultsError if there is no such file.
    """
    file = path
    try:
        file = path / RESULTS_FILE if path.is_dir() else path
        irregular = irregular_text(file.stat().st_mode)
    except FileNotFoundError:
        fault = "no such file or folder" if file == path else f"contains no {RESULTS_FILE}"
        raise ResultsError(
            f"{path}: {fault}; give results written by `deepaccident predict` or ResultsWriter"
        ) from None
    except (OSError, ValueError) as error:
        fault = fault_text(error) if isinstance(error, OSError) else NO_NAME
        raise ResultsError(f"{path}: {fault}; give readable results") from error
    if irregular:
        raise ResultsError(f"{file}: {irregular}; give a results file")
    return file


@dataclass(frozen=True, slots=True, eq=False)
class EntryContents:
    """Contents of a results file without shards; all entries are in memory and checked.

    Attributes:
        task: Kind of the predictions.
        meta: The author's notes.
        tokens: Tokens of the samples.
        prediction: Function that returns the prediction for a token.
        form: None, since only results in shards have a form.
    """

    task: ResultsTask
    meta: ReadOnlyValues
    tokens: Collection[str]
    prediction: Callable[[str], Prediction]
    form: Form | None = None


# Contents of a file. Callers must only ask for tokens that it contains.
Contents = EntryContents | ShardContents
# Path and fingerprint of a file → its contents, for the files that this process parsed most
# recently.
cached_contents: Final[dict[tuple[Path, str], Contents]] = {}


def contents_of(path: Path, fingerprint: str = "") -> tuple[Contents, str]:
    """Return the contents of a file and its fingerprint.

    Each process parses a file only once, however many copies of `Results` refer to it.

    Args:
        path: Path of the file.
        fingerprint: Fingerprint that the file must have; empty accepts any. If contents with this
            fingerprint are cached, they are returned and the file is not read again.

    Raises:
        ResultsError: If the file cannot be read, violates its format, or has changed.
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
    """Read a file's bytes, and hash them to 32 hexadecimal digits.

    Raise ResultsError if the file cannot be read, or its hash is not the expected fingerprint.
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
    """Parse the bytes of a results file; raise ResultsError if they violate the format."""
    try:
        document, meta = read_document(content, path)
        if isinstance(document, MotionFile | SegmentationFile):
            return ShardContents(path, meta, document)
        make_columns, make_prediction = ENTRIES[document.task]
        entries = Entries.read(document.results, make_columns)
    except (ContentError, OSError) as error:
        raise fault_of(path, error) from error
    prediction = partial(make_prediction, entries)
    tokens = entries.number.keys()
    return EntryContents(document.task, meta, tokens, prediction)


@contextmanager
def _collector_paused() -> Iterator[None]:
    """Pause the garbage collector.

    Parsing creates millions of objects, none of them in a cycle; scanning them repeatedly would
    double the time.
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
    """The N entries of a results file with S samples, as columns.

    Attributes:
        number: Token → index of the sample in the file.
        first: (S + 1,) index of each sample's first entry, followed by N.
        columns: Field → values of all entries, shape (N, …).
    """

    number: Mapping[str, int]
    first: IntArray
    columns: Columns

    @classmethod
    def read(
        cls,
        results: Mapping[str, Sequence[Any]],
        make_columns: Callable[[ReadOnlyValues], Columns],
    ) -> Entries:
        """Convert records to columns; raise a ContentError with token, entry and field on a fault.

        Args:
            results: Token → records of the sample.
            make_columns: Function that converts all records to columns.
        """
        with locate_errors("results"):
            for token in results:
                check_token(token)
        counts = [len(records) for records in results.values()]
        first = np.concatenate([[0], np.cumsum(counts)])
        numbers = {token: number for number, token in enumerate(results)}
        return cls(numbers, first, make_columns(results))

    def sample_columns(self, token: str) -> Columns:
        """Return the columns of a sample's entries; raise KeyError if the sample is unknown."""
        number = self.number[token]
        rows = slice(self.first[number], self.first[number + 1])
        return {field: column[rows] for field, column in self.columns.items()}


def accident_columns(results: Mapping[str, Sequence[AccidentEntry]]) -> Columns:
    """Convert N accidents to columns.

    The columns are positions (N, 2, 2) in metres, time (N,) in seconds, score (N,), ids (N, 2), and
    identified (N,) bool, which is True for accidents with ids.
    """
    accidents = list(chain.from_iterable(results.values()))
    positions = [chain(*accident.positions) for accident in accidents]
    times = [accident.time for accident in accidents]
    scores = [accident.score for accident in accidents]
    ids = [accident.ids or (0, 0) for accident in accidents]
    is_identified = [bool(accident.ids) for accident in accidents]
    return {
        "positions": _make_floats(positions, 2, 2),
        "time": np.array(times, dtype=np.float64),
        "score": np.array(scores, dtype=np.float64),
        "ids": np.array(ids, dtype=np.int64).reshape(-1, 2),
        "identified": np.array(is_identified, dtype=bool),
    }


def accidents_at(entries: Entries, token: str) -> list[Accident]:
    """Return the predicted accidents of a sample; raise KeyError if the sample is unknown."""
    columns = entries.sample_columns(token)
    accidents = []
    for row, is_identified in enumerate(columns["identified"].tolist()):
        ids = None
        if is_identified:
            ids = columns["ids"][row].tolist()
        accident = Accident(
            positions=columns["positions"][row],
            time=columns["time"].item(row),
            score=columns["score"].item(row),
            ids=ids,
        )
        accidents.append(accident)
    return accidents


def track_columns(results: Mapping[str, Sequence[TrackEntry]]) -> Columns:
    """Convert N boxes of tracks to the columns of detections, and texts `ids` (N,).

    Raise ContentError also if a track has two boxes in a sample.
    """
    ids: list[str] = []
    for token, tracks in results.items():
        sample_ids = [track.tracking_id for track in tracks]
        for number, name in enumerate(sample_ids):
            if name in sample_ids[:number]:
                raise ContentError(
                    f"{entry_place(token, number)}.tracking_id: {name!r} appears twice in this "
                    "sample; give each box of a sample its own id"
                )
        ids += sample_ids
    columns = detection_columns(results, "tracking")
    return {**columns, "ids": np.array(ids, dtype=object)}


def detection_columns(results: _BoxRecords, kind: str = "detection") -> Columns:
    """Convert N boxes in the world frame, of detections or of tracks, to columns.

    The columns are center (N, 3) in metres, rotation (N, 4) as unit quaternions w, x, y, z, size
    (N, 3) as length, width and height in metres, velocity (N, 3) in m/s (NaN if unknown), category
    (N,) and score (N,). Raise ContentError if a box names another sample, or if the length of its
    quaternion is not 1.
    """
    _check_sample_tokens(results)
    boxes = list(chain.from_iterable(results.values()))
    rotation = _make_floats([box.rotation for box in boxes], 4)
    _check_unit_length(rotation, results)
    velocity = _make_floats([box.velocity or _UNKNOWN_VELOCITY for box in boxes], 2)
    velocity_z = np.where(np.isnan(velocity[:, :1]), np.nan, 0.0)
    code_by_name = {name: code for code, name in enumerate(CATEGORIES)}
    codes = [code_by_name[getattr(box, f"{kind}_name")] for box in boxes]
    scores = [getattr(box, f"{kind}_score") for box in boxes]
    sizes = _make_floats([box.size for box in boxes], 3)
    return {
        "center": _make_floats([box.translation for box in boxes], 3),
        "size": sizes[:, LENGTH_FIRST],
        "rotation": rotation,
        "velocity": np.column_stack([velocity, velocity_z]),
        "category": np.array(codes, dtype=np.int8),
        "score": np.array(scores, dtype=np.float64),
    }


def _check_sample_tokens(results: _BoxRecords) -> None:
    """Raise ContentError if a box names another sample than the one that lists it."""
    for token, boxes in results.items():
        for number, box in enumerate(boxes):
            if box.sample_token != token:
                raise ContentError(
                    f"{entry_place(token, number)}.sample_token: expected {token}, the key of the "
                    f"entry, found {shortened(box.sample_token)!r}"
                )


def _check_unit_length(rotation: FloatArray, results: _BoxRecords) -> None:
    """Raise ContentError if the length of one of N quaternions, shape (N, 4), is not 1."""
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(rotation, axis=1)
    is_wrong = np.abs(lengths - 1) > _UNIT_TOLERANCE
    if not is_wrong.any():
        return
    row = 0
    for token, boxes in results.items():
        for number, box in enumerate(boxes):
            if is_wrong[row]:
                raise ContentError(
                    f"{entry_place(token, number)}.rotation: expected a unit quaternion "
                    f"[w, x, y, z], found {list(box.rotation)} of length {lengths[row]:.3g}"
                )
            row += 1


def boxes_at(entries: Entries, token: str) -> DetectedBoxes:
    """Return the boxes of a sample in the world frame; raise KeyError if the sample is unknown."""
    boxes, scores = _world_boxes(entries.sample_columns(token))
    return DetectedBoxes(boxes=boxes, scores=scores)


def tracks_at(entries: Entries, token: str) -> Tracks:
    """Return the tracks of a sample in the world frame; raise KeyError if the sample is unknown."""
    columns = entries.sample_columns(token)
    ids = columns.pop("ids")
    boxes, scores = _world_boxes(columns)
    return Tracks(boxes=boxes, scores=scores, ids=ids)


def _world_boxes(columns: NamedValues) -> tuple[Boxes, FloatArray]:
    """Return the boxes and scores of the columns of a sample."""
    scores: FloatArray = columns.pop("score")
    count = len(scores)
    boxes = Boxes(
        frame="world",
        **columns,
        actor_id=np.full(count, UNTRACKED_ID),
        num_lidar_pts=np.zeros(count, dtype=np.int64),
        camera_visible=np.zeros(count, dtype=bool),
        row=np.arange(count),
    )
    return boxes, scores


def _make_floats(rows: Sequence[Iterable[float]], *shape: int) -> FloatArray:
    """Convert N rows of numbers to a float64 array (N, *shape)."""
    size = len(rows) * math.prod(shape)
    numbers = np.fromiter(chain.from_iterable(rows), np.float64, size)
    return numbers.reshape(len(rows), *shape)


def plan_columns(results: Mapping[str, Sequence[PlanEntry]]) -> Columns:
    """Convert N plans to a column of `Plan` objects.

    Raise ContentError if the lists of a plan differ in length, or if a sample has no plan.
    """
    for token, plans in results.items():
        if not plans:
            raise ContentError(
                f"{entry_place(token)}: expected at least one plan, found none; omit the sample"
            )
    return _make_objects(results, _make_plan)


def _make_plan(entry: Any) -> Plan:
    """Convert an entry to a `Plan`."""
    yaw = entry.yaw or None
    return Plan(times=entry.times, path=entry.path, score=entry.score, yaw=yaw)


def forecast_columns(results: Mapping[str, Sequence[ForecastEntry]]) -> Columns:
    """Convert N forecasts to a column of `Forecast` objects.

    Raise ContentError if the lists of a forecast differ in length, or if an actor occurs twice.
    """
    for token, forecasts in results.items():
        ids: set[int] = set()
        for number, forecast in enumerate(forecasts):
            if forecast.id in ids:
                raise ContentError(
                    f"{entry_place(token, number)}.id: actor {forecast.id} appears twice"
                )
            ids.add(forecast.id)
    return _make_objects(results, _make_forecast)


def _make_forecast(entry: Any) -> Forecast:
    """Convert an entry to a `Forecast`."""
    return Forecast(
        actor_id=entry.id,
        times=entry.times,
        paths=entry.paths,
        probabilities=entry.probabilities,
    )


def _make_objects(
    results: Mapping[str, Sequence[Any]], make_object: Callable[[Any], Any]
) -> Columns:
    """Convert records to a column of objects; raise a ContentError that names an invalid entry."""
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
    """Return the plans or forecasts of a sample; raise KeyError if the sample is unknown."""
    columns = entries.sample_columns(token)
    objects: list[Any] = columns[_OBJECT].tolist()
    return objects


# Task → function that converts records to columns, and function that converts the columns of a
# sample to its prediction.
ENTRIES: Final[Mapping[str, tuple[Callable[..., Columns], Callable[[Entries, str], Any]]]] = {
    "accident": (accident_columns, accidents_at),
    "detection": (detection_columns, boxes_at),
    "tracking": (track_columns, tracks_at),
    "planning": (plan_columns, objects_at),
    "forecasting": (forecast_columns, objects_at),
}
