"""The open choices of a scenario file: ranges of numbers and lists of values; each draw takes one value of them."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np


@dataclass(frozen=True, slots=True)
class Fixed:
    """One value."""

    value: Any

    def draw(self, _rng: np.random.Generator) -> Any:
        """The value."""
        return self.value

    def alternatives(self) -> Iterator[Any]:
        """The value."""
        yield self.value


@dataclass(frozen=True, slots=True)
class Range:
    """A span of numbers, each equally likely, both ends included.

    Attributes:
        low: the smallest.
        high: the largest.
        whole: whether only whole numbers are drawn.
    """

    low: float
    high: float
    whole: bool

    def draw(self, rng: np.random.Generator) -> float:
        """A number of the span."""
        if self.whole:
            return int(rng.integers(int(self.low), int(self.high) + 1))
        return float(rng.uniform(self.low, self.high))

    def alternatives(self) -> Iterator[float]:
        """The smallest and the largest."""
        yield from (self.low, self.high)


@dataclass(frozen=True, slots=True)
class OneOf:
    """One of several values, each equally likely; a value that is listed twice is twice as likely."""

    options: tuple[Choice, ...]

    def draw(self, rng: np.random.Generator) -> Any:
        """A value."""
        return self.options[int(rng.integers(len(self.options)))].draw(rng)

    def alternatives(self) -> Iterator[Any]:
        """The values; of a range both ends."""
        for option in self.options:
            yield from option.alternatives()


@dataclass(frozen=True, slots=True)
class Items:
    """A list whose items are all kept."""

    items: tuple[Choice, ...]

    def draw(self, rng: np.random.Generator) -> tuple[Any, ...]:
        """All items, each drawn."""
        return tuple(item.draw(rng) for item in self.items)

    def alternatives(self) -> Iterator[Items]:
        """Only itself: the open choices are in its items."""
        yield self


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a scenario.

    Attributes:
        kind: its dataclass.
        where: its line of the file, such as `mine.yaml:12`.
        path: such as `actors[1]`; empty for the whole file.
        fields: those that the file names, in the order of the dataclass; the others have their defaults.
        lines: field that the file names → its line, such as `mine.yaml:13`.
    """

    kind: type[Any]
    where: str
    path: str
    fields: Mapping[str, Choice]
    lines: Mapping[str, str]

    def draw(self, rng: np.random.Generator) -> Any:
        """An instance of the dataclass."""
        return self.kind(**{name: choice.draw(rng) for name, choice in self.fields.items()})

    def alternatives(self) -> Iterator[Part]:
        """Only itself: the open choices are in its fields."""
        yield self

    def values(self, name: str) -> tuple[Any, ...]:
        """The alternatives of a field; its default if the file does not name it."""
        if name in self.fields:
            return tuple(self.fields[name].alternatives())
        return (default_of(self.kind, name),)

    def instances(self) -> Iterator[Any]:
        """Each instance that can be drawn (of a range only its ends), made one at a time."""
        options = [tuple(_instances(choice)) for choice in self.fields.values()]
        for values in itertools.product(*options):
            yield self.kind(**dict(zip(self.fields, values, strict=True)))

    def line(self, name: str) -> str:
        """The line of a field; if the file does not name the field, the line of the part."""
        return self.lines.get(name, self.where)

    def path_of(self, name: str) -> str:
        """The path of a field, such as `actors[1].from`."""
        key = key_of(name)
        return f"{self.path}.{key}" if self.path else key


Choice: TypeAlias = Fixed | Range | OneOf | Items | Part


def _instances(choice: Choice) -> Iterator[Any]:
    for value in choice.alternatives():
        yield from value.instances() if isinstance(value, Part) else (value,)


def has_list(choice: Choice) -> bool:
    """Whether a value in it is drawn from a list of several."""
    if isinstance(choice, Items):
        return any(has_list(item) for item in choice.items)
    if isinstance(choice, Part):
        return any(has_list(inner) for inner in choice.fields.values())
    return isinstance(choice, OneOf)


def key_of(name: str) -> str:
    """A field's key in a file: the field `from_arm` has the key `from`, which cannot be a name in Python."""
    return "from" if name == "from_arm" else name


def default_of(kind: type[Any], name: str) -> Any:
    """The default of a field."""
    field = next(field for field in dataclasses.fields(kind) if field.name == name)
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
