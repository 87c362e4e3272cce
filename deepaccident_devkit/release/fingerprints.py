"""Hashes of the truth: the bytes of a scenario's label, meta and calib files, as they are in the release."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.release.layout import ScenarioFolder, find_release, frame_numbers, frame_sizes
from deepaccident_devkit.release.store import ReleasePath, places_of, read_content
from deepaccident_devkit.support.reading import FileKind
from deepaccident_devkit.taxonomy import AGENTS, CHANNEL_FORMAT

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine

_DIGEST_BYTES: Final = 16
_ENDINGS: Final[Mapping[FileKind, str]] = {"label": "txt", "calib": "pkl"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioHashes:
    """Of one scenario's files, each a blake2b of 16 bytes in hexadecimal digits; None where it has no such file.

    Files go into it by agent (`taxonomy.AGENTS`) and frame, each as its name, its length and its bytes.

    Attributes:
        label: of all agents' label files.
        meta: of the meta file.
        calib: of all agents' calib files.
    """

    label: str | None
    meta: str | None
    calib: str | None

    def as_dict(self) -> dict[str, str | None]:
        """By name."""
        return asdict(self)


class Located(Protocol):
    """An object that knows where a release is, such as a `Dataset`."""

    @property
    def dataroot(self) -> ReleasePath:
        """The release's folder."""

    @property
    def version(self) -> str:
        """`v1` or `v1-mini`."""


@runtime_checkable
class HasTruth(Protocol):
    """A source whose truth is not in a release's files."""

    def truth_hashes(self, scenario: str) -> ScenarioHashes:
        """The hashes of a scenario's truth; raises TokenError."""


def scenario_hashes(dataset: Located, scenarios: Collection[str], **how: Unpack[Engine]) -> dict[str, ScenarioHashes]:
    """The hashes of some scenarios' files, by token in order; those that are not in the release are left out.

    Reads the files themselves and not the index, which does not notice a file that was edited in place.

    Args:
        dataset: the release.
        scenarios: their tokens.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        DatarootError: the release's folder is gone, or one of its folders cannot be listed.
        ReleaseError: a file cannot be read.
    """
    if isinstance(dataset, HasTruth):
        return {token: dataset.truth_hashes(token) for token in sorted(set(scenarios))}
    from deepaccident_devkit.parallel import Places, run_batch  # here: opening a release waits for this module

    folders = scenario_folders(dataset, scenarios)
    found = run_batch(folder_hashes, list(folders.values()), places=Places(reads=places_of(dataset.dataroot)), **how)
    return dict(zip(folders, found, strict=True))


def scenario_folders(dataset: Located, scenarios: Collection[str]) -> dict[str, ScenarioFolder]:
    """Where some scenarios' files lie, by token in order, if they are in the release; raises DatarootError."""
    folders = {each.token: each for each in reversed(find_release(dataset.dataroot, dataset.version).scenarios)}
    return {token: folders[token] for token in sorted(set(scenarios)) if token in folders}


def folder_hashes(scenario: ScenarioFolder, kinds: Collection[FileKind] = ("label", "meta", "calib")) -> ScenarioHashes:
    """The hashes of a scenario's files, of some kinds; raises DatarootError and ReleaseError as `scenario_hashes`."""
    base = scenario.root / scenario.folder / scenario.scenario_type
    meta = [scenario.meta_path] if "meta" in kinds and scenario.meta_path.is_file() else []
    hashes = {"meta": _digest(meta, "meta", scenario.meta_path.parent)}
    for kind, ending in _ENDINGS.items():
        paths = [
            scenario.file(agent, kind, frame, ending)
            for agent in AGENTS
            if kind in kinds
            for frame in frame_numbers(scenario.kind_folder(agent, kind), ending)[0]
        ]
        hashes[kind] = _digest(paths, kind, base)
    return ScenarioHashes(**hashes)


def sensor_digest(scenario: ScenarioFolder, sensors: Iterable[tuple[str, str]]) -> str:
    """A hash of frames and sizes of sensor files of a scenario's agents and channels; folders are only listed."""
    sizes = [
        (agent, channel, list(frame_sizes(scenario.kind_folder(agent, channel), CHANNEL_FORMAT[channel]).items()))
        for agent, channel in sensors
    ]
    return digest_of(sizes)


def fingerprint(hashes: Mapping[str, ScenarioHashes]) -> str:
    """One hash for the truth of several scenarios, in any order."""
    return digest_of({token: asdict(each) for token, each in hashes.items()})


def digest_of(value: Any) -> str:
    """A hash of a JSON value; the order of names does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=_DIGEST_BYTES).hexdigest()


def _digest(paths: Collection[ReleasePath], kind: FileKind, base: ReleasePath) -> str | None:
    if not paths:
        return None
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for path in paths:
        content = read_content(path, kind, ReleaseError)
        name = str(path).removeprefix(str(base)).replace(os.sep, "/").lstrip("/")
        digest.update(f"{name} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()
