"""Present and missing files of a release, by listing folders; only split files are opened."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, islice
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
# Scenarios that the text lists.
_MAX_LISTED_SCENARIOS: Final = 10
# Heading of a column in the text's tables → its kinds of files.
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
        agent: Name of the agent; None for `meta`, one file for each scenario.
        channel: `calib`, `label`, a sensor's channel, or `meta`.
        expected: Number of expected files, one a frame of every scenario.
        missing: Number of expected files that are absent or empty.
        bytes: Size of the present files.
    """

    agent: str | None
    channel: str
    expected: int
    missing: int
    bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitFiles(ShortRepr):
    """Present files of the scenarios of a split.

    Attributes:
        scenarios: Number of scenarios that are present, in part or completely.
        whole: Number of them that lack nothing.
        expected: Scenarios of the split in the complete release; None for a selection, and for
            unknown splits.
        files: Counts for every agent and kind of file, then for `meta`.
    """

    scenarios: int
    whole: int
    expected: int | None
    files: Sequence[FileCount]


@dataclass(frozen=True, slots=True, kw_only=True)
class Completeness(Report):
    """Present and missing files of a release.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        scenarios: Number of scenarios that are present, in part or completely, with a calib or
            label file, which number their frames.
        whole: Number of them that lack nothing.
        total: Sum of all files; its agent is None, its channel `all`.
        splits: Split → its present files; `unknown` for scenarios of no known split. The mini
            release is one split.
        lacking: Incomplete scenario → kind of file → number of missing files, of all agents.
        unreadable_archives: A sentence for each unreadable archive, with its fault and remedy.
            Files that it may hold count as missing.
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
        """Return blocks for a terminal: unreadable archives, splits, then incomplete scenarios."""
        refused = [f"cannot be read: {sentence}" for sentence in self.unreadable_archives]
        head = f"DeepAccident {self.version} at {self.dataroot}"
        return "\n".join([head, *refused, self.section()])

    def section(self) -> str:
        """Return the text without the release's name, as a part of another report."""
        total = self.total
        present = total.expected - total.missing
        head = (
            f"{counted(self.scenarios, 'scenario')} here, {self.whole:,} whole\n"
            f"files here: {present:,} of {total.expected:,} ({size_text(total.bytes)})"
            f", missing: {total.missing:,}"
        )
        blocks = [head, *(_split_text(name, split) for name, split in self.splits.items())]
        if self.lacking:
            blocks.append(self._lacking_text())
        return "\n\n".join(blocks)

    def _lacking_text(self) -> str:
        """Return a line for each of the first incomplete scenarios."""
        number = len(self.lacking)
        lines = [f"scenarios that lack files, and how many ({number:,}):"]
        for token, kinds in islice(self.lacking.items(), _MAX_LISTED_SCENARIOS):
            lines.append(f"  {token}: {sum(kinds.values()):,}")
        if number > _MAX_LISTED_SCENARIOS:
            lines.append(f"  … and {number - _MAX_LISTED_SCENARIOS:,} more (--json lists all)")
        return "\n".join(lines)


def release_completeness(
    root: Dataroot,
    version: str = "v1",
    *,
    scenarios: Collection[str] | None = None,
    **engine: Unpack[Engine],
) -> Completeness:
    """Count present and missing files by split, agent and channel.

    Every agent is expected to have a file of every kind for each frame of a scenario, which its
    calib and label files number; the test split has no label, BEV camera and meta files. Broken
    scenarios count, too. A folder that cannot be listed counts as empty; `validate_release` names
    it.

    Args:
        root: Dataroot of the release, as for `DeepAccident`: a folder, archives, or a URL.
        version: `v1` or `v1-mini`.
        scenarios: Tokens of the scenarios to examine; None for all.
        **engine: `workers`, `executor` and `progress` (`parallel.Engine`).

    Raises:
        DatarootError: The folder is missing, holds no release, or a part of it that is no archive
            cannot be listed.
        VersionError: The version is unknown or not under this folder.
        SplitFileError: A split file cannot be read.
        TokenError: A token of `scenarios` is not in the release.
    """
    layout = readable_release(root, version)
    folders = chosen_scenarios(layout, scenarios)
    places = Places(reads=places_of(layout.root))
    files = run_batch(files_of, folders, label="listing files", places=places, **engine)
    tokens = [folder.token for folder in folders]
    return completeness(
        layout, zip(tokens, files, strict=True), str(root), selected=scenarios is not None
    )


def readable_release(root: Dataroot, version: str) -> ReleaseLayout:
    """Return the release under a dataroot, without archives that cannot be listed.

    It may then have no scenario at all.

    Raises:
        DatarootError, VersionError: As in `find_release`, if all archives can be listed.
    """
    dataroot = open_dataroot(root, on_error="skip")
    try:
        return find_release(dataroot, version)
    except ReleaseError:
        if not refused_archives(dataroot):
            raise
        return ReleaseLayout(root=dataroot, version=version, layout="A", scenarios=())


def chosen_scenarios(
    layout: ReleaseLayout, scenarios: Collection[str] | None
) -> list[ScenarioFolder]:
    """Return the scenarios of tokens, None for all; raises TokenError."""
    if scenarios is None:
        return list(layout.scenarios)
    tokens = set(members_of("scenarios", scenarios, "tokens of scenarios"))
    folders = [folder for folder in layout.scenarios if folder.token in tokens]
    unknown = sorted(tokens - {folder.token for folder in folders})
    if unknown:
        message = f"{layout.root}: has no scenario {unknown[0]!r}"
        raise TokenError(f"{message}; its folders name {len(layout.scenarios)} others")
    return folders


