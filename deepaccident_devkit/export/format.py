"""The base of export formats: their settings, units and output, shards, and the README."""

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
from deepaccident_devkit.support.text import PathType, choices, members_of, settle_choices
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables.tables import split_choice
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS

LinkKind = Literal["hard", "symbolic", "copy"]
# Errors of a file system that cannot make a link, unlike a full disk.
_NO_LINKS = (
    errno.EXDEV,
    errno.EPERM,
    errno.EACCES,
    errno.EMLINK,
    errno.ENOTSUP,
    errno.ENOSYS,
)
_DIGEST_SUFFIX = re.compile(r"-[0-9a-f]{16}\Z")
# Largest number of characters of a name made from a token. Systems allow 255, but the devkit and
# the formats append endings.
_MAX_NAME_LENGTH = 150
README: Final = "README.md"
SPLIT_NAMES: Final[Mapping[str | None, str]] = {
    "train": "train",
    "val": "validation",
    "test": "test",
    None: "unknown",
}
"""Word for each split in the names of files; `datasets` expects these words."""
_README_TEMPLATE = """\
---
{head}---

# {title}

Made by `deepaccident export {name}` of the DeepAccident devkit {devkit} from version {version} of \
DeepAccident
(https://deepaccident.github.io/). {selection}

Please cite the paper: Wang et al., DeepAccident: A Motion and Accident Prediction Benchmark for \
V2X Autonomous Driving,
AAAI 2024, https://arxiv.org/abs/2304.01168. The data belong to the authors of the paper, whose \
terms apply. The licence
Apache-2.0 covers only the code of the devkit.

{axes} Frames are numbered from 1 and 0.1 s apart. The
impact of an accident is the last frame of its scenario.

{body}"""
_RIGHT_HANDED = """\
Everything is right-handed: x forward, y left, z up, yaw counter-clockwise; metres, seconds, \
radians. Quaternions are
w, x, y, z. Cameras have optical axes: x right, y down, z forward."""


@dataclass(slots=True, kw_only=True)
class Tally:
    """Counts of what was written.

    Attributes:
        samples: Number of samples, each of one agent at one moment.
        files: Number of files that were written, neither linked nor copied.
        bytes: Size of these files, bytes.
        linked: Number of files of the release that were linked or copied, by kind of link.
        left_out: Number of items, by kind of data, that are missing in this (partial) release or
            that the format cannot represent.
    """

    samples: int = 0
    files: int = 0
    bytes: int = 0
    linked: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)

    def add(self, other: Tally) -> None:
        """Add the counts of another tally."""
        self.samples += other.samples
        self.files += other.files
        self.bytes += other.bytes
        linked = Counter(self.linked) + Counter(other.linked)
        self.linked = dict(sorted(linked.items()))
        left_out = Counter(self.left_out) + Counter(other.left_out)
        self.left_out = dict(sorted(left_out.items()))


