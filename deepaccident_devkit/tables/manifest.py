"""The manifest of an index: what it was made from, and what is broken."""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.reading import read_bytes
from deepaccident_devkit.tables.specs import table_specs
from deepaccident_devkit.tables.store import table_path

SCHEMA_VERSION = 3
"""Counts up whenever the stored columns, their meaning or the form of the index change."""
MANIFEST_FILE = "manifest.json"
TABLES_PREFIX = "tables-"
"""How the name of the tables' folder begins."""
_TABLES_FOLDER = re.compile(rf"{TABLES_PREFIX}\w+", re.ASCII)
_CHECKSUM = "checksum"
_LONGEST_TEXT = 20_000
"""Of a message or a name; a path has at most 4,096 bytes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem(ShortRepr):
    """What is wrong with one scenario.

    Attributes:
        scenario: its token.
        messages: a sentence each, naming file, line and remedy.
        contents: digest of its files as they were when this was found; empty if they are not the cause.
    """

    scenario: str
    messages: tuple[str, ...]
    contents: str = ""


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
    content = asdict(manifest)
    content[_CHECKSUM] = _checksum(content)
    write_bytes(folder / MANIFEST_FILE, json.dumps(content, indent=1).encode())


def _content(folder: Path) -> Mapping[str, object]:
    """The manifest's JSON object, empty if there is none."""
    try:
        content = json.loads(read_bytes(folder / MANIFEST_FILE, "index"))  # names of files may have half characters
    except (OSError, ValueError, RecursionError, MemoryError):
        return {}
    return content if isinstance(content, dict) else {}


def _checksum(content: Mapping[str, object]) -> str:
    """A checksum of all that a manifest says but its checksum."""
    rest = {name: value for name, value in content.items() if name != _CHECKSUM}
    return hashlib.blake2b(json.dumps(rest, sort_keys=True).encode(), digest_size=16).hexdigest()


def _parsed(content: Mapping[str, Any]) -> Manifest:
    if content[_CHECKSUM] != _checksum(content):
        raise ValueError("damaged")
    tables, table_files = _text(content["tables"]), content["table_files"]
    names = {table_path(Path(), table).name for table in table_specs()} if tables else set()
    if set(table_files) != names or (tables and not _TABLES_FOLDER.fullmatch(tables)):
        raise ValueError("not the tables of an index")
    return Manifest(
        schema_version=SCHEMA_VERSION,
        fingerprint=_text(content["fingerprint"]),
        tables=tables,
        table_files={name: (int(size), _text(checksum)) for name, (size, checksum) in table_files.items()},
        problems=tuple(
            Problem(
                scenario=_text(entry["scenario"]), messages=_texts(entry["messages"]), contents=_text(entry["contents"])
            )
            for entry in content["problems"]
        ),
        notices=_texts(content["notices"]),
    )


def _texts(values: Iterable[object]) -> tuple[str, ...]:
    return tuple(map(_text, values))


def _text(value: object) -> str:
    if not isinstance(value, str) or len(value) > _LONGEST_TEXT:
        raise TypeError("expected a text")
    return value
