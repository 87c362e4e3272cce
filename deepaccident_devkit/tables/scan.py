"""A scenario's small files: their existence, contents and faults, and digests of their state."""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from operator import attrgetter
from typing import Any, Literal

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.release import (
    Calibs,
    Labels,
    Meta,
    ScenarioFolder,
    read_calibs,
    read_labels,
    read_meta,
)
from deepaccident_devkit.release.fingerprints import folder_hashes
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.release.store import (
    FolderEntry,
    ReleasePath,
    StorePath,
    fetched,
    folder_entries,
)
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.reading import FileKind, fault_text, observed, read_bytes
from deepaccident_devkit.taxonomy import AGENTS, AgentName

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Levels of severity, worst first.

An `error` cannot be indexed or is impossible, a `warning` is probably wrong, and a `note` is worth
knowing.
"""
SMALL_FILE_ENDINGS = {"calib": "pkl", "label": "txt"}
"""Kind of small file → ending of its files."""
_MAX_RANGES = 6
_ARCHIVE_REMEDY = "unpack its archive again, or leave the scenario out with on_error='skip'"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding(ShortRepr):
    """A wrong, odd or missing part of a release.

    Attributes:
        code: Kind of finding, such as `label-unreadable`; `validation.CODES` has all.
        severity: Severity.
        scenario: Token of the scenario; None for the release itself.
        where: File (with the line), folder, or agents and actors.
        what: Description of the fault.
        remedy: What the user should do.
        known: Whether the real release has it too, so that it is not a fault of this copy.
    """

    code: str
    severity: Severity
    scenario: str | None
    where: str
    what: str
    remedy: str
    known: bool = False

    def __str__(self) -> str:
        """Return one sentence: location, description, and remedy."""
        return f"{self.where}: {self.what}; {self.remedy}"


def finding_of(error: ReleaseError, code: str, scenario: str | None) -> Finding:
    """Convert a reader's error to a finding."""
    location, _, text = str(error).partition(": ")
    message, _, remedy = text.rpartition("; ")
    return _make_error_finding(scenario, code, location, message, remedy)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioScan:
    """Listing of a scenario's folders.

    Attributes:
        agents: Agents with calib files.
        has_meta: Whether the scenario has a meta file.
        labelled: Agents of `agents` with label files.
        num_frames: Highest frame number of any calib or label file.
        problems: Faults that break the scenario.
        notices: A sentence for each part that was ignored.
    """

    agents: tuple[AgentName, ...]
    has_meta: bool
    labelled: tuple[AgentName, ...]
    num_frames: int
    problems: tuple[Finding, ...]
    notices: tuple[str, ...]


def scan_scenario(scenario: ScenarioFolder) -> ScenarioScan:
    """List a scenario's calib and label folders, and check that each agent has all its frames."""
    problems: list[Finding] = []
    if scenario.token.encode(errors="replace") != os.fsencode(scenario.token):
        message = "the scenario's name is not UTF-8"
        remedy = "rename its folders and files"
        problems.append(
            _make_error_finding(scenario.token, "odd-name", scenario.meta_path, message, remedy)
        )
    frames = {}
    for agent in AGENTS:
        for kind, ending in SMALL_FILE_ENDINGS.items():
            frames[agent, kind] = _list_frames(scenario, agent, kind, ending, problems)
    agents = tuple(agent for agent in AGENTS if frames[agent, "calib"])
    notices = [
        f"{scenario.token}: {agent} has labels but no calib files and is excluded"
        for agent in AGENTS
        if frames[agent, "label"] and agent not in agents
    ]
    labelled = tuple(agent for agent in agents if frames[agent, "label"])
    has_meta = False
    with suppress(OSError):  # the folder may be unreadable
        has_meta = scenario.meta_path.exists()
    if labelled and not has_meta:
        notices.append(
            f"{scenario.meta_path}: missing or not readable, so the weather and collision of this "
            "scenario are unknown and find(collision=…) does not return it; use "
            "find(designed_accident=True), which goes by the folder"
        )
    num_frames = 0
    for agent in agents:
        for kind in SMALL_FILE_ENDINGS:
            num_frames = max([num_frames, *frames[agent, kind]])
    all_frames = set(range(1, num_frames + 1))
    for agent in agents:
        kinds = ("calib", "label") if agent in labelled else ("calib",)
        for kind in kinds:
            missing_frames = sorted(all_frames - set(frames[agent, kind]))
            if missing_frames:
                message = (
                    f"missing frames: {frame_ranges(missing_frames)} (expected 1 to {num_frames})"
                )
                folder = scenario.kind_folder(agent, kind)
                problems.append(
                    _make_error_finding(
                        scenario.token, "frames-missing", folder, message, _ARCHIVE_REMEDY
                    )
                )
    return ScenarioScan(
        agents=agents,
        has_meta=has_meta,
        labelled=labelled,
        num_frames=num_frames,
        problems=tuple(problems),
        notices=tuple(notices),
    )


