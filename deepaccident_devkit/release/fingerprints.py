"""Hashes of the ground truth: the bytes of a scenario's label, meta and calib files."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeAlias, runtime_checkable

import numpy as np

from deepaccident_devkit.errors import IndexStoreError, ReleaseError
from deepaccident_devkit.release.layout import (
    ScenarioFolder,
    find_release,
    frame_numbers,
    frame_sizes,
)
from deepaccident_devkit.release.store import ReleasePath, places_of, read_content
from deepaccident_devkit.support.reading import FileKind
from deepaccident_devkit.support.sketches import Sketch, distance, sketch
from deepaccident_devkit.taxonomy import AGENTS, CHANNEL_FORMAT

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

_Reader: TypeAlias = Callable[[ReleasePath, FileKind], bytes]
_DIGEST_BYTES: Final = 16
# Number of LiDAR points in a line of a label.
_POINTS_PATTERN: Final = re.compile(rb" (\d{1,7})(?= (?:True|False)[ \t\r]*$)", re.MULTILINE)
_HASHES_WITHOUT_POINTS: Final = attrgetter("meta", "calib", "boxes")
# The LiDAR points of a scenario's boxes may differ by this root of the sum of squares.
# docs/benchmark.md has the measurement.
POINTS_TOLERANCE: Final = 12.0
# Remedy for an index that was made from other files.
INDEX_REMEDY: Final = "update it with: deepaccident check index DATAROOT"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioHashes:
    """Hashes of one scenario's files.

    Each is a blake2b of 16 bytes in hexadecimal digits, or None if there is no such file. It covers
    files by agent (`taxonomy.AGENTS`) and frame, each with its name, its length and its bytes.

    Attributes:
        label: Hash of all agents' label files.
        meta: Hash of the meta file.
        calib: Hash of all agents' calib files.
        boxes: Hash of all agents' label files without `num_lidar_pts`; None if unknown.
        points: Sketch of `num_lidar_pts` of all boxes.
    """

    label: str | None
    meta: str | None
    calib: str | None
    boxes: str | None = field(default=None, compare=False)
    points: Sketch = field(default=(), compare=False)

    def as_dict(self) -> dict[str, str | None]:
        """Return the hashes of complete files by name."""
        return {"label": self.label, "meta": self.meta, "calib": self.calib}

    def is_like(self, other: ScenarioHashes | None) -> bool:
        """Return whether the files are equal, except for the LiDAR points of some boxes.

        The points may differ by `POINTS_TOLERANCE`.
        """
        if other is None or None in (self.boxes, other.boxes):
            return self == other
        if _HASHES_WITHOUT_POINTS(self) != _HASHES_WITHOUT_POINTS(other):
            return False
        return distance(self.points, other.points) <= POINTS_TOLERANCE


class Located(Protocol):
    """An opened release, such as a `Dataset`, with its location and the hashes of its index."""

    @property
    def dataroot(self) -> ReleasePath:
        """Folder of the release."""

    @property
    def version(self) -> str:
        """Version, `v1` or `v1-mini`."""

    def indexed_hashes(self, scenario: str) -> ScenarioHashes | None:
        """Return the hashes of the files from which a scenario's rows were made, or None."""


@runtime_checkable
class HasTruth(Protocol):
    """A source with a ground truth that is not in a release's files."""

    def truth_hashes(self, scenario: str) -> ScenarioHashes:
        """Return the hashes of a scenario's ground truth; raises TokenError."""


def scenario_hashes(
    dataset: Located, scenarios: Collection[str], **engine: Unpack[Engine]
) -> dict[str, ScenarioHashes]:
    """Return the hashes of some scenarios' files by token, in order.

    Scenarios that the release lacks are left out. The files are read, and compared with the hashes
    of the index: the index does not notice a file that was overwritten, so that numbers and hashes
    would belong to different files.

    Args:
        dataset: The release.
        scenarios: Tokens of the scenarios.
        **engine: `workers`, `executor` and `progress`, see `parallel.Engine`.

    Raises:
        DatarootError: The release's folder no longer exists, or one of its folders cannot be
            listed.
        IndexStoreError: The index was made from other files.
        ReleaseError: A file cannot be read.
    """
    if isinstance(dataset, HasTruth):
        return {token: dataset.truth_hashes(token) for token in sorted(set(scenarios))}
    # Imported late, since opening a release waits for this module.
    from deepaccident_devkit.support.parallel import Places, run_batch

    folders = scenario_folders(dataset, scenarios)
    work = partial(checked_hashes, dataset)
    places = Places(reads=places_of(dataset.dataroot))
    results = run_batch(work, list(folders.values()), places=places, **engine)
    return dict(zip(folders, results, strict=True))


