"""What file names say of a scenario: its frames, missing files, and digests that change with any file."""

import hashlib
import os
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.release import ScenarioFolder
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.release.store import ReleasePath, StorePath, listed
from deepaccident_devkit.support.reading import FileKind, fault_text, read_bytes
from deepaccident_devkit.tables.findings import Finding, finding_of
from deepaccident_devkit.taxonomy import AGENTS, AgentName

ENDINGS = {"calib": "pkl", "label": "txt"}
"""Kind of small file → ending of its files."""
_FRAMES_NAMED = 6
_AnyPath: TypeAlias = ReleasePath | str
_REMEDY = "unpack its archive again, or leave the scenario out with on_error='skip'"


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
            f"{scenario.meta_path}: missing or not readable: weather and collision of this scenario are unknown"
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
    """A digest of name and content of every label, calib and meta file of a scenario.

    Args:
        scenario: where they lie.
        known: path → `content_words` of files that were read already; the others are read now.
    """
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