class Output:
    """The folder that a unit is written into. Each file is complete or absent, and is counted.

    Attributes:
        folder: Folder that paths are relative to.
        parts: Folder of the unit's own files for `finish`.
        tally: The counts so far; the format itself counts samples.
        contents: What the format says in the manifest about its files; only `finish` adds to it.
    """

    def __init__(
        self,
        folder: Path,
        parts: Path,
        link: LinkKind,
        tally: Tally | None = None,
        note: Callable[[str], object] = lambda _: None,
    ) -> None:
        """Prepare to write below `folder`.

        Args:
            folder: Folder that paths are relative to.
            parts: Folder of the unit's own files.
            link: Kind of links to files of the release; if it is impossible, the next kind is used.
            tally: Counts to add to; None for new ones.
            note: Function that is called with each path before anything is written there.
        """
        self.folder = folder
        self.parts = parts
        self.tally = Tally() if tally is None else tally
        self.contents: NamedValues = {}
        self._link = link
        self._note = note

    def __repr__(self) -> str:
        return f"<output in {self.folder}>"

    def write(self, path: str, content: bytes) -> None:
        """Write a file with a path relative to the folder."""
        with self.file(path) as temporary:
            temporary.write_bytes(content)

    @contextmanager
    def file(self, path: str) -> Iterator[Path]:
        """Yield a temporary path for a file that is written piece by piece."""
        with replacing(self._prepare_path(path)) as temporary:
            yield temporary
            size = temporary.stat().st_size
        self.tally.files += 1
        self.tally.bytes += size

    @contextmanager
    def whole_folder(self, path: str) -> Iterator[Output]:
        """Yield the output of a folder, whose files appear at once and replace an older folder."""
        target = self._prepare_path(path)
        remove_in(self.folder, path)
        with replacing_folder(target) as temporary:
            yield Output(temporary, self.parts, self._link, self.tally)

    def link(self, source: ReleasePath, path: str, *, symbolic: bool = True) -> None:
        """Link a file of the release, by a hard link, otherwise a symbolic link, otherwise a copy.

        A file in an archive is always copied.

        Args:
            source: The file.
            path: Path relative to the folder.
            symbolic: Whether a symbolic link is allowed, which shows the path of the file in the
                release.

        Raises:
            SensorFileError: If the file cannot be read.
        """
        content = b""
        file = None
        try:
            if isinstance(source, StorePath):
                content = read_bytes(source, "image")
            else:
                file = Path(os.path.realpath(source))
                open_file(file).close()
        except OSError as error:
            raise SensorFileError(
                f"{source}: {fault_text(error)}; restore it from its archive"
            ) from error
        with replacing(self._prepare_path(path)) as temporary:
            if file is None:
                temporary.write_bytes(content)
                link = "copy"
            else:
                link = _link_file(file, temporary, self._link, symbolic=symbolic)
        self.tally.linked[link] = self.tally.linked.get(link, 0) + 1

    def leave_out(self, kind: str, count: int = 1) -> None:
        """Count data that is not written; `kind` is its plain plural, such as `untracked boxes`."""
        if count:
            self.tally.left_out[kind] = self.tally.left_out.get(kind, 0) + count

    def _prepare_path(self, path: str) -> Path:
        self._note(path)
        return place_in(self.folder, path)


def _link_file(source: Path, target: Path, link: LinkKind, *, symbolic: bool) -> str:
    """Link `target` to `source` by the first possible kind from `link` on, and return that kind."""
    functions: dict[str, Callable[[], object]] = {
        "hard": lambda: os.link(source, target),
        "symbolic": lambda: target.symlink_to(source),
        "copy": lambda: shutil.copyfile(source, target),
    }
    kinds = get_args(LinkKind)
    for kind in kinds[kinds.index(link) :]:
        if kind == "symbolic" and not symbolic:
            continue
        try:
            functions[kind]()
        except OSError as error:
            if kind == "copy" or error.errno not in _NO_LINKS:
                raise
        else:
            break
    return str(kind)


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """Scenarios that one worker writes at once. No two units write the same file.

    Attributes:
        name: Name of the folder of its parts, which is unique and consists of letters, digits, `_`,
            `-` and dots, with no dot at the beginning.
        scenarios: Tokens, in order.
    """

    name: str
    scenarios: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Format(ABC):
    """A format with its settings, cheap to pickle. Each format adds its own settings.

    Attributes:
        split: Name of the only split to export, or path of your own split file; None for all.
        where: Filters that all exported scenarios match (`deepaccident_devkit.selection`).
        agents: Agents with recordings to export.
        link: Way to include files of the release that the format takes unchanged: `hard` links,
            otherwise `symbolic` ones, otherwise copies.

    Raises:
        ChoiceError: If there is no such split, agent or kind of link, or a filter is not a valid
            text.
    """

    split: PathType | None = None
    where: tuple[str, ...] = ()
    agents: tuple[str, ...] = AGENTS
    link: LinkKind = "hard"

    name: ClassVar[str]
    """Name on the command line, a single word."""
    unit_word: ClassVar[str] = "scenario"
    """Word for a unit in texts."""
    channels: ClassVar[tuple[str, ...]] = CHANNELS
    """Sensors whose files decide what is written; tables and infos also name missing files."""
    empty_reason: ClassVar[str] = (
        "none of the chosen agents recorded these scenarios; choose other agents or scenarios"
    )
    """Text that states why there may be no sample to write, and what to do about it."""
    compatible_formats: ClassVar[tuple[str, ...]] = ()
    """Formats that may already have exports in the same folder."""

    def __post_init__(self) -> None:
        """Check the choices, and give them their usual spelling and order."""
        settle_choices(self, {"link": get_args(LinkKind)})
        if isinstance(self.split, str) and not self.split.endswith(".txt"):
            object.__setattr__(self, "split", split_choice(self.split))
        object.__setattr__(self, "where", tuple(members_of("where", self.where, "filters")))
        for text in self.where:
            parse_where(text)
        object.__setattr__(self, "agents", check_names("agents", self.agents, AGENTS))

    def settings(self) -> dict[str, Any]:
        """Return all settings that decide what is written, for JSON.

        The release is not among them. The kind of links is not either, since links have the same
        content as copies.
        """
        values = asdict(self)
        del values["link"]
        if self.split is not None:
            values["split"] = os.fspath(self.split)
        return values

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """Return the agents and channels of the sensor files that decide what is written."""
        return tuple(product(self.agents, self.channels))

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:  # noqa: ARG002 - for other formats
        """Return the selected scenarios as units of one scenario each."""
        units = []
        for token in scenarios:
            units.append(Unit(name=flat_name(token), scenarios=(token,)))
        return units

    def survey(self, dataset: Dataset, scenarios: Sequence[str], folder: Path) -> str:  # noqa: ARG002 - for other formats
        """Check that the scenarios can be exported to a folder, before anything is written.

        Returns:
            A line about the files that will be exported, or an empty text.
        """
        return ""

    def check(self, dataset: Dataset, folder: Path) -> None:  # noqa: B027 - few formats add to one
        """Check that a folder contains the export to which this format adds files.

        Raises ExportError if it does not, and ConfigError if the export has other settings.
        """

    @abstractmethod
    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a unit, and count its samples in `output.tally`.

        After an interruption, it is called again for the same unit.
        """

    def finish(  # noqa: B027 - some formats write nothing more
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Write the files that span units from the units' parts.

        After an interruption, it is called again.
        """


