"""Paths of a release's files (docs/format.md, Tree): folders, split files, missing files."""

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
from typing import Final, TypeAlias, get_args

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
from deepaccident_devkit.support.text import PathType, choice, match_spelling
from deepaccident_devkit.taxonomy import AGENTS, CHANNEL_FORMAT, VERSIONS, AgentName, OnError

_UNLISTABLE_REMEDY = "unpack its archive again, or make it readable"
_SPLIT_NAMES = (*SPLIT_FOLDERS, MINI_FOLDER)
_TYPE_SUBFOLDERS = ("meta", *AGENTS)
_KINDS = ("calib", "label", *CHANNEL_FORMAT)
# Names that browsers, cloud drives and people give to a copy, or a part, of a known folder.
_COPY_PATTERN = r"(?:Copy of )?({})(?:\W.*|_*\d.*|_+(?i:copy|part|old|new|backup)\w*)?"
# The error for a folder without scenarios lists at most this many folders.
_MAX_NAMED_FOLDERS = 3
# A table that every version of nuScenes has.
NUSCENES_TABLE: Final = "scene.json"
# Paths that are not read, each with the name that it should have, or None.
_PathsAside: TypeAlias = Iterator[tuple[ReleasePath, str | None]]
_FRAME_FILE = re.compile(r"_(\d{3,})\.\w+")
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ScenarioFolder:
    """Folders of one scenario's files.

    Attributes:
        root: Folder of the release.
        folder: Folder below the root that contains the scenario in layout B (`train`, …); empty in
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
        """Token of the scenario, with its type, because names may occur in several types."""
        return f"{self.scenario_type}/{self.name}"

    @property
    def meta_path(self) -> ReleasePath:
        """Meta file of the scenario."""
        return self._join_path(f"meta/{self.name}.txt")

    def kind_folder(self, agent: str, kind: str) -> ReleasePath:
        """Return the folder of one kind of file (`label`, `calib` or a channel) of one agent."""
        return self._join_path(f"{agent}/{kind}/{self.name}")

    def file(self, agent: str, kind: str, frame: int, ending: str) -> ReleasePath:
        """Return the path of an agent's file of one kind in one frame."""
        file_name = f"{self.name}_{frame:03d}.{ending}"
        return self._join_path(f"{agent}/{kind}/{self.name}/{file_name}")

    def _join_path(self, relative: str) -> ReleasePath:
        """Return a path below the folder of the scenario's type."""
        folder = self.scenario_type
        if self.folder:
            folder = f"{self.folder}/{folder}"
        return self.root / f"{folder}/{relative}"  # one join: there are 500,000 files

    def label_path(self, agent: str, frame: int) -> ReleasePath:
        """Return the path of an agent's label file in a frame."""
        return self.file(agent, "label", frame, "txt")

    def calib_path(self, agent: str, frame: int) -> ReleasePath:
        """Return the path of an agent's calib file in a frame."""
        return self.file(agent, "calib", frame, "pkl")

    def channel_path(self, agent: str, channel: str, frame: int) -> ReleasePath:
        """Return the path of an agent's sensor file (image or array) in a frame."""
        return self.file(agent, channel, frame, CHANNEL_FORMAT[channel])


@dataclass(frozen=True, slots=True)
class ReleaseLayout(ShortRepr):
    """Content of a dataroot, according to its folder names.

    Attributes:
        root: The dataroot.
        version: Version, `v1` or `v1-mini`.
        layout: Layout, `A` (scenario types in the root), `B` (split folders) or `A+B`.
        scenarios: Scenarios sorted by token; a scenario in two split folders occurs twice.
        split_files: Split name → split file, for splits that have one.
    """

    root: ReleasePath
    version: str
    layout: str
    scenarios: tuple[ScenarioFolder, ...]
    split_files: Mapping[str, ReleasePath] = field(default_factory=dict)


def find_release(root: ReleasePath, version: str = "v1") -> ReleaseLayout:
    """Find the scenarios below a dataroot; folders are listed, no file is opened.

    Raises:
        DatarootError: If the folder does not exist or contains no release.
        VersionError: If the version is unknown, or is not under this folder.
    """
    version = match_spelling(version, VERSIONS)
    if version not in VERSIONS:
        known_versions = ", ".join(VERSIONS)
        raise VersionError(
            f"unknown version {version!r}; expected {known_versions}{_suggest_version(version)}"
        )
    try:
        str(root).encode()
    except UnicodeEncodeError:
        raise DatarootError(
            f"{str(root)!r}: the path is not UTF-8, which Arrow requires; rename the folder"
        ) from None
    if not root.is_dir():
        state = "does not exist"
        if root.is_file():
            state = "is a file"
        elif os.path.islink(str(root)):  # noqa: PTH114
            state = "is a broken link"
        raise DatarootError(f"{root}: {state}; pass the folder of the unpacked release as dataroot")
    folders = _find_scenario_folders(root, version)
    scenarios: list[ScenarioFolder] = []
    for folder in folders:
        scenarios.extend(_find_scenarios(root, folder))
    if not scenarios:
        raise _make_no_scenario_error(root)
    layout = "B"
    if "" in folders:
        layout = "A+B" if any(folders) else "A"
    return ReleaseLayout(
        root=root,
        version=version,
        layout=layout,
        scenarios=tuple(sorted(scenarios, key=attrgetter("token", "folder"))),
        split_files=_find_split_files(root),
    )


