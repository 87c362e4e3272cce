"""Accidents as the released code evaluates them, bugs included (protocol `released`).

docs/released_code.md, Accidents, describes it. Bugs of other functions: `exact.contours` (boxes of
5 m × 2 m at most, rasterised into the wrong frame after a gap, and only for the first frame's
instances), `outlines.first_outline` (of an instance in several parts, only one counts),
`trajectories.padded` and `match_trajectories`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.scoring import (
    ACCIDENT_ERRORS,
    DISTANCES,
    AccidentResult,
    ComparedAccidents,
    actor_of,
    named,
    sample_tally,
    tally_result,
    united,
)
from deepaccident_devkit.evaluation.alarms import position_difference
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.instances import (
    Paths,
    instance_paths,
    longest,
    match_trajectories,
    padded,
)
from deepaccident_devkit.evaluation.predictions import (
    Accident,
    MotionOutput,
    Prediction,
    compared_frames,
    first_frames,
    frames_there,
    labels_at_present,
)
from deepaccident_devkit.evaluation.truth import AccidentContext
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import to_orientation
from deepaccident_devkit.motion import MotionHeads, MotionLabels, predict_instances, trajectories
from deepaccident_devkit.motion.reference_arithmetic.contours import first_hulls, redrawn_cells
from deepaccident_devkit.motion.reference_arithmetic.outlines import pair_gaps
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_Pair = tuple[int, int]
# The released code's errors where nothing is foreseen: a share, metres, seconds.
_ERRORS_WITHOUT_HIT: Final = {"id": 1.0, "position": 20.0, "time": 1.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleasedAccidents:
    """The released rules with all quirks, without a choice.

    - The truth is what the post-processing finds in the labels, also where instance maps are
      predicted.
    - Distances are between the boxes rasterised along the paths (`outlines.pair_gaps`).
    - Only the last frame counts, as the lists of accidents begin empty at each. So accidents have
      no time, and its error is always 0.
    - An accident foreseen elsewhere is a false positive and does not leave the true one missed.
    - Where the first prediction has no instance at all, the others do not count: a true accident is
      missed, and nothing is a false alarm.
    - Where there is no accident, only one foreseen by the last prediction (the mean) is a false
      positive. A true accident may be foreseen by any prediction.
    - The errors are means over all three distances; the paper has the errors within 10 m.
    """

    labels: ClassVar[str] = "released"
    """Protocol of the labels that are the truth; others are refused."""
    truth_gap: ClassVar[float] = 0.001
    """Cells; true instances that are nearer collide: they must overlap."""
    prediction_gap: ClassVar[float] = 5.0
    """Cells; predicted instances that are nearer collide: 2.5 m. The paper has 1 m for both."""

    maps_alone: ClassVar[bool] = True
    """Whether it only compares maps, and no explicit accidents."""

    def counts(
        self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext
    ) -> Counts:
        """Return what one sample adds.

        Raises:
            EvaluationError: there is no label, or the prediction is not motion.
        """
        if not isinstance(prediction, MotionOutput) or label is None:
            raise EvaluationError(
                "the released protocol compares motion: give a MotionOutput and the sample's "
                "motion labels; explicit accidents are for protocol='paper' or 'boxes'"
            )
        frames = compared_frames(prediction, label, self.labels)
        label = labels_at_present(label)
        truth, present = self.truth_paths(label, frames)
        points = longest(truth.paths) or len(truth.drawn)
        truth = padded_paths(truth, points)
        predictions = []
        for drawn_paths in self.prediction_paths(prediction, frames):
            predictions.append(padded_paths(drawn_paths, points))
        matches = []
        for predicted in predictions:
            matches.append(match_trajectories(predicted.paths, truth.paths).pairs)
        counts, pair = accident_counts(predictions, truth, matches)
        actors = None
        if pair is not None:
            actors = [actor_of(present == instance, 0, label, context) for instance in pair]
        return counts | {"named": named(actors, context)}

    def compared(
        self,
        prediction: MotionOutput | list[Accident],
        label: MotionLabels | None,
        _context: AccidentContext,
    ) -> ComparedAccidents:
        """Return the accidents that the protocol sees; raises EvaluationError."""
        if label is None or not isinstance(prediction, MotionOutput):
            raise EvaluationError(
                "the released protocol compares motion: give a MotionOutput and the motion labels"
            )
        frames = frames_there(label)
        truth, _ = self.truth_paths(labels_at_present(label), frames)
        points = longest(truth.paths) or len(truth.drawn)
        seconds = (points - 1) * (label.config.step * FRAME_PERIOD)
        predictions = self.prediction_paths(prediction, frames)
        if not predictions[0].paths:
            predictions = []
        predicted = []
        true = _drawn_accident(truth, points, self.truth_gap, seconds)
        for drawn_paths in predictions:
            accident = _drawn_accident(drawn_paths, points, self.prediction_gap, seconds)
            if accident is not None:
                predicted.append(accident)
        return ComparedAccidents(true=true, predicted=tuple(predicted))

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """Return the metrics of some samples' counts, in any order."""
        result = tally_result(_united(counts), DISTANCES[0])
        errors: dict[str, Any] = {}
        for name in ACCIDENT_ERRORS:
            field = f"{name}_error"
            by_distance = [getattr(within, field) for within in result.within.values()]
            errors[field] = self._error(by_distance, name)
        return replace(result, **errors)

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """Return the sum of all counts, which has the same result."""
        return [_united(counts)]

    def truth_paths(self, label: MotionLabels, frames: int) -> tuple[DrawnPaths, AnyArray]:
        """Return what predictions are compared with, and its ids at the present, (H, W)."""
        heads = first_frames(MotionHeads.from_labels(label), frames)
        return paths_of_heads(heads, label.config.grid)

    def prediction_paths(self, output: MotionOutput, frames: int) -> list[DrawnPaths]:
        """Return the paths of each of the K predictions, cut to a number of frames."""
        if output.instances is not None:
            return [paths_of_instances(maps[:frames], output.grid) for maps in output.instances]
        cut = [first_frames(heads, frames) for heads in output.heads or ()]
        return [paths_of_heads(heads, output.grid)[0] for heads in cut]

    def _error(self, errors: Sequence[float | None], name: str) -> float:
        """Return an error over all distances; `_ERRORS_WITHOUT_HIT` stands in for unknown ones."""
        default = _ERRORS_WITHOUT_HIT[name]
        known = [default if error is None else error for error in errors]
        return math.fsum(known) / len(known)


