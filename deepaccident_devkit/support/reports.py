"""`Report`: base of reports on many scenarios, as a value for JSON, named tables, and a text."""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from deepaccident_devkit.errors import escaped
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import writable_folder, write_bytes
from deepaccident_devkit.support.text import PathType, columns_text, path_of

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
        """Return the table as aligned lines, the first `left` columns flush left, and the notes."""
        lines = [columns_text(self.rows, left=left), *self.notes]
        return "\n".join(lines)


class Report(ShortRepr):
    """Base of reports, which are dataclasses; their values and tables make all other forms."""

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON; None for unknown values."""
        return asdict(self)  # type: ignore[call-overload,no-any-return]

    def named_tables(self) -> Mapping[str, Iterable[Row]]:
        """Return name (of a table and its file) → rows, heading first; None is an empty cell."""
        return {}

    def _readable_tables(self) -> Mapping[str, Iterable[Row]]:
        """Return `named_tables` as people read them, with names instead of identifiers."""
        return self.named_tables()

    def to_json(self) -> str:
        """Return `to_dict` as one JSON object, without characters that UTF-8 lacks.

        File names may have such characters.
        """
        return escaped(json.dumps(self.to_dict(), indent=2, ensure_ascii=False))

    def to_text(self) -> str:
        """Return the tables, for a terminal."""
        tables = []
        for name, rows in self._readable_tables().items():
            tables.append(f"{name}\n{columns_text(_format_rows(rows))}")
        return "\n\n".join(tables)

    def to_html(self) -> str:
        """Return the tables, for a notebook or a page; all texts are escaped."""
        html = ""
        for name, rows in self._readable_tables().items():
            html += table_html(_format_rows(rows), name)
        return html

    def to_csv(self, folder: PathType) -> list[Path]:
        """Write a file for each table into a folder, each atomically, and return their paths.

        Existing files are replaced.

        Args:
            folder: Output folder; it is made if it does not exist.

        Raises:
            ConfigError: If `folder` cannot be written to, or is not a folder.
        """
        folder = writable_folder(folder)
        tables = self.named_tables()
        return [write_csv(folder / f"{name}.csv", rows) for name, rows in tables.items()]


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckReport(Report):
    """Base of reports on faults, which also say what was compared.

    Attributes:
        compared: Subject of the comparison → number of compared objects.
        cannot_say: A sentence for each subject that could not be judged, with the reason.
    """

    compared: Mapping[str, int]
    cannot_say: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether no fault was found."""
        return True

    @property
    def exit_status(self) -> int:
        """Exit status: 1 for a fault, otherwise 2 if nothing was compared, and 0 if all is well."""
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
        counts = [f"{number:,} {subject}" for subject, number in self.compared.items()]
        lines = [f"Compared: {', '.join(counts)}."]
        lines += [f"Cannot say: {sentence}" for sentence in self.cannot_say]
        return "\n".join(lines)


def write_csv(path: PathType, rows: Iterable[Row]) -> Path:
    """Write rows as a CSV file, the heading first; None is an empty cell.

    An existing file is replaced.
    """
    text = io.StringIO(newline="")
    target = path_of(path)
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_bytes(target, text.getvalue().encode())
    return target


def record_rows(kind: type[Any], records: Iterable[object]) -> list[Row]:
    """Return a heading with a dataclass's field names, and a row for each record."""
    names = tuple(field.name for field in fields(kind))
    rows: list[Row] = [names]
    for record in records:
        rows.append([getattr(record, name) for name in names])
    return rows


def table_html(rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """Return a table for a notebook; the first row is the heading."""
    # Imported here, since only notebooks need it.
    from deepaccident_devkit.support.pages import rendered

    return rendered("notebook_table.html", rows=rows, caption=caption)


def _format_rows(rows: Iterable[Row]) -> list[list[str]]:
    """Return all cells as text."""
    text_rows = []
    for row in rows:
        text_rows.append(["" if cell is None else str(cell) for cell in row])
    return text_rows
