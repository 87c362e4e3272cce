"""The golden detections (tests/data/golden, e_detection): average precision and errors of boxes, in
both modes.

Made by the released functions under numpy 1.23.5, numba 0.57.1 and shapely 2.0.1 instead of the
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

TOLERANCE = 1e-9
SCALE_TOLERANCE = 1e-4
RELEASED = DETECTION_PROTOCOLS["released"]
CHECKED_THRESHOLD = RELEASED.thresholds.index(2.0)
CHECKED_SCORE = 0.3
"""The threshold and the score of the golden's frame_checks."""

every_class = pytest.mark.golden_cases("e_detection", "class_order")
modes = pytest.mark.parametrize(("mode", "prefix"), [("released", ""), ("released_iou", "iou_")])


def make_columns(
    boxes: np.ndarray, category: np.ndarray, score: np.ndarray | None = None
) -> BoxColumns:
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
def read_frames(folder: Path) -> list[tuple[BoxColumns, BoxColumns]]:
    """Return the detections and the true boxes of each frame."""
    with np.load(folder / "e_detection.npz") as archive:
        arrays = dict(archive)
    prefix = "gt_boxes_"
    numbers = sorted(name.removeprefix(prefix) for name in arrays if name.startswith(prefix))
    assert numbers

    frames = []
    for number in numbers:
        detections = (arrays[f"dt_{name}_{number}"] for name in ("boxes", "cls", "score"))
        truth = (arrays[f"gt_{name}_{number}"] for name in ("boxes", "cls"))
        frames.append((make_columns(*detections), make_columns(*truth)))
    return frames


@functools.cache
def evaluate_columns(folder: Path, mode: str) -> DetectionResult:
    protocol = DETECTION_PROTOCOLS[mode]
    counts = [
        {"token": f"{position:06d}", **frame_counts(*frame, protocol)}
        for position, frame in enumerate(read_frames(folder))
    ]
    return detection_result(json.loads(json.dumps(counts))[::-1], protocol)


def count_differing(ours: np.ndarray, expected: np.ndarray) -> int:
    """Count the numbers that differ from the golden ones."""
    is_close = np.isclose(ours, expected, rtol=0, atol=TOLERANCE, equal_nan=True)
    return int((~is_close).sum())


@every_class
@modes
def test_points_of_the_curves(golden, mode: str, prefix: str) -> None:
    """Compare precision and recall at 40 points, for 4 distances or 3 ranges x 2 overlaps."""
    assert tuple(golden.whole["class_order"]) == CATEGORIES
    ours = evaluate_columns(golden.folder, mode)
    for name in ("precision", "recall"):
        expected = golden.array(prefix + name)[golden.index]
        curve = getattr(ours, name)[golden.index].reshape(expected.shape)
        assert count_differing(curve, expected) == 0


@every_class
def test_average_precisions_and_errors(golden) -> None:
    assert list(RELEASED.thresholds) == golden.whole["distance_thresholds"]
    ours = evaluate_columns(golden.folder, "released")

    expected_precision = golden.whole["ap_per_threshold"][golden.index]
    assert count_differing(ours.average_precision[golden.index, 0], expected_precision) == 0

    ate, ase, aoe, ave = ours.errors[golden.index]
    expected = {name: golden.whole[name][golden.index] for name in ("mATE", "mASE", "mAOE", "mAVE")}
    expected_ase = expected.pop("mASE")
    assert count_differing(np.array([ate, aoe, ave]), list(expected.values())) == 0
    assert_allclose(ase, expected_ase, rtol=0, atol=SCALE_TOLERANCE)


