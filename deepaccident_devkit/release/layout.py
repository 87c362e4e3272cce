"""Paths of a release's files (docs/format.md, Tree): folders, split files, missing files."""

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
_SPLIT_NAMES = (*SPLIT_FOLDERS, MINI_FOLDER)
_TYPE_SUBFOLDERS = ("meta", *AGENTS)
_KINDS = ("calib", "label", *CHANNEL_FORMAT)
# Names that browsers, drives and people use for a copy, or for a part, of a folder with one of some
# names.
_COPY_PATTERN = r"(?:Copy of )?({})(?:\W.*|_*\d.*|_+(?i:copy|part|old|new|backup)\w*)?"
# The error of a release without scenarios names at most this number of folders.
_MAX_NAMED_FOLDERS = 3
# A table that every version of nuScenes has.
NUSCENES_TABLE: Final = "scene.json"
_FRAME_FILE = re.compile(r"_(\d{3,})\.\w+")
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ScenarioFolder:
    """Folders of one scenario's files.

    Attributes:
        root: Folder of the release.
        folder: Folder of layout B below the root that holds the scenario (`train`, …); empty in
            layout A.
        scenario_type: Scenario type, such as `type1_subtype1_accident`.
        name: Name of the scenario, such as `Town03_type001_subtype0001_scenario00024`.
        agents: Agents that have a calib folder, in the order of `taxonomy.AGENTS`.
    """

    root: ReleasePath
    folder: str
    scenario_type: str
    name: str
    agents: tuple[AgentName, ...]

    @property
    def token(self) -> str:
        """Token of the scenario: its name may occur in several types."""
        return f"{self.scenario_type}/{self.name}"

    @property
    def meta_path(self) -> ReleasePath:
        """Meta file of the scenario."""
        return self._path(f"meta/{self.name}.txt")

    def kind_folder(self, agent: str, kind: str) -> ReleasePath:
        """Return the folder of one kind of file (`label`, `calib` or a channel) of one agent."""
        return self._path(f"{agent}/{kind}/{self.name}")

    def file(self, agent: str, kind: str, frame: int, ending: str) -> ReleasePath:
        """Return one frame's file of a kind."""
        return self._path(f"{agent}/{kind}/{self.name}/{self.name}_{frame:03d}.{ending}")

    def _path(self, relative: str) -> ReleasePath:
        """Return a path below the folder of the scenario's type."""
        folder = f"{self.folder}/{self.scenario_type}" if self.folder else self.scenario_type
        return self.root / f"{folder}/{relative}"  # one join: a release has half a million files

    def label_path(self, agent: str, frame: int) -> ReleasePath:
        """Return one frame's label file."""
        return self.file(agent, "label", frame, "txt")

    def calib_path(self, agent: str, frame: int) -> ReleasePath:
        """Return one frame's calib file."""
        return self.file(agent, "calib", frame, "pkl")

    def channel_path(self, agent: str, channel: str, frame: int) -> ReleasePath:
        """Return one frame's image or array of a sensor channel."""
        return self.file(agent, channel, frame, CHANNEL_FORMAT[channel])


@dataclass(frozen=True, slots=True)
class ReleaseLayout(ShortRepr):
    """Content of a dataroot, by the names of folders.

    Attributes:
        root: The dataroot.
        version: Version, `v1` or `v1-mini`.
        layout: Layout, `A` (scenario types in the root), `B` (split folders) or `A+B`.
        scenarios: Scenarios in the order of their tokens; a scenario in two split folders occurs
            twice.
        split_files: Split name → its file, if there is one.
    """

    root: ReleasePath
    version: str
    layout: str
    scenarios: tuple[ScenarioFolder, ...]
    split_files: Mapping[str, ReleasePath] = field(default_factory=dict)


