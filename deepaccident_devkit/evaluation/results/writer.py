"""`ResultsWriter`: writes predictions of many samples into a results file, completely or not at all."""

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

# What is before and after the entries in a file; no line ends in the notes.
_BODY, _END = ',\n"results": {', "\n}\n}\n"
_FIRST_DATE: Final = (1980, 1, 1, 0, 0, 0)
_MOST_SAMPLES: Final = 64
MOST_BYTES: Final = 32 * 2**20


class ResultsWriter:
    """Writes results that `read_results` reads; used in a `with` statement.

    The file, or for motion the folder, appears when the block ends well; after an exception there is nothing. Memory
    does not grow with the samples, and the same predictions give the same bytes.

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
            path: a file that is not there yet; for motion a folder that is not there, or empty.
            task: of `RESULTS_NAMES`.
            meta: what readers should know: method, training, author; as JSON holds it.
            grid: of motion, that of all predictions; None takes the first one's.
            step: of motion, seconds between two frames.
            labels: of motion, the label protocol (`motion.LABEL_PROTOCOLS`) that the model learned from, which it is
                compared with; None if it is not known.
            store: of motion, `instances` keeps instance maps, some 30 KB a sample of five predictions; heads are
                post-processed as the released evaluation of motion does (docs/released_code.md, Post-processing). The
                released accident evaluation does that in its own way, and from instance maps its numbers differ
                slightly. `heads` keeps the maps of the model as they are: 34 MB a sample of six predictions.

        Raises:
            ChoiceError: no such task.
            ResultsError: a value that cannot be written, or something stands at `path`.
        """
        self.task = choice("task", task, get_args(ResultsTask))
        self.path = path_of(path).absolute()
        try:
            told = json_meta({} if meta is None else meta)
        except ContentError as error:
            raise ResultsError(str(error)) from error
        self._header = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "task": self.task,
            "meta": told,
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
        """Its task and path, and how many samples it has written."""
        return f"ResultsWriter({self.task} to {self.path}: {counted(len(self._tokens), 'sample')})"

    def __enter__(self) -> ResultsWriter:
        """Begin beside the path; raises ResultsError if nothing can be written there."""
        self._check_free()
        with _told(self.path), ExitStack() as stack:
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
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Put the results in their place, or after an exception remove what was written."""
        body, self._body = self._body, None
        if kind is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with _told(self.path), self._stack:
            if body is None:
                raise ResultsError(
                    "a prediction could not be written, so that none is kept; write all of them again"
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
            token: of the sample; each one once. Whether the release has it is not known here: `check results
                --dataroot` tells.
            prediction: of motion a MotionOutput, all of one grid and number of frames; of accidents those that are
                foreseen, [] for none; of detection the boxes, in the world frame; of planning one or more Plans; of
                forecasting the Forecasts, one an actor.

        Raises:
            ResultsError: the prediction is of another kind, grid or frame, the sample was added before, or nothing can
                be written; the message begins with path and token.
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
            raise _unwritten(self.path, error) from error
        self._tokens.add(token)

    def add_part(self, part: Results) -> None:
        """Write all predictions of results that a `ResultsWriter` of the same arguments wrote, bytes as they are.

        Raises:
            ResultsError: nothing can be read or written.
        """
        body, self._body = self._opened(), None  # as `add` leaves it after an error of the system
        with _told(self.path):
            body.add_part(part)
        self._body = body
        self._tokens.update(part.tokens)

    def _opened(self) -> EntryWriter | ShardWriter:
        if self._body is None:
            raise ResultsError(
                f"{self.path}: is not open; add predictions inside `with ResultsWriter(…) as writer:`"
            )
        return self._body

    def _check_free(self) -> None:
        with _told(self.path):
            empty = self.task == "motion" and self.path.is_dir() and not any(self.path.iterdir())
            if not empty and (self.path.exists() or self.path.is_symlink()):
                raise ResultsError(
                    f"{self.path}: is there already{self._other()}; choose another path, or remove it"
                )

    def _other(self) -> str:
        """How the notes of results that are there differ, in brackets; empty where nothing is known."""
        try:
            there = read_results(self.path)
        except ResultsError:
            return ""
        asked = self._header["meta"]
        if there.meta.get("method") != asked.get("method"):  # all else differs with it
            there_is, wanted = (shortened(repr(meta.get("method"))) for meta in (there.meta, asked))
            return f" (of method {there_is}, not of {wanted})"
        notes = (
            {name: note for name, note in meta.items() if name != "bytes"}
            for meta in (there.meta, asked)
        )
        return f" ({differing_text(*notes) or 'of other samples'})"  # bytes follow from the rest


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Raise ResultsError that names the results for an error of the system."""
    try:
        yield
    except ResultsError as error:
        text = str(error)
        raise ResultsError(text if text.startswith(str(path)) else f"{path}: {text}") from error
    except OSError as error:
        raise _unwritten(path, error) from error


