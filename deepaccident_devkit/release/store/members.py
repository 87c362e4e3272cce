"""Files that belong to a release, by the folders that lead to them, and lists of a store's files.

The list holds the archive and the position of each file; it is a memory-mapped Arrow file beside
the index. Opening it takes milliseconds for millions of files: only folders are read, and a file is
searched on request among the sorted files of its folder.
"""

import json
import re
import zlib
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from deepaccident_devkit.errors import DatarootError, IndexStoreError, shortened
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.reading import mapped_file
from deepaccident_devkit.taxonomy import MINI_SPLITS, SPLITS

MINI_FOLDER: Final = "DeepAccident_mini"
SPLIT_FOLDERS: Final = SPLITS
SPLIT_FILE_FOLDER: Final = "split_txt_files"
SCENARIO_TYPE: Final = re.compile(r"type\d+_subtype\d+_(?:accident|normal)")
SPLIT_FILES: Final = tuple(f"{split}.txt" for split in (*SPLITS, *MINI_SPLITS))
# Size of a file in bytes, and a text that changes with the file.
FileState: TypeAlias = tuple[int, str]
# The folder that macOS adds to its archives.
_MACOS_FOLDER = "__MACOSX"
# The form increases whenever the file's form or its meaning changes.
FORM: Final = 3
_METADATA_KEY = b"deepaccident_members"
# Stored form of a `Member`.
_MEMBER_TYPE = np.dtype(
    [
        ("archive", "<i4"),
        ("offset", "<i8"),
        ("stored", "<i8"),
        ("size", "<i8"),
        ("version", "<u4"),
        ("deflated", "u1"),
    ]
)
# Position of the number in the name of a frame's file.
_FRAME_NUMBER = slice(-7, -4)
_REMEDY = "remove it with: deepaccident index DATAROOT --clear"


def release_folder(parts: Sequence[str]) -> str | None:
    """Return the folder of a release that the parts of a path stand for.

    It begins with the scenario type, or with the split folder if there is one:
    `DeepAccident/train/type1_subtype1_accident/meta` stands for
    `train/type1_subtype1_accident/meta`. The folders that lead to it do not matter, so that an
    archive may hold any part of a release, below any folders. It is empty for the release's own
    folder, and None for a folder with files of no release.
    """
    # Hidden folders, or folders that lead out of an archive.
    if any(name.startswith(".") or name == _MACOS_FOLDER for name in parts):
        return None
    type_positions = [index for index, name in enumerate(parts) if SCENARIO_TYPE.fullmatch(name)]
    if not type_positions:
        return ""
    last_type = type_positions[-1]
    splits = [name for name in parts[:last_type] if name in (*SPLIT_FOLDERS, MINI_FOLDER)]
    names = [*splits[-1:], *parts[last_type:]]
    return "/".join(names)


def is_release_file(folder: str, name: str) -> bool:
    """Return whether a file belongs to a release.

    It lies below a scenario type, or is a split file in the release's own folder.
    """
    return bool(folder) or name in SPLIT_FILES


class Member(NamedTuple):
    """One file of a store.

    Attributes:
        archive: Position in `Members.archives`.
        offset: Position of its header in the archive; −1 where the archive is the file's folder.
        stored: Size in the archive, bytes.
        size: Size of the file, bytes.
        version: CRC-32 in a zip; elsewhere another number that changes with the file.
        deflated: Whether the file is compressed.
    """

    archive: int
    offset: int
    stored: int
    size: int
    version: int
    deflated: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Listing:
    """The N files of one archive that belong to a release.

    Attributes:
        archive: Path of the archive from the store's base.
        folders: Folders of the release, each once.
        folder: Positions in `folders`, shape (N,).
        names: Names of the N files.
        numbers: Columns of `Member` except `archive`, each of shape (N,).
    """

    archive: str
    folders: Sequence[str]
    folder: AnyArray
    names: Sequence[str]
    numbers: Mapping[str, AnyArray]


