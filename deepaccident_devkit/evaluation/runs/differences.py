"""`Difference`: one difference from a bundle, and how two JSON values differ."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.reading import shortened

ABSENT: Final = "absent"
"""Stands for a missing value."""
_LONGEST: Final = 60
"""Characters of a value that a line shows."""
_LONGEST_PLACE: Final = 300


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference(ShortRepr):
    """What a bundle says, and what was found.

    Attributes:
        where: its file and its place there, such as `metrics_summary.json: metrics/apa`.
        stored: what the bundle says.
        found: what was found.
    """

    where: str
    stored: Any
    found: Any

    def text(self) -> str:
        """In a line."""
        where = shortened(self.where if self.where.isprintable() else ascii(self.where), _LONGEST_PLACE)
        return f"{where}: stored {_short(self.stored)}, found {_short(self.found)}"

    def as_dict(self) -> dict[str, Any]:
        """By name."""
        return {"where": self.where, "stored": self.stored, "found": self.found}


def differing(stored: Any, found: Any, *, without: Collection[str] = ()) -> Iterator[tuple[str, Any, Any]]:
    """The paths at which two values differ that JSON can hold, and what is there; numbers must be exactly equal.

    Args:
        stored: one of them.
        found: the other.
        without: paths that do not count, with all below them.
    """
    yield from _differing(stored, found, "", frozenset(without))


def _differing(stored: Any, found: Any, path: str, without: frozenset[str]) -> Iterator[tuple[str, Any, Any]]:
    if path in without:
        return
    parts: Mapping[Any, tuple[Any, Any]] | None = None
    if isinstance(stored, Mapping) and isinstance(found, Mapping):
        names = dict.fromkeys([*stored, *found])
        parts = {name: (stored.get(name, ABSENT), found.get(name, ABSENT)) for name in names}
    elif isinstance(stored, list) and isinstance(found, list) and len(stored) == len(found):
        parts = dict(enumerate(zip(stored, found, strict=True)))
    if parts is None:
        if type(stored) is not type(found) or stored != found:
            yield path, stored, found
        return
    for name, (one, other) in parts.items():
        yield from _differing(one, other, f"{path}/{name}" if path else str(name), without)


def _short(value: Any) -> str:
    text = value if value == ABSENT else repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
