"""What an index says of itself: what it was made from, and what is broken."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from deepaccident_devkit.files import write_bytes

SCHEMA_VERSION = 1
"""Counts up whenever the stored columns or their meaning change."""
_FILE = "manifest.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """What is wrong with one scenario.

    Attributes:
        scenario: its token.
        messages: a sentence each, naming file, line and remedy.
        digest: of its files as they were when this was found; empty where they are not the cause.
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
    try:
        content = json.loads((folder / _FILE).read_text(encoding="utf-8"))
        return _parsed(content) if content["schema_version"] == SCHEMA_VERSION else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest, which makes what it names the index."""
    write_bytes(folder / _FILE, json.dumps(asdict(manifest), indent=1).encode())


def _parsed(content: Mapping[str, object]) -> Manifest:
    problems = content["problems"]
    notices = content["notices"]
    table_files = content["table_files"]
    if not isinstance(problems, list) or not isinstance(notices, list) or not isinstance(table_files, dict):
        raise TypeError("not a manifest")
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
