"""Which files are of a release, by the folders that lead to them, and the list of a store's files.

The list says where each lies in which archive; it is a memory-mapped Arrow file beside the index. Opening it takes
milliseconds for millions of files: only folders are looked at, and a file is found among those of its folder, which are
sorted, when it is asked for.
"""

from __future__ import annotations

import json
import re
import zlib
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

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
# The folder that macOS adds to its archives.
_FROM_MACOS: Final = "__MACOSX"
# Counts up whenever the file's form or its meaning changes.
FORM: Final = 3
_HEAD: Final = b"deepaccident_members"
# How a `Member` is stored.
_NUMBERS: Final = np.dtype(
    [
        ("archive", "<i4"),
        ("offset", "<i8"),
        ("stored", "<i8"),
        ("size", "<i8"),
        ("version", "<u4"),
        ("deflated", "u1"),
    ]
)
# Where the name of a frame's file has its number.
_FRAME: Final = slice(-7, -4)
_REMEDY: Final = "remove it with: deepaccident index DATAROOT --clear"


def release_folder(parts: Sequence[str]) -> str | None:
    """The folder of a release that a folder stands for: from its scenario type on, below its split folder if any.

    `DeepAccident/train/type1_subtype1_accident/meta` stands for `train/type1_subtype1_accident/meta`. What leads there
    does not matter, so that an archive may hold any part of a release, below any folders. Empty for the release's own
    folder; None for one that holds files of no release.
    """
    if any(
        name.startswith(".") or name == _FROM_MACOS for name in parts
    ):  # hidden, or leading out of an archive
        return None
    types = [place for place, name in enumerate(parts) if SCENARIO_TYPE.fullmatch(name)]
    if not types:
        return ""
    above = [name for name in parts[: types[-1]] if name in (*SPLIT_FOLDERS, MINI_FOLDER)]
    return "/".join([*above[-1:], *parts[types[-1] :]])


def is_release_file(folder: str, name: str) -> bool:
    """Whether a file is of a release: below a scenario type, or a split file in the release's own folder."""
    return bool(folder) or name in SPLIT_FILES


class Member(NamedTuple):
    """One file of a store.

    Attributes:
        archive: position in `Members.archives`.
        offset: where its head begins in the archive; −1 where the archive is the folder that it lies in.
        stored: bytes in the archive.
        size: bytes of the file.
        version: its CRC-32 in a zip; another number that changes with the file elsewhere.
        deflated: whether it is compressed.
    """

    archive: int
    offset: int
    stored: int
    size: int
    version: int
    deflated: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Listing:
    """The files of one archive that are of a release; N of them.

    Attributes:
        archive: its path from the store's place.
        folders: of the release, each once.
        folder: (N,) positions in `folders`.
        names: N names of files.
        numbers: the columns of `Member` but `archive`, (N,) each.
    """

    archive: str
    folders: Sequence[str]
    folder: AnyArray
    names: Sequence[str]
    numbers: Mapping[str, AnyArray]


class Members:
    """The files of a store, by folder and name.

    Attributes:
        archives: their paths from the store's base.
        states: of all archives that were there, bytes and a text that changes with them.
        lacking: those that could not be listed.
    """

    def __init__(self, path: Path) -> None:
        """Map the file that `write_members` wrote; raises IndexStoreError if it cannot be read."""
        import pyarrow as pa

        try:
            batch = pa.ipc.open_file(mapped_file(path)).get_batch(0)
            head = json.loads(batch.schema.metadata[_HEAD])
            if head["form"] != FORM:
                raise ValueError("of another version of the devkit")
            names = batch.column("name")
            _, offsets, content = names.buffers()
            self.archives: tuple[str, ...] = tuple(map(str, head["archives"]))
            self.states = {
                str(name): (int(size), str(text)) for name, (size, text) in head["states"].items()
            }
            self.lacking = [archive for archive in self.states if archive not in self.archives]
            self._rows = {
                str(folder): (int(first), int(last)) for folder, first, last in head["folders"]
            }
            self._starts = np.frombuffer(offsets, np.int64) if offsets else np.zeros(1, np.int64)
            self._content = memoryview(content) if content else memoryview(b"")
            self._numbers = np.frombuffer(batch.column("member").buffers()[1] or b"", _NUMBERS)
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
        """How many files there are."""
        return len(self._starts) - 1

    def find(self, name: str) -> Member | None:
        """A file by its path in the release; None if it is not there."""
        folder, _, last = name.rpartition("/")
        low, high = self._rows.get(folder, (0, 0))
        base = last.encode(errors="surrogateescape")
        frame = base[_FRAME]
        row = low + int(frame) - 1 if frame.isdigit() else high  # of a whole recording
        if not (low <= row < high and self._name(row) == base):
            row = bisect_left(range(high), base, low, high, key=self._name)
            if row == high or self._name(row) != base:
                return None
        return self._member(row)

    def has_folder(self, folder: str) -> bool:
        """Whether a folder of the release has anything in it."""
        return folder in self._children

    def folders_in(self, folder: str) -> list[str]:
        """The names of a folder's folders."""
        return [*self._children.get(folder, ())]

    def files_in(self, folder: str) -> list[tuple[str, Member]]:
        """The names of a folder's files in order, and where they are."""
        low, high = self._rows.get(folder, (0, 0))
        return [
            (self._name(row).decode(errors="surrogateescape"), self._member(row))
            for row in range(low, high)
        ]

    def number_of(self, member: Member) -> int:
        """Return a number that changes with a file, and with the archive that it is in."""
        state = self.states.get(self.archives[member.archive])
        return member.version << 32 | zlib.crc32(repr(state).encode())

    def _name(self, row: int) -> bytes:
        return bytes(self._content[self._starts.item(row) : self._starts.item(row + 1)])

    def _member(self, row: int) -> Member:
        return Member._make(self._numbers.item(row))

    def _add_folder(self, folder: str) -> None:
        self._children.setdefault(folder, {})
        while folder:
            folder, _, name = folder.rpartition("/")
            siblings = self._children.setdefault(folder, {})
            if name in siblings:
                break
            siblings[name] = None


