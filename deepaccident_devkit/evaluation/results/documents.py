"""A results file's JSON text as its records, read strictly."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results.entries import ENTRIES, entry_place, read_entries
from deepaccident_devkit.evaluation.results.faults import ContentError, at, decoded, parsed_json, shown
from deepaccident_devkit.evaluation.results.header import json_meta
from deepaccident_devkit.evaluation.results.records import FORMAT, FORMAT_VERSION, MotionFile, ResultsFile


class _Texts(msgspec.Struct):
    """The entries of each sample, not yet read."""

    results: dict[str, msgspec.Raw]


def read_document(content: bytes, path: Path) -> tuple[ResultsFile, dict[str, Any]]:
    """The records of a results file, and its meta.

    Args:
        content: the file's bytes.
        path: its path, for errors.

    Raises:
        ContentError: it is no JSON, or is not as its format says; names the token and the field.
        ResultsError: it is of another version.
    """
    try:
        document: ResultsFile = decoded(content, ResultsFile)  # type: ignore[arg-type]  # a union is a kind too
    except ContentError:
        _tell(content, path)
        raise
    return document, json_meta(_strict_meta(content, document))


def _strict_meta(content: bytes, document: ResultsFile) -> object:
    """The meta of a document, where no name stands twice, and all that was not read is JSON as `parsed_json` has it.

    The records have as many names as the text has colons outside texts. Where it has more, the strict reader says why;
    it takes four times as long.
    """
    if not isinstance(document, MotionFile):
        record = ENTRIES[document.task].record
        entries = list(chain.from_iterable(document.results.values()))
        optional = record.__struct_fields__[-len(record.__struct_defaults__) :]
        kinds = Counter(chain.from_iterable(map(type, map(attrgetter(name), entries)) for name in optional))
        ignored = [getattr(each, name) for each in entries for name in optional] if kinds[msgspec.Raw] else []
        unread = b"[%s]" % b",".join([document.meta, *(each for each in ignored if isinstance(each, msgspec.Raw))])
        # the file's own names, the task among them, those of samples, and those of entries
        names = (
            len(document.__struct_fields__) + 1 + len(document.results) + len(entries) * len(record.__struct_fields__)
        )
        colons = np.count_nonzero(np.frombuffer(content, np.uint8) == ord(":"))
        with suppress(ContentError):
            meta, *_ = parsed_json(unread)
            if names - kinds[msgspec.UnsetType] + unread.count(b":") == colons:
                return meta
    return parsed_json(content)["meta"]


def _tell(content: bytes, path: Path) -> None:
    """Say what is wrong with a results file, by its token or with its remedy, where that is known; raises."""
    told = parsed_json(content)
    if not isinstance(told, dict):
        raise ContentError(f"expected a JSON object, found {shown(told)}")
    if "format" not in told and "results" in told:
        raise ContentError(
            f'has no "format" (a nuScenes results file?); put "format": "{FORMAT}", "version": {FORMAT_VERSION} and '
            '"task": "detection" before its "meta" and "results"'
        )
    version = told.get("version")
    if told.get("format") == FORMAT and type(version) is int and version != FORMAT_VERSION:
        age, remedy = ("a newer", "update the devkit") if version > FORMAT_VERSION else ("an older", "write it again")
        raise ResultsError(
            f"{path}: version: {age} results format ({shown(version)}, this devkit's is {FORMAT_VERSION}); {remedy}"
        )
    kind = ENTRIES.get(str(told.get("task")))
    if kind is not None and isinstance(told.get("results"), dict):
        for token, entries in decoded(content, _Texts).results.items():
            with at(entry_place(token)):
                read_entries(bytes(entries), kind.record)
