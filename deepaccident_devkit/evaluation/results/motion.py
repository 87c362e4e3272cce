"""Motion results in a folder: how they are stored, the manifest of their shards, and the arrays in these.

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
    at,
    check_token,
    fault_of,
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

# Name of a sample's array in the archive, of its token and the array's name.
MEMBER: Final = "{}/{}.npy"
# Map → its channels.
HEADS: Final[Mapping[str, int]] = {"segmentation": 2, "centerness": 1, "offset": 2, "flow": 2}
# Arrays that earlier files have beside their maps, which say the same.
NOT_READ: Final = ("trajectory_id", "trajectory")
# Cells over all frames and predictions of a sample, twenty times as many as ten released predictions have. A small
# archive can hold more, but memory cannot.
_MOST_VALUES: Final = 2**26
# Bytes of a number.
_WIDEST: Final = 8
_LONGEST_HEADER: Final = 1 << 16
# How an array's member begins.
_NPY: Final = b"\x93NUMPY\x01\x00"
_KINDS: Final = {"u": "unsigned whole numbers", "i": "whole numbers", "f": "floats"}
_HIGHEST_ID: Final = 2**31 - 1
_OPEN_FILES: Final = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionForm:
    """How motion results are stored: the same for all samples of a file.

    Attributes:
        stored: `instances`: maps of ids; `heads`: the model's own maps.
        grid: the cells; its orientation is how the maps lie.
        predictions: how many a sample has at most, K; of several, the last one is the mean.
        frames: T, the present one first.
        step: seconds from one frame to the next, a whole number of recorded frames (0.1 s).
        labels: name of the label protocol (`motion.LABEL_PROTOCOLS`) that the model learned from; None if not known.
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
        settle_choices(
            self,
            {"stored": get_args(Stored), "labels": (*LABEL_PROTOCOLS, None)},
            error=ResultsError,
        )
        for name in ("predictions", "frames"):
            if type(value := getattr(self, name)) is not int or value < 1:
                raise ResultsError(f"{name}: expected a whole number from 1, found {value!r}")
        object.__setattr__(self, "step", checked_number("step", self.step, error=ResultsError))
        steps = self.step / FRAME_PERIOD
        if not (math.isfinite(steps) and steps > 0.5 and abs(steps - round(steps)) < 1e-6):
            raise ResultsError(
                f"step: expected seconds, a whole number of recorded frames of 0.1 s, found {self.step!r}"
            )
        if self.predictions * self.frames * self.grid.cells > _MOST_VALUES:
            raise ResultsError(
                f"form: {self.predictions} predictions of {self.frames} frames of {self.grid.cells} cells are more "
                "than memory holds; store fewer"
            )

    def as_dict(self) -> dict[str, Any]:
        """The form as JSON holds it."""
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
    def from_record(cls, told: FormRecord) -> MotionForm:
        """The form that JSON holds; raises ContentError that names the field."""
        try:
            grid = BevGrid(told.x, told.y, told.orientation)
            others = {
                name: getattr(told, name)
                for name in ("stored", "predictions", "frames", "step", "labels")
            }
            return cls(grid=grid, **others)
        except DeepAccidentError as error:
            raise ContentError(str(error)) from error


class MotionContents:
    """Motion, in the shards of a folder, as `reader.EntryContents` has other predictions."""

    task: ResultsTask = "motion"

    def __init__(self, path: Path, meta: Mapping[str, Any], document: MotionFile) -> None:
        """Check the manifest, and that its shards exist and have their sizes; raises ContentError."""
        self._path, self._root = path, path.parent
        self.meta = meta
        self.shards = document.shards
        with at("form"):
            self.form = MotionForm.from_record(document.form)
        self._shard_of = _shards_of(document.shards, path.parent)
        self.tokens: Collection[str] = self._shard_of.keys()

    def prediction(self, token: str) -> MotionOutput:
        """The prediction of a sample; raises ResultsError."""
        shard, within = self._shard_of[token], ""
        try:
            archive = shared_archive(self._root, shard, os.getpid())
            within = token
            return stored_output(archive, token, self.form)
        except (ContentError, OSError) as error:
            raise fault_of(self._path, error, shard.file, within) from error

    def check(self, **how: Any) -> None:
        """Read every array, as `run_batch` is told; raises ResultsError that names shard, token and array."""
        check = partial(check_shard, self._root, self.form)
        run_batch(check, self.shards, label="shards", places=Places(reads=(self._root,)), **how)


def _shards_of(shards: Sequence[Shard], root: Path) -> dict[str, Shard]:
    """Token → its shard, in the order of the shards; raises ContentError that names the field, or the shard."""
    shard_of: dict[str, Shard] = {}
    files: set[str] = set()
    for number, shard in enumerate(shards):
        with at(f"shards[{number}]"):
            _check_file(shard, root, files)
        files.add(shard.file)
        for token in shard.tokens:
            with at(f"shards[{number}].tokens"):
                check_token(token)
            if token in shard_of:
                others = "twice" if shard_of[token] is shard else f"also in {shard_of[token].file}"
                raise ContentError(
                    f"{shard.file}: {token}: stands there {others}; store a sample once"
                )
            shard_of[token] = shard
    return shard_of


