"""The kinds of findings, with severity, meaning and remedy (docs/validation.md)."""

import json
from dataclasses import dataclass
from pathlib import Path

from deepaccident_devkit.release.fingerprints import INDEX_REMEDY
from deepaccident_devkit.tables import Severity


@dataclass(frozen=True, slots=True)
class Code:
    """A kind of finding.

    Attributes:
        severity: How serious such findings are.
        meaning: One sentence for the docs.
        remedy: What the user should do.
        known: Why the real release itself contains such findings; empty if it does not.
        deep: Whether only `--deep` finds it.
    """

    severity: Severity
    meaning: str
    remedy: str
    known: str = ""
    deep: bool = False


_DATA = json.loads(Path(__file__).with_suffix(".json").read_bytes())
# Name of a remedy that several kinds share → its text; other kinds state their text directly.
_REMEDIES = {**_DATA["remedies"], "update the index": INDEX_REMEDY}
CODES: dict[str, Code] = {}
"""Name of a kind of finding → its entry, read from `codes.json`."""
for _name, _fields in _DATA["codes"].items():
    _remedy = _fields["remedy"]
    CODES[_name] = Code(**{**_fields, "remedy": _REMEDIES.get(_remedy, _remedy)})
