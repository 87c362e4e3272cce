"""Where the files of a release lie (docs/format.md, Tree): folders of either layout, split files, missing files."""

from __future__ import annotations

import logging
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Final, get_args

from deepaccident_devkit.errors import (
    DatarootError,
    MissingFileError,
    SplitFileError,
    VersionError,
    shortened,
)
from deepaccident_devkit.release.store import (
    FolderEntry,
    ReleasePath,
    folder_entries,
    is_folder,
    leads_back,
    read_lines,
)
from deepaccident_devkit.release.store.members import (
    MINI_FOLDER,
    SCENARIO_TYPE,
    SPLIT_FILE_FOLDER,
    SPLIT_FILES,
    SPLIT_FOLDERS,
)
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.text import choice, spelled
from deepaccident_devkit.taxonomy import AGENTS, CHANNEL_FORMAT, VERSIONS, AgentName, OnError

_UNLISTABLE_REMEDY = "unpack its archive again, or make it readable"
_ABOVE_TYPES = (*SPLIT_FOLDERS, MINI_FOLDER)
_IN_TYPE = ("meta", *AGENTS)
_KINDS = ("calib", "label", *CHANNEL_FORMAT)
# The names that browsers, drives and people give to a copy, or to a part, of a folder of some names.
_COPY = r"(?:Copy of )?({})(?:\W.*|_*\d.*|_+(?i:copy|part|old|new|backup)\w*)?"
# Folders that the error of a release without scenarios names at most.
_MOST_ASIDE = 3
# A table that every version of nuScenes has.
NUSCENES_TABLE: Final = "scene.json"
_FRAME_FILE = re.compile(r"_(\d{3,})\.\w+")
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ScenarioFolder:
    """Where one scenario's files lie.

    Attributes:
        root: the release's folder.
        folder: the folder of layout B below the root that holds the scenario (`train`, …); empty in layout A.
        scenario_type: such as `type1_subtype1_accident`.
        name: such as `Town03_type001_subtype0001_scenario00024`.
        agents: the agents that have a calib folder, in the order of `taxonomy.AGENTS`.
    """

    root: ReleasePath
    folder: str
    scenario_type: str
    name: str
    agents: tuple[AgentName, ...]

    @property
    def token(self) -> str:
        """The scenario's token: a name alone occurs in several types."""
        return f"{self.scenario_type}/{self.name}"

    @property
    def meta_path(self) -> ReleasePath:
        """The scenario's meta file."""
        return self._below(f"meta/{self.name}.txt")

    def kind_folder(self, agent: str, kind: str) -> ReleasePath:
        """The folder of one kind of file (`label`, `calib` or a channel) of one agent."""
        return self._below(f"{agent}/{kind}/{self.name}")

    def file(self, agent: str, kind: str, frame: int, ending: str) -> ReleasePath:
        """One frame's file of a kind."""
        return self._below(f"{agent}/{kind}/{self.name}/{self.name}_{frame:03d}.{ending}")

    def _below(self, path: str) -> ReleasePath:
        place = f"{self.folder}/{self.scenario_type}" if self.folder else self.scenario_type
        return self.root / f"{place}/{path}"  # one join: a release has half a million files

    def label_path(self, agent: str, frame: int) -> ReleasePath:
        """One frame's label file."""
        return self.file(agent, "label", frame, "txt")

    def calib_path(self, agent: str, frame: int) -> ReleasePath:
        """One frame's calib file."""
        return self.file(agent, "calib", frame, "pkl")

    def channel_path(self, agent: str, channel: str, frame: int) -> ReleasePath:
        """One frame's image or array of a sensor channel."""
        return self.file(agent, channel, frame, CHANNEL_FORMAT[channel])


@dataclass(frozen=True, slots=True)
class ReleaseLayout(ShortRepr):
    """What lies under a dataroot, by the names of folders.

    Attributes:
        root: the dataroot.
        version: `v1` or `v1-mini`.
        layout: `A` (scenario types in the root), `B` (split folders) or `A+B`.
        scenarios: in the order of their tokens; a scenario that stands in two split folders occurs twice.
        split_files: split name → its file, where there is one.
    """

    root: ReleasePath
    version: str
    layout: str
    scenarios: tuple[ScenarioFolder, ...]
    split_files: Mapping[str, ReleasePath] = field(default_factory=dict)


