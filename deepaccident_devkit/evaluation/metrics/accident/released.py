"""Accidents as the released code evaluates them, bugs included (protocol `released`; docs/released_code.md, Accidents).

Each bug is a field of `ReleasedAccidents` that can be corrected, or lies in the functions that have it:
`motion.postprocessing.redrawing` (boxes of 5 m × 2 m at most, rasterised into the wrong frame after a gap, and of the
first frame's instances alone), `outlines.first_outline` (of an instance in several parts, one counts),
`trajectories.padded` and `match_trajectories`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.metrics.accident.outlines import pair_gaps
from deepaccident_devkit.evaluation.metrics.accident.scoring import (
    DISTANCES,
    ERRORS,
    AccidentResult,
    actor_of,
    named,
    sample_tally,
    tally_result,
    united,
)
from deepaccident_devkit.evaluation.metrics.alarms.raised import position_difference
from deepaccident_devkit.evaluation.metrics.alarms.truth import AccidentContext
from deepaccident_devkit.evaluation.metrics.evaluator import Counts
from deepaccident_devkit.evaluation.metrics.predictions import (
    MotionOutput,
    Prediction,
    check_output,
    check_protocol,
    first_frames,
    frames_there,
    labels_at_present,
)
from deepaccident_devkit.evaluation.metrics.trajectories import (
    Paths,
    instance_paths,
    longest,
    match_trajectories,
    padded,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import (
    POST_PROCESSING,
    MotionHeads,
    MotionLabels,
    PostProcessing,
    predict_instances,
    trajectories,
)
from deepaccident_devkit.motion.orientations import to_orientation
from deepaccident_devkit.motion.postprocessing.contours import first_hulls, redrawn_cells
from deepaccident_devkit.taxonomy import FRAME_PERIOD

Pair = tuple[int, int]
_NOTHING_FOUND: Final = {"id": 1.0, "position": 20.0, "time": 1.0}
"""The released code's errors where nothing is foreseen: a share, metres, seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleasedAccidents:
    """The released rules; the defaults keep all quirks.

    Attributes:
        truth_gap: cells; the true instances that are nearer collide. With 0.001 they must overlap.
        prediction_gap: cells; the predicted instances that are nearer collide: 2.5 m. The paper has 1 m for both.
        level: where the outlines run, see `outlines.LEVEL`: 0.1 makes instances almost a cell larger all around.
        truth_through_heads: truth is what the post-processing finds in the labels; else the labels' own instances.
        redraw: distances are those of the boxes rasterised along the paths; else of the instances themselves.
        last_frame_only: only the last frame counts, as the lists of accidents begin empty at each. So accidents
            have no time, and its error is always 0. Else the frame with the smallest distance counts, and truth and
            prediction have each its own.
        far_is_missed: an accident foreseen elsewhere also leaves the true one missed. The released code counts it once.
        empty_first_ends: where the first prediction has no instance at all, the others do not count: a true accident
            is missed, and nothing is a false alarm.
        mean_alone_alarms: where there is no accident, only one foreseen by the last prediction (the mean) is a false
            positive; else one by any. (A true accident may be foreseen by any.)
        errors_at: metres: the distance whose true positives the errors are means over; None for the mean of the errors
            at all three. The paper says 10.
    """

    labels: ClassVar[str] = "released"
    """Protocol of the labels that are the truth; others are refused."""
    truth_gap: float = 0.001
    prediction_gap: float = 5.0
    level: float = 0.1
    truth_through_heads: bool = True
    redraw: bool = True
    last_frame_only: bool = True
    far_is_missed: bool = False
    empty_first_ends: bool = True
    mean_alone_alarms: bool = True
    errors_at: float | None = None

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        for name, least, most in (("truth_gap", 0, math.inf), ("prediction_gap", 0, math.inf), ("level", 0, 1)):
            if not least < getattr(self, name) < most:
                raise ConfigError(
                    f"{name}: expected a number between {least} and {most}, found {getattr(self, name)!r}"
                )
        if self.errors_at is not None and self.errors_at not in DISTANCES:
            raise ConfigError(f"errors_at: expected one of {', '.join(map(str, DISTANCES))}, found {self.errors_at!r}")

    def counts(self, prediction: Prediction, label: MotionLabels | None, context: AccidentContext) -> Counts:
        """What one sample adds.

        Raises:
            EvaluationError: there is no label, or the prediction is no motion.
        """
        if not isinstance(prediction, MotionOutput) or label is None:
            raise EvaluationError(
                "the released protocol compares motion: give a MotionOutput and the sample's motion labels; "
                "explicit accidents are for protocol='paper' or 'boxes'"
            )
        check_protocol(label, self.labels)
        frames = frames_there(label)
        check_output(prediction, label, frames)
        label = labels_at_present(label)
        truth, present = self.truth_paths(label, frames)
        points = longest(truth.paths) or len(truth.drawn)
        truth, *predictions = (
            padded_paths(each, points) for each in (truth, *self.prediction_paths(prediction, frames))
        )
        matches = [match_trajectories(each.paths, truth.paths).pairs for each in predictions]
        step = label.config.step * FRAME_PERIOD
        counts, pair = accident_counts(predictions, truth, matches, self, step)
        actors = None if pair is None else [actor_of(present == name, 0, label, context) for name in pair]
        return counts | {"named": named(actors, context)}

    def result(self, counts: Collection[Counts]) -> AccidentResult:
        """The metrics of some samples' counts, in any order."""
        made = tally_result(_united(counts), DISTANCES[0])
        errors: dict[str, Any] = {
            f"{name}_error": self._error([getattr(each, f"{name}_error") for each in made.within.values()], name)
            for name in ERRORS
        }
        return replace(made, **errors)

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """The sum of all counts, which has the same result."""
        return [_united(counts)]

    @property
    def post_processing(self) -> PostProcessing:
        """How instances are read off heads."""
        return replace(POST_PROCESSING["accident"], redraw=self.redraw)

    def truth_paths(self, label: MotionLabels, frames: int) -> tuple[DrawnPaths, AnyArray]:
        """What predictions are compared with, and (H, W) its ids at the present."""
        grid = label.config.grid
        if self.truth_through_heads:
            return paths_of_heads(first_frames(MotionHeads.from_labels(label), frames), grid, self.post_processing)
        return paths_of_instances(label.instance[:frames], grid, redraw=self.redraw), label.instance[0]

    def prediction_paths(self, output: MotionOutput, frames: int) -> list[DrawnPaths]:
        """What is compared of each of the K predictions, cut to so many frames."""
        if output.instances is not None:
            return [paths_of_instances(maps[:frames], output.grid, redraw=self.redraw) for maps in output.instances]
        cut = [first_frames(heads, frames) for heads in output.heads or ()]
        return [paths_of_heads(heads, output.grid, self.post_processing)[0] for heads in cut]

    def _error(self, errors: Sequence[float | None], name: str) -> float:
        """An error over all distances from those at each; where none is foreseen it is that of `_NOTHING_FOUND`."""
        if self.errors_at is not None:
            errors = [errors[DISTANCES.index(self.errors_at)]]
        filled = [_NOTHING_FOUND[name] if error is None else error for error in errors]
        return math.fsum(filled) / len(filled)


