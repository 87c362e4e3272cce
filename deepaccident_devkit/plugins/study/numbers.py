"""The numbers of a study: hidden actors, the numbers of a row, and differences between two rows.

If a row has several seeds, a number is the mean over the seeds: scores of two models have different
scales, so a curve over the boxes of both would describe neither. Intervals are 95 % intervals over
pairs of an accident and its twin; a pair that is left out is left out for all seeds.
"""

import math
from collections.abc import Collection, Iterable, Mapping
from operator import itemgetter
from typing import Any

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import DetectedBoxes, Evaluator, MotionOutput
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.evaluator import Counts, ratio, total
from deepaccident_devkit.evaluation.intervals import (
    MIN_CLUSTERS,
    Resampling,
    draws_of_parts,
    ends_of_draws,
    numbers_of,
)
from deepaccident_devkit.evaluation.results import ResultsTask
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, agent_of, scenario_of
from deepaccident_devkit.motion import MotionLabelConfig, motion_labels
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, json_numbers
from deepaccident_devkit.support.human_names import metric_name
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID
from deepaccident_devkit.v2x import AVAILABLE
from deepaccident_devkit.v2x.cooperation import seen_actors

# Largest distance in metres between an actor and a box that detects it.
DETECTION_RADIUS = 2.0
# Boxes with a lower score are ignored when hidden actors are counted.
MIN_BOX_SCORE = 0.1
HIDDEN = "hidden"
_SOURCES = {
    "iou_30": ("motion", "ranges/30x30/iou"),
    "vpq_30": ("motion", "ranges/30x30/pq"),
    "iou_100": ("motion", "ranges/100x100/iou"),
    "vpq_100": ("motion", "ranges/100x100/pq"),
    "apa": ("accident", "apa"),
    "precision": ("accident", "precision"),
    "recall": ("accident", "recall"),
    "map": ("detection", "mean_average_precision"),
    "hidden_foreground": (HIDDEN, "hidden_foreground"),
    "seen_foreground": (HIDDEN, "seen_foreground"),
    "false_foreground": (HIDDEN, "false_foreground"),
    "hidden_detected": (HIDDEN, "hidden_detected"),
    "seen_detected": (HIDDEN, "seen_detected"),
    "false_boxes": (HIDDEN, "false_boxes"),
}
# Number → its evaluator, its path in that evaluator's result, and its name in tables.
NUMBERS: Mapping[str, tuple[str, str, str]] = {
    number: (*source, metric_name(number)) for number, source in _SOURCES.items()
}
# The numbers that are shares of the hidden or the seen actors.
_ACTOR_SHARES = ("hidden_foreground", "seen_foreground", "hidden_detected", "seen_detected")
RESAMPLING = Resampling()
# Name of an evaluator → the evaluator, for one model.
Evaluators = Mapping[str, Evaluator[Any]]
# Seed of a row → its evaluators; a row without seeds has the seed "".
EvaluatorsBySeed = Mapping[str, Evaluators]


def setups_of(labels: str, horizon: float = 2.0) -> dict[ResultsTask, EvaluationSetup]:
    """Return the evaluation setup of each task."""
    return {
        "motion": EvaluationSetup(
            task="motion", protocol="paper", switches={"labels": labels}, horizon=horizon
        ),
        "accident": EvaluationSetup(task="accident", protocol="boxes", horizon=horizon),
        "detection": EvaluationSetup(task="detection", protocol="paper", horizon=horizon),
    }


def evaluators_of(labels: str) -> dict[str, Evaluator[Any]]:
    """Return new evaluators of all tasks and of hidden actors; the horizon changes no rule."""
    return {
        **{task: setup.evaluator() for task, setup in setups_of(labels).items()},
        HIDDEN: HiddenActors(),
    }


