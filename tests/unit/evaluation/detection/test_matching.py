"""Measures, errors and counted boxes, compared with plain computations on random boxes."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from shapely import Polygon

from deepaccident_devkit.evaluation.detection import (
    DETECTION_PROTOCOLS,
    DetectionProtocol,
    detection_protocol,
)
from deepaccident_devkit.evaluation.detection.boxes import BoxColumns
from deepaccident_devkit.evaluation.detection.matching import (
    costs,
    frame_counts,
    limit_of,
    match_errors,
)

CATEGORIES = ("car", "truck", "van", "cyclist", "motorcycle", "pedestrian")
RELEASED = DETECTION_PROTOCOLS["released"]
# A full turn in the released code, radians.
RELEASED_TURN = 2 * 3.1415926


def random_boxes(random: np.random.Generator, count: int) -> BoxColumns:
    """Draw boxes near each other, turned several times around, of all categories."""
    return BoxColumns(
        center=random.uniform(-3, 3, (count, 3)),
        size=random.uniform(1, 5, (count, 3)),
        yaw=random.uniform(-9, 9, count),
        velocity=random.uniform(-9, 9, (count, 2)),
        category=random.integers(0, 6, count),
        score=random.uniform(0, 1, count),
        own=random.random(count) < 0.2,
    )


def footprint_corners(boxes: BoxColumns, row: int) -> np.ndarray:
    """Return the corners of a box from above, (4, 2)."""
    yaw = boxes.yaw[row]
    rotation = np.array(
        [
            [math.cos(yaw), -math.sin(yaw)],
            [math.sin(yaw), math.cos(yaw)],
        ]
    )
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    offsets = signs * boxes.size[row, :2] / 2
    return boxes.center[row, :2] + offsets @ rotation.T


def overlaps(
    boxes: BoxColumns, row: int, other_boxes: BoxColumns, other_row: int, *, down: bool
) -> tuple[float, float]:
    """Return the overlaps (IoU) of two footprints and of two volumes; volumes reach up or down from
    the lower faces.
    """
    size, other_size = boxes.size[row], other_boxes.size[other_row]
    footprint = Polygon(footprint_corners(boxes, row))
    shared_area = footprint.intersection(Polygon(footprint_corners(other_boxes, other_row))).area
    spans = []
    for z, height in (
        (boxes.center[row, 2], size[2]),
        (other_boxes.center[other_row, 2], other_size[2]),
    ):
        lower_face = z - height / 2
        spans.append(
            (lower_face - height, lower_face) if down else (lower_face, lower_face + height)
        )
    (low, high), (other_low, other_high) = spans
    shared_volume = shared_area * max(min(high, other_high) - max(low, other_low), 0)
    areas = size[:2].prod() + other_size[:2].prod()
    volumes = size.prod() + other_size.prod()
    return (
        shared_area / (areas - shared_area),
        shared_volume / (volumes - shared_volume),
    )


@pytest.mark.parametrize("name", DETECTION_PROTOCOLS)
def test_costs_are_distances_or_overlaps_pair_by_pair(name: str) -> None:
    rules = DETECTION_PROTOCOLS[name]
    random = np.random.default_rng(7)
    detected = random_boxes(random, 9)
    truth = random_boxes(random, 8)
    expected = np.zeros((9, 8))
    for row, other in np.ndindex(9, 8):
        difference = detected.center[row] - truth.center[other]
        half_heights = [0, 0, (detected.size[row, 2] - truth.size[other, 2]) / 2]
        iou_bev, iou_3d = overlaps(
            detected,
            row,
            truth,
            other,
            down=rules.bottom_taken_as_top,
        )
        measures = {
            "distance_of_bottoms": np.linalg.norm(difference - half_heights),
            "distance_bev": np.linalg.norm(difference[:2]),
            "iou_3d": -iou_3d,
            "iou_bev": -iou_bev,
        }
        expected[row, other] = measures[rules.measure]

    result = costs(detected, truth, rules)

    assert_allclose(result, expected, atol=1e-9)
    assert len({*result.ravel()}) > 9
    assert limit_of(0.5, rules) == (-0.5 if "iou" in rules.measure else 0.5)


@pytest.mark.parametrize("name", ["released", "paper"])
def test_errors_of_matches_pair_by_pair(name: str) -> None:
    rules = detection_protocol(name, single_precision=False)
    random = np.random.default_rng(8)
    detected = random_boxes(random, 40)
    truth = random_boxes(random, 40)
    errors = match_errors(detected, truth, rules)
    for row, (position_error, scale_error, turn, speed_error) in enumerate(errors):
        difference = detected.center[row] - truth.center[row]
        size, true_size = detected.size[row], truth.size[row]
        yaw, true_yaw = detected.yaw[row], truth.yaw[row]
        velocity_difference = detected.velocity[row] - truth.velocity[row]
        assert speed_error == pytest.approx(np.linalg.norm(velocity_difference))
        if name == "released":
            bottoms = difference - [0, 0, (size[2] - true_size[2]) / 2]
            assert position_error == pytest.approx(np.linalg.norm(bottoms))
            expected_turn = abs(true_yaw % RELEASED_TURN - yaw % RELEASED_TURN)
            assert turn == pytest.approx(expected_turn, abs=1e-9)
            _, iou_3d = overlaps(
                detected,
                row,
                truth,
                row,
                down=True,
            )
            assert scale_error == pytest.approx(1 - iou_3d)
        else:
            assert position_error == pytest.approx(np.linalg.norm(difference[:2]))
            left_turn = (yaw - true_yaw) % (2 * math.pi)
            assert turn == pytest.approx(min(left_turn, 2 * math.pi - left_turn))
            common = np.minimum(size, true_size).prod()
            aligned_iou = common / (size.prod() + true_size.prod() - common)
            assert scale_error == pytest.approx(1 - aligned_iou)


def test_a_released_turn_of_single_precision_is_rounded_only_for_the_truth() -> None:
    random = np.random.default_rng(9)
    detected = random_boxes(random, 5).rounded()
    truth = random_boxes(random, 5).rounded()
    yaw = detected.yaw.astype(float) % RELEASED_TURN
    true_yaw = (truth.yaw.astype(float) % RELEASED_TURN).astype(np.float32)
    turns = match_errors(detected, truth, RELEASED)[:, 2]
    assert_array_equal(turns, np.abs(true_yaw - yaw))


@pytest.mark.parametrize(
    "switches",
    [
        {},
        {"own_box": True},
        {"area": (-20.0, 31.0, -30.0, 10.5)},
        {"area": (-20.0, 31.0, -30.0, 10.5), "area_of": "footprint"},
        {"ranges": [[0, 10], [10, 25]], "error_threshold": None},
        {
            "ranges": [[0, 10], [10, 25]],
            "error_threshold": None,
            "range_from_x_alone": True,
            "area": None,
        },
        {"classes": [["vehicle", ["van", "car"]], ["walking", ["pedestrian"]]]},
    ],
)
@pytest.mark.parametrize("name", ["paper", "released"])
def test_boxes_count_in_their_groups_box_by_box(name: str, switches: dict[str, Any]) -> None:
    """Boxes lie at the edges of areas and ranges, and next to them."""
    rules = detection_protocol(name, **switches)
    random = np.random.default_rng(3)
    places = np.array([-31, -30, -20.5, -20, -6, 0, 6, 8, 10, 10.5, 11, 15, 20, 25, 31, 31.5])
    detected, truth = (
        replace(
            random_boxes(random, 300),
            center=np.c_[random.choice(places, (300, 2)), np.zeros(300)],
        )
        for _ in range(2)
    )

    counts = frame_counts(detected, truth, rules)

    expected_truths = count_groups(truth, rules, is_truth=True)
    assert counts["truths"] == expected_truths
    assert sum(expected_truths) > 20
    detections = np.bincount(counts["detections"][0], minlength=len(expected_truths))
    assert detections.tolist() == count_groups(detected, rules, is_truth=False)


def count_groups(boxes: BoxColumns, rules: DetectionProtocol, *, is_truth: bool) -> list[int]:
    """Count the boxes in each class and each of its ranges, one by one."""
    counts = np.zeros(
        (len(rules.classes), len(rules.ranges)),
        dtype=int,
    )
    for row in range(len(boxes.yaw)):
        if is_truth and boxes.own[row] and not rules.own_box:
            continue
        points = boxes.center[row : row + 1, :2]
        if rules.area_of == "footprint":
            points = footprint_corners(boxes, row)
        x_low, x_high, y_low, y_high = rules.area or (-math.inf, math.inf, -math.inf, math.inf)
        if not all(x_low <= x <= x_high and y_low <= y <= y_high for x, y in points.tolist()):
            continue
        x, y = boxes.center[row, :2].tolist()
        aside = x if rules.range_from_x_alone else y
        distance = math.sqrt(x * x + aside * aside)
        category = CATEGORIES[boxes.category[row]]
        for code, (_, categories) in enumerate(rules.classes):
            for ring, (low, high) in enumerate(rules.ranges):
                counts[code, ring] += category in categories and low <= distance < high
    return counts.ravel().tolist()
