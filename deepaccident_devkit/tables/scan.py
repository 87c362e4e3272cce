"""A scenario's small files: which there are, what is in them and what is wrong with them; digests that tell changes."""

import hashlib
import os
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.release import Calibs, Labels, Meta, ScenarioFolder, read_calibs, read_labels, read_meta
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.release.store import ReleasePath, StorePath, fetched, listed
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.reading import FileKind, fault_text, read_bytes
from deepaccident_devkit.taxonomy import AGENTS, AgentName

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Worst first: `error` cannot be indexed or cannot be true, `warning` is probably wrong, `note` is worth knowing."""
ENDINGS = {"calib": "pkl", "label": "txt"}
"""Kind of small file → ending of its files."""
_FRAMES_NAMED = 6
_AnyPath: TypeAlias = ReleasePath | str
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
    return Finding(code=code, severity="error", scenario=scenario, where=where, what=what, remedy=remedy)


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
    frames = {
        (agent, kind): _frames(scenario, agent, kind, ending, problems)
        for agent in AGENTS
        for kind, ending in ENDINGS.items()
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
    num_frames = max((found[-1] for (agent, _), found in frames.items() if found and agent in agents), default=0)
    for agent in agents:
        for kind in ("calib", "label") if agent in labelled else ("calib",):
            missing = sorted(set(range(1, num_frames + 1)) - set(frames[agent, kind]))
            if missing:
                what = f"lacks frames {frame_ranges(missing)} of 1 to {num_frames}"
                problems.append(_broken(scenario, "frames-missing", scenario.kind_folder(agent, kind), what, _REMEDY))
    return ScenarioScan(
        agents=agents,
        has_meta=has_meta,
        labelled=labelled,
        num_frames=num_frames,
        problems=tuple(problems),
        notices=tuple(notices),
    )


def _frames(scenario: ScenarioFolder, agent: AgentName, kind: str, ending: str, problems: list[Finding]) -> list[int]:
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


def _broken(scenario: ScenarioFolder, code: str, where: ReleasePath, what: str, remedy: str) -> Finding:
    return Finding(code=code, severity="error", scenario=scenario.token, where=str(where), what=what, remedy=remedy)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenarioFiles:
    """The small files of a scenario, read.

    Attributes:
        scenario: where they lie.
        scan: which there are.
        meta: None if the scenario has none.
        calibs: of every sample, agent by agent.
        labels: of every labelled sample, agent by agent.
    """

    scenario: ScenarioFolder
    scan: ScenarioScan
    meta: Meta | None
    calibs: Calibs
    labels: Labels

    @property
    def num_samples(self) -> int:
        """Agents times frames."""
        return len(self.scan.agents) * self.scan.num_frames


def read_scenario(scenario: ScenarioFolder, scan: ScenarioScan) -> tuple[ScenarioFiles | None, list[Finding]]:
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
    with fetched([*meta_paths, *calib_paths, *label_paths]):
        metas = attempt(_read_metas, "meta-unreadable", meta_paths)
        calibs = attempt(read_calibs, "calib-unreadable", calib_paths)
        labels = attempt(read_labels, "label-unreadable", label_paths)
    if faults:
        return None, faults
    meta = metas[0] if metas else None
    return ScenarioFiles(scenario=scenario, scan=scan, meta=meta, calibs=calibs, labels=labels), []


def _read_metas(paths: Sequence[ReleasePath]) -> list[Meta]:
    return [read_meta(path) for path in paths]


def folder_digest(scenarios: Iterable[ScenarioFolder], files: Iterable[ReleasePath]) -> str:
    """A digest of the times of the scenarios' calib and label folders and of some files; opens none of them.

    It changes when a file is added, removed or renamed, not when one is edited in place; in a store, when an archive
    changes.
    """
    digest = hashlib.blake2b(digest_size=16)
    for scenario in scenarios:
        if isinstance(scenario.root, StorePath):
            digest.update(os.fsencode(f"{scenario.root.store.state} {scenario.folder}/{scenario.token}\n"))
            continue
        root = os.fspath(scenario.root)
        base = os.path.join(root, scenario.folder, scenario.scenario_type)  # noqa: PTH118 - 7,000 of them at start
        digest.update(os.fsencode(f"{scenario.folder}/{scenario.token}\n"))
        paths = [f"{base}/{agent}/{kind}/{scenario.name}" for agent in AGENTS for kind in ("calib", "label")]
        for path in [*paths, f"{base}/meta/{scenario.name}.txt"]:
            digest.update(_stat_words(path))
    for file in files:
        digest.update(os.fsencode(file.name) + _stat_words(file))
    return digest.hexdigest()


def times_digest(scenario: ScenarioFolder) -> str:
    """A digest of name, size and time of every label, calib and meta file of a scenario; opens none of them."""
    return _digest(scenario, lambda path, _kind: _stat_words(path))


def contents_digest(scenario: ScenarioFolder, known: Mapping[str, bytes] | None = None) -> str:
    """A digest of names and contents of a scenario's small files; of those read already, `content_words` are given."""
    found = known or {}
    return _digest(scenario, lambda path, kind: found.get(str(path)) or _words_of_file(path, kind))


def content_words(content: bytes) -> bytes:
    """What a file's content adds to `contents_digest`; a CRC, as it tells damage at a tenth of a hash's time."""
    return f" {len(content)} {zlib.crc32(content):08x}\n".encode()


def _digest(scenario: ScenarioFolder, words_of: Callable[[_AnyPath, FileKind], bytes]) -> str:
    """A digest of where a scenario lies, and of each small file's name and what `words_of` its path and kind gives."""
    digest = hashlib.blake2b(os.fsencode(f"{scenario.folder}/{scenario.token}"), digest_size=16)
    kinds: tuple[FileKind, ...] = ("calib", "label")
    for agent in AGENTS:
        for kind in kinds:
            folder = scenario.kind_folder(agent, kind)
            for name in _names(folder):
                digest.update(os.fsencode(f"{agent}/{kind}/{name}") + words_of(_below(folder, name), kind))
    digest.update(words_of(scenario.meta_path, "meta"))
    return digest.hexdigest()


def _words_of_file(path: _AnyPath, kind: FileKind) -> bytes:
    try:
        return content_words(read_bytes(Path(path) if isinstance(path, str) else path, kind))
    except OSError as error:
        return f" {fault_text(error)}\n".encode()


def _names(folder: ReleasePath) -> list[str]:
    try:
        return sorted(entry.name for entry in listed(folder))
    except OSError:
        return []


def _below(folder: ReleasePath, name: str) -> _AnyPath:
    """A file in a folder; a text, as there are a million of them."""
    return f"{folder}{os.sep}{name}" if isinstance(folder, Path) else folder / name


def _stat_words(path: _AnyPath) -> bytes:
    try:
        found = path.stat() if isinstance(path, StorePath) else os.stat(path)  # noqa: PTH116 - texts, as above
    except OSError:
        return b" none\n"
    return f" {found.st_size} {found.st_mtime_ns}\n".encode()


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
    words = [f"{first}" if first == last else f"{first}–{last}" for first, last in runs[:_FRAMES_NAMED]]
    return ", ".join(words) + (" …" if len(runs) > _FRAMES_NAMED else "")
