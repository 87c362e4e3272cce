"""`V2XStudy`: the study's tables, and their forms: text, CSV, JSON."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from deepaccident_devkit.baselines.study_config import StudyConfig
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
from deepaccident_devkit.files import write_bytes
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
    "boxes_recall": "recall boxes",
}
"""Numbers of a row → how tables call them. IoU and VPQ are percent, accuracies and shares in [0, 1]; errors are means
over the accidents foreseen within 10 m. What ends in `boxes` is by the protocol of that name."""
_FIELDS: Final[Mapping[str, str]] = {
    "agents": "agents",
    "horizon": "ahead (s)",
    "pose_noise": "noise (m)",
    "latency": "late (s)",
    "group": "samples of",
}


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
        positives: of which an accident comes, by the study's protocol.
        metrics: of `METRICS`; None where there is no value.
    """

    agents: str
    horizon: float
    pose_noise: float
    latency: float
    group: str
    samples: int
    positives: int
    metrics: Mapping[str, float | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyTable:
    """One of the study's tables.

    Attributes:
        name: also of its files.
        title: for people.
        by: the fields of its rows that tell them apart, the agents first.
        rows: in their order.
    """

    name: str
    title: str
    by: tuple[str, ...]
    rows: tuple[StudyRow, ...]

    def to_text(self) -> str:
        """Aligned columns under the title."""
        heading = [*(_FIELDS[name] for name in self.by), "samples", *METRICS.values()]
        lines = [
            [
                *(_cell(getattr(row, name)) for name in self.by),
                str(row.samples),
                *(_number(row.metrics[name], 1 if name.startswith(("iou", "vpq")) else 2) for name in METRICS),
            ]
            for row in self.rows
        ]
        return f"{self.title}\n{columns_text([heading, *lines])}"

    def to_csv(self) -> str:
        """A heading, then a row a line; nothing where there is no value."""
        names = (*_FIELDS, "samples", "positives")
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*names, *METRICS])
        writer.writerows(
            [*(getattr(row, name) for name in names), *(row.metrics[name] for name in METRICS)] for row in self.rows
        )
        return text.getvalue()


@dataclass(frozen=True, slots=True, kw_only=True)
class V2XStudy(FrozenMappings):
    """What cooperation is worth on a release, to the baseline.

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
            f"ego: {', '.join(config.egos)}; scenarios: {config.scope}; {how}; link seed {config.seed}",
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
            paths.append(Path(folder) / f"{table.name}.csv")
            write_bytes(paths[-1], table.to_csv().encode())
        return paths


def _cell(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:.{digits}f}"
