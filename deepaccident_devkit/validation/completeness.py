"""Which files of a release are here and which are missing, by listing folders; only split files are opened."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from deepaccident_devkit.errors import ReleaseError, TokenError
from deepaccident_devkit.parallel import Places, run_batch
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, find_release, read_split_file
from deepaccident_devkit.release.layout import frame_sizes, names_without_calib
from deepaccident_devkit.release.store import Dataroot, ReleasePath, open_dataroot, places_of
from deepaccident_devkit.tables.scan import ENDINGS
from deepaccident_devkit.tables.split_assignment import assign_splits
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CHANNEL_FORMAT,
    CHANNELS,
    EXPECTED_MINI_SCENARIOS,
    EXPECTED_SCENARIOS,
    SPLITS,
)
from deepaccident_devkit.validation.completeness_report import (
    Completeness,
    FileCount,
    LackingScenario,
    SplitFiles,
    summed,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine

_META = "meta"
_KINDS = ("calib", "label", *CHANNELS)
"""The kinds of files that an agent has."""
_NOT_IN_TEST = ("label", BEV_CAMERA, _META)
"""Kinds that the test split ships without."""
_UNKNOWN_SPLIT = "unknown"
_Part = tuple[str | None, str]
"""Agent and kind of file; no agent and `meta`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _FilesHere:
    """What is here of one scenario.

    Attributes:
        frames: the highest number of any agent's calib and label files.
        sizes: agent and kind → number and bytes of the files of these frames that have any bytes; of `meta` as well.
    """

    frames: int
    sizes: Mapping[_Part, tuple[int, int]]


@dataclass(frozen=True, slots=True)
class _Counted:
    """A scenario and its split with the counts of all its files, agent by agent, then `meta`."""

    folder: ScenarioFolder
    split: str
    counts: Sequence[FileCount]


def release_completeness(
    root: Dataroot,
    version: str = "v1",
    *,
    scenarios: Collection[str] | None = None,
    **how: Unpack[Engine],
) -> Completeness:
    """Count which files are here and which are missing, by split, agent and channel.

    Every agent is expected to have a file of every kind for each frame of a scenario, which its calib and label files
    number; the test split has no label, BEV camera and meta files. Broken scenarios count, too.

    Args:
        root: the release, as of `DeepAccident`: a folder, archives, or a URL.
        version: `v1` or `v1-mini`.
        scenarios: tokens of the scenarios to look at; None for all.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        DatarootError: the folder is missing, holds no release, or a part of it cannot be listed.
        VersionError: the version is unknown or not under this folder.
        SplitFileError: a split file cannot be read.
        TokenError: one of `scenarios` is not there.
    """
    layout = find_release(open_dataroot(root), version)
    return completeness(layout, scenarios, str(root), **how)


def completeness(
    layout: ReleaseLayout,
    scenarios: Collection[str] | None,
    dataroot: str,
    *,
    lenient: bool = False,
    **how: Unpack[Engine],
) -> Completeness:
    """What `release_completeness` gives of a release that was found; what cannot be listed may count as missing.

    Args:
        layout: the release, with the split files to read.
        scenarios: tokens of the scenarios to look at; None for all.
        dataroot: its name.
        lenient: whether a folder that cannot be listed counts as empty.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.
    """
    folders = chosen_scenarios(layout, scenarios)
    listing = partial(_files_here, lenient=lenient)
    files = run_batch(listing, folders, label="listing files", places=Places(reads=places_of(layout.root)), **how)
    counted = _count_all(layout, {folder: here for folder, here in zip(folders, files, strict=True) if here.frames})
    lacking = [_lacking(each) for each in counted if any(count.missing for count in each.counts)]
    strays = [] if scenarios is not None else _without_calib(layout, counted)
    return Completeness(
        dataroot=dataroot,
        version=layout.version,
        selected=scenarios is not None,
        scenarios=len(counted),
        whole=len(counted) - len(lacking),
        total=summed((count for each in counted for count in each.counts), "all"),
        splits=_splits(layout.version, counted, lacking, selected=scenarios is not None),
        lacking=lacking,
        not_here={} if scenarios is not None else _not_here(layout, strays),
        without_calib=strays,
    )


def chosen_scenarios(layout: ReleaseLayout, scenarios: Collection[str] | None) -> list[ScenarioFolder]:
    """The scenarios of some tokens, None for all; raises TokenError."""
    chosen = [folder for folder in layout.scenarios if scenarios is None or folder.token in scenarios]
    unknown = sorted(set(scenarios or ()) - {folder.token for folder in chosen})
    if unknown:
        raise TokenError(
            f"{layout.root}: has no scenario {unknown[0]!r}; its folders name {len(layout.scenarios)} others"
        )
    return chosen


