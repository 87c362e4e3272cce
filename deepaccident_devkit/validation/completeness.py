"""Which files of a release are here and which are missing, by listing folders; only split files are opened."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.errors import ReleaseError, TokenError
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, find_release
from deepaccident_devkit.release.layout import frame_sizes
from deepaccident_devkit.release.store import Dataroot, open_dataroot, places_of, refused_archives
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.parallel import Places, run_batch
from deepaccident_devkit.support.reports import Report
from deepaccident_devkit.support.text import columns_text, counted, members_of, size_text
from deepaccident_devkit.tables.indexing import assign_splits
from deepaccident_devkit.tables.scan import SMALL_FILE_ENDINGS
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CAMERAS,
    CHANNEL_FORMAT,
    EXPECTED_MINI_SCENARIOS,
    EXPECTED_SCENARIOS,
    LIDAR,
    SPLITS,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

_META: Final = "meta"
# Kinds that the test split ships without.
_NOT_IN_TEST: Final = ("label", BEV_CAMERA, _META)
_UNKNOWN_SPLIT: Final = "unknown"
# Scenarios that the text lists at most.
_LISTED: Final = 10
# Of the text's tables: heading → kinds of files.
_COLUMNS: Final = {
    "calib": ("calib",),
    "label": ("label",),
    f"{len(CAMERAS)} cameras": CAMERAS,
    LIDAR: (LIDAR,),
    BEV_CAMERA: (BEV_CAMERA,),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FileCount:
    """Files of one kind of one agent, or `meta` files, in one or several scenarios.

    Attributes:
        agent: the agent's name; None for `meta`, of which a scenario has one.
        channel: `calib`, `label`, a sensor's channel, or `meta`.
        expected: one a frame of every scenario.
        missing: those of them that are not here, or have no bytes.
        bytes: of the files that are here.
    """

    agent: str | None
    channel: str
    expected: int
    missing: int
    bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitFiles(ShortRepr):
    """What is here of the scenarios of a split.

    Attributes:
        scenarios: how many are here, in part or whole.
        whole: those of them that lack nothing.
        expected: scenarios of the split in the whole release; None for a selection, and for unknown splits.
        files: for every agent and kind of file, then for `meta`.
    """

    scenarios: int
    whole: int
    expected: int | None
    files: Sequence[FileCount]


@dataclass(frozen=True, slots=True, kw_only=True)
class Completeness(Report):
    """Which files of a release are here, and which are missing.

    Attributes:
        dataroot: its folder.
        version: `v1` or `v1-mini`.
        scenarios: how many are here, in part or whole, and have a calib or label file, by which frames are counted.
        whole: those of them that lack nothing.
        total: the files of all of them; its agent is None, its channel `all`.
        splits: split → what is here of it; `unknown` for scenarios of no known split. The mini release is one split.
        lacking: scenario that is not whole → kind of file → how many are missing, of all agents.
        unreadable_archives: a sentence each: which one, what is wrong with it, and what to do. Files that they may hold
            are not here.
    """

    dataroot: str
    version: str
    scenarios: int
    whole: int
    total: FileCount
    splits: Mapping[str, SplitFiles]
    lacking: Mapping[str, Mapping[str, int]]
    unreadable_archives: Sequence[str]

    def to_text(self) -> str:
        """Blocks for a terminal: unreadable archives, each split, then the first scenarios that lack something."""
        refused = [f"cannot be read: {sentence}" for sentence in self.unreadable_archives]
        return "\n".join(
            [f"DeepAccident {self.version} at {self.dataroot}", *refused, self.section()]
        )

    def section(self) -> str:
        """The same without the release's name, as a part of another report."""
        total, here = self.total, self.total.expected - self.total.missing
        head = (
            f"{counted(self.scenarios, 'scenario')} here, {self.whole:,} whole\n"
            f"files here: {here:,} of {total.expected:,} ({size_text(total.bytes)}), missing: {total.missing:,}"
        )
        blocks = [head, *(_split_text(name, split) for name, split in self.splits.items())]
        if self.lacking:
            lines = [f"  {token}: {sum(kinds.values()):,}" for token, kinds in self.lacking.items()]
            more = (
                [f"  … and {len(lines) - _LISTED:,} more (--json lists all)"]
                if len(lines) > _LISTED
                else []
            )
            heading = f"scenarios that lack files, and how many ({len(lines):,}):"
            blocks.append("\n".join([heading, *lines[:_LISTED], *more]))
        return "\n\n".join(blocks)