def _make_no_scenario_error(root: ReleasePath) -> DatarootError:
    """Return the error for a folder without scenarios, with hints on its content."""
    if isinstance(root, Path) and nuscenes_tables(root):
        return DatarootError(f"{root}: is a nuScenes dataroot; open it with nuscenes.open_nuscenes")
    hints = ""
    if SCENARIO_TYPE.fullmatch(root.name):
        hints = f"; it is the folder of one scenario type: give {root.parent}"
    for path, expected_name in islice(find_ignored_paths(root), _MAX_NAMED_FOLDERS):
        if expected_name:
            hints += f"; {path} looks like {expected_name}: rename it"
        else:
            hints += f"; {path} is a broken link"
    return DatarootError(
        f"{root}: no scenario found{hints}; expected <scenario_type>/<agent>/calib/<scenario>/*.pkl"
        f" below it, or below its folders {', '.join((*SPLIT_FOLDERS, MINI_FOLDER))} "
        "(unpack the calib archives, give a folder with only zip archives, or make a small release "
        "with: deepaccident synth OUT)"
    )


def nuscenes_tables(dataroot: PathType) -> Path | None:
    """Return the folder of nuScenes tables: the dataroot or a folder in it; None without any.

    VersionError is raised if the dataroot has several versions; the user should pass the
    folder of one of them.
    """
    root = Path(dataroot)
    tables = (root / NUSCENES_TABLE, *root.glob(f"v1.0*/{NUSCENES_TABLE}"))
    folders = sorted(table.parent for table in tables if table.is_file())
    if len(folders) > 1:
        raise VersionError(
            f"{root}: contains several versions of nuScenes; give the folder of one, "
            f"such as {folders[0]}"
        )
    if not folders:
        return None
    return folders[0].absolute()


def _suggest_version(version: object) -> str:
    """Return a remedy if `version` is a folder or a nuScenes version, otherwise an empty text."""
    text = os.fspath(version) if isinstance(version, os.PathLike) else str(version)
    # texts that no path can have
    if os.path.isdir(text) or os.sep in text or text.startswith(("~", ".")):  # noqa: PTH112
        return f"; to open the folder, write DeepAccident(dataroot={text!r})"
    if text.lower().startswith("v1"):
        similar_version = "v1-mini" if text.lower().endswith("mini") else "v1"
        return f"; did you mean {similar_version!r}?"
    return ""


def frame_numbers(folder: ReleasePath, ending: str) -> tuple[list[int], list[str]]:
    """Return the frame numbers of a folder's files, and the file names without a frame number.

    Both are sorted, and only include files with the ending. A folder that does not exist has none.
    DatarootError is raised if the folder cannot be listed or is a file.
    """
    frames, odd_names = [], []
    for number, entry in _list_frame_entries(folder, _list_entries(folder), ending):
        if number is None:
            odd_names.append(entry.name)
        else:
            frames.append(number)
    return sorted(frames), sorted(odd_names)


def frame_sizes(folder: ReleasePath, ending: str) -> dict[int, int]:
    """Return frame number → size of the frame's file in a folder, bytes, ascending.

    The folder is listed once. The result is empty if the folder does not exist or is a file; broken
    links are left out. DatarootError is raised if the folder cannot be listed.
    """
    sizes = {}
    for number, entry in _list_frame_entries(folder, _list_entries(folder, files=True), ending):
        with suppress(OSError):
            if number is not None:
                sizes[number] = entry.stat().st_size
    return dict(sorted(sizes.items()))


def _list_frame_entries(
    folder: ReleasePath, entries: Iterable[FolderEntry], ending: str
) -> Iterator[tuple[int | None, FolderEntry]]:
    """Yield the frame number (or None) and the entry, for each entry with an ending."""
    stem = folder.name
    for entry in entries:
        name = entry.name
        if not name.endswith(f".{ending}") or name.startswith("."):
            continue
        number = 0
        match = None
        if name.startswith(stem):
            match = _FRAME_FILE.fullmatch(name, len(stem))
        if match and match[1] == f"{int(match[1]):03d}":
            number = int(match[1])
        yield number or None, entry  # frames are numbered from 1


