"""What a results file holds, once it is parsed: by sample, whatever the task."""

from __future__ import annotations

import functools
import gc
import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results.accident_entries import accident_columns, accidents_at
from deepaccident_devkit.evaluation.results.detection_entries import boxes_at, detection_columns
from deepaccident_devkit.evaluation.results.entries import Entries, ReadColumns, read_entries
from deepaccident_devkit.evaluation.results.faults import at, told_of
from deepaccident_devkit.evaluation.results.form import MotionForm
from deepaccident_devkit.evaluation.results.header import Header, read_header
from deepaccident_devkit.evaluation.results.manifest import read_manifest
from deepaccident_devkit.evaluation.results.motion_arrays import stored_output, stored_paths
from deepaccident_devkit.evaluation.results.paths import paths_of
from deepaccident_devkit.evaluation.results.shards import OpenShards, ShardCheck, check_shard
from deepaccident_devkit.evaluation.results.strict_json import parsed_json
from deepaccident_devkit.parallel import run_batch

Prediction = MotionOutput | list[Accident] | DetectedBoxes


class EntryContents:
    """Accidents or detected boxes, all of them in memory and checked."""

    form: MotionForm | None = None

    def __init__(self, header: Header, results: object) -> None:
        """Check all entries; raises ContentError."""
        columns, self._at = _ENTRIES[header.task]
        self.header = header
        self._entries = read_entries(results, columns)

    @property
    def tokens(self) -> Collection[str]:
        """The samples."""
        return self._entries.number.keys()

    def prediction(self, token: str) -> Prediction:
        """The entries of a sample."""
        return self._at(self._entries, token)

    def check(self, *, workers: int | None, progress: bool) -> None:
        """All was checked when it was read."""


class MotionContents:
    """Motion, in the shards of a folder."""

    def __init__(self, path: Path, header: Header, document: Mapping[str, Any]) -> None:
        """Check the manifest; raises ContentError."""
        self._path, self._root = path, path.parent
        self.header = header
        self._manifest = read_manifest(document, self._root)
        self.form: MotionForm = self._manifest.form
        self._shards = OpenShards(self._root)

    @property
    def tokens(self) -> Collection[str]:
        """The samples."""
        return self._manifest.shard_of.keys()

    def prediction(self, token: str) -> MotionOutput:
        """The prediction of a sample; raises ResultsError."""
        shard = self._manifest.shards[self._manifest.shard_of[token]]
        with told_of(self._path), at(shard.file):
            archive = self._shards.archive(shard)
            with at(token):
                return stored_output(archive, token, self.form)

    def trajectories(self, token: str) -> dict[int, FloatArray]:
        """Those stored with a sample, or else those of its maps; raises ResultsError."""
        shard = self._manifest.shards[self._manifest.shard_of[token]]
        with told_of(self._path), at(shard.file):
            archive = self._shards.archive(shard)
            with at(token):
                stored = stored_paths(archive, token, self.form)
        return paths_of(self.prediction(token), self.form.labels) if stored is None else stored

    def check(self, *, workers: int | None, progress: bool) -> None:
        """Read every array; raises ResultsError that names shard, token and array."""
        tasks = [ShardCheck(self._root, shard, self.form) for shard in self._manifest.shards]
        run_batch(check_shard, tasks, workers=workers, label="shards", progress=progress)


Contents = EntryContents | MotionContents
"""What is in a file; those who ask for a token know that it is there."""


@functools.lru_cache(maxsize=4)
def contents_of(path: Path, fingerprint: str) -> Contents:
    """The contents of a file of known bytes; a process parses it once, however many copies of `Results` it gets.

    Raises:
        ResultsError: it cannot be read, is not as its format says, or has other bytes now.
    """
    with told_of(path):
        content = path.read_bytes()
    if content_fingerprint(content) != fingerprint:
        raise ResultsError(f"{path}: was changed after it was opened; open it again")
    with told_of(path), _collector_paused():
        document = parsed_json(content)
        header = read_header(document, path)
        if header.task == "motion":
            return MotionContents(path, header, document)
        return EntryContents(header, document["results"])


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


def content_fingerprint(content: bytes) -> str:
    """The hash of a file's bytes, 32 hexadecimal digits."""
    return hashlib.blake2b(content, digest_size=16).hexdigest()


_ENTRIES: Final[Mapping[str, tuple[ReadColumns, Callable[[Entries, str], Prediction]]]] = {
    "accident": (accident_columns, accidents_at),
    "detection": (detection_columns, boxes_at),
}