class HiddenActors(Evaluator[dict[str, float]]):
    """Evaluates how well actors are detected that the ego sees, or that only partners see.

    Its result contains these numbers, NaN if unknown. `hidden_foreground` and `seen_foreground`:
    shares of actors with a foreground cell at their centre at t = 0. `hidden_detected` and
    `seen_detected`: shares of actors with a predicted box within 2 m. `false_foreground`: share of
    the predicted foreground that is background in the labels. `false_boxes`: number of predicted
    boxes per sample that are on the grid but not near any actor. Only actors that some agent sees
    and that the labels draw are counted. An actor is hidden if the ego does not see it by the
    released visibility rule.
    """

    @property
    def settings(self) -> NamedValues:
        """The largest distance of a detection in metres, and the lowest score of a box."""
        return {"near": DETECTION_RADIUS, "least_score": MIN_BOX_SCORE}

    def update(
        self,
        token: str,
        dataset: Dataset,
        labels: MotionLabelConfig,
        motion: MotionOutput,
        boxes: DetectedBoxes,
    ) -> None:
        """Count a sample.

        The boxes are in the ego frame. `motion` must have instance maps; the last map is used.
        """
        if motion.instances is None:
            raise EvaluationError(
                f"{token}: expected instance maps, found heads; read them from a results file"
            )
        label_map = motion_labels(dataset, token, labels).segmentation[0] > 0
        predicted_map = motion.instances[-1, 0] > 0
        foreground = motion.grid.reorient(predicted_map, labels.grid.orientation)
        actors = seen_actors(dataset, token, agents=AVAILABLE, frame="ego")
        centers = actors.boxes.center[:, :2]
        is_other = actors.boxes.actor_id != OWN_ACTOR_ID
        is_counted = _look_up_cells(label_map, centers, labels) & is_other
        counted_centers = centers[is_counted]
        ego_bit = 1 << AGENTS.index(agent_of(token))
        is_hidden = (actors.seen_by[is_counted] & ego_bit) == 0
        detections = boxes.boxes.center[boxes.scores >= MIN_BOX_SCORE, :2]
        _, is_on_grid = labels.grid.index_of(detections)
        is_on_map = _look_up_cells(foreground, counted_centers, labels)
        is_detected = _have_neighbour(counted_centers, detections)
        masks = {
            "cells": foreground,
            "false_cells": foreground & ~label_map,
            "false_boxes": ~_have_neighbour(detections[is_on_grid], centers),
        }
        for group, is_in_group in {"hidden": is_hidden, "seen": ~is_hidden}.items():
            masks[group] = is_in_group
            masks[f"{group}_foreground"] = is_in_group & is_on_map
            masks[f"{group}_detected"] = is_in_group & is_detected
        self.add(token, {name: int(mask.sum()) for name, mask in masks.items()})

    def result_of(self, counts: Collection[Counts]) -> dict[str, float]:
        """Return the shares, and the mean number of false boxes per sample."""
        result = {}
        result["false_foreground"] = ratio(total(counts, "false_cells"), total(counts, "cells"))
        for name in _ACTOR_SHARES:
            group = name.split("_")[0]
            result[name] = ratio(total(counts, name), total(counts, group))
        result["false_boxes"] = ratio(total(counts, "false_boxes"), len(counts))
        return result


def _look_up_cells(raster: AnyArray, points: FloatArray, labels: MotionLabelConfig) -> BoolArray:
    """Return whether the map (H, W) is set in the cells of points (N, 2), shape (N,).

    It is False for points outside the grid.
    """
    indices, is_on_grid = labels.grid.index_of(points)
    rows, columns = np.where(is_on_grid[:, None], indices, 0).T
    is_set: BoolArray = is_on_grid & (np.asarray(raster)[rows, columns] > 0)
    return is_set


def _have_neighbour(points: FloatArray, others: FloatArray) -> BoolArray:
    """Return whether any of `others` (M, 2) is within `DETECTION_RADIUS` of each point, (N,)."""
    offsets = points[:, None] - others
    distances = np.linalg.norm(offsets, axis=-1)
    is_near = distances <= DETECTION_RADIUS
    has_neighbour: BoolArray = is_near.any(axis=1)
    return has_neighbour