def find_release(root: ReleasePath, version: str = "v1") -> ReleaseLayout:
    """Find the scenarios under `root`, which `open_dataroot` gives, by listing folders; opens no file.

    Raises:
        DatarootError: the folder is missing or holds no release.
        VersionError: the version is unknown or not under this folder.
    """
    version = spelled(version, VERSIONS)
    if version not in VERSIONS:
        raise VersionError(
            f"unknown version {version!r}; known are {', '.join(VERSIONS)}{_version_remedy(version)}"
        )
    try:
        str(root).encode()
    except UnicodeEncodeError:
        raise DatarootError(
            f"{str(root)!r}: is not UTF-8, which Arrow needs a path to be; rename the folder"
        ) from None
    if not root.is_dir():
        missing = "is a link that leads nowhere" if os.path.islink(str(root)) else "does not exist"  # noqa: PTH114
        state = "is a file" if root.is_file() else missing
        raise DatarootError(
            f"{root}: {state}; give the folder that the release was unpacked into as dataroot"
        )
    folders = _folders_of(root, version)
    scenarios = [scenario for folder in folders for scenario in _scenarios_in(root, folder)]
    if not scenarios:
        if isinstance(root, Path) and nuscenes_tables(root):
            raise DatarootError(
                f"{root}: is a dataroot of nuScenes; open it with nuscenes.open_nuscenes"
            )
        aside = (
            f"; it is of one scenario type: give {root.parent}"
            if SCENARIO_TYPE.fullmatch(root.name)
            else ""
        )
        aside += "".join(
            f"; {path} {f'looks like {meant}: rename it' if meant else 'is a link that leads nowhere'}"
            for path, meant in islice(left_aside(root), _MOST_ASIDE)
        )
        raise DatarootError(
            f"{root}: no scenario found{aside}; expected <scenario_type>/<agent>/calib/<scenario>/*.pkl below it, or "
            f"below its folders {', '.join((*SPLIT_FOLDERS, MINI_FOLDER))} "
            "(unpack the calib archives, give a folder of zips alone, or make a small release with: deepaccident synth "
            "OUT)"
        )
    return ReleaseLayout(
        root=root,
        version=version,
        layout="+".join(["A"] * ("" in folders) + ["B"] * any(folders)),
        scenarios=tuple(sorted(scenarios, key=attrgetter("token", "folder"))),
        split_files=_split_files(root),
    )


def nuscenes_tables(dataroot: str | os.PathLike[str]) -> Path | None:
    """The folder of nuScenes' tables in a dataroot, or this folder itself; None where there is none.

    Raises VersionError: the dataroot has several versions; give the folder of one.
    """
    given = Path(dataroot)
    tables = (given / NUSCENES_TABLE, *given.glob(f"v1.0*/{NUSCENES_TABLE}"))
    found = sorted(table.parent for table in tables if table.is_file())
    if len(found) > 1:
        raise VersionError(
            f"{given}: has several versions of nuScenes; give the folder of one, such as {found[0]}"
        )
    return found[0].absolute() if found else None


def _version_remedy(version: object) -> str:
    """What to write where a folder, or a version of nuScenes, was given as the version."""
    text = os.fspath(version) if isinstance(version, os.PathLike) else str(version)
    if os.path.isdir(text) or os.sep in text or text.startswith(("~", ".")):  # noqa: PTH112 - odd texts are no folder
        return f"; to open the folder, write DeepAccident(dataroot={text!r})"
    if text.lower().startswith("v1"):
        return f"; did you mean {'v1-mini' if text.lower().endswith('mini') else 'v1'!r}?"
    return ""


def frame_numbers(folder: ReleasePath, ending: str) -> tuple[list[int], list[str]]:
    """The frame numbers of a folder's files, ascending, and the names with that ending but without a frame number.

    A folder that is not there has none; one that cannot be listed, or a file in its place, raises DatarootError.
    """
    frames, odd = [], []
    for number, entry in _frame_entries(folder, _entries(folder), ending):
        if number is None:
            odd.append(entry.name)
        else:
            frames.append(number)
    return sorted(frames), sorted(odd)


def frame_sizes(folder: ReleasePath, ending: str) -> dict[int, int]:
    """Frame number → bytes of a folder's files of frames, ascending, by one look into it; raises DatarootError.

    A folder that is not there, or with a file in its place, has none; a link to nothing is no file.
    """
    sizes = {}
    for number, entry in _frame_entries(folder, _entries(folder, files=True), ending):
        with suppress(OSError):
            if number is not None:
                sizes[number] = entry.stat().st_size
    return dict(sorted(sizes.items()))


def _frame_entries(
    folder: ReleasePath, entries: Iterable[FolderEntry], ending: str
) -> Iterator[tuple[int | None, FolderEntry]]:
    """A folder's entries with an ending, each with its frame number; None if the name has none."""
    stem = folder.name
    for entry in entries:
        name = entry.name
        if not name.endswith(f".{ending}") or name.startswith("."):
            continue
        match = _FRAME_FILE.fullmatch(name, len(stem)) if name.startswith(stem) else None
        number = int(match[1]) if match and match[1] == f"{int(match[1]):03d}" else None
        yield number or None, entry


