"""Accidents as the released code evaluates them, bugs included (protocol `released`).

The section "Accidents" of docs/released_code.md describes the rules. Other functions reproduce bugs
of the released code, too: `reference_arithmetic.contours` (boxes of at most 5 m × 2 m, rasterised
into the wrong frame after a gap, and only for the first frame's instances),
`outlines.first_outline` (only one part of an instance counts), `trajectories.padded` and
`match_trajectories`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.scoring import (
    ACCIDENT_ERRORS,
    DISTANCES,
    AccidentResult,
    ComparedAccidents,
    actor_of,
    add_tallies,
    classify_pair,
    sample_tally,
    tally_result,
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
    labels_at_present,
    num_recorded_frames,
)
from deepaccident_devkit.evaluation.truth import AccidentContext
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import to_orientation
from deepaccident_devkit.motion import MotionHeads, MotionLabels, predict_instances, trajectories
from deepaccident_devkit.motion.reference_arithmetic.contours import first_hulls, redrawn_cells
from deepaccident_devkit.motion.reference_arithmetic.outlines import pair_gaps
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_Pair = tuple[int, int]
# Errors that the released code reports if no true accident is foreseen: share, metres, seconds.
_ERRORS_WITHOUT_HIT = {"id": 1.0, "position": 20.0, "time": 1.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleasedAccidents:
    """The rules of the released code with all quirks; there are no options.

    - The truth is what the post-processing finds in the labels, even if instance maps are
      predicted.
    - Distances are measured between the boxes rasterised along the paths (`outlines.pair_gaps`).
    - Only the last frame counts, as the lists of accidents are emptied at each frame. So accidents
      have no time, and the time error is always 0.
    - An accident foreseen in the wrong place is a false positive, but the true accident does not
      count as missed.
    - If the first prediction has no instance at all, the others do not count: a true accident is
      missed, and there is no false alarm.
    - If there is no true accident, only an accident in the last prediction (the mean) is a false
      positive. A true accident may be foreseen by any prediction.
    - The errors are averaged over all three distances; the paper reports the errors within 10 m.
    """

    labels: ClassVar[str] = "released"
    """Name of the protocol that the labels must follow; others are rejected."""
    truth_gap: ClassVar[float] = 0.001
    """Distance in cells below which true instances collide; in effect they must overlap."""
    prediction_gap: ClassVar[float] = 5.0
    """Distance in cells below which predicted instances collide: 2.5 m. In the paper it is 1 m, for
    both true and predicted instances."""

    maps_alone: ClassVar[bool] = True
    """Whether the protocol only accepts maps, no explicit accidents."""

    def counts(
        self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext
    ) -> Counts:
        """Count one sample; see `accident_counts` for the counts.

        Raises:
            EvaluationError: If there is no label, or the prediction is not motion.
        """
        if not isinstance(prediction, MotionOutput) or label is None:
            raise EvaluationError(
                "the released protocol compares motion: give a MotionOutput and the sample's "
                "motion labels; explicit accidents are for protocol='paper' or 'boxes'"
            )
        frames = compared_frames(prediction, label, self.labels)
        label = labels_at_present(label)
        truth, present_ids = self.truth_paths(label, frames)
        point_count = longest(truth.paths) or len(truth.drawn)
        truth = padded_paths(truth, point_count)
        predictions = []
        matches = []
        for prediction_paths in self.prediction_paths(prediction, frames):
            padded_prediction = padded_paths(prediction_paths, point_count)
            predictions.append(padded_prediction)
            matches.append(match_trajectories(padded_prediction.paths, truth.paths).pairs)
        counts, pair = accident_counts(predictions, truth, matches)
        actors = None
        if pair is not None:
            actors = [actor_of(present_ids == instance, 0, label, context) for instance in pair]
        return counts | {"named": classify_pair(actors, context)}

    def compared(
        self,
        prediction: MotionOutput | list[Accident],
        label: MotionLabels | None,
        _context: AccidentContext,
    ) -> ComparedAccidents:
        """Find the accidents in a prediction and in the truth.

        Raises:
            EvaluationError: If there is no label, or the prediction is not motion.
        """
        if label is None or not isinstance(prediction, MotionOutput):
            raise EvaluationError(
                "the released protocol compares motion: give a MotionOutput and the motion labels"
            )
        frames = num_recorded_frames(label)
        truth, _ = self.truth_paths(labels_at_present(label), frames)
        point_count = longest(truth.paths) or len(truth.drawn)
        time = (point_count - 1) * (label.config.step * FRAME_PERIOD)
        predictions = self.prediction_paths(prediction, frames)
        if not predictions[0].paths:
            predictions = []
        true_accident = _drawn_accident(truth, point_count, self.truth_gap, time)
        predicted_accidents = []
        for paths in predictions:
            accident = _drawn_accident(paths, point_count, self.prediction_gap, time)
            if accident is not None:
                predicted_accidents.append(accident)
        return ComparedAccidents(true=true_accident, predicted=tuple(predicted_accidents))

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """Compute the metrics from the counts of samples, in any order."""
        result = tally_result(_sum_counts(counts), DISTANCES[0])
        mean_errors: NamedValues = {}
        for name in ACCIDENT_ERRORS:
            field = f"{name}_error"
            errors = []
            for within in result.within.values():
                error = getattr(within, field)
                errors.append(_ERRORS_WITHOUT_HIT[name] if error is None else error)
            mean_errors[field] = math.fsum(errors) / len(errors)
        return replace(result, **mean_errors)

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """Sum all counts, which leads to the same result."""
        return [_sum_counts(counts)]

    def truth_paths(self, label: MotionLabels, frames: int) -> tuple[DrawnPaths, AnyArray]:
        """Return the paths that predictions are compared with, and the id map at t = 0 (H, W)."""
        heads = first_frames(MotionHeads.from_labels(label), frames)
        return paths_of_heads(heads, label.config.grid)

    def prediction_paths(self, output: MotionOutput, frames: int) -> list[DrawnPaths]:
        """Return the paths of each of the K predictions, cut to the first `frames` frames."""
        if output.instances is not None:
            return [paths_of_instances(maps[:frames], output.grid) for maps in output.instances]
        predictions = []
        for heads in output.heads or ():
            paths, _ = paths_of_heads(first_frames(heads, frames), output.grid)
            predictions.append(paths)
        return predictions


def padded_paths(drawn_paths: DrawnPaths, length: int) -> DrawnPaths:
    """Extend the paths of a prediction to `length` points.

    The extension accelerates, as in the released code (`trajectories.padded`).
    """
    paths = padded(drawn_paths.paths, length)
    return replace(drawn_paths, paths=paths)


def accident_counts(
    predictions: Sequence[DrawnPaths], truth: DrawnPaths, matches: Sequence[Collection[_Pair]]
) -> tuple[NamedValues, _Pair | None]:
    """Count one sample from padded paths.

    Args:
        predictions: K predictions; the last is the mean.
        truth: True paths and rasters.
        matches: For each prediction, the pairs of a predicted id and the matched true id.

    Returns:
        The counts and the truly colliding pair (None if there is none). The counts are `positive`
        and, each a list by `DISTANCES`, `tp`, `fp`, `fn` and the summed errors `id`, `position` and
        `time`.
    """
    last_frame = (longest(truth.paths) or len(truth.drawn)) - 1
    true_pair = drawn_collision(truth, last_frame, ReleasedAccidents.truth_gap)
    names = ("tp", "fp", "fn", *ACCIDENT_ERRORS)
    counts: NamedValues = {name: [0] * len(DISTANCES) for name in names}
    counts["positive"] = true_pair is not None
    if not predictions[0].paths:
        counts["fn"] = [int(true_pair is not None)] * len(DISTANCES)
        return counts, true_pair
    gap = ReleasedAccidents.prediction_gap
    pairs = [drawn_collision(prediction, last_frame, gap) for prediction in predictions]
    if true_pair is None:
        counts["fp"] = [int(pairs[-1] is not None)] * len(DISTANCES)
        return counts, None
    true_positions = _positions(truth, true_pair, last_frame)
    nearest_match: tuple[float, _Pair, Collection[_Pair]] | None = None
    for prediction, pair, matched_ids in zip(predictions, pairs, matches, strict=True):
        if pair is None:
            continue
        positions = _positions(prediction, pair, last_frame)
        position_error = position_difference(positions, true_positions)
        if nearest_match is None or position_error < nearest_match[0]:
            nearest_match = position_error, pair, matched_ids
    if nearest_match is None:
        counts["fn"] = [1] * len(DISTANCES)
        return counts, true_pair
    position_error, pair, matched_ids = nearest_match
    # the prediction names the true actors if both of its paths match the paths of the true pair
    true_matches = {instance for instance, true in matched_ids if true in true_pair}
    id_error = int(not true_matches.issuperset(pair))
    errors = {"id": id_error, "position": position_error, "time": 0.0}
    is_within = [position_error <= distance for distance in DISTANCES]
    counts["tp"] = [int(is_hit) for is_hit in is_within]
    counts["fp"] = [int(not is_hit) for is_hit in is_within]
    for name, error in errors.items():
        counts[name] = [error if is_hit else 0 for is_hit in is_within]
    return counts, true_pair


def drawn_collision(drawn_paths: DrawnPaths, frame: int, gap: float) -> _Pair | None:
    """Return the two instances that are nearest to each other in a frame; None if too far apart.

    If pairs are equally near, the one with the lowest ids is returned.

    Args:
        drawn_paths: Rasterised instances.
        frame: Index of the frame.
        gap: Distance below which two instances collide, cells.
    """
    ids = np.array([*drawn_paths.paths], dtype=np.int64)
    pairs, gaps = pair_gaps(drawn_paths.drawn[frame], ids, below=gap)
    if not len(gaps) or gaps.min() >= gap:
        return None
    first, second = pairs[gaps.argmin()].tolist()
    return first, second


def _drawn_accident(
    drawn_paths: DrawnPaths, point_count: int, gap: float, time: float
) -> Accident | None:
    """Return the collision at the last point of the paths as an accident; None if there is none."""
    drawn_paths = padded_paths(drawn_paths, point_count)
    last_frame = point_count - 1
    pair = drawn_collision(drawn_paths, last_frame, gap)
    if pair is None:
        return None
    return Accident(positions=_positions(drawn_paths, pair, last_frame), time=time)


def _positions(drawn_paths: DrawnPaths, pair: _Pair, frame: int) -> FloatArray:
    """Return the positions of two instances in a frame, shape (2, 2), metres."""
    return np.array([drawn_paths.paths[instance][frame] for instance in pair])


def _sum_counts(counts: Collection[Counts]) -> Counts:
    """Sum the counts of samples, or sums that `pooled` returned."""
    tallies = []
    for sample in counts:
        if "numbers" in sample:
            tallies.append(sample)
        else:
            tallies.append(sample_tally(sample, _cases_by_distance(sample)))
    return add_tallies(tallies)


def _cases_by_distance(counts: Counts) -> list[NamedValues]:
    """Split the counts of one sample into cases and errors for each of `DISTANCES`."""
    cases_by_distance = []
    for index, tp in enumerate(counts["tp"]):
        cases: NamedValues = {"tp": tp, "fp": counts["fp"][index], "fn": counts["fn"][index]}
        for name in ACCIDENT_ERRORS:
            cases[name] = [counts[name][index]] if tp else []
        cases_by_distance.append(cases)
    return cases_by_distance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnPaths:
    """Paths and rasters of one prediction, or of the truth, over T frames.

    Attributes:
        paths: Id of each instance of the first frame, ascending → (n, 2) positions in metres, one
            for each frame that contains the instance.
        drawn: (T, H, W) ids of the rasterised instances, 0 elsewhere; in the orientation
            `released`, since outlines depend on their starting point.
    """

    paths: Paths
    drawn: AnyArray


def paths_of_heads(heads: MotionHeads, grid: BevGrid) -> tuple[DrawnPaths, AnyArray]:
    """Post-process heads for accidents; return the instances and the map of ids at t = 0.

    The map (H, W) has the orientation of the heads.
    """
    linked = predict_instances(heads, "accident")
    drawn_maps = linked.redrawn
    if drawn_maps is None:
        drawn_maps = linked.instance
    drawn_maps = to_orientation(
        drawn_maps, vectors=False, source=heads.orientation, target="released"
    )
    # without the half-cell shift, as for instance maps; only differences matter
    paths = trajectories(linked, grid, half_cell_shift=False)
    return DrawnPaths(paths=paths, drawn=drawn_maps), linked.instance[0]


def paths_of_instances(instance: AnyArray, grid: BevGrid) -> DrawnPaths:
    """Return the paths of instances in maps, with boxes rasterised along them as released.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere.
        grid: Cells and orientation of the maps.
    """
    paths = instance_paths(instance, grid)
    ids = np.array([*paths], dtype=np.int64)
    maps = to_orientation(instance, vectors=False, source=grid.orientation, target="released")
    return DrawnPaths(paths=paths, drawn=_redrawn_maps(maps, ids))


def _redrawn_maps(instance: AnyArray, ids: IntArray) -> AnyArray:
    """Rasterise the boxes of the first frame's instances into maps (T, H, W).

    Args:
        instance: (T, H, W) ids, 0 elsewhere.
        ids: (n,) ids of the first frame's instances, ascending.
    """
    frame_count, height, width = instance.shape
    frame, row, column = np.nonzero(np.isin(instance, ids))
    id_index = np.searchsorted(ids, instance[frame, row, column])
    cells = np.stack([row, column])
    is_first = frame == 0
    hulls = first_hulls(cells[:, is_first], id_index[is_first] + 1, len(ids))
    key = id_index * frame_count + frame
    centers, exists = _cell_centers(key, cells, (len(ids), frame_count))
    box_cells, ranks = redrawn_cells(hulls, centers, exists, (height, width))
    redrawn = np.zeros_like(instance)
    for image, (box_row, box_column), rank in zip(redrawn, box_cells, ranks, strict=True):
        image[box_row, box_column] = ids[rank - 1]
    return redrawn


def _cell_centers(
    key: IntArray, cells: IntArray, shape: tuple[int, int]
) -> tuple[FloatArray, BoolArray]:
    """Average the rows and columns of the cells of each instance and frame; 0 without cells.

    Args:
        key: (N,) instance · T + frame of each cell.
        cells: (2, N) rows and columns of the cells.
        shape: Numbers I of instances and T of frames.

    Returns:
        Means, shape (I, T, 2), and whether there are any cells, shape (I, T).
    """
    length = shape[0] * shape[1]
    cell_counts = np.bincount(key, minlength=length)
    sums = np.stack([np.bincount(key, values, length) for values in cells], axis=-1)
    means = sums / np.maximum(cell_counts, 1)[:, None]
    return means.reshape(*shape, 2), cell_counts.reshape(shape) > 0
