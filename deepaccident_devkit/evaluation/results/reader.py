"""`Results`: a model's predictions of many samples, read strictly from a results file."""

from __future__ import annotations

import copy
import gc
import hashlib
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from deepaccident_devkit.errors import ResultsError, TokenError
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results.entries import ENTRIES, Entries, entry_place, read_entries
from deepaccident_devkit.evaluation.results.header import (
    RESULTS_FILE,
    ContentError,
    MotionForm,
    at,
    decoded,
    json_meta,
    parsed_json,
    shown,
    told_of,
)
from deepaccident_devkit.evaluation.results.motion_arrays import stored_output
from deepaccident_devkit.evaluation.results.records import FORMAT, FORMAT_VERSION, MotionFile, ResultsFile, ResultsTask
from deepaccident_devkit.evaluation.results.shards import check_shard, read_manifest, shared_archive
from deepaccident_devkit.parallel import Places, run_batch
from deepaccident_devkit.support.reading import NO_NAME, fault_text, irregular_text, read_bytes
from deepaccident_devkit.support.text import path_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine


class _Texts(msgspec.Struct):
    """The entries of each sample, not yet read."""

    results: dict[str, msgspec.Raw]


def read_document(content: bytes, path: Path) -> tuple[ResultsFile, dict[str, Any]]:
    """The records of a results file, and its meta.

    Args:
        content: the file's bytes.
        path: its path, for errors.

    Raises:
        ContentError: it is no JSON, or is not as its format says; names the token and the field.
        ResultsError: it is of another version.
    """
    try:
        document: ResultsFile = decoded(content, ResultsFile)  # type: ignore[arg-type]  # a union is a kind too
    except ContentError:
        _tell(content, path)
        raise
    return document, json_meta(_strict_meta(content, document))


def _strict_meta(content: bytes, document: ResultsFile) -> object:
    """The meta of a document, where no name stands twice, and all that was not read is JSON as `parsed_json` has it.

    The records have as many names as the text has colons outside texts. Where it has more, the strict reader says why;
    it takes four times as long.
    """
    if not isinstance(document, MotionFile):
        record = ENTRIES[document.task].record
        entries = list(chain.from_iterable(document.results.values()))
        optional = record.__struct_fields__[-len(record.__struct_defaults__) :]
        kinds = Counter(chain.from_iterable(map(type, map(attrgetter(name), entries)) for name in optional))
        ignored = [getattr(each, name) for each in entries for name in optional] if kinds[msgspec.Raw] else []
        unread = b"[%s]" % b",".join([document.meta, *(each for each in ignored if isinstance(each, msgspec.Raw))])
        # the file's own names, the task among them, those of samples, and those of entries
        names = (
            len(document.__struct_fields__) + 1 + len(document.results) + len(entries) * len(record.__struct_fields__)
        )
        colons = np.count_nonzero(np.frombuffer(content, np.uint8) == ord(":"))
        with suppress(ContentError):
            meta, *_ = parsed_json(unread)
            if names - kinds[msgspec.UnsetType] + unread.count(b":") == colons:
                return meta
    return parsed_json(content)["meta"]


def _tell(content: bytes, path: Path) -> None:
    """Say what is wrong with a results file, by its token or with its remedy, where that is known; raises."""
    told = parsed_json(content)
    if not isinstance(told, dict):
        raise ContentError(f"expected a JSON object, found {shown(told)}")
    if "format" not in told and "results" in told:
        raise ContentError(
            f'has no "format" (a nuScenes results file?); put "format": "{FORMAT}", "version": {FORMAT_VERSION} and '
            '"task": "detection" before its "meta" and "results"'
        )
    version = told.get("version")
    if told.get("format") == FORMAT and type(version) is int and version != FORMAT_VERSION:
        age, remedy = ("a newer", "update the devkit") if version > FORMAT_VERSION else ("an older", "write it again")
        raise ResultsError(
            f"{path}: version: {age} results format ({shown(version)}, this devkit's is {FORMAT_VERSION}); {remedy}"
        )
    kind = ENTRIES.get(str(told.get("task")))
    if kind is not None and isinstance(told.get("results"), dict):
        for token, entries in decoded(content, _Texts).results.items():
            with at(entry_place(token)):
                read_entries(bytes(entries), kind.record)


Prediction = MotionOutput | list[Accident] | DetectedBoxes


