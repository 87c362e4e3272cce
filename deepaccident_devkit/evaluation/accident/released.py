"""Accidents as the released code evaluates them, bugs included (protocol `released`; docs/released_code.md, Accidents).

Bugs of other functions: `exact.contours` (boxes of 5 m × 2 m at most, rasterised into the wrong frame
after a gap, and of the first frame's instances alone), `outlines.first_outline` (of an instance in several parts, one
counts), `trajectories.padded` and `match_trajectories`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.scoring import (
    DISTANCES,
    ERRORS,
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
_NOTHING_FOUND: Final = {"id": 1.0, "position": 20.0, "time": 1.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleasedAccidents:
    """The released rules with all quirks, without a choice.

    - Truth is what the post-processing finds in the labels, also where instance maps are predicted.
    - Distances are those of the boxes rasterised along the paths (`outlines.pair_gaps`).
    - Only the last frame counts, as the lists of accidents begin empty at each. So accidents have no time, and its
      error is always 0.
    - An accident foreseen elsewhere is a false positive and does not leave the true one missed.
    - Where the first prediction has no instance at all, the others do not count: a true accident is missed, and nothing
      is a false alarm.
    - Where there is no accident, only one foreseen by the last prediction (the mean) is a false positive. A true
      accident may be foreseen by any.
    - The errors are means of those at all three distances; the paper has those within 10 m.
    """

    labels: ClassVar[str] = "released"
    """Protocol of the labels that are the truth; others are refused."""
    truth_gap: ClassVar[float] = 0.001
    """Cells; the true instances that are nearer collide: they must overlap."""
    prediction_gap: ClassVar[float] = 5.0
    """Cells; the predicted instances that are nearer collide: 2.5 m. The paper has 1 m for both."""

    maps_alone: ClassVar[bool] = True
    """It compares no explicit accidents."""

    def counts(
        self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext
    ) -> Counts:
        """What one sample adds.

        Raises:
            EvaluationError: there is no label, or the prediction is no motion.
        """
        if not isinstance(prediction, MotionOutput) or label is None:
            raise EvaluationError(
                "the released protocol compares motion: give a MotionOutput and the sample's motion labels; "
                "explicit accidents are for protocol='paper' or 'boxes'"
            )
        frames = compared_frames(prediction, label, self.labels)
        label = labels_at_present(label)
        truth, present = self.truth_paths(label, frames)
        points = longest(truth.paths) or len(truth.drawn)
        truth, *predictions = (
            padded_paths(each, points)
            for each in (truth, *self.prediction_paths(prediction, frames))
        )
        matches = [match_trajectories(each.paths, truth.paths).pairs for each in predictions]
        counts, pair = accident_counts(predictions, truth, matches)
        actors = (
            None
            if pair is None
            else [actor_of(present == name, 0, label, context) for name in pair]
        )
        return counts | {"named": named(actors, context)}

    def compared(
        self,
        given: MotionOutput | list[Accident],
        label: MotionLabels | None,
        _context: AccidentContext,
    ) -> ComparedAccidents:
        """Which accidents it sees; raises EvaluationError."""
        if label is None or not isinstance(given, MotionOutput):
            raise EvaluationError(
                "the released protocol compares motion: give a MotionOutput and the motion labels"
            )
        frames = frames_there(label)
        truth, _ = self.truth_paths(labels_at_present(label), frames)
        points = longest(truth.paths) or len(truth.drawn)
        last = points - 1

        def found(paths: DrawnPaths, gap: float) -> list[Accident]:
            padded = padded_paths(paths, points)
            pair = collision(padded, last, gap)
            if pair is None:
                return []
            positions = np.array([padded.paths[name][last] for name in pair])
            return [Accident(positions=positions, time=last * (label.config.step * FRAME_PERIOD))]

        predictions = self.prediction_paths(given, frames)
        if not predictions[0].paths:
            predictions = []
        return ComparedAccidents(
            true=next(iter(found(truth, self.truth_gap)), None),
            predicted=tuple(
                alarm for each in predictions for alarm in found(each, self.prediction_gap)
            ),
        )

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order."""
        made = tally_result(_united(counts), DISTANCES[0])
        errors: dict[str, Any] = {
            f"{name}_error": self._error(
                [getattr(each, f"{name}_error") for each in made.within.values()], name
            )
            for name in ERRORS
        }
        return replace(made, **errors)

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """The sum of all counts, which has the same result."""
        return [_united(counts)]

    def truth_paths(self, label: MotionLabels, frames: int) -> tuple[DrawnPaths, AnyArray]:
        """What predictions are compared with, and (H, W) its ids at the present."""
        return paths_of_heads(
            first_frames(MotionHeads.from_labels(label), frames), label.config.grid
        )

    def prediction_paths(self, output: MotionOutput, frames: int) -> list[DrawnPaths]:
        """What is compared of each of the K predictions, cut to so many frames."""
        if output.instances is not None:
            return [paths_of_instances(maps[:frames], output.grid) for maps in output.instances]
        cut = [first_frames(heads, frames) for heads in output.heads or ()]
        return [paths_of_heads(heads, output.grid)[0] for heads in cut]

    def _error(self, errors: Sequence[float | None], name: str) -> float:
        """An error over all distances from those at each; where none is foreseen it is that of `_NOTHING_FOUND`."""
        filled = [_NOTHING_FOUND[name] if error is None else error for error in errors]
        return math.fsum(filled) / len(filled)


