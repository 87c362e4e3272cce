"""The shards of motion results: opened a few at a time, and checked as a whole."""

from __future__ import annotations

import os
import zipfile
from collections import Counter, OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from deepaccident_devkit.evaluation.results.arrays_in_shards import member_name
from deepaccident_devkit.evaluation.results.faults import ContentError, at, told_of
from deepaccident_devkit.evaluation.results.form import RESULTS_FILE, MotionForm
from deepaccident_devkit.evaluation.results.manifest import Shard
from deepaccident_devkit.evaluation.results.motion_arrays import PATHS, check_sample, members
from deepaccident_devkit.files import DAMAGED_ARCHIVE, file_checksum

_OPEN_FILES: Final = 8


class OpenShards:
    """Archives of a folder, the last few of which stay open; safe in threads and in forked workers."""

    def __init__(self, root: Path) -> None:
        """Start without any open."""
        self._root = root
        self._open: OrderedDict[str, zipfile.ZipFile] = OrderedDict()
        self._process = os.getpid()

    def archive(self, shard: Shard) -> zipfile.ZipFile:
        """The archive, open; raises ContentError. Threads may ask at once: what leaves is left to the collector."""
        if self._process != os.getpid():  # a fork shares positions in open files with its parent
            self._open, self._process = OrderedDict(), os.getpid()
        archive = self._open.get(shard.file)
        if archive is None:
            archive = opened(self._root, shard)
            self._open[shard.file] = archive
            while len(self._open) > _OPEN_FILES:
                self._open.popitem(last=False)
        with suppress(KeyError):
            self._open.move_to_end(shard.file)
        return archive


@dataclass(frozen=True, slots=True)
class ShardCheck:
    """A shard to look through.

    Attributes:
        root: the folder of the results.
        shard: which.
        form: of what is stored.
    """

    root: Path
    shard: Shard
    form: MotionForm


def check_shard(task: ShardCheck) -> None:
    """Read all of a shard; raises ResultsError that names shard, token and array."""
    shard, path = task.shard, task.root / task.shard.file
    with told_of(task.root / RESULTS_FILE), at(shard.file):
        if file_checksum(path) != shard.checksum:
            raise ContentError("its bytes are not those that the checksum is of; copy it again from where it was made")
        with opened(task.root, shard) as archive:
            _check_members(archive, shard, task.form)
            for token in shard.tokens:
                with at(token):
                    check_sample(archive, token, task.form)


def opened(root: Path, shard: Shard) -> zipfile.ZipFile:
    """A shard's archive; raises ContentError."""
    try:
        return zipfile.ZipFile(root / shard.file)
    except DAMAGED_ARCHIVE as error:
        raise ContentError(f"is no npz archive that can be read ({error}); copy it again") from error


def _check_members(archive: zipfile.ZipFile, shard: Shard, form: MotionForm) -> None:
    possible = {member_name(token, name) for token in shard.tokens for name in (*members(form), *PATHS)}
    for name, times in Counter(archive.namelist()).items():
        if name not in possible:
            raise ContentError(f"{name}: belongs to no sample of the shard; store the arrays of its tokens alone")
        if times > 1:
            raise ContentError(f"{name}: stands there {times} times; store each array once")