class EntryContents:
    """Accidents or detected boxes, all of them in memory and checked."""

    form: MotionForm | None = None

    def __init__(self, task: ResultsTask, meta: Mapping[str, Any], results: Mapping[str, Any]) -> None:
        """Check what records cannot say; raises ContentError."""
        self.task, self.meta = task, meta
        self._kind = ENTRIES[task]
        self._entries = Entries.read(results, self._kind.columns)

    @property
    def tokens(self) -> Collection[str]:
        """The samples."""
        return self._entries.number.keys()

    def prediction(self, token: str) -> Prediction:
        """The entries of a sample."""
        return self._kind.prediction(self._entries, token)

    def check(self, **_how: Any) -> None:
        """Nothing to do: all was checked when it was read."""


class MotionContents:
    """Motion, in the shards of a folder."""

    task: ResultsTask = "motion"

    def __init__(self, path: Path, meta: Mapping[str, Any], document: MotionFile) -> None:
        """Check the manifest; raises ContentError."""
        self._path, self._root = path, path.parent
        self.meta = meta
        self._shards = document.shards
        self.form, self._shard_of = read_manifest(document, self._root)

    @property
    def tokens(self) -> Collection[str]:
        """The samples."""
        return self._shard_of.keys()

    def prediction(self, token: str) -> MotionOutput:
        """The prediction of a sample; raises ResultsError."""
        shard = self._shard_of[token]
        with told_of(self._path), at(shard.file):
            archive = shared_archive(self._root, shard, os.getpid())
            with at(token):
                return stored_output(archive, token, self.form)

    def check(self, **how: Any) -> None:
        """Read every array, as `run_batch` is told.

        Raises:
            ResultsError: names shard, token and array.
        """
        check = partial(check_shard, self._root, self.form)
        run_batch(check, self._shards, label="shards", places=Places(reads=(self._root,)), **how)


Contents = EntryContents | MotionContents
"""The content of a file; callers ask only for tokens that it has."""
kept: Final[dict[tuple[Path, str], Contents]] = {}
"""Path and fingerprint → contents of the files that this process parsed last."""
_MOST_KEPT: Final = 4


def contents_of(path: Path, fingerprint: str = "") -> tuple[Contents, str]:
    """The contents of a file; a process parses it once, however many copies of `Results` it gets.

    Args:
        path: of the file.
        fingerprint: of the bytes that it must have, which are not read again if they were parsed; empty for any.

    Returns:
        The contents, and the fingerprint of the file's bytes.

    Raises:
        ResultsError: it cannot be read, is not as its format says, or has other bytes now.
    """
    contents = kept.get((path, fingerprint))
    if contents is not None:
        return contents, fingerprint
    with told_of(path):
        content = read_bytes(path, "results")
    found = content_fingerprint(content)
    if fingerprint not in ("", found):
        raise ResultsError(f"{path}: was changed after it was opened; open it again")
    contents = kept.get((path, found))
    if contents is None:
        with told_of(path), _collector_paused():
            contents = _parsed(content, path)
        while len(kept) >= _MOST_KEPT:
            kept.pop(next(iter(kept)), None)
        kept[path, found] = contents
    return contents, found


def _parsed(content: bytes, path: Path) -> Contents:
    document, meta = read_document(content, path)
    if isinstance(document, MotionFile):
        return MotionContents(path, meta, document)
    return EntryContents(document.task, meta, document.results)


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

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without the contents."""
        return Results, (self.path, self.task, self.fingerprint)

    def __repr__(self) -> str:
        return f"<{self.task} results: {len(self):,} samples in {self.path}>"

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
            For motion a MotionOutput; of accidents a list, empty if none is foreseen; of detection the boxes, in the
            world frame.

        Raises:
            TokenError: the sample is not here.
            ResultsError: its arrays are missing or damaged, or the file was changed.
        """
        contents = self._contents
        if token not in contents.tokens:
            raise TokenError(f"{self.path}: has no prediction of {token!r}; `tokens` lists those that it has")
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
        with told_of(self._file):
            now = content_fingerprint(read_bytes(self._file, "results"))
        if now != self.fingerprint:
            raise ResultsError(f"{self._file}: was changed after it was opened; open it again")
        how = {"workers": 1, **how}
        self._contents.check(**how)

    @property
    def _file(self) -> Path:
        return self.path / RESULTS_FILE if self.task == "motion" else self.path

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
        raise ResultsError(f"{file}: is the manifest of motion results; call it {RESULTS_FILE}, as others look for it")
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