def names_without_calib(layout: ReleaseLayout) -> Iterator[tuple[ReleasePath, str]]:
    """Yield (type folder, name) of scenarios with labels, meta or sensor files, but no calib.

    Folders that cannot be listed are skipped; reading their scenarios raises the error.
    """
    known_names: dict[ReleasePath, set[str]] = {}
    for scenario in layout.scenarios:
        type_folder = scenario.root / scenario.folder / scenario.scenario_type
        known_names.setdefault(type_folder, set()).add(scenario.name)
    for folder, names in known_names.items():
        all_names: set[str] = set()
        with suppress(DatarootError):
            for entry in _list_entries(folder / "meta"):
                if entry.name.endswith(".txt"):
                    all_names.add(entry.name[:-4])
        for agent in AGENTS:
            for kind in ("label", *CHANNEL_FORMAT):
                with suppress(DatarootError):
                    all_names.update(_list_subfolders(folder / agent / kind))
        for name in sorted(all_names - names):
            yield folder, name


def find_ignored_paths(root: ReleasePath) -> _PathsAside:
    """Yield paths in a release that are ignored, although they look as if they should be read.

    They are folders whose name only resembles a name in the release, together with the correct name
    (repeated downloads are unpacked as `… (1)`, `…-001`); and broken or circular links, together
    with None.
    """
    splits = [root / name for name in _list_subfolders(root) if name in _SPLIT_NAMES]
    yield from _find_aside(root, (SCENARIO_TYPE.pattern, *_SPLIT_NAMES))
    for folder in splits:
        yield from _find_aside(folder, (SCENARIO_TYPE.pattern,))
    for folder in (root, *splits):
        for type_name in _list_scenario_types(folder):
            yield from _find_aside_in_type(folder / type_name)


def _find_aside_in_type(type_folder: ReleasePath) -> _PathsAside:
    """Yield the paths of `find_ignored_paths` in the folder of a scenario type."""
    yield from _find_aside(type_folder, _TYPE_SUBFOLDERS)
    for agent in _list_subfolders(type_folder):
        if agent not in AGENTS:
            continue
        agent_folder = type_folder / agent
        yield from _find_aside(agent_folder, _KINDS)
        for kind in _list_subfolders(agent_folder):
            if kind in _KINDS:
                yield from _find_aside(agent_folder / kind, ())


def _find_aside(folder: ReleasePath, known_names: Sequence[str]) -> _PathsAside:
    """Yield the paths of `find_ignored_paths` directly in one folder.

    Names that match `known_names`, which are patterns, are read. If it is empty, only links are
    yielded.
    """
    entries: list[FolderEntry] = []
    with suppress(DatarootError):  # reading its scenarios raises the error
        entries = _list_entries(folder, files=True)
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
        elif known_names is _TYPE_SUBFOLDERS and {"calib", "label"} & {*_list_subfolders(path)}:
            agent_names = ", ".join(AGENTS)
            yield path, f"an agent (the agents are {agent_names})"


def _holds_types(folder: ReleasePath) -> bool:
    """Return whether a folder, or a split folder in it, contains scenario types."""
    for split_name in ("", *_SPLIT_NAMES):
        if any(map(SCENARIO_TYPE.match, _list_subfolders(folder / split_name))):
            return True
    return False


def _find_scenario_folders(root: ReleasePath, version: str) -> list[str]:
    """Return the folders below the root that contain scenario types of this version.

    The root itself is `""`.
    """
    has_types = bool(_list_scenario_types(root))
    flat_folders = [""] if has_types else []
    mini_folders: list[str] = []
    split_folders: list[str] = []
    for name in _list_subfolders(root):
        if name in _SPLIT_NAMES and _list_scenario_types(root / name):
            folders = mini_folders if name == MINI_FOLDER else split_folders
            folders.append(name)
    root_is_mini = root.resolve().name == MINI_FOLDER
    if version == "v1":
        return flat_folders + split_folders or mini_folders
    if root_is_mini and has_types:
        return flat_folders
    if not mini_folders and (has_types or split_folders):
        raise VersionError(
            f"{root}: contains no mini release (folder {MINI_FOLDER}); open it with version='v1'"
        )
    return mini_folders


def _list_scenario_types(folder: ReleasePath) -> list[str]:
    """Return the sorted names of the scenario types in a folder."""
    return sorted(filter(SCENARIO_TYPE.fullmatch, _list_subfolders(folder)))