def _unwritten(path: Path, error: OSError) -> ResultsError:
    return ResultsError(
        f"{path}: results cannot be written ({error}); make room there, or choose another path"
    )


class EntryWriter:
    """Writes the file of accident or detection results from its header to its last sample."""

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        """Begin a new file."""
        self._entries, self._record = _ENTRIES[header["task"]], ENTRY_RECORDS[header["task"]]
        self._count = 0
        self._file = path.open("w", encoding="utf-8", newline="\n")
        for name, value in header.items():
            self._file.write(
                f"{',' if self._file.tell() else '{'}\n{json.dumps(name)}: {json.dumps(value)}"
            )
        self._file.write(_BODY)

    def add(self, token: str, prediction: object) -> None:
        """Write the entries of a sample; raises ResultsError or ContentError, and nothing of it is written then."""
        entries = json.dumps(self._entries(token, prediction))
        read_entries(entries.encode(), self._record)
        self._file.write(f"{',' if self._count else ''}\n{json.dumps(token)}: {entries}")
        self._count += 1

    def add_part(self, part: Results) -> None:
        """Write the entries of a file that another of this class wrote."""
        body = read_bytes(part.path, "results").decode().partition(_BODY)[2].removesuffix(_END)
        self._file.write(f"{',' if self._count else ''}{body}")
        self._count += len(part)

    def finish(self) -> None:
        """Write the end; raises ResultsError if nothing was added."""
        if not self._count:
            raise ResultsError("no prediction was added; results of no sample cannot be read")
        self._file.write(_END)
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
            "expected a list of Accidents, found a MotionOutput; write that to results of task 'motion'"
        )
    return [
        {
            "positions": each.positions.tolist(),
            "time": each.time,
            "score": each.score,
            "ids": None if each.ids is None else list(each.ids),
        }
        for each in accidents
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
            boxes.size[:, LENGTH_FIRST].tolist(),
            boxes.rotation.tolist(),
            boxes.velocity[:, :2].tolist(),
            boxes.category.tolist(),
            detected.scores.tolist(),
            strict=True,
        )
    ]


def _plans(token: str, prediction: object) -> list[dict[str, Any]]:
    del token
    return [
        {"times": each.times.tolist(), "path": each.path.tolist(), "score": each.score}
        | ({} if each.yaw is None else {"yaw": each.yaw.tolist()})
        for each in _all_of(Plan, prediction)
    ]


def _forecasts(token: str, prediction: object) -> list[dict[str, Any]]:
    del token
    return [
        {
            "id": each.actor_id,
            "times": each.times.tolist(),
            "paths": each.paths.tolist(),
            "probabilities": each.probabilities.tolist(),
        }
        for each in _all_of(Forecast, prediction)
    ]


def _all_of(kind: type[Kind], prediction: object) -> list[Kind]:
    given = list(prediction) if isinstance(prediction, Iterable) else [prediction]
    others = [each for each in given if not isinstance(each, kind)]
    if others:
        raise ResultsError(
            f"expected a list of {kind.__name__}s, found {type(others[0]).__name__} in it"
        )
    return [each for each in given if isinstance(each, kind)]


