"""What a mutation is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from fault_injection.place import Place

Apply = Callable[[Place, np.random.Generator], str]
Only = Literal["accident", "normal"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mutation:
    """One way to damage a release.

    Attributes:
        name: its name in the table.
        group: what kind of file it damages.
        title: what it does, in a phrase.
        apply: damages a scenario; returns what was done.
        deep: whether only the sensors' files show it.
        harmless: why it cannot be found, or need not be; None for a fault.
        beyond: why `validate` need not find this fault; None if it must.
        only: the kind of scenario that it can damage; None for both.
    """

    name: str
    group: str
    title: str
    apply: Apply
    deep: bool = False
    harmless: str | None = None
    beyond: str | None = None
    only: Only | None = None


@dataclass(slots=True)
class Group:
    """Gathers the mutations of one module."""

    name: str
    deep: bool = False
    mutations: list[Mutation] = field(default_factory=list)

    def add(self, rows: Mapping[str, tuple[str, Apply]], **how: Any) -> None:
        """Enter a mutation a row: name → what it does, and the function; all have the same further fields."""
        for name, (says, apply) in rows.items():
            title = " ".join(says.split()).rstrip(".")
            self.mutations.append(
                Mutation(name=name, group=self.name, title=title, apply=apply, **{"deep": self.deep, **how})
            )

    def kind(self, **how: Any) -> Callable[[Apply], Apply]:
        """Enter the decorated function under its own name; its docstring says what it does."""

        def enter(apply: Apply) -> Apply:
            self.add({apply.__name__: (apply.__doc__ or "", apply)}, **how)
            return apply

        return enter


def cut(content: bytes, rng: np.random.Generator, *, end: int | None = None) -> bytes:
    """The beginning of a file: at least a byte stays and two go."""
    return content[: rng.integers(1, (end or len(content)) - 1)]


def garbage(rng: np.random.Generator, size: int) -> bytes:
    """Random bytes."""
    return rng.integers(0, 256, size=max(size, 16), dtype=np.uint8).tobytes()
