"""What a release holds, counted: the texts behind `deepaccident info` and the facade's `list_*` methods."""

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
# Whether a scenario has a collision → how a line says that.
_ENDS = {"true": "collision", "false": "no collision", _UNKNOWN: "collision unknown"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Overview(Report):
    """Counts over one release.

    Attributes:
        dataroot: its folder.
        version: `v1` or `v1-mini`; of nuScenes such as `v1.0-mini`.
        layout: `A`, `B` or `A+B`; or `nuScenes`.
        index: folder of the index's tables.
        tables: table → rows.
        splits: split → scenarios here; `unknown` for those of no known split.
        expected: split (or the version, for mini) → scenarios of the whole release; empty for nuScenes.
        agents: agent → scenarios that have it.
        labelled: agent → scenarios in which it has labels.
        channels: channel → recordings (scenario and agent) that have files of it.
        files: channel → files of these recordings.
        recordings: all recordings.
        samples: their moments: as many files has a channel of a whole release.
        attributes: field → value → scenarios; of `collision` true, false and unknown.
        left_out: broken scenarios that were skipped, by token.
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
        """Some aligned blocks for a terminal."""
        scenarios = self.tables["scenario"]
        head = f"DeepAccident {self.version} at {self.dataroot} (layout {self.layout})\nindex: {self.index}"
        splits = [
            (name, f"{count} of {self.expected[name]}" if name in self.expected else str(count))
            for name, count in self.splits.items()
        ]
        if set(self.expected) != set(SPLITS):
            splits = [(name, str(count)) for name, count in self.splits.items()]
            splits += [(name, f"{scenarios} of {count}") for name, count in self.expected.items()]
        blocks = [
            head,
            table_text(
                "table", "rows", [(name, f"{rows:,}") for name, rows in self.tables.items()]
            ),
            table_text("split", "scenarios", splits),
            table_text(
                "agent",
                "scenarios (labelled)",
                [(name, f"{count} ({self.labelled[name]})") for name, count in self.agents.items()],
            ),
            columns_text(
                [
                    ("sensor", f"recordings of {self.recordings}", "files"),
                    *(
                        (name, str(count), f"{self.files[name]:,} of {self.samples:,}")
                        for name, count in self.channels.items()
                    ),
                ]
            ),
            *(
                table_text(
                    field, "scenarios", [(value, str(count)) for value, count in counts.items()]
                )
                for field, counts in self.attributes.items()
            ),
        ]
        if self.left_out:
            blocks.append(
                "left out as broken:\n" + "\n".join(f"  {token}" for token in self.left_out)
            )
        return "\n\n".join(blocks)


def overview(dataset: Dataset) -> Overview:
    """Count what a release holds."""
    scenarios, agents = dataset.scenario[:], dataset.agent[:]
    samples = {
        agent["token"]: dataset.get("sample", agent["first_sample_token"]) for agent in agents
    }
    split_counts = Counter(scenario["split"] or _UNKNOWN for scenario in scenarios)
    expected = {"v1": EXPECTED_SCENARIOS, "v1-mini": {"v1-mini": EXPECTED_MINI_SCENARIOS}}
    files = _channel_files(dataset, scenarios)
    return Overview(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        layout=dataset.layout,
        index=str(dataset.tables_folder),
        tables={name: len(dataset.arrow(name)) for name in dataset.table_names},
        splits={
            name: split_counts[name]
            for name in (*SPLITS, _UNKNOWN)
            if split_counts[name] or name in SPLITS
        },
        expected=expected.get(dataset.version, {}),
        agents={name: sum(agent["name"] == name for agent in agents) for name in AGENTS},
        labelled={
            name: sum(
                agent["name"] == name and samples[agent["token"]]["labelled"] for agent in agents
            )
            for name in AGENTS
        },
        channels={channel: sum(count > 0 for count in counts) for channel, counts in files.items()},
        files={channel: sum(counts) for channel, counts in files.items()},
        recordings=len(agents),
        samples=len(dataset.sample),
        attributes={
            "collision": _counts(map(_collides, scenarios)),
            **{
                field: _counts(scenario[field] for scenario in scenarios)
                for field in SCENARIO_ATTRIBUTES
            },
        },
        left_out=[problem.scenario for problem in dataset.problems],
    )


def scenario_lines(scenarios: Iterable[ScenarioRecord]) -> list[str]:
    """A line a scenario: token, frames, split, weather and how it ended."""
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
    """A line for each agent name, with the number of its scenarios."""
    counts = Counter(agent["name"] for agent in dataset.agent)
    return [f"{name}  {counted(counts[name], 'scenario')}" for name in AGENTS]


def category_lines(dataset: Dataset) -> list[str]:
    """A line a category: index, name, instances, annotations."""
    annotations = Counter(dataset.arrow("annotation")["category"].combine_chunks().to_pylist())
    instances = Counter(dataset.arrow("instance")["category"].combine_chunks().to_pylist())
    return [
        f"{record['index']}  {record['name']}  {instances[record['name']]:,} instances  "
        f"{annotations[record['name']]:,} annotations"
        for record in dataset.category
    ]


def sample_lines(dataset: Dataset, sample: RowArgument) -> list[str]:
    """A sample's files and boxes, a line each."""
    record = dataset.get("sample", sample)
    files = [f"{record['token']}/{channel}" for channel in CHANNELS]
    paths = [dataset.sensor_path(token) for token in files]
    return [
        f"sample {record['token']}, t = {record['timestamp']:.1f} s",
        *(f"  {path}{'' if path.is_file() else '  (not here)'}" for path in paths),
        *(f"  {box.token}: {box}" for box in dataset.get_boxes(record, "lidar")),
    ]


def table_text(left: str, right: str, rows: Sequence[tuple[str, str]]) -> str:
    """Two aligned columns under a heading."""
    return columns_text([(left, right), *rows])


def _collides(scenario: ScenarioRecord) -> str:
    if scenario["weather"] is None:
        return _UNKNOWN  # there is no meta
    return "true" if scenario["collision"] else "false"


def _counts(values: Iterable[object]) -> dict[str, int]:
    counts = Counter("none" if value is None else str(value) for value in values)
    return dict(sorted(counts.items(), key=lambda item: natural_order(item[0])))


def _channel_files(dataset: Dataset, scenarios: Sequence[ScenarioRecord]) -> dict[str, list[int]]:
    """Channel → number of files of each recording, by their names; what is in them `validate` tells."""
    counts: dict[str, list[int]] = {channel: [] for channel in CHANNELS}
    for scenario in scenarios:
        for (_, channel), frames in dataset.sensor_frames(scenario).items():
            counts[channel].append(len(frames))
    return counts
