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
    at,
    check_token,
    entry_place,
    fault_of,
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
# How far from 1 a quaternion's norm may be; `Boxes` brings it there.
_UNIT_TOLERANCE: Final = 1e-3
_UNKNOWN: Final = (math.nan, math.nan)
_MOST_KEPT: Final = 4


class Results:
    """Predictions by sample token; `read_results` opens them.

    Cheap to pickle, since copies read the file again, once a process; safe in threads and in forked workers.

    Attributes:
        path: of the file, or of the folder of motion results.
        task: what the predictions are of.
        fingerprint: hash of the file's bytes; those of motion results hold the shards' checksums.
    """

    def __init__(self, path: Path, task: ResultsTask, fingerprint: str) -> None:
        """Results that `read_results` has seen; it opens new ones."""
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
        """Number of samples."""
        return len(self._contents.tokens)

    def __contains__(self, token: object) -> bool:
        """Whether a sample has a prediction."""
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
        """The prediction of a sample.

        Returns:
            For motion a MotionOutput; of accidents, plans and forecasts a list, empty if there is none; of detection
            the boxes, in the world frame.

        Raises:
            TokenError: the sample is not here.
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
        **how: Unpack[Engine],
    ) -> None:
        """Read and check everything: do so before long work and before publishing.

        Args:
            **how: `workers` (1 if not given), `executor` and `progress`, as `parallel.Engine` says.

        Raises:
            ResultsError: names the shard, the token and the array of the first fault, or the file was changed.
            WorkerError: a worker was killed, or does not see the results.
        """
        _content(self._file, self.fingerprint)
        contents = self._contents
        if isinstance(contents, MotionContents):  # all others were checked when they were read
            contents.check(**{"workers": 1, **how})

    @property
    def _contents(self) -> Contents:
        return contents_of(self._file, self.fingerprint)[0]


def read_results(path: str | os.PathLike[str]) -> Results:
    """Open results (schema/results/README.md); all accidents and boxes are checked, and of motion the manifest.

    Args:
        path: a JSON file, or a folder that holds a results.json, as motion results do.

    Raises:
        ResultsError: there is none, it is of another version, or against its format; the message names the first
            wrong entry by its token and field.
    """
    file = _file_of(path_of(path, error=ResultsError).absolute())
    contents, fingerprint = contents_of(file)
    task = contents.task
    if task == "motion" and file.name != RESULTS_FILE:
        raise ResultsError(
            f"{file}: is the manifest of motion results; call it {RESULTS_FILE}, as others look for it"
        )
    return Results(file.parent if task == "motion" else file, task, fingerprint)


def _file_of(path: Path) -> Path:
    file = path
    try:
        file = path / RESULTS_FILE if path.is_dir() else path
        irregular = irregular_text(file.stat().st_mode)
    except FileNotFoundError:
        what = "no such file or folder" if file == path else f"holds no {RESULTS_FILE}"
        raise ResultsError(f"{path}: {what}; give the results that ResultsWriter made") from None
    except (OSError, ValueError) as error:
        raise ResultsError(
            f"{path}: {fault_text(error) if isinstance(error, OSError) else NO_NAME}; give results that can be read"
        ) from error
    if irregular:
        raise ResultsError(f"{file}: {irregular}; give a results file")
    return file


@dataclass(frozen=True, slots=True, eq=False)
class EntryContents:
    """Accidents or detected boxes, all of them in memory and checked; `prediction` gives those of a token."""

    task: ResultsTask
    meta: Mapping[str, Any]
    tokens: Collection[str]
    prediction: Callable[[str], Prediction]
    form: MotionForm | None = None


# The content of a file; callers ask only for tokens that it has.
Contents = EntryContents | MotionContents
# Path and fingerprint → contents of the files that this process parsed last.
kept: Final[dict[tuple[Path, str], Contents]] = {}


def contents_of(path: Path, fingerprint: str = "") -> tuple[Contents, str]:
    """The contents of a file, which a process parses once for all copies of `Results`, and its fingerprint.

    A fingerprint that is given is of the bytes that it must have, not read again if they were parsed. Raises
    ResultsError: it cannot be read, is not as its format says, or has other bytes now.
    """
    contents = kept.get((path, fingerprint))
    if contents is not None:
        return contents, fingerprint
    content, found = _content(path, fingerprint)
    contents = kept.get((path, found))
    if contents is None:
        with _collector_paused():
            contents = _parsed(content, path)
        while len(kept) >= _MOST_KEPT:
            kept.pop(next(iter(kept)), None)
        kept[path, found] = contents
    return contents, found


def _content(path: Path, fingerprint: str) -> tuple[bytes, str]:
    """A file's bytes, and their hash, 32 hexadecimal digits; raises ResultsError if it was to be another."""
    try:
        content = read_bytes(path, "results")
    except OSError as error:
        raise fault_of(path, error) from error
    found = hashlib.blake2b(content, digest_size=16).hexdigest()
    if fingerprint not in ("", found):
        raise ResultsError(f"{path}: was changed after it was opened; open it again")
    return content, found


