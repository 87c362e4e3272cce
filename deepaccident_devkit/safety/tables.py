"""What the tables of safety share: CSV files, and words for agents and numbers."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.text import fixed_text


def write_csv(path: Path, rows: Iterable[Sequence[Any]]) -> Path:
    """Write rows, the heading first, into a file, over one that is there; None leaves a cell empty."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_bytes(path, text.getvalue().encode())
    return path


def short_agent(agent: str) -> str:
    """An agent's short name for headings: `ego`, `ego behind`, `other`, `other behind`, `infrastructure`."""
    return agent.replace("_vehicle", "").replace("_", " ")


def number_text(value: float | None, digits: int) -> str:
    """A number with so many decimals; a dash for None and NaN."""
    return "–" if value is None or math.isnan(value) else fixed_text(value, digits)
