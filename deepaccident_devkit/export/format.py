"""Base of export formats: settings, units of scenarios, output of a unit; shards and README."""

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
# Errors of a file system that cannot make a link; a full disk is another matter.
_NO_LINKS: Final = (
    errno.EXDEV,
    errno.EPERM,
    errno.EACCES,
    errno.EMLINK,
    errno.ENOTSUP,
    errno.ENOSYS,
)
_DIGEST_SUFFIX: Final = re.compile(r"-[0-9a-f]{16}\Z")
# In characters, of a name made from a token; endings of the devkit and of formats are appended, and
# systems allow 255.
_MAX_NAME_LENGTH: Final = 150
README: Final = "README.md"
SPLIT_NAMES: Final[Mapping[str | None, str]] = {
    "train": "train",
    "val": "validation",
    "test": "test",
    None: "unknown",
}
"""A scenario's split → its word in names of files; `datasets` expects these words."""
_README_TEMPLATE: Final = """\
---
{head}---

# {title}

Made by `deepaccident export {name}` of the DeepAccident devkit {devkit} from version {version} of \
DeepAccident
(https://deepaccident.github.io/). {selection}

Please cite the paper: Wang et al., DeepAccident: A Motion and Accident Prediction Benchmark for \
V2X Autonomous Driving,
AAAI 2024, https://arxiv.org/abs/2304.01168. The data are those of its authors, and their terms \
hold. The licence of the
devkit, Apache-2.0, is that of its code alone.

Everything is right-handed: x forward, y left, z up, yaw counter-clockwise; metres, seconds, \
radians. Quaternions are
w, x, y, z. Cameras have optical axes: x right, y down, z forward. Frames are numbered from 1 and \
0.1 s apart. The
impact of an accident is the last frame of its scenario.

{body}"""


@dataclass(slots=True, kw_only=True)
class Tally:
    """Counts of what was written.

    Attributes:
        samples: Number of agents at moments.
        files: Number of files written, not linked or copied.
        bytes: Their size.
        linked: Kind of link → number of files of the release that were linked or copied.
        left_out: Kind of data → how much of it the format cannot hold, or is missing in this
            (partial) release.
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
    """The folder that a unit is written into. Each file is complete or absent, and counted.

    Attributes:
        folder: Folder that paths are relative to.
        parts: Folder of the unit's own files for `finish`.
        tally: The counts so far; the format counts samples itself.
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
            link: Kind of links to the release's files; if it is impossible, the next kind is used.
            tally: Counts to add to; None for new ones.
            note: Function that is called with each path before something is written there.
        """
        self.folder, self.parts = folder, parts
        self.tally = Tally() if tally is None else tally
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
        """Yield the output of a folder; its files appear at once, and replace an older folder."""
        target = self._place(path)
        remove_in(self.folder, path)
        with replacing_folder(target) as temporary:
            yield Output(temporary, self.parts, self._link, self.tally)

    def link(self, source: ReleasePath, path: str, *, symbolic: bool = True) -> None:
        """Link a file of the release: tries a hard link, then a symbolic link, then a copy.

        A file in an archive is always copied.

        Args:
            source: The file.
            path: Path relative to the folder.
            symbolic: Whether a symbolic link is allowed, which shows the path of the file in the
                release.

        Raises:
            SensorFileError: it cannot be read.
        """
        try:
            if isinstance(source, StorePath):
                content, file = read_bytes(source, "image"), None
            else:
                content, file = b"", Path(os.path.realpath(source))
                open_file(file).close()
        except OSError as error:
            raise SensorFileError(
                f"{source}: {fault_text(error)}; restore it from its archive"
            ) from error
        with replacing(self._place(path)) as temporary:
            if file is None:
                temporary.write_bytes(content)
                link = "copy"
            else:
                link = _link_file(file, temporary, self._link, symbolic=symbolic)
        self.tally.linked[link] = self.tally.linked.get(link, 0) + 1

    def leave_out(self, kind: str, count: int = 1) -> None:
        """Count data that is not written; `kind` is a plain plural, such as `untracked boxes`."""
        if count:
            self.tally.left_out[kind] = self.tally.left_out.get(kind, 0) + count

    def _place(self, path: str) -> Path:
        self._note(path)
        return place_in(self.folder, path)


def _link_file(source: Path, target: Path, link: LinkKind, *, symbolic: bool) -> str:
    """Link `target` to `source` by the first possible kind, from `link` on, and return the kind."""
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
        name: Name of its folder of parts: letters, digits, `_`, `-` and dots, no dot first; unique.
        scenarios: Tokens, in order.
    """

    name: str
    scenarios: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Format(ABC):
    """A format with its settings; cheap to pickle. Each format adds settings of its own.

    Attributes:
        split: Only scenarios of this split, or of your own split file; None for all.
        where: Only scenarios that match all of these filters (`deepaccident_devkit.selection`).
        agents: Only recordings of these agents.
        link: How files of the release are included where the format takes them unchanged: `hard`
            links, otherwise `symbolic` ones, otherwise copies.

    Raises:
        ChoiceError: no such split, agent or kind of link; or a filter is not a valid text.
    """

    split: str | os.PathLike[str] | None = None
    where: tuple[str, ...] = ()
    agents: tuple[str, ...] = AGENTS
    link: LinkKind = "hard"

    name: ClassVar[str]
    """Name on the command line, a single word."""
    unit_word: ClassVar[str] = "scenario"
    """Name of a unit in texts."""
    channels: ClassVar[tuple[str, ...]] = CHANNELS
    """Sensors with files that decide what is written; tables and infos also name missing files."""
    nothing: ClassVar[str] = (
        "no chosen agent recorded one of these scenarios; choose other agents or scenarios"
    )
    """Why there may be no sample to write, and the remedy."""
    beside: ClassVar[tuple[str, ...]] = ()
    """Formats that may already have exports in the same folder."""

    def __post_init__(self) -> None:
        """Check the choices, and give them their usual spelling and order."""
        settle_choices(self, {"link": get_args(LinkKind)})
        if isinstance(self.split, str) and not self.split.endswith(".txt"):
            object.__setattr__(self, "split", split_choice(self.split))
        object.__setattr__(self, "where", tuple(members_of("where", self.where, "filters")))
        for text in self.where:
            parse_where(text)
        object.__setattr__(self, "agents", checked_names("agents", self.agents, AGENTS))

    def settings(self) -> dict[str, Any]:
        """Return all settings that decide what is written, for JSON.

        The release is not among them. Links are not either, since they have the content of copies.
        """
        values = asdict(self)
        del values["link"]
        return {**values, "split": None if self.split is None else os.fspath(self.split)}

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """Return agents and channels of the sensor files that decide what is written."""
        return tuple(product(self.agents, self.channels))

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:  # noqa: ARG002 - for other formats
        """Return the selected scenarios as units: one each."""
        return [Unit(name=flat_name(token), scenarios=(token,)) for token in scenarios]

    def check(self, dataset: Dataset, folder: Path) -> None:  # noqa: B027 - few formats add to one
        """Raise ExportError or ConfigError if a folder lacks the export that the format adds to."""

    @abstractmethod
    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a unit, and count its samples (`output.tally`).

        It is called again for the same unit after an interruption.
        """

    def finish(  # noqa: B027 - some formats write nothing more
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Write files that span units, from their parts; called again after an interruption."""


