"""What a format is: settings, units of scenarios, what each of them writes into an export's folder; and shards."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, get_args

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.release.store import ReleasePath, StorePath
from deepaccident_devkit.selection import parse_where
from deepaccident_devkit.support.files import place_in, remove_in, replacing, replacing_folder
from deepaccident_devkit.support.reading import fault_text, open_file, read_bytes
from deepaccident_devkit.support.text import choices, members_of, settle_choices
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables.tables import split_choice
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS

LinkKind = Literal["hard", "symbolic", "copy"]
# What a file system answers that cannot make a link; a full disk is another matter.
_NO_LINKS: Final = (
    errno.EXDEV,
    errno.EPERM,
    errno.EACCES,
    errno.EMLINK,
    errno.ENOTSUP,
    errno.ENOSYS,
)
_DIGEST: Final = re.compile(r"-[0-9a-f]{16}\Z")
# Of a name made from a token; the devkit's and the formats' endings come to it, and systems allow 255.
_MOST_CHARACTERS: Final = 150
README: Final = "README.md"
SPLIT_NAMES: Final[Mapping[str | None, str]] = {
    "train": "train",
    "val": "validation",
    "test": "test",
    None: "unknown",
}
"""A scenario's split → what files are called by it; `datasets` expects these words."""
_TEXT: Final = """\
---
{head}---

# {title}

Made by `deepaccident export {name}` of the DeepAccident devkit {devkit} from version {version} of DeepAccident
(https://deepaccident.github.io/). {selection}

Please cite the paper: Wang et al., DeepAccident: A Motion and Accident Prediction Benchmark for V2X Autonomous Driving,
AAAI 2024, https://arxiv.org/abs/2304.01168. The data are those of its authors, and their terms hold. The licence of the
devkit, Apache-2.0, is that of its code alone.

Everything is right-handed: x forward, y left, z up, yaw counter-clockwise; metres, seconds, radians. Quaternions are
w, x, y, z. Cameras have optical axes: x right, y down, z forward. Frames are numbered from 1 and 0.1 s apart. The
impact of an accident is the last frame of its scenario.

{body}"""


@dataclass(slots=True, kw_only=True)
class Tally:
    """Counts of what was written.

    Attributes:
        samples: agents at moments.
        files: written, not linked or copied.
        bytes: in them.
        linked: way → files of the release that were linked or copied.
        left_out: what → how much of it the format cannot hold, or is not in this (partial) release.
    """

    samples: int = 0
    files: int = 0
    bytes: int = 0
    linked: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)

    def add(self, other: Tally) -> None:
        """Count what another one counts."""
        self.samples += other.samples
        self.files += other.files
        self.bytes += other.bytes
        self.linked = dict(sorted((Counter(self.linked) + Counter(other.linked)).items()))
        self.left_out = dict(sorted((Counter(self.left_out) + Counter(other.left_out)).items()))


class Output:
    """The folder that a unit is written into. Each file is complete or absent, and counted.

    Attributes:
        folder: where paths begin.
        parts: a folder of the unit's own for what `finish` puts together.
        tally: the counts so far; the format counts samples itself.
    """

    def __init__(
        self,
        folder: Path,
        parts: Path,
        link: LinkKind,
        tally: Tally | None = None,
        note: Callable[[str], object] = lambda _: None,
    ) -> None:
        """Write below `folder`, and link the release's files in this way or, where that cannot be, in the next one.

        `note` is called with each path before something is written there.
        """
        self.folder, self.parts, self.tally = folder, parts, Tally() if tally is None else tally
        self._link, self._note = link, note

    def __repr__(self) -> str:
        return f"<output in {self.folder}>"

    def write(self, path: str, content: bytes) -> None:
        """Write a file; the path is relative to the folder."""
        with self.file(path) as temporary:
            temporary.write_bytes(content)

    @contextmanager
    def file(self, path: str) -> Iterator[Path]:
        """Yield a temporary path for a file that is written piece by piece."""
        with replacing(self._place(path)) as temporary:
            yield temporary
            size = temporary.stat().st_size
        self.tally.files += 1
        self.tally.bytes += size

    @contextmanager
    def whole_folder(self, path: str) -> Iterator[Output]:
        """Yield the output of a folder whose files all appear at once, in the place of an older one."""
        target = self._place(path)
        remove_in(self.folder, path)
        with replacing_folder(target) as temporary:
            yield Output(temporary, self.parts, self._link, self.tally)

    def link(self, source: ReleasePath, path: str, *, symbolic: bool = True) -> None:
        """Link a file of the release: hard, else symbolic, else copied, as one out of an archive is.

        Args:
            source: the file.
            path: relative to the folder.
            symbolic: whether it may be a symbolic link, which shows the path of the file in the release.

        Raises:
            SensorFileError: it cannot be read.
        """
        try:
            if isinstance(source, StorePath):
                content, real = read_bytes(source, "image"), None
            else:
                content, real = b"", Path(os.path.realpath(source))
                open_file(real).close()
        except OSError as error:
            raise SensorFileError(
                f"{source}: {fault_text(error)}; restore it from its archive"
            ) from error
        with replacing(self._place(path)) as temporary:
            if real is None:
                temporary.write_bytes(content)
            way = (
                "copy" if real is None else _linked(real, temporary, self._link, symbolic=symbolic)
            )
        self.tally.linked[way] = self.tally.linked.get(way, 0) + 1

    def leave_out(self, what: str, count: int = 1) -> None:
        """Count what is not written; `what` is a plural in plain words, such as `untracked boxes`."""
        if count:
            self.tally.left_out[what] = self.tally.left_out.get(what, 0) + count

    def _place(self, path: str) -> Path:
        self._note(path)
        return place_in(self.folder, path)


