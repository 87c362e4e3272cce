"""The log of a run: one JSON object a line, each with its `step`; a resumed run drops what it does again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.reading import read_bytes

NAME = "log.jsonl"


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The rows of a run's log, in order; none if it has no log. A last line that is cut off is left out.

    Raises:
        ConfigError: a line that is no JSON object.
    """
    path = folder / NAME
    if not path.is_file():
        return []
    rows = []
    for number, line in enumerate(read_bytes(path, "bundle").split(b"\n")[:-1], 1):
        try:
            row = parsed_json(line)
        except ValueError:
            row = None
        if not isinstance(row, dict) or not isinstance(row.get("step"), int):
            raise ConfigError(f"{path}:{number}: expected a JSON object with a step; remove the line, or the file")
        rows.append(row)
    return rows


def cut_log(folder: Path, step: int) -> None:
    """Drop the rows after a step."""
    kept = [row for row in read_log(folder) if row["step"] <= step]
    write_bytes(folder / NAME, "".join(f"{json.dumps(row)}\n" for row in kept).encode())


def add_to_log(folder: Path, row: Mapping[str, Any]) -> None:
    """Add a row, and have it on disk."""
    with (folder / NAME).open("a", encoding="utf-8") as file:
        file.write(f"{json.dumps(row)}\n")
