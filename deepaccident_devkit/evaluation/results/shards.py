"""Results in a folder: the manifest of their shards, and the shards' arrays.

Arrays are never unpickled, and arrays that are larger than expected are never read.
"""

from __future__ import annotations

import math
import os
import zipfile
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath
from typing import Any, Final

from deepaccident_devkit.errors import shortened
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results.forms import ArrayLayout
from deepaccident_devkit.evaluation.results.motion import MotionForm
from deepaccident_devkit.evaluation.results.records import (
    MEMBER,
    RESULTS_FILE,
    ContentError,
    MotionFile,
    ResultsTask,
    SegmentationFile,
    Shard,
    check_token,
    fault_of,
    locate_errors,
)
from deepaccident_devkit.evaluation.results.segmentation import SegmentationForm
from deepaccident_devkit.evaluation.segmentation import SegmentationOutput
from deepaccident_devkit.support.arrays import AnyArray
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

Form = MotionForm | SegmentationForm
# Task → class of the form of its results.
_FORMS: Mapping[str, Any] = {"motion": MotionForm, "segmentation": SegmentationForm}
# Arrays that older files of motion contain, too; they only repeat what the maps say.
NOT_READ: Final = ("trajectory_id", "trajectory")
# Largest sizes of a single number, and of the header of an array, in bytes.
_MAX_NUMBER_BYTES = 8
_MAX_HEADER_BYTES = 1 << 16
# First bytes of an array file.
_NPY_MAGIC = b"\x93NUMPY\x01\x00"
_KIND_NAMES = {
    "b": "true and false",
    "u": "unsigned whole numbers",
    "i": "whole numbers",
    "f": "floats",
}
_MAX_OPEN_FILES = 8


class ShardContents:
    """Results in the shards of a folder; `reader.EntryContents` holds all other results."""

    def __init__(
        self, path: Path, meta: Mapping[str, Any], document: MotionFile | SegmentationFile
    ) -> None:
        """Check the manifest; raise ContentError if a shard is missing or has the wrong size."""
        self._path = path
        self._root = path.parent
        self.task: ResultsTask = document.task
        self.meta = meta
        self.shards = document.shards
        with locate_errors("form"):
            self.form: Form = _FORMS[document.task].from_record(document.form)
        self._shard_by_token = _map_shards(document.shards, path.parent)
        self.tokens: Collection[str] = self._shard_by_token.keys()

    def prediction(self, token: str) -> MotionOutput | SegmentationOutput:
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


def check_shard(root: Path, form: Form, shard: Shard) -> None:
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


def _check_members(archive: zipfile.ZipFile, shard: Shard, form: Form) -> None:
    """Raise ContentError if an archive has unknown or repeated members."""
    tokens = set(shard.tokens)
    file_names = {f"{name}.npy" for name in (*form.array_layout(), *NOT_READ)}
    counts = Counter(archive.namelist())
    for member, count in counts.items():
        token, _, file_name = member.rpartition("/")
        if token not in tokens or file_name not in file_names:
            raise ContentError(
                f"{member}: belongs to no sample of the shard; store only arrays of its tokens"
            )
        if count > 1:
            raise ContentError(f"{member}: appears {count} times; store each array once")


def read_output(
    archive: zipfile.ZipFile, token: str, form: Form
) -> MotionOutput | SegmentationOutput:
    """Read the prediction of a sample; raise a ContentError that names the first invalid array."""
    arrays: dict[str, AnyArray] = {}
    for name, layout in form.array_layout().items():
        with locate_errors(name):
            arrays[name] = read_checked_array(archive, MEMBER.format(token, name), layout)
    return form.output(arrays)


def read_checked_array(archive: zipfile.ZipFile, member: str, layout: ArrayLayout) -> AnyArray:
    """Read an array from an archive; raise ContentError if it is not as expected.

    An array with more bytes than expected is not decompressed.

    Args:
        archive: Open archive.
        member: Path of the array in the archive.
        layout: Expected shape and types.
    """
    try:
        entry = archive.getinfo(member)
    except KeyError:
        raise ContentError(f"is missing; expected the member {member}") from None
    max_length, *other_lengths = layout.shape
    lengths = str(max_length)
    if layout.min_length < max_length:
        lengths = f"{layout.min_length} to {max_length}"
    expected = f"expected shape ({lengths}, {', '.join(map(str, other_lengths))})"
    max_bytes = math.prod(layout.shape) * _MAX_NUMBER_BYTES + _MAX_HEADER_BYTES
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
    if array.dtype.kind not in layout.kinds:
        expected_kinds = " or ".join(_KIND_NAMES[kind] for kind in layout.kinds)
        raise ContentError(f"expected {expected_kinds}, found {array.dtype}")
    has_shape = array.ndim == len(layout.shape) and [*array.shape[1:]] == other_lengths
    if not has_shape or not layout.min_length <= len(array) <= max_length:
        raise ContentError(f"{expected}, found {array.shape}")
    return array