def _find_scenarios(root: ReleasePath, folder: str) -> Iterator[ScenarioFolder]:
    """Yield the scenarios in a folder of the root; raise DatarootError if it cannot be listed."""
    for scenario_type in _list_scenario_types(root / folder):
        type_folder = root / folder / scenario_type
        _list_entries(type_folder)  # raises if it cannot be listed, which would hide its scenarios
        scenario_agents: dict[str, list[AgentName]] = {}
        listing_error: DatarootError | None = None
        for agent in AGENTS:
            try:
                names = _list_subfolders(type_folder / agent / "calib", loops=True)
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


def _list_subfolders(folder: ReleasePath, *, loops: bool = False) -> list[str]:
    """Return the names of the folders in a folder; none if it is a file.

    `frame_numbers` reports such a file for each scenario. If `loops`, links to themselves count as
    folders; `frame_numbers` reports these too.
    """
    entries = [
        entry for entry in _list_entries(folder, files=True) if not entry.name.startswith(".")
    ]
    return [entry.name for entry in entries if is_folder(entry, loops=loops)]


def _list_entries(folder: ReleasePath, *, files: bool = False) -> list[FolderEntry]:
    """Return the entries of a folder; none if it does not exist.

    If `files`, the path may also be a file, which has no entries. DatarootError is raised if the
    folder cannot be listed.
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
    """Read the scenarios of a split file, in its order, as tokens `<scenario_type>/<scenario>`.

    Each scenario is returned once. Blank lines, blanks at line ends and CRLF are accepted. Names
    that are not UTF-8 are decoded like file names.

    Args:
        path: The file.
        raw: Whether to keep repetitions of scenarios that are in several lines.
        unique: Whether a scenario in two lines is an error.

    Raises:
        MissingFileError: If there is no such file.
        SplitFileError: If a line does not have two words, if the file is not text, or if a scenario
            occurs twice and `unique` is set.
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
                f"found {shortened(' '.join(words))!r}; correct or remove the line"
            )
    first_lines: dict[tuple[str, ...], int] = {}
    for number, words in numbered_words:
        if unique and words in first_lines:
            raise SplitFileError(
                f"{path}:{number}: {shortened(' '.join(words))!r} is already in line "
                f"{first_lines[words]}; remove one of the two lines"
            )
        first_lines[words] = number
    tokens = ["/".join(words) for _, words in numbered_words]
    if raw:
        return tokens
    return list(dict.fromkeys(tokens))


def write_split_file(path: Path, scenario_tokens: Sequence[str]) -> None:
    """Write scenario tokens to a split file, one per line."""
    write_bytes(path, encode_split_file(scenario_tokens))


def encode_split_file(scenario_tokens: Sequence[str]) -> bytes:
    """Return the content of a split file with scenario tokens, one per line."""
    lines = []
    for token in scenario_tokens:
        scenario_type, name = token.split("/")
        lines.append(f"{scenario_type} {name}\n")
    return "".join(lines).encode()


class MissingFiles:
    """A check that sensor files exist; `on_missing='skip'` counts the missing ones by channel."""

    def __init__(self, root: ReleasePath, on_missing: OnError = "raise") -> None:
        """Prepare the check for files in `root`; raise ChoiceError if `on_missing` is invalid."""
        self._root = root
        self._skips = choice("on_missing", on_missing, get_args(OnError)) == "skip"
        self._checked: Counter[str] = Counter()
        self._missing: Counter[str] = Counter()

    def has(self, path: ReleasePath, channel: str) -> bool:
        """Return whether a file exists; if not, raise MissingFileError if `on_missing` says so."""
        self._checked[channel] += 1
        if path.exists():
            return True
        if not self._skips:
            raise MissingFileError(
                f"{path}: no such file; unpack the archive that contains it, or skip missing files "
                "with on_missing='skip'"
            )
        self._missing[channel] += 1
        return False

    def tell(self) -> None:
        """Log one warning with the number of files that were skipped, if any."""
        if self._missing:
            counts = []
            for channel, missing_count in self._missing.items():
                counts.append(f"{missing_count} of {self._checked[channel]} {channel} files")
            texts = ", ".join(counts)
            _logger.warning("skipped files that are missing in %s: %s", self._root, texts)


def _find_split_files(root: ReleasePath) -> dict[str, ReleasePath]:
    """Return split name → split file, for all split files that exist."""
    paths = {}
    for name in SPLIT_FILES:
        for folder in (root, root / SPLIT_FILE_FOLDER):
            path = folder / name
            exists = os.path.lexists(path) if isinstance(path, Path) else path.is_file()
            if exists and not path.is_dir():  # reading a pipe or a circular link fails later
                paths[path.stem] = path
                break
    return paths