def _list_frames(
    scenario: ScenarioFolder, agent: AgentName, kind: str, ending: str, problems: list[Finding]
) -> list[int]:
    """Return the frame numbers of an agent's files of a kind, and add faults to `problems`."""
    folder = scenario.kind_folder(agent, kind)
    try:
        frames, odd_names = frame_numbers(folder, ending)
    except ReleaseError as error:
        problems.append(finding_of(error, "folder-unreadable", scenario.token))
        return []
    message = f"expected a name {scenario.name}_<NNN>.{ending}"
    for name in odd_names:
        problems.append(
            _make_error_finding(scenario.token, "odd-name", folder / name, message, "rename it")
        )
    return frames


def _make_error_finding(
    scenario: str | None, code: str, path: ReleasePath | str, message: str, remedy: str
) -> Finding:
    return Finding(
        code=code,
        severity="error",
        scenario=scenario,
        where=str(path),
        what=message,
        remedy=remedy,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenarioFiles:
    """Contents of a scenario's small files.

    Attributes:
        scenario: Folders of the files.
        scan: Listing of the files.
        meta: Content of the meta file; None if the scenario has none.
        calibs: Calib of every sample, agent by agent.
        labels: Labels of every labelled sample, agent by agent.
        hashes: Hashes of the files' bytes, as in `content_hashes`.
    """

    scenario: ScenarioFolder
    scan: ScenarioScan
    meta: Meta | None
    calibs: Calibs
    labels: Labels
    hashes: str = ""

    @property
    def num_samples(self) -> int:
        """Number of samples: agents times frames."""
        return len(self.scan.agents) * self.scan.num_frames


def read_scenario(
    scenario: ScenarioFolder, scan: ScenarioScan
) -> tuple[ScenarioFiles | None, list[Finding]]:
    """Read a scenario's meta, calib and label files; return their contents and faults.

    The contents are None if any file has a fault. Only the first fault of each file is returned.
    """
    faults: list[Finding] = []

    def read_or_add_faults(read: Any, code: str, paths: list[ReleasePath]) -> Any:
        try:
            return read(paths)
        except ReleaseError as error:
            num_faults = len(faults)
            # The reader stops at the first fault, so read each file separately.
            if len(paths) > 1:
                for path in paths:
                    read_or_add_faults(read, code, [path])
            # Files may be valid separately, but not together.
            if len(faults) == num_faults:
                faults.append(finding_of(error, code, scenario.token))
            return None

    frames = range(1, scan.num_frames + 1)
    meta_paths = [scenario.meta_path] if scan.has_meta else []
    calib_paths = [scenario.calib_path(agent, frame) for agent in scan.agents for frame in frames]
    label_paths = [scenario.label_path(agent, frame) for agent in scan.labelled for frame in frames]
    contents: dict[str, bytes] = {}
    paths = [*meta_paths, *calib_paths, *label_paths]
    with fetched(paths), observed(lambda path, content: contents.update({str(path): content})):
        metas = read_or_add_faults(_read_metas, "meta-unreadable", meta_paths)
        calibs = read_or_add_faults(read_calibs, "calib-unreadable", calib_paths)
        labels = read_or_add_faults(read_labels, "label-unreadable", label_paths)
    if faults:
        return None, faults
    meta = metas[0] if metas else None
    hashes = content_hashes(scenario, contents)
    files = ScenarioFiles(
        scenario=scenario, scan=scan, meta=meta, calibs=calibs, labels=labels, hashes=hashes
    )
    return files, []


def _read_metas(paths: Sequence[ReleasePath]) -> list[Meta]:
    return [read_meta(path) for path in paths]


def folder_digest(scenarios: Iterable[ScenarioFolder], split_files: Iterable[ReleasePath]) -> str:
    """Return a digest of the states of folders and meta files, and of the contents of split files.

    The digest changes if a file is added, removed, renamed or replaced, even by a tool that
    restores all times, because no tool can restore a folder's ctime. It does not change if a label
    or calib file is overwritten in place, nor if files get hard links (which only changes the
    files' ctime). In a store, it changes with the list of the archives' members.
    """
    digest = hashlib.blake2b(digest_size=16)
    for scenario in scenarios:
        if isinstance(scenario.root, StorePath):
            state = f"{scenario.root.store.state} {scenario.folder}/{scenario.token}\n"
            digest.update(os.fsencode(state))
            continue
        root = os.fspath(scenario.root)
        base = os.path.join(root, scenario.folder, scenario.scenario_type)  # noqa: PTH118 - 7,000 of them at start
        digest.update(os.fsencode(f"{scenario.folder}/{scenario.token}\n"))
        for agent in AGENTS:
            for kind in SMALL_FILE_ENDINGS:
                folder = f"{base}/{agent}/{kind}/{scenario.name}"
                digest.update(_format_status(folder, ctime=True))
        digest.update(_format_status(f"{base}/meta", ctime=True))
        digest.update(_format_status(f"{base}/meta/{scenario.name}.txt"))
    for file in split_files:
        digest.update(os.fsencode(file.name))
        if isinstance(file, StorePath):
            digest.update(_format_status(file))
        else:
            digest.update(_read_content_or_fault(file, "split"))
    return digest.hexdigest()


def times_digest(
    scenario: ScenarioFolder,
    kinds: Iterable[str] = tuple(SMALL_FILE_ENDINGS),
    *,
    ctime: bool = True,
) -> str:
    """Return a digest of the names, sizes and times of a scenario's files (`kinds` and meta).

    No file is opened. With `ctime`, the digest changes with every change of a file, even if the
    file's time is restored, and also if a file gets a hard link.
    """
    digest = hashlib.blake2b(os.fsencode(f"{scenario.folder}/{scenario.token}"), digest_size=16)
    for agent, kind in product(AGENTS, kinds):
        # The folder may be missing.
        with suppress(OSError):
            entries = folder_entries(scenario.kind_folder(agent, kind))
            for entry in sorted(entries, key=attrgetter("name")):
                name = os.fsencode(f"{agent}/{kind}/{entry.name}")
                digest.update(name + _format_status(entry, ctime=ctime))
    digest.update(_format_status(scenario.meta_path, ctime=ctime))
    return digest.hexdigest()


def content_hashes(scenario: ScenarioFolder, known: Mapping[str, bytes] | None = None) -> str:
    """Return the hashes of a scenario's files (`ScenarioHashes`) as JSON.

    The text is empty if a folder cannot be listed.

    Args:
        scenario: Folders of the files.
        known: Path → bytes of files that were already read. The others are read now; for a file
            that cannot be read, the fault is hashed.
    """
    contents = known or {}

    def get_content(path: ReleasePath, kind: FileKind) -> bytes:
        content = contents.get(str(path))
        if content is None:
            return _read_content_or_fault(path, kind)
        return content

    try:
        hashes = folder_hashes(scenario, read=get_content)
    except ReleaseError:
        return ""
    return json.dumps(hashes.as_dict())


def _read_content_or_fault(path: ReleasePath, kind: FileKind) -> bytes:
    """Read a file's bytes; if it cannot be read, return the fault instead."""
    try:
        return read_bytes(path, kind)
    except OSError as error:
        return fault_text(error).encode()


def _format_status(path: ReleasePath | FolderEntry | str, *, ctime: bool = False) -> bytes:
    """Return the size and times of a path as one line of text."""
    try:
        # Opening a release passes 7,000 texts, for which os.stat is faster.
        status = os.stat(path) if isinstance(path, str) else path.stat()  # noqa: PTH116
    except OSError:
        return b" none\n"
    changed = getattr(status, "st_ctime_ns", 0) if ctime else 0
    return f" {status.st_size} {status.st_mtime_ns} {changed}\n".encode()


def frame_ranges(numbers: Sequence[int]) -> str:
    """Format ascending numbers as at most six ranges, such as `3–5, 9`."""
    ranges: list[list[int]] = []
    for number in numbers:
        if ranges and ranges[-1][1] == number - 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    words = []
    for first, last in ranges[:_MAX_RANGES]:
        words.append(f"{first}" if first == last else f"{first}–{last}")
    text = ", ".join(words)
    if len(ranges) > _MAX_RANGES:
        text += " …"
    return text
