"""Who is matched with whom: the same numbers as the evaluators count."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import DetectedBoxes, detection_truth
from deepaccident_devkit.evaluation.metrics.detection import DETECTION_PROTOCOLS, detection_matches, detection_protocol
from deepaccident_devkit.evaluation.metrics.detection.boxes import BoxColumns, columns_of
from deepaccident_devkit.evaluation.metrics.detection.frame_counts import frame_counts
from deepaccident_devkit.evaluation.metrics.detection.matching import match_errors
from deepaccident_devkit.geometry import Boxes


@pytest.mark.parametrize("protocol", DETECTION_PROTOCOLS)
def test_detections_match_as_they_are_counted(da_b: DeepAccident, protocol: str) -> None:
    """All detections arrived, so the counted sums of arrivals are the matches."""
    rules = DETECTION_PROTOCOLS[protocol]
    token = da_b.sample[0]["token"]
    truth = detection_truth(da_b, token, rules)
    rng = np.random.default_rng(1)
    keep = np.flatnonzero(rng.random(len(truth)) < 0.7)
    off = rng.normal(0, 0.4, (len(keep), 3)) * (1, 1, 0)
    columns: dict[str, Any] = {"category": np.tile(truth.category[keep], 2), "frame": rules.frame}
    center = np.vstack([truth.center[keep] + off, truth.center[keep] + (9.0, 9.0, 0.0)])
    size, yaw = np.tile(truth.size[keep], (2, 1)), np.tile(truth.yaw[keep], 2)
    detected = DetectedBoxes.from_arrays(center, size, yaw, rng.random(len(center)), **columns)
    counts = frame_counts(columns_of(detected.boxes, detected.scores), columns_of(truth), rules)
    for level, threshold in enumerate(rules.thresholds):
        found = detection_matches(detected, truth, rules, threshold)
        cells = np.array(counts["tp"][0], dtype=int)
        assert len(found.detection) == np.sum(cells % len(rules.thresholds) == level)
        if rules.matching == "by_score":
            assert len(found.detection) + len(found.missed) == sum(counts["truths"])
            assert len(found.detection) + len(found.false) == len(counts["detections"][0])
        assert_array_equal(detected.boxes.category[found.detection], truth.category[found.truth])
        assert len(np.unique(found.truth)) == len(found.truth)
        assert not np.isin(found.truth, found.missed).any()
        assert not np.isin(found.detection, found.false).any()
    with pytest.raises(ChoiceError, match=r"threshold: expected one of .*, found 77"):
        detection_matches(detected, truth, rules, 77)


@pytest.mark.parametrize("nearest_first", [True, False])
@pytest.mark.parametrize("protocol", DETECTION_PROTOCOLS)
def test_of_several_that_are_near_enough_the_nearest_is_matched(protocol: str, *, nearest_first: bool) -> None:
    """A detection looks for its true box or, in the released way, a true box for its detection: here one for two."""
    rules = DETECTION_PROTOCOLS[protocol]
    one, two = [(10.0, 0.0)], [(10.1, 0.0), (10.3, 0.0)][:: 1 if nearest_first else -1]
    truth_places, places = (two, one) if rules.matching == "by_score" else (one, two)

    def columns(found: list[tuple[float, float]]) -> dict[str, Any]:
        center = np.array([(*place, 0.75) for place in found])
        return {"center": center, "size": np.full((len(found), 3), 4.0), "yaw": np.zeros(len(found))}

    truth = Boxes.from_arrays(**columns(truth_places), frame=rules.frame)
    detected = DetectedBoxes.from_arrays(**columns(places), scores=np.ones(len(places)), frame=rules.frame)
    found = detection_matches(detected, truth, rules, rules.thresholds[0])
    of_two = found.truth if rules.matching == "by_score" else found.detection
    assert of_two.tolist() == [0 if nearest_first else 1]


def columns_at(*places: tuple[float, float]) -> dict[str, Any]:
    center = np.array([(*place, 0.75) for place in places]).reshape(-1, 3)
    size, yaw = np.tile((4.0, 2.0, 1.5), (len(places), 1)), np.zeros(len(places))
    return {"center": center, "size": size, "yaw": yaw, "frame": "lidar"}


def detected_at(*places: tuple[float, float]) -> DetectedBoxes:
    return DetectedBoxes.from_arrays(**columns_at(*places), scores=np.linspace(0.9, 0.1, len(places)))


def test_the_threshold_that_is_not_given_is_that_of_the_errors_or_the_middle_one() -> None:
    truth, detected = Boxes.from_arrays(**columns_at((10, 0))), detected_at((10, 0))
    expected = {"released": 2.0, "released_iou": 0.15, "paper": 2.0, "opencood": 0.5}
    assert {name: detection_matches(detected, truth, name).threshold for name in expected} == expected
    assert detection_matches(detected, truth).threshold == 2.0
    assert detection_matches(detected, truth, "paper", 4.0).threshold == 4.0


def test_pairs_of_which_one_is_out_of_range_are_neither_matches_nor_errors() -> None:
    """The released range ends at x = 84.85 m: the first pair has its truth beyond, the second its detection."""
    truth = Boxes.from_arrays(**columns_at((85.5, 0), (84.0, 20), (10, 0), (30, 0)))
    found = detection_matches(detected_at((84.5, 0), (85.0, 20), (50, 0), (10, 0), (40, 0)), truth, "released", 4.0)
    assert (found.detection.tolist(), found.truth.tolist()) == ([3], [2])
    assert (found.false.tolist(), found.missed.tolist()) == ([2, 4], [3])
    alone = detection_matches(detected_at((84.5, 0)), truth.select(np.array([0])), "released")
    assert [len(rows) for rows in (alone.detection, alone.truth, alone.false, alone.missed)] == [0] * 4


def test_matches_of_several_ranges_are_in_the_order_of_rows() -> None:
    places = [(60.0, 0.0), (5.0, 0.0), (40.0, 0.0), (70.0, 9.0)]
    found = detection_matches(detected_at(*places, (20, 9)), Boxes.from_arrays(**columns_at(*places)), "released_iou")
    assert (found.detection.tolist(), found.truth.tolist()) == ([0, 1, 2, 3], [0, 1, 2, 3])
    assert (found.false.tolist(), found.missed.tolist()) == ([4], [])
    near = detection_protocol("released_iou", range_from_x_alone=False)
    found = detection_matches(detected_at((5, 0), (55, 9), (33, 0)), Boxes.from_arrays(**columns_at(*places)), near)
    assert (found.detection.tolist(), found.truth.tolist()) == ([0], [1])
    assert (found.false.tolist(), found.missed.tolist()) == ([1, 2], [0, 2, 3])


def test_ranges_begin_with_their_first_metre_and_end_before_their_last() -> None:
    ranges = ((0.0, 30.0), (30.0, 50.0))
    rules = detection_protocol("paper", ranges=ranges, area=None, error_threshold=None)
    truth = Boxes.from_arrays(**columns_at((0, 0), (0, 29.9), (18, 24), (-30, 40), (0, -49.9)))
    detected = detected_at((0, 0), (29.9, 0), (0, 30), (0, 50), (0, 49.9))
    counts = frame_counts(columns_of(detected.boxes, detected.scores), columns_of(truth), rules)
    assert counts["truths"][:2] == [2, 2]
    assert counts["detections"] == [[0, 0, 1, 1], [0, 1, 2, 4]]


def test_the_edge_of_an_area_belongs_to_it() -> None:
    rules = detection_protocol("paper", area=(-20.0, 30.0, -10.0, 40.0))
    for inside in ((-20, 0), (30, 0), (0, -10), (0, 40), (30, 40)):
        assert detection_matches(
            detected_at(inside), Boxes.from_arrays(**columns_at(inside)), rules
        ).truth.tolist() == [0]
    for outside in ((-20.1, 0), (30.1, 0), (0, -10.1), (0, 40.1)):
        found = detection_matches(detected_at(outside), Boxes.from_arrays(**columns_at(outside)), rules)
        assert (len(found.truth), len(found.missed), len(found.false)) == (0, 0, 0)


def test_released_errors_of_places_have_three_axes() -> None:
    def columns(center: tuple[float, float, float]) -> BoxColumns:
        box = Boxes.from_arrays([center], size=[[4.0, 2.0, 1.5]], yaw=[0.0], frame="lidar")
        return columns_of(box)

    truth, found = columns((10.0, 5.0, 1.0)), columns((13.0, 9.0, 13.0))
    assert match_errors(found, truth, DETECTION_PROTOCOLS["released"])[0, 0] == pytest.approx(13)
    assert match_errors(found, truth, DETECTION_PROTOCOLS["paper"])[0, 0] == pytest.approx(5)
