"""What every results file begins with: format, version, task and meta; and sample tokens."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, get_args

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results.faults import ContentError, at, shown
from deepaccident_devkit.evaluation.results.form import FORMAT, FORMAT_VERSION, ResultsTask
from deepaccident_devkit.evaluation.results.strict_json import parsed_json

HEADER_FIELDS: Final = ("format", "version", "task", "meta")
BODY_FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    "motion": ("form", "shards"),
    "accident": ("results",),
    "detection": ("results",),
}
"""Task → the fields after the header's."""
_MOST_LEVELS: Final = 30
"""Of objects and lists in one another, in `meta`: people and reports read it."""
WORDS: Final = r"^[^/\\]+(/[^/\\]+)*$"
"""A regular expression of tokens: words with `/` between."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """What a results file says of itself.

    Attributes:
        task: what its predictions are of.
        meta: whatever its author says: the method, its training, who made it.
    """

    task: ResultsTask
    meta: Mapping[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """The header as it stands in the file."""
        return {"format": FORMAT, "version": FORMAT_VERSION, "task": self.task, "meta": self.meta}


def read_header(document: object, path: Path) -> Header:
    """The header of a results file; all fields of the document are there, and no others.

    Raises:
        ContentError: something else than the header of a results file.
        ResultsError: it is of another version.
    """
    if not isinstance(document, dict):
        raise ContentError(f"expected a JSON object, found {shown(document)}")
    if "format" not in document and "results" in document:
        raise ContentError(
            f'has no "format" (a nuScenes results file?); put "format": "{FORMAT}", "version": {FORMAT_VERSION} and '
            '"task": "detection" before its "meta" and "results"'
        )
    check_required(document, ("format", "version", "task"))
    if document["format"] != FORMAT:
        raise ContentError(f'format: expected "{FORMAT}", found {shown(document["format"])}')
    _check_version(document["version"], path)
    task = document["task"]
    if task not in get_args(ResultsTask):
        raise ContentError(f"task: expected one of {', '.join(get_args(ResultsTask))}, found {shown(task)}")
    check_fields(document, (*HEADER_FIELDS, *BODY_FIELDS[task]))
    if not isinstance(document["meta"], dict):
        raise ContentError(f"meta: expected an object, {{}} to say nothing, found {shown(document['meta'])}")
    return Header(task=task, meta=json_meta(document["meta"]))


def json_meta(meta: object) -> dict[str, Any]:
    """A copy of `meta` as JSON holds it; raises ContentError."""
    if not isinstance(meta, Mapping):
        raise ContentError(f"meta: expected a mapping of names to what JSON holds, found {type(meta).__name__}")
    try:
        text = json.dumps(dict(meta), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ContentError(f"meta: cannot be written as JSON ({error})") from error
    with at("meta"):
        copied: dict[str, Any] = parsed_json(text.encode())
        _check_levels(copied, _MOST_LEVELS)
    return copied


def check_fields(entry: Mapping[str, object], required: Sequence[str], optional: Sequence[str] = ()) -> None:
    """Whether an object has the fields it must have, and others only if it may; raises ContentError that names one."""
    check_required(entry, required)
    known = (*required, *optional)
    unknown = [name for name in entry if name not in known]
    if unknown:
        raise ContentError(f"{unknown[0]}: is no field of the format (expected {', '.join(known)})")


def check_required(entry: Mapping[str, object], required: Sequence[str]) -> None:
    """Whether an object has the fields it must have; raises ContentError that names the first that is missing."""
    missing = [name for name in required if name not in entry]
    if missing:
        raise ContentError(f"{missing[0]}: is missing (expected {', '.join(required)})")


def check_token(token: object) -> str:
    """A sample's token, if it could be one: words with `/` between; raises ContentError."""
    if not isinstance(token, str):
        raise ContentError(f"expected a sample's token, a text, found {shown(token)}")
    words = token.split("/")
    if not re.fullmatch(WORDS, token) or not token.isprintable() or {".", ".."} & set(words):
        raise ContentError(f"expected a sample's token, <scenario_type>/<name>/<agent>/<NNN>, found {token!r}")
    return token


def _check_levels(value: object, most: int) -> None:
    if not isinstance(value, dict | list):
        return
    if most == 0:
        raise ContentError(f"is nested more than {_MOST_LEVELS} levels deep")
    for each in value.values() if isinstance(value, dict) else value:
        _check_levels(each, most - 1)


def _check_version(version: object, path: Path) -> None:
    if type(version) is not int:
        raise ContentError(f"version: expected {FORMAT_VERSION}, found {shown(version)}")
    if version != FORMAT_VERSION:
        kind, remedy = ("a newer", "update the devkit") if version > FORMAT_VERSION else ("an older", "write it anew")
        raise ResultsError(
            f"{path}: version: {kind} results format ({shown(version)}, this devkit's is {FORMAT_VERSION}); {remedy}"
        )