def names_without_calib(layout: ReleaseLayout) -> Iterator[tuple[ReleasePath, str]]:
    """Scenario type folders and the names in them that have labels, meta or sensor files, but no calib of any agent.

    Folders that cannot be listed have none; each scenario of theirs tells that itself.
    """
    known: dict[ReleasePath, set[str]] = {}
    for scenario in layout.scenarios:
        known.setdefault(scenario.root / scenario.folder / scenario.scenario_type, set()).add(
            scenario.name
        )
    for folder, names in known.items():
        found: set[str] = set()
        with suppress(DatarootError):
            found = {
                entry.name[:-4]
                for entry in _entries(folder / "meta")
                if entry.name.endswith(".txt")
            }
        for agent in AGENTS:
            for kind in ("label", *CHANNEL_FORMAT):
                with suppress(DatarootError):
                    found.update(_subfolders(folder / agent / kind))
        for name in sorted(found - names):
            yield folder, name


def left_aside(root: ReleasePath) -> Iterator[tuple[ReleasePath, str | None]]:
    """What lies in a release and is not read, though it looks as if it should be.

    Each folder with a name that only looks like one of the release (downloads are unpacked beside each other as `…
    (1)`, `…-001`), and what it looks like; each link that leads nowhere or back, and None.
    """
    splits = [root / name for name in _subfolders(root) if name in _ABOVE_TYPES]
    yield from _aside_in(root, (SCENARIO_TYPE.pattern, *_ABOVE_TYPES))
    for folder in splits:
        yield from _aside_in(folder, (SCENARIO_TYPE.pattern,))
    for of_type in (
        folder / name for folder in (root, *splits) for name in _scenario_types(folder)
    ):
        yield from _aside_in(of_type, _IN_TYPE)
        for agent in (of_type / name for name in _subfolders(of_type) if name in AGENTS):
            yield from _aside_in(agent, _KINDS)
            for kind in (name for name in _subfolders(agent) if name in _KINDS):
                yield from _aside_in(agent / kind, ())


def _aside_in(
    folder: ReleasePath, known: Sequence[str]
) -> Iterator[tuple[ReleasePath, str | None]]:
    """What `left_aside` tells of one folder, in which these names (patterns) are read; of others only links."""
    entries: list[FolderEntry] = []
    with suppress(DatarootError):  # told where its scenarios are read
        entries = _entries(folder, files=True)
    for entry in sorted(entries, key=lambda entry: entry.name):
        path, found = folder / entry.name, re.fullmatch(_COPY.format("|".join(known)), entry.name)
        if leads_back(entry):
            yield path, None
        elif (
            not known
            or entry.name.startswith(".")
            or not is_folder(entry)
            or (found and found[1] == entry.name)
        ):
            continue
        elif found and (found[1] not in _ABOVE_TYPES or _holds_types(path)):
            yield path, found[1]
        elif known is _IN_TYPE and {"calib", "label"}.intersection(_subfolders(path)):
            yield path, f"an agent, of which the release has {', '.join(AGENTS)}"


def _holds_types(folder: ReleasePath) -> bool:
    """Whether scenario types lie in a folder, or in a split folder in it."""
    return any(
        SCENARIO_TYPE.match(name)
        for below in ("", *_ABOVE_TYPES)
        for name in _subfolders(folder / below)
    )


def _folders_of(root: ReleasePath, version: str) -> list[str]:
    """The folders below the root, `""` for the root itself, that hold scenario types of this version."""
    flat = [""] if _scenario_types(root) else []
    split = [
        name for name in _subfolders(root) if name in _ABOVE_TYPES and _scenario_types(root / name)
    ]
    mini = [split.pop(split.index(MINI_FOLDER))] if MINI_FOLDER in split else []
    root_is_mini = root.resolve().name == MINI_FOLDER
    if version == "v1":
        return flat + split or mini
    if root_is_mini and flat:
        return flat
    if not mini and (flat or split):
        raise VersionError(
            f"{root}: holds no mini release (folder {MINI_FOLDER}); open it with version='v1'"
        )
    return mini


def _scenario_types(folder: ReleasePath) -> list[str]:
    return sorted(filter(SCENARIO_TYPE.fullmatch, _subfolders(folder)))


def _scenarios_in(root: ReleasePath, folder: str) -> Iterator[ScenarioFolder]:
    for scenario_type in _scenario_types(root / folder):
        _entries(
            root / folder / scenario_type
        )  # one that cannot be listed would hide its scenarios
        agents_of: dict[str, list[AgentName]] = {}
        closed: DatarootError | None = None
        for agent in AGENTS:
            try:
                names = _subfolders(root / folder / scenario_type / agent / "calib", loops=True)
            except DatarootError as error:  # scenarios that other agents name report this themselves when they are read
                closed, names = error, []
            for name in names:
                agents_of.setdefault(name, []).append(agent)
        if closed and not agents_of:
            raise closed
        for name, agents in agents_of.items():
            yield ScenarioFolder(root, folder, scenario_type, name, tuple(agents))


