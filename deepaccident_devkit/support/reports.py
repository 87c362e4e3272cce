"""`Report`: base of reports on many scenarios, as a value for JSON, named tables, and a text."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from deepaccident_devkit.errors import escaped
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import writable_folder, write_bytes
from deepaccident_devkit.support.text import columns_text, path_of

Row = Sequence[object]


@dataclass(frozen=True, slots=True)
class Table:
    """A table of texts.

    Attributes:
        rows: Rows of cells; the first row is the heading.
        notes: Sentences below the table.
    """

    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()

    def to_text(self, left: int = 1) -> str:
        """Return aligned lines, the first `left` columns flush left, and the notes."""
        return "\n".join([columns_text(self.rows, left=left), *self.notes])


class Report(ShortRepr):
    """Base of reports, which are dataclasses: their value and their tables make all their forms."""

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON; None for unknown values."""
        return asdict(self)  # type: ignore[call-overload,no-any-return]

    def named_tables(self) -> Mapping[str, Iterable[Row]]:
        """Return name of a table and its file → rows, the heading first; None is an empty cell."""
        return {}

    def to_json(self) -> str:
        """Return `to_dict` as one JSON object, without characters that UTF-8 lacks.

        File names may have such characters.
        """
        return escaped(json.dumps(self.to_dict(), indent=2, ensure_ascii=False))

    def to_text(self) -> str:
        """Return the tables, for a terminal."""
        tables = self.named_tables().items()
        return "\n\n".join(f"{name}\n{columns_text(_texts(rows))}" for name, rows in tables)

    def to_html(self) -> str:
        """Return the tables, for a notebook or a page; all texts are escaped."""
        return "".join(table_html(_texts(rows), name) for name, rows in self.named_tables().items())

    def to_csv(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write a file for each table into a folder, each atomically; return their paths.

        Existing files are replaced.

        Args:
            folder: Output folder; it is made if it does not exist.

        Raises:
            ConfigError: `folder` cannot be written to, or is not a folder.
        """
        folder = writable_folder(folder)
        return [
            write_csv(folder / f"{name}.csv", rows) for name, rows in self.named_tables().items()
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckReport(Report):
    """Base of reports on faults, which therefore also state what they compared.

    Attributes:
        compared: What is compared → its number.
        cannot_say: What could not be judged, and why, a sentence each.
    """

    compared: Mapping[str, int]
    cannot_say: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether no fault was found."""
        return True

    @property
    def exit_status(self) -> int:
        """Exit status: 1 if something is wrong, otherwise 2 if nothing was compared, or 0."""
        if not self.is_good:
            return 1
        if any(self.compared.values()):
            return 0
        return 2

    def to_text(self) -> str:
        """Return the tables, and what was compared."""
        return f"{Report.to_text(self)}\n\n{self.basis_text()}"

    def basis_text(self) -> str:
        """Return lines on what was compared, and what could not be judged."""
        compared = ", ".join(f"{number:,} {subject}" for subject, number in self.compared.items())
        return "\n".join([f"Compared: {compared}.", *map("Cannot say: {}".format, self.cannot_say)])


def write_csv(path: str | os.PathLike[str], rows: Iterable[Row]) -> Path:
    """Write rows, the heading first, into a file, replacing it; None is an empty cell."""
    text, target = io.StringIO(newline=""), path_of(path)
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_bytes(target, text.getvalue().encode())
    return target


def record_rows(kind: type[Any], records: Iterable[object]) -> list[Row]:
    """Return a row for each record of a dataclass, below the names of its fields."""
    names = tuple(field.name for field in fields(kind))
    return [names, *([getattr(record, name) for name in names] for record in records)]


def table_html(rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """Return a table for a notebook; the first row is the heading."""
    # Imported here, since only notebooks need it.
    from deepaccident_devkit.support.pages import rendered

    return rendered("notebook_table.html", rows=rows, caption=caption)


def _texts(rows: Iterable[Row]) -> list[list[str]]:
    return [["" if cell is None else str(cell) for cell in row] for row in rows]
