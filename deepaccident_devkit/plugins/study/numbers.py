"""The numbers of a study: hidden actors, the numbers of a row, and differences of two rows.

If a row has several seeds, a number is the mean over the seeds: the scores of two models are on
different scales, so a curve over the boxes of both would belong to no model. Intervals are of 95 %
over pairs of an accident and its twin; a pair that is left out is left out of all seeds.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from operator import itemgetter
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import DetectedBoxes, Evaluator, MotionOutput
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.evaluator import Counts, ratio, total
from deepaccident_devkit.evaluation.intervals import (
    LEAST_CLUSTERS,
    Resampling,
    draws_of_parts,
    ends_of_draws,
    numbers_of,
)
from deepaccident_devkit.evaluation.results import ResultsTask
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, agent_of, scenario_of
from deepaccident_devkit.motion import MotionLabelConfig, motion_labels
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, known
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID
from deepaccident_devkit.v2x import AVAILABLE
from deepaccident_devkit.v2x.cooperation import seen_actors

# Metres between the centres of a box and an actor, up to which the actor is detected.
DETECTION_RADIUS: Final = 2.0
# Boxes with a lower score are ignored when hidden actors are counted.
MIN_BOX_SCORE: Final = 0.1
HIDDEN: Final = "hidden"
# Number → its evaluator, its path in the evaluator's result, and its name in tables.
NUMBERS: Final[Mapping[str, tuple[str, str, str]]] = {
    "iou_30": ("motion", "ranges/30x30/iou", "IoU 30x30 (%)"),
    "vpq_30": ("motion", "ranges/30x30/pq", "VPQ 30x30 (%)"),
    "iou_100": ("motion", "ranges/100x100/iou", "IoU 100x100 (%)"),
    "vpq_100": ("motion", "ranges/100x100/pq", "VPQ 100x100 (%)"),
    "apa": ("accident", "apa", "APA boxes"),
    "precision": ("accident", "precision", "precision boxes"),
    "recall": ("accident", "recall", "recall boxes"),
    "map": ("detection", "mean_average_precision", "mAP (%)"),
    "hidden_foreground": (HIDDEN, "hidden_foreground", "hidden, on the map"),
    "seen_foreground": (HIDDEN, "seen_foreground", "seen, on the map"),
    "false_foreground": (HIDDEN, "false_foreground", "false share of the map"),
    "hidden_detected": (HIDDEN, "hidden_detected", "hidden, detected"),
    "seen_detected": (HIDDEN, "seen_detected", "seen, detected"),
    "false_boxes": (HIDDEN, "false_boxes", "false boxes a sample"),
}
# The numbers that are shares of hidden or seen actors.
_ACTOR_SHARES: Final = ("hidden_foreground", "seen_foreground", "hidden_detected", "seen_detected")
RESAMPLING: Final = Resampling()
# The evaluators of one model, by their names.
Evaluators = Mapping[str, Evaluator[Any]]
# The evaluators of each seed of a row; a row without seeds has an empty text as its seed.
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
    """Return new evaluators, also of hidden actors; their rules are the same for every horizon."""
    return {
        **{task: setup.evaluator() for task, setup in setups_of(labels).items()},
        HIDDEN: HiddenActors(),
    }


class HiddenActors(Evaluator[dict[str, float]]):
    """Detection of actors that only partners see, beside the actors that the ego sees, by sample.

    The result has, NaN where there is none: `hidden_foreground` and `seen_foreground`, the shares
    of actors with a foreground cell at their centre at the present; `hidden_detected` and
    `seen_detected`, the shares of actors with a predicted box within 2 m; `false_foreground`, the
    share of the predicted foreground that is background in the labels; and `false_boxes`, the
    number of predicted boxes a sample that are on the grid and near no actor. Actors are the ones
    that any agent sees and the labels draw; an actor is hidden if the ego does not see it, by the
    released rule of visibility.
    """

    @property
    def settings(self) -> dict[str, Any]:
        """The distance of a detection, in metres, and the minimum score of a box."""
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

        The boxes are in its ego frame. The motion must have instance maps; its last map counts.
        """
        if motion.instances is None:
            raise EvaluationError(
                f"{token}: expected instance maps, found heads; read them from a results file"
            )
        label_map = motion_labels(dataset, token, labels).segmentation[0] > 0
        foreground = motion.grid.reorient(motion.instances[-1, 0] > 0, labels.grid.orientation)
        actors = seen_actors(dataset, token, agents=AVAILABLE, frame="ego")
        centers = actors.boxes.center[:, :2]
        is_other = actors.boxes.actor_id != OWN_ACTOR_ID
        is_counted = _at_cells(label_map, centers, labels) & is_other
        counted_centers = centers[is_counted]
        ego_bit = 1 << AGENTS.index(agent_of(token))
        is_hidden = (actors.seen_by[is_counted] & ego_bit) == 0
        detections = boxes.boxes.center[boxes.scores >= MIN_BOX_SCORE, :2]
        detections_on_grid = detections[labels.grid.index_of(detections)[1]]
        on_map = _at_cells(foreground, counted_centers, labels)
        is_detected = _are_near(counted_centers, detections)
        masks = {
            "cells": foreground,
            "false_cells": foreground & ~label_map,
            "false_boxes": ~_are_near(detections_on_grid, centers),
        }
        for group, in_group in {"hidden": is_hidden, "seen": ~is_hidden}.items():
            masks[group] = in_group
            masks[f"{group}_foreground"] = in_group & on_map
            masks[f"{group}_detected"] = in_group & is_detected
        self.add(token, {name: int(mask.sum()) for name, mask in masks.items()})

    def result_of(self, counts: Collection[Counts]) -> dict[str, float]:
        """Return the shares, and the number of false boxes a sample."""
        parts_and_totals = {"false_foreground": ("false_cells", "cells")}
        for name in _ACTOR_SHARES:
            group = name.split("_")[0]
            parts_and_totals[name] = (name, group)
        result = {}
        for name, (part, group) in parts_and_totals.items():
            result[name] = ratio(total(counts, part), total(counts, group))
        result["false_boxes"] = ratio(total(counts, "false_boxes"), len(counts))
        return result


