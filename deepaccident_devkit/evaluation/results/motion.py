"""Motion results in a folder: their form, the manifest of their shards, and the shards' arrays.

Arrays are never unpickled, and never larger than expected.
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
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Path of an array in the archive, for a sample's token and the array's name.
MEMBER: Final = "{}/{}.npy"
# Map → number of its channels.
HEADS: Final[Mapping[str, int]] = {"segmentation": 2, "centerness": 1, "offset": 2, "flow": 2}
# Arrays that earlier files have beside their maps, with the same content.
NOT_READ: Final = ("trajectory_id", "trajectory")
# Number of cells over all frames and predictions of a sample, twenty times that of ten released
# predictions. A small archive can hold more, but memory cannot.
_MAX_CELLS: Final = 2**26
# Bytes of a number, and of the header of an array.
_MAX_NUMBER_BYTES: Final = 8
_MAX_HEADER_BYTES: Final = 1 << 16
# First bytes of an array's file.
_NPY_MAGIC: Final = b"\x93NUMPY\x01\x00"
_KIND_NAMES: Final = {"u": "unsigned whole numbers", "i": "whole numbers", "f": "floats"}
_MAX_ID: Final = 2**31 - 1
_MAX_OPEN_FILES: Final = 8
# Tolerance of a step in frames.
_FRAME_TOLERANCE: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionForm:
    """How motion results are stored: the same for all samples of a file.

    Attributes:
        stored: `instances`: maps of ids; `heads`: the model's own maps.
        grid: BEV grid of the maps, with their orientation.
        predictions: Largest number K of predictions of a sample; of several, the last one is the
            mean.
        frames: Number T of frames, the present one first.
        step: Seconds between frames, a whole number of recorded frames (0.1 s).
        labels: Name of the label protocol (`motion.LABEL_PROTOCOLS`) that the model learned from;
            None if not known.
    """

    stored: Stored
    grid: BevGrid
    predictions: int
    frames: int
    step: float = 0.5
    labels: str | None = None

    def __post_init__(self) -> None:
        """Check the values; raises ResultsError that names the field."""
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
                f"{self.grid.cells} cells are more than memory holds; store fewer"
            )

    def _check_step(self) -> None:
        """Raise ResultsError unless the step is a whole number of recorded frames."""
        frames = self.step / FRAME_PERIOD
        is_positive = math.isfinite(frames) and frames > 0.5
        if not (is_positive and abs(frames - round(frames)) < _FRAME_TOLERANCE):
            raise ResultsError(
                "step: expected seconds, a whole number of recorded frames of 0.1 s, found "
                f"{self.step!r}"
            )

    def as_dict(self) -> dict[str, Any]:
        """Return the form as JSON."""
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
        """Return the form of a JSON record; raises ContentError that names the field."""
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
    """Motion in the shards of a folder; the counterpart of `reader.EntryContents`."""

    task: ResultsTask = "motion"

    def __init__(self, path: Path, meta: Mapping[str, Any], document: MotionFile) -> None:
        """Check the manifest, and the existence and size of its shards; raises ContentError."""
        self._path, self._root = path, path.parent
        self.meta = meta
        self.shards = document.shards
        with locate_errors("form"):
            self.form = MotionForm.from_record(document.form)
        self._shard_of = _shards_of(document.shards, path.parent)
        self.tokens: Collection[str] = self._shard_of.keys()

    def prediction(self, token: str) -> MotionOutput:
        """Return the prediction of a sample; raises ResultsError."""
        shard = self._shard_of[token]
        failed_token = ""
        try:
            archive = shared_archive(self._root, shard, os.getpid())
            failed_token = token
            return read_output(archive, token, self.form)
        except (ContentError, OSError) as error:
            raise fault_of(self._path, error, shard.file, failed_token) from error

    def check(self, **engine: Any) -> None:
        """Read every array; raises ResultsError that names shard, token and array.

        Args:
            **engine: Arguments of `run_batch`.
        """
        check = partial(check_shard, self._root, self.form)
        run_batch(check, self.shards, label="shards", places=Places(reads=(self._root,)), **engine)


def _shards_of(shards: Sequence[Shard], root: Path) -> dict[str, Shard]:
    """Return token → its shard, in the order of the shards.

    Raises ContentError that names the field, or the shard.
    """
    shard_of: dict[str, Shard] = {}
    files: set[str] = set()
    for number, shard in enumerate(shards):
        with locate_errors(f"shards[{number}]"):
            _check_file(shard, root, files)
        files.add(shard.file)
        for token in shard.tokens:
            with locate_errors(f"shards[{number}].tokens"):
                check_token(token)
            if token in shard_of:
                owner = shard_of[token]
                repetition = "twice" if owner is shard else f"also in {owner.file}"
                raise ContentError(
                    f"{shard.file}: {token}: stands there {repetition}; store a sample once"
                )
            shard_of[token] = shard
    return shard_of


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
        raise ContentError(f"file: {shard.file} is another entry's too; list each file once")
    try:
        status = path.stat()
        is_in_folder = path.resolve().is_relative_to(root.resolve())
    except OSError as error:
        raise ContentError(
            f"file: {shard.file} cannot be opened ({error.strerror}); copy it to its place"
        ) from error
    if not is_in_folder:
        raise ContentError(
            f"file: {shard.file} is a link that leads out of the folder; put the file itself there"
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
    return not path.is_absolute() and path.parts != () and ".." not in path.parts


@lru_cache(maxsize=_MAX_OPEN_FILES)
def shared_archive(root: Path, shard: Shard, _process: int) -> zipfile.ZipFile:
    """Return a shard's archive; the most recent archives stay open. Raises ContentError.

    Threads may share it, so the garbage collector closes it. A fork shares positions in open files
    with its parent, and so must pass its own process id.
    """
    return open_archive(root, shard)


def open_archive(root: Path, shard: Shard) -> zipfile.ZipFile:
    """Open a shard's archive; raises ContentError."""
    try:
        return open_zip(root / shard.file)
    except DAMAGED_ARCHIVE as error:
        raise ContentError(
            f"is no npz archive that can be read ({error}); copy it again"
        ) from error