def find_release(root: ReleasePath, version: str = "v1") -> ReleaseLayout:
    """Find the scenarios under a root of `open_dataroot` by listing folders; opens no file.

    Raises:
        DatarootError: The folder is missing or holds no release.
        VersionError: The version is unknown or not under this folder.
    """
    version = spelled(version, VERSIONS)
    if version not in VERSIONS:
        known_versions = ", ".join(VERSIONS)
        raise VersionError(
            f"unknown version {version!r}; known are {known_versions}{_version_remedy(version)}"
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
    scenarios: list[ScenarioFolder] = []
    for folder in folders:
        scenarios.extend(_scenarios_in(root, folder))
    if not scenarios:
        raise _no_scenario_error(root)
    layouts = ["A"] * ("" in folders) + ["B"] * any(folders)
    return ReleaseLayout(
        root=root,
        version=version,
        layout="+".join(layouts),
        scenarios=tuple(sorted(scenarios, key=attrgetter("token", "folder"))),
        split_files=_split_files(root),
    )


def _no_scenario_error(root: ReleasePath) -> DatarootError:
    """Return the error for a folder without scenarios, with hints on its content."""
    if isinstance(root, Path) and nuscenes_tables(root):
        return DatarootError(
            f"{root}: is a dataroot of nuScenes; open it with nuscenes.open_nuscenes"
        )
    hints = ""
    if SCENARIO_TYPE.fullmatch(root.name):
        hints = f"; it is of one scenario type: give {root.parent}"
    for path, expected_name in islice(left_aside(root), _MAX_NAMED_FOLDERS):
        if expected_name:
            hints += f"; {path} looks like {expected_name}: rename it"
        else:
            hints += f"; {path} is a link that leads nowhere"
    return DatarootError(
        f"{root}: no scenario found{hints}; expected <scenario_type>/<agent>/calib/<scenario>/*.pkl"
        f" below it, or below its folders {', '.join((*SPLIT_FOLDERS, MINI_FOLDER))} "
        "(unpack the calib archives, give a folder of zips alone, or make a small release with: "
        "deepaccident synth OUT)"
    )


def nuscenes_tables(dataroot: str | os.PathLike[str]) -> Path | None:
    """Return the folder of nuScenes' tables in a dataroot, which may be the folder itself, or None.

    Raises VersionError if the dataroot has several versions; the caller should use the folder of
    one of them.
    """
    root = Path(dataroot)
    tables = (root / NUSCENES_TABLE, *root.glob(f"v1.0*/{NUSCENES_TABLE}"))
    folders = sorted(table.parent for table in tables if table.is_file())
    if len(folders) > 1:
        raise VersionError(
            f"{root}: has several versions of nuScenes; give the folder of one, "
            f"such as {folders[0]}"
        )
    return folders[0].absolute() if folders else None


def _version_remedy(version: object) -> str:
    """Return the remedy if a folder, or a version of nuScenes, was used as the version."""
    text = os.fspath(version) if isinstance(version, os.PathLike) else str(version)
    # Odd texts are no folder.
    if os.path.isdir(text) or os.sep in text or text.startswith(("~", ".")):  # noqa: PTH112
        return f"; to open the folder, write DeepAccident(dataroot={text!r})"
    if text.lower().startswith("v1"):
        return f"; did you mean {'v1-mini' if text.lower().endswith('mini') else 'v1'!r}?"
    return ""


def frame_numbers(folder: ReleasePath, ending: str) -> tuple[list[int], list[str]]:
    """Return the frame numbers of a folder's files, and the names without a frame number.

    Both ascend; the names have the same ending. A folder that does not exist has none; a folder
    that cannot be listed, or a file with its name, raises DatarootError.
    """
    frames, odd_names = [], []
    for number, entry in _frame_entries(folder, _entries(folder), ending):
        if number is None:
            odd_names.append(entry.name)
        else:
            frames.append(number)
    return sorted(frames), sorted(odd_names)


def frame_sizes(folder: ReleasePath, ending: str) -> dict[int, int]:
    """Return frame number → size in bytes of a folder's files of frames, ascending.

    The folder is listed once. A folder that does not exist, or a file with its name, has none; a
    link to nothing is no file. Raises DatarootError.
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
    """Yield a folder's entries with an ending, and their frame numbers; None for names without."""
    stem = folder.name
    for entry in entries:
        name = entry.name
        if not name.endswith(f".{ending}") or name.startswith("."):
            continue
        match = _FRAME_FILE.fullmatch(name, len(stem)) if name.startswith(stem) else None
        number = int(match[1]) if match and match[1] == f"{int(match[1]):03d}" else None
        yield number or None, entry


def names_without_calib(layout: ReleaseLayout) -> Iterator[tuple[ReleasePath, str]]:
    """Yield scenarios that have labels, meta or sensor files, but no calib of any agent.

    They are the folder of the scenario type and the name. Folders that cannot be listed have none;
    reading their scenarios raises the error.
    """
    known_names: dict[ReleasePath, set[str]] = {}
    for scenario in layout.scenarios:
        type_folder = scenario.root / scenario.folder / scenario.scenario_type
        known_names.setdefault(type_folder, set()).add(scenario.name)
    for folder, names in known_names.items():
        all_names: set[str] = set()
        with suppress(DatarootError):
            for entry in _entries(folder / "meta"):
                if entry.name.endswith(".txt"):
                    all_names.add(entry.name[:-4])
        for agent in AGENTS:
            for kind in ("label", *CHANNEL_FORMAT):
                with suppress(DatarootError):
                    all_names.update(_subfolders(folder / agent / kind))
        for name in sorted(all_names - names):
            yield folder, name


def left_aside(root: ReleasePath) -> Iterator[tuple[ReleasePath, str | None]]:
    """Yield paths in a release that are not read, although they look as if they should be.

    They are folders with a name that only resembles one of the release (downloads are unpacked
    beside each other as `… (1)`, `…-001`), with that name; and links that lead nowhere or back,
    with None.
    """
    splits = [root / name for name in _subfolders(root) if name in _SPLIT_NAMES]
    yield from _aside_in(root, (SCENARIO_TYPE.pattern, *_SPLIT_NAMES))
    for folder in splits:
        yield from _aside_in(folder, (SCENARIO_TYPE.pattern,))
    for folder in (root, *splits):
        for type_name in _scenario_types(folder):
            yield from _aside_in_type(folder / type_name)


def _aside_in_type(type_folder: ReleasePath) -> Iterator[tuple[ReleasePath, str | None]]:
    """Yield the paths of `left_aside` in the folder of a scenario type."""
    yield from _aside_in(type_folder, _TYPE_SUBFOLDERS)
    for agent in _subfolders(type_folder):
        if agent not in AGENTS:
            continue
        agent_folder = type_folder / agent
        yield from _aside_in(agent_folder, _KINDS)
        for kind in _subfolders(agent_folder):
            if kind in _KINDS:
                yield from _aside_in(agent_folder / kind, ())


def _aside_in(
    folder: ReleasePath, known_names: Sequence[str]
) -> Iterator[tuple[ReleasePath, str | None]]:
    """Yield the paths of `left_aside` directly in one folder.

    Its folders with known names (patterns) are read; without known names only links count.
    """
    entries: list[FolderEntry] = []
    with suppress(DatarootError):  # reading its scenarios raises the error
        entries = _entries(folder, files=True)
    pattern = _COPY_PATTERN.format("|".join(known_names))
    for entry in sorted(entries, key=lambda entry: entry.name):
        path = folder / entry.name
        match = re.fullmatch(pattern, entry.name)
        is_known = match is not None and match[1] == entry.name
        if leads_back(entry):
            yield path, None
        elif is_known or not known_names or entry.name.startswith(".") or not is_folder(entry):
            continue
        elif match and (match[1] not in _SPLIT_NAMES or _holds_types(path)):
            yield path, match[1]
        elif known_names is _TYPE_SUBFOLDERS and {"calib", "label"} & {*_subfolders(path)}:
            yield path, f"an agent, of which the release has {', '.join(AGENTS)}"


def _holds_types(folder: ReleasePath) -> bool:
    """Return whether a folder, or a split folder in it, has scenario types."""
    for split_name in ("", *_SPLIT_NAMES):
        if any(map(SCENARIO_TYPE.match, _subfolders(folder / split_name))):
            return True
    return False


def _folders_of(root: ReleasePath, version: str) -> list[str]:
    """Return the folders below the root that hold scenario types of this version.

    The root itself is `""`.
    """
    flat = [""] if _scenario_types(root) else []
    split = []
    for name in _subfolders(root):
        if name in _SPLIT_NAMES and _scenario_types(root / name):
            split.append(name)
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
    """Return the names of the scenario types in a folder, sorted."""
    return sorted(filter(SCENARIO_TYPE.fullmatch, _subfolders(folder)))


def _scenarios_in(root: ReleasePath, folder: str) -> Iterator[ScenarioFolder]:
    """Yield the scenarios in a folder below the root; raises DatarootError."""
    for scenario_type in _scenario_types(root / folder):
        type_folder = root / folder / scenario_type
        _entries(type_folder)  # raises if it cannot be listed, which would hide its scenarios
        scenario_agents: dict[str, list[AgentName]] = {}
        listing_error: DatarootError | None = None
        for agent in AGENTS:
            try:
                names = _subfolders(type_folder / agent / "calib", loops=True)
            except DatarootError as error:
                # Scenarios of other agents raise this error when they are read.
                listing_error = error
                names = []
            for name in names:
                scenario_agents.setdefault(name, []).append(agent)
        if listing_error and not scenario_agents:
            raise listing_error
        for name, agents in scenario_agents.items():
            yield ScenarioFolder(root, folder, scenario_type, name, tuple(agents))


def _subfolders(folder: ReleasePath, *, loops: bool = False) -> list[str]:
    """Return the folders in a folder, none if a file has its name.

    `frame_numbers` reports such a file for each scenario. With `loops`, links to themselves count
    as folders, which `frame_numbers` also reports.
    """
    names = []
    for entry in _entries(folder, files=True):
        if not entry.name.startswith(".") and is_folder(entry, loops=loops):
            names.append(entry.name)
    return names


def _entries(folder: ReleasePath, *, files: bool = False) -> list[FolderEntry]:
    """Return the entries of a folder; none if it does not exist.

    With `files`, there are also none if a file has its name. Raises DatarootError.
    """
    try:
        return folder_entries(folder)
    except OSError as error:
        if isinstance(error, FileNotFoundError):
            return []
        if files and isinstance(error, NotADirectoryError):
            return []
        raise DatarootError(
            f"{folder}: cannot be listed ({error.strerror}); {_UNLISTABLE_REMEDY}"
        ) from error


def read_split_file(path: ReleasePath, *, raw: bool = False, unique: bool = False) -> list[str]:
    """Return the scenarios of a split file, in its order, as tokens `<scenario_type>/<scenario>`.

    Each scenario occurs once. Blank lines, blanks at line ends and CRLF are accepted. A name that
    is not UTF-8 is decoded like the system's file names.

    Args:
        path: The file.
        raw: Whether to repeat scenarios that are in several lines.
        unique: Whether a scenario in two lines is an error; otherwise it counts once.

    Raises:
        MissingFileError: There is no such file.
        SplitFileError: A line does not have two words, the file is no text, or a scenario occurs
            twice and `unique` is set.
    """
    remedy = "restore it from the release"
    lines = read_lines(path, "split", SplitFileError, remedy, errors="surrogateescape")
    if any("\0" in line for line in lines):
        raise SplitFileError(f"{path}: not a text file; {remedy}")
    numbered_words = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            numbered_words.append((number, tuple(line.split(maxsplit=2))))
    for number, words in numbered_words:
        if len(words) != 2:
            raise SplitFileError(
                f"{path}:{number}: expected '<scenario_type> <scenario>', "
                f"found {shortened(' '.join(words))!r}; mend or remove the line"
            )
    first_lines: dict[tuple[str, ...], int] = {}
    for number, words in numbered_words if unique else ():
        if words in first_lines:
            raise SplitFileError(
                f"{path}:{number}: {shortened(' '.join(words))!r} stands in line "
                f"{first_lines[words]} already; remove one of the two lines"
            )
        first_lines[words] = number
    tokens = ["/".join(words) for _, words in numbered_words]
    return tokens if raw else list(dict.fromkeys(tokens))


def write_split_file(path: Path, scenario_tokens: Sequence[str]) -> None:
    """Write scenario tokens, one line each."""
    lines = []
    for token in scenario_tokens:
        scenario_type, name = token.split("/")
        lines.append(f"{scenario_type} {name}\n")
    write_bytes(path, "".join(lines).encode())


class MissingFiles:
    """A check for sensor files, which counts missing ones by channel (`on_missing='skip'`)."""

    def __init__(self, root: ReleasePath, on_missing: OnError = "raise") -> None:
        """Prepare the check of files below a release's folder; raises ChoiceError."""
        self._root = root
        self._skips = choice("on_missing", on_missing, get_args(OnError)) == "skip"
        self._checked: Counter[str] = Counter()
        self._missing: Counter[str] = Counter()

    def has(self, path: ReleasePath, channel: str) -> bool:
        """Return whether a file exists; raises MissingFileError if missing files are errors."""
        self._checked[channel] += 1
        if path.exists():
            return True
        if not self._skips:
            raise MissingFileError(
                f"{path}: no such file; unpack the archive that holds it, or leave out what is "
                "missing with on_missing='skip'"
            )
        self._missing[channel] += 1
        return False

    def tell(self) -> None:
        """Log one warning with the number of files that were left out, if any."""
        if self._missing:
            counts = ", ".join(
                f"{self._missing[name]} of {self._checked[name]} of {name}"
                for name in self._missing
            )
            _logger.warning("left out files that are not in %s: %s", self._root, counts)


def _split_files(root: ReleasePath) -> dict[str, ReleasePath]:
    """Return split name → its file."""
    paths: dict[str, ReleasePath] = {}
    for name in SPLIT_FILES:
        for folder in (root, root / SPLIT_FILE_FOLDER):
            path = folder / name
            exists = os.path.lexists(path) if isinstance(path, Path) else path.is_file()
            if exists and not path.is_dir():  # reading a pipe, or a link to itself, is an error
                paths[path.stem] = path
                break
    return paths