class Members:
    """The files of a store, by folder and name.

    Attributes:
        archives: Paths of the archives from the store's base.
        states: Existing archive → its size in bytes, and a text that changes with it.
        lacking: Archives that could not be listed.
    """

    def __init__(self, path: Path) -> None:
        """Map the file that `write_members` wrote; raises IndexStoreError if it cannot be read."""
        import pyarrow as pa

        try:
            batch = pa.ipc.open_file(mapped_file(path)).get_batch(0)
            header = json.loads(batch.schema.metadata[_METADATA_KEY])
            if header["form"] != FORM:
                raise ValueError("made by another version of the devkit")
            names = batch.column("name")
            _, offsets, content = names.buffers()
            self.archives: tuple[str, ...] = tuple(map(str, header["archives"]))
            self.states: dict[str, FileState] = {}
            for name, (size, text) in header["states"].items():
                self.states[str(name)] = (int(size), str(text))
            self.lacking = [archive for archive in self.states if archive not in self.archives]
            self._rows: dict[str, tuple[int, int]] = {}
            for folder, start, stop in header["folders"]:
                self._rows[str(folder)] = (int(start), int(stop))
            self._starts = np.frombuffer(offsets, np.int64) if offsets else np.zeros(1, np.int64)
            self._content = memoryview(content) if content else memoryview(b"")
            member_buffer = batch.column("member").buffers()[1] or b""
            self._numbers = np.frombuffer(member_buffer, _MEMBER_TYPE)
            if len(self._numbers) < len(names) or self._starts[-1] > len(self._content):
                raise ValueError("its columns do not fit together")
        except (
            OSError,
            pa.ArrowException,
            KeyError,
            TypeError,
            ValueError,
            AttributeError,
        ) as error:
            raise IndexStoreError(
                f"{path}: cannot be read ({shortened(str(error))}); {_REMEDY}"
            ) from error
        self._children: dict[str, dict[str, None]] = {"": {}}
        for folder in self._rows:
            self._add_folder(folder)

    def __len__(self) -> int:
        """Return the number of files."""
        return len(self._starts) - 1

    def find(self, name: str) -> Member | None:
        """Return a file by its path in the release; None if it does not exist."""
        folder, _, last_name = name.rpartition("/")
        low, high = self._rows.get(folder, (0, 0))
        file_name = last_name.encode(errors="surrogateescape")
        frame = file_name[_FRAME_NUMBER]
        # In a complete recording the rows follow the frame numbers.
        row = low + int(frame) - 1 if frame.isdigit() else high
        if not (low <= row < high and self._read_name(row) == file_name):
            row = bisect_left(range(high), file_name, low, high, key=self._read_name)
            if row == high or self._read_name(row) != file_name:
                return None
        return self._read_member(row)

    def has_folder(self, folder: str) -> bool:
        """Return whether a folder of the release has any content."""
        return folder in self._children

    def folders_in(self, folder: str) -> list[str]:
        """Return the names of the folders in a folder."""
        return [*self._children.get(folder, ())]

    def files_in(self, folder: str) -> list[tuple[str, Member]]:
        """Return the names of a folder's files with their members, in order."""
        files = []
        for row in range(*self._rows.get(folder, (0, 0))):
            name = self._read_name(row).decode(errors="surrogateescape")
            files.append((name, self._read_member(row)))
        return files

    def number_of(self, member: Member) -> int:
        """Return a number that changes with a file and with its archive."""
        archive = self.archives[member.archive]
        state_text = repr(self.states.get(archive))
        return member.version << 32 | zlib.crc32(state_text.encode())

    def _read_name(self, row: int) -> bytes:
        """Return the name of the file in a row."""
        start = self._starts.item(row)
        stop = self._starts.item(row + 1)
        return bytes(self._content[start:stop])

    def _read_member(self, row: int) -> Member:
        """Return the file in a row."""
        return Member._make(self._numbers.item(row))

    def _add_folder(self, folder: str) -> None:
        """Add a folder, and the folders that lead to it, to the tree."""
        self._children.setdefault(folder, {})
        while folder:
            folder, _, name = folder.rpartition("/")
            siblings = self._children.setdefault(folder, {})
            if name in siblings:
                break
            siblings[name] = None


