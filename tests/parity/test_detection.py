"""The golden detections (tests/data/golden, e_detection): average precision and errors of boxes, in
both modes.

Made by the released functions under numpy 1.23.5, numba 0.57.1 and shapely 2.0.1 in place of the
CUDA kernel (tests/data/golden/README.md); the rules are docs/released_code.md, Detection.
Everything equal to 1e-9, but mASE to 1e-4.

The golden's boxes are left-handed, with yaws beyond half a turn: they go in as columns, y and vy
negated. Yaw stands as the converter writes it, which is ours.
"""

import functools
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.evaluation.detection import (
    DETECTION_PROTOCOLS,
    DetectedBoxes,
    DetectionEvaluator,
    DetectionResult,
)
from deepaccident_devkit.evaluation.detection.boxes import BoxColumns
from deepaccident_devkit.evaluation.detection.matching import (
    ERRORS,
    class_codes,
    frame_counts,
    highest_score_by_truth,
    nearest_by_truth,
    ring_of,
)
from deepaccident_devkit.evaluation.detection.result import detection_result, mean_of
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import CATEGORIES

TOLERANCE, SCALE_TOLERANCE = 1e-9, 1e-4
RELEASED = DETECTION_PROTOCOLS["released"]
SHOWN_THRESHOLD, SHOWN_SCORE = RELEASED.thresholds.index(2.0), 0.3
"""What the golden's frame_checks are at."""

every_class = pytest.mark.golden_cases("e_detection", "class_order")
modes = pytest.mark.parametrize(("mode", "prefix"), [("released", ""), ("released_iou", "iou_")])


def columns(boxes: np.ndarray, category: np.ndarray, score: np.ndarray | None = None) -> BoxColumns:
    return BoxColumns(
        center=boxes[:, :3] * (1, -1, 1),
        size=boxes[:, 3:6],
        yaw=boxes[:, 6],
        velocity=boxes[:, 7:] * (1, -1),
        category=category.astype(np.int64),
        score=np.zeros(len(boxes)) if score is None else score,
        own=np.zeros(len(boxes), dtype=bool),
    )


@functools.cache
def frames(folder: Path) -> list[tuple[BoxColumns, BoxColumns]]:
    """Detections and true boxes of each frame."""
    with np.load(folder / "e_detection.npz") as archive:
        numbers = sorted(
            name.removeprefix("gt_boxes_") for name in archive.files if name.startswith("gt_boxes_")
        )
        assert numbers
        return [
            (
                columns(*(archive[f"dt_{name}_{number}"] for name in ("boxes", "cls", "score"))),
                columns(*(archive[f"gt_{name}_{number}"] for name in ("boxes", "cls"))),
            )
            for number in numbers
        ]


@functools.cache
def result(folder: Path, mode: str) -> DetectionResult:
    protocol = DETECTION_PROTOCOLS[mode]
    counts = [
        {"token": f"{position:06d}", **frame_counts(*frame, protocol)}
        for position, frame in enumerate(frames(folder))
    ]
    return detection_result(json.loads(json.dumps(counts))[::-1], protocol)


def differing(ours: np.ndarray, expected: np.ndarray) -> int:
    """How many numbers are others than the golden's."""
    return int((~np.isclose(ours, expected, rtol=0, atol=TOLERANCE, equal_nan=True)).sum())


@every_class
@modes
def test_points_of_the_curves(golden, mode: str, prefix: str) -> None:
    """Precision and recall at each of the 40 points: 4 distances, or 3 ranges x 2 overlaps."""
    assert tuple(golden.whole["class_order"]) == CATEGORIES
    ours = result(golden.folder, mode)
    for name in ("precision", "recall"):
        expected = golden.array(prefix + name)[golden.index]
        assert differing(getattr(ours, name)[golden.index].reshape(expected.shape), expected) == 0


@every_class
def test_average_precisions_and_errors(golden) -> None:
    ours = result(golden.folder, "released")
    assert (
        differing(
            ours.average_precision[golden.index, 0], golden.whole["ap_per_threshold"][golden.index]
        )
        == 0
    )
    assert list(RELEASED.thresholds) == golden.whole["distance_thresholds"]
    ate, ase, aoe, ave = ours.errors[golden.index]
    expected = [golden.whole[name][golden.index] for name in ("mATE", "mASE", "mAOE", "mAVE")]
    assert differing(np.array([ate, aoe, ave]), [expected[0], *expected[2:]]) == 0
    assert_allclose(ase, expected[1], rtol=0, atol=SCALE_TOLERANCE)


