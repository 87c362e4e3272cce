"""A scenario's small files: which there are, what is in them and what is wrong with them; digests that tell changes."""

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
"""Worst first: `error` cannot be indexed or cannot be true, `warning` is probably wrong, `note` is worth knowing."""
SMALL_FILE_ENDINGS = {"calib": "pkl", "label": "txt"}
"""Kind of small file → ending of its files."""
_FRAMES_NAMED = 6
_REMEDY = "unpack its archive again, or leave the scenario out with on_error='skip'"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding(ShortRepr):
    """One thing that is wrong, odd or missing.

    Attributes:
        code: its kind, such as `label-unreadable`; `validation.CODES` has all.
        severity: how bad it is.
        scenario: token of the scenario; None where the release as a whole is meant.
        where: the file (with the line), the folder, or the agents and actors.
        what: what is wrong there.
        remedy: what to do.
        known: whether the real release has it too; then it is no fault of this copy.
    """

    code: str
    severity: Severity
    scenario: str | None
    where: str
    what: str
    remedy: str
    known: bool = False

    def __str__(self) -> str:
        """One sentence: where, what, and the remedy."""
        return f"{self.where}: {self.what}; {self.remedy}"


def finding_of(error: ReleaseError, code: str, scenario: str | None) -> Finding:
    """The finding that a reader's error tells of; its text is the error's."""
    where, _, rest = str(error).partition(": ")
    what, _, remedy = rest.rpartition("; ")
    return Finding(
        code=code, severity="error", scenario=scenario, where=where, what=what, remedy=remedy
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioScan:
    """What a scenario's folders hold.

    Attributes:
        agents: the agents with calib files.
        has_meta: whether there is a meta file.
        labelled: those of them with label files.
        num_frames: the highest frame number of any of their files.
        problems: what makes the scenario broken.
        notices: what was left aside, a sentence each.
    """

    agents: tuple[AgentName, ...]
    has_meta: bool
    labelled: tuple[AgentName, ...]
    num_frames: int
    problems: tuple[Finding, ...]
    notices: tuple[str, ...]


def scan_scenario(scenario: ScenarioFolder) -> ScenarioScan:
    """List a scenario's calib and label folders and check that they hold frames 1 to n for every agent."""
    problems: list[Finding] = []
    if scenario.token.encode(errors="replace") != os.fsencode(scenario.token):
        what, remedy = "the scenario's name is not UTF-8", "rename its folders and files"
        problems.append(_broken(scenario, "odd-name", scenario.meta_path, what, remedy))
    frames = {
        (agent, kind): _frames(scenario, agent, kind, ending, problems)
        for agent in AGENTS
        for kind, ending in SMALL_FILE_ENDINGS.items()
    }
    agents = tuple(agent for agent in AGENTS if frames[agent, "calib"])
    notices = [
        f"{scenario.token}: {agent} has labels but no calib files and is left out"
        for agent in AGENTS
        if frames[agent, "label"] and agent not in agents
    ]
    labelled = tuple(agent for agent in agents if frames[agent, "label"])
    has_meta = _is_there(scenario.meta_path)
    if labelled and not has_meta:
        notices.append(
            f"{scenario.meta_path}: missing or not readable: weather and collision of this scenario are unknown, "
            "and find(collision=…) leaves it out; find(designed_accident=True) goes by its folder"
        )
    num_frames = max(
        (found[-1] for (agent, _), found in frames.items() if found and agent in agents), default=0
    )
    for agent in agents:
        for kind in ("calib", "label") if agent in labelled else ("calib",):
            missing = sorted(set(range(1, num_frames + 1)) - set(frames[agent, kind]))
            if missing:
                what = f"lacks frames {frame_ranges(missing)} of 1 to {num_frames}"
                problems.append(
                    _broken(
                        scenario, "frames-missing", scenario.kind_folder(agent, kind), what, _REMEDY
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


def _frames(
    scenario: ScenarioFolder, agent: AgentName, kind: str, ending: str, problems: list[Finding]
) -> list[int]:
    """The frame numbers of an agent's files of a kind; what is wrong with the folder goes to `problems`."""
    folder = scenario.kind_folder(agent, kind)
    try:
        frames, odd = frame_numbers(folder, ending)
    except ReleaseError as error:
        problems.append(finding_of(error, "folder-unreadable", scenario.token))
        return []
    what = f"expected a name {scenario.name}_<NNN>.{ending}"
    problems += [_broken(scenario, "odd-name", folder / name, what, "rename it") for name in odd]
    return frames


def _broken(
    scenario: ScenarioFolder, code: str, where: ReleasePath, what: str, remedy: str
) -> Finding:
    return Finding(
        code=code,
        severity="error",
        scenario=scenario.token,
        where=str(where),
        what=what,
        remedy=remedy,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenarioFiles:
    """The small files of a scenario, read.

    Attributes:
        scenario: where they lie.
        scan: which there are.
        meta: None if the scenario has none.
        calibs: of every sample, agent by agent.
        labels: of every labelled sample, agent by agent.
        hashes: of the files' bytes, as of `content_hashes`.
    """

    scenario: ScenarioFolder
    scan: ScenarioScan
    meta: Meta | None
    calibs: Calibs
    labels: Labels
    hashes: str = ""

    @property
    def num_samples(self) -> int:
        """Agents times frames."""
        return len(self.scan.agents) * self.scan.num_frames


def read_scenario(
    scenario: ScenarioFolder, scan: ScenarioScan
) -> tuple[ScenarioFiles | None, list[Finding]]:
    """A scenario's meta, calib and label files, None if there is a fault; and the faults, the first of every file."""
    faults: list[Finding] = []

    def attempt(read: Any, code: str, paths: list[ReleasePath]) -> Any:
        try:
            return read(paths)
        except ReleaseError as error:
            if len(paths) == 1:
                faults.append(finding_of(error, code, scenario.token))
            else:
                known = len(faults)
                for path in paths:  # each by itself: the reader stops at the first
                    attempt(read, code, [path])
                if len(faults) == known:  # good alone, and not together
                    faults.append(finding_of(error, code, scenario.token))
            return None

    frames = range(1, scan.num_frames + 1)
    meta_paths = [scenario.meta_path] if scan.has_meta else []
    calib_paths = [scenario.calib_path(agent, n) for agent in scan.agents for n in frames]
    label_paths = [scenario.label_path(agent, n) for agent in scan.labelled for n in frames]
    contents: dict[str, bytes] = {}
    paths = [*meta_paths, *calib_paths, *label_paths]
    with fetched(paths), observed(lambda path, content: contents.update({str(path): content})):
        metas = attempt(_read_metas, "meta-unreadable", meta_paths)
        calibs = attempt(read_calibs, "calib-unreadable", calib_paths)
        labels = attempt(read_labels, "label-unreadable", label_paths)
    if faults:
        return None, faults
    meta = metas[0] if metas else None
    hashes = content_hashes(scenario, contents)
    return ScenarioFiles(
        scenario=scenario, scan=scan, meta=meta, calibs=calibs, labels=labels, hashes=hashes
    ), []


def _read_metas(paths: Sequence[ReleasePath]) -> list[Meta]:
    return [read_meta(path) for path in paths]


def folder_digest(scenarios: Iterable[ScenarioFolder], split_files: Iterable[ReleasePath]) -> str:
    """Return a digest of the states of the scenarios' folders and meta files, and of the contents of split files.

    It changes when a file is added, removed, renamed or replaced, also by a tool that puts all times back, for none can
    put back a folder's ctime. It does not change when a label or calib file is written in place, nor when files get
    hard links, which change the ctime of a file. In a store it changes with the list of the archives' members.
    """
    digest = hashlib.blake2b(digest_size=16)
    for scenario in scenarios:
        if isinstance(scenario.root, StorePath):
            digest.update(
                os.fsencode(f"{scenario.root.store.state} {scenario.folder}/{scenario.token}\n")
            )
            continue
        root = os.fspath(scenario.root)
        base = os.path.join(root, scenario.folder, scenario.scenario_type)  # noqa: PTH118 - 7,000 of them at start
        digest.update(os.fsencode(f"{scenario.folder}/{scenario.token}\n"))
        folders = [
            f"{base}/{agent}/{kind}/{scenario.name}"
            for agent in AGENTS
            for kind in SMALL_FILE_ENDINGS
        ]
        for path in [*folders, f"{base}/meta"]:
            digest.update(_stat_words(path, ctime=True))
        digest.update(_stat_words(f"{base}/meta/{scenario.name}.txt"))
    for file in split_files:
        digest.update(os.fsencode(file.name))
        digest.update(
            _stat_words(file) if isinstance(file, StorePath) else _content_or_fault(file, "split")
        )
    return digest.hexdigest()


def times_digest(
    scenario: ScenarioFolder,
    kinds: Iterable[str] = tuple(SMALL_FILE_ENDINGS),
    *,
    ctime: bool = True,
) -> str:
    """Return a digest of the names, sizes and times of a scenario's files of some kinds, and of meta; opens none.

    With `ctime` it changes with whatever is done to a file, also if its time is put back, and if it gets a hard link.
    """
    digest = hashlib.blake2b(os.fsencode(f"{scenario.folder}/{scenario.token}"), digest_size=16)
    for agent, kind in product(AGENTS, kinds):
        with suppress(OSError):  # no such folder
            for entry in sorted(
                folder_entries(scenario.kind_folder(agent, kind)), key=attrgetter("name")
            ):
                digest.update(
                    os.fsencode(f"{agent}/{kind}/{entry.name}") + _stat_words(entry, ctime=ctime)
                )
    digest.update(_stat_words(scenario.meta_path, ctime=ctime))
    return digest.hexdigest()


def content_hashes(scenario: ScenarioFolder, known: Mapping[str, bytes] | None = None) -> str:
    """Return the hashes of a scenario's files (`ScenarioHashes`) as JSON; empty if a folder cannot be listed.

    Args:
        scenario: where the files lie.
        known: path → bytes of files that were read before. The others are read now; of a file that cannot be read, the
            fault counts.
    """
    contents = known or {}

    def read(path: ReleasePath, kind: FileKind) -> bytes:
        content = contents.get(str(path))
        return _content_or_fault(path, kind) if content is None else content

    try:
        return json.dumps(folder_hashes(scenario, read=read).as_dict())
    except ReleaseError:
        return ""


def _content_or_fault(path: ReleasePath, kind: FileKind) -> bytes:
    try:
        return read_bytes(path, kind)
    except OSError as error:
        return fault_text(error).encode()


def _stat_words(path: ReleasePath | FolderEntry | str, *, ctime: bool = False) -> bytes:
    try:
        status = os.stat(path) if isinstance(path, str) else path.stat()  # noqa: PTH116 - there are 7,000 texts at start
    except OSError:
        return b" none\n"
    changed = getattr(status, "st_ctime_ns", 0) if ctime else 0
    return f" {status.st_size} {status.st_mtime_ns} {changed}\n".encode()


def _is_there(path: ReleasePath) -> bool:
    try:
        return path.exists()
    except OSError:  # its folder is closed
        return False


def frame_ranges(numbers: Sequence[int]) -> str:
    """`3–5, 9`: runs of consecutive numbers, the first few."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and runs[-1][1] == number - 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    words = [
        f"{first}" if first == last else f"{first}–{last}" for first, last in runs[:_FRAMES_NAMED]
    ]
    return ", ".join(words) + (" …" if len(runs) > _FRAMES_NAMED else "")
