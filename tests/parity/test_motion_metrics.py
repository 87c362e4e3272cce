"""The golden IoU and VPQ (tests/data/golden, b_vpq) of linked instances, at both ranges, of each
sequence and of all.

Made by the released functions (FIERY's panoptic metric, torchmetrics' IoU) under numpy 1.23.5 and
torch 2.13 on the CPU (tests/data/golden/README.md; docs/released_code.md, IoU and VPQ). Counts
equal; rates and sums of intersections over unions to 2e-6, since the released code sums in float32.
`test_trajectories` has the errors of the paths, `test_motion_end_to_end` the evaluator.
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
PARTS = ("iou", "true_positive", "false_positive", "false_negative")
by_range = pytest.mark.parametrize("name", RANGES)


def crop(golden, name: str, maps: np.ndarray) -> np.ndarray:
    cells = slice(*golden.whole["ranges"][name])
    return maps[:, cells, cells]


def instances(golden, name: str) -> tuple[np.ndarray, np.ndarray]:
    return crop(golden, name, golden["pred"]), crop(golden, name, golden["gt"])


def segmentations(golden, name: str) -> list[SegmentationCounts]:
    predicted, true = (crop(golden, name, golden[which]) for which in ("seg_pred", "seg_gt"))
    return [mask_counts(predicted == index, true == index) for index in (0, 1)]


def vpq(counts: Sequence[VpqCounts]) -> list[PanopticQuality]:
    """Of the background and of the instances, over all frames of all sequences."""
    sums = [sum(getattr(each, part).sum(axis=0) for each in counts) for part in PARTS]
    return [panoptic_quality(*numbers) for numbers in zip(*sums, strict=True)]


def assert_quality(found: Sequence[PanopticQuality], expected: dict) -> None:
    for key in ("pq", "sq", "rq", "denominator"):
        assert_allclose(
            [getattr(each, key) for each in found], expected[key], rtol=0, atol=TOLERANCE
        )


@by_range
@pytest.mark.golden_cases("b_vpq", "sequences")
def test_vpq_of_a_sequence(golden, name: str) -> None:
    found, expected = vpq_counts(*instances(golden, name)), golden.entry[name]
    assert len(found.iou) == golden.entry["S"]
    for key in ("true_positive", "false_positive", "false_negative"):
        assert_array_equal(getattr(found, key), [frame[key] for frame in expected["per_frame"]])
    assert_allclose(
        found.iou, [frame["iou"] for frame in expected["per_frame"]], rtol=TOLERANCE, atol=TOLERANCE
    )
    assert_quality(vpq([found]), expected)


@by_range
@pytest.mark.golden_cases("b_vpq", "sequences")
def test_panoptic_quality_of_a_sequence_frame_by_frame(golden, name: str) -> None:
    found = vpq_counts(*instances(golden, name), temporally_consistent=False)
    assert_quality(vpq([found]), golden.entry[name]["not_temporally_consistent"])


@by_range
@pytest.mark.golden_cases("b_vpq", "sequences")
def test_iou_of_a_sequence(golden, name: str) -> None:
    found, expected = segmentations(golden, name), golden.entry[name]
    for key in ("true_positive", "false_positive", "false_negative"):
        assert [getattr(each, key) for each in found] == expected["seg_counts"][key]
    support = [each.true_positive + each.false_negative for each in found]
    assert support == expected["seg_counts"]["support"]
    assert_allclose([iou([each]) for each in found], expected["iou"], rtol=0, atol=TOLERANCE)


@pytest.mark.golden_cases("b_vpq", "aggregate")
def test_all_sequences(golden) -> None:
    """Sums over everything, and over the sequences `selected_index`, as a breakdown takes them; and
    the mistake.
    """
    name = list(golden.whole["aggregate"])[golden.index]
    expected, selected = golden.whole["aggregate"][name], golden.whole["selected_index"]
    cases = [
        replace(golden, key="sequences", index=number)
        for number in range(len(golden.whole["sequences"]))
    ]
    counts = [vpq_counts(*instances(case, name)) for case in cases]
    cells = [segmentations(case, name) for case in cases]

    assert_quality(vpq(counts), expected["separate"])
    assert_quality(vpq(counts), expected["plain"])
    frames = [
        [getattr(each, part)[frame] for part in PARTS]
        for each in counts
        for frame in range(len(each.iou))
    ]
    wrong = np.sum([frames[number] for number in selected], axis=0)
    assert_quality(
        [panoptic_quality(*sums) for sums in wrong.T], expected["separate_selected_as_released"]
    )
    for key in ("iou_separate", "iou_plain"):
        assert_allclose(
            [iou([each[index] for each in cells]) for index in (0, 1)],
            expected[key],
            rtol=0,
            atol=TOLERANCE,
        )
    chosen = [cells[number] for number in selected]
    assert_allclose(
        [iou([each[index] for each in chosen]) for index in (0, 1)],
        expected["iou_selected"],
        rtol=0,
        atol=TOLERANCE,
    )