def padded_paths(given: DrawnPaths, length: int) -> DrawnPaths:
    """The same with paths of so many points; those that end early go on faster and faster (`trajectories.padded`)."""
    return replace(given, paths=padded(given.paths, length))


def accident_counts(
    predictions: Sequence[DrawnPaths], truth: DrawnPaths, matches: Sequence[Collection[_Pair]]
) -> tuple[dict[str, Any], _Pair | None]:
    """What one sample adds, of paths that are padded.

    Args:
        predictions: K of them, the mean last.
        truth: what is true.
        matches: of each prediction: its ids and the matched true ids.

    Returns:
        The counts: `tp`, `fp`, `fn` and the sums of the errors (`id`, `position`, `time`), each a list by `DISTANCES`,
        and `positive`; and the pair that collides in truth.
    """
    last = (longest(truth.paths) or len(truth.drawn)) - 1
    true = collision(truth, last, ReleasedAccidents.truth_gap)
    counts: dict[str, Any] = {name: [0] * len(DISTANCES) for name in ("tp", "fp", "fn", *ERRORS)}
    counts["positive"] = true is not None
    if not predictions[0].paths:
        counts["fn"] = [int(true is not None)] * len(DISTANCES)
        return counts, true
    found = [collision(each, last, ReleasedAccidents.prediction_gap) for each in predictions]
    if true is None:
        counts["fp"] = [int(found[-1] is not None)] * len(DISTANCES)
        return counts, None
    foreseen = [
        (_apart((each, one), (truth, true), last), one, same)
        for each, one, same in zip(predictions, found, matches, strict=True)
        if one is not None
    ]
    if not foreseen:
        counts["fn"] = [1] * len(DISTANCES)
        return counts, true
    position, best, same = min(foreseen, key=lambda each: each[0])
    named_so = all(
        any((name, other) in same for other in true) for name in best
    )  # by the matches of their paths
    errors = {"id": int(not named_so), "position": position, "time": 0.0}
    within = [position <= distance for distance in DISTANCES]
    counts |= {"tp": [int(each) for each in within], "fp": [int(not each) for each in within]}
    counts |= {name: [error if each else 0 for each in within] for name, error in errors.items()}
    return counts, true


def collision(given: DrawnPaths, frame: int, gap: float) -> _Pair | None:
    """The two instances of the smallest distance below `gap` cells at a frame; of equal ones the first ids."""
    pairs, gaps = pair_gaps(given.drawn[frame], np.array([*given.paths], dtype=np.int64), below=gap)
    if not len(gaps) or gaps.min() >= gap:
        return None
    first, second = pairs[gaps.argmin()].tolist()
    return first, second


