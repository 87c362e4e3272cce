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
_DIGEST_BYTES = 16
# The number of LiDAR points in a line of a label file.
_POINTS_PATTERN = re.compile(rb" (\d{1,7})(?= (?:True|False)[ \t\r]*$)", re.MULTILINE)
_HASHES_WITHOUT_POINTS = attrgetter("meta", "calib", "boxes")
# Largest accepted root of the sum of squared differences between the LiDAR point counts of a
# scenario's boxes. Without numpy's code for newer processors, one box of 1.4 million had one more
# point; without Embree, two boxes of 3,417 had.
POINTS_TOLERANCE: Final = 12.0
# Remedy for an index that was made from other files.
INDEX_REMEDY: Final = "update it with: deepaccident check index DATAROOT"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioHashes:
    """Hashes of one scenario's files.

    Each is a 16-byte blake2b hash in hexadecimal digits, or None if there are no files of the kind.
    It covers the name, length and bytes of each file, in the order of agents (`taxonomy.AGENTS`)
    and frames.

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
        """Return kind of file → hash of all files of this kind."""
        return {"label": self.label, "meta": self.meta, "calib": self.calib}

    def is_like(self, other: ScenarioHashes | None) -> bool:
        """Return whether the files are equal but for the LiDAR point counts of some boxes.

        The counts may differ by `POINTS_TOLERANCE`.
        """
        if other is None or None in (self.boxes, other.boxes):
            return self == other
        if _HASHES_WITHOUT_POINTS(self) != _HASHES_WITHOUT_POINTS(other):
            return False
        return distance(self.points, other.points) <= POINTS_TOLERANCE


class Located(Protocol):
    """An opened release, such as a `Dataset`, with its location and its index's hashes."""

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
    """A source whose ground truth is not in a release's files."""

    def truth_hashes(self, scenario: str) -> ScenarioHashes:
        """Return the hashes of a scenario's ground truth; raise TokenError if it is unknown."""


def scenario_hashes(
    dataset: Located, scenarios: Collection[str], **engine: Unpack[Engine]
) -> dict[str, ScenarioHashes]:
    """Return scenario token → hashes of the scenario's files, sorted by token.

    Scenarios that the release lacks are left out. The files are read and compared with the hashes
    in the index. Opening an index does not notice an overwritten file, so without this check the
    numbers and the hashes could come from different files.

    Args:
        dataset: The release.
        scenarios: Tokens of the scenarios.
        **engine: `workers`, `executor` and `progress`, see `parallel.Engine`.

    Raises:
        DatarootError: If the release's folder no longer exists, or if one of its folders cannot be
            listed.
        IndexStoreError: If the index was made from other files.
        ReleaseError: If a file cannot be read.
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
    """Return the hashes of a scenario's files as they are now, with errors of `scenario_hashes`."""
    hashes = folder_hashes(scenario)
    indexed_hashes = dataset.indexed_hashes(scenario.token)
    if indexed_hashes not in (None, hashes):
        raise IndexStoreError(
            f"{dataset.dataroot}: the index is out of date: files of {scenario.token} have changed "
            f"since it was made; {INDEX_REMEDY}"
        )
    return hashes


def scenario_folders(dataset: Located, scenarios: Collection[str]) -> dict[str, ScenarioFolder]:
    """Return scenario token → folders, sorted by token, for scenarios in the release.

    DatarootError is raised if the release's folder no longer exists or cannot be listed.
    """
    layout = find_release(dataset.dataroot, dataset.version)
    # Reversed, so that the first of a scenario's two folders wins.
    folders = {folder.token: folder for folder in reversed(layout.scenarios)}
    return {token: folders[token] for token in sorted(set(scenarios)) if token in folders}


def _read_file(path: ReleasePath, kind: FileKind) -> bytes:
    """Read a file's bytes; raise ReleaseError if it cannot be read."""
    return read_content(path, kind, ReleaseError)


def folder_hashes(scenario: ScenarioFolder, read: _Reader = _read_file) -> ScenarioHashes:
    """Return the hashes of a scenario's files.

    Args:
        scenario: Folders of the files.
        read: Function that returns a file's bytes.

    Raises:
        DatarootError: If a folder cannot be listed.
        ReleaseError: If a file cannot be read.
    """

    def read_files(kind: FileKind, ending: str) -> dict[ReleasePath, bytes]:
        paths = []
        for agent in AGENTS:
            frames, _ = frame_numbers(scenario.kind_folder(agent, kind), ending)
            paths += [scenario.file(agent, kind, frame, ending) for frame in frames]
        return {path: read(path, kind) for path in paths}

    labels = read_files("label", "txt")
    point_counts = []
    labels_without_points = {}
    for path, content in labels.items():
        point_counts += _POINTS_PATTERN.findall(content)
        labels_without_points[path] = _POINTS_PATTERN.sub(b"", content)
    meta_path = scenario.meta_path
    meta = {meta_path: read(meta_path, "meta")} if meta_path.is_file() else {}
    base = scenario.root / scenario.folder / scenario.scenario_type
    return ScenarioHashes(
        label=_hash_files(labels, base),
        meta=_hash_files(meta, meta_path.parent),
        calib=_hash_files(read_files("calib", "pkl"), base),
        boxes=_hash_files(labels_without_points, base),
        points=sketch(np.array(point_counts, dtype=np.float32)),
    )


def sensor_digest(scenario: ScenarioFolder, sensors: Iterable[tuple[str, str]]) -> str:
    """Return a hash of the frames and sizes of a scenario's sensor files.

    Folders are listed; no file is opened.

    Args:
        scenario: Folders of the files.
        sensors: Pairs of agent and channel.
    """
    all_sizes = []
    for agent, channel in sensors:
        folder = scenario.kind_folder(agent, channel)
        sizes = frame_sizes(folder, CHANNEL_FORMAT[channel])
        all_sizes.append((agent, channel, list(sizes.items())))
    return digest_of(all_sizes)


def fingerprint(hashes: Mapping[str, ScenarioHashes]) -> str:
    """Return one hash for the ground truth of several scenarios; their order does not matter."""
    dicts = {token: scenario.as_dict() for token, scenario in hashes.items()}
    return digest_of(dicts)


def digest_of(value: Any) -> str:
    """Return a hash of a JSON value; the order of names does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=_DIGEST_BYTES).hexdigest()


def _hash_files(contents: Mapping[ReleasePath, bytes], base: ReleasePath) -> str | None:
    """Return a hash of files and their paths relative to `base`; None if there are no files."""
    if not contents:
        return None
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for path, content in contents.items():
        name = str(path).removeprefix(str(base)).replace(os.sep, "/").lstrip("/")
        digest.update(f"{name} {len(content)}\n".encode(errors="surrogateescape"))
        digest.update(content)
    return digest.hexdigest()
