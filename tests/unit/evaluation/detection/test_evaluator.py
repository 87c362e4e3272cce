"""Detection metrics on cases whose numbers can be told by hand, and the evaluator around them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS, DetectedBoxes, DetectionEvaluator
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

SIZE = (4.0, 2.0, 1.5)
PROTOCOLS = sorted(DETECTION_PROTOCOLS)


def truth_at(*places: tuple[float, float], category: str = "car", **columns) -> Boxes:
    count = len(places)
    center = np.array([(*place, 0.75) for place in places]).reshape(count, 3)
    columns = {"velocity": np.zeros((count, 3)), **columns}
    return Boxes.from_arrays(
        center, np.tile(SIZE, (count, 1)), np.zeros(count), frame="lidar", category=[category] * count, **columns
    )


def found_at(*places: tuple[float, float, float], category: str = "car", **columns) -> DetectedBoxes:
    """Boxes at x, y with a score each."""
    boxes = truth_at(*(place[:2] for place in places), category=category, **columns)
    return DetectedBoxes(boxes=boxes, scores=np.array([place[2] for place in places]))


def evaluated(protocol: str, *samples: tuple[DetectedBoxes, Boxes], **switches) -> DetectionEvaluator:
    evaluator = DetectionEvaluator(protocol, **switches)
    for number, (prediction, truth) in enumerate(samples):
        evaluator.update(f"s/ego_vehicle/{number:03d}", prediction, truth)
    return evaluator


def perfect(truth: Boxes) -> DetectedBoxes:
    return DetectedBoxes(boxes=truth, scores=np.linspace(0.9, 0.1, len(truth)))


def two_samples(protocol: str = "released") -> DetectionEvaluator:
    first = found_at((10, 0, 0.9), (20, 0, 0.5)), truth_at((10.3, 0), (20.2, 0))
    second = found_at((10, 0, 0.8), (-20, 0, 0.7)), truth_at((10.2, 0))
    return evaluated(protocol, first, second)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_saved_counts_go_on(protocol: str, tmp_path: Path) -> None:
    whole = two_samples(protocol)
    again = DetectionEvaluator(protocol).resume(whole.save(tmp_path / "counts.json"))
    assert again.counts == whole.counts
    assert again.merge(whole).repeated == whole.tokens


@pytest.mark.parametrize("protocol", ["paper", "opencood"])
def test_perfect_predictions_score_100(protocol: str) -> None:
    truths = [truth_at((10, 0), (20, 5), (-30, -8)), truth_at((5, 5))]
    result = evaluated(protocol, *((perfect(truth), truth) for truth in truths)).compute()
    assert result.class_average_precision[result.classes[0]] == 100
    assert result.mean_average_precision == 100
    if protocol == "paper":
        assert list(result.mean_errors.values()) == [0, 0, 0, 0]


def test_the_released_code_gives_perfect_predictions_less_than_100() -> None:
    """Sums of 1/40 in double precision end above 1, which no recall exceeds: the last of 36 points is never reached."""
    truth = truth_at((10, 0), (20, 5), (-30, -8))
    result = evaluated("released", (perfect(truth), truth)).compute()
    assert result.average_precision[0, 0].tolist() == pytest.approx([100 * 35 / 36] * 4)
    assert result.errors[0].tolist() == pytest.approx([1 / 36] * 4)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_nothing_there_and_no_samples(protocol: str) -> None:
    zero = DETECTION_PROTOCOLS[protocol].absent_class_is_zero
    for evaluator in (evaluated(protocol, (found_at(), truth_at())), DetectionEvaluator(protocol)):
        mean = evaluator.compute().mean_average_precision
        assert mean == 0 if zero else math.isnan(mean)
        assert json.dumps(evaluator.compute().as_dict(), allow_nan=False)


def test_an_ignored_detection_uses_up_the_truth() -> None:
    """Beyond |x| = 84.85 m nothing counts, but it takes part: the near truth is neither found nor missed."""
    truth = truth_at((84.0, 0), (10, 0))
    taken = evaluated("released", (found_at((85.0, 0, 0.9), (10, 0, 0.5)), truth)).compute()
    assert taken.detections[0, 0] == 1
    # at 2 m and 4 m recall is 1 of 1: of two truths one is excused
    assert taken.recall[0, 0, 2, 0] == 1.0
    assert taken.recall[0, 0, 1, 0] == 0.5
    assert taken.precision[0, 0, :, 0].tolist() == [1, 1, 1, 1]


def test_a_detection_that_counts_goes_before_an_ignored_one() -> None:
    truth = truth_at((84.0, 0))
    both = found_at((85.0, 0, 0.9), (83.0, 1.0, 0.5))
    result = evaluated("released", (both, truth)).compute()
    # at 2 m the score pass gives the truth to the ignored one: no match, no points
    assert result.average_precision[0, 0, 2] == 0
    one = evaluated("released", (found_at((85.0, 0, 0.4), (83.0, 1.0, 0.5)), truth)).compute()
    assert one.recall[0, 0, 2, 0] == 1.0


def test_a_detection_of_a_truth_that_does_not_count_is_no_false_alarm() -> None:
    """The other way round: the detection is within |x| = 84.85 m, its truth beyond."""
    found = found_at((84.5, 0, 0.9), (10, 0, 0.5)), truth_at((85.5, 0), (10, 0))
    result = evaluated("released", found).compute()
    assert (result.truths[0, 0], result.detections[0, 0]) == (1, 2)
    assert result.precision[0, 0, :, 0].tolist() == [0.5, 0.5, 1, 1]  # at 2 m and 4 m the two match


def test_the_released_range_is_of_x_alone() -> None:
    truth = truth_at((10, 200))
    assert evaluated("released", (perfect(truth), truth)).compute().truths[0, 0] == 1
    assert evaluated("released", (perfect(truth), truth), range_from_x_alone=False).compute().truths[0, 0] == 0


def test_the_paper_counts_within_its_area_and_without_the_own_box() -> None:
    truth = truth_at((10, 0), (51.3, 0), (0, -51.3), (0, 0), actor_id=[1, 2, 3, OWN_ACTOR_ID])
    result = evaluated("paper", (found_at((10, 0, 0.5), (60, 0, 0.9)), truth)).compute()
    assert (result.truths[0, 0], result.detections[0, 0]) == (1, 1)
    assert result.mean_average_precision == 100
    assert evaluated("paper", (found_at(), truth), own_box=True).compute().truths[0, 0] == 2
    assert evaluated("paper", (found_at(), truth), area=None).compute().truths[0, 0] == 3


def test_the_papers_thresholds_are_strict_and_on_the_ground() -> None:
    high = Boxes.from_arrays([[10, 1.0, 9]], [SIZE], [0.0], frame="lidar")
    prediction = DetectedBoxes(boxes=high, scores=[1.0])
    result = evaluated("paper", (prediction, truth_at((10, 0)))).compute()
    assert result.average_precision[0, 0].tolist() == [0, 100, 100]
    assert evaluated("released", (prediction, truth_at((10, 0)))).compute().average_precision[0].max() == 0


def test_errors_of_the_paper() -> None:
    truth = truth_at((10, 0), velocity=[[3.0, 0, 0]])
    boxes = Boxes.from_arrays(
        [[10.3, 0.4, 0.75]], [[4, 2, 3.0]], [-3.0], frame="lidar", velocity=[[0.0, 4.0, 0]], category=["car"]
    )
    result = evaluated("paper", (DetectedBoxes(boxes=boxes, scores=[0.5]), truth)).compute()
    assert result.errors[0].tolist() == pytest.approx([0.5, 0.5, 3.0, 5.0])
    wrapped = Boxes.from_arrays([[10, 0, 0.75]], [SIZE], [3.0], frame="lidar", velocity=[[0.0, 0, 0]])
    other = evaluated("paper", (DetectedBoxes(boxes=boxes, scores=[0.5]), wrapped)).compute()
    assert other.errors[0, 2] == pytest.approx(2 * math.pi - 6)


def test_the_released_heading_error_is_not_wrapped_and_its_scale_error_not_aligned() -> None:
    truth = Boxes.from_arrays([[10, 0, 0.75]], [SIZE], [0.1], frame="lidar", velocity=[[math.nan] * 3])
    prediction = DetectedBoxes.from_arrays([[11, 0, 0.75]], [SIZE], [-0.1], [0.5], velocity=[[3.0, 4.0]], frame="lidar")
    errors = evaluated("released", (prediction, truth)).compute().errors[0]
    reached = errors - 1 / 36  # one point of 36 is never reached, and counts as 1
    overlap = 1 - 1.0 * 36 / 35 * reached[1]
    assert reached[0] * 36 / 35 == pytest.approx(1.0)
    assert 0.4 < overlap < 0.65
    assert reached[2] * 36 / 35 == pytest.approx(6.2831852 - 0.2, abs=1e-6)
    assert reached[3] * 36 / 35 == pytest.approx(5.0)  # an unknown true velocity is one of 0


def test_of_several_true_velocities_those_not_known_are_0() -> None:
    truth = truth_at((10, 0), (30, 0), velocity=[[math.nan] * 3, [0.0, 0.0, 0.0]])
    result = evaluated("released", (found_at((10, 0, 0.9), (30, 0, 0.5)), truth)).compute()
    assert result.errors[0].tolist() == pytest.approx([1 / 36] * 4)


def test_velocities_that_a_detector_does_not_give() -> None:
    truth = truth_at((10, 0))
    prediction = DetectedBoxes.from_arrays(truth.center, truth.size, truth.yaw, [0.5], frame="lidar")
    evaluator = evaluated("paper", (prediction, truth))
    result = evaluator.compute()
    assert math.isnan(result.mean_errors["AVE"])
    assert result.as_dict()["mAVE"] is None
    evaluator.update("s/ego_vehicle/000", prediction, truth)  # the same once more: unknown equals unknown
    assert evaluator.repeated == {"s/ego_vehicle/000"}


def test_opencood_has_one_vehicle_class_and_includes_the_threshold() -> None:
    truth = truth_at((10, 0), category="truck")
    half = DetectedBoxes(
        boxes=Boxes.from_arrays([[10, 0, 0.75]], [[2, 2, 1.5]], [0.0], frame="lidar", category=["van"]), scores=[0.5]
    )
    result = evaluated("opencood", (half, truth)).compute()
    assert result.classes == ("vehicle",)
    assert result.average_precision[0, 0].tolist() == [100, 100, 0]
    people = truth_at((10, 0), category="pedestrian")
    assert evaluated("opencood", (perfect(people), people)).compute().truths[0, 0] == 0


def test_opencood_counts_boxes_that_are_wholly_in_range() -> None:
    truth = truth_at((138.1, 0), (137.9, 0))
    assert evaluated("opencood", (perfect(truth), truth)).compute().truths[0, 0] == 1


def test_a_box_of_which_a_corner_is_out_of_range_does_not_count() -> None:
    """Turned by 45°, a car of 4 × 2 m reaches 2.12 m along each axis, with another corner each time."""
    for reach, counted in ((1.8, 0), (2.2, 4)):
        places = (140 - reach, 0), (reach - 140, 0), (0, 40 - reach), (0, reach - 40)
        center = np.array([(*place, 0.75) for place in places])
        truth = Boxes.from_arrays(center, np.tile(SIZE, (4, 1)), np.full(4, np.pi / 4), frame="lidar")
        assert evaluated("opencood", (perfect(truth), truth)).compute().truths[0, 0] == counted


def test_beyond_the_recall_that_is_reached_opencoods_precision_is_0() -> None:
    result = evaluated("opencood", (found_at((10, 0, 0.9)), truth_at((10, 0), (30, 0)))).compute()
    precision = result.precision[0, 0, 0]
    assert (precision[0], precision[-1]) == (1, 0)


@pytest.mark.parametrize(("found", "error"), [(10, 1), (11, 0)])
def test_errors_of_the_paper_begin_where_recall_exceeds_a_tenth(found: int, error: int) -> None:
    places = [(9.0 * row - 45, 9.0 * column - 45) for row in range(10) for column in range(10)]
    prediction = found_at(*((*place, 0.9) for place in places[:found]))
    assert evaluated("paper", (prediction, truth_at(*places))).compute().errors[0].tolist() == [error] * 4


def test_errors_of_the_paper_are_means_over_the_points_of_recall_that_are_reached() -> None:
    """Of 100 cars 12 are found, the least sure one 1.2 m off: 0 on average up to recall 0.11, 0.1 m up to 0.12."""
    places = [(9.0 * row - 45, 9.0 * column - 45) for row in range(10) for column in range(10)]
    found = [(x, y + 1.2 * (rank == 11), 0.9 - 0.01 * rank) for rank, (x, y) in enumerate(places[:12])]
    result = evaluated("paper", (found_at(*found), truth_at(*places))).compute()
    assert result.errors[0, 0] == pytest.approx(0.05)


def test_scores_sorted_over_all_samples_or_by_sample() -> None:
    """A bad detection of low score in the first sample stands before a good one of the second."""
    first = found_at((10, 0, 0.9), (30, 0, 0.1)), truth_at((10, 0))
    second = found_at((10, 0, 0.8)), truth_at((10, 0))
    assert evaluated("opencood", first, second).compute().average_precision[0, 0, 1] == 100
    by_sample = evaluated("opencood", first, second, global_sort=False).compute()
    assert by_sample.average_precision[0, 0, 1] == pytest.approx(100 * (1 / 2 + 2 / 3 / 2))


def test_classes_that_are_nowhere() -> None:
    truth = truth_at((10, 0))
    prediction = found_at((10, 0, 0.5), (20, 0, 0.5))
    left_out = evaluated("paper", (prediction, truth)).compute()
    assert math.isnan(left_out.class_average_precision["van"])
    nobody = evaluated("opencood", (found_at(), truth_at()), absent_class_is_zero=True).compute()
    assert nobody.mean_average_precision == 0
    counted = evaluated("paper", (prediction, truth), absent_class_is_zero=True).compute()
    assert counted.mean_average_precision == pytest.approx(left_out.mean_average_precision / 6)


def test_boxes_of_another_frame_are_refused() -> None:
    with pytest.raises(GeometryError, match="the protocol counts in 'lidar'"):
        DetectionEvaluator().update("a", found_at(), Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), []))


def test_detected_boxes_are_checked_and_read_only() -> None:
    assert_refused(
        (lambda: DetectedBoxes(boxes=truth_at((1, 1)), scores=[0.5, 0.6]), GeometryError, "scores"),
        (lambda: found_at((1, 1, math.nan)), GeometryError, "not all numbers are finite"),
    )
    detected = found_at((1, 1, 0.5))
    with pytest.raises(ValueError, match="read-only"):
        detected.scores[0] = 1
    assert len(detected) == 1