def _check_file(shard: Shard, root: Path, others: AbstractSet[str]) -> None:
    """Whether a shard's file is there, as long as it should be, in the folder, and not another shard's too."""
    if (
        not shard.file.isprintable()
        or "\\" in shard.file
        or not _is_inside(PurePosixPath(shard.file))
    ):
        raise ContentError(
            f"file: expected a path inside the folder of the results, found {shortened(shard.file)!r}"
        )
    path = root / shard.file
    if shard.file in others:
        raise ContentError(f"file: {shard.file} is another entry's too; list each file once")
    try:
        status = path.stat()
        inside = path.resolve().is_relative_to(root.resolve())
    except OSError as error:
        raise ContentError(
            f"file: {shard.file} cannot be opened ({error.strerror}); copy it to its place"
        ) from error
    if not inside:
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


@lru_cache(maxsize=_OPEN_FILES)
def shared_archive(root: Path, shard: Shard, _process: int) -> zipfile.ZipFile:
    """A shard's archive, one of the last few, which stay open; raises ContentError.

    Threads may share it, so the garbage collector closes it. A fork shares positions in open files with its parent, and
    so must name its own process.
    """
    return opened(root, shard)


def opened(root: Path, shard: Shard) -> zipfile.ZipFile:
    """A shard's archive; raises ContentError."""
    try:
        return open_zip(root / shard.file)
    except DAMAGED_ARCHIVE as error:
        raise ContentError(
            f"is no npz archive that can be read ({error}); copy it again"
        ) from error


def check_shard(root: Path, form: MotionForm, shard: Shard) -> None:
    """Read all of a shard of the results in a folder; raises ResultsError that names shard, token and array."""
    path, within = root / shard.file, ""
    try:
        if path.stat().st_size != shard.bytes or file_checksum(path) != shard.checksum:
            raise ContentError(
                "its bytes are not those that the checksum is of; copy it again from where it was made"
            )
        with opened(root, shard) as archive:
            _check_members(archive, shard, form)
            for within in shard.tokens:
                stored_output(archive, within, form)
    except (ContentError, OSError) as error:
        raise fault_of(root / RESULTS_FILE, error, shard.file, within) from error


def _check_members(archive: zipfile.ZipFile, shard: Shard, form: MotionForm) -> None:
    tokens, arrays = set(shard.tokens), set(map("{}.npy".format, (*members(form), *NOT_READ)))
    for name, times in Counter(archive.namelist()).items():
        token, _, array = name.rpartition("/")
        if token not in tokens or array not in arrays:
            raise ContentError(
                f"{name}: belongs to no sample of the shard; store the arrays of its tokens alone"
            )
        if times > 1:
            raise ContentError(f"{name}: stands there {times} times; store each array once")


def members(form: MotionForm) -> dict[str, tuple[tuple[int, ...], str]]:
    """Array of each sample → its shape, whose first axis may be shorter, and numpy's letters of its kinds."""
    maps, cells = (form.predictions, form.frames), form.grid.shape
    if form.stored == "instances":
        return {"instance": ((*maps, *cells), "ui")}
    return {name: ((*maps, channels, *cells), "f") for name, channels in HEADS.items()}


def stored_output(archive: zipfile.ZipFile, token: str, form: MotionForm) -> MotionOutput:
    """The prediction of a sample; raises ContentError that begins with the array's name."""
    arrays: dict[str, AnyArray] = {}
    name = ""
    try:
        for name, (shape, kinds) in members(form).items():
            arrays[name] = take_array(archive, MEMBER.format(token, name), shape, kinds)
    except ContentError as error:
        raise ContentError(f"{name}: {error}") from error
    if form.stored == "instances":
        maps = arrays["instance"]
        if maps.min() < 0 or maps.max() > _HIGHEST_ID:
            raise ContentError(
                f"instance: expected ids from 0 to {_HIGHEST_ID}, found {maps.min()} to {maps.max()}"
            )
        return MotionOutput(grid=form.grid, instances=maps.astype(np.int32))
    try:
        return MotionOutput.from_arrays(*arrays.values(), grid=form.grid)
    except GeometryError as error:
        raise ContentError(str(error)) from error


def take_array(archive: zipfile.ZipFile, member: str, shape: Sequence[int], kinds: str) -> AnyArray:
    """An array of an archive, as long as the shape or shorter, else it is not decompressed; raises ContentError."""
    try:
        entry = archive.getinfo(member)
    except KeyError:
        raise ContentError(f"is missing; expected the member {member}") from None
    expected = f"expected shape (1 to {shape[0]}, {', '.join(map(str, shape[1:]))})"
    most = math.prod(shape) * _WIDEST + _LONGEST_HEADER
    if entry.file_size > most:
        raise ContentError(
            f"{expected}, which has at most {most:,} bytes, found {entry.file_size:,} bytes"
        )
    try:
        content = read_member(archive, entry, "results")
        array = array_of(content, "results")
    except DAMAGED_ARCHIVE as error:
        raise ContentError(
            f"cannot be read ({error}); the file is damaged, copy it again"
        ) from error
    if not content.startswith(_NPY):
        raise ContentError("expected npy format 1.0, as numpy.save writes numbers")
    if array.dtype.kind not in kinds:
        raise ContentError(
            f"expected {' or '.join(_KINDS[kind] for kind in kinds)}, found {array.dtype}"
        )
    if (
        array.ndim != len(shape)
        or not 1 <= len(array) <= shape[0]
        or array.shape[1:] != tuple(shape[1:])
    ):
        raise ContentError(f"{expected}, found {array.shape}")
    return array
