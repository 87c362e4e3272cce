"""Present and missing files of a release, from folder listings; only split files are opened."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING

from deepaccident_devkit.errors import ReleaseError, TokenError
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, find_release
from deepaccident_devkit.release.layout import frame_sizes
from deepaccident_devkit.release.part import PartManifest, read_part_manifest, recording_name
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

_META = "meta"
# Kinds of files that the test split is shipped without.
_NOT_IN_TEST = ("label", BEV_CAMERA, _META)
_UNKNOWN_SPLIT = "unknown"
# Number of incomplete scenarios that the text lists.
_MAX_LISTED_SCENARIOS = 10
# Heading of a column in the text's tables → its kinds of files.
_COLUMNS = {
    "calib": ("calib",),
    "label": ("label",),
    f"{len(CAMERAS)} cameras": CAMERAS,
    LIDAR: (LIDAR,),
    BEV_CAMERA: (BEV_CAMERA,),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FileCount:
    """Counts of one agent's files of one kind (or of `meta` files), in one or more scenarios.

    Attributes:
        agent: Name of the agent; None for `meta`, which has one file per scenario.
        channel: `calib`, `label`, a sensor's channel, or `meta`.
        expected: Number of expected files: one per frame of each scenario.
        missing: Number of expected files that are absent or empty.
        bytes: Total size of the present files.
    """

    agent: str | None
    channel: str
    expected: int
    missing: int
    bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitFiles(ShortRepr):
    """Present files of the scenarios in one split.

    Attributes:
        scenarios: Number of scenarios that are present, partly or completely.
        whole: Number of scenarios without missing files.
        expected: Number of the split's scenarios in the complete release; None for a selection, and
            for unknown splits.
        files: Counts for each agent and kind of file, then for `meta`.
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
        scenarios: Number of scenarios that are present, partly or completely, and have a calib or
            label file, from which their frames are known.
        whole: Number of scenarios without missing files.
        total: Sum over all files; its agent is None, its channel `all`.
        splits: Split → its present files; `unknown` for scenarios of no known split. The mini
            release counts as one split.
        lacking: Incomplete scenario → kind of file → number of missing files, over all agents.
        unreadable_archives: A sentence per unreadable archive, with the fault and the remedy. Files
            that it may contain count as missing.
        is_part: Whether the release is a part that `deepaccident export release` wrote. Only the
            files that its manifest names are expected.
    """

    dataroot: str
    version: str
    scenarios: int
    whole: int
    total: FileCount
    splits: Mapping[str, SplitFiles]
    lacking: Mapping[str, Mapping[str, int]]
    unreadable_archives: Sequence[str]
    is_part: bool = False

    def to_text(self) -> str:
        """Return text for a terminal: unreadable archives, splits, then incomplete scenarios."""
        refused = [f"cannot be read: {sentence}" for sentence in self.unreadable_archives]
        head = f"DeepAccident {self.version} at {self.dataroot}"
        return "\n".join([head, *refused, self.section()])

    def section(self) -> str:
        """Return the text without the release's name, for use in another report."""
        total = self.total
        present = total.expected - total.missing
        release = "this part of a release" if self.is_part else "the release"
        head = (
            f"{counted(self.scenarios, 'scenario')} in {release}, {self.whole:,} complete\n"
            f"files present: {present:,} of {total.expected:,} ({size_text(total.bytes)})"
            f", missing: {total.missing:,}"
        )
        blocks = [head]
        for name, split in self.splits.items():
            blocks.append(_split_text(name, split))
        if self.lacking:
            blocks.append(self._lacking_text())
        return "\n\n".join(blocks)

    def _lacking_text(self) -> str:
        """Return a line per incomplete scenario, up to a maximum number."""
        number = len(self.lacking)
        lines = [f"missing files by scenario ({counted(number, 'scenario')}):"]
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

    For each frame of a scenario, every agent is expected to have a file of every kind. The frames
    are known from the calib and label files. In the test split, label, BEV camera and meta files
    are not expected; in a part of a release, only the files that its manifest names are. Broken
    scenarios count, too. A folder that cannot be listed counts as empty; `validate_release` reports
    it.

    Args:
        root: Dataroot of the release, as for `DeepAccident`: a folder, archives, or a URL.
        version: `v1` or `v1-mini`.
        scenarios: Tokens of the scenarios to examine; None for all.
        **engine: `workers`, `executor` and `progress` (`parallel.Engine`).

    Raises:
        DatarootError: If the folder is missing or contains no release, or a part that is not an
            archive cannot be listed.
        VersionError: If the version is unknown, or not in this folder.
        SplitFileError: If a split file cannot be read.
        TokenError: If a token of `scenarios` is not in the release.
    """
    layout = readable_release(root, version)
    folders = chosen_scenarios(layout, scenarios)
    places = Places(reads=places_of(layout.root))
    files = run_batch(files_of, folders, label="Listing files", places=places, **engine)
    tokens = [folder.token for folder in folders]
    return completeness(
        layout,
        zip(tokens, files, strict=True),
        str(root),
        selected=scenarios is not None,
        part=read_part_manifest(layout.root),
    )


def readable_release(root: Dataroot, version: str) -> ReleaseLayout:
    """Find the release under a dataroot, ignoring archives that cannot be listed.

    The result may have no scenario.

    Raises:
        DatarootError, VersionError: For the reasons in `find_release`, if all archives are listed.
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
    """Return the scenarios with these tokens (all if None); raise TokenError for unknown ones."""
    if scenarios is None:
        return list(layout.scenarios)
    tokens = set(members_of("scenarios", scenarios, "tokens of scenarios"))
    folders = [folder for folder in layout.scenarios if folder.token in tokens]
    known_tokens = {folder.token for folder in folders}
    unknown_tokens = sorted(tokens - known_tokens)
    if unknown_tokens:
        message = f"{layout.root}: has no scenario {unknown_tokens[0]!r}"
        scenarios_text = counted(len(layout.scenarios), "scenario")
        raise TokenError(f"{message}; its folders contain {scenarios_text}")
    return folders