def _apart(alarm: tuple[DrawnPaths, _Pair], true: tuple[DrawnPaths, _Pair], frame: int) -> float:
    """Metres: the sum of the distances of the predicted from the true two, in the order with the smaller sum."""
    here, there = (
        np.array([each.paths[name][frame] for name in pair]) for each, pair in (alarm, true)
    )
    return position_difference(here, there)


def _united(counts: Collection[Counts]) -> Counts:
    """The tally of samples, those of `pooled` among them."""
    return united(
        each if "numbers" in each else sample_tally(each, _by_distance(each)) for each in counts
    )


def _by_distance(counts: Counts) -> list[dict[str, Any]]:
    return [
        {"tp": tp, "fp": fp, "fn": fn}
        | {name: [counts[name][index]] if tp else [] for name in ERRORS}
        for index, (tp, fp, fn) in enumerate(
            zip(counts["tp"], counts["fp"], counts["fn"], strict=True)
        )
    ]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnPaths:
    """One prediction, or the truth, over T frames.

    Attributes:
        paths: by id, ascending, the first frame's instances: (n, 2) positions in metres, one for each frame that the
            instance is in.
        drawn: (T, H, W) the ids as they are rasterised, 0 elsewhere; in the orientation `released`, since outlines
            depend on where they begin.
    """

    paths: Paths
    drawn: AnyArray


def paths_of_heads(heads: MotionHeads, grid: BevGrid) -> tuple[DrawnPaths, AnyArray]:
    """Instances found by the accident post-processing, and (H, W) their ids at the present, as the heads lie."""
    linked = predict_instances(heads, "accident")
    drawn = linked.instance if linked.redrawn is None else linked.redrawn
    drawn = to_orientation(drawn, vectors=False, source=heads.orientation, target="released")
    paths = trajectories(
        linked, grid, half_cell_shift=False
    )  # as instance maps' are: only differences count
    return DrawnPaths(paths=paths, drawn=drawn), linked.instance[0]


def paths_of_instances(instance: AnyArray, grid: BevGrid) -> DrawnPaths:
    """Instances given as maps; boxes are rasterised along their paths, as the released post-processing does.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere.
        grid: its cells and orientation.
    """
    paths = instance_paths(instance, grid)
    lying = to_orientation(instance, vectors=False, source=grid.orientation, target="released")
    return DrawnPaths(paths=paths, drawn=_redrawn(lying, np.array([*paths], dtype=np.int64)))


def _redrawn(instance: AnyArray, ids: IntArray) -> AnyArray:
    """(T, H, W) the boxes of the first frame's instances `ids`, ascending."""
    frames, *shape = instance.shape
    frame, *position = np.nonzero(np.isin(instance, ids))
    which = np.searchsorted(ids, instance[frame, position[0], position[1]])
    first = frame == 0
    hulls = first_hulls(np.stack(position)[:, first], which[first] + 1, len(ids))
    centers, exists = _centers(which * frames + frame, np.stack(position), (len(ids), frames))
    cells, drawn = redrawn_cells(hulls, centers, exists, (shape[0], shape[1]))
    result = np.zeros_like(instance)
    for image, (row, column), rank in zip(result, cells, drawn, strict=True):
        image[row, column] = ids[rank - 1]
    return result


def _centers(
    key: IntArray, position: IntArray, shape: tuple[int, int]
) -> tuple[FloatArray, BoolArray]:
    """(I, T, 2) mean rows and columns of cells by key, 0 where there are none, and (I, T) where there are some."""
    length = shape[0] * shape[1]
    count = np.bincount(key, minlength=length)
    sums = np.stack([np.bincount(key, along, length) for along in position], axis=-1)
    return (sums / np.maximum(count, 1)[:, None]).reshape(*shape, 2), count.reshape(shape) > 0