# Task → the entries of a sample as a file has them, of its token and prediction.
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
        """Write into an empty folder; the other arguments are those of ResultsWriter."""
        self._folder, self._header = folder, header
        self._grid, self._step, self._labels, self._store = grid, step, labels, store
        self._frames = self._predictions = 0
        self._shards: list[Shard] = []
        self._archive: zipfile.ZipFile | None = None
        self._in_shard: list[str] = []
        (folder / "shards").mkdir()

    def add(self, token: str, prediction: object) -> None:
        """Write the prediction of a sample; raises ResultsError, and nothing of it is written then."""
        output = self._checked(prediction)
        arrays = self._arrays(output)
        predictions, frames = next(iter(arrays.values())).shape[:2]
        if self._frames not in (0, frames):
            raise ResultsError(
                f"expected {self._frames} frames as of the samples before, found {frames}"
            )
        self._form(output.grid, predictions, frames)
        self._grid, self._frames = output.grid, frames
        self._predictions = max(self._predictions, predictions)
        if self._archive is None:
            self._archive = zipfile.ZipFile(self._folder / self._file, "w")
        for name, array in arrays.items():
            put_array(self._archive, MEMBER.format(token, name), array)
        self._in_shard.append(token)
        written = sum(entry.compress_size for entry in self._archive.infolist())
        if len(self._in_shard) >= _MOST_SAMPLES or written >= MOST_BYTES:
            self._end_shard()

    def add_part(self, part: Results) -> None:
        """Copy the shards of a folder that another of this class wrote, of the same grid and frames."""
        self._end_shard()
        contents: Any = contents_of(part.path / RESULTS_FILE)[0]
        self._grid, self._frames = contents.form.grid, contents.form.frames
        self._predictions = max(self._predictions, contents.form.predictions)
        for shard in contents.shards:
            with (
                open_file(part.path / shard.file) as source,
                (self._folder / self._file).open("wb") as target,
            ):
                shutil.copyfileobj(source, target)
            self._shards.append(msgspec.structs.replace(shard, file=self._file))

    def finish(self) -> None:
        """Write the manifest; raises ResultsError if nothing was added."""
        self._end_shard()
        if self._grid is None or not self._shards:
            raise ResultsError("no prediction was added; results of no sample cannot be read")
        told = {
            **self._header,
            "form": self._form(self._grid, self._predictions, self._frames).as_dict(),
            "shards": msgspec.to_builtins(self._shards),
        }
        (self._folder / RESULTS_FILE).write_bytes(f"{json.dumps(told, indent=1)}\n".encode())

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
                f"expected a prediction on {self._grid}, found one on {prediction.grid}; write others to other results"
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
                "expected a model's heads, found those of labels, which hold values to ignore; write them with "
                "store='instances'"
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
    """The heads of a prediction, each (K, T, channels, H, W) float32."""
    heads = output.heads or ()
    return {name: np.stack([getattr(each, name) for each in heads]) for name in HEADS}


def instance_arrays(output: MotionOutput) -> dict[str, AnyArray]:
    """The instance maps of a prediction; heads are post-processed for them."""
    maps = output.instances
    if maps is None:
        maps = np.stack([predict_instances(each, "motion").instance for each in output.heads or ()])
    highest = int(maps.max(initial=0))
    dtype = np.uint8 if highest < 2**8 else np.uint16 if highest < 2**16 else np.int32
    return {"instance": maps.astype(dtype)}


def put_array(archive: zipfile.ZipFile, member: str, array: AnyArray) -> None:
    """Add an array to an archive; the bytes do not depend on the time."""
    buffer = io.BytesIO()
    np.lib.format.write_array(
        buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False
    )
    entry = zipfile.ZipInfo(member, _FIRST_DATE)
    entry.external_attr = 0o644 << 16
    maps_of_floats = (
        array.dtype.kind == "f" and array.ndim > 3
    )  # noise: deflating takes a second and saves nothing
    way = zipfile.ZIP_STORED if maps_of_floats else zipfile.ZIP_DEFLATED
    archive.writestr(entry, buffer.getvalue(), way, compresslevel=6)
