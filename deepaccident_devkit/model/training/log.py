"""The log of a run: one JSON object a line, each with its `step`; a resumed run drops what it does again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.json_text import as_record, parsed_json
from deepaccident_devkit.reading import fault_text, read_bytes

NAME = "log.jsonl"


class _Row(msgspec.Struct):
    """What readers need of a row."""

    step: Annotated[int, msgspec.Meta(ge=0, le=1 << 53)]
    losses: dict[str, float] | None = None
    validation: dict[str, float] | None = None


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The rows of a run's log, in order; none if it has no log. A last line that is cut off is left out.

    Raises:
        ConfigError: it cannot be read, or a line is no JSON object of a step.
    """
    path = folder / NAME
    if not path.is_file():
        return []
    try:
        lines = read_bytes(path, "bundle").split(b"\n")[:-1]
    except OSError as error:
        raise ConfigError(f"{path}: {fault_text(error)}; remove the file") from error
    return [_row(f"{path}:{number}", line) for number, line in enumerate(lines, 1)]


def cut_log(folder: Path, step: int) -> None:
    """Drop the rows after a step."""
    kept = [row for row in read_log(folder) if row["step"] <= step]
    write_bytes(folder / NAME, "".join(f"{json.dumps(row)}\n" for row in kept).encode())


def add_to_log(folder: Path, row: Mapping[str, Any]) -> None:
    """Add a row, and have it on disk."""
    with (folder / NAME).open("a", encoding="utf-8") as file:
        file.write(f"{json.dumps(row)}\n")


def _row(where: str, line: bytes) -> dict[str, Any]:
    try:
        row: dict[str, Any] = parsed_json(line)
        as_record(row, _Row)
    except ValueError as error:
        raise ConfigError(
            f"{where}: expected a JSON object with a step ({error}); remove the line, or the file"
        ) from error
    return row
