"""Counts of what a release holds, behind `deepaccident info` and the facade's `list_*` methods."""

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

_UNKNOWN = "unknown"
# Whether a scenario has a collision → its words in a scenario's line.
_ENDS = {"true": "collision", "false": "no collision", _UNKNOWN: "collision unknown"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Overview(Report):
    """Counts over one release.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`; of nuScenes such as `v1.0-mini`.
        layout: `A`, `B` or `A+B`; or `nuScenes`.
        index: Folder of the index's tables.
        tables: Table → rows.
        splits: Split → scenarios present; `unknown` for scenarios without a known split.
        expected: Split (or the version, for mini) → scenarios of the complete release; empty for
            nuScenes.
        agents: Agent → scenarios that have it.
        labelled: Agent → scenarios in which it has labels.
        channels: Channel → recordings (scenario and agent) that have files of it.
        files: Channel → files of these recordings.
        recordings: Number of all recordings.
        samples: Number of their samples: the files that each channel of a complete release has.
        attributes: Field → value → scenarios; of `collision` true, false and unknown.
        left_out: Tokens of broken scenarios that were skipped.
    """

    dataroot: str
    version: str
    layout: str
    index: str
    tables: Mapping[str, int]
    splits: Mapping[str, int]
    expected: Mapping[str, int]
    agents: Mapping[str, int]
    labelled: Mapping[str, int]
    channels: Mapping[str, int]
    files: Mapping[str, int]
    recordings: int
    samples: int
    attributes: Mapping[str, Mapping[str, int]]
    left_out: Sequence[str]

    def to_text(self) -> str:
        """Return a few aligned blocks for a terminal."""
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
            blocks.append(f"left out as broken:\n{tokens}")
        return "\n\n".join(blocks)

    def _split_rows(self) -> list[tuple[str, str]]:
        """Return each split with its scenarios, present and expected."""
        if set(self.expected) != set(SPLITS):
            scenarios = self.tables["scenario"]
            present = [(name, str(count)) for name, count in self.splits.items()]
            return present + [
                (name, f"{scenarios} of {count}") for name, count in self.expected.items()
            ]
        rows = []
        for name, count in self.splits.items():
            of_expected = f" of {self.expected[name]}" if name in self.expected else ""
            rows.append((name, f"{count}{of_expected}"))
        return rows


def overview(dataset: Dataset) -> Overview:
    """Count what a release holds."""
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
    files = _channel_files(dataset, scenarios)
    attributes = {"collision": _count_values(map(_collides, scenarios))}
    for field in SCENARIO_ATTRIBUTES:
        attributes[field] = _count_values(scenario[field] for scenario in scenarios)
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
        channels={channel: sum(count > 0 for count in counts) for channel, counts in files.items()},
        files={channel: sum(counts) for channel, counts in files.items()},
        recordings=len(agents),
        samples=len(dataset.sample),
        attributes=attributes,
        left_out=[problem.scenario for problem in dataset.problems],
    )


def scenario_lines(scenarios: Iterable[ScenarioRecord]) -> list[str]:
    """Return a line a scenario: token, frames, split, weather and how it ended."""
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
    """Return a line for each agent name, with the number of its scenarios."""
    counts = Counter(agent["name"] for agent in dataset.agent)
    return [f"{name}  {counted(counts[name], 'scenario')}" for name in AGENTS]


def category_lines(dataset: Dataset) -> list[str]:
    """Return a line a category: index, name, instances, annotations."""
    annotations = Counter(dataset.arrow("annotation")["category"].combine_chunks().to_pylist())
    instances = Counter(dataset.arrow("instance")["category"].combine_chunks().to_pylist())
    return [
        f"{record['index']}  {record['name']}  {instances[record['name']]:,} instances  "
        f"{annotations[record['name']]:,} annotations"
        for record in dataset.category
    ]


def sample_lines(dataset: Dataset, sample: RowArgument) -> list[str]:
    """Return lines of a sample: its time, then each file and each box."""
    record = dataset.get("sample", sample)
    lines = [f"sample {record['token']}, t = {record['timestamp']:.1f} s"]
    for channel in CHANNELS:
        path = dataset.sensor_path(f"{record['token']}/{channel}")
        note = "" if path.is_file() else "  (not here)"
        lines.append(f"  {path}{note}")
    for box in dataset.get_boxes(record, "lidar"):
        lines.append(f"  {box.token}: {box}")
    return lines


def table_text(name: str, value: str, rows: Sequence[tuple[str, str]]) -> str:
    """Return two aligned columns under their headings."""
    return columns_text([(name, value), *rows])


def _collides(scenario: ScenarioRecord) -> str:
    if scenario["weather"] is None:  # The scenario has no meta.
        return _UNKNOWN
    return "true" if scenario["collision"] else "false"


def _count_values(values: Iterable[object]) -> dict[str, int]:
    counts = Counter("none" if value is None else str(value) for value in values)
    return {word: counts[word] for word in sorted(counts, key=natural_order)}


def _channel_files(dataset: Dataset, scenarios: Sequence[ScenarioRecord]) -> dict[str, list[int]]:
    """Return channel → number of files of each recording; `validate` also reads their content."""
    counts: dict[str, list[int]] = {channel: [] for channel in CHANNELS}
    for scenario in scenarios:
        for (_, channel), frames in dataset.sensor_frames(scenario).items():
            counts[channel].append(len(frames))
    return counts
