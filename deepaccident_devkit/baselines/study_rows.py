"""The rows of the study's tables: numbers of some samples under one condition, and how sure they are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, Final

import numpy as np

from deepaccident_devkit.baselines.conditions import Condition
from deepaccident_devkit.baselines.counting import Evaluators, drawn
from deepaccident_devkit.baselines.study_config import StudyConfig
from deepaccident_devkit.baselines.study_result import StudyRow
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.metrics.attributes import cluster_of
from deepaccident_devkit.evaluation.metrics.evaluator import Evaluator
from deepaccident_devkit.evaluation.metrics.intervals import (
    LEAST_CLUSTERS,
    Clusters,
    difference_intervals,
    intervals_of,
)
from deepaccident_devkit.evaluation.metrics.numbers import numbers_of

_PATHS: Final[Mapping[str, Mapping[str, str]]] = {
    "motion": {
        "iou_30": "ranges/30x30/iou",
        "vpq_30": "ranges/30x30/pq",
        "iou_100": "ranges/100x100/iou",
        "vpq_100": "ranges/100x100/pq",
    },
    "maps": {"apa": "apa", "id_error": "id_error", "position_error": "position_error", "time_error": "time_error"},
    "boxes": {"boxes_apa": "apa", "boxes_precision": "precision", "boxes_recall": "recall"},
    "detection": {"mAP": "mean_average_precision"},
}
"""Evaluator → number of a row → its path in that evaluator's result."""
_Ends = dict[str, tuple[float, float]]


def study_row(
    condition: Condition,
    group: str,
    tokens: Sequence[str],
    evaluators: Mapping[Condition, Evaluators],
    config: StudyConfig,
) -> StudyRow:
    """The row of some samples.

    Args:
        condition: under which they were counted.
        group: what the table calls them.
        tokens: of the samples.
        evaluators: of the condition and of its base.
        config: of the study.
    """
    seeds, clusters = condition.seeds(config.seeds), _clusters(tokens)
    metrics: dict[str, float | None] = {}
    intervals, gains, spread = _Ends(), _Ends(), _Ends()
    for kind, paths in _PATHS.items():
        evaluator: Evaluator[Any] = getattr(evaluators[condition], kind)
        counts = _counts(evaluator, clusters, seeds)
        result = evaluator.result_of([*chain.from_iterable(counts)])
        made, found = intervals_of(evaluator, counts, result, config.resampling), numbers_of(result)
        metrics |= {name: _known(found.get(path)) for name, path in paths.items()}
        intervals |= _named(made.ends, paths)
        if condition.base != condition:
            base = _counts(getattr(evaluators[condition.base], kind), clusters, condition.base.seeds(config.seeds))
            gains |= _named(_gains(evaluator, base, counts, list(paths.values()), config.resampling), paths)
        if len(seeds) > 1:
            alone = [numbers_of(evaluator.compute(drawn(token, seed) for token in tokens)) for seed in seeds]
            spread |= _spread(alone, paths)
    return StudyRow(
        agents=condition.agents,
        horizon=condition.horizon,
        pose_noise=condition.pose_noise,
        latency=condition.latency,
        group=group,
        samples=len(tokens),
        scenarios=len({token.rsplit("/", 2)[0] for token in tokens}),
        clusters=len(clusters),
        positives=evaluators[condition].maps.compute(drawn(token, seeds[0]) for token in tokens).positives,
        metrics=metrics,
        intervals=intervals,
        gains=gains,
        spread=spread,
    )


def _clusters(tokens: Sequence[str]) -> list[list[str]]:
    """The samples of each accident and its twin."""
    found: dict[str, list[str]] = {}
    for token in sorted(tokens):
        found.setdefault(cluster_of(token.rsplit("/", 2)[0]), []).append(token)
    return [found[name] for name in sorted(found)]


def _counts(evaluator: Evaluator[Any], clusters: Sequence[Sequence[str]], seeds: Sequence[int]) -> Clusters:
    """What was counted of each cluster, with all seeds."""
    counts = evaluator.counts
    return [[counts[drawn(token, seed)] for token in cluster for seed in seeds] for cluster in clusters]


def _gains(
    evaluator: Evaluator[Any], base: Clusters, counts: Clusters, paths: Sequence[str], resampling: Resampling
) -> _Ends:
    """Intervals of differences of paths' numbers to those of the base, cluster by cluster; as of two runs."""
    if not resampling.resamples or len(counts) < LEAST_CLUSTERS:
        return {}
    found = [numbers_of(evaluator.result_of([*chain.from_iterable(each)])) for each in (base, counts)]
    gained = {path: found[1].get(path, math.nan) - found[0].get(path, math.nan) for path in paths}
    low, high, _ = difference_intervals(evaluator, (base, counts), gained, resampling)
    return {path: (float(low[at]), float(high[at])) for at, path in enumerate(paths) if np.isfinite(low[at])}


def _named(ends: Mapping[str, tuple[float, float]], paths: Mapping[str, str]) -> _Ends:
    """Ends by the names of numbers, not by their paths."""
    return {name: ends[path] for name, path in paths.items() if path in ends}


def _spread(seeds: Sequence[Mapping[str, float]], paths: Mapping[str, str]) -> _Ends:
    """The least and the most of the seeds that have a number."""
    found = {name: [each[path] for each in seeds if _known(each.get(path)) is not None] for name, path in paths.items()}
    return {name: (min(values), max(values)) for name, values in found.items() if values}


def _known(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value
