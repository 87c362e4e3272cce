"""The study's figures, rendered into files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from deepaccident_devkit.baselines.study_result import METRICS, PERCENT, StudyRow, StudyTable, V2XStudy
from deepaccident_devkit.files import path_of
from deepaccident_devkit.render.baselines import Panel, save_panels

_SHOWN: Final = ("iou_100", "vpq_100", "apa", "boxes_apa", "mAP")
_XLABELS: Final = {"pose_noise": "pose noise (m)", "latency": "latency (s)"}
_EVERYONE: Final = "all samples"


def save_study(study: V2XStudy, folder: str | os.PathLike[str]) -> list[Path]:
    """Render each table of a study into `<name>.png`, over those that exist. Returns their paths."""
    paths = []
    for table in study.tables.values():
        paths.append(path_of(folder) / f"{table.name}.png")
        save_panels(study_panels(table), table.title, paths[-1])
    return paths


def study_panels(table: StudyTable) -> list[list[Panel]]:
    """The panels of a table: one for each metric; with several horizons, a row of panels for each."""
    swept = next((name for name in table.by if name in _XLABELS), None)
    horizons = sorted({row.horizon for row in table.rows})
    result = []
    for horizon in horizons:
        rows = [row for row in table.rows if row.horizon == horizon]
        ahead = f", {horizon:g} s ahead" if len(horizons) > 1 else ""
        result.append([_panel(rows, metric, swept, ahead) for metric in _SHOWN])
    return result


def _panel(rows: Sequence[StudyRow], metric: str, swept: str | None, ahead: str) -> Panel:
    values: dict[str, dict[str | float, float | None]] = {}
    intervals: dict[str, dict[str | float, tuple[float, float]]] = {}
    for row in rows:
        group = _EVERYONE if row.group == "all" else row.group
        place = getattr(row, swept) if swept else group
        values.setdefault(row.agents, {})[place] = row.metrics[metric]
        if metric in row.intervals:
            intervals.setdefault(row.agents, {})[place] = row.intervals[metric]
    percent = metric in PERCENT
    return Panel(
        values=values,
        intervals=intervals,
        title=f"{METRICS[metric]}{ahead}",
        ylabel=f"{METRICS[metric]} (%)" if percent else METRICS[metric],
        top=100.0 if percent else 1.0,
        xlabel=_XLABELS[swept] if swept else None,
    )