def files_of(scenario: ScenarioFolder) -> tuple[FileCount, ...]:
    """Count the files of a scenario, agent by agent, then `meta`.

    The result is empty if neither calib nor label files show which frames exist.
    """
    sizes_by_kind = {}
    num_frames = 0
    for agent in AGENTS:
        for kind, ending in {**SMALL_FILE_ENDINGS, **CHANNEL_FORMAT}.items():
            sizes: Mapping[int, int] = {}
            # `validate_release` reports folders that cannot be listed.
            with suppress(ReleaseError):
                sizes = frame_sizes(scenario.kind_folder(agent, kind), ending)
            sizes_by_kind[agent, kind] = sizes
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
    part: PartManifest | None,
) -> Completeness:
    """Sum up the file counts of scenarios.

    Args:
        layout: The release.
        counts_by_token: Token of each scenario, with its file counts.
        dataroot: Folder of the release.
        selected: Whether these are only a selection of the release's scenarios.
        part: Manifest of a part of a release, which says what files are expected; None for a whole
            release.
    """
    split_of = assign_splits(layout).split_of
    is_mini = layout.version == "v1-mini"
    counts_by_split: dict[str, dict[str, list[FileCount]]] = {}
    all_counts: list[FileCount] = []
    lacking = {}
    for token, scenario_counts in counts_by_token:
        if not scenario_counts:
            continue
        split = layout.version
        if not is_mini:
            split = split_of.get(token, _UNKNOWN_SPLIT)
        counts = [_expect_in_split(split, count) for count in scenario_counts]
        counts = _expect_in_part(part, token, counts)
        counts_by_split.setdefault(split, {})[token] = counts
        all_counts += counts
        missing_kinds = Counter[str]()
        for count in counts:
            missing_kinds[count.channel] += count.missing
        missing = dict(+missing_kinds)
        if missing:
            lacking[token] = missing
    expected: Mapping[str, int] = EXPECTED_SCENARIOS
    if is_mini:
        expected = {layout.version: EXPECTED_MINI_SCENARIOS}
    if selected or part is not None:
        expected = {}
    splits = {}
    for split in (*SPLITS, layout.version, _UNKNOWN_SPLIT):
        if split in counts_by_split or split in expected:
            scenarios = counts_by_split.get(split, {})
            splits[split] = _split_files(scenarios, lacking, expected.get(split))
    num_scenarios = sum(map(len, counts_by_split.values()))
    return Completeness(
        dataroot=dataroot,
        version=layout.version,
        scenarios=num_scenarios,
        whole=num_scenarios - len(lacking),
        total=_sum_counts(all_counts, "all"),
        splits=splits,
        lacking=dict(sorted(lacking.items())),
        unreadable_archives=refused_archives(layout.root),
        is_part=part is not None,
    )


def _sum_counts(counts: Sequence[FileCount], channel: str, agent: str | None = None) -> FileCount:
    """Return the sum of counts as a count with this channel and agent."""
    return FileCount(
        agent=agent,
        channel=channel,
        expected=sum(count.expected for count in counts),
        missing=sum(count.missing for count in counts),
        bytes=sum(count.bytes for count in counts),
    )


def _expect_in_split(split: str, count: FileCount) -> FileCount:
    """Adapt a scenario's count of one kind of file to what its split expects.

    In the test split, some kinds of files may be missing completely.
    """
    is_optional = split == "test" and count.channel in _NOT_IN_TEST
    if is_optional and count.missing == count.expected:
        return replace(count, expected=0, missing=0)
    return count


def _expect_in_part(
    part: PartManifest | None, token: str, counts: list[FileCount]
) -> list[FileCount]:
    """Adapt a scenario's counts to what a part of a release should have, if it names the scenario.

    Args:
        part: Manifest of the part; None for a whole release.
        token: Token of the scenario.
        counts: Counts of the scenario's files.
    """
    if part is None or token not in part.contents:
        return counts
    content = part.contents[token]
    adapted_counts = []
    for count in counts:
        present = count.expected - count.missing
        expected = content.get(recording_name(count.agent, count.channel), 0)
        missing = max(expected - present, 0)
        adapted_counts.append(replace(count, expected=expected, missing=missing))
    return adapted_counts


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
    of_release = ""
    if split.expected is not None:
        of_release = f" of {split.expected} in the full release"
    scenarios = counted(split.scenarios, "scenario")
    head = f"split {name}: {scenarios}{of_release}, {split.whole:,} complete"
    if split.whole == split.scenarios:
        return head
    rows: list[Sequence[str]] = [("missing files", *_COLUMNS)]
    for agent in AGENTS:
        rows.append((agent, *_missing_texts(split.files, agent)))
    lines = [head, columns_text(rows)]
    missing_meta = next(count.missing for count in split.files if count.channel == _META)
    if missing_meta:
        lines.append(f"missing meta files: {missing_meta:,}")
    return "\n".join(lines)


def _missing_texts(files: Sequence[FileCount], agent: str) -> Iterator[str]:
    """Yield how many files an agent lacks in each of `_COLUMNS`: `-` for none, or `all`."""
    for kinds in _COLUMNS.values():
        counts = [count for count in files if count.agent == agent and count.channel in kinds]
        total = _sum_counts(counts, "")
        if not total.missing:
            yield "-"
        elif total.missing == total.expected:
            yield "all"
        else:
            yield f"{total.missing:,}"