def _subfolders(folder: ReleasePath, *, loops: bool = False) -> list[str]:
    """The folders in a folder; none where a file is in the way, which `frame_numbers` reports for each scenario.

    With `loops`, so are links to themselves, which `frame_numbers` reports, too.
    """
    entries = _entries(folder, files=True)
    return [
        entry.name
        for entry in entries
        if not entry.name.startswith(".") and is_folder(entry, loops=loops)
    ]


def _entries(folder: ReleasePath, *, files: bool = False) -> list[FolderEntry]:
    """What lies in a folder; nothing if there is no such folder, nor, with `files`, if a file is in its place."""
    try:
        return folder_entries(folder)
    except OSError as error:
        if isinstance(error, FileNotFoundError) or (
            files and isinstance(error, NotADirectoryError)
        ):
            return []
        raise DatarootError(
            f"{folder}: cannot be listed ({error.strerror}); {_UNLISTABLE_REMEDY}"
        ) from error


def read_split_file(path: ReleasePath, *, raw: bool = False, unique: bool = False) -> list[str]:
    """The scenarios of a split file, in its order, each once, as tokens `<scenario_type>/<scenario>`.

    Blank lines, blanks at line ends and CRLF are read. A name that is not UTF-8 is as the system gives those of files.

    Args:
        path: the file.
        raw: keep scenarios that stand in several lines as often.
        unique: a scenario in two lines is an error; if not set, it counts once.

    Raises:
        MissingFileError: there is no such file.
        SplitFileError: a line has not two words, the file is no text, or a scenario stands twice and `unique` is set.
    """
    remedy = "restore it from the release"
    lines = read_lines(path, "split", SplitFileError, remedy, errors="surrogateescape")
    if any("\0" in line for line in lines):
        raise SplitFileError(f"{path}: not a text file; {remedy}")
    words = [
        (number, tuple(line.split(maxsplit=2)))
        for number, line in enumerate(lines, start=1)
        if line.strip()
    ]
    for number, line_words in words:
        if len(line_words) != 2:
            raise SplitFileError(
                f"{path}:{number}: expected '<scenario_type> <scenario>', found {shortened(' '.join(line_words))!r}; "
                "mend or remove the line"
            )
    first_line: dict[tuple[str, ...], int] = {}
    for number, line_words in words if unique else ():
        if line_words in first_line:
            raise SplitFileError(
                f"{path}:{number}: {shortened(' '.join(line_words))!r} stands in line {first_line[line_words]} "
                "already; remove one of the two lines"
            )
        first_line[line_words] = number
    tokens = ["/".join(line_words) for _, line_words in words]
    return tokens if raw else list(dict.fromkeys(tokens))


def write_split_file(path: Path, scenario_tokens: Sequence[str]) -> None:
    """Write scenario tokens, one line each."""
    lines = [
        f"{scenario_type} {name}\n"
        for scenario_type, name in (token.split("/") for token in scenario_tokens)
    ]
    write_bytes(path, "".join(lines).encode())


class MissingFiles:
    """Asks for sensor files, and counts by channel those that are not there (`on_missing='skip'`)."""

    def __init__(self, root: ReleasePath, on_missing: OnError = "raise") -> None:
        """Files below a release's folder; raises ChoiceError."""
        self._root = root
        self._skips = choice("on_missing", on_missing, get_args(OnError)) == "skip"
        self._asked: Counter[str] = Counter()
        self._missing: Counter[str] = Counter()

    def has(self, path: ReleasePath, channel: str) -> bool:
        """Whether a file is there, to be read; raises MissingFileError if it is not and nothing may be left out."""
        self._asked[channel] += 1
        if path.exists():
            return True
        if not self._skips:
            raise MissingFileError(
                f"{path}: no such file; unpack the archive that holds it, or leave out what is missing with "
                "on_missing='skip'"
            )
        self._missing[channel] += 1
        return False

    def tell(self) -> None:
        """Log one warning with the number of files that were left out, if any."""
        if self._missing:
            counts = ", ".join(
                f"{self._missing[name]} of {self._asked[name]} of {name}" for name in self._missing
            )
            _logger.warning("left out files that are not in %s: %s", self._root, counts)


def _split_files(root: ReleasePath) -> dict[str, ReleasePath]:
    found: dict[str, ReleasePath] = {}
    for name in SPLIT_FILES:
        for folder in (root, root / SPLIT_FILE_FOLDER):
            path = folder / name
            there = os.path.lexists(path) if isinstance(path, Path) else path.is_file()
            if there and not path.is_dir():  # a pipe, or a link to itself, is the reader's error
                found[path.stem] = path
                break
    return found