def _parsed(content: bytes, path: Path) -> Contents:
    try:
        document, meta = read_document(content, path)
        if isinstance(document, MotionFile):
            return MotionContents(path, meta, document)
        columns, prediction = ENTRIES[document.task]
        entries = Entries.read(document.results, columns)
    except (ContentError, OSError) as error:
        raise fault_of(path, error) from error
    return EntryContents(document.task, meta, entries.number.keys(), partial(prediction, entries))


@contextmanager
def _collector_paused() -> Iterator[None]:
    """Parsing makes millions of objects, none in a cycle; to look through them again and again doubles the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


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
    def read(
        cls, results: Mapping[str, Sequence[Any]], columns: Callable[[Mapping[str, Any]], Columns]
    ) -> Entries:
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


def accident_columns(results: Mapping[str, Sequence[AccidentEntry]]) -> Columns:
    """Of N accidents positions (N, 2, 2) metres, time (N,) seconds, score (N,), ids (N, 2), identified (N,) bool."""
    accidents = list(chain.from_iterable(results.values()))
    return {
        "positions": _floats(
            [(*one, *other) for one, other in (each.positions for each in accidents)], 2, 2
        ),
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


def detection_columns(results: Mapping[str, Sequence[BoxEntry]]) -> Columns:
    """Of N boxes `center` (N, 3) metres, rotation (N, 4) unit quaternions w, x, y, z, both in the world, and others.

    These are size (N, 3) length, width, height, velocity (N, 3) m/s, NaN where unknown, category (N,), score (N,).
    Raises ContentError: a box names another sample, or its quaternion has another length than 1.
    """
    for token, given in results.items():
        others = [number for number, box in enumerate(given) if box.sample_token != token]
        if others:
            place, found = entry_place(token, others[0]), shortened(given[others[0]].sample_token)
            raise ContentError(
                f"{place}.sample_token: expected {token}, under which it stands, found {found!r}"
            )
    boxes = list(chain.from_iterable(results.values()))
    rotation = _floats([box.rotation for box in boxes], 4)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(rotation, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > _UNIT_TOLERANCE)
    if len(wrong):
        row = int(wrong[0])
        places = [
            entry_place(token, number)
            for token, given in results.items()
            for number in range(len(given))
        ]
        found = f"{list(boxes[row].rotation)}, {length[row]:.3g} long"
        raise ContentError(
            f"{places[row]}.rotation: expected a unit quaternion [w, x, y, z], found {found}"
        )
    velocity = _floats([box.velocity or _UNKNOWN for box in boxes], 2)
    code = {name: number for number, name in enumerate(CATEGORIES)}
    return {
        "center": _floats([box.translation for box in boxes], 3),
        "size": _floats([box.size for box in boxes], 3)[:, LENGTH_FIRST],
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


def _floats(values: Sequence[Iterable[float]], *shape: int) -> FloatArray:
    """(N, *shape) float64 of N flat tuples."""
    flat = np.fromiter(chain.from_iterable(values), np.float64, len(values) * math.prod(shape))
    return flat.reshape(len(values), *shape)


def plan_columns(results: Mapping[str, Sequence[PlanEntry]]) -> Columns:
    """(N,) plans; raises ContentError for one whose lists do not go together, or a sample without any."""
    for token, given in results.items():
        if not given:
            raise ContentError(
                f"{entry_place(token)}: expected one plan or more, found none; leave the sample out"
            )
    return _objects(
        results,
        lambda each: Plan(times=each.times, path=each.path, score=each.score, yaw=each.yaw or None),
    )


def forecast_columns(results: Mapping[str, Sequence[ForecastEntry]]) -> Columns:
    """(N,) forecasts; raises ContentError for one whose lists do not go together, or an actor that comes twice."""
    for token, given in results.items():
        again = [
            number
            for number, each in enumerate(given)
            if each.id in {other.id for other in given[:number]}
        ]
        if again:
            raise ContentError(
                f"{entry_place(token, again[0])}.id: actor {given[again[0]].id} comes twice"
            )
    return _objects(
        results,
        lambda each: Forecast(
            actor_id=each.id, times=each.times, paths=each.paths, probabilities=each.probabilities
        ),
    )


def _objects(results: Mapping[str, Sequence[Any]], made: Callable[[Any], Any]) -> Columns:
    objects = []
    for token, given in results.items():
        for number, each in enumerate(given):
            try:
                objects.append(made(each))
            except GeometryError as error:  # noqa: PERF203 - which entry it is
                raise ContentError(f"{entry_place(token, number)}: {error}") from error
    column = np.empty(len(objects), dtype=object)
    column[:] = objects
    return {_OBJECT: column}


def objects_at(entries: Entries, token: str) -> list[Any]:
    """The plans or forecasts of a sample; KeyError for one that is not here."""
    found: list[Any] = entries.of(token)[_OBJECT].tolist()
    return found


_OBJECT: Final = "object"
# Task → what makes the columns of its records by token, and of the columns a sample's prediction.
ENTRIES: Final[Mapping[str, tuple[Callable[..., Columns], Callable[[Entries, str], Any]]]] = {
    "accident": (accident_columns, accidents_at),
    "detection": (detection_columns, boxes_at),
    "planning": (plan_columns, objects_at),
    "forecasting": (forecast_columns, objects_at),
}