def padded_paths(drawn_paths: DrawnPaths, length: int) -> DrawnPaths:
    """Return the same with paths of a number of points.

    Paths that end early go on faster and faster (`trajectories.padded`).
    """
    return replace(drawn_paths, paths=padded(drawn_paths.paths, length))


def accident_counts(
    predictions: Sequence[DrawnPaths], truth: DrawnPaths, matches: Sequence[Collection[_Pair]]
) -> tuple[dict[str, Any], _Pair | None]:
    """Return what one sample adds, from padded paths.

    Args:
        predictions: K predictions, the mean last.
        truth: The truth.
        matches: Pairs of predicted and matched true ids, for each prediction.

    Returns:
        The counts: `tp`, `fp`, `fn` and the sums of the errors (`id`, `position`, `time`), each a
        list by `DISTANCES`, and `positive`; and the pair that collides in truth.
    """
    frame = (longest(truth.paths) or len(truth.drawn)) - 1
    true_pair = drawn_collision(truth, frame, ReleasedAccidents.truth_gap)
    names = ("tp", "fp", "fn", *ACCIDENT_ERRORS)
    counts: dict[str, Any] = {name: [0] * len(DISTANCES) for name in names}
    counts["positive"] = true_pair is not None
    if not predictions[0].paths:
        counts["fn"] = [int(true_pair is not None)] * len(DISTANCES)
        return counts, true_pair
    gap = ReleasedAccidents.prediction_gap
    pairs = [drawn_collision(prediction, frame, gap) for prediction in predictions]
    if true_pair is None:
        counts["fp"] = [int(pairs[-1] is not None)] * len(DISTANCES)
        return counts, None
    best: tuple[float, _Pair, Collection[_Pair]] | None = None
    for prediction, pair, matched in zip(predictions, pairs, matches, strict=True):
        if pair is None:
            continue
        position = _position_error((prediction, pair), (truth, true_pair), frame)
        if best is None or position < best[0]:
            best = position, pair, matched
    if best is None:
        counts["fn"] = [1] * len(DISTANCES)
        return counts, true_pair
    position, pair, matched = best
    # by the matches of their paths
    is_same = all(any((name, true) in matched for true in true_pair) for name in pair)
    errors = {"id": int(not is_same), "position": position, "time": 0.0}
    within = [position <= distance for distance in DISTANCES]
    counts["tp"] = [int(is_within) for is_within in within]
    counts["fp"] = [int(not is_within) for is_within in within]
    for name, error in errors.items():
        counts[name] = [error if is_within else 0 for is_within in within]
    return counts, true_pair


def drawn_collision(drawn_paths: DrawnPaths, frame: int, gap: float) -> _Pair | None:
    """Return the two instances with the smallest distance at a frame, if it is below a gap.

    Of equal distances the one of the lowest ids counts.

    Args:
        drawn_paths: Rasterised instances.
        frame: Frame of the maps.
        gap: Cells.
    """
    ids = np.array([*drawn_paths.paths], dtype=np.int64)
    pairs, gaps = pair_gaps(drawn_paths.drawn[frame], ids, below=gap)
    if not len(gaps) or gaps.min() >= gap:
        return None
    first, second = pairs[gaps.argmin()].tolist()
    return first, second


