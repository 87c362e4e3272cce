"""`v2x_study`: the paper's tables on the gain of cooperation, with a baseline, on any release."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from deepaccident_devkit.baselines.conditions import Condition, TablePlan, study_plan
from deepaccident_devkit.baselines.counting import Counting, Evaluators, counted
from deepaccident_devkit.baselines.study_config import StudyConfig
from deepaccident_devkit.baselines.study_result import StudyTable, V2XStudy
from deepaccident_devkit.baselines.study_rows import study_row
from deepaccident_devkit.baselines.study_samples import StudySamples, study_samples
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation import SampleAttributes, sample_attributes
from deepaccident_devkit.evaluation.metrics.attributes import tokens_by_value

if TYPE_CHECKING:
    from concurrent.futures import Executor


def v2x_study(
    dataset: Dataset,
    split: str | os.PathLike[str] = "val",
    config: StudyConfig | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> V2XStudy:
    """Compare what seven sets of agents foresee: overall, by visibility and time, and with noisy and late data.

    All rows of a horizon are of the same samples. Intervals are over clusters (an accident and its twin are one).

    Args:
        dataset: the release.
        split: `val`, … or a split file.
        config: the settings; None for the paper's.
        workers: processes; None takes what the work is worth. The numbers do not depend on it.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        ChoiceError: no such split.
        NotAvailableError: the release has nothing to compare.
        WorkerError: a worker was killed, or cannot do the work.
    """
    planned = PlannedStudy.of(dataset, split, config or StudyConfig())
    return planned.study(
        counted(planned.counting, planned.conditions, workers=workers, executor=executor, progress=progress)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedStudy:
    """A study before its samples are counted.

    Attributes:
        counting: how they are.
        split: name of a split, or a split file.
        config: the settings.
        samples: what is compared.
        tables: what each table shows.
        conditions: sample → the conditions under which it is counted.
    """

    counting: Counting
    split: str
    config: StudyConfig
    samples: StudySamples
    tables: Sequence[TablePlan]
    conditions: Mapping[str, Sequence[Condition]]

    @classmethod
    def of(cls, dataset: Dataset, split: str | os.PathLike[str], config: StudyConfig) -> PlannedStudy:
        """The plan of `v2x_study`, with its errors."""
        every = [condition for table in study_plan(quick=config.quick) for condition in table.conditions]
        samples = study_samples(
            dataset,
            split,
            sorted({each.horizon for each in every}),
            egos=config.egos,
            scope=config.scope,
            latest=max(each.latency for each in every),
        )
        tables = study_plan(samples.agents, quick=config.quick)
        wanted = dict.fromkeys(condition for table in tables for condition in table.conditions)
        conditions: dict[str, list[Condition]] = {}
        for condition in wanted:
            for token in samples.tokens[condition.horizon]:
                conditions.setdefault(token, []).append(condition)
        return cls(
            counting=Counting(dataset=dataset, model=config.model, protocol=config.protocol, seeds=config.seeds),
            split=str(split),
            config=config,
            samples=samples,
            tables=tables,
            conditions=conditions,
        )

    def study(self, evaluators: Mapping[Condition, Evaluators]) -> V2XStudy:
        """The study, of the evaluators of all conditions."""
        dataset = self.counting.dataset
        attributes = sample_attributes(dataset, self.conditions)
        return V2XStudy(
            dataroot=str(dataset.dataroot),
            version=dataset.version,
            split=self.split,
            config=self.config,
            tables={each.name: _table(each, evaluators, self.samples, attributes, self.config) for each in self.tables},
            notes=self.samples.notes,
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