@every_class
@modes
def test_results_equal_what_evaluate_returned(golden, mode: str, prefix: str) -> None:
    """Compare the numbers of this class and of all classes under the released names."""
    ours = evaluate_columns(golden.folder, mode)
    expected = golden.whole[f"{prefix}ap_dict"]
    name = ours.classes[golden.index]

    results = {}
    if mode == "released":
        results["Overall_3D_mAP"] = ours.mean_average_precision
        results[f"{name}_3D_average_distance_mAP"] = ours.class_average_precision[name]
        for error, value in zip(ERRORS, ours.errors[golden.index], strict=True):
            results[f"{name}_m{error}"] = value
    else:
        results["Overall_3D"] = ours.mean_average_precision
        results[f"Overall_3D_{name}"] = ours.class_average_precision[name]
        for ring, difficulty in enumerate(("easy", "moderate", "hard")):
            results[f"Overall_3D_{difficulty}"] = mean_of(ours.average_precision[:, ring])
            for level, strictness in enumerate(("strict", "loose")):
                average_precision = ours.average_precision[golden.index, ring, level]
                results[f"{name}_3D_{difficulty}_{strictness}"] = average_precision

    for key, value in results.items():
        tolerance = SCALE_TOLERANCE if key.endswith("mASE") else TOLERANCE
        assert abs(value - expected[f"CARLA/{key}"]) <= tolerance, key


@pytest.mark.golden_cases("e_detection", "frame_checks")
def test_one_frame_and_class(golden) -> None:
    """Compare the boxes that count, and the matches at 2 m of both passes.

    One pass collects the scores, the other one matches the detections from a score of 0.3 on.
    """
    expected = golden.entry
    detections, truth = (boxes.rounded() for boxes in read_frames(golden.folder)[expected["frame"]])
    code = expected["cls"]
    ring = ring_of(detections, truth, RELEASED, 0)

    is_true_class = class_codes(truth, RELEASED) == code
    ignored = np.where(ring.truth_counts, 0, 1)
    assert_array_equal(np.where(is_true_class, ignored, -1), expected["ignored_gt"])
    is_class = class_codes(detections, RELEASED) == code
    is_beyond = ~ring.counts
    assert_array_equal(np.where(is_beyond, 1, np.where(is_class, 0, -1)), expected["ignored_dt"])
    is_valid_truth = is_true_class & ring.truth_counts
    assert is_valid_truth.sum() == expected["num_valid_gt"]

    num_classes = len(RELEASED.classes)
    counts_false_positives = expected["compute_fp"]
    min_score = CHECKED_SCORE if counts_false_positives else -np.inf
    reach = {}
    counts = {}
    for candidate, pairs in ring.reach(CHECKED_THRESHOLD).items():
        row = candidate // num_classes
        if candidate % num_classes == code and detections.score[row] >= min_score:
            reach[candidate] = pairs
            counts[candidate] = bool(ring.counts[row])
    steps = nearest_by_truth(reach, counts, ring.truth_counts.tolist())
    holder = steps.holder if counts_false_positives else highest_score_by_truth(reach)
    rows_by_truth = {index: candidate // num_classes for index, candidate in holder.items()}

    hits = [i for i in sorted(holder) if ring.truth_counts[i] and counts[holder[i]]]
    assert len(hits) == expected["tp"]
    assert [detections.score[rows_by_truth[index]] for index in hits] == expected["scores"]
    num_matched = sum(is_valid_truth[index] for index in holder)
    assert sum(is_valid_truth) - num_matched == expected["fn"]

    if counts_false_positives:
        is_checked = ring.counts & is_class & (detections.score >= CHECKED_SCORE)
        unmatched_rows = set(np.flatnonzero(is_checked)) - set(rows_by_truth.values())
        assert len(unmatched_rows) == expected["fp"]
        assert len(steps.tp) == expected["tp"]
    else:
        assert expected["fp"] == 0


@every_class
def test_the_evaluator_gives_the_same_result(golden) -> None:
    """Evaluate `Boxes`, which keep yaws within half a turn.

    The released modulus then differs by 1e-7.
    """
    evaluator = DetectionEvaluator("released")
    for position, (detections, truth) in enumerate(read_frames(golden.folder)):
        detected = DetectedBoxes(boxes=make_boxes(detections), scores=detections.score)
        evaluator.update(f"{position:06d}", detected, make_boxes(truth))
    result = evaluator.compute()

    expected = evaluate_columns(golden.folder, "released")
    assert_array_equal(result.average_precision, expected.average_precision)
    assert_allclose(result.errors, expected.errors, rtol=0, atol=1e-6)


def make_boxes(columns: BoxColumns) -> Boxes:
    return Boxes.from_arrays(
        columns.center,
        columns.size,
        columns.yaw,
        frame="lidar",
        category=columns.category,
        velocity=np.column_stack([columns.velocity, np.zeros(len(columns))]),
    )