def _drawn_accident(
    drawn_paths: DrawnPaths, points: int, gap: float, seconds: float
) -> Accident | None:
    """Return the collision at the last point as an accident; None without one."""
    paths = padded_paths(drawn_paths, points)
    last = points - 1
    pair = drawn_collision(paths, last, gap)
    if pair is None:
        return None
    positions = np.array([paths.paths[instance][last] for instance in pair])
    return Accident(positions=positions, time=seconds)


def _position_error(
    alarm: tuple[DrawnPaths, _Pair], true: tuple[DrawnPaths, _Pair], frame: int
) -> float:
    """Return the summed distances of the two predicted from the two true instances, metres.

    Of the two orders the one with the smaller sum counts.
    """
    positions = []
    for drawn_paths, pair in (alarm, true):
        positions.append(np.array([drawn_paths.paths[instance][frame] for instance in pair]))
    return position_difference(*positions)


def _united(counts: Collection[Counts]) -> Counts:
    """Return the tally of samples, among them `pooled` ones."""
    tallies = []
    for sample in counts:
        if "numbers" in sample:
            tallies.append(sample)
        else:
            tallies.append(sample_tally(sample, _by_distance(sample)))
    return united(tallies)


def _by_distance(counts: Counts) -> list[dict[str, Any]]:
    """Return the cases and errors of one sample for each distance."""
    by_distance = []
    cases = zip(counts["tp"], counts["fp"], counts["fn"], strict=True)
    for index, (tp, fp, fn) in enumerate(cases):
        entry: dict[str, Any] = {"tp": tp, "fp": fp, "fn": fn}
        for name in ACCIDENT_ERRORS:
            entry[name] = [counts[name][index]] if tp else []
        by_distance.append(entry)
    return by_distance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnPaths:
    """Paths and rasters of one prediction, or of the truth, over T frames.

    Attributes:
        paths: The first frame's instances by id, ascending: (n, 2) positions in metres, one for
            each frame that has the instance.
        drawn: (T, H, W) ids as they are rasterised, 0 elsewhere; in the orientation `released`,
            since outlines depend on their starting point.
    """

    paths: Paths
    drawn: AnyArray


def paths_of_heads(heads: MotionHeads, grid: BevGrid) -> tuple[DrawnPaths, AnyArray]:
    """Return the instances of the accident post-processing, and their ids at the present.

    The ids (H, W) are in the orientation of the heads.
    """
    linked = predict_instances(heads, "accident")
    drawn = linked.instance if linked.redrawn is None else linked.redrawn
    drawn = to_orientation(drawn, vectors=False, source=heads.orientation, target="released")
    # without the half-cell shift, as for instance maps: only differences count
    paths = trajectories(linked, grid, half_cell_shift=False)
    return DrawnPaths(paths=paths, drawn=drawn), linked.instance[0]


def paths_of_instances(instance: AnyArray, grid: BevGrid) -> DrawnPaths:
    """Return instances of maps with boxes rasterised along their paths, as the released code does.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere.
        grid: Cells and orientation of the maps.
    """
    paths = instance_paths(instance, grid)
    maps = to_orientation(instance, vectors=False, source=grid.orientation, target="released")
    return DrawnPaths(paths=paths, drawn=_redrawn(maps, np.array([*paths], dtype=np.int64)))


def _redrawn(instance: AnyArray, ids: IntArray) -> AnyArray:
    """Return maps (T, H, W) with the boxes of the first frame's instances `ids`, ascending."""
    frames, *shape = instance.shape
    frame, *position = np.nonzero(np.isin(instance, ids))
    id_index = np.searchsorted(ids, instance[frame, position[0], position[1]])
    cells = np.stack(position)
    is_first = frame == 0
    hulls = first_hulls(cells[:, is_first], id_index[is_first] + 1, len(ids))
    centers, exists = _centers(id_index * frames + frame, cells, (len(ids), frames))
    boxes, drawn = redrawn_cells(hulls, centers, exists, (shape[0], shape[1]))
    result = np.zeros_like(instance)
    for image, (row, column), rank in zip(result, boxes, drawn, strict=True):
        image[row, column] = ids[rank - 1]
    return result


def _centers(
    key: IntArray, position: IntArray, shape: tuple[int, int]
) -> tuple[FloatArray, BoolArray]:
    """Return mean rows and columns of cells by key, 0 where there are none, and whether any are.

    Args:
        key: (N,) instance · T + frame of each cell.
        position: (2, N) rows and columns of the cells.
        shape: I instances and T frames.

    Returns:
        Means, shape (I, T, 2), and a mask, shape (I, T).
    """
    length = shape[0] * shape[1]
    count = np.bincount(key, minlength=length)
    sums = np.stack([np.bincount(key, values, length) for values in position], axis=-1)
    means = sums / np.maximum(count, 1)[:, None]
    return means.reshape(*shape, 2), count.reshape(shape) > 0
