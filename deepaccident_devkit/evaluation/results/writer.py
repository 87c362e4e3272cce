"""`ResultsWriter` writes the predictions for many samples, completely or not at all."""

from __future__ import annotations

import io
import json
import math
import shutil
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeVar, get_args

import msgspec
import numpy as np

from deepaccident_devkit.errors import EvaluationError, ResultsError, shortened
from deepaccident_devkit.evaluation.forecasting.metrics import Forecast
from deepaccident_devkit.evaluation.planning.scene import Plan
from deepaccident_devkit.evaluation.predicted_boxes import DetectedBoxes, Tracks
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, checked_prediction
from deepaccident_devkit.evaluation.results.motion import MotionEncoder
from deepaccident_devkit.evaluation.results.reader import Results, contents_of, read_results
from deepaccident_devkit.evaluation.results.records import (
    ENTRY_RECORDS,
    FOLDER_TASKS,
    FORMAT,
    FORMAT_VERSION,
    LENGTH_FIRST,
    MEMBER,
    RESULTS_FILE,
    ContentError,
    Kind,
    ResultsTask,
    Shard,
    Stored,
    check_token,
    json_meta,
    read_entries,
)
from deepaccident_devkit.evaluation.results.segmentation import SegmentationEncoder
from deepaccident_devkit.evaluation.segmentation import SegmentationOutput
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.files import replacing, replacing_folder
from deepaccident_devkit.support.reading import file_checksum, open_file, read_bytes
from deepaccident_devkit.support.text import PathType, choice, counted, differing_text, path_of
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues

_BoxesT = TypeVar("_BoxesT", bound=DetectedBoxes)
# Text before the entries in a file. The notes before it do not contain line ends.
_BODY_START = ',\n"results": {'
# Text after the entries in a file.
_BODY_END = "\n}\n}\n"
# Date of all members of an archive: the earliest one that zip can store.
_ARCHIVE_DATE = (1980, 1, 1, 0, 0, 0)
# A shard is complete when it has this many samples,
_MAX_SHARD_SAMPLES = 64
# or this many bytes.
MAX_SHARD_BYTES: Final = 32 * 2**20


