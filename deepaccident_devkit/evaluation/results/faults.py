"""`ContentError`: something in a results file is not as its format says; places are put before it on its way out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from deepaccident_devkit.errors import ResultsError

_SHOWN: Final = 80
"""Characters of a wrong value that an error shows."""


class ContentError(ValueError):
    """What is wrong, in half a sentence; `told_of` makes a ResultsError of it."""


@contextmanager
def at(place: str) -> Iterator[None]:
    """Put the place before what is found wrong there."""
    try:
        yield
    except ContentError as error:
        raise ContentError(f"{place}: {error}") from error


@contextmanager
def told_of(path: Path) -> Iterator[None]:
    """Raise ResultsError with the file's name and the remedy for what is found wrong in it, or if it cannot be read."""
    try:
        yield
    except ContentError as error:
        raise ResultsError(f"{path}: {error}; the format is described in schema/results/README.md") from error
    except OSError as error:
        raise ResultsError(f"{path}: cannot be read ({error}); give a results file that can") from error


def shown(value: object) -> str:
    """A value of a JSON file as it stands there, cut if it is long."""
    text = json.dumps(value, ensure_ascii=False, default=repr)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