def _files_here(scenario: ScenarioFolder, *, lenient: bool) -> _FilesHere:
    endings = {**ENDINGS, **CHANNEL_FORMAT}
    found = {
        (agent, kind): _sizes(scenario.kind_folder(agent, kind), endings[kind], lenient=lenient)
        for agent in AGENTS
        for kind in _KINDS
    }
    frames = max((frame for (_, kind), sizes in found.items() if kind in ENDINGS for frame in sizes), default=0)
    sizes: dict[_Part, tuple[int, int]] = {}
    for part, of_frames in found.items():
        filled = [size for frame, size in of_frames.items() if size and frame <= frames]
        sizes[part] = len(filled), sum(filled)
    try:
        meta = scenario.meta_path.stat().st_size
    except OSError:
        meta = 0
    sizes[None, _META] = int(meta > 0), meta
    return _FilesHere(frames=frames, sizes=sizes)


def _sizes(folder: ReleasePath, ending: str, *, lenient: bool) -> Mapping[int, int]:
    """Frame → bytes of its file in a folder."""
    try:
        return frame_sizes(folder, ending)
    except ReleaseError:
        if not lenient:
            raise
        return {}


def _count_all(layout: ReleaseLayout, found: Mapping[ScenarioFolder, _FilesHere]) -> list[_Counted]:
    """The counts of every scenario, with estimates by what is here of all of them."""
    split_of = assign_splits(layout).split_of
    files: Counter[str] = Counter()
    size: Counter[str] = Counter()
    for here in found.values():
        for (_, kind), (number, in_bytes) in here.sizes.items():
            files[kind] += number
            size[kind] += in_bytes
    means = {kind: size[kind] / number for kind, number in files.items() if number}
    counted = []
    for folder, here in found.items():
        split = layout.version if layout.version == "v1-mini" else split_of.get(folder.token, _UNKNOWN_SPLIT)
        counts = [_count(part, here, means, in_test=split == "test") for part in here.sizes]
        counted.append(_Counted(folder, split, counts))
    return counted


def _count(part: _Part, files: _FilesHere, means: Mapping[str, float], *, in_test: bool) -> FileCount:
    agent, kind = part
    here, in_bytes = files.sizes[part]
    expected = 1 if kind == _META else files.frames
    if in_test and not here and kind in _NOT_IN_TEST:
        expected = 0
    missing = expected - here
    estimate = None if missing and kind not in means else round(missing * means.get(kind, 0))
    return FileCount(
        agent=agent,
        channel=kind,
        expected=expected,
        here=here,
        missing=missing,
        bytes_here=in_bytes,
        bytes_missing=estimate,
    )


def _lacking(counted: _Counted) -> LackingScenario:
    with_files = {count.agent for count in counted.counts if count.here}
    absent = [agent for agent in AGENTS if agent not in with_files]
    return LackingScenario(
        scenario=counted.folder.token,
        folder=counted.folder.folder,
        split=counted.split,
        absent_agents=absent,
        files=[count for count in counted.counts if count.missing and count.agent not in absent],
    )


def _splits(
    version: str, counted: Sequence[_Counted], lacking: Sequence[LackingScenario], *, selected: bool
) -> dict[str, SplitFiles]:
    """Split → its counts, in the usual order; those that a whole release has, and those of which a scenario is here."""
    of_release = {version: EXPECTED_MINI_SCENARIOS} if version == "v1-mini" else EXPECTED_SCENARIOS
    expected = {} if selected else of_release
    splits = {}
    for split in (*SPLITS, version, _UNKNOWN_SPLIT):
        here = [each for each in counted if each.split == split]
        if not here and split not in expected:
            continue
        broken = [each for each in lacking if each.split == split]
        absent = Counter(agent for each in broken for agent in each.absent_agents)
        splits[split] = SplitFiles(
            scenarios=len(here),
            whole=len(here) - len(broken),
            expected=expected.get(split),
            absent_agents={agent: absent[agent] for agent in AGENTS if agent in absent},
            files=[
                summed(of_part, of_part[0].channel, of_part[0].agent)
                for of_part in zip(*(each.counts for each in here), strict=True)
            ],
        )
    return splits


def _without_calib(layout: ReleaseLayout, counted: Sequence[_Counted]) -> list[str]:
    """Scenarios that have files or folders here, but no frames."""
    numbered = {each.folder.token for each in counted}
    strays = {f"{folder.name}/{name}" for folder, name in names_without_calib(layout)}
    strays |= {folder.token for folder in layout.scenarios}
    return sorted(strays - numbered)


def _not_here(layout: ReleaseLayout, strays: Collection[str]) -> dict[str, list[str]]:
    """Split → scenarios of its file that are not here; the split files are not the mini release's."""
    if layout.version == "v1-mini":
        return {}
    here = {folder.token for folder in layout.scenarios}.union(strays)
    listed = {split: set(read_split_file(path)) - here for split, path in layout.split_files.items()}
    return {split: sorted(tokens) for split, tokens in listed.items() if tokens}