def write_members(path: Path, listings: Sequence[Listing], states: Mapping[str, FileState]) -> None:
    """Write the list of all archives' files, which `Members` reads.

    Raises DatarootError for a file that occurs twice.
    """
    import pyarrow as pa

    folders = sorted({folder for listing in listings for folder in listing.folders})
    folder_numbers = {folder: number for number, folder in enumerate(folders)}
    tables = [
        _make_listing_table(listing, archive, folder_numbers)
        for archive, listing in enumerate(listings)
    ]
    order = [("folder", "ascending"), ("name", "ascending")]
    table = pa.concat_tables(tables).sort_by(order).combine_chunks()
    archives = [listing.archive for listing in listings]
    folder = table["folder"].to_numpy()
    _check_unique(table, folder, folders, archives)
    stops = np.cumsum(np.bincount(folder, minlength=len(folders))).tolist()
    rows = list(zip(folders, [0, *stops], stops, strict=False))
    header = json.dumps({"form": FORM, "archives": archives, "folders": rows, "states": states})
    table = table.select(["name", "member"]).replace_schema_metadata(
        {_METADATA_KEY: header.encode()}
    )
    with replacing(path) as temporary, pa.ipc.new_file(str(temporary), table.schema) as writer:
        columns = [_take_single_chunk(column) for column in table.columns]
        writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=table.schema))


def _make_listing_table(listing: Listing, archive: int, folder_numbers: Mapping[str, int]) -> Any:
    """Return a table of an archive's files, with the numbers of the archive and of the folders."""
    import pyarrow as pa

    members = np.zeros(len(listing.names), _MEMBER_TYPE)
    for field, values in {**listing.numbers, "archive": archive}.items():
        members[field] = values
    listing_folders = np.array([folder_numbers[name] for name in listing.folders], np.int32)
    names = [name.encode(errors="surrogateescape") for name in listing.names]
    return pa.table(
        {
            "folder": listing_folders[listing.folder],
            "name": pa.array(names, pa.large_binary()),
            "member": pa.FixedSizeBinaryArray.from_buffers(
                pa.binary(_MEMBER_TYPE.itemsize),
                len(members),
                [None, pa.py_buffer(members.tobytes())],
            ),
        }
    )


def _take_single_chunk(column: Any) -> Any:
    """Return a column's only chunk, or an empty array if it has none."""
    import pyarrow as pa

    if column.num_chunks:
        return column.chunk(0)
    return pa.array([], column.type)


def _check_unique(
    table: Any, folder: AnyArray, folders: Sequence[str], archives: Sequence[str]
) -> None:
    """Raise DatarootError if a file occurs twice; in the sorted rows it does so in neighbours."""
    import pyarrow.compute as pc

    if len(folder) < 2:
        return
    names = table["name"]
    is_repeated = (folder[1:] == folder[:-1]) & pc.equal(names[1:], names[:-1]).to_numpy()
    if is_repeated.any():
        row = int(np.flatnonzero(is_repeated)[0])
        name = names[row].as_py().decode(errors="backslashreplace")
        archive_names = []
        for number in (row, row + 1):
            member = np.frombuffer(table["member"][number].as_py(), _MEMBER_TYPE)
            archive_names.append(archives[int(member["archive"][0])])
        first, second = archive_names
        location = f"twice in {first}"
        if first != second:
            location = f"in {first} and in {second}"
        num_others = is_repeated.sum() - 1
        others_text = f", and so are {num_others:,} more" if num_others else ""
        raise DatarootError(
            f"{folders[folder[row]]}/{name}: is {location}{others_text}; "
            "keep one of them in this folder"
        )
