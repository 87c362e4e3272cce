"""The numbers of the study: actors that the ego cannot see, a row's numbers, and differences of two rows."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import DetectedBoxes, Evaluator, MotionOutput, Resampling
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.evaluator import Counts, ratio, total
from deepaccident_devkit.evaluation.intervals import (
    LEAST_CLUSTERS,
    Clusters,
    difference_intervals,
    intervals_of,
    numbers_of,
)
from deepaccident_devkit.motion import MotionLabelConfig, motion_labels
from deepaccident_devkit.study.numbers import LEAST_SCORE, NEAR
from deepaccident_devkit.study.numbers import NUMBERS as PATHS
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID
from deepaccident_devkit.v2x.cooperation import seen_actors

Evaluators = Mapping[str, Evaluator[Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenResult:
    """How actors that only partners see are found, beside those that the ego sees; NaN where there is none.

    Attributes:
        hidden: how many, over all samples.
        seen: likewise, of those that the ego sees itself.
        hidden_foreground: share of the hidden ones whose centre's cell is foreground at the present.
        seen_foreground: likewise.
        hidden_detected: share of the hidden ones with a predicted box within `NEAR`.
        seen_detected: likewise.
        false_foreground: share of the predicted foreground cells that are background in the labels.
        false_boxes: predicted boxes on the grid, a sample, that are near no actor.
    """

    hidden: int
    seen: int
    hidden_foreground: float
    seen_foreground: float
    hidden_detected: float
    seen_detected: float
    false_foreground: float
    false_boxes: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """The truth of a sample at the present, in its ego frame.

    Attributes:
        labels: what its labels show.
        foreground: (H, W) bool, the labels' foreground.
        actors: (N, 2) metres, the centres of those that somebody sees and the labels draw; the ego is not among them.
        hidden: (N,) bool: the ego does not see it, but a partner does, by the released rule of visibility.
        every: (M, 2) the centres of all actors that somebody sees, also beyond the grid, and of the ego.
    """

    labels: MotionLabelConfig
    foreground: BoolArray
    actors: FloatArray
    hidden: BoolArray
    every: FloatArray


def scene_of(dataset: DeepAccident, token: str, labels: MotionLabelConfig) -> Scene:
    """The truth of a sample."""
    drawn = motion_labels(dataset, token, labels).segmentation[0] > 0
    seen = seen_actors(dataset, token, agents="all", frame="ego")
    own_bit = 1 << AGENTS.index(token.rsplit("/", 2)[1])
    centers = seen.boxes.center[:, :2]
    chosen = at_cells(drawn, centers, labels) & (seen.boxes.actor_id != OWN_ACTOR_ID)
    return Scene(
        labels=labels,
        foreground=drawn,
        actors=centers[chosen],
        hidden=(seen.seen_by[chosen] & own_bit) == 0,
        every=centers,
    )


def at_cells(raster: AnyArray, points: FloatArray, labels: MotionLabelConfig) -> BoolArray:
    """(N,) whether the cells of points are set; False beyond the grid."""
    index, inside = labels.grid.index_of(points)
    rows, columns = np.where(inside[:, None], index, 0).T
    return inside & (np.asarray(raster)[rows, columns] > 0)


class HiddenActors(Evaluator[HiddenResult]):
    """Counts of actors found, hidden and seen, by sample."""

    @property
    def settings(self) -> dict[str, Any]:
        return {"near": NEAR, "least_score": LEAST_SCORE}

    def update(self, token: str, scene: Scene, motion: MotionOutput, boxes: DetectedBoxes) -> None:
        """Count a sample; the boxes are in its ego frame, the motion is given as instance maps."""
        assert motion.instances is not None, f"{token}: expected instance maps"
        foreground = motion.grid.reorient(motion.instances[-1, 0] > 0, scene.labels.grid.orientation)
        chosen = boxes.boxes.center[boxes.scores >= LEAST_SCORE, :2]
        self.add(token, found_counts(scene, foreground, chosen))

    def result_of(self, counts: Collection[Counts]) -> HiddenResult:
        sums = {name: total(counts, name) for name in _COUNTED}
        return HiddenResult(
            hidden=int(sums["hidden"]),
            seen=int(sums["seen"]),
            hidden_foreground=ratio(sums["hidden_foreground"], sums["hidden"]),
            seen_foreground=ratio(sums["seen_foreground"], sums["seen"]),
            hidden_detected=ratio(sums["hidden_detected"], sums["hidden"]),
            seen_detected=ratio(sums["seen_detected"], sums["seen"]),
            false_foreground=ratio(sums["false_cells"], sums["cells"]),
            false_boxes=ratio(sums["false_boxes"], len(counts)),
        )


_COUNTED: Final = (
    "hidden",
    "seen",
    "hidden_foreground",
    "seen_foreground",
    "hidden_detected",
    "seen_detected",
    "cells",
    "false_cells",
    "false_boxes",
)


def found_counts(scene: Scene, foreground: BoolArray, boxes: FloatArray) -> dict[str, int]:
    """What a sample adds: the map (H, W) and boxes' centres (B, 2), also beyond the grid, against the truth."""
    on_map = at_cells(foreground, scene.actors, scene.labels)
    detected = _near(scene.actors, boxes)
    on_grid = boxes[scene.labels.grid.index_of(boxes)[1]]
    hidden = scene.hidden
    return {
        "hidden": int(hidden.sum()),
        "seen": int((~hidden).sum()),
        "hidden_foreground": int((on_map & hidden).sum()),
        "seen_foreground": int((on_map & ~hidden).sum()),
        "hidden_detected": int((detected & hidden).sum()),
        "seen_detected": int((detected & ~hidden).sum()),
        "cells": int(foreground.sum()),
        "false_cells": int((foreground & ~scene.foreground).sum()),
        "false_boxes": int((~_near(on_grid, scene.every)).sum()),
    }