def _linked(source: Path, target: Path, link: LinkKind, *, symbolic: bool) -> str:
    """Make `target` show `source`, and say how."""
    ways: dict[str, Callable[[], object]] = {
        "hard": lambda: os.link(source, target),
        "symbolic": lambda: target.symlink_to(source),
        "copy": lambda: shutil.copyfile(source, target),
    }
    for way in get_args(LinkKind)[get_args(LinkKind).index(link) :]:
        if symbolic or way != "symbolic":
            try:
                ways[way]()
            except OSError as error:
                if way == "copy" or error.errno not in _NO_LINKS:
                    raise
            else:
                break
    return str(way)


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """What one worker writes at once. No two units write the same file.

    Attributes:
        name: of its folder of parts: letters, digits, `_`, `-` and dots, no dot first; unique.
        scenarios: tokens, in order.
    """

    name: str
    scenarios: tuple[str, ...]


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
    link: LinkKind = "hard"

    name: ClassVar[str]
    """One word, as on the command line."""
    unit_word: ClassVar[str] = "scenario"
    """What a unit is, for people."""
    channels: ClassVar[tuple[str, ...]] = CHANNELS
    """Sensors whose files decide what is written; tables and infos name files, there or not."""
    nothing: ClassVar[str] = (
        "no chosen agent recorded one of these scenarios; choose other agents or scenarios"
    )
    """Why there may be no sample to write, and the remedy."""
    beside: ClassVar[tuple[str, ...]] = ()
    """Formats whose exports may lie in the same folder already."""

    def __post_init__(self) -> None:
        """Check the choices, give them their usual spelling, and put the agents in their usual order."""
        settle_choices(self, {"link": get_args(LinkKind)})
        if isinstance(self.split, str) and not self.split.endswith(".txt"):
            object.__setattr__(self, "split", split_choice(self.split))
        object.__setattr__(self, "where", tuple(members_of("where", self.where, "filters")))
        for text in self.where:
            parse_where(text)
        object.__setattr__(self, "agents", some_of("agents", self.agents, AGENTS))

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
    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a unit, and count its samples (`output.tally`); called again for the same one after an interruption."""

    def finish(  # noqa: B027 - some formats write nothing more
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Write what spans units, from the parts that they left; called again after an interruption."""


def some_of(argument: str, given: Sequence[str], names: tuple[str, ...]) -> tuple[str, ...]:
    """Those of the names that are given, each once, in their usual order; raises ChoiceError, for none too."""
    named = choices(argument, given, names)
    return tuple(name for name in names if name in named)


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


def shards(
    dataset: Dataset, sizes: Mapping[str, int], limit: int
) -> dict[str, list[tuple[str, ...]]]:
    """Name of a split → its shards: consecutive scenarios, sizes up to the limit, but at least one scenario."""
    found: dict[str, list[tuple[str, ...]]] = {name: [] for name in SPLIT_NAMES.values()}
    room = dict.fromkeys(found, 0)
    for scenario, size in sizes.items():
        split = SPLIT_NAMES[dataset.scenario.get(scenario)["split"]]
        if not found[split] or size > room[split]:
            found[split].append(())
            room[split] = limit
        found[split][-1] = (*found[split][-1], scenario)
        room[split] -= size
    return {split: groups for split, groups in found.items() if groups}


def readme(form: Format, dataset: Dataset, title: str, head: Mapping[str, Any], body: str) -> bytes:
    """A README.md with a head in YAML, what is in the export and where it is from, and a body."""
    import yaml

    selection = [f"split {form.split}"] if form.split is not None else []
    selection += [f"scenarios where {text}" for text in form.where]
    return _TEXT.format(
        head=yaml.safe_dump({"pretty_name": title, **head}, sort_keys=False, allow_unicode=True),
        title=title,
        name=form.name,
        devkit=__version__,
        version=dataset.version,
        selection=f"It holds {', '.join(selection) or 'all scenarios'}, as recorded by {', '.join(form.agents)}.",
        body=body,
    ).encode()