def release_completeness(
    root: Dataroot,
    version: str = "v1",
    *,
    scenarios: Collection[str] | None = None,
    **how: Unpack[Engine],
) -> Completeness:
    """Count which files are here and which are missing, by split, agent and channel.

    Every agent is expected to have a file of every kind for each frame of a scenario, which its calib and label files
    number; the test split has no label, BEV camera and meta files. Broken scenarios count, too. A folder that cannot be
    listed counts as empty; `validate_release` names it.

    Args:
        root: the release, as of `DeepAccident`: a folder, archives, or a URL.
        version: `v1` or `v1-mini`.
        scenarios: tokens of the scenarios to look at; None for all.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        DatarootError: the folder is missing, holds no release, or a part of it that is no archive cannot be listed.
        VersionError: the version is unknown or not under this folder.
        SplitFileError: a split file cannot be read.
        TokenError: one of `scenarios` is not there.
    """
    layout = readable_release(root, version)
    folders = chosen_scenarios(layout, scenarios)
    files = run_batch(
        files_of, folders, label="listing files", places=Places(reads=places_of(layout.root)), **how
    )
    tokens = [folder.token for folder in folders]
    return completeness(
        layout, zip(tokens, files, strict=True), str(root), selected=scenarios is not None
    )


def readable_release(root: Dataroot, version: str) -> ReleaseLayout:
    """Return what lies under a dataroot, except in archives that cannot be listed; perhaps no scenario is left then.

    Raises:
        DatarootError, VersionError: as of `find_release`, if all archives can be listed.
    """
    place = open_dataroot(root, on_error="skip")
    try:
        return find_release(place, version)
    except ReleaseError:
        if not refused_archives(place):
            raise
        return ReleaseLayout(root=place, version=version, layout="A", scenarios=())


def chosen_scenarios(
    layout: ReleaseLayout, scenarios: Collection[str] | None
) -> list[ScenarioFolder]:
    """The scenarios of some tokens, None for all; raises TokenError."""
    if scenarios is None:
        return list(layout.scenarios)
    tokens = set(members_of("scenarios", scenarios, "tokens of scenarios"))
    chosen = [folder for folder in layout.scenarios if folder.token in tokens]
    unknown = sorted(tokens - {folder.token for folder in chosen})
    if unknown:
        raise TokenError(
            f"{layout.root}: has no scenario {unknown[0]!r}; its folders name {len(layout.scenarios)} others"
        )
    return chosen


def files_of(scenario: ScenarioFolder) -> tuple[FileCount, ...]:
    """The files of a scenario, agent by agent, then `meta`; none if neither calib nor labels number a frame."""
    found: dict[tuple[str, str], Mapping[int, int]] = {}
    for agent in AGENTS:
        for kind, ending in {**SMALL_FILE_ENDINGS, **CHANNEL_FORMAT}.items():
            found[agent, kind] = {}
            with suppress(ReleaseError):  # a finding of its own
                found[agent, kind] = frame_sizes(scenario.kind_folder(agent, kind), ending)
    frames = max(
        (
            frame
            for (_, kind), sizes in found.items()
            if kind in SMALL_FILE_ENDINGS
            for frame in sizes
        ),
        default=0,
    )
    if not frames:
        return ()
    counts = []
    for (name, kind), of_frames in found.items():
        sizes = [size for frame, size in of_frames.items() if size and frame <= frames]
        missing = frames - len(sizes)
        counts.append(
            FileCount(agent=name, channel=kind, expected=frames, missing=missing, bytes=sum(sizes))
        )
    meta = 0
    with suppress(OSError):
        meta = scenario.meta_path.stat().st_size
    return *counts, FileCount(
        agent=None, channel=_META, expected=1, missing=int(not meta), bytes=meta
    )