def _near(points: FloatArray, others: FloatArray) -> BoolArray:
    """(N,) whether one of the others is within `NEAR` of each point."""
    apart = np.linalg.norm(points[:, None] - others[None], axis=-1)
    return np.asarray((apart <= NEAR).any(axis=1))


def clusters_of(tokens: Collection[str]) -> list[list[str]]:
    """The samples of each accident and its twin, always in the same order."""
    found: dict[str, list[str]] = {}
    for token in sorted(tokens):
        found.setdefault(cluster_of(token.rsplit("/", 2)[0]), []).append(token)
    return [found[name] for name in sorted(found)]


def row_numbers(
    seeds: Sequence[Evaluators], resampling: Resampling, tokens: Collection[str] | None = None
) -> dict[str, dict[str, Any]]:
    """Number → `value`, and with an interval `low` and `high`; of all seeds together, each sample once a seed.

    Args:
        seeds: the evaluators of each of the row's models.
        resampling: how intervals are made.
        tokens: of which samples; None for all.
    """
    found: dict[str, dict[str, Any]] = {}
    for kind in seeds[0]:
        clusters = _counts(seeds, kind, tokens)
        evaluator = seeds[0][kind]
        result = evaluator.result_of([*chain.from_iterable(clusters)])
        ends, values = intervals_of(evaluator, clusters, result, resampling).ends, numbers_of(result)
        for name, path in _named(kind).items():
            low, high = ends.get(path, (None, None))
            found[name] = {"value": _known(values.get(path)), "low": low, "high": high}
    return {name: found[name] for name in PATHS if name in found}


def differences(
    base: Sequence[Evaluators], other: Sequence[Evaluators], resampling: Resampling
) -> dict[str, dict[str, Any]]:
    """Number → how much more the other has, with its interval: the same clusters are left out of both."""
    found: dict[str, dict[str, Any]] = {}
    for kind in base[0]:
        evaluator, pair = base[0][kind], (_counts(base, kind), _counts(other, kind))
        first, second = (numbers_of(evaluator.result_of([*chain.from_iterable(each)])) for each in pair)
        paths = _named(kind)
        more = {path: second.get(path, math.nan) - first.get(path, math.nan) for path in paths.values()}
        ends = _ends(evaluator, pair, more, resampling)
        found |= {
            name: {"value": _known(more[path]), "low": ends[path][0], "high": ends[path][1]}
            for name, path in paths.items()
        }
    return {name: found[name] for name in PATHS if name in found}


def _ends(
    evaluator: Evaluator[Any], pair: tuple[Clusters, Clusters], more: Mapping[str, float], resampling: Resampling
) -> dict[str, tuple[float | None, float | None]]:
    if len(pair[0]) < LEAST_CLUSTERS or not resampling.resamples:
        return dict.fromkeys(more, (None, None))
    low, high, _ = difference_intervals(evaluator, pair, more, resampling)
    return {path: (_known(float(low[at])), _known(float(high[at]))) for at, path in enumerate(more)}


def _counts(seeds: Sequence[Evaluators], kind: str, tokens: Collection[str] | None = None) -> Clusters:
    """Of each cluster the counts of all its samples, with all seeds."""
    counts = [evaluators[kind].counts for evaluators in seeds]
    return [[each[token] for token in cluster for each in counts] for cluster in clusters_of(tokens or counts[0])]


def _named(kind: str) -> dict[str, str]:
    return {name: path for name, (found, path, _) in PATHS.items() if found == kind}


def _known(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value