def write_members(
    path: Path, listings: Sequence[Listing], states: Mapping[str, tuple[int, str]]
) -> None:
    """Write the list of some archives' files, as `Members` has it; raises DatarootError for a file that is twice."""
    import pyarrow as pa

    folders = sorted({folder for listing in listings for folder in listing.folders})
    number_of = {folder: number for number, folder in enumerate(folders)}
    parts = []
    for archive, listing in enumerate(listings):
        numbers = np.zeros(len(listing.names), _NUMBERS)
        for name, values in {**listing.numbers, "archive": archive}.items():
            numbers[name] = values
        parts.append(
            pa.table(
                {
                    "folder": np.array([number_of[name] for name in listing.folders], np.int32)[
                        listing.folder
                    ],
                    "name": pa.array(
                        [name.encode(errors="surrogateescape") for name in listing.names],
                        pa.large_binary(),
                    ),
                    "member": pa.FixedSizeBinaryArray.from_buffers(
                        pa.binary(_NUMBERS.itemsize),
                        len(numbers),
                        [None, pa.py_buffer(numbers.tobytes())],
                    ),
                }
            )
        )
    table = (
        pa.concat_tables(parts)
        .sort_by([("folder", "ascending"), ("name", "ascending")])
        .combine_chunks()
    )
    archives = [listing.archive for listing in listings]
    folder = table["folder"].to_numpy()
    _check_once(table, folder, folders, archives)
    last = np.cumsum(np.bincount(folder, minlength=len(folders)))
    rows = zip(folders, [0, *last.tolist()], last.tolist(), strict=False)
    head = json.dumps({"form": FORM, "archives": archives, "folders": list(rows), "states": states})
    table = table.select(["name", "member"]).replace_schema_metadata({_HEAD: head.encode()})
    with replacing(path) as temporary, pa.ipc.new_file(str(temporary), table.schema) as writer:
        writer.write_batch(
            pa.RecordBatch.from_arrays(
                [_one(column) for column in table.columns], schema=table.schema
            )
        )


def _one(column: Any) -> Any:
    """A column's only piece; an empty one has none."""
    import pyarrow as pa

    return column.chunk(0) if column.num_chunks else pa.array([], column.type)


def _check_once(
    table: Any, folder: AnyArray, folders: Sequence[str], archives: Sequence[str]
) -> None:
    """Raise DatarootError if two rows, which are neighbours as they are sorted, are of the same file."""
    import pyarrow.compute as pc

    if len(folder) < 2:
        return
    names = table["name"]
    same = (folder[1:] == folder[:-1]) & pc.equal(names[1:], names[:-1]).to_numpy()
    if same.any():
        row = int(np.flatnonzero(same)[0])
        name = names[row].as_py().decode(errors="backslashreplace")
        members = (
            np.frombuffer(table["member"][each].as_py(), _NUMBERS) for each in (row, row + 1)
        )
        first, second = (archives[int(member["archive"][0])] for member in members)
        where = f"in {first} and in {second}" if first != second else f"twice in {first}"
        more = f", and so are {same.sum() - 1:,} more" if same.sum() > 1 else ""
        raise DatarootError(
            f"{folders[folder[row]]}/{name}: is {where}{more}; keep one of them in this folder"
        )
