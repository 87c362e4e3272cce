"""The golden IoU and VPQ (tests/data/golden, b_vpq) of linked instances, at both ranges, of each
sequence and of all.

The released functions (FIERY's panoptic metric, torchmetrics' IoU) made them under numpy 1.23.5 and
torch 2.13 on the CPU (tests/data/golden/README.md; docs/released_code.md, IoU and VPQ). Counts are
equal; rates and sums of intersections over unions agree to 2e-6, since the released code sums in
float32. `test_trajectories` tests the errors of the paths, `test_motion_end_to_end` the evaluator.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.evaluation.instances import (
    PanopticQuality,
    SegmentationCounts,
    VpqCounts,
    iou,
    mask_counts,
    panoptic_quality,
    vpq_counts,
)

RANGES = ("30x30", "100x100")
TOLERANCE = 2e-6
COUNTS = ("true_positive", "false_positive", "false_negative")
PARTS = ("iou", *COUNTS)
by_range = pytest.mark.parametrize("name", RANGES)


def crop(golden, name: str, maps: np.ndarray) -> np.ndarray:
    cells = slice(*golden.whole["ranges"][name])
    return maps[:, cells, cells]


def crop_instances(golden, name: str) -> tuple[np.ndarray, np.ndarray]:
    return crop(golden, name, golden["pred"]), crop(golden, name, golden["gt"])


def count_cells(golden, name: str) -> list[SegmentationCounts]:
    predicted = crop(golden, name, golden["seg_pred"])
    true = crop(golden, name, golden["seg_gt"])
    return [mask_counts(predicted == index, true == index) for index in (0, 1)]


def compute_vpq(sequences: Sequence[VpqCounts]) -> list[PanopticQuality]:
    """Return the quality of background and instances over all frames of all sequences."""
    frame_counts = concatenate_frames(sequences)
    return quality_of_sums([counts.sum(axis=0) for counts in frame_counts])


def concatenate_frames(sequences: Sequence[VpqCounts]) -> list[np.ndarray]:
    """Return each part of the counts, frame by frame over all sequences."""
    return [np.concatenate([getattr(counts, part) for counts in sequences]) for part in PARTS]


def quality_of_sums(sums: Sequence[np.ndarray]) -> list[PanopticQuality]:
    return [panoptic_quality(*class_sums) for class_sums in zip(*sums, strict=True)]


def compute_ious(cells: Sequence[list[SegmentationCounts]]) -> list[float]:
    """Return the IoU of background and instances over all sequences."""
    return [iou(counts) for counts in zip(*cells, strict=True)]


def assert_quality(qualities: Sequence[PanopticQuality], expected: dict) -> None:
    for key in ("pq", "sq", "rq", "denominator"):
        values = [getattr(quality, key) for quality in qualities]
        assert_allclose(values, expected[key], rtol=0, atol=TOLERANCE)


@by_range
@pytest.mark.golden_cases("b_vpq", "sequences")
def test_vpq_of_a_sequence(golden, name: str) -> None:
    expected = golden.entry[name]
    counts = vpq_counts(*crop_instances(golden, name))
    assert len(counts.iou) == golden.entry["S"]
    for key in COUNTS:
        expected_counts = [frame[key] for frame in expected["per_frame"]]
        assert_array_equal(getattr(counts, key), expected_counts)
    expected_ious = [frame["iou"] for frame in expected["per_frame"]]
    assert_allclose(counts.iou, expected_ious, rtol=TOLERANCE, atol=TOLERANCE)
    assert_quality(compute_vpq([counts]), expected)


@by_range
@pytest.mark.golden_cases("b_vpq", "sequences")
def test_panoptic_quality_of_a_sequence_frame_by_frame(golden, name: str) -> None:
    counts = vpq_counts(*crop_instances(golden, name), temporally_consistent=False)
    assert_quality(compute_vpq([counts]), golden.entry[name]["not_temporally_consistent"])


@by_range
@pytest.mark.golden_cases("b_vpq", "sequences")
def test_iou_of_a_sequence(golden, name: str) -> None:
    expected = golden.entry[name]
    cells = count_cells(golden, name)
    for key in COUNTS:
        numbers = [getattr(counts, key) for counts in cells]
        assert numbers == expected["seg_counts"][key]
    support = [counts.true_positive + counts.false_negative for counts in cells]
    assert support == expected["seg_counts"]["support"]
    assert_allclose(compute_ious([cells]), expected["iou"], rtol=0, atol=TOLERANCE)


@pytest.mark.golden_cases("b_vpq", "aggregate")
def test_all_sequences(golden) -> None:
    """Compare sums over all sequences and over the selected ones of a breakdown.

    The released code takes the indices of the selected sequences for indices of frames.
    """
    name, expected = list(golden.whole["aggregate"].items())[golden.index]
    selected = golden.whole["selected_index"]
    cases = [
        replace(golden, key="sequences", index=number)
        for number in range(len(golden.whole["sequences"]))
    ]
    sequences = [vpq_counts(*crop_instances(case, name)) for case in cases]
    cells = [count_cells(case, name) for case in cases]

    assert_quality(compute_vpq(sequences), expected["separate"])
    assert_quality(compute_vpq(sequences), expected["plain"])

    wrong_sums = [counts[selected].sum(axis=0) for counts in concatenate_frames(sequences)]
    assert_quality(quality_of_sums(wrong_sums), expected["separate_selected_as_released"])

    ious = compute_ious(cells)
    assert_allclose(ious, expected["iou_separate"], rtol=0, atol=TOLERANCE)
    assert_allclose(ious, expected["iou_plain"], rtol=0, atol=TOLERANCE)
    selected_ious = compute_ious([cells[number] for number in selected])
    assert_allclose(selected_ious, expected["iou_selected"], rtol=0, atol=TOLERANCE)