def check_shard(root: Path, form: MotionForm, shard: Shard) -> None:
    """Read a shard of the results in a folder; raises ResultsError with shard, token and array."""
    path = root / shard.file
    token = ""
    try:
        if path.stat().st_size != shard.bytes or file_checksum(path) != shard.checksum:
            raise ContentError(
                "its bytes are not those that the checksum is of; copy it again from where it was "
                "made"
            )
        with open_archive(root, shard) as archive:
            _check_members(archive, shard, form)
            for token in shard.tokens:
                read_output(archive, token, form)
    except (ContentError, OSError) as error:
        raise fault_of(root / RESULTS_FILE, error, shard.file, token) from error


def _check_members(archive: zipfile.ZipFile, shard: Shard, form: MotionForm) -> None:
    """Raise ContentError if an archive has foreign or repeated members."""
    tokens = set(shard.tokens)
    arrays = {f"{name}.npy" for name in (*array_layout(form), *NOT_READ)}
    for name, count in Counter(archive.namelist()).items():
        token, _, array = name.rpartition("/")
        if token not in tokens or array not in arrays:
            raise ContentError(
                f"{name}: belongs to no sample of the shard; store the arrays of its tokens alone"
            )
        if count > 1:
            raise ContentError(f"{name}: stands there {count} times; store each array once")


def array_layout(form: MotionForm) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return array of each sample → its shape and numpy's letters of its kinds.

    The first axis may be shorter.
    """
    maps, cells = (form.predictions, form.frames), form.grid.shape
    if form.stored == "instances":
        return {"instance": ((*maps, *cells), "ui")}
    return {name: ((*maps, channels, *cells), "f") for name, channels in HEADS.items()}


def read_output(archive: zipfile.ZipFile, token: str, form: MotionForm) -> MotionOutput:
    """Return the prediction of a sample; raises ContentError that begins with the array's name."""
    arrays: dict[str, AnyArray] = {}
    name = ""
    try:
        for name, (shape, kinds) in array_layout(form).items():
            arrays[name] = read_array(archive, MEMBER.format(token, name), shape, kinds)
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


def read_array(archive: zipfile.ZipFile, member: str, shape: Sequence[int], kinds: str) -> AnyArray:
    """Return an array of an archive, as long as the shape or shorter; raises ContentError.

    An array that takes more bytes is not decompressed.

    Args:
        archive: The archive.
        member: Path in the archive.
        shape: Expected shape.
        kinds: numpy's letters of the expected kinds.
    """
    try:
        entry = archive.getinfo(member)
    except KeyError:
        raise ContentError(f"is missing; expected the member {member}") from None
    expected = f"expected shape (1 to {shape[0]}, {', '.join(map(str, shape[1:]))})"
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
        raise ContentError(
            f"expected {' or '.join(_KIND_NAMES[kind] for kind in kinds)}, found {array.dtype}"
        )
    has_shape = array.ndim == len(shape) and array.shape[1:] == tuple(shape[1:])
    if not has_shape or not 1 <= len(array) <= shape[0]:
        raise ContentError(f"{expected}, found {array.shape}")
    return array
