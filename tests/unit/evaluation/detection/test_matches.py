"""Who is matched with whom: the same numbers as the evaluators count."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import DetectedBoxes, detection_truth
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS, detection_matches, detection_protocol
from deepaccident_devkit.evaluation.detection.boxes import BoxColumns, columns_of
from deepaccident_devkit.evaluation.detection.matching import frame_counts, match_errors
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


def test_released_errors_of_places_have_three_axes() -> None:
    def columns(center: tuple[float, float, float]) -> BoxColumns:
        box = Boxes.from_arrays([center], size=[[4.0, 2.0, 1.5]], yaw=[0.0], frame="lidar")
        return columns_of(box)

    truth, found = columns((10.0, 5.0, 1.0)), columns((13.0, 9.0, 13.0))
    assert match_errors(found, truth, DETECTION_PROTOCOLS["released"])[0, 0] == pytest.approx(13)
    assert match_errors(found, truth, DETECTION_PROTOCOLS["paper"])[0, 0] == pytest.approx(5)


def boxes_at(*places: tuple[float, float]) -> Boxes:
    center = np.array([(*place, 0.75) for place in places]).reshape(-1, 3)
    return Boxes.from_arrays(center, np.tile((4.0, 2.0, 1.5), (len(places), 1)), np.zeros(len(places)), frame="lidar")


def detected_at(*places: tuple[float, float]) -> DetectedBoxes:
    return DetectedBoxes(boxes=boxes_at(*places), scores=np.linspace(0.9, 0.1, len(places)))


def test_the_threshold_that_is_not_given_is_that_of_the_errors_or_the_middle_one() -> None:
    expected = {"released": 2.0, "released_iou": 0.15, "paper": 2.0, "opencood": 0.5}
    assert {name: detection_matches(detected_at(), boxes_at(), name).threshold for name in expected} == expected


def test_pairs_of_which_one_is_out_of_range_are_neither_matches_nor_errors() -> None:
    """The released range ends at x = 84.85 m: the first pair has its truth beyond, the second its detection."""
    truth = boxes_at((85.5, 0), (84.0, 20), (10, 0), (30, 0))
    found = detection_matches(detected_at((84.5, 0), (85.0, 20), (50, 0), (10, 0), (40, 0)), truth, "released", 4.0)
    assert (found.detection.tolist(), found.truth.tolist()) == ([3], [2])
    assert (found.false.tolist(), found.missed.tolist()) == ([2, 4], [3])


def test_ranges_begin_with_their_first_metre_and_end_before_their_last_and_areas_have_their_edges() -> None:
    rules = detection_protocol(
        "paper", ranges=((0.0, 30.0), (30.0, 50.0)), area=(-30.0, 31.0, -49.9, 50.0), error_threshold=None
    )
    places = [(0, 0), (18, 24), (-30, 40), (-30, 0), (31, 0), (0, -49.9), (0, 50.0), (0, 29.9), (9, 40), (-31, 0)]
    rows = [detection_matches(detected_at(place), boxes_at(place), rules, 4.0).truth.tolist() for place in places]
    assert rows == [[0], [0], [], [0], [0], [0], [], [0], [0], []]
    edges = detection_protocol(rules, ranges=((0.0, 99.0),))
    rows = [detection_matches(detected_at(place), boxes_at(place), edges, 4.0).truth.tolist() for place in places]
    assert rows == [[0]] * 9 + [[]]
    counts = frame_counts(columns_of(detected_at(*places).boxes), columns_of(boxes_at(*places)), rules)
    assert counts["truths"][:2] == [2, 5]