@dataclass(frozen=True, slots=True, kw_only=True)
class Collision:
    """Two instances that collide, and at which frame."""

    pair: Pair
    frame: int


def padded_paths(given: DrawnPaths, length: int) -> DrawnPaths:
    """The same with paths of so many points; those that end early go on faster and faster (`trajectories.padded`)."""
    return replace(given, paths=padded(given.paths, length))


def accident_counts(
    predictions: Sequence[DrawnPaths],
    truth: DrawnPaths,
    matches: Sequence[Collection[Pair]],
    rules: ReleasedAccidents,
    step: float,
) -> tuple[dict[str, Any], Pair | None]:
    """What one sample adds, of paths that are padded.

    Args:
        predictions: K of them, the mean last.
        truth: what is true.
        matches: of each prediction: its ids and the matched true ids.
        rules: the rules.
        step: seconds from one frame to the next.

    Returns:
        The counts: `tp`, `fp`, `fn` and the sums of the errors (`id`, `position`, `time`), each a list by `DISTANCES`,
        and `positive`; and the pair that collides in truth.
    """
    last = (longest(truth.paths) or len(truth.drawn)) - 1
    frames = [last] if rules.last_frame_only else [*range(last + 1)]
    true = collision(truth, frames, rules.truth_gap, rules.level)
    counts: dict[str, Any] = {name: [0] * len(DISTANCES) for name in ("tp", "fp", "fn", *ERRORS)}
    counts["positive"] = true is not None
    if not predictions[0].paths and rules.empty_first_ends:
        counts["fn"] = [int(true is not None)] * len(DISTANCES)
        return counts, None if true is None else true.pair
    found = [collision(each, frames, rules.prediction_gap, rules.level) for each in predictions]
    if true is None:
        alarms = found[-1:] if rules.mean_alone_alarms else found
        counts["fp"] = [int(any(alarm is not None for alarm in alarms))] * len(DISTANCES)
        return counts, None
    foreseen = [
        (_apart(each, one, truth, true), one, same)
        for each, one, same in zip(predictions, found, matches, strict=True)
        if one is not None
    ]
    if not foreseen:
        counts["fn"] = [1] * len(DISTANCES)
        return counts, true.pair
    position, best, same = min(foreseen, key=lambda each: each[0])
    errors = {"id": _others_named(best, true, same), "position": position, "time": abs(best.frame - true.frame) * step}
    for index, distance in enumerate(DISTANCES):
        within = position <= distance
        counts["tp" if within else "fp"][index] = 1
        counts["fn"][index] = int(not within and rules.far_is_missed)
        for name, error in errors.items():
            counts[name][index] = error if within else 0
    return counts, true.pair


