"""Counts of a release's content, for `deepaccident info` and the `list_*` methods."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.support.reports import Report
from deepaccident_devkit.support.text import columns_text, counted, natural_order
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CHANNELS,
    EXPECTED_MINI_SCENARIOS,
    EXPECTED_SCENARIOS,
    SCENARIO_ATTRIBUTES,
    SPLITS,
)

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

# Name → count.
Counts = Mapping[str, int]
_UNKNOWN = "unknown"
# Whether a scenario has a collision → the wording in the scenario's line.
_ENDS = {"true": "collision", "false": "no collision", _UNKNOWN: "collision unknown"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Overview(Report):
    """Counts over one release.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`; for nuScenes, a name such as `v1.0-mini`.
        layout: `A`, `B` or `A+B`; or `nuScenes`.
        index: Folder of the index's tables.
        tables: Table → number of rows.
        splits: Split → number of scenarios present; `unknown` for scenarios of no known split.
        expected: Split (or the version, for mini) → number of scenarios in the complete release;
            empty for nuScenes.
        agents: Agent → number of scenarios that contain it.
        labelled: Agent → number of scenarios in which it has labels.
        channels: Channel → number of recordings (scenario and agent) that contain files of it.
        files: Channel → number of files in these recordings.
        recordings: Number of all recordings.
        samples: Number of their samples, which is the number of files per channel in a complete
            release.
        attributes: Field → value → number of scenarios; the values of `collision` are true, false
            and unknown.
        left_out: Tokens of broken scenarios that were skipped.
    """

    dataroot: str
    version: str
    layout: str
    index: str
    tables: Counts
    splits: Counts
    expected: Counts
    agents: Counts
    labelled: Counts
    channels: Counts
    files: Counts
    recordings: int
    samples: int
    attributes: Mapping[str, Counts]
    left_out: Sequence[str]

    def to_text(self) -> str:
        """Return the counts as aligned blocks for a terminal."""
        head = f"DeepAccident {self.version} at {self.dataroot} (layout {self.layout})"
        blocks = [f"{head}\nindex: {self.index}"]
        tables = [(name, f"{rows:,}") for name, rows in self.tables.items()]
        blocks.append(table_text("table", "rows", tables))
        blocks.append(table_text("split", "scenarios", self._split_rows()))
        agents = [(name, f"{count} ({self.labelled[name]})") for name, count in self.agents.items()]
        blocks.append(table_text("agent", "scenarios (labelled)", agents))
        sensors = [("sensor", f"recordings of {self.recordings}", "files")]
        for name, count in self.channels.items():
            sensors.append((name, str(count), f"{self.files[name]:,} of {self.samples:,}"))
        blocks.append(columns_text(sensors))
        for field, counts in self.attributes.items():
            values = [(value, str(count)) for value, count in counts.items()]
            blocks.append(table_text(field, "scenarios", values))
        if self.left_out:
            tokens = "\n".join(f"  {token}" for token in self.left_out)
            blocks.append(f"excluded as broken:\n{tokens}")
        return "\n\n".join(blocks)

    def _split_rows(self) -> list[tuple[str, str]]:
        """Return a row per split: its name, and how many scenarios are present and expected."""
        rows = []
        is_split_release = set(self.expected) == set(SPLITS)
        for name, count in self.splits.items():
            of_expected = ""
            if is_split_release and name in self.expected:
                of_expected = f" of {self.expected[name]}"
            rows.append((name, f"{count}{of_expected}"))
        if not is_split_release:
            scenarios = self.tables["scenario"]
            for name, count in self.expected.items():
                rows.append((name, f"{scenarios} of {count}"))
        return rows


def overview(dataset: Dataset) -> Overview:
    """Count what a release contains."""
    scenarios = dataset.scenario[:]
    agents = dataset.agent[:]
    split_counts = Counter(scenario["split"] or _UNKNOWN for scenario in scenarios)
    splits = {name: split_counts[name] for name in SPLITS}
    if split_counts[_UNKNOWN]:
        splits[_UNKNOWN] = split_counts[_UNKNOWN]
    agent_counts = Counter[str]()
    labelled_counts = Counter[str]()
    for agent in agents:
        agent_counts[agent["name"]] += 1
        if dataset.get("sample", agent["first_sample_token"])["labelled"]:
            labelled_counts[agent["name"]] += 1
    expected = {"v1": EXPECTED_SCENARIOS, "v1-mini": {"v1-mini": EXPECTED_MINI_SCENARIOS}}
    channels = Counter[str]()
    files = Counter[str]()
    for scenario in scenarios:
        for (_, channel), frames in dataset.sensor_frames(scenario).items():
            channels[channel] += len(frames) > 0
            files[channel] += len(frames)
    attributes = {"collision": _count_by_word(map(_collides, scenarios))}
    for field in SCENARIO_ATTRIBUTES:
        attributes[field] = _count_by_word(scenario[field] for scenario in scenarios)
    return Overview(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        layout=dataset.layout,
        index=str(dataset.tables_folder),
        tables={name: len(dataset.arrow(name)) for name in dataset.table_names},
        splits=splits,
        expected=expected.get(dataset.version, {}),
        agents={name: agent_counts[name] for name in AGENTS},
        labelled={name: labelled_counts[name] for name in AGENTS},
        channels={channel: channels[channel] for channel in CHANNELS},
        files={channel: files[channel] for channel in CHANNELS},
        recordings=len(agents),
        samples=len(dataset.sample),
        attributes=attributes,
        left_out=[problem.scenario for problem in dataset.problems],
    )


def scenario_lines(scenarios: Iterable[ScenarioRecord]) -> list[str]:
    """Return a line per scenario: token, frames, split, weather and how it ended."""
    lines = []
    for scenario in scenarios:
        end = _ENDS[_collides(scenario)]
        weather = f"{scenario['weather'] or _UNKNOWN} {scenario['time_of_day'] or ''}".strip()
        split = scenario["split"] or "split unknown"
        lines.append(
            f"{scenario['token']}  {scenario['num_frames']} frames  {split}  {weather}  {end}"
        )
    return lines


def agent_lines(dataset: Dataset) -> list[str]:
    """Return a line per agent name, with the number of scenarios that contain it."""
    counts = Counter(agent["name"] for agent in dataset.agent)
    lines = []
    for name in AGENTS:
        scenarios = counted(counts[name], "scenario")
        lines.append(f"{name}  {scenarios}")
    return lines


def category_lines(dataset: Dataset) -> list[str]:
    """Return a line per category: index, name, instances, annotations."""
    annotations = Counter(dataset.arrow("annotation")["category"].combine_chunks().to_pylist())
    instances = Counter(dataset.arrow("instance")["category"].combine_chunks().to_pylist())
    lines = []
    for record in dataset.category:
        name = record["name"]
        lines.append(
            f"{record['index']}  {name}  {instances[name]:,} instances  "
            f"{annotations[name]:,} annotations"
        )
    return lines


def sample_lines(dataset: Dataset, sample: RowArgument) -> list[str]:
    """Describe a sample in lines: its time, then each file, then each box."""
    record = dataset.get("sample", sample)
    lines = [f"sample {record['token']}, t = {record['timestamp']:.1f} s"]
    for channel in CHANNELS:
        path = dataset.sensor_path(f"{record['token']}/{channel}")
        note = ""
        if not path.is_file():
            note = "  (not here)"
        lines.append(f"  {path}{note}")
    for box in dataset.get_boxes(record, "lidar"):
        lines.append(f"  {box.token}: {box}")
    return lines


def table_text(name: str, value: str, rows: Sequence[tuple[str, str]]) -> str:
    """Format rows as two aligned columns with headings."""
    return columns_text([(name, value), *rows])


def _collides(scenario: ScenarioRecord) -> str:
    if scenario["weather"] is None:  # the scenario has no meta file
        return _UNKNOWN
    return "true" if scenario["collision"] else "false"


def _count_by_word(values: Iterable[object]) -> dict[str, int]:
    counts = Counter[str]()
    for value in values:
        word = "none" if value is None else str(value)
        counts[word] += 1
    words = sorted(counts, key=natural_order)
    return {word: counts[word] for word in words}
