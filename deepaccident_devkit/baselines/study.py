"""`v2x_study`: the paper's tables on what cooperation is worth, of a baseline, on any release."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence

from deepaccident_devkit.baselines.conditions import Condition, TablePlan, study_plan
from deepaccident_devkit.baselines.counting import Counting, Evaluators, counted
from deepaccident_devkit.baselines.study_config import StudyConfig
from deepaccident_devkit.baselines.study_result import StudyRow, StudyTable, V2XStudy
from deepaccident_devkit.baselines.study_samples import study_samples
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation import SampleAttributes, sample_attributes
from deepaccident_devkit.evaluation.metrics.attributes import tokens_by_value


def v2x_study(
    dataset: Dataset,
    split: str | os.PathLike[str] = "val",
    config: StudyConfig | None = None,
    *,
    workers: int | None = None,
    progress: bool = False,
) -> V2XStudy:
    """Compare what seven sets of agents foresee: overall, by visibility and time, and with noisy and late data.

    All rows of a horizon are of the same samples.

    Args:
        dataset: the release.
        split: `val`, … or a split file.
        config: how; None for the paper's way.
        workers: processes; None takes what the work is worth. The numbers do not depend on it.
        progress: whether to show a bar.

    Raises:
        ChoiceError: no such split.
        NotAvailableError: the release has nothing to compare.
    """
    how = config or StudyConfig()
    every = [condition for table in study_plan(quick=how.quick) for condition in table.conditions]
    samples = study_samples(
        dataset,
        split,
        sorted({each.horizon for each in every}),
        egos=how.egos,
        scope=how.scope,
        latest=max(each.latency for each in every),
    )
    plan = study_plan(samples.agents, quick=how.quick)
    wanted = dict.fromkeys(condition for table in plan for condition in table.conditions)
    conditions: dict[str, list[Condition]] = {}
    for condition in wanted:
        for token in samples.tokens[condition.horizon]:
            conditions.setdefault(token, []).append(condition)
    counting = Counting(dataset=dataset, model=how.model, protocol=how.protocol, seed=how.seed)
    evaluators = counted(counting, conditions, workers=workers, progress=progress)
    attributes = sample_attributes(dataset, conditions)
    return V2XStudy(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        split=str(split),
        config=how,
        tables={table.name: _table(table, evaluators, attributes) for table in plan},
        notes=samples.notes,
    )


def _table(
    plan: TablePlan, evaluators: Mapping[Condition, Evaluators], attributes: Mapping[str, SampleAttributes]
) -> StudyTable:
    rows = [
        (group, condition, evaluators[condition], tokens)
        for condition in plan.conditions
        if condition in evaluators
        for group, tokens in _groups(evaluators[condition], attributes, plan.by).items()
    ]
    grouped = plan.by != ("all",)
    if grouped:
        rows.sort(key=lambda row: (row[1].horizon, row[0]))
    by = ("agents", *plan.varied, *(("group",) if grouped else ()))
    return StudyTable(name=plan.name, title=plan.title, by=by, rows=tuple(_row(*row) for row in rows))


def _groups(
    evaluators: Evaluators, attributes: Mapping[str, SampleAttributes], by: Sequence[str]
) -> dict[str, list[str]]:
    """The samples of each value of each attribute."""
    here = {token: attributes[token] for token in sorted(evaluators.motion.tokens)}
    return {group or "not known": tokens for name in by for group, tokens in tokens_by_value(here, name).items()}


def _row(group: str, condition: Condition, evaluators: Evaluators, tokens: Sequence[str]) -> StudyRow:
    motion, maps = evaluators.motion.compute(tokens), evaluators.maps.compute(tokens)
    boxes = evaluators.boxes.compute(tokens)
    near, far = motion.ranges["30x30"], motion.ranges["100x100"]
    at = boxes.within[10.0]
    return StudyRow(
        agents=condition.agents,
        horizon=condition.horizon,
        pose_noise=condition.pose_noise,
        latency=condition.latency,
        group=group,
        samples=len(tokens),
        positives=maps.positives,
        metrics={
            "iou_30": _known(near.iou),
            "vpq_30": _known(near.pq),
            "iou_100": _known(far.iou),
            "vpq_100": _known(far.pq),
            "apa": _known(maps.apa),
            "id_error": _known(maps.id_error),
            "position_error": _known(maps.position_error),
            "time_error": _known(maps.time_error),
            "boxes_apa": _known(boxes.apa),
            "boxes_recall": at.tp / boxes.positives if boxes.positives else None,
        },
    )


def _known(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value
