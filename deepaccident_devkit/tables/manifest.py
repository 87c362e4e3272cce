"""The manifest of an index: what it was made from, and what is broken."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.files import write_bytes

SCHEMA_VERSION = 2
"""Counts up whenever the stored columns or their meaning change."""
MANIFEST_FILE = "manifest.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem(ShortRepr):
    """What is wrong with one scenario.

    Attributes:
        scenario: its token.
        messages: a sentence each, naming file, line and remedy.
        digest: of its files as they were when this was found; empty if they are not the cause.
    """

    scenario: str
    messages: tuple[str, ...]
    digest: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """What an index was made from.

    Attributes:
        schema_version: of the code that made it.
        fingerprint: digest of the release's folder, meta and split file times.
        tables: name of the folder that holds the tables; empty if none could be made.
        table_files: the size and checksum of each file in it, by name.
        problems: the scenarios left out.
        notices: what else was left aside, a sentence each.
    """

    schema_version: int
    fingerprint: str
    tables: str
    table_files: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()
    notices: tuple[str, ...] = ()


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of an index folder; None if there is none that today's code can use."""
    content = _content(folder)
    try:
        return _parsed(content) if content.get("schema_version") == SCHEMA_VERSION else None
    except (ValueError, KeyError, TypeError, OverflowError):
        return None


def stored_schema_version(folder: Path) -> int | None:
    """The schema version that an index folder's manifest states, known here or not; None if it states none."""
    version = _content(folder).get("schema_version")
    return version if isinstance(version, int) and not isinstance(version, bool) else None


def stored_tables(folder: Path) -> str:
    """The name of the tables' folder that an index folder's manifest states, of any schema; empty if it states none."""
    return str(_content(folder).get("tables", ""))


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest: from then on the tables that it names are the index."""
    write_bytes(folder / MANIFEST_FILE, json.dumps(asdict(manifest), indent=1).encode())


def _content(folder: Path) -> Mapping[str, object]:
    """The manifest's JSON object, empty if there is none."""
    try:
        content = json.loads((folder / MANIFEST_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _parsed(content: Mapping[str, object]) -> Manifest:
    problems = content["problems"]
    notices = content["notices"]
    table_files = content["table_files"]
    if not isinstance(problems, list) or not isinstance(notices, list) or not isinstance(table_files, dict):
        raise TypeError("not a manifest")
    if content["tables"] and not table_files:
        raise ValueError("tables without files")
    return Manifest(
        schema_version=SCHEMA_VERSION,
        fingerprint=str(content["fingerprint"]),
        tables=str(content["tables"]),
        table_files={str(name): (int(size), str(checksum)) for name, (size, checksum) in table_files.items()},
        problems=tuple(
            Problem(scenario=entry["scenario"], messages=tuple(entry["messages"]), digest=entry["digest"])
            for entry in problems
        ),
        notices=tuple(map(str, notices)),
    )