class ResultsWriter:
    """Writer of results that `read_results` can read; use it in a `with` statement.

    The file (for motion and segmentation, the folder) appears when the block ends without an
    exception; otherwise nothing appears. Memory does not grow with the number of samples, and the
    same predictions always lead to the same bytes.

        with ResultsWriter("results/motion", "motion", meta={"method": "mine"}) as writer:
            for token in tokens:
                writer.add(token, MotionOutput.from_arrays(*model(token), grid=grid))
    """

    def __init__(
        self,
        path: PathType,
        task: ResultsTask,
        *,
        meta: Mapping[str, Any] | None = None,
        grid: BevGrid | None = None,
        step: float = 0.5,
        labels: str | None = "released",
        store: Stored = "instances",
        classes: Sequence[str] | None = None,
    ) -> None:
        """Prepare to write; no file is created yet.

        Args:
            path: Path of a new file; for motion and segmentation, of a new or empty folder.
            task: Name from `RESULTS_NAMES`.
            meta: Notes for readers, such as method, training and author; JSON-compatible values.
            grid: For motion and segmentation, the BEV grid of all predictions; None takes the grid
                of the first prediction.
            step: For motion, seconds between two frames.
            labels: For motion, the label protocol (`motion.LABEL_PROTOCOLS`) that the model was
                trained on and is compared with; None if unknown.
            store: For motion, `instances` stores instance maps, about 30 KB for a sample with five
                predictions. Heads are post-processed as in the released evaluation of motion
                (docs/released_code.md, section "Post-processing"). The released accident evaluation
                post-processes heads differently, so its numbers differ slightly if they are
                computed from instance maps. `heads` stores the model's outputs unchanged, 34 MB for
                a sample with six predictions.
            classes: For segmentation, names of the layers of all predictions; None takes those of
                the first prediction.

        Raises:
            ChoiceError: If `task` is not a name from `RESULTS_NAMES`.
            ResultsError: If a value cannot be written, or something already exists at `path`.
        """
        self.task = choice("task", task, get_args(ResultsTask))
        self.path = path_of(path).absolute()
        try:
            notes = json_meta({} if meta is None else meta)
        except ContentError as error:
            raise ResultsError(str(error)) from error
        self._header = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "task": self.task,
            "meta": notes,
        }
        self._encoder: MotionEncoder | SegmentationEncoder
        self._encoder = MotionEncoder(grid, step, labels, store)
        if self.task == "segmentation":
            self._encoder = SegmentationEncoder(grid, classes)
        self._check_free()
        self._tokens: set[str] = set()
        self._stack = ExitStack()
        self._body: EntryWriter | ShardWriter | None = None

    def __repr__(self) -> str:
        """Return the task, the path and the number of samples written."""
        samples = counted(len(self._tokens), "sample")
        return f"ResultsWriter({self.task} to {self.path}: {samples})"

    def __enter__(self) -> ResultsWriter:
        """Open a temporary file or folder next to the path; raise ResultsError on failure."""
        self._check_free()
        with _naming_results(self.path), ExitStack() as stack:
            if self.task in FOLDER_TASKS:
                folder = stack.enter_context(replacing_folder(self.path))
                self._body = ShardWriter(folder, self._header, self._encoder)
            else:
                temporary = stack.enter_context(replacing(self.path))
                self._body = EntryWriter(temporary, self._header)
            stack.callback(self._body.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Move the results to their path; after an exception, remove what was written instead."""
        body = self._body
        self._body = None
        if error_type is not None:
            self._stack.__exit__(error_type, error, trace)
            return
        with _naming_results(self.path), self._stack:
            if body is None:
                raise ResultsError(
                    "a prediction could not be written, so none was kept; write all predictions "
                    "again"
                )
            body.finish()

    def add(
        self,
        token: str,
        prediction: MotionOutput
        | Iterable[Accident]
        | DetectedBoxes
        | Iterable[Plan]
        | Iterable[Forecast]
        | SegmentationOutput,
    ) -> None:
        """Write the prediction for a sample.

        Args:
            token: Token of the sample; add each sample only once. `check results --dataroot` checks
                whether the release has the sample; this method does not.
            prediction: For motion, a MotionOutput; all outputs must have the same grid and number
                of frames. For accidents, a list of predicted accidents, [] if there are none. For
                detection and tracking, boxes in the world frame. For planning, one or more Plans.
                For forecasting, one Forecast per actor. For segmentation, a SegmentationOutput; all
                outputs must have the same grid and classes, and all masks or all scores.

        Raises:
            ResultsError: If the prediction has the wrong type, grid or frame, the sample was added
                before, or writing fails; the message begins with the path and the token.
        """
        body = self._check_open()
        try:
            check_token(token)
            if token in self._tokens:
                raise ResultsError("was already added; add one prediction per sample")
            body.add(token, prediction)
        except (ContentError, ResultsError) as error:
            raise ResultsError(f"{self.path}: {token}: {error}") from error
        except OSError as error:
            self._body = None
            raise _write_error(self.path, error) from error
        self._tokens.add(token)

    def add_part(self, part: Results) -> None:
        """Copy all predictions from results that another writer with the same arguments wrote.

        The bytes are copied without decoding them.

        Raises:
            ResultsError: If reading or writing fails.
        """
        body = self._check_open()
        self._body = None  # stays None after an error, as in `add`
        with _naming_results(self.path):
            body.add_part(part)
        self._body = body
        self._tokens.update(part.tokens)

    def _check_open(self) -> EntryWriter | ShardWriter:
        """Return the open writer; raise ResultsError if there is none, outside a `with` block."""
        if self._body is None:
            raise ResultsError(
                f"{self.path}: is not open; add predictions inside `with ResultsWriter(…) as "
                "writer:`"
            )
        return self._body

    def _check_free(self) -> None:
        """Raise ResultsError if the path exists, unless it is an empty folder for shards."""
        with _naming_results(self.path):
            may_exist = self.task in FOLDER_TASKS and self.path.is_dir()
            is_empty = may_exist and not any(self.path.iterdir())
            exists = self.path.exists() or self.path.is_symlink()
            if exists and not is_empty:
                raise ResultsError(
                    f"{self.path}: already exists{self._existing_notes_text()}; choose another "
                    "path, or remove it"
                )

    def _existing_notes_text(self) -> str:
        """Say in brackets how the notes of existing results differ; empty if there are none."""
        try:
            existing = read_results(self.path)
        except ResultsError:
            return ""
        old_meta = existing.meta
        new_meta = dict(self._header["meta"])
        old_method = old_meta.get("method")
        new_method = new_meta.get("method")
        if old_method != new_method:  # then the other notes differ, too
            old_text = shortened(repr(old_method))
            new_text = shortened(repr(new_method))
            return f" (with method {old_text}, not {new_text})"
        for meta in (old_meta, new_meta):
            meta.pop("bytes", None)  # they follow from the other notes
        text = differing_text(old_meta, new_meta)
        return f" ({text or 'of other samples'})"


@contextmanager
def _naming_results(path: Path) -> Iterator[None]:
    """Prefix the path to ResultsErrors, and turn OSErrors into ResultsErrors with it."""
    try:
        yield
    except ResultsError as error:
        text = str(error)
        if not text.startswith(str(path)):
            text = f"{path}: {text}"
        raise ResultsError(text) from error
    except OSError as error:
        raise _write_error(path, error) from error


def _write_error(path: Path, error: OSError) -> ResultsError:
    """Build the ResultsError for results that cannot be written."""
    return ResultsError(
        f"{path}: results cannot be written ({error}); free space there, or choose another path"
    )


class EntryWriter:
    """Writer of a results file, from the header to the last sample; maps have `ShardWriter`."""

    def __init__(self, path: Path, header: ReadOnlyValues) -> None:
        """Open a new file and write the header."""
        task = header["task"]
        self._make_entries = _ENTRIES[task]
        self._record_type = ENTRY_RECORDS[task]
        self._count = 0
        self._file = path.open("w", encoding="utf-8", newline="\n")
        for name, value in header.items():
            if self._file.tell():
                separator = ","
            else:
                separator = "{"
            self._file.write(f"{separator}\n{json.dumps(name)}: {json.dumps(value)}")
        self._file.write(_BODY_START)

    def add(self, token: str, prediction: object) -> None:
        """Write the entries of a sample.

        Raise ResultsError or ContentError if they are invalid; then nothing of the sample is
        written.
        """
        entries = json.dumps(self._make_entries(token, prediction))
        read_entries(entries.encode(), self._record_type)
        self._write_body(f"\n{json.dumps(token)}: {entries}", 1)

    def add_part(self, part: Results) -> None:
        """Copy the entries of a file that another writer of this class wrote."""
        text = read_bytes(part.path, "results").decode()
        body = text.partition(_BODY_START)[2].removesuffix(_BODY_END)
        self._write_body(body, len(part))

    def _write_body(self, text: str, sample_count: int) -> None:
        """Append the text of further samples, after a separator if there are earlier ones."""
        if self._count:
            self._file.write(",")
        self._file.write(text)
        self._count += sample_count

    def finish(self) -> None:
        """Write the end of the file and close it; raise ResultsError if no sample was added."""
        if not self._count:
            raise ResultsError("no prediction was added; add at least one prediction")
        self._file.write(_BODY_END)
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _accident_entries(token: str, prediction: object) -> list[NamedValues]:
    """Convert the accidents of a sample to entries; raise ResultsError if one is invalid."""
    del token
    try:
        accidents = checked_prediction(prediction)
    except EvaluationError as error:
        raise ResultsError(str(error)) from error
    if isinstance(accidents, MotionOutput):
        raise ResultsError(
            "expected a list of Accidents, found a MotionOutput; write it to results of the task "
            "'motion'"
        )
    return [
        {
            "positions": accident.positions.tolist(),
            "time": accident.time,
            "score": accident.score,
            "ids": None if accident.ids is None else list(accident.ids),
        }
        for accident in accidents
    ]


def _box_entries(token: str, prediction: object) -> list[NamedValues]:
    """Convert the boxes of a sample to entries; raise ResultsError if they are invalid."""
    return detection_entries(token, _check_boxes(DetectedBoxes, prediction))


def _check_boxes(box_type: type[_BoxesT], prediction: object) -> _BoxesT:
    """Return a prediction; raise ResultsError if it has another type or is not in the world."""
    name = box_type.__name__
    if type(prediction) is not box_type:
        raise ResultsError(
            f"expected {name}, found {type(prediction).__name__}; make them with "
            f"{name}.from_arrays(center, size, yaw, scores, …, frame='world')"
        )
    frame = prediction.boxes.frame
    if frame != "world":
        raise ResultsError(
            f"expected boxes in the world frame, found {frame}; give "
            f"detected.transform(dataset.world_from(token, {frame!r}), 'world')"
        )
    return prediction


def detection_entries(
    token: str, predicted: DetectedBoxes, kind: str = "detection"
) -> list[NamedValues]:
    """Convert a sample's boxes, which are in the world frame, to entries of a results file."""
    boxes = predicted.boxes
    rows = zip(
        boxes.center.tolist(),
        boxes.size[:, LENGTH_FIRST].tolist(),
        boxes.rotation.tolist(),
        boxes.velocity[:, :2].tolist(),
        boxes.category_names,
        predicted.scores.tolist(),
        strict=True,
    )
    return [
        {
            "sample_token": token,
            "translation": center,
            "size": size,
            "rotation": rotation,
            "velocity": velocity if all(map(math.isfinite, velocity)) else None,
            f"{kind}_name": category,
            f"{kind}_score": score,
        }
        for center, size, rotation, velocity, category, score in rows
    ]


def _track_entries(token: str, prediction: object) -> list[NamedValues]:
    """Convert the tracks of a sample to entries; raise ResultsError if they are invalid."""
    tracks = _check_boxes(Tracks, prediction)
    entries = detection_entries(token, tracks, "tracking")
    return [{**entry, "tracking_id": name} for entry, name in zip(entries, tracks.ids, strict=True)]


def _plan_entries(token: str, prediction: object) -> list[NamedValues]:
    """Convert the plans of a sample to entries; raise ResultsError if an item is not a Plan."""
    del token
    entries = []
    for plan in _check_items(Plan, prediction):
        entry: NamedValues = {
            "times": plan.times.tolist(),
            "path": plan.path.tolist(),
            "score": plan.score,
        }
        if plan.yaw is not None:
            entry["yaw"] = plan.yaw.tolist()
        entries.append(entry)
    return entries


def _forecast_entries(token: str, prediction: object) -> list[NamedValues]:
    """Convert the forecasts of a sample to entries; raise ResultsError if one is not a Forecast."""
    del token
    return [
        {
            "id": forecast.actor_id,
            "times": forecast.times.tolist(),
            "paths": forecast.paths.tolist(),
            "probabilities": forecast.probabilities.tolist(),
        }
        for forecast in _check_items(Forecast, prediction)
    ]


def _check_items(item_type: type[Kind], prediction: object) -> list[Kind]:
    """Return the items of a prediction as a list; raise ResultsError if one has another type."""
    items = list(prediction) if isinstance(prediction, Iterable) else [prediction]
    checked = []
    for item in items:
        if not isinstance(item, item_type):
            raise ResultsError(
                f"expected a list of {item_type.__name__}s, found {type(item).__name__} in the list"
            )
        checked.append(item)
    return checked


# Task → function that converts a sample's token and prediction to entries.
_ENTRIES: Mapping[str, Callable[[str, object], list[NamedValues]]] = {
    "accident": _accident_entries,
    "detection": _box_entries,
    "tracking": _track_entries,
    "planning": _plan_entries,
    "forecasting": _forecast_entries,
}


class ShardWriter:
    """Writer of a folder of results in arrays: first the shards, then the manifest."""

    def __init__(
        self,
        folder: Path,
        header: ReadOnlyValues,
        encoder: MotionEncoder | SegmentationEncoder,
    ) -> None:
        """Create the folder of shards in an empty folder.

        Args:
            folder: The folder.
            header: Fields at the beginning of the manifest.
            encoder: Encoder of the predictions.
        """
        self._folder = folder
        self._header = header
        self._encoder: Any = encoder
        self._shards: list[Shard] = []
        self._archive: zipfile.ZipFile | None = None
        self._shard_tokens: list[str] = []
        (folder / "shards").mkdir()

    def add(self, token: str, prediction: object) -> None:
        """Write a sample's prediction; if it is invalid, raise ResultsError and write nothing."""
        arrays = self._encoder.encode(prediction)
        if self._archive is None:
            self._archive = zipfile.ZipFile(self._folder / self._shard_file, "w")
        for name, array in arrays.items():
            put_array(self._archive, MEMBER.format(token, name), array)
        self._shard_tokens.append(token)
        written_bytes = sum(entry.compress_size for entry in self._archive.infolist())
        if len(self._shard_tokens) >= _MAX_SHARD_SAMPLES or written_bytes >= MAX_SHARD_BYTES:
            self._end_shard()

    def add_part(self, part: Results) -> None:
        """Copy the shards of a folder that another writer of this class wrote.

        The predictions of both must have the same grid and, for motion, number of frames.
        """
        self._end_shard()
        contents: Any = contents_of(part.path / RESULTS_FILE)[0]
        self._encoder.adopt(contents.form)
        for shard in contents.shards:
            target_path = self._folder / self._shard_file
            with open_file(part.path / shard.file) as source, target_path.open("wb") as target:
                shutil.copyfileobj(source, target)
            self._shards.append(msgspec.structs.replace(shard, file=self._shard_file))

    def finish(self) -> None:
        """Write the manifest; raise ResultsError if no sample was added."""
        self._end_shard()
        form = self._encoder.form
        if form is None or not self._shards:
            raise ResultsError("no prediction was added; add at least one prediction")
        shards = msgspec.to_builtins(self._shards)
        manifest = {**self._header, "form": form.as_dict(), "shards": shards}
        text = f"{json.dumps(manifest, indent=1)}\n"
        (self._folder / RESULTS_FILE).write_bytes(text.encode())

    def close(self) -> None:
        """Close the archive that is being written, if any."""
        archive = self._archive
        self._archive = None
        if archive is not None:
            archive.close()

    @property
    def _shard_file(self) -> str:
        """Path of the next shard, relative to the folder."""
        number = len(self._shards)
        return f"shards/{number:05d}.npz"

    def _end_shard(self) -> None:
        """Close the archive that is being written, and list it as a shard."""
        if self._archive is None:
            return
        self.close()
        path = self._folder / self._shard_file
        shard = Shard(
            file=self._shard_file,
            tokens=tuple(self._shard_tokens),
            bytes=path.stat().st_size,
            checksum=file_checksum(path),
        )
        self._shards.append(shard)
        self._shard_tokens = []


def put_array(archive: zipfile.ZipFile, member: str, array: AnyArray) -> None:
    """Add an array to an archive with a fixed date, so that equal contents have equal bytes."""
    buffer = io.BytesIO()
    contiguous = np.ascontiguousarray(array)
    np.lib.format.write_array(buffer, contiguous, version=(1, 0), allow_pickle=False)
    entry = zipfile.ZipInfo(member, _ARCHIVE_DATE)
    entry.external_attr = 0o644 << 16
    # maps of floats look like noise: compressing them takes a second and saves nothing
    is_noise = array.dtype.kind == "f" and array.ndim > 3
    if is_noise:
        compression = zipfile.ZIP_STORED
    else:
        compression = zipfile.ZIP_DEFLATED
    archive.writestr(entry, buffer.getvalue(), compression, compresslevel=6)