def files_of(scenario: ScenarioFolder) -> tuple[FileCount, ...]:
    """Return the file counts of a scenario, agent by agent, then of `meta`.

    They are empty if neither calib nor label files number a frame.
    """
    sizes_by_kind: dict[tuple[str, str], Mapping[int, int]] = {}
    for agent in AGENTS:
        for kind, ending in {**SMALL_FILE_ENDINGS, **CHANNEL_FORMAT}.items():
            sizes_by_kind[agent, kind] = {}
            # `validate_release` reports a folder that cannot be listed.
            with suppress(ReleaseError):
                sizes_by_kind[agent, kind] = frame_sizes(scenario.kind_folder(agent, kind), ending)
    num_frames = 0
    for (_, kind), sizes in sizes_by_kind.items():
        if kind in SMALL_FILE_ENDINGS:
            num_frames = max([num_frames, *sizes])
    if not num_frames:
        return ()
    counts = []
    for (agent_name, kind), sizes in sizes_by_kind.items():
        present = [size for frame, size in sizes.items() if size and frame <= num_frames]
        count = FileCount(
            agent=agent_name,
            channel=kind,
            expected=num_frames,
            missing=num_frames - len(present),
            bytes=sum(present),
        )
        counts.append(count)
    meta_size = 0
    with suppress(OSError):
        meta_size = scenario.meta_path.stat().st_size
    meta = FileCount(
        agent=None, channel=_META, expected=1, missing=int(not meta_size), bytes=meta_size
    )
    return (*counts, meta)


def completeness(
    layout: ReleaseLayout,
    counts_by_token: Iterable[tuple[str, Sequence[FileCount]]],
    dataroot: str,
    *,
    selected: bool,
) -> Completeness:
    """Return the sum of the file counts of scenarios, by token.

    `selected` means that they are a selection of the release's scenarios.
    """
    split_of = assign_splits(layout).split_of
    is_mini = layout.version == "v1-mini"
    by_split: dict[str, dict[str, list[FileCount]]] = {}
    lacking: dict[str, dict[str, int]] = {}
    for token, scenario_counts in counts_by_token:
        if not scenario_counts:
            continue
        split = layout.version if is_mini else split_of.get(token, _UNKNOWN_SPLIT)
        counts = [_expect_in_split(split, count) for count in scenario_counts]
        by_split.setdefault(split, {})[token] = counts
        missing = _missing_kinds(counts)
        if missing:
            lacking[token] = missing
    expected: Mapping[str, int] = EXPECTED_SCENARIOS
    if is_mini:
        expected = {layout.version: EXPECTED_MINI_SCENARIOS}
    if selected:
        expected = {}
    splits = {}
    for split in (*SPLITS, layout.version, _UNKNOWN_SPLIT):
        if split in by_split or split in expected:
            scenarios = by_split.get(split, {})
            splits[split] = _split_files(scenarios, lacking, expected.get(split))
    num_scenarios = sum(map(len, by_split.values()))
    all_counts = chain.from_iterable(
        counts for scenarios in by_split.values() for counts in scenarios.values()
    )
    return Completeness(
        dataroot=dataroot,
        version=layout.version,
        scenarios=num_scenarios,
        whole=num_scenarios - len(lacking),
        total=_sum_counts(all_counts, "all"),
        splits=splits,
        lacking=dict(sorted(lacking.items())),
        unreadable_archives=refused_archives(layout.root),
    )


def _sum_counts(counts: Iterable[FileCount], channel: str, agent: str | None = None) -> FileCount:
    """Return the sum of counts, under a name."""
    counts = list(counts)
    return FileCount(
        agent=agent,
        channel=channel,
        expected=sum(count.expected for count in counts),
        missing=sum(count.missing for count in counts),
        bytes=sum(count.bytes for count in counts),
    )


def _expect_in_split(split: str, count: FileCount) -> FileCount:
    """Return a scenario's count of a kind; the test split may lack all files of some kinds."""
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
    files = []
    for counts in zip(*scenarios.values(), strict=True):
        files.append(_sum_counts(counts, counts[0].channel, counts[0].agent))
    return SplitFiles(
        scenarios=len(scenarios),
        whole=len(scenarios.keys() - set(lacking)),
        expected=expected,
        files=files,
    )


def _split_text(name: str, split: SplitFiles) -> str:
    of_release = "" if split.expected is None else f" of the release's {split.expected}"
    scenarios = counted(split.scenarios, "scenario")
    head = f"split {name}: {scenarios}{of_release} here, {split.whole:,} whole"
    if split.whole == split.scenarios:
        return head
    rows: list[Sequence[str]] = [("missing files", *_COLUMNS)]
    for agent in AGENTS:
        rows.append((agent, *_missing_texts(split.files, agent)))
    lines = [head, columns_text(rows)]
    missing_meta = next(count.missing for count in split.files if count.channel == _META)
    if missing_meta:
        lines.append(f"meta is missing of {missing_meta:,}")
    return "\n".join(lines)


def _missing_texts(files: Sequence[FileCount], agent: str) -> Iterator[str]:
    """Yield an agent's missing files for each of `_COLUMNS`: `-` for none, or `all`."""
    for kinds in _COLUMNS.values():
        counts = [count for count in files if count.agent == agent and count.channel in kinds]
        total = _sum_counts(counts, "")
        if not total.missing:
            yield "-"
        elif total.missing == total.expected:
            yield "all"
        else:
            yield f"{total.missing:,}"
