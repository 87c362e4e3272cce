"""`ResultsWriter` writes predictions of many samples to results, completely or not at all."""

from __future__ import annotations

import io
import json
import math
import os
import shutil
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Final, get_args

import msgspec
import numpy as np

from deepaccident_devkit.errors import EvaluationError, ResultsError, shortened
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.forecasting.metrics import Forecast
from deepaccident_devkit.evaluation.planning.scene import Plan
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, checked_prediction
from deepaccident_devkit.evaluation.results.motion import HEADS, MEMBER, MotionForm
from deepaccident_devkit.evaluation.results.reader import Results, contents_of, read_results
from deepaccident_devkit.evaluation.results.records import (
    ENTRY_RECORDS,
    FORMAT,
    FORMAT_VERSION,
    LENGTH_FIRST,
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
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import predict_instances
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.files import replacing, replacing_folder
from deepaccident_devkit.support.reading import file_checksum, open_file, read_bytes
from deepaccident_devkit.support.text import choice, counted, differing_text, path_of
from deepaccident_devkit.taxonomy import CATEGORIES

# Texts before and after the entries in a file; the notes have no line ends.
_BODY_START, _BODY_END = ',\n"results": {', "\n}\n}\n"
# The earliest date of a zip archive.
_ARCHIVE_DATE: Final = (1980, 1, 1, 0, 0, 0)
# Number of samples, and of bytes, at which a shard is complete.
_MAX_SHARD_SAMPLES: Final = 64
MAX_SHARD_BYTES: Final = 32 * 2**20


class ResultsWriter:
    """Writes results that `read_results` reads; used in a `with` statement.

    The file, or for motion the folder, appears when the block ends without an exception; otherwise
    nothing does. Memory does not grow with the samples, and the same predictions give the same
    bytes.

        with ResultsWriter("results/motion", "motion", meta={"method": "mine"}) as writer:
            for token in tokens:
                writer.add(token, MotionOutput.from_arrays(*model(token), grid=grid))
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        task: ResultsTask,
        *,
        meta: Mapping[str, Any] | None = None,
        grid: BevGrid | None = None,
        step: float = 0.5,
        labels: str | None = "released",
        store: Stored = "instances",
    ) -> None:
        """Prepare to write; touches nothing.

        Args:
            path: Path of a new file; for motion of a new or empty folder.
            task: Name from `RESULTS_NAMES`.
            meta: Notes for readers in JSON form: method, training, author.
            grid: For motion, the BEV grid of all predictions; None for that of the first
                prediction.
            step: For motion, seconds between two frames.
            labels: For motion, the label protocol (`motion.LABEL_PROTOCOLS`) that the model learned
                from, which it is compared with; None if it is not known.
            store: For motion, `instances` stores instance maps, about 30 KB a sample of five
                predictions; heads are post-processed as in the released evaluation of motion
                (docs/released_code.md, Post-processing). The released accident evaluation does that
                in its own way, and from instance maps its numbers differ slightly. `heads` stores
                the maps of the model unchanged: 34 MB a sample of six predictions.

        Raises:
            ChoiceError: no such task.
            ResultsError: a value that cannot be written, or something exists at `path`.
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
        form = MotionForm(
            stored=store, grid=grid or BevGrid(), predictions=1, frames=1, step=step, labels=labels
        )
        self._motion: dict[str, Any] = {
            "grid": grid,
            "step": form.step,
            "labels": form.labels,
            "store": form.stored,
        }
        self._check_free()
        self._tokens: set[str] = set()
        self._stack = ExitStack()
        self._body: EntryWriter | ShardWriter | None = None

    def __repr__(self) -> str:
        """Return its task and path, and how many samples it has written."""
        return f"ResultsWriter({self.task} to {self.path}: {counted(len(self._tokens), 'sample')})"

    def __enter__(self) -> ResultsWriter:
        """Begin beside the path; raises ResultsError if nothing can be written there."""
        self._check_free()
        with _naming_results(self.path), ExitStack() as stack:
            if self.task == "motion":
                folder = stack.enter_context(replacing_folder(self.path))
                self._body = ShardWriter(folder, self._header, **self._motion)
            else:
                self._body = EntryWriter(stack.enter_context(replacing(self.path)), self._header)
            stack.callback(self._body.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Move the results to their path, or after an exception remove what was written."""
        body, self._body = self._body, None
        if error_type is not None:
            self._stack.__exit__(error_type, error, trace)
            return
        with _naming_results(self.path), self._stack:
            if body is None:
                raise ResultsError(
                    "a prediction could not be written, so that none is kept; write all of them "
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
        | Iterable[Forecast],
    ) -> None:
        """Write the prediction of a sample.

        Args:
            token: Token of the sample, each once. It is not checked against the release:
                `check results --dataroot` does that.
            prediction: For motion a MotionOutput, all of one grid and number of frames; for
                accidents the expected ones, [] for none; for detection the boxes, in the world
                frame; for planning one or more Plans; for forecasting the Forecasts, one an actor.

        Raises:
            ResultsError: the prediction is of another kind, grid or frame, the sample was added
                before, or nothing can be written; the message begins with path and token.
        """
        body = self._opened()
        try:
            check_token(token)
            if token in self._tokens:
                raise ResultsError("was added before; give each sample one prediction")
            body.add(token, prediction)
        except (ContentError, ResultsError) as error:
            raise ResultsError(f"{self.path}: {token}: {error}") from error
        except OSError as error:
            self._body = None
            raise _write_error(self.path, error) from error
        self._tokens.add(token)

    def add_part(self, part: Results) -> None:
        """Write all predictions of results that a `ResultsWriter` of the same arguments wrote.

        The bytes are copied.

        Raises:
            ResultsError: nothing can be read or written.
        """
        body, self._body = self._opened(), None  # as `add` leaves it after an error of the system
        with _naming_results(self.path):
            body.add_part(part)
        self._body = body
        self._tokens.update(part.tokens)

    def _opened(self) -> EntryWriter | ShardWriter:
        """Return the open writer; raises ResultsError outside a `with` statement."""
        if self._body is None:
            raise ResultsError(
                f"{self.path}: is not open; add predictions inside `with ResultsWriter(…) as "
                "writer:`"
            )
        return self._body

    def _check_free(self) -> None:
        """Raise ResultsError if anything but an empty folder for motion exists at the path."""
        with _naming_results(self.path):
            is_empty = self.task == "motion" and self.path.is_dir() and not any(self.path.iterdir())
            if not is_empty and (self.path.exists() or self.path.is_symlink()):
                raise ResultsError(
                    f"{self.path}: is there already{self._existing_notes_text()}; choose another "
                    "path, or remove it"
                )

    def _existing_notes_text(self) -> str:
        """Return how the notes of existing results differ, in brackets; empty if there are none."""
        try:
            existing = read_results(self.path)
        except ResultsError:
            return ""
        old_meta, new_meta = existing.meta, self._header["meta"]
        old_method, new_method = old_meta.get("method"), new_meta.get("method")
        if old_method != new_method:  # all other notes differ with it
            old_text, new_text = shortened(repr(old_method)), shortened(repr(new_method))
            return f" (of method {old_text}, not of {new_text})"
        text = differing_text(_without_bytes(old_meta), _without_bytes(new_meta))
        return f" ({text or 'of other samples'})"


def _without_bytes(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Return notes without `bytes`, which follow from the other notes."""
    return {name: note for name, note in meta.items() if name != "bytes"}


@contextmanager
def _naming_results(path: Path) -> Iterator[None]:
    """Turn errors of the system into a ResultsError that names the results."""
    try:
        yield
    except ResultsError as error:
        text = str(error)
        raise ResultsError(text if text.startswith(str(path)) else f"{path}: {text}") from error
    except OSError as error:
        raise _write_error(path, error) from error


def _write_error(path: Path, error: OSError) -> ResultsError:
    return ResultsError(
        f"{path}: results cannot be written ({error}); make room there, or choose another path"
    )


class EntryWriter:
    """Writes the file of accident or detection results from its header to its last sample."""

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        """Begin a new file."""
        task = header["task"]
        self._make_entries, self._record_type = _ENTRIES[task], ENTRY_RECORDS[task]
        self._count = 0
        self._file = path.open("w", encoding="utf-8", newline="\n")
        for name, value in header.items():
            separator = "," if self._file.tell() else "{"
            self._file.write(f"{separator}\n{json.dumps(name)}: {json.dumps(value)}")
        self._file.write(_BODY_START)

    def add(self, token: str, prediction: object) -> None:
        """Write the entries of a sample.

        Raises ResultsError or ContentError, and then writes nothing of the sample.
        """
        entries = json.dumps(self._make_entries(token, prediction))
        read_entries(entries.encode(), self._record_type)
        separator = "," if self._count else ""
        self._file.write(f"{separator}\n{json.dumps(token)}: {entries}")
        self._count += 1

    def add_part(self, part: Results) -> None:
        """Copy the entries of a file that another writer of this class wrote."""
        text = read_bytes(part.path, "results").decode()
        body = text.partition(_BODY_START)[2].removesuffix(_BODY_END)
        separator = "," if self._count else ""
        self._file.write(f"{separator}{body}")
        self._count += len(part)

    def finish(self) -> None:
        """Write the end; raises ResultsError if nothing was added."""
        if not self._count:
            raise ResultsError("no prediction was added; results of no sample cannot be read")
        self._file.write(_BODY_END)
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
        raise ResultsError(
            "expected a list of Accidents, found a MotionOutput; write that to results of task "
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


def detection_entries(token: str, detected: DetectedBoxes) -> list[dict[str, Any]]:
    """Return a sample's boxes, which are in the world frame, as entries of a file."""
    boxes = detected.boxes
    columns = zip(
        boxes.center.tolist(),
        boxes.size[:, LENGTH_FIRST].tolist(),
        boxes.rotation.tolist(),
        boxes.velocity[:, :2].tolist(),
        boxes.category.tolist(),
        detected.scores.tolist(),
        strict=True,
    )
    return [
        {
            "sample_token": token,
            "translation": center,
            "size": size,
            "rotation": rotation,
            "velocity": velocity if all(map(math.isfinite, velocity)) else None,
            "detection_name": CATEGORIES[category],
            "detection_score": score,
        }
        for center, size, rotation, velocity, category, score in columns
    ]


def _plans(token: str, prediction: object) -> list[dict[str, Any]]:
    del token
    entries = []
    for plan in _checked_list(Plan, prediction):
        entry: dict[str, Any] = {
            "times": plan.times.tolist(),
            "path": plan.path.tolist(),
            "score": plan.score,
        }
        if plan.yaw is not None:
            entry["yaw"] = plan.yaw.tolist()
        entries.append(entry)
    return entries


def _forecasts(token: str, prediction: object) -> list[dict[str, Any]]:
    del token
    return [
        {
            "id": forecast.actor_id,
            "times": forecast.times.tolist(),
            "paths": forecast.paths.tolist(),
            "probabilities": forecast.probabilities.tolist(),
        }
        for forecast in _checked_list(Forecast, prediction)
    ]


def _checked_list(item_type: type[Kind], prediction: object) -> list[Kind]:
    """Return the items of a prediction; raises ResultsError if one is of another type."""
    items = list(prediction) if isinstance(prediction, Iterable) else [prediction]
    checked = []
    for item in items:
        if not isinstance(item, item_type):
            raise ResultsError(
                f"expected a list of {item_type.__name__}s, found {type(item).__name__} in it"
            )
        checked.append(item)
    return checked


# Task → function that makes the entries of a sample from its token and prediction.
_ENTRIES: Final[Mapping[str, Callable[[str, object], list[dict[str, Any]]]]] = {
    "accident": _accidents,
    "detection": _boxes,
    "planning": _plans,
    "forecasting": _forecasts,
}


class ShardWriter:
    """Writes the folder of motion results, the manifest last."""

    def __init__(
        self,
        folder: Path,
        header: Mapping[str, Any],
        *,
        grid: BevGrid | None,
        step: float,
        labels: str | None,
        store: Stored,
    ) -> None:
        """Create the folder of shards in an empty folder; other arguments as in ResultsWriter."""
        self._folder, self._header = folder, header
        self._grid, self._step, self._labels, self._store = grid, step, labels, store
        self._frames = self._predictions = 0
        self._shards: list[Shard] = []
        self._archive: zipfile.ZipFile | None = None
        self._in_shard: list[str] = []
        (folder / "shards").mkdir()

    def add(self, token: str, prediction: object) -> None:
        """Write the prediction of a sample; raises ResultsError, and then writes nothing of it."""
        output = self._checked(prediction)
        arrays = self._arrays(output)
        predictions, frames = next(iter(arrays.values())).shape[:2]
        if self._frames not in (0, frames):
            raise ResultsError(
                f"expected {self._frames} frames as of the samples before, found {frames}"
            )
        self._form(output.grid, predictions, frames)  # raises for an invalid form
        self._grid, self._frames = output.grid, frames
        self._predictions = max(self._predictions, predictions)
        if self._archive is None:
            self._archive = zipfile.ZipFile(self._folder / self._file, "w")
        for name, array in arrays.items():
            put_array(self._archive, MEMBER.format(token, name), array)
        self._in_shard.append(token)
        written_bytes = sum(entry.compress_size for entry in self._archive.infolist())
        if len(self._in_shard) >= _MAX_SHARD_SAMPLES or written_bytes >= MAX_SHARD_BYTES:
            self._end_shard()

    def add_part(self, part: Results) -> None:
        """Copy the shards of a folder that another writer of this class wrote.

        Its predictions are of the same grid and number of frames.
        """
        self._end_shard()
        contents: Any = contents_of(part.path / RESULTS_FILE)[0]
        self._grid, self._frames = contents.form.grid, contents.form.frames
        self._predictions = max(self._predictions, contents.form.predictions)
        for shard in contents.shards:
            target_path = self._folder / self._file
            with open_file(part.path / shard.file) as source, target_path.open("wb") as target:
                shutil.copyfileobj(source, target)
            self._shards.append(msgspec.structs.replace(shard, file=self._file))

    def finish(self) -> None:
        """Write the manifest; raises ResultsError if nothing was added."""
        self._end_shard()
        if self._grid is None or not self._shards:
            raise ResultsError("no prediction was added; results of no sample cannot be read")
        form = self._form(self._grid, self._predictions, self._frames)
        shards = msgspec.to_builtins(self._shards)
        manifest = {**self._header, "form": form.as_dict(), "shards": shards}
        text = f"{json.dumps(manifest, indent=1)}\n"
        (self._folder / RESULTS_FILE).write_bytes(text.encode())

    def close(self) -> None:
        """Close the archive that is being written, if any."""
        archive, self._archive = self._archive, None
        if archive is not None:
            archive.close()

    @property
    def _file(self) -> str:
        return f"shards/{len(self._shards):05d}.npz"

    def _form(self, grid: BevGrid, predictions: int, frames: int) -> MotionForm:
        return MotionForm(
            stored=self._store,
            grid=grid,
            predictions=predictions,
            frames=frames,
            step=self._step,
            labels=self._labels,
        )

    def _checked(self, prediction: object) -> MotionOutput:
        if not isinstance(prediction, MotionOutput):
            raise ResultsError(
                f"expected a MotionOutput, found {type(prediction).__name__}; make one with "
                "MotionOutput.from_arrays(…), or of instance maps with instances_of(…)"
            )
        if self._grid not in (None, prediction.grid):
            raise ResultsError(
                f"expected a prediction on {self._grid}, found one on {prediction.grid}; write "
                "others to other results"
            )
        return prediction

    def _arrays(self, output: MotionOutput) -> dict[str, AnyArray]:
        if output.instances is not None and output.instances.min() < 0:
            raise ResultsError(
                f"instances: expected ids from 1, and 0 elsewhere, found {output.instances.min()}"
            )
        if self._store == "instances":
            return instance_arrays(output)
        if output.heads is None:
            raise ResultsError(
                "expected heads, found instance maps; write those with store='instances'"
            )
        if any(heads.ignore_index is not None for heads in output.heads):
            raise ResultsError(
                "expected a model's heads, found those of labels, which hold values to ignore; "
                "write them with store='instances'"
            )
        return head_arrays(output)

    def _end_shard(self) -> None:
        if self._archive is None:
            return
        self.close()
        path = self._folder / self._file
        self._shards.append(
            Shard(
                file=self._file,
                tokens=tuple(self._in_shard),
                bytes=path.stat().st_size,
                checksum=file_checksum(path),
            )
        )
        self._in_shard = []


def head_arrays(output: MotionOutput) -> dict[str, AnyArray]:
    """Return the heads of a prediction, float32 arrays of shape (K, T, channels, H, W)."""
    heads = output.heads or ()
    return {name: np.stack([getattr(frame_heads, name) for frame_heads in heads]) for name in HEADS}


def instance_arrays(output: MotionOutput) -> dict[str, AnyArray]:
    """Return the instance maps of a prediction; heads are post-processed for them."""
    maps = output.instances
    if maps is None:
        predicted = [predict_instances(heads, "motion").instance for heads in output.heads or ()]
        maps = np.stack(predicted)
    max_id = int(maps.max(initial=0))
    if max_id < 2**8:
        return {"instance": maps.astype(np.uint8)}
    if max_id < 2**16:
        return {"instance": maps.astype(np.uint16)}
    return {"instance": maps.astype(np.int32)}


def put_array(archive: zipfile.ZipFile, member: str, array: AnyArray) -> None:
    """Add an array to an archive; the bytes do not depend on the time."""
    buffer = io.BytesIO()
    np.lib.format.write_array(
        buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False
    )
    entry = zipfile.ZipInfo(member, _ARCHIVE_DATE)
    entry.external_attr = 0o644 << 16
    # maps of floats are noise: deflating them takes a second and saves nothing
    is_noise = array.dtype.kind == "f" and array.ndim > 3
    compression = zipfile.ZIP_STORED if is_noise else zipfile.ZIP_DEFLATED
    archive.writestr(entry, buffer.getvalue(), compression, compresslevel=6)
