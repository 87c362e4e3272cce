"""Sensor files of several agents or moments: one that is not there is an error, or is left out and counted."""

from __future__ import annotations

import logging
from collections import Counter
from typing import get_args

from deepaccident_devkit.errors import MissingFileError
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import OnError

_logger = logging.getLogger(__name__)


class MissingFiles:
    """Asks for sensor files, and counts by channel those that are not there (`on_missing='skip'`)."""

    def __init__(self, root: ReleasePath, on_missing: OnError = "raise") -> None:
        """Files below a release's folder; raises ChoiceError."""
        self._root = root
        self._skips = choice("on_missing", on_missing, get_args(OnError)) == "skip"
        self._asked: Counter[str] = Counter()
        self._missing: Counter[str] = Counter()

    def has(self, path: ReleasePath, channel: str) -> bool:
        """Whether a file is there, to be read; raises MissingFileError if it is not and nothing may be left out."""
        self._asked[channel] += 1
        if path.exists():
            return True
        if not self._skips:
            raise MissingFileError(
                f"{path}: no such file; unpack the archive that holds it, or leave out what is missing with "
                "on_missing='skip'"
            )
        self._missing[channel] += 1
        return False

    def tell(self) -> None:
        """Log one warning with the number of files that were left out, if any."""
        if self._missing:
            counts = ", ".join(f"{self._missing[name]} of {self._asked[name]} of {name}" for name in self._missing)
            _logger.warning("left out files that are not in %s: %s", self._root, counts)
