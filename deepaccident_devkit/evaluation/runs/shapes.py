"""The schema of a bundle's JSON files: what they must hold before anything of them is used."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from deepaccident_devkit.reading import shortened

_MOST_CHARACTERS: Final = 1000
"""Of a text that is used: a name, a path, a checksum."""
LINE: Final = "a printable text"
WHOLE: Final = "a whole number"
NUMBER: Final = "a number"
OBJECT: Final = "an object"
EACH: Final = ""
"""Stands for every name of an object."""
SUMMARY: Final = {
    "task": LINE,
    "protocol": LINE,
    "switches": OBJECT,
    "horizon": NUMBER,
    "split": LINE,
    "samples": LINE,
    "scope": LINE,
    "agents": (None, [LINE]),
    "counts": {"left_out": WHOLE},
    "partial": (None, {"mark": LINE}),
    "release": {"version": LINE, "dataroot": LINE},
    "results": {"path": LINE, "form": (None, OBJECT)},
    "breakdowns": {EACH: {"resampling": OBJECT}},
    "environment": {EACH: LINE},
}
"""Of `metrics_summary.json` all that is used, and not only compared."""
SCENARIOS: Final = {"scenarios": {EACH: {EACH: (None, LINE)}}}
FILES: Final = {"files": {EACH: LINE}}


def misfits(value: Any, shape: Any, place: str = "") -> Iterator[str]:
    """What of a JSON value does not fit a shape, as clauses such as `counts/left_out: expected a whole number`.

    Args:
        value: as JSON holds it.
        shape: a kind above; an object's shapes by name, which it must have; [shape] of a list's entries; (None, shape)
            of what may be null.
        place: of the value, for the clauses.
    """
    if isinstance(shape, tuple):
        if value is not None:
            yield from misfits(value, shape[1], place)
    elif isinstance(shape, dict) and isinstance(value, dict):
        for name, inner in shape.items() if EACH not in shape else ((name, shape[EACH]) for name in value):
            here = f"{place}/{shortened(name)}" if place else shortened(name)
            if name in value:
                yield from misfits(value[name], inner, here)
            else:
                yield f"{here} is missing"
    elif isinstance(shape, list) and isinstance(value, list):
        for number, each in enumerate(value):
            yield from misfits(each, shape[0], f"{place}/{number}")
    elif not isinstance(shape, str) or not _is(value, shape):
        expected = shape if isinstance(shape, str) else OBJECT if isinstance(shape, dict) else "a list"
        yield f"{place}: expected {expected}, found {type(value).__name__} {shortened(repr(value))}"


def _is(value: object, kind: str) -> bool:
    if kind == LINE:
        return isinstance(value, str) and len(value) <= _MOST_CHARACTERS and value.isprintable()
    types = {WHOLE: int, NUMBER: int | float, OBJECT: dict}
    return isinstance(value, types[kind]) and not isinstance(value, bool)
