"""Motion results in a folder: their format, the manifest of their shards, and the shards' arrays.

Arrays are never unpickled, and arrays that are larger than expected are never read.
"""

from __future__ import annotations

import math
import os
import zipfile
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath
from typing import Any, Final, get_args

import numpy as np

from deepaccident_devkit.errors import DeepAccidentError, GeometryError, ResultsError, shortened
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results.records import (
    RESULTS_FILE,
    ContentError,
    FormRecord,
    MotionFile,
    ResultsTask,
    Shard,
    Stored,
    check_token,
    fault_of,
    locate_errors,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS
from deepaccident_devkit.support.arrays import AnyArray, checked_number
from deepaccident_devkit.support.parallel import Places, run_batch
from deepaccident_devkit.support.reading import (
    DAMAGED_ARCHIVE,
    array_of,
    check_size,
    file_checksum,
    irregular_text,
    open_zip,
    read_member,
)
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Template of an array's path in the archive, from the sample token and the name of the array.
MEMBER: Final = "{}/{}.npy"
# Name of a head → its number of channels.
HEADS: Final[Mapping[str, int]] = {"segmentation": 2, "centerness": 1, "offset": 2, "flow": 2}
# Arrays that older files contain, too; they only repeat what the maps say.
NOT_READ: Final = ("trajectory_id", "trajectory")
# Largest number of cells of a sample, summed over frames and predictions: twenty times the number
# in ten released predictions. A small archive can hold more, but memory cannot.
_MAX_CELLS = 2**26
# Largest sizes of a single number, and of the header of an array, in bytes.
_MAX_NUMBER_BYTES = 8
_MAX_HEADER_BYTES = 1 << 16
# First bytes of an array file.
_NPY_MAGIC = b"\x93NUMPY\x01\x00"
_KIND_NAMES = {"u": "unsigned whole numbers", "i": "whole numbers", "f": "floats"}
_MAX_ID = 2**31 - 1
_MAX_OPEN_FILES = 8
# A step may differ from a whole number of frames by this fraction of a frame.
_FRAME_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionForm:
    """Layout of stored motion results, which all samples of a file share.

    Attributes:
        stored: `instances` for maps of ids, `heads` for the outputs of the model.
        grid: BEV grid and orientation of the maps.
        predictions: Largest number K of predictions per sample; if there are several, the last one
            is the mean.
        frames: Number T of frames; the current frame is the first.
        step: Seconds between frames, a whole number of recorded frames (0.1 s).
        labels: Name of the label protocol (`motion.LABEL_PROTOCOLS`) that the model was trained on;
            None if unknown.
    """

    stored: Stored
    grid: BevGrid
    predictions: int
    frames: int
    step: float = 0.5
    labels: str | None = None

    def __post_init__(self) -> None:
        """Check the fields; raise a ResultsError that names the first invalid one."""
        if not isinstance(self.grid, BevGrid):
            raise ResultsError(f"grid: expected a BevGrid, found {type(self.grid).__name__}")
        allowed = {"stored": get_args(Stored), "labels": (*LABEL_PROTOCOLS, None)}
        settle_choices(self, allowed, error=ResultsError)
        for name in ("predictions", "frames"):
            value = getattr(self, name)
            if type(value) is not int or value < 1:
                raise ResultsError(f"{name}: expected a whole number from 1, found {value!r}")
        object.__setattr__(self, "step", checked_number("step", self.step, error=ResultsError))
        self._check_step()
        if self.predictions * self.frames * self.grid.cells > _MAX_CELLS:
            raise ResultsError(
                f"form: {self.predictions} predictions of {self.frames} frames of "
                f"{self.grid.cells} cells do not fit into memory; store fewer"
            )

    def _check_step(self) -> None:
        """Raise ResultsError unless the step is a whole number of recorded frames."""
        frames = self.step / FRAME_PERIOD
        is_positive = math.isfinite(frames) and frames > 0.5
        if not (is_positive and abs(frames - round(frames)) < _FRAME_TOLERANCE):
            raise ResultsError(
                "step: expected seconds that are a multiple of 0.1 s (one frame), found "
                f"{self.step!r}"
            )

    def as_dict(self) -> dict[str, Any]:
        """Convert the form to JSON-compatible values."""
        return {
            "stored": self.stored,
            "x": list(self.grid.x),
            "y": list(self.grid.y),
            "orientation": self.grid.orientation,
            "predictions": self.predictions,
            "frames": self.frames,
            "step": self.step,
            "labels": self.labels,
        }

    @classmethod
    def from_record(cls, record: FormRecord) -> MotionForm:
        """Build the form from a record; raise a ContentError that names the first invalid field."""
        try:
            return cls(
                grid=BevGrid(record.x, record.y, record.orientation),
                stored=record.stored,
                predictions=record.predictions,
                frames=record.frames,
                step=record.step,
                labels=record.labels,
            )
        except DeepAccidentError as error:
            raise ContentError(str(error)) from error


class MotionContents:
    """Motion results in the shards of a folder; `reader.EntryContents` holds all other results."""

    task: ResultsTask = "motion"

    def __init__(self, path: Path, meta: ReadOnlyValues, document: MotionFile) -> None:
        """Check the manifest; raise ContentError if a shard is missing or has the wrong size."""
        self._path = path
        self._root = path.parent
        self.meta = meta
        self.shards = document.shards
        with locate_errors("form"):
            self.form = MotionForm.from_record(document.form)
        self._shard_by_token = _map_shards(document.shards, path.parent)
        self.tokens: Collection[str] = self._shard_by_token.keys()

    def prediction(self, token: str) -> MotionOutput:
        """Read the prediction of a sample; raise ResultsError if it is missing or damaged."""
        shard = self._shard_by_token[token]
        failed_token = ""
        try:
            archive = shared_archive(self._root, shard, os.getpid())
            failed_token = token
            return read_output(archive, token, self.form)
        except (ContentError, OSError) as error:
            raise fault_of(self._path, error, shard.file, failed_token) from error

    def check(self, **engine: Any) -> None:
        """Read every array; raise a ResultsError with shard, token and array if one is invalid.

        Args:
            **engine: Arguments of `run_batch`.
        """
        check = partial(check_shard, self._root, self.form)
        places = Places(reads=(self._root,))
        run_batch(check, self.shards, label="Checking shards", places=places, **engine)


def _map_shards(shards: Sequence[Shard], root: Path) -> dict[str, Shard]:
    """Map each token to its shard, in the order of the shards.

    Raise a ContentError that names the field or the shard if a shard is invalid or lists a token
    that occurs twice.
    """
    shard_by_token: dict[str, Shard] = {}
    seen_files: set[str] = set()
    for number, shard in enumerate(shards):
        with locate_errors(f"shards[{number}]"):
            _check_file(shard, root, seen_files)
        seen_files.add(shard.file)
        for token in shard.tokens:
            with locate_errors(f"shards[{number}].tokens"):
                check_token(token)
            if token in shard_by_token:
                earlier_shard = shard_by_token[token]
                repetition = f"also appears in {earlier_shard.file}"
                if earlier_shard is shard:
                    repetition = "appears twice"
                raise ContentError(f"{shard.file}: {token}: {repetition}; store a sample once")
            shard_by_token[token] = shard
    return shard_by_token


def _check_file(shard: Shard, root: Path, other_files: AbstractSet[str]) -> None:
    """Raise ContentError unless a shard's file is in the folder, complete, and listed once."""
    is_printable = shard.file.isprintable() and "\\" not in shard.file
    if not is_printable or not _is_inside(PurePosixPath(shard.file)):
        raise ContentError(
            "file: expected a path inside the folder of the results, found "
            f"{shortened(shard.file)!r}"
        )
    path = root / shard.file
    if shard.file in other_files:
        raise ContentError(f"file: {shard.file} is listed twice; list each file once")
    try:
        status = path.stat()
        is_in_folder = path.resolve().is_relative_to(root.resolve())
    except OSError as error:
        raise ContentError(
            f"file: {shard.file} cannot be opened ({error.strerror}); copy it to this path"
        ) from error
    if not is_in_folder:
        raise ContentError(
            f"file: {shard.file} is a link to a file outside the folder; replace the link "
            "with the file itself"
        )
    irregular = irregular_text(status.st_mode)
    if irregular:
        raise ContentError(f"file: {shard.file} is {irregular}")
    check_size(status.st_size, "results", shard.file)
    if status.st_size != shard.bytes:
        raise ContentError(
            f"bytes: {shard.file} should have {shard.bytes}, found {status.st_size}; copy it again"
        )


def _is_inside(path: PurePosixPath) -> bool:
    """Return whether a relative path stays inside the folder that it starts from."""
    if path.is_absolute() or not path.parts:
        return False
    return ".." not in path.parts


@lru_cache(maxsize=_MAX_OPEN_FILES)
def shared_archive(root: Path, shard: Shard, _process: int) -> zipfile.ZipFile:
    """Return a shard's open archive; the most recently used archives stay open.

    Raise ContentError if the archive cannot be read. Threads may share an archive, so the garbage
    collector closes it. A forked process shares file positions with its parent, so it must pass its
    own process id.
    """
    return open_archive(root, shard)


def open_archive(root: Path, shard: Shard) -> zipfile.ZipFile:
    """Open a shard's archive; raise ContentError if it cannot be read."""
    try:
        return open_zip(root / shard.file)
    except DAMAGED_ARCHIVE as error:
        raise ContentError(f"is not a readable npz archive ({error}); copy it again") from error


def check_shard(root: Path, form: MotionForm, shard: Shard) -> None:
    """Read a shard completely; raise a ResultsError with shard, token and array if it is invalid.

    Args:
        root: Folder of the results.
        form: Layout of the results.
        shard: Entry of the manifest.
    """
    path = root / shard.file
    token = ""
    try:
        if path.stat().st_size != shard.bytes or file_checksum(path) != shard.checksum:
            raise ContentError(
                "its content does not match its checksum; copy it again from where it was made"
            )
        with open_archive(root, shard) as archive:
            _check_members(archive, shard, form)
            for token in shard.tokens:
                read_output(archive, token, form)
    except (ContentError, OSError) as error:
        raise fault_of(root / RESULTS_FILE, error, shard.file, token) from error


def _check_members(archive: zipfile.ZipFile, shard: Shard, form: MotionForm) -> None:
    """Raise ContentError if an archive has unknown or repeated members."""
    tokens = set(shard.tokens)
    file_names = {f"{name}.npy" for name in (*array_layout(form), *NOT_READ)}
    for member, count in Counter(archive.namelist()).items():
        token, _, file_name = member.rpartition("/")
        if token not in tokens or file_name not in file_names:
            raise ContentError(
                f"{member}: belongs to no sample of the shard; store only arrays of its tokens"
            )
        if count > 1:
            raise ContentError(f"{member}: appears {count} times; store each array once")


def array_layout(form: MotionForm) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the expected shapes and dtype kinds of a sample's arrays.

    Returns:
        Name of an array → its shape, whose first axis may be shorter, and the letters of the numpy
        dtype kinds that it may have.
    """
    map_counts = (form.predictions, form.frames)
    if form.stored == "instances":
        return {"instance": ((*map_counts, *form.grid.shape), "ui")}
    layout: dict[str, tuple[tuple[int, ...], str]] = {}
    for name, channels in HEADS.items():
        layout[name] = ((*map_counts, channels, *form.grid.shape), "f")
    return layout


def read_output(archive: zipfile.ZipFile, token: str, form: MotionForm) -> MotionOutput:
    """Read the prediction of a sample; raise a ContentError that names the first invalid array."""
    arrays: dict[str, AnyArray] = {}
    name = ""
    try:
        for name, (shape, kinds) in array_layout(form).items():
            arrays[name] = read_checked_array(archive, MEMBER.format(token, name), shape, kinds)
    except ContentError as error:
        raise ContentError(f"{name}: {error}") from error
    if form.stored == "instances":
        maps = arrays["instance"]
        if maps.min() < 0 or maps.max() > _MAX_ID:
            raise ContentError(
                f"instance: expected ids from 0 to {_MAX_ID}, found {maps.min()} to {maps.max()}"
            )
        return MotionOutput(grid=form.grid, instances=maps.astype(np.int32))
    try:
        return MotionOutput.from_arrays(*arrays.values(), grid=form.grid)
    except GeometryError as error:
        raise ContentError(str(error)) from error


def read_checked_array(
    archive: zipfile.ZipFile, member: str, shape: Sequence[int], kinds: str
) -> AnyArray:
    """Read an array from an archive; raise ContentError if it is not as expected.

    An array with more bytes than expected is not decompressed.

    Args:
        archive: Open archive.
        member: Path of the array in the archive.
        shape: Expected shape; the first axis may be shorter.
        kinds: Letters of the accepted numpy dtype kinds.
    """
    try:
        entry = archive.getinfo(member)
    except KeyError:
        raise ContentError(f"is missing; expected the member {member}") from None
    max_length, *other_lengths = shape
    expected = f"expected shape (1 to {max_length}, {', '.join(map(str, other_lengths))})"
    max_bytes = math.prod(shape) * _MAX_NUMBER_BYTES + _MAX_HEADER_BYTES
    if entry.file_size > max_bytes:
        raise ContentError(
            f"{expected}, which has at most {max_bytes:,} bytes, found {entry.file_size:,} bytes"
        )
    try:
        content = read_member(archive, entry, "results")
        array = array_of(content, "results")
    except DAMAGED_ARCHIVE as error:
        raise ContentError(
            f"cannot be read ({error}); the file is damaged, copy it again"
        ) from error
    if not content.startswith(_NPY_MAGIC):
        raise ContentError("expected npy format 1.0, as numpy.save writes numbers")
    if array.dtype.kind not in kinds:
        expected_kinds = " or ".join(_KIND_NAMES[kind] for kind in kinds)
        raise ContentError(f"expected {expected_kinds}, found {array.dtype}")
    has_shape = array.ndim == len(shape) and [*array.shape[1:]] == other_lengths
    if not has_shape or not 1 <= len(array) <= max_length:
        raise ContentError(f"{expected}, found {array.shape}")
    return array
