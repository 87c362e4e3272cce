"""What a scenario file can hold, and the designs, as text for people."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from inspect import cleandoc
from typing import Any

from deepaccident_devkit.synth.spec.catalogue import DESIGNS
from deepaccident_devkit.synth.spec.choices import default_of, key_of
from deepaccident_devkit.synth.spec.model import ScenarioSpec
from deepaccident_devkit.synth.spec.reading import FieldType, field_types, required_fields
from deepaccident_devkit.text import columns_text


@dataclass(frozen=True, slots=True)
class FieldEntry:
    """A line of the table of fields.

    Attributes:
        key: in the file.
        values: what it can be.
        default: if the file does not name it.
        meaning: one or more sentences.
    """

    key: str
    values: str
    default: str
    meaning: str


def field_tables() -> dict[str, tuple[FieldEntry, ...]]:
    """The fields of a scenario file, by where they stand, such as `road.hump`; the file itself is the empty text."""
    return dict(_tables(ScenarioSpec, ""))


def designs_text() -> str:
    """The twelve designs: number, name, junction."""
    rows = [("design  name", "junction")]
    for number, template in DESIGNS.items():
        (road,) = template.root.values("road")
        lights = "signalised" if road.values("signalized")[0] else "unsignalised"
        rows.append((f"{number:>6}  {template.name}", f"{road.values('kind')[0]}, {lights}"))
    return columns_text(rows)


def _tables(kind: type[Any], path: str) -> Iterator[tuple[str, tuple[FieldEntry, ...]]]:
    types_of, meanings = field_types(kind), _meanings(kind)
    required = required_fields(kind)
    yield (
        path,
        tuple(
            FieldEntry(
                key_of(name),
                _values(wanted),
                "required" if name in required else _default(default_of(kind, name)),
                meanings[name],
            )
            for name, wanted in types_of.items()
        ),
    )
    for name, wanted in types_of.items():
        inner, ending = (wanted.items, "[]") if wanted.items else (wanted, "")
        if dataclasses.is_dataclass(inner.base):
            yield from _tables(inner.base, f"{path}.{key_of(name)}{ending}".lstrip("."))


def _values(wanted: FieldType) -> str:
    if wanted.items is not None:
        many = f"list of {wanted.length}" if wanted.length else "list"
        return f"{many}: {_values(wanted.items)}"
    if dataclasses.is_dataclass(wanted.base):
        text = "keys and values"
    elif wanted.words:
        text = ", ".join(wanted.words)
    else:
        names = {str: "text", bool: "true, false", int: "whole number", float: "number"}
        text = names[wanted.base] + (f", {wanted.bounds}" if wanted.bounds else "")
    return f"{text}; or null" if wanted.optional else text


def _default(value: Any) -> str:
    if dataclasses.is_dataclass(value):
        return "its defaults"
    if isinstance(value, tuple):
        return f"[{', '.join(map(str, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return "null" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _meanings(kind: type[Any]) -> dict[str, str]:
    """Field name → its text in the docstring's section Attributes."""
    lines = cleandoc(kind.__doc__ or "").partition("Attributes:\n")[2].splitlines()
    meanings: dict[str, str] = {}
    name = ""
    for line in lines:
        if line.startswith(" " * 8):
            meanings[name] += f" {line.strip()}"
        elif line.strip():
            name, _, text = line.strip().partition(": ")
            meanings[name] = text
    return meanings