def checked_names(
    argument: str, requested: Sequence[str], names: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the requested names, each once, in their usual order.

    Raises ChoiceError, also for none.
    """
    valid_names = choices(argument, requested, names)
    return tuple(name for name in names if name in valid_names)


def flat_name(token: str) -> str:
    """Return a scenario's token as the name of one folder: `<type>__<scenario>`; it is unique.

    A digest of the token is appended if characters were replaced (all but ASCII letters, digits,
    `_`, `-` and dots), if the name was too long, or if it seems to end with a digest.
    """
    plain = token.replace("/", "__")
    name = re.sub(r"[^\w.-]", "_", plain, flags=re.ASCII)[:_MAX_NAME_LENGTH]
    if name == plain and not _DIGEST_SUFFIX.search(name):
        return name
    digest = hashlib.blake2b(token.encode(), digest_size=8).hexdigest()
    return f"{name}-{digest}"


def shards(
    dataset: Dataset, sizes: Mapping[str, int], limit: int
) -> dict[str, list[tuple[str, ...]]]:
    """Return name of a split → its shards, each a tuple of consecutive scenarios.

    Args:
        dataset: The release.
        sizes: Scenario → its size.
        limit: Largest sum of sizes in a shard, unless it has only one scenario.
    """
    groups: dict[str, list[tuple[str, ...]]] = {name: [] for name in SPLIT_NAMES.values()}
    free = dict.fromkeys(groups, 0)
    for scenario, size in sizes.items():
        split = SPLIT_NAMES[dataset.scenario.get(scenario)["split"]]
        split_groups = groups[split]
        if not split_groups or size > free[split]:
            split_groups.append(())
            free[split] = limit
        split_groups[-1] = (*split_groups[-1], scenario)
        free[split] -= size
    return {split: split_groups for split, split_groups in groups.items() if split_groups}


def readme(form: Format, dataset: Dataset, title: str, head: Mapping[str, Any], body: str) -> bytes:
    """Return a README.md with a head in YAML, the export's contents and source, and a body."""
    import yaml

    parts = [f"split {form.split}"] if form.split is not None else []
    parts += [f"scenarios where {text}" for text in form.where]
    scenarios, agents = ", ".join(parts) or "all scenarios", ", ".join(form.agents)
    return _README_TEMPLATE.format(
        head=yaml.safe_dump({"pretty_name": title, **head}, sort_keys=False, allow_unicode=True),
        title=title,
        name=form.name,
        devkit=__version__,
        version=dataset.version,
        selection=f"It holds {scenarios}, as recorded by {agents}.",
        body=body,
    ).encode()