def _at_cells(raster: AnyArray, points: FloatArray, labels: MotionLabelConfig) -> BoolArray:
    """Return whether the cells of points (N, 2) are set in a map (H, W), shape (N,).

    Points beyond the grid are False.
    """
    indices, on_grid = labels.grid.index_of(points)
    rows, columns = np.where(on_grid[:, None], indices, 0).T
    return np.asarray(on_grid & (np.asarray(raster)[rows, columns] > 0))


def _are_near(points: FloatArray, others: FloatArray) -> BoolArray:
    """Return whether any of `others` (M, 2) is within `DETECTION_RADIUS` of points (N, 2), (N,)."""
    distances = np.linalg.norm(points[:, None] - others[None], axis=-1)
    return np.asarray((distances <= DETECTION_RADIUS).any(axis=1))


def numbers_of_rows(
    tokens: Collection[str], row: EvaluatorsBySeed, less: EvaluatorsBySeed | None = None
) -> dict[str, dict[str, Any]]:
    """Return the numbers of a row at some samples, or its differences from another row.

    The numbers are named as in `NUMBERS`. A number is the mean over all seeds, and missing if a
    seed lacks it. For its interval the same pairs of scenarios are left out of all seeds, and of
    both rows. `seeds` has the value of each seed; a row without seeds is compared with each seed of
    the other row.

    Returns:
        Number → `value`, `low` and `high`, None where there is none, and `seeds`.
    """
    numbers: dict[str, dict[str, Any]] = {}
    names = {token: cluster_of(scenario_of(token)) for token in tokens}
    clusters = dict(sorted(names.items(), key=itemgetter(1, 0)))
    has_interval = len({*clusters.values()}) >= LEAST_CLUSTERS
    for kind, evaluator in next(iter(row.values())).items():
        paths = {path: name for name, (owner, path, _) in NUMBERS.items() if owner == kind}
        row_values = _values_by_seed(row, kind, tokens, paths)
        if less is None:
            less_values = {"": np.zeros(len(paths))}
        else:
            less_values = _values_by_seed(less, kind, tokens, paths)
        values = np.mean([*row_values.values()], axis=0) - np.mean([*less_values.values()], axis=0)
        low = high = np.full(len(paths), math.nan)
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
                "value": known(values[index]),
                "low": known(low[index]),
                "high": known(high[index]),
                "seeds": {seed: known(array[index]) for seed, array in differences.items()},
            }
    return {name: numbers[name] for name in NUMBERS if name in numbers}


def _differences_by_seed(
    row_values: Mapping[str, FloatArray], less_values: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Return the differences (M,) of two rows by seed; a row without seeds joins each seed."""
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
    """Return each seed's numbers (M,) at some samples, NaN for none."""
    values = {}
    for seed, evaluators in seeds.items():
        numbers = numbers_of(evaluators[kind].compute(tokens))
        values[seed] = np.array([numbers.get(path, math.nan) for path in paths])
    return values


def _mean_draws(
    seeds: EvaluatorsBySeed, kind: str, clusters: Mapping[str, str], paths: Iterable[str]
) -> FloatArray:
    """Return the draws (2P, M) of `intervals.draws_of_parts`, averaged over seeds with a number."""
    draws_of_seeds = []
    for evaluators in seeds.values():
        evaluator = evaluators[kind]
        draws = draws_of_parts(evaluator, evaluator.clustered(clusters), paths, RESAMPLING)
        draws_of_seeds.append(draws)
    stacked_draws = np.ma.masked_invalid(np.array(draws_of_seeds))
    return np.asarray(stacked_draws.mean(axis=0).filled(math.nan))


def verdict(difference: Mapping[str, Any]) -> str:
    """Return `wins`, `loses` or `not decided`, by the interval of a difference."""
    low, high = difference["low"], difference["high"]
    if low is None or high is None or low <= 0 <= high:
        return "not decided"
    return "wins" if low > 0 else "loses"