@every_class
@modes
def test_what_evaluate_returned(golden, mode: str, prefix: str) -> None:
    """Numbers of this class and those of all, under the names that it gives them."""
    ours, expected = result(golden.folder, mode), golden.whole[f"{prefix}ap_dict"]
    name, kind = ours.classes[golden.index], "average_distance_mAP" if mode == "released" else None
    told = {"Overall_3D_mAP" if kind else "Overall_3D": ours.mean_average_precision}
    if kind:
        told |= {f"{name}_3D_{kind}": ours.class_average_precision[name]}
        told |= {
            f"{name}_m{error}": value
            for error, value in zip(ERRORS, ours.errors[golden.index], strict=True)
        }
    else:
        told |= {f"Overall_3D_{name}": ours.class_average_precision[name]}
        for ring, difficulty in enumerate(("easy", "moderate", "hard")):
            told[f"Overall_3D_{difficulty}"] = mean_of(ours.average_precision[:, ring])
            for level, strictness in enumerate(("strict", "loose")):
                told[f"{name}_3D_{difficulty}_{strictness}"] = ours.average_precision[
                    golden.index, ring, level
                ]
    for key, value in told.items():
        tolerance = SCALE_TOLERANCE if key.endswith("mASE") else TOLERANCE
        assert abs(value - expected[f"CARLA/{key}"]) <= tolerance, key


@pytest.mark.golden_cases("e_detection", "frame_checks")
def test_one_frame_and_class(golden) -> None:
    """Who counts, and the matches at 2 m of the score pass and of the pass at a score of 0.3."""
    expected = golden.entry
    detections, truth = (boxes.rounded() for boxes in frames(golden.folder)[expected["frame"]])
    wanted = expected["cls"]
    ring = ring_of(detections, truth, RELEASED, 0)
    ignored = np.where(ring.truth_counts, 0, 1)
    assert_array_equal(
        np.where(class_codes(truth, RELEASED) == wanted, ignored, -1), expected["ignored_gt"]
    )
    of_class = np.where(class_codes(detections, RELEASED) == wanted, 0, -1)
    beyond = ~ring.counts
    assert_array_equal(np.where(beyond, 1, of_class), expected["ignored_dt"])
    there = (class_codes(truth, RELEASED) == wanted) & ring.truth_counts
    assert there.sum() == expected["num_valid_gt"]

    classes = len(RELEASED.classes)
    passes = expected["compute_fp"]
    reach = {
        candidate: pairs
        for candidate, pairs in ring.reach(SHOWN_THRESHOLD).items()
        if candidate % classes == wanted
        and (not passes or detections.score[candidate // classes] >= SHOWN_SCORE)
    }
    counts = {candidate: bool(ring.counts[candidate // classes]) for candidate in reach}
    steps = nearest_by_truth(reach, counts, ring.truth_counts.tolist())
    holder = steps.holder if passes else highest_score_by_truth(reach)
    found = [one for one in sorted(holder) if ring.truth_counts[one] and counts[holder[one]]]
    assert len(found) == expected["tp"]
    assert [detections.score[holder[one] // classes] for one in found] == expected["scores"]
    assert sum(there) - sum(1 for one in holder if there[one]) == expected["fn"]
    asked = ring.counts & (of_class == 0) & (detections.score >= SHOWN_SCORE)
    assigned = {candidate // classes for candidate in holder.values()}
    in_vain = [row for row in np.flatnonzero(asked).tolist() if row not in assigned]
    assert (len(in_vain) if passes else 0) == expected["fp"]
    if passes:
        assert len(steps.tp) == expected["tp"]


@every_class
def test_the_evaluator_says_the_same(golden) -> None:
    """Through `Boxes`, which keep yaws within half a turn: the released modulus then differs by
    1e-7.
    """
    evaluator = DetectionEvaluator("released")
    for position, (detections, truth) in enumerate(frames(golden.folder)):
        predicted, true = (
            Boxes.from_arrays(
                boxes.center,
                boxes.size,
                boxes.yaw,
                frame="lidar",
                category=boxes.category,
                velocity=np.column_stack([boxes.velocity, np.zeros(len(boxes))]),
            )
            for boxes in (detections, truth)
        )
        evaluator.update(
            f"{position:06d}", DetectedBoxes(boxes=predicted, scores=detections.score), true
        )
    ours, of_columns = evaluator.compute(), result(golden.folder, "released")
    assert_array_equal(ours.average_precision, of_columns.average_precision)
    assert_allclose(ours.errors, of_columns.errors, rtol=0, atol=1e-6)
