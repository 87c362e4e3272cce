"""Parts of bulk work, for job arrays: each job does every Nth scenario, and a last call puts the parts together."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias, TypeVar

from deepaccident_devkit.errors import ChoiceError, UnfinishedError
from deepaccident_devkit.files import place_in, remove_in

Item = TypeVar("Item")
MERGE: Final = "merge"


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several parts of about the same size.

    Attributes:
        number: from 1.
        count: how many parts there are.

    Raises:
        ChoiceError: there is no such part.
    """

    number: int
    count: int

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not 1 <= self.number <= self.count:
            raise ChoiceError(f"shard: expected K/N with K from 1 to N, such as 3/8, found {self}")

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    @classmethod
    def parse(cls, text: str) -> Shard:
        """The part that a text such as `3/8` names; raises ChoiceError."""
        found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip(), re.ASCII)
        if found is None:
            raise ChoiceError(f"shard: expected K/N with K from 1 to N, such as 3/8, found {text!r}")
        return cls(int(found[1]), int(found[2]))

    def of(self, items: Sequence[Item]) -> list[Item]:
        """Its items: every Nth one, as neighbours in the release take about the same time."""
        return list(items[self.number - 1 :: self.count])


Part: TypeAlias = Shard | Literal["merge"] | None
"""What a call does of some bulk work: a shard of it; `merge` puts shards together and does no such work; None all."""


def part_of(given: Part | str) -> Part:
    """What a call does, also of the text `3/8`; raises ChoiceError."""
    return Shard.parse(given) if isinstance(given, str) and given != MERGE else given  # type: ignore[return-value]


def mine(part: Part, items: Sequence[Item]) -> list[Item]:
    """The items that a call looks after: those of its shard, or all."""
    return part.of(items) if isinstance(part, Shard) else list(items)


def check_whole(wanted: Sequence[str], done: Collection[str], where: object) -> None:
    """Refuse to merge shards if some are missing.

    Args:
        wanted: names of all that there should be.
        done: names of what is there.
        where: the place that is named.

    Raises:
        UnfinishedError: something is missing.
    """
    missing = [name for name in wanted if name not in done]
    if missing:
        raise UnfinishedError(
            f"{where}: {len(missing)} of {len(wanted)} are not done, such as {missing[0]}; run their shards again, or "
            "the whole without a shard, which does what is left"
        )


@dataclass(frozen=True, slots=True)
class ShardFiles:
    """The files in which shards keep their results, in a folder beside the place that the whole will have.

    Attributes:
        out: the place of the whole.
        name: a digest of all that decides the results, so that other settings have other files.
        ending: of the files, with its dot.
    """

    out: Path
    name: str
    ending: str

    @property
    def folder(self) -> Path:
        """Where they lie."""
        return unfinished_folder(self.out)

    def path(self, shard: Shard) -> Path:
        """The file of a shard."""
        return self.folder / f"{self.name}.{shard.number}-of-{shard.count}{self.ending}"

    def found(self) -> list[Path]:
        """Those that are there; shards of several counts may be among them, and share items."""
        return sorted(self.folder.glob(f"{self.name}.*-of-*{self.ending}"))

    def remove(self) -> None:
        """Remove them, once the whole is written."""
        for path in self.found():
            remove_in(self.folder, path.name)
        with suppress(OSError):  # missing, or something else lies there
            self.folder.rmdir()


def unfinished_folder(out: Path) -> Path:
    """The folder beside `out` for what is not finished; raises OutputFolderError if it is a link."""
    place = out.absolute()
    return place_in(place.parent, f"{place.name}.unfinished", opened=True)