def checked_hashes(dataset: Located, scenario: ScenarioFolder) -> ScenarioHashes:
    """Return the hashes of a scenario's present files; raises as `scenario_hashes`."""
    hashes = folder_hashes(scenario)
    indexed_hashes = dataset.indexed_hashes(scenario.token)
    if indexed_hashes not in (None, hashes):
        raise IndexStoreError(
            f"{dataset.dataroot}: the index is out of date: files of {scenario.token} have changed "
            f"since it was made; {INDEX_REMEDY}"
        )
    return hashes


def scenario_folders(dataset: Located, scenarios: Collection[str]) -> dict[str, ScenarioFolder]:
    """Return the folders of some scenarios by token in order, if they are in the release.

    Raises DatarootError.
    """
    layout = find_release(dataset.dataroot, dataset.version)
    # Reversed, so that the first of two folders of a scenario remains.
    folders = {folder.token: folder for folder in reversed(layout.scenarios)}
    return {token: folders[token] for token in sorted(set(scenarios)) if token in folders}


def _read(path: ReleasePath, kind: FileKind) -> bytes:
    """Return a file's bytes, or raise ReleaseError."""
    return read_content(path, kind, ReleaseError)


def folder_hashes(scenario: ScenarioFolder, read: _Reader = _read) -> ScenarioHashes:
    """Return the hashes of a scenario's files.

    Args:
        scenario: Folders of the files.
        read: Function that returns a file's bytes.

    Raises:
        DatarootError: A folder cannot be listed.
        ReleaseError: A file cannot be read.
    """

    def contents(kind: FileKind, ending: str) -> dict[ReleasePath, bytes]:
        paths = []
        for agent in AGENTS:
            frames, _ = frame_numbers(scenario.kind_folder(agent, kind), ending)
            paths += [scenario.file(agent, kind, frame, ending) for frame in frames]
        return {path: read(path, kind) for path in paths}

    labels = contents("label", "txt")
    counts = []
    boxes = {}
    for path, content in labels.items():
        counts += _POINTS_PATTERN.findall(content)
        boxes[path] = _POINTS_PATTERN.sub(b"", content)
    meta_path = scenario.meta_path
    meta = {meta_path: read(meta_path, "meta")} if meta_path.is_file() else {}
    base = scenario.root / scenario.folder / scenario.scenario_type
    return ScenarioHashes(
        label=_digest(labels, base),
        meta=_digest(meta, meta_path.parent),
        calib=_digest(contents("calib", "pkl"), base),
        boxes=_digest(boxes, base),
        points=sketch(np.array(counts, dtype=np.float32)),
    )


def sensor_digest(scenario: ScenarioFolder, sensors: Iterable[tuple[str, str]]) -> str:
    """Return a hash of frames and sizes of sensor files of a scenario's agents and channels.

    Folders are only listed.
    """
    all_sizes = []
    for agent, channel in sensors:
        folder = scenario.kind_folder(agent, channel)
        sizes = frame_sizes(folder, CHANNEL_FORMAT[channel])
        all_sizes.append((agent, channel, list(sizes.items())))
    return digest_of(all_sizes)


def fingerprint(hashes: Mapping[str, ScenarioHashes]) -> str:
    """Return one hash for the ground truth of several scenarios, in any order."""
    return digest_of({token: scenario.as_dict() for token, scenario in hashes.items()})


def digest_of(value: Any) -> str:
    """Return a hash of a JSON value; the order of names does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=_DIGEST_BYTES).hexdigest()


def _digest(contents: Mapping[ReleasePath, bytes], base: ReleasePath) -> str | None:
    """Return a hash of files with their names below a base folder; None without files."""
    if not contents:
        return None
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for path, content in contents.items():
        name = str(path).removeprefix(str(base)).replace(os.sep, "/").lstrip("/")
        digest.update(f"{name} {len(content)}\n".encode(errors="surrogateescape"))
        digest.update(content)
    return digest.hexdigest()
