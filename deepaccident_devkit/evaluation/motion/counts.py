"""What one sample adds to the motion metrics: `motion_counts`."""

from __future__ import annotations

from dataclasses import asdict

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.frames import (
    check_output,
    check_protocol,
    checked_pair,
    first_frames,
    frames_there,
    labels_at_present,
)
from deepaccident_devkit.evaluation.instance_paths import instance_paths
from deepaccident_devkit.evaluation.motion.protocol import MotionProtocol
from deepaccident_devkit.evaluation.panoptic import vpq_counts
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.ranges import cells_within
from deepaccident_devkit.evaluation.segmentation import mask_counts
from deepaccident_devkit.evaluation.trajectory_errors import trajectory_errors
from deepaccident_devkit.evaluation.trajectory_matching import longest, match_trajectories, padded
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionHeads, MotionLabels, PostProcessing, predict_instances, trajectories


def motion_counts(
    prediction: MotionOutput,
    label: MotionLabels,
    protocol: MotionProtocol | None = None,
    *,
    trajectories: bool = True,
) -> Counts:
    """What one sample adds, as JSON can hold it; arguments and errors as of `MotionEvaluator.update`.

    Returns:
        `samples`, 1; `frames` compared; `instance_maps`, 1 if the prediction was given so, else 0; by range, `cells`
        [tp, fp, fn] and `vpq`, four lists by frame: the sum of the intersections over unions, and the numbers of true
        positives, false positives and false negatives; `paths`, sums by name, or None.
    """
    rules = protocol or MotionProtocol()
    prediction, label = checked_pair(prediction, label)
    check_protocol(label, rules.labels)
    frames = frames_there(label)
    check_output(prediction, label, frames)
    truth, grid = labels_at_present(label), label.config.grid
    last = _last_maps(prediction, frames, rules.instances)
    actors, instance = (prediction.grid.reorient(maps, grid.orientation) for maps in last)
    true_actors, true_instance = truth.segmentation[:frames] == 1, truth.instance[:frames]
    cells, vpq = [], []
    for extent in rules.ranges:
        within = (slice(None), *cells_within(grid, extent))
        counted = mask_counts(actors[within], true_actors[within])
        cells.append([counted.true_positive, counted.false_positive, counted.false_negative])
        quality = vpq_counts(instance[within], true_instance[within], rules.vpq)
        by_name = (quality.iou, quality.true_positive, quality.false_positive, quality.false_negative)
        vpq.append([values[:, 1].tolist() for values in by_name])
    return {
        "samples": 1,
        "frames": frames,
        "instance_maps": int(prediction.instances is not None),
        "cells": cells,
        "vpq": vpq,
        "paths": _path_counts(prediction, truth, frames, rules) if trajectories else None,
    }


def _last_maps(prediction: MotionOutput, frames: int, settings: PostProcessing) -> tuple[AnyArray, AnyArray]:
    """(T, H, W) which cells are actors, and instances, of the last prediction, as it lies."""
    if prediction.instances is not None:
        instances = prediction.instances[-1, :frames]
        return instances > 0, instances
    heads = first_frames((prediction.heads or ())[-1], frames)
    return heads.segmentation[:, 1] > heads.segmentation[:, 0], predict_instances(heads, settings).instance


def _path_counts(prediction: MotionOutput, truth: MotionLabels, frames: int, rules: MotionProtocol) -> dict[str, float]:
    grid = truth.config.grid
    if prediction.instances is not None:
        maps = [*((each, prediction.grid) for each in prediction.instances), (truth.instance, grid)]
        *predicted, true = (instance_paths(each[:frames], cells) for each, cells in maps)
    else:
        heads = (*(prediction.heads or ()), MotionHeads.from_labels(truth))
        *predicted, true = (_paths_of(first_frames(each, frames), grid, rules.paths) for each in heads)
    length = longest(true)
    *sides, true = (padded(each, length, accelerating=rules.accelerating_paths) for each in (*predicted, true))
    matches = [match_trajectories(paths, true, gate=rules.gate) for paths in sides]
    errors = trajectory_errors(sides, true, matches, rules.trajectories)
    last = matches[-1]
    return asdict(errors) | {
        "true_positive": len(last.pairs),
        "false_positive": len(last.unmatched_prediction),
        "false_negative": len(last.unmatched_truth),
    }


def _paths_of(heads: MotionHeads, grid: BevGrid, settings: PostProcessing) -> dict[int, FloatArray]:
    return trajectories(predict_instances(heads, settings), grid, half_cell_shift=False)
