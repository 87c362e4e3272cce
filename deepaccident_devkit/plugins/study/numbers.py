"""The numbers of a study: actors that the ego cannot see, a row's numbers, and differences of two rows.

Where a row has several seeds, a number is the mean of theirs: the scores of two models are on different scales, so a
curve over the boxes of both would be no model's. Intervals are of 95 % over pairs of an accident and its twin; a pair
that is left out is left out of all seeds.
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

# Metres, from a box's centre to an actor's: so near, the actor is detected.
DETECTION_RADIUS: Final = 2.0
# Boxes with a lower score are not looked at when hidden actors are counted.
LEAST_BOX_SCORE: Final = 0.1
HIDDEN: Final = "hidden"
# Number → the evaluator that has it, its path in the result, and its name in tables.
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
RESAMPLING: Final = Resampling()
# One model's evaluators, by what they evaluate.
Evaluators = Mapping[str, Evaluator[Any]]
# Those of each of a row's seeds; of a row without, under an empty text.
EvaluatorsBySeed = Mapping[str, Evaluators]


def setups_of(labels: str, horizon: float = 2.0) -> dict[ResultsTask, EvaluationSetup]:
    """Task → by which rules it is evaluated."""
    return {
        "motion": EvaluationSetup(
            task="motion", protocol="paper", switches={"labels": labels}, horizon=horizon
        ),
        "accident": EvaluationSetup(task="accident", protocol="boxes", horizon=horizon),
        "detection": EvaluationSetup(task="detection", protocol="paper", horizon=horizon),
    }


def evaluators_of(labels: str) -> dict[str, Evaluator[Any]]:
    """New evaluators by these rules, which are the same for every horizon, and that of hidden actors."""
    return {
        **{task: setup.evaluator() for task, setup in setups_of(labels).items()},
        HIDDEN: HiddenActors(),
    }


class HiddenActors(Evaluator[dict[str, float]]):
    """How actors that only partners see are found, beside those that the ego sees, by sample.

    The result has, NaN where there is none: `hidden_foreground` and `seen_foreground`, the shares of actors whose
    centre's cell is foreground at the present; `hidden_detected` and `seen_detected`, of those with a predicted box
    within 2 m; `false_foreground`, the share of the predicted foreground that is background in the labels; and
    `false_boxes`, predicted boxes on the grid, a sample, that are near no actor. Actors are those that somebody sees
    and the labels draw; hidden are those of them that the ego does not see, by the released rule of visibility.
    """

    @property
    def settings(self) -> dict[str, Any]:
        """The distance and the score."""
        return {"near": DETECTION_RADIUS, "least_score": LEAST_BOX_SCORE}

    def update(
        self,
        token: str,
        dataset: Dataset,
        labels: MotionLabelConfig,
        motion: MotionOutput,
        boxes: DetectedBoxes,
    ) -> None:
        """Count a sample; the boxes are in its ego frame, the motion is given as instance maps, the last one counts."""
        if motion.instances is None:
            raise EvaluationError(
                f"{token}: expected instance maps, found heads; read them from a results file"
            )
        drawn = motion_labels(dataset, token, labels).segmentation[0] > 0
        foreground = motion.grid.reorient(motion.instances[-1, 0] > 0, labels.grid.orientation)
        seen = seen_actors(dataset, token, agents=AVAILABLE, frame="ego")
        center, own_bit = seen.boxes.center[:, :2], 1 << AGENTS.index(agent_of(token))
        chosen = _at_cells(drawn, center, labels) & (seen.boxes.actor_id != OWN_ACTOR_ID)
        actors, hidden = center[chosen], (seen.seen_by[chosen] & own_bit) == 0
        found = boxes.boxes.center[boxes.scores >= LEAST_BOX_SCORE, :2]
        on_grid = found[labels.grid.index_of(found)[1]]
        counts = {
            "cells": foreground,
            "false_cells": foreground & ~drawn,
            "false_boxes": ~_near(on_grid, center),
        }
        on_map, detected = _at_cells(foreground, actors, labels), _near(actors, found)
        for who, those in {"hidden": hidden, "seen": ~hidden}.items():
            counts |= {
                who: those,
                f"{who}_foreground": those & on_map,
                f"{who}_detected": those & detected,
            }
        self.add(token, {name: int(each.sum()) for name, each in counts.items()})

    def result_of(self, counts: Collection[Counts]) -> dict[str, float]:
        """Shares, and boxes a sample."""
        of = {
            "false_foreground": ("false_cells", "cells"),
            **{name: (name, name.split("_")[0]) for name in _SHARES},
        }
        shares = {
            name: ratio(total(counts, one), total(counts, all_)) for name, (one, all_) in of.items()
        }
        return {**shares, "false_boxes": ratio(total(counts, "false_boxes"), len(counts))}


_SHARES: Final = ("hidden_foreground", "seen_foreground", "hidden_detected", "seen_detected")


def _at_cells(raster: AnyArray, points: FloatArray, labels: MotionLabelConfig) -> BoolArray:
    """(N,) whether the cells of points (N, 2) are set in a map (H, W); False beyond the grid."""
    index, inside = labels.grid.index_of(points)
    rows, columns = np.where(inside[:, None], index, 0).T
    return np.asarray(inside & (np.asarray(raster)[rows, columns] > 0))


def _near(points: FloatArray, others: FloatArray) -> BoolArray:
    """(N,) whether one of the others is within `DETECTION_RADIUS` of each point."""
    apart = np.linalg.norm(points[:, None] - others[None], axis=-1)
    return np.asarray((apart <= DETECTION_RADIUS).any(axis=1))


def numbers_of_rows(
    tokens: Collection[str], row: EvaluatorsBySeed, less: EvaluatorsBySeed | None = None
) -> dict[str, dict[str, Any]]:
    """The numbers of a row at some samples, or how much more it has than another one, by their names in `NUMBERS`.

    A number is the mean of those of all seeds; there is none if a seed has none. For its interval the same pairs of
    scenarios are left out of all seeds, and of both rows. `seeds` has the value of each seed; a row without seeds is
    compared with each one of the other.

    Returns:
        Number → `value`, `low` and `high`, None where there is none, and `seeds`.
    """
    found: dict[str, dict[str, Any]] = {}
    names = {token: cluster_of(scenario_of(token)) for token in tokens}
    clusters = dict(sorted(names.items(), key=itemgetter(1, 0)))
    for kind, evaluator in next(iter(row.values())).items():
        paths = {path: name for name, (of, path, _) in NUMBERS.items() if of == kind}
        ours = _values(row, kind, tokens, paths)
        theirs = {"": np.zeros(len(paths))} if less is None else _values(less, kind, tokens, paths)
        values = np.mean([*ours.values()], axis=0) - np.mean([*theirs.values()], axis=0)
        low = high = np.full(len(paths), math.nan)
        if len({*clusters.values()}) >= LEAST_CLUSTERS:
            drawn, rows = _drawn(row, kind, clusters, paths), evaluator.result_class.rows
            if less is not None:
                drawn, rows = drawn - _drawn(less, kind, clusters, paths), None
            low, high, _ = ends_of_draws(paths, values, drawn, RESAMPLING.confidence, rows)
        seeds = {}
        for seed in dict.fromkeys(filter(None, (*ours, *theirs))):
            pair = [each.get(seed, each.get("")) for each in (ours, theirs)]
            if pair[0] is not None and pair[1] is not None:
                seeds[seed] = pair[0] - pair[1]
        for at, name in enumerate(paths.values()):
            ends = {"value": known(values[at]), "low": known(low[at]), "high": known(high[at])}
            found[name] = {**ends, "seeds": {seed: known(each[at]) for seed, each in seeds.items()}}
    return {name: found[name] for name in NUMBERS if name in found}


def _values(
    seeds: EvaluatorsBySeed, kind: str, tokens: Collection[str], paths: Iterable[str]
) -> dict[str, FloatArray]:
    """Return each seed's numbers (M,) at some samples, NaN for none."""
    values = {}
    for seed, evaluators in seeds.items():
        numbers = numbers_of(evaluators[kind].compute(tokens))
        values[seed] = np.array([numbers.get(path, math.nan) for path in paths])
    return values


def _drawn(
    seeds: EvaluatorsBySeed, kind: str, clusters: Mapping[str, str], paths: Iterable[str]
) -> FloatArray:
    """Return the draws (2P, M) of `intervals.draws_of_parts`, the mean of those of the seeds that have a number."""
    evaluators = [each[kind] for each in seeds.values()]
    drawn = np.array(
        [draws_of_parts(each, each.clustered(clusters), paths, RESAMPLING) for each in evaluators]
    )
    return np.asarray(np.ma.masked_invalid(drawn).mean(axis=0).filled(math.nan))


def verdict(difference: Mapping[str, Any]) -> str:
    """`wins`, `loses` or `not decided`, by the interval of a difference."""
    low, high = difference["low"], difference["high"]
    decided = low is not None and high is not None and not low <= 0 <= high
    return ("wins" if low > 0 else "loses") if decided else "not decided"
