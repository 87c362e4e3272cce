"""Which files of a release are here and which are missing: the counts, and their text and JSON."""

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.reports import Report
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.text import columns_text, counted, size_text

_LISTED = 10
"""Scenarios that the text lists at most."""
_WIDTH = 100
_HEADING = ("agent", "files", "expected", "here", "missing", "size here", "size missing")
_ESTIMATED = (
    "Sizes of missing files are estimates: as many times the mean size of the files of that kind that are here; "
    "'unknown' where there are none. Files without bytes count as missing; 'deepaccident validate' tells what is wrong "
    "in the others."
)
_OF_TEST = (
    "The test split ships without label, BEV_instance_camera and meta files; there they are only expected where an "
    "agent has some."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FileCount:
    """Files of one kind of one agent, or `meta` files, in one or several scenarios.

    Attributes:
        agent: the agent's name; None for `meta`, of which a scenario has one.
        channel: `calib`, `label`, a sensor's channel, or `meta`.
        expected: one a frame of every scenario.
        here: those that are here and have any bytes.
        missing: those that are not.
        bytes_here: of the files that are here.
        bytes_missing: an estimate, by the mean size of the channel's files here, of all agents and scenarios; None if
            files are missing and there is none to estimate by.
    """

    agent: str | None
    channel: str
    expected: int
    here: int
    missing: int
    bytes_here: int
    bytes_missing: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class LackingScenario(ShortRepr):
    """A scenario that is not whole.

    Attributes:
        scenario: its token.
        folder: the folder of layout B that it lies in; empty in layout A.
        split: its split, or `unknown`.
        absent_agents: agents of which it has no file at all.
        files: what else is missing: the counts of kinds that the other agents lack files of, and of `meta`.
    """

    scenario: str
    folder: str
    split: str
    absent_agents: Sequence[str]
    files: Sequence[FileCount]


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitFiles(ShortRepr):
    """What is here of the scenarios of a split.

    Attributes:
        scenarios: how many are here, in part or whole.
        whole: those of them that lack nothing.
        expected: scenarios of the split in the whole release; None for a selection, and for unknown splits.
        absent_agents: agent → scenarios that have no file of it.
        files: for every agent and kind of file, then for `meta`.
    """

    scenarios: int
    whole: int
    expected: int | None
    absent_agents: Mapping[str, int]
    files: Sequence[FileCount]


@dataclass(frozen=True, slots=True, kw_only=True)
class Completeness(Report):
    """Which files of a release are here, and which are missing.

    Attributes:
        dataroot: its folder.
        version: `v1` or `v1-mini`.
        selected: whether only some scenarios were looked at.
        scenarios: how many are here, in part or whole.
        whole: those of them that lack nothing.
        total: the files of all of them; its agent is None, its channel `all`.
        splits: split → what is here of it; `unknown` for scenarios of no known split. The mini release is one split.
        lacking: the scenarios that are not whole.
        not_here: split → scenarios that its split file lists and of which no file is here; empty for a selection.
        without_calib: scenarios with other files, but no calib of any agent: nobody knows how many frames they have,
            and none of the counts has their files; empty for a selection.
    """

    dataroot: str
    version: str
    selected: bool
    scenarios: int
    whole: int
    total: FileCount
    splits: Mapping[str, SplitFiles]
    lacking: Sequence[LackingScenario]
    not_here: Mapping[str, Sequence[str]]
    without_calib: Sequence[str]

    def to_text(self) -> str:
        """Blocks of at most 100 columns for a terminal: each split, then the first scenarios that lack something."""
        selected = " (a selection of scenarios)" if self.selected else ""
        return f"DeepAccident {self.version} at {self.dataroot}{selected}\n{self.section()}"

    def section(self) -> str:
        """The same without the release's name, as a part of another report."""
        blocks = [
            self._head(),
            *(_split_text(name, split) for name, split in self.splits.items()),
            *_listing(
                "scenarios that lack files, and how many",
                [_lacking_text(scenario, self.version) for scenario in self.lacking],
            ),
            *(
                line
                for split, tokens in self.not_here.items()
                for line in _listing(f"scenarios in {split}.txt that are not here at all", [f"  {t}" for t in tokens])
            ),
            *_listing(
                "scenarios without any calib, which are not counted above: their number of frames is not known",
                [f"  {token}" for token in self.without_calib],
            ),
        ]
        if self.total.missing:
            remarks = [_ESTIMATED, *([_OF_TEST] if "test" in self.splits else [])]
            blocks.append("\n".join(textwrap.fill(remark, _WIDTH) for remark in remarks))
        return "\n\n".join(blocks)

    def _head(self) -> str:
        total = self.total
        missing = f"{total.missing:,} are missing{f' (size: {_estimate(total)})' if total.missing else ''}"
        lines = [
            f"{counted(self.scenarios, 'scenario')} here, {self.whole:,} of them whole",
            f"{total.here:,} of their {total.expected:,} files are here ({size_text(total.bytes_here)}), {missing}",
        ]
        return "\n".join(lines)


def summed(counts: Iterable[FileCount], channel: str, agent: str | None = None) -> FileCount:
    """The sum of some counts, under a name."""
    counts = list(counts)
    estimates = [count.bytes_missing for count in counts]
    return FileCount(
        agent=agent,
        channel=channel,
        expected=sum(count.expected for count in counts),
        here=sum(count.here for count in counts),
        missing=sum(count.missing for count in counts),
        bytes_here=sum(count.bytes_here for count in counts),
        bytes_missing=None if None in estimates else sum(filter(None, estimates)),
    )


def _split_text(name: str, split: SplitFiles) -> str:
    of_release = "" if split.expected is None else f" of the release's {split.expected}"
    lines = [f"split {name}: {counted(split.scenarios, 'scenario')}{of_release} here, {split.whole:,} of them whole"]
    if split.absent_agents:
        absent = ", ".join(f"{agent} ({count:,})" for agent, count in split.absent_agents.items())
        lines.append(textwrap.fill(f"agents that are absent, and from how many scenarios: {absent}", _WIDTH))
    rows: list[tuple[str, ...]] = [_HEADING]
    for agent, counts in _by_agent(count for count in split.files if count.expected):
        for count in _grouped(counts):
            numbers = (f"{number:,}" for number in (count.expected, count.here, count.missing))
            rows.append((agent or "", count.channel, *numbers, size_text(count.bytes_here), _estimate(count)))
    return "\n".join([*lines, columns_text(rows, left=2)] if split.scenarios else lines)


def _lacking_text(scenario: LackingScenario, version: str) -> str:
    """The token, and what is missing in a sentence below it; agents that lack the same share their words."""
    place = "" if scenario.split == version else f" ({scenario.split})"
    agents_of: dict[str, list[str]] = {}
    for agent, counts in _by_agent(scenario.files):
        if agent is not None:
            lacks = ", ".join(f"{each.channel} {each.missing} of {each.expected}" for each in _lacking_rows(counts))
            agents_of.setdefault(lacks, []).append(agent)
    words = [f"no {', '.join(scenario.absent_agents)}"] if scenario.absent_agents else []
    for lacks, agents in agents_of.items():
        words.append(f"{'every agent' if len(agents) == len(AGENTS) else ', '.join(agents)}: {lacks}")
    words += ["meta" for each in scenario.files if each.agent is None]
    body = textwrap.fill("; ".join(words), _WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return f"  {scenario.scenario}{place}\n{body}"


def _listing(heading: str, items: Sequence[str]) -> Iterator[str]:
    """A block with the first items; none if there are none."""
    if items:
        more = [f"  … and {len(items) - _LISTED:,} more (--json lists all)"] if len(items) > _LISTED else []
        yield "\n".join([f"{heading} ({len(items):,}):", *items[:_LISTED], *more])


def _by_agent(counts: Iterable[FileCount]) -> Iterator[tuple[str | None, list[FileCount]]]:
    return ((agent, list(group)) for agent, group in groupby(counts, lambda count: count.agent))


def _grouped(counts: Sequence[FileCount]) -> Iterator[FileCount]:
    """An agent's counts in few rows: of each kind that lacks files, or of all cameras together; then of the rest."""
    if not any(count.here for count in counts):
        yield summed(counts, "everything" if len(counts) > 1 else counts[0].channel)
        return
    lacking = list(_lacking_rows(counts))
    yield from lacking
    complete = [count for count in counts if not count.missing]
    if len(counts) == 1:
        yield from complete
    elif complete:
        yield summed(complete, "all else" if lacking else "everything")


def _lacking_rows(counts: Iterable[FileCount]) -> Iterator[FileCount]:
    """The counts that lack files; those of the cameras as one, if all lack as many."""
    lacking = [count for count in counts if count.missing]
    cameras = [count for count in lacking if count.channel in CAMERAS]
    together = len(cameras) == len(CAMERAS) and len({(count.expected, count.here) for count in cameras}) == 1
    if together:
        yield summed(cameras, f"{len(CAMERAS)} cameras")
    yield from (count for count in lacking if not (together and count in cameras))


def _estimate(count: FileCount) -> str:
    if count.bytes_missing is None:
        return "unknown"
    return f"~{size_text(count.bytes_missing)}" if count.missing else "-"
