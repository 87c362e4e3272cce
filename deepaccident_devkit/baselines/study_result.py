"""`V2XStudy`: the study's tables, and their forms: text, CSV, JSON."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.baselines.study_config import StudyConfig
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
from deepaccident_devkit.evaluation.metrics.intervals import LEAST_CLUSTERS
from deepaccident_devkit.files import path_of, write_bytes
from deepaccident_devkit.text import columns_text

METRICS: Final[Mapping[str, str]] = {
    "iou_30": "IoU 30x30",
    "vpq_30": "VPQ 30x30",
    "iou_100": "IoU 100x100",
    "vpq_100": "VPQ 100x100",
    "apa": "APA",
    "id_error": "id error",
    "position_error": "position (m)",
    "time_error": "time (s)",
    "boxes_apa": "APA boxes",
    "boxes_precision": "precision boxes",
    "boxes_recall": "recall boxes",
    "mAP": "mAP",
}
"""Numbers of a row → how tables call them. IoU, VPQ and mAP are percent, accuracies and shares in [0, 1]; errors are
means over the accidents foreseen within 10 m. What ends in `boxes` is by the protocol of that name; mAP is of the boxes
that are seen, by the protocol `paper` of detections."""
PERCENT: Final = ("iou_30", "vpq_30", "iou_100", "vpq_100", "mAP")
_PRINTED: Final = ("iou_100", "vpq_100", "apa", "boxes_apa", "mAP")
"""Numbers that the text has room for; CSV and JSON have all."""
_FIELDS: Final[Mapping[str, str]] = {
    "agents": "agents",
    "horizon": "ahead (s)",
    "pose_noise": "noise (m)",
    "latency": "late (s)",
    "group": "samples of",
}
_NONE: Final = (None, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyRow(FrozenMappings):
    """The numbers of some samples under one condition.

    Attributes:
        agents: name of the configuration.
        horizon: seconds looked ahead.
        pose_noise: metres.
        latency: seconds.
        group: the value of the table's attribute; `all` for every sample.
        samples: how many.
        scenarios: how many they are of.
        clusters: how many these are, where an accident and its twin are one (`attributes.cluster_of`).
        positives: of which an accident comes, by the study's protocol.
        metrics: of `METRICS`, with pose noise of all seeds together; None where there is no value.
        intervals: name of a metric → (low, high); those without one (docs/statistics.md) are not there.
        gains: name of a metric → (low, high) of how much more it is than with a single vehicle, of rows with noise or
            delay than with the same agents and a perfect link; those without such an interval are not there.
        spread: name of a metric → the least and the most that a single seed gives; empty where one seed is enough.
    """

    agents: str
    horizon: float
    pose_noise: float
    latency: float
    group: str
    samples: int
    scenarios: int
    clusters: int
    positives: int
    metrics: Mapping[str, float | None]
    intervals: Mapping[str, tuple[float, float]]
    gains: Mapping[str, tuple[float, float]]
    spread: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyTable(ShortRepr):
    """One of the study's tables.

    Attributes:
        name: also of its files.
        title: for people.
        by: the fields that distinguish its rows, the agents first.
        rows: in their order.
    """

    name: str
    title: str
    by: tuple[str, ...]
    rows: tuple[StudyRow, ...]

    def to_text(self) -> str:
        """Aligned columns under the title: numbers with their intervals, and beneath them what single seeds give."""
        heading = [*(_FIELDS[name] for name in self.by), "samples", "scenarios", *(METRICS[name] for name in _PRINTED)]
        lines = [
            [*self._names(row), str(row.samples), str(row.scenarios), *(sure_text(row, name) for name in _PRINTED)]
            for row in self.rows
        ]
        text = f"{self.title}\n{columns_text([heading, *lines])}"
        single = [[*self._names(row), *(_range(row, name) for name in _PRINTED)] for row in self.rows if row.spread]
        if not single:
            return text
        heading = [*(_FIELDS[name] for name in self.by), *(METRICS[name] for name in _PRINTED)]
        return f"{text}\n\n{self.title}: least and most of single seeds\n{columns_text([heading, *single])}"

    def to_csv(self) -> str:
        """A heading, then a row a line; nothing where there is no value.

        Of each number there are also the ends of its interval (`…_low`, `…_high`) and of its gain's (`…_gain_low`,
        `…_gain_high`), and the least and the most of single seeds (`…_least`, `…_most`).
        """
        names = (*_FIELDS, "samples", "scenarios", "clusters", "positives")
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        ends = ("", "_low", "_high", "_gain_low", "_gain_high", "_least", "_most")
        writer.writerow([*names, *(f"{name}{end}" for name in METRICS for end in ends)])
        for row in self.rows:
            pairs = (row.intervals, row.gains, row.spread)
            numbers = [
                (row.metrics[name], *(end for each in pairs for end in each.get(name, _NONE))) for name in METRICS
            ]
            writer.writerow([*(getattr(row, name) for name in names), *chain.from_iterable(numbers)])
        return text.getvalue()

    def _names(self, row: StudyRow) -> list[str]:
        """The values that distinguish a row."""
        return [_cell(getattr(row, name)) for name in self.by]


@dataclass(frozen=True, slots=True, kw_only=True)
class V2XStudy(FrozenMappings):
    """The gain of cooperation on a release, for the baseline.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        split: whose samples.
        config: how it was made.
        tables: by name.
        notes: what was left out, in sentences.
    """

    dataroot: str
    version: str
    split: str
    config: StudyConfig
    tables: Mapping[str, StudyTable]
    notes: tuple[str, ...]

    def to_text(self) -> str:
        """All tables for a terminal, with what they are of."""
        config = self.config
        how = f"{config.model.replace('_', ' ')}; accidents in maps by the protocol {config.protocol!r}"
        head = [
            f"V2X study of {self.split} in {self.dataroot} ({self.version})",
            f"ego: {', '.join(config.egos)}; scenarios: {config.scope}; {how}; detections: 'paper'",
            f"pose noise: of the seeds {', '.join(map(str, config.seeds))} together",
            *_intervals_text(config.resampling),
            *self.notes,
        ]
        return "\n\n".join(["\n".join(head), *(table.to_text() for table in self.tables.values())])

    def to_json(self) -> str:
        """One JSON object; null for what has no value."""
        return json.dumps(self.as_dict(), indent=2, ensure_ascii=False)

    def to_csv(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write a file a table into a folder, over those that are there; returns their paths. Raises OSError."""
        paths = []
        for table in self.tables.values():
            paths.append(path_of(folder) / f"{table.name}.csv")
            write_bytes(paths[-1], table.to_csv().encode())
        return paths


def _intervals_text(resampling: Resampling) -> list[str]:
    """The meaning of the brackets, and why some numbers have none."""
    if not resampling.resamples:
        return []
    what = f"[low, high]: intervals of {100 * resampling.confidence:g} %; a number has none where fewer than"
    return [f"{what} {LEAST_CLUSTERS} clusters (an accident and its twin are one) have and change it"]


def _cell(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def sure_text(row: StudyRow, name: str) -> str:
    """A row's metric as tables print it, with its interval if it has one: `73.0 [61.2, 82.4]`."""
    number = number_text(row.metrics[name], name)
    return f"{number} [{_ends(row.intervals[name], name)}]" if name in row.intervals else number


def _range(row: StudyRow, name: str) -> str:
    return _ends(row.spread[name], name) if name in row.spread else number_text(None, name)


def _ends(ends: tuple[float, float], name: str) -> str:
    return ", ".join(number_text(end, name) for end in ends)


def number_text(value: float | None, name: str) -> str:
    """A value of a metric as tables print it."""
    return "–" if value is None else f"{value:.{1 if name in PERCENT else 2}f}"
