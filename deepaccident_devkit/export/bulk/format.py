"""What a format is: its settings, and how a unit of scenarios is planned and written."""

from __future__ import annotations

import hashlib
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, get_args

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.export.bulk.output import Link, Output
from deepaccident_devkit.selection import parse_where
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS, MINI_SPLITS, SPLITS
from deepaccident_devkit.text import choice, settle_choices

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

_DIGEST: Final = re.compile(r"-[0-9a-f]{16}\Z")
_MOST_CHARACTERS: Final = 150
"""Of a name made from a token; the devkit's and the formats' endings come to it, and systems allow 255."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """What one worker writes at once. No two units write the same file.

    Attributes:
        name: of its folder of parts: letters, digits, `_`, `-` and dots, no dot first; unique.
        scenarios: tokens, in order.
    """

    name: str
    scenarios: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """How much will be written, about.

    Attributes:
        samples: agents at moments.
        files: to be made.
        bytes: in them.
        linked_files: files of the release that will be linked, or copied.
        linked_bytes: in those.
    """

    samples: int = 0
    files: int = 0
    bytes: int = 0
    linked_files: int = 0
    linked_bytes: int = 0

    def __add__(self, other: Plan) -> Plan:
        """Both together."""
        return Plan(**{name: getattr(self, name) + getattr(other, name) for name in Plan.__slots__})


@dataclass(frozen=True, kw_only=True)
class Format(ABC):
    """A format with its settings; cheap to pickle. Each format adds settings of its own.

    Attributes:
        split: only scenarios of this split, or of a split file of your own; None for all.
        where: only scenarios that match all of these filters (`deepaccident_devkit.selection`).
        agents: only what these recorded.
        link: how files of the release are put there where the format takes them as they are: `hard` links, else
            `symbolic` ones, else copies.

    Raises:
        ChoiceError: no such split, agent or way; or a filter is no text of that form.
    """

    split: str | os.PathLike[str] | None = None
    where: tuple[str, ...] = ()
    agents: tuple[str, ...] = AGENTS
    link: Link = "hard"

    name: ClassVar[str]
    """One word, as on the command line."""
    channels: ClassVar[tuple[str, ...]] = CHANNELS
    """Sensors whose files decide what is written; tables and infos name files, there or not."""
    nothing: ClassVar[str] = "no chosen agent recorded one of these scenarios; choose other agents or scenarios"
    """Why there may be no sample to write, and the remedy."""
    beside: ClassVar[tuple[str, ...]] = ()
    """Formats whose exports may lie in the same folder already."""

    def __post_init__(self) -> None:
        """Check the choices, give them their usual spelling, and put the agents in their usual order."""
        settle_choices(self, {"link": get_args(Link)})
        if isinstance(self.split, str) and not self.split.endswith(".txt"):
            object.__setattr__(self, "split", choice("split", self.split, (*SPLITS, *MINI_SPLITS)))
        for name in ("where", "agents"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, (getattr(self, name),))
        for text in self.where:
            parse_where(text)
        object.__setattr__(self, "where", tuple(self.where))
        named = {choice("agents", name, AGENTS) for name in self.agents}
        if not named:
            raise ChoiceError(f"agents: expected some of {', '.join(AGENTS)}, found none")
        object.__setattr__(self, "agents", tuple(name for name in AGENTS if name in named))

    def settings(self) -> dict[str, Any]:
        """Everything that decides what is written, but the release; for JSON. Links show the same as copies."""
        found = asdict(self)
        del found["link"]
        return {**found, "split": None if self.split is None else os.fspath(self.split)}

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """Agents and channels of the sensor files that decide what is written."""
        return tuple(product(self.agents, self.channels))

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:  # noqa: ARG002 - for those that ask it
        """The chosen scenarios as units: one each."""
        return [Unit(name=flat_name(token), scenarios=(token,)) for token in scenarios]

    def check(self, dataset: Dataset, folder: Path) -> None:  # noqa: B027 - most formats add to nothing
        """Refuse a folder that lacks what the format adds to; raises ExportError or ConfigError."""

    @abstractmethod
    def plan(self, dataset: Dataset, unit: Unit) -> Plan:
        """About how much a unit is; fast, so it reads at most a few sensor files."""

    @abstractmethod
    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a unit; called again for the same unit after an interruption."""

    @abstractmethod
    def finish(self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]) -> None:
        """Write what spans units, from the parts that they left; called again after an interruption."""


def flat_name(token: str) -> str:
    """A scenario's token as the name of one folder: `<type>__<scenario>`; no two tokens have the same.

    A digest of the token stands at the end if characters were replaced (all but ASCII letters, digits, `_`, `-` and
    dots), if the name was too long, or if it looks as if it had one.
    """
    plain = token.replace("/", "__")
    name = re.sub(r"[^\w.-]", "_", plain, flags=re.ASCII)[:_MOST_CHARACTERS]
    if name == plain and not _DIGEST.search(name):
        return name
    return f"{name}-{hashlib.blake2b(token.encode(), digest_size=8).hexdigest()}"