def completeness(
    layout: ReleaseLayout,
    found: Iterable[tuple[str, Sequence[FileCount]]],
    dataroot: str,
    *,
    selected: bool,
) -> Completeness:
    """The sum of the files of scenarios, of which `files_of` told; `selected` if these are not all of the release."""
    split_of = assign_splits(layout).split_of
    by_split: dict[str, dict[str, list[FileCount]]] = {}
    for token, counts in found:
        split = (
            layout.version if layout.version == "v1-mini" else split_of.get(token, _UNKNOWN_SPLIT)
        )
        if counts:
            by_split.setdefault(split, {})[token] = [_expected_in(split, count) for count in counts]
    every = {
        token: counts for scenarios in by_split.values() for token, counts in scenarios.items()
    }
    lacking = {token: kinds for token, counts in every.items() if (kinds := _missing_kinds(counts))}
    of_release = (
        {layout.version: EXPECTED_MINI_SCENARIOS}
        if layout.version == "v1-mini"
        else EXPECTED_SCENARIOS
    )
    expected = {} if selected else of_release
    splits = (
        split
        for split in (*SPLITS, layout.version, _UNKNOWN_SPLIT)
        if split in by_split or split in expected
    )
    return Completeness(
        dataroot=dataroot,
        version=layout.version,
        scenarios=len(every),
        whole=len(every) - len(lacking),
        total=_summed((count for counts in every.values() for count in counts), "all"),
        splits={
            split: _split_files(by_split.get(split, {}), lacking, expected.get(split))
            for split in splits
        },
        lacking=dict(sorted(lacking.items())),
        unreadable_archives=refused_archives(layout.root),
    )


def _summed(counts: Iterable[FileCount], channel: str, agent: str | None = None) -> FileCount:
    """The sum of some counts, under a name."""
    counts = list(counts)
    return FileCount(
        agent=agent,
        channel=channel,
        expected=sum(count.expected for count in counts),
        missing=sum(count.missing for count in counts),
        bytes=sum(count.bytes for count in counts),
    )


def _expected_in(split: str, count: FileCount) -> FileCount:
    """A scenario's count of a kind; the test split is not expected to have any file of some kinds."""
    if split == "test" and count.missing == count.expected and count.channel in _NOT_IN_TEST:
        return replace(count, expected=0, missing=0)
    return count


def _missing_kinds(counts: Iterable[FileCount]) -> dict[str, int]:
    kinds: Counter[str] = Counter()
    for count in counts:
        kinds[count.channel] += count.missing
    return dict(+kinds)


def _split_files(
    scenarios: Mapping[str, Sequence[FileCount]], lacking: Collection[str], expected: int | None
) -> SplitFiles:
    of_parts = zip(*scenarios.values(), strict=True)
    return SplitFiles(
        scenarios=len(scenarios),
        whole=len(scenarios.keys() - set(lacking)),
        expected=expected,
        files=[_summed(of_part, of_part[0].channel, of_part[0].agent) for of_part in of_parts],
    )


def _split_text(name: str, split: SplitFiles) -> str:
    of_release = "" if split.expected is None else f" of the release's {split.expected}"
    head = f"split {name}: {counted(split.scenarios, 'scenario')}{of_release} here, {split.whole:,} whole"
    if split.whole == split.scenarios:
        return head
    rows = [
        ("missing files", *_COLUMNS),
        *((agent, *_missing_texts(split.files, agent)) for agent in AGENTS),
    ]
    without_meta = next(count.missing for count in split.files if count.channel == _META)
    return "\n".join(
        [
            head,
            columns_text(rows),
            *([f"meta is missing of {without_meta:,}"] if without_meta else []),
        ]
    )


def _missing_texts(files: Sequence[FileCount], agent: str) -> Iterator[str]:
    """How many files of the kinds of each of `_COLUMNS` an agent lacks; - for none, `all` for as many as expected."""
    for kinds in _COLUMNS.values():
        count = _summed(
            (each for each in files if each.agent == agent and each.channel in kinds), ""
        )
        yield (
            "-"
            if not count.missing
            else "all"
            if count.missing == count.expected
            else f"{count.missing:,}"
        )
