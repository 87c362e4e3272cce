"""`Report`: base of what is found out about many scenarios: a value for JSON, named tables, a text; and its tables."""

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
        rows: of cells; the first row is the heading.
        notes: sentences below it.
    """

    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()

    def to_text(self, left: int = 1) -> str:
        """Aligned lines, of which the first `left` columns are flush left, and the notes."""
        return "\n".join([columns_text(self.rows, left=left), *self.notes])


class Report(ShortRepr):
    """Base of reports, which are dataclasses: what a report says, and what its tables are, makes all its forms."""

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        return asdict(self)  # type: ignore[call-overload,no-any-return]

    def named_tables(self) -> Mapping[str, Iterable[Row]]:
        """Name of a table, and of its file → rows, the heading first; None leaves a cell empty."""
        return {}

    def to_json(self) -> str:
        """`to_dict` as one JSON object, in characters that UTF-8 has: a name of a file may have others."""
        return escaped(json.dumps(self.to_dict(), indent=2, ensure_ascii=False))

    def to_text(self) -> str:
        """The tables, for a terminal."""
        return "\n\n".join(
            f"{name}\n{columns_text(_texts(rows))}" for name, rows in self.named_tables().items()
        )

    def to_html(self) -> str:
        """The tables, for a notebook or a page; all texts are escaped."""
        return "".join(table_html(_texts(rows), name) for name, rows in self.named_tables().items())

    def to_csv(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write a file for each table into a folder, each atomically, over those that are there; returns their paths.

        Args:
            folder: where; it is made if it is not there.

        Raises:
            ConfigError: `folder` cannot be written to, or is not one.
        """
        folder = writable_folder(folder)
        return [
            write_csv(folder / f"{name}.csv", rows) for name, rows in self.named_tables().items()
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckReport(Report):
    """Base of reports on whether something is wrong, which therefore also say what they compared.

    Attributes:
        compared: what is compared → how many there were of it.
        cannot_say: what could not be judged, and why, a sentence each.
    """

    compared: Mapping[str, int]
    cannot_say: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether nothing wrong was found."""
        return True

    @property
    def exit_status(self) -> int:
        """Return 1 if something is wrong, else 2 if nothing was compared, else 0."""
        return 1 if not self.is_good else 0 if any(self.compared.values()) else 2

    def to_text(self) -> str:
        """The tables, and what was compared."""
        return f"{Report.to_text(self)}\n\n{self.basis_text()}"

    def basis_text(self) -> str:
        """Return lines that say what was compared, and what could not be judged."""
        compared = ", ".join(f"{number:,} {what}" for what, number in self.compared.items())
        return "\n".join([f"Compared: {compared}.", *map("Cannot say: {}".format, self.cannot_say)])


def write_csv(path: str | os.PathLike[str], rows: Iterable[Row]) -> Path:
    """Write rows, the heading first, into a file, over one that is there; None leaves a cell empty."""
    text, target = io.StringIO(newline=""), path_of(path)
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_bytes(target, text.getvalue().encode())
    return target


def record_rows(kind: type[Any], records: Iterable[object]) -> list[Row]:
    """A row for each record of a dataclass, below the names of its fields."""
    names = tuple(each.name for each in fields(kind))
    return [names, *([getattr(each, name) for name in names] for each in records)]


def table_html(rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """A table for a notebook; the first row is the heading."""
    from deepaccident_devkit.support.pages import rendered  # here: for notebooks alone

    return rendered("notebook_table.html", rows=rows, caption=caption)


def _texts(rows: Iterable[Row]) -> list[list[str]]:
    return [["" if cell is None else str(cell) for cell in row] for row in rows]
