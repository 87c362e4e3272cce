"""Motion results in shards: the manifest that lists them, archives opened a few at a time and checked, their writer."""

from __future__ import annotations

import json
import zipfile
from collections import Counter
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, Final

import msgspec

from deepaccident_devkit.errors import ResultsError, shortened
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results.header import (
    RESULTS_FILE,
    ContentError,
    MotionForm,
    at,
    check_token,
    told_of,
)
from deepaccident_devkit.evaluation.results.motion_arrays import (
    NOT_READ,
    head_arrays,
    instance_arrays,
    member_name,
    members,
    put_array,
    stored_output,
)
from deepaccident_devkit.evaluation.results.records import MotionFile, Shard, Stored
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.reading import DAMAGED_ARCHIVE, check_size, file_checksum, irregular_text, open_zip


def read_manifest(document: MotionFile, root: Path) -> tuple[MotionForm, dict[str, Shard]]:
    """The manifest of the results in a folder, with a check that its shards exist and have their sizes.

    Returns:
        How predictions are stored, and token → its shard, in the order of the shards.

    Raises:
        ContentError: names the field, or the shard.
    """
    with at("form"):
        form = MotionForm.from_record(document.form)
    shard_of: dict[str, Shard] = {}
    files: set[str] = set()
    for number, shard in enumerate(document.shards):
        with at(f"shards[{number}]"):
            _check_file(shard, root, files)
        files.add(shard.file)
        for token in shard.tokens:
            with at(f"shards[{number}].tokens"):
                check_token(token)
            if token in shard_of:
                others = "twice" if shard_of[token] is shard else f"also in {shard_of[token].file}"
                raise ContentError(f"{shard.file}: {token}: stands there {others}; store a sample once")
            shard_of[token] = shard
    return form, shard_of


def _is_inside(path: PurePosixPath) -> bool:
    return not path.is_absolute() and path.parts != () and ".." not in path.parts


def _check_file(shard: Shard, root: Path, others: AbstractSet[str]) -> None:
    """Whether a shard's file is there, as long as it should be, in the folder, and not another shard's too."""
    if not shard.file.isprintable() or "\\" in shard.file or not _is_inside(PurePosixPath(shard.file)):
        raise ContentError(f"file: expected a path inside the folder of the results, found {shortened(shard.file)!r}")
    path = root / shard.file
    if shard.file in others:
        raise ContentError(f"file: {shard.file} is another entry's too; list each file once")
    try:
        status = path.stat()
        inside = path.resolve().is_relative_to(root.resolve())
    except OSError as error:
        raise ContentError(f"file: {shard.file} cannot be opened ({error.strerror}); copy it to its place") from error
    if not inside:
        raise ContentError(f"file: {shard.file} is a link that leads out of the folder; put the file itself there")
    irregular = irregular_text(status.st_mode)
    if irregular:
        raise ContentError(f"file: {shard.file} is {irregular}")
    check_size(status.st_size, "results", shard.file)
    if status.st_size != shard.bytes:
        raise ContentError(f"bytes: {shard.file} should have {shard.bytes}, found {status.st_size}; copy it again")


_OPEN_FILES: Final = 8


@lru_cache(maxsize=_OPEN_FILES)
def shared_archive(root: Path, shard: Shard, _process: int) -> zipfile.ZipFile:
    """A shard's archive, one of the last few, which stay open; raises ContentError.

    Threads may share it, so the garbage collector closes it. A fork shares positions in open files with its parent, and
    so must name its own process.
    """
    return opened(root, shard)


def check_shard(root: Path, form: MotionForm, shard: Shard) -> None:
    """Read all of a shard of the results in a folder; raises ResultsError that names shard, token and array."""
    path = root / shard.file
    with told_of(root / RESULTS_FILE), at(shard.file):
        if path.stat().st_size != shard.bytes or file_checksum(path) != shard.checksum:
            raise ContentError("its bytes are not those that the checksum is of; copy it again from where it was made")
        with opened(root, shard) as archive:
            _check_members(archive, shard, form)
            for token in shard.tokens:
                with at(token):
                    stored_output(archive, token, form)


def opened(root: Path, shard: Shard) -> zipfile.ZipFile:
    """A shard's archive; raises ContentError."""
    try:
        return open_zip(root / shard.file)
    except DAMAGED_ARCHIVE as error:
        raise ContentError(f"is no npz archive that can be read ({error}); copy it again") from error


def _check_members(archive: zipfile.ZipFile, shard: Shard, form: MotionForm) -> None:
    possible = {member_name(token, name) for token in shard.tokens for name in (*members(form), *NOT_READ)}
    for name, times in Counter(archive.namelist()).items():
        if name not in possible:
            raise ContentError(f"{name}: belongs to no sample of the shard; store the arrays of its tokens alone")
        if times > 1:
            raise ContentError(f"{name}: stands there {times} times; store each array once")


_MOST_SAMPLES: Final = 64
_MOST_BYTES: Final = 32 * 2**20


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
            raise ResultsError(f"expected {self._frames} frames as of the samples before, found {frames}")
        self._form(output.grid, predictions, frames)
        self._grid, self._frames = output.grid, frames
        self._predictions = max(self._predictions, predictions)
        if self._archive is None:
            self._archive = zipfile.ZipFile(self._folder / self._file, "w")
        for name, array in arrays.items():
            put_array(self._archive, token, name, array)
        self._in_shard.append(token)
        written = sum(entry.compress_size for entry in self._archive.infolist())
        if len(self._in_shard) >= _MOST_SAMPLES or written >= _MOST_BYTES:
            self._end_shard()

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
            raise ResultsError(f"instances: expected ids from 1, and 0 elsewhere, found {output.instances.min()}")
        if self._store == "instances":
            return instance_arrays(output)
        if output.heads is None:
            raise ResultsError("expected heads, found instance maps; write those with store='instances'")
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