def collision(given: DrawnPaths, frames: Sequence[int], gap: float, level: float) -> Collision | None:
    """The two instances of the smallest distance below `gap` cells; of equal ones the earliest, then the first ids."""
    ids = np.array([*given.paths], dtype=np.int64)
    nearest, result = gap, None
    for frame in frames:
        pairs, gaps = pair_gaps(given.drawn[frame], ids, level=level, below=nearest)
        best = gaps.argmin() if len(gaps) else -1
        if best >= 0 and gaps[best] < nearest:
            nearest = gaps.item(best)
            first, second = pairs[best].tolist()
            result = Collision(pair=(first, second), frame=frame)
    return result


def _apart(predicted: DrawnPaths, alarm: Collision, truth: DrawnPaths, true: Collision) -> float:
    """Metres: the sum of the distances of the predicted from the true two, in the order with the smaller sum."""
    here, there = (
        np.array([each.paths[name][one.frame] for name in one.pair])
        for each, one in ((predicted, alarm), (truth, true))
    )
    return position_difference(here, there)


def _others_named(alarm: Collision, true: Collision, same: Collection[Pair]) -> int:
    """0 if the two predicted ones are the true ones, by the matches of their paths; else 1."""
    return int(not all(any((name, other) in same for other in true.pair) for name in alarm.pair))


def _united(counts: Collection[Counts]) -> Counts:
    """The tally of samples, those of `pooled` among them."""
    return united(each if "numbers" in each else sample_tally(each, _by_distance(each)) for each in counts)


def _by_distance(counts: Counts) -> list[dict[str, Any]]:
    return [
        {"tp": tp, "fp": fp, "fn": fn} | {name: [counts[name][index]] if tp else [] for name in ERRORS}
        for index, (tp, fp, fn) in enumerate(zip(counts["tp"], counts["fp"], counts["fn"], strict=True))
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


def paths_of_heads(heads: MotionHeads, grid: BevGrid, settings: PostProcessing) -> tuple[DrawnPaths, AnyArray]:
    """Instances found by the accident post-processing, and (H, W) their ids at the present, as the heads lie."""
    linked = predict_instances(heads, settings)
    drawn = linked.instance if linked.redrawn is None else linked.redrawn
    drawn = to_orientation(drawn, vectors=False, source=heads.orientation, target="released")
    paths = trajectories(linked, grid, half_cell_shift=False)  # as instance maps' are: only differences count
    return DrawnPaths(paths=paths, drawn=drawn), linked.instance[0]


def paths_of_instances(instance: AnyArray, grid: BevGrid, *, redraw: bool) -> DrawnPaths:
    """Instances given as maps.

    Args:
        instance: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere.
        grid: its cells and orientation.
        redraw: rasterise boxes along the paths, as the released post-processing does; else keep the instances.
    """
    paths = instance_paths(instance, grid)
    lying = to_orientation(instance, vectors=False, source=grid.orientation, target="released")
    return DrawnPaths(paths=paths, drawn=_redrawn(lying, np.array([*paths], dtype=np.int64)) if redraw else lying)


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


def _centers(key: IntArray, position: IntArray, shape: tuple[int, int]) -> tuple[FloatArray, BoolArray]:
    """(I, T, 2) mean rows and columns of cells by key, 0 where there are none, and (I, T) where there are some."""
    length = shape[0] * shape[1]
    count = np.bincount(key, minlength=length)
    sums = np.stack([np.bincount(key, along, length) for along in position], axis=-1)
    centers = sums / np.maximum(count, 1)[:, None]
    return centers.reshape(*shape, 2), count.reshape(shape) > 0
