"""Hashes of the truth: the bytes of a scenario's label, meta and calib files, as they are in the release."""

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
# The number of LiDAR points in a line of a label.
_POINTS: Final = re.compile(rb" (\d{1,7})(?= (?:True|False)[ \t\r]*$)", re.MULTILINE)
_UNCOUNTED: Final = attrgetter("meta", "calib", "boxes")
# LiDAR points by which a scenario's boxes may differ: the root of the sum of their squares. docs/benchmark.md says how
# much was measured.
POINTS_TOLERANCE: Final = 12.0
# What to do about an index that was made from other files.
INDEX_REMEDY: Final = "update it with: deepaccident check index DATAROOT"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioHashes:
    """Of one scenario's files, each a blake2b of 16 bytes in hexadecimal digits; None where it has no such file.

    Files go into it by agent (`taxonomy.AGENTS`) and frame, each as its name, its length and its bytes.

    Attributes:
        label: of all agents' label files.
        meta: of the meta file.
        calib: of all agents' calib files.
        boxes: of all agents' label files without `num_lidar_pts`; None if unknown.
        points: the sketch of `num_lidar_pts` of all boxes.
    """

    label: str | None
    meta: str | None
    calib: str | None
    boxes: str | None = field(default=None, compare=False)
    points: Sketch = field(default=(), compare=False)

    def as_dict(self) -> dict[str, str | None]:
        """Return the hashes of whole files by name."""
        return {"label": self.label, "meta": self.meta, "calib": self.calib}

    def is_like(self, other: ScenarioHashes | None) -> bool:
        """Return whether the files are the same, but for a few LiDAR points more or less in some boxes."""
        if other is None or None in (self.boxes, other.boxes):
            return self == other
        return (
            _UNCOUNTED(self) == _UNCOUNTED(other)
            and distance(self.points, other.points) <= POINTS_TOLERANCE
        )


class Located(Protocol):
    """An opened release, such as a `Dataset`: where it is, and what its index was made from."""

    @property
    def dataroot(self) -> ReleasePath:
        """The release's folder."""

    @property
    def version(self) -> str:
        """`v1` or `v1-mini`."""

    def indexed_hashes(self, scenario: str) -> ScenarioHashes | None:
        """Return the hashes of the files that a scenario's rows were made from; None where they are unknown."""


@runtime_checkable
class HasTruth(Protocol):
    """A source whose truth is not in a release's files."""

    def truth_hashes(self, scenario: str) -> ScenarioHashes:
        """The hashes of a scenario's truth; raises TokenError."""


def scenario_hashes(
    dataset: Located, scenarios: Collection[str], **how: Unpack[Engine]
) -> dict[str, ScenarioHashes]:
    """Return the hashes of some scenarios' files by token, in order; scenarios that the release lacks are left out.

    Reads the files, and compares them with those that the index was made from: it does not notice a file that was
    written in place, so that numbers would be of other files than the hashes.

    Args:
        dataset: the release.
        scenarios: their tokens.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        DatarootError: the release's folder is gone, or one of its folders cannot be listed.
        IndexStoreError: the index was made from other files.
        ReleaseError: a file cannot be read.
    """
    if isinstance(dataset, HasTruth):
        return {token: dataset.truth_hashes(token) for token in sorted(set(scenarios))}
    from deepaccident_devkit.support.parallel import (
        Places,
        run_batch,
    )  # here: opening a release waits for this module

    folders = scenario_folders(dataset, scenarios)
    work, places = partial(checked_hashes, dataset), Places(reads=places_of(dataset.dataroot))
    return dict(
        zip(folders, run_batch(work, list(folders.values()), places=places, **how), strict=True)
    )


def checked_hashes(dataset: Located, scenario: ScenarioFolder) -> ScenarioHashes:
    """Return the hashes of a scenario's files as they are now; raises as `scenario_hashes`."""
    hashes, indexed = folder_hashes(scenario), dataset.indexed_hashes(scenario.token)
    if indexed not in (None, hashes):
        raise IndexStoreError(
            f"{dataset.dataroot}: the index is out of date: files of {scenario.token} have changed since it was made; "
            f"{INDEX_REMEDY}"
        )
    return hashes


def scenario_folders(dataset: Located, scenarios: Collection[str]) -> dict[str, ScenarioFolder]:
    """Where some scenarios' files lie, by token in order, if they are in the release; raises DatarootError."""
    folders = {
        each.token: each
        for each in reversed(find_release(dataset.dataroot, dataset.version).scenarios)
    }
    return {token: folders[token] for token in sorted(set(scenarios)) if token in folders}


def _read(path: ReleasePath, kind: FileKind) -> bytes:
    return read_content(path, kind, ReleaseError)


def folder_hashes(scenario: ScenarioFolder, read: _Reader = _read) -> ScenarioHashes:
    """Return the hashes of a scenario's files.

    Args:
        scenario: where the files lie.
        read: gives a file's bytes.

    Raises:
        DatarootError: a folder cannot be listed.
        ReleaseError: a file cannot be read.
    """

    def contents(kind: FileKind, ending: str) -> dict[ReleasePath, bytes]:
        paths = [
            scenario.file(agent, kind, frame, ending)
            for agent in AGENTS
            for frame in frame_numbers(scenario.kind_folder(agent, kind), ending)[0]
        ]
        return {path: read(path, kind) for path in paths}

    labels, meta = contents("label", "txt"), scenario.meta_path
    counts = [count for text in labels.values() for count in _POINTS.findall(text)]
    base = scenario.root / scenario.folder / scenario.scenario_type
    return ScenarioHashes(
        label=_digest(labels, base),
        meta=_digest({meta: read(meta, "meta")} if meta.is_file() else {}, meta.parent),
        calib=_digest(contents("calib", "pkl"), base),
        boxes=_digest({path: _POINTS.sub(b"", text) for path, text in labels.items()}, base),
        points=sketch(np.array(counts, dtype=np.float32)),
    )


def sensor_digest(scenario: ScenarioFolder, sensors: Iterable[tuple[str, str]]) -> str:
    """A hash of frames and sizes of sensor files of a scenario's agents and channels; folders are only listed."""
    sizes = [
        (
            agent,
            channel,
            list(
                frame_sizes(scenario.kind_folder(agent, channel), CHANNEL_FORMAT[channel]).items()
            ),
        )
        for agent, channel in sensors
    ]
    return digest_of(sizes)


def fingerprint(hashes: Mapping[str, ScenarioHashes]) -> str:
    """One hash for the truth of several scenarios, in any order."""
    return digest_of({token: each.as_dict() for token, each in hashes.items()})


def digest_of(value: Any) -> str:
    """A hash of a JSON value; the order of names does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=_DIGEST_BYTES).hexdigest()


def _digest(contents: Mapping[ReleasePath, bytes], base: ReleasePath) -> str | None:
    if not contents:
        return None
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for path, content in contents.items():
        name = str(path).removeprefix(str(base)).replace(os.sep, "/").lstrip("/")
        digest.update(f"{name} {len(content)}\n".encode(errors="surrogateescape"))
        digest.update(content)
    return digest.hexdigest()
