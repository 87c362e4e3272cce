"""What is still open in a scenario file: ranges of numbers and lists of values, from which each draw takes one."""

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
    """A span of numbers, all alike; both ends are in it.

    Attributes:
        low: the least.
        high: the most.
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
        """The least and the most."""
        yield from (self.low, self.high)


@dataclass(frozen=True, slots=True)
class OneOf:
    """One of several values, each as likely; one that stands there twice is twice as likely."""

    options: tuple[Choice, ...]

    def draw(self, rng: np.random.Generator) -> Any:
        """A value."""
        return self.options[int(rng.integers(len(self.options)))].draw(rng)

    def alternatives(self) -> Iterator[Any]:
        """The values, and both ends of those that are ranges."""
        for option in self.options:
            yield from option.alternatives()


@dataclass(frozen=True, slots=True)
class Items:
    """A list, all of which holds."""

    items: tuple[Choice, ...]

    def draw(self, rng: np.random.Generator) -> tuple[Any, ...]:
        """All items, each drawn."""
        return tuple(item.draw(rng) for item in self.items)

    def alternatives(self) -> Iterator[Items]:
        """Itself: what is open lies within the items."""
        yield self


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a scenario.

    Attributes:
        kind: its dataclass.
        where: line of the file, such as `mine.yaml:12`.
        path: such as `actors[1]`; empty for the whole.
        fields: what the file says, in the order of the dataclass; the rest has its default.
        lines: of the fields that the file names, such as `mine.yaml:13`.
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
        """Itself: what is open lies within the fields."""
        yield self

    def values(self, name: str) -> tuple[Any, ...]:
        """The alternatives of a field; its default if the file does not name it."""
        if name in self.fields:
            return tuple(self.fields[name].alternatives())
        return (default_of(self.kind, name),)

    def instances(self) -> Iterator[Any]:
        """All that it can be drawn as, of a range its ends; made as they are asked for."""
        options = [tuple(_instances(choice)) for choice in self.fields.values()]
        for values in itertools.product(*options):
            yield self.kind(**dict(zip(self.fields, values, strict=True)))

    def line(self, name: str) -> str:
        """Where a field stands, or else the part."""
        return self.lines.get(name, self.where)

    def path_of(self, name: str) -> str:
        """Such as `actors[1].from`."""
        key = key_of(name)
        return f"{self.path}.{key}" if self.path else key


Choice: TypeAlias = Fixed | Range | OneOf | Items | Part


def _instances(choice: Choice) -> Iterator[Any]:
    for value in choice.alternatives():
        yield from value.instances() if isinstance(value, Part) else (value,)


def key_of(name: str) -> str:
    """A field's key in a file: `from` cannot be a name in Python."""
    return "from" if name == "from_arm" else name


def default_of(kind: type[Any], name: str) -> Any:
    """What a field is if nothing is said of it."""
    field = next(field for field in dataclasses.fields(kind) if field.name == name)
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
