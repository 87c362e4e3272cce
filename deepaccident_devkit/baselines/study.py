"""`v2x_study`: the paper's tables on the gain of cooperation, with a baseline, on any release."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

from deepaccident_devkit.baselines.conditions import Condition, TablePlan, study_plan
from deepaccident_devkit.baselines.counting import Counting, Evaluators, counted
from deepaccident_devkit.baselines.study_config import StudyConfig
from deepaccident_devkit.baselines.study_result import StudyTable, V2XStudy
from deepaccident_devkit.baselines.study_rows import study_row
from deepaccident_devkit.baselines.study_samples import StudySamples, study_samples
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

    All rows of a horizon are of the same samples. Intervals are over clusters (an accident and its twin are one).

    Args:
        dataset: the release.
        split: `val`, … or a split file.
        config: the settings; None for the paper's.
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
    counting = Counting(dataset=dataset, model=how.model, protocol=how.protocol, seeds=how.seeds)
    evaluators = counted(counting, conditions, workers=workers, progress=progress)
    attributes = sample_attributes(dataset, conditions)
    return V2XStudy(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        split=str(split),
        config=how,
        tables={table.name: _table(table, evaluators, samples, attributes, how) for table in plan},
        notes=samples.notes,
    )


def _table(
    plan: TablePlan,
    evaluators: Mapping[Condition, Evaluators],
    samples: StudySamples,
    attributes: Mapping[str, SampleAttributes],
    config: StudyConfig,
) -> StudyTable:
    rows = [
        (condition, group, tokens)
        for condition in plan.conditions
        if condition in evaluators
        for group, tokens in _groups(samples.tokens[condition.horizon], attributes, plan.by).items()
    ]
    grouped = plan.by != ("all",)
    if grouped:
        rows.sort(key=lambda row: (row[0].horizon, row[1]))
    return StudyTable(
        name=plan.name,
        title=plan.title,
        by=("agents", *plan.varied, *(("group",) if grouped else ())),
        rows=tuple(study_row(*row, evaluators, config) for row in rows),
    )


def _groups(
    tokens: Sequence[str], attributes: Mapping[str, SampleAttributes], by: Sequence[str]
) -> dict[str, list[str]]:
    """The samples of each value of each attribute."""
    here = {token: attributes[token] for token in sorted(tokens)}
    return {group or "not known": found for name in by for group, found in tokens_by_value(here, name).items()}
