"""Measures, errors, and who counts, beside plain computations on random boxes."""

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

RELEASED = DETECTION_PROTOCOLS["released"]


def random_boxes(source: np.random.Generator, count: int) -> BoxColumns:
    """Near each other, turned several times around, of all categories."""
    return BoxColumns(
        center=source.uniform(-3, 3, (count, 3)),
        size=source.uniform(1, 5, (count, 3)),
        yaw=source.uniform(-9, 9, count),
        velocity=source.uniform(-9, 9, (count, 2)),
        category=source.integers(0, 6, count),
        score=source.uniform(0, 1, count),
        own=source.random(count) < 0.2,
    )


def corners(boxes: BoxColumns, at: int) -> np.ndarray:
    ahead = np.array([math.cos(boxes.yaw[at]), math.sin(boxes.yaw[at])]) * boxes.size[at, 0] / 2
    aside = np.array([-math.sin(boxes.yaw[at]), math.cos(boxes.yaw[at])]) * boxes.size[at, 1] / 2
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    return np.array([boxes.center[at, :2] + one * ahead + two * aside for one, two in signs])


def overlaps(
    one: BoxColumns, at: int, other: BoxColumns, there: int, *, down: bool
) -> tuple[float, float]:
    """Shares of footprints and of volumes; these reach up or down from their lower faces."""
    area = Polygon(corners(one, at)).intersection(Polygon(corners(other, there))).area
    lows = [
        each.center[row, 2] - each.size[row, 2] / 2 for each, row in ((one, at), (other, there))
    ]
    spans = [
        (low - height * down, low + height * (not down))
        for low, height in zip(lows, (one.size[at, 2], other.size[there, 2]), strict=True)
    ]
    shared = area * max(min(high for _, high in spans) - max(low for low, _ in spans), 0)
    flat, whole = (one.size[at, :axes].prod() + other.size[there, :axes].prod() for axes in (2, 3))
    return area / (flat - area), shared / (whole - shared)


@pytest.mark.parametrize("name", DETECTION_PROTOCOLS)
def test_costs_are_distances_or_overlaps_pair_by_pair(name: str) -> None:
    rules, source = DETECTION_PROTOCOLS[name], np.random.default_rng(7)
    found, truth = random_boxes(source, 9), random_boxes(source, 8)
    expected = np.zeros((9, 8))
    for at, there in np.ndindex(9, 8):
        apart = found.center[at] - truth.center[there]
        bottoms = apart - [0, 0, (found.size[at, 2] - truth.size[there, 2]) / 2]
        flat, whole = overlaps(found, at, truth, there, down=rules.bottom_taken_as_top)
        measures = {
            "distance_of_bottoms": np.linalg.norm(bottoms),
            "distance_bev": np.linalg.norm(apart[:2]),
            "iou_3d": -whole,
            "iou_bev": -flat,
        }
        expected[at, there] = measures[rules.measure]
    assert_allclose(costs(found, truth, rules), expected, atol=1e-9)
    assert [limit_of(0.5, rules), len({*costs(found, truth, rules).ravel()}) > 9] == [
        -0.5 if "iou" in rules.measure else 0.5,
        True,
    ]


@pytest.mark.parametrize("name", ["released", "paper"])
def test_errors_of_matches_pair_by_pair(name: str) -> None:
    rules, source = detection_protocol(name, single_precision=False), np.random.default_rng(8)
    found, truth = random_boxes(source, 40), random_boxes(source, 40)
    for row, (place, scale, turn, speed) in enumerate(match_errors(found, truth, rules)):
        apart = found.center[row] - truth.center[row]
        assert speed == pytest.approx(np.linalg.norm(found.velocity[row] - truth.velocity[row]))
        if name == "released":
            bottoms = apart - [0, 0, (found.size[row, 2] - truth.size[row, 2]) / 2]
            around = 2 * 3.1415926
            assert place == pytest.approx(np.linalg.norm(bottoms))
            assert turn == pytest.approx(
                abs(truth.yaw[row] % around - found.yaw[row] % around), abs=1e-9
            )
            assert scale == pytest.approx(1 - overlaps(found, row, truth, row, down=True)[1])
        else:
            common = np.minimum(found.size[row], truth.size[row]).prod()
            apart_yaw = (found.yaw[row] - truth.yaw[row]) % (2 * math.pi)
            assert place == pytest.approx(np.linalg.norm(apart[:2]))
            assert turn == pytest.approx(min(apart_yaw, 2 * math.pi - apart_yaw))
            assert scale == pytest.approx(
                1 - common / (found.size[row].prod() + truth.size[row].prod() - common)
            )


def test_a_released_turn_of_single_precision_is_rounded_for_the_truth_alone() -> None:
    source = np.random.default_rng(9)
    found, truth = random_boxes(source, 5).rounded(), random_boxes(source, 5).rounded()
    around = 2 * 3.1415926
    true = (truth.yaw.astype(float) % around).astype(np.float32)
    assert_array_equal(
        match_errors(found, truth, RELEASED)[:, 2], np.abs(true - found.yaw.astype(float) % around)
    )


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
def test_who_counts_box_by_box(name: str, switches: dict[str, Any]) -> None:
    """Places at the edges of areas and ranges, and next to them."""
    rules, source = detection_protocol(name, **switches), np.random.default_rng(3)
    places = np.array([-31, -30, -20.5, -20, -6, 0, 6, 8, 10, 10.5, 11, 15, 20, 25, 31, 31.5])
    boxes, truth = (
        replace(
            random_boxes(source, 300), center=np.c_[source.choice(places, (300, 2)), np.zeros(300)]
        )
        for _ in range(2)
    )
    counts = frame_counts(boxes, truth, rules)
    found, true = (
        np.zeros(len(counts["truths"]), dtype=int),
        np.zeros(len(counts["truths"]), dtype=int),
    )
    for some, sums, is_truth in ((boxes, found, False), (truth, true, True)):
        for row in range(300):
            for group in groups_of(some, row, rules, is_truth=is_truth):
                sums[group] += 1
    assert counts["truths"] == true.tolist()
    assert np.bincount(counts["detections"][0], minlength=len(found)).tolist() == found.tolist()
    assert true.sum() > 20


def groups_of(
    boxes: BoxColumns, row: int, rules: DetectionProtocol, *, is_truth: bool
) -> list[int]:
    """The classes in their ranges in which a box counts."""
    names = ("car", "truck", "van", "cyclist", "motorcycle", "pedestrian")
    codes = [
        at for at, (_, taken) in enumerate(rules.classes) if names[boxes.category[row]] in taken
    ]
    points = (
        corners(boxes, row) if rules.area_of == "footprint" else boxes.center[row : row + 1, :2]
    )
    x_low, x_high, y_low, y_high = rules.area or (-math.inf, math.inf, -math.inf, math.inf)
    inside = all(x_low <= x <= x_high and y_low <= y <= y_high for x, y in points.tolist())
    x, y = boxes.center[row, :2].tolist()
    distance = math.sqrt(x * x + (x * x if rules.range_from_x_alone else y * y))
    own = is_truth and not rules.own_box and boxes.own[row]
    rings = [at for at, (low, high) in enumerate(rules.ranges) if low <= distance < high]
    return [
        code * len(rules.ranges) + ring for code in codes for ring in rings if inside and not own
    ]
