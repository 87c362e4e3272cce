"""Facts that show without a suspicion: empty predictions, ids that are not linked, equal scores, lost paths."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import pairwise
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.frames import frames_there, labels_at_present
from deepaccident_devkit.evaluation.metrics.headlines import headlines
from deepaccident_devkit.evaluation.metrics.motion import MotionResult
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput
from deepaccident_devkit.evaluation.runs.sanity.classes import class_names
from deepaccident_devkit.evaluation.runs.sanity.foregrounds import NOT_COUNTED, foreground_counts
from deepaccident_devkit.evaluation.runs.sanity.motion import actor_cells
from deepaccident_devkit.motion import MotionLabels, PostProcessing

_FEWEST_KEPT: Final = 0.2
"""Share of ids that stay from frame to frame below which nobody has linked them."""
_RANKED: Final = {"mAP", "average_precision"}
"""Headlines that are of the order of scores."""
_PAIRS: Final = 10
"""Instances found in two frames on end that say something of it."""
_PATHS: Final = 10
"""True paths that say something of how many have a match."""
_HIGH_IOU: Final = 0.4
"""Share of the truth's IoU from which on predictions show where the actors are."""
_FEW_PATHS: Final = 0.5
"""Of that share, the part that the paths with a match have to be."""


def facts_of(prediction: Any, truth: Any, settings: PostProcessing | None = None) -> dict[str, Any]:
    """What shows without a suspicion: whether nothing is predicted, which ids stay, scores, and names of classes.

    Args:
        prediction: of a sample, as its evaluator takes it.
        truth: likewise.
        settings: how the protocol reads accidents or paths off heads (`foregrounds.post_processing_of`).
    """
    if isinstance(prediction, MotionOutput):
        frames = frames_there(truth)
        return {
            "empty": is_empty(prediction, frames),
            "ids": ids_kept(prediction, truth),
            "scores": [],
            "foreground": foreground_counts(prediction, frames, settings),
        }
    boxes = isinstance(prediction, DetectedBoxes)
    scores = prediction.scores.tolist() if boxes else [each.score for each in prediction]
    classes = {"classes": class_names(prediction, truth).tolist()} if boxes else {}
    return {"empty": not scores, "ids": [0, 0], "scores": scores, "foreground": [*NOT_COUNTED], **classes}


def is_ranked(task: str, result: object) -> bool:
    """Whether some number of a result is of the order of scores."""
    return task == "warning" or bool(_RANKED & {each.name for each in headlines(task, result)})


def all_empty(facts: Collection[Mapping[str, Any]]) -> bool:
    """Whether nothing is predicted in any sample."""
    return all(each["empty"] for each in facts)


def plain_warnings(facts: Collection[Mapping[str, Any]], *, ranked: bool) -> list[str]:
    """Sentences on what shows in the facts of some samples.

    Args:
        facts: of each sample, as `facts_of` gives them.
        ranked: whether the order of scores counts.
    """
    warnings = []
    if all_empty(facts):
        warnings.append(f"all {len(facts)} predictions looked at are empty: nothing is predicted in them")
    kept, pairs = (sum(each["ids"][index] for each in facts) for index in (0, 1))
    if pairs >= _PAIRS and kept < _FEWEST_KEPT * pairs:
        warnings.append(
            f"ids are not linked over time: {kept} of {pairs} instances that are found in two frames in a row keep "
            "their id. VPQ counts the others as missed: give an instance the same id in all frames"
        )
    scores = [score for each in facts for score in each["scores"]]
    if ranked and len(scores) > 1 and len(set(scores)) == 1:
        warnings.append(
            f"all {len(scores)} scores are {scores[0]:g}: numbers that depend on the order of scores, such as an "
            "average precision, then say little; give surer predictions higher scores"
        )
    return warnings


def path_warnings(given: object, perfect: object) -> list[str]:
    """A sentence if a motion prediction shows where the actors are, but few of their paths have a match.

    Args:
        given: the result of the predictions.
        perfect: that of the truth itself.
    """
    if not isinstance(given, MotionResult) or not isinstance(perfect, MotionResult) or perfect.paths < _PATHS:
        return []
    overlaps = [list(each.ranges.values())[-1].iou for each in (given, perfect)]
    share = overlaps[0] / overlaps[1] if overlaps[1] > 0 else 0.0
    if not share >= _HIGH_IOU or given.paths >= _FEW_PATHS * share * perfect.paths:
        return []
    every = perfect.path_true_positive + perfect.path_false_negative
    warning = (
        f"only {given.paths} of {every} true paths have a match ({perfect.paths} if the truth is predicted): minADE, "
        "minFDE and the miss rate are of these alone"
    )
    return [warning]


def ids_kept(prediction: MotionOutput, label: MotionLabels) -> list[int]:
    """How often a true instance that is found in two frames on end keeps its id, and how often there is one.

    Found is an instance most of whose cells have one predicted id. Of heads, whose ids the devkit links itself: none.
    """
    if prediction.instances is None:
        return [0, 0]
    frames = frames_there(label)
    grid, truth = label.config.grid, labels_at_present(label)
    predicted = prediction.grid.reorient(prediction.instances[-1, :frames], grid.orientation)
    names = [_names(found, true) for found, true in zip(predicted, truth.instance[:frames], strict=True)]
    pairs = [before[one] == after[one] for before, after in pairwise(names) for one in before.keys() & after.keys()]
    return [sum(pairs), len(pairs)]


def is_empty(prediction: MotionOutput, frames: int) -> bool:
    """Whether the last prediction is empty."""
    return not actor_cells(prediction, frames).any()


def _names(found: AnyArray, true: AnyArray) -> dict[int, int]:
    """True id → the predicted id that most of its cells have."""
    both = true > 0
    keys, counts = np.unique(np.stack([true[both], found[both]]), axis=1, return_counts=True)
    cells = dict(zip(*np.unique(true[both], return_counts=True), strict=True))
    return {
        int(one): int(other)
        for one, other, count in zip(*keys, counts, strict=True)
        if other > 0 and 2 * count > cells[one]
    }