def check_names(argument: str, requested: Sequence[str], names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the requested names, each once, in their usual order.

    Raises ChoiceError if a name is unknown, or if no name is requested.
    """
    requested_names = choices(argument, requested, names)
    return tuple(name for name in names if name in requested_names)


def flat_name(token: str) -> str:
    """Turn a scenario's token into a unique folder name: `<type>__<scenario>`.

    A digest of the token is appended if characters were replaced (all but ASCII letters, digits,
    `_`, `-` and dots), if the name was too long, or if it seems to end with a digest.
    """
    plain = token.replace("/", "__")
    name = re.sub(r"[^\w.-]", "_", plain, flags=re.ASCII)[:_MAX_NAME_LENGTH]
    if name == plain and not _DIGEST_SUFFIX.search(name):
        return name
    digest = hashlib.blake2b(token.encode(), digest_size=8).hexdigest()
    return f"{name}-{digest}"


def divide_into_shards(
    dataset: Dataset, sizes: Mapping[str, int], limit: int
) -> dict[str, list[tuple[str, ...]]]:
    """Divide scenarios into shards by their splits.

    Args:
        dataset: The release.
        sizes: Size of each scenario, by token.
        limit: Largest sum of sizes in a shard, unless it has only one scenario.

    Returns:
        The shards of each split, by the split's name; a shard is a tuple of consecutive scenarios.
    """
    shards: dict[str, list[tuple[str, ...]]] = {name: [] for name in SPLIT_NAMES.values()}
    free_sizes = dict.fromkeys(shards, 0)
    for scenario, size in sizes.items():
        split = SPLIT_NAMES[dataset.scenario.get(scenario)["split"]]
        split_shards = shards[split]
        if not split_shards or size > free_sizes[split]:
            split_shards.append(())
            free_sizes[split] = limit
        split_shards[-1] = (*split_shards[-1], scenario)
        free_sizes[split] -= size
    return {split: split_shards for split, split_shards in shards.items() if split_shards}


def format_readme(
    form: Format,
    dataset: Dataset,
    title: str,
    head: ReadOnlyValues,
    body: str,
    axes: str = _RIGHT_HANDED,
) -> bytes:
    """Return a README.md with a YAML head, the source and selection of the export, and a body.

    `axes` are the sentences about the axes of all values.
    """
    import yaml

    conditions = []
    if form.split is not None:
        conditions.append(f"split {form.split}")
    conditions += [f"scenarios where {text}" for text in form.where]
    scenarios = ", ".join(conditions) or "all scenarios"
    agents = ", ".join(form.agents)
    return _README_TEMPLATE.format(
        head=yaml.safe_dump({"pretty_name": title, **head}, sort_keys=False, allow_unicode=True),
        title=title,
        name=form.name,
        devkit=__version__,
        version=dataset.version,
        selection=f"It contains {scenarios}, as recorded by {agents}.",
        axes=axes,
        body=body,
    ).encode()