def numbers_of_rows(
    tokens: Collection[str], row: EvaluatorsBySeed, less: EvaluatorsBySeed | None = None
) -> dict[str, NamedValues]:
    """Compute the numbers of a row over some samples, or its differences from another row.

    Their names are those in `NUMBERS`. Each is the mean over all seeds; it is missing if any seed
    lacks it. For its interval, the same pairs of scenarios are left out for all seeds, and in both
    rows. `seeds` contains the value of each seed. A row without seeds is compared with each seed of
    the other row.

    Returns:
        Number → `value`, `low` and `high` (None if unknown), and `seeds`.
    """
    numbers: dict[str, NamedValues] = {}
    cluster_by_token = {token: cluster_of(scenario_of(token)) for token in tokens}
    clusters = dict(sorted(cluster_by_token.items(), key=itemgetter(1, 0)))
    has_interval = len({*clusters.values()}) >= MIN_CLUSTERS
    for kind, evaluator in next(iter(row.values())).items():
        paths = {path: name for name, (owner, path, _) in NUMBERS.items() if owner == kind}
        row_values = _values_by_seed(row, kind, tokens, paths)
        less_values = {"": np.zeros(len(paths))}
        if less is not None:
            less_values = _values_by_seed(less, kind, tokens, paths)
        row_mean = np.mean([*row_values.values()], axis=0)
        less_mean = np.mean([*less_values.values()], axis=0)
        values = row_mean - less_mean
        low = np.full(len(paths), math.nan)
        high = low
        if has_interval:
            draws = _mean_draws(row, kind, clusters, paths)
            result_rows = evaluator.result_class.rows
            if less is not None:
                draws = draws - _mean_draws(less, kind, clusters, paths)
                result_rows = None
            low, high, _ = ends_of_draws(paths, values, draws, RESAMPLING.confidence, result_rows)
        differences = _differences_by_seed(row_values, less_values)
        for index, name in enumerate(paths.values()):
            numbers[name] = {
                "value": json_numbers(values[index]),
                "low": json_numbers(low[index]),
                "high": json_numbers(high[index]),
                "seeds": {seed: json_numbers(array[index]) for seed, array in differences.items()},
            }
    return {name: numbers[name] for name in NUMBERS if name in numbers}


def _differences_by_seed(
    row_values: Mapping[str, FloatArray], less_values: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Return the differences (M,) of two rows by seed; a row without seeds pairs with each seed."""
    differences = {}
    for seed in dict.fromkeys((*row_values, *less_values)):
        if not seed:
            continue
        row_array = row_values.get(seed, row_values.get(""))
        less_array = less_values.get(seed, less_values.get(""))
        if row_array is not None and less_array is not None:
            differences[seed] = row_array - less_array
    return differences


def _values_by_seed(
    seeds: EvaluatorsBySeed, kind: str, tokens: Collection[str], paths: Iterable[str]
) -> dict[str, FloatArray]:
    """Return the numbers (M,) of each seed over some samples; NaN if unknown."""
    values = {}
    for seed, evaluators in seeds.items():
        numbers = numbers_of(evaluators[kind].compute(tokens))
        values[seed] = np.array([numbers.get(path, math.nan) for path in paths])
    return values


def _mean_draws(
    seeds: EvaluatorsBySeed, kind: str, clusters: Mapping[str, str], paths: Iterable[str]
) -> FloatArray:
    """Average the draws (2P, M) of `intervals.draws_of_parts` over the seeds with known values."""
    draws_of_seeds = []
    for evaluators in seeds.values():
        evaluator = evaluators[kind]
        draws = draws_of_parts(evaluator, evaluator.clustered(clusters), paths, RESAMPLING)
        draws_of_seeds.append(draws)
    stacked_draws = np.ma.masked_invalid(np.array(draws_of_seeds))
    mean_draws: FloatArray = stacked_draws.mean(axis=0).filled(math.nan)
    return mean_draws


def verdict(difference: ReadOnlyValues) -> str:
    """Return `wins`, `loses` or `not decided`, by the interval of a difference."""
    low = difference["low"]
    high = difference["high"]
    if low is None or high is None or low <= 0 <= high:
        return "not decided"
    if low > 0:
        return "wins"
    return "loses"
