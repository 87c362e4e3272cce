"""Detection metrics on cases with numbers computed by hand, their evaluator, and matched boxes."""

import json
import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.evaluation.detection import (
    DETECTION_PROTOCOLS,
    DetectedBoxes,
    DetectionEvaluator,
    DetectionMatches,
    DetectionResult,
    detection_matches,
    detection_protocol,
    detection_truth,
)
from deepaccident_devkit.evaluation.detection.boxes import columns_of
from deepaccident_devkit.evaluation.detection.matching import frame_counts
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, SMALL_CATEGORIES

SIZE_M = (4.0, 2.0, 1.5)


def make_truth(
    *positions: tuple[float, float],
    category: str = "car",
    size: Any = SIZE_M,
    yaw: float = 0.0,
    **columns,
) -> Boxes:
    """Make boxes on the ground, which stand unless `columns` differ; velocity None for unknown."""
    count = len(positions)
    center = np.array([(*position, 0.75) for position in positions]).reshape(
        count,
        3,
    )
    columns = {
        "velocity": np.zeros((count, 3)),
        "category": [category] * count,
        **columns,
    }
    return Boxes.from_arrays(
        center,
        np.tile(size, (count, 1)),
        np.full(count, yaw),
        frame="lidar",
        **{name: values for name, values in columns.items() if values is not None},
    )


def make_detections(*positions: tuple[float, float, float], **columns) -> DetectedBoxes:
    """Make a box at each x and y, with a score."""
    return DetectedBoxes(
        boxes=make_truth(*((x, y) for x, y, _ in positions), **columns),
        scores=np.array([score for _, _, score in positions]),
    )


def evaluate(
    protocol: str, *samples: tuple[DetectedBoxes, Boxes], **switches
) -> DetectionEvaluator:
    evaluator = DetectionEvaluator(protocol, **switches)
    for number, (prediction, truth) in enumerate(samples):
        evaluator.update(f"s/ego_vehicle/{number:03d}", prediction, truth)
    return evaluator


def detect_all(truth: Boxes) -> tuple[DetectedBoxes, Boxes]:
    return DetectedBoxes(boxes=truth, scores=np.linspace(0.9, 0.1, len(truth))), truth


def read_numbers(result: DetectionResult) -> dict[str, Any]:
    """Return numbers of the first class and range, and of the first point for all thresholds."""
    return {
        "mAP": result.mean_average_precision,
        "AP": result.average_precision[0, 0].tolist(),
        "precision": result.precision[0, 0, :, 0].tolist(),
        "recall": result.recall[0, 0, :, 0].tolist(),
        "errors": result.errors[0].tolist(),
        "counted": [int(result.truths[0, 0]), int(result.detections[0, 0])],
    }


THREE = make_truth((10, 0), (20, 5), (-30, -8))
OWN = make_truth((10, 0), (51.3, 0), (0, -51.3), (0, 0), actor_id=[1, 2, 3, OWN_ACTOR_ID])
HIGH = Boxes.from_arrays([[10, 1.0, 9]], [SIZE_M], [0.0], frame="lidar")
TURNED = make_detections((10.3, 0.4, 0.5), size=(4, 2, 3.0), yaw=-3.0, velocity=[[0.0, 4.0, 0]])
TURNED_TRUTH = make_truth((10, 0), velocity=[[3.0, 0, 0]])
HALF_VAN = make_detections((10, 0, 0.5), size=(2, 2, 1.5), category="van")
GRID = [(9.0 * row - 45, 9.0 * column - 45) for row in range(10) for column in range(10)]
FIRST = make_detections((10, 0, 0.9), (30, 0, 0.1)), make_truth((10, 0))
SECOND = make_detections((10, 0, 0.8)), make_truth((10, 0))
ONE_TOO_MANY = make_detections((10, 0, 0.5), (20, 0, 0.4)), make_truth((10, 0))
# Sums of 1/40 in double precision end above 1, which no recall exceeds: the last of 36 points is
# never reached, and counts as 0 in precision and as 1 in errors.
UNREACHED = 1 / 36
REACHED = 35 / 36


@pytest.mark.parametrize(
    ("protocol", "samples", "switches", "expected"),
    [
        (
            "paper",
            [detect_all(THREE), detect_all(make_truth((5, 5)))],
            {},
            {"mAP": 100, "errors": [0] * 4, "counted": [4, 4]},
        ),
        (
            "opencood",
            [detect_all(THREE), detect_all(make_truth((5, 5)))],
            {},
            {"mAP": 100, "AP": [100] * 3},
        ),
        (
            "released",
            [detect_all(THREE)],
            {},
            {"AP": [100 * REACHED] * 4, "errors": [UNREACHED] * 4, "mAP": 100 * REACHED / 6},
        ),
        # beyond |x| = 84.85 m a detection does not count, but it uses up the truth, which is then
        # neither found nor missed
        (
            "released",
            [(make_detections((85.0, 0, 0.9), (10, 0, 0.5)), make_truth((84.0, 0), (10, 0)))],
            {},
            {"counted": [2, 1], "precision": [1] * 4, "recall": [0.5, 0.5, 1, 1]},
        ),
        # at 2 m the score pass gives the truth to the detection that does not count: no match
        (
            "released",
            [(make_detections((85.0, 0, 0.9), (83.0, 1.0, 0.5)), make_truth((84.0, 0)))],
            {},
            {"AP": [0] * 4, "errors": [1] * 4},
        ),
        # a detection that counts goes before one that does not
        (
            "released",
            [(make_detections((85.0, 0, 0.4), (83.0, 1.0, 0.5)), make_truth((84.0, 0)))],
            {},
            {"recall": [0, 0, 1, 1], "AP": [0, 0, 100 * REACHED, 100 * REACHED]},
        ),
        # the other way round: at 2 m and 4 m the two match, and there is no false alarm
        (
            "released",
            [(make_detections((84.5, 0, 0.9), (10, 0, 0.5)), make_truth((85.5, 0), (10, 0)))],
            {},
            {"counted": [1, 2], "precision": [0.5, 0.5, 1, 1]},
        ),
        # only x counts for the range
        ("released", [detect_all(make_truth((10, 200)))], {}, {"counted": [1, 1]}),
        (
            "released",
            [detect_all(make_truth((10, 200)))],
            {"range_from_x_alone": False},
            {"counted": [0, 0]},
        ),
        (
            "paper",
            [(make_detections((10, 0, 0.5), (60, 0, 0.9)), OWN)],
            {},
            {"counted": [1, 1], "mAP": 100},
        ),
        ("paper", [(make_detections(), OWN)], {"own_box": True}, {"counted": [2, 0]}),
        ("paper", [(make_detections(), OWN)], {"area": None}, {"counted": [3, 0]}),
        # 1 m is not less than 1 m
        (
            "paper",
            [(DetectedBoxes(boxes=HIGH, scores=[1.0]), make_truth((10, 0)))],
            {},
            {"AP": [0, 100, 100]},
        ),
        (
            "released",
            [(DetectedBoxes(boxes=HIGH, scores=[1.0]), make_truth((10, 0)))],
            {},
            {"AP": [0] * 4},
        ),
        ("paper", [(TURNED, TURNED_TRUTH)], {}, {"errors": [0.5, 0.5, 3, 5]}),
        (
            "paper",
            [(TURNED, make_truth((10, 0), yaw=3.0))],
            {},
            {"errors": [0.5, 0.5, 2 * math.pi - 6, 4]},
        ),
        # the heading is not wrapped, the scale not aligned, and an unknown true velocity is 0
        (
            "released",
            [
                (
                    make_detections((11, 0, 0.5), yaw=-0.1, velocity=[[3.0, 4.0, 0]]),
                    make_truth((10, 0), yaw=0.1, velocity=None),
                )
            ],
            {},
            {
                "errors": [
                    1,
                    0.462387148 * REACHED + UNREACHED,
                    (6.2831852 - 0.2) * REACHED + UNREACHED,
                    5 * REACHED + UNREACHED,
                ]
            },
        ),
        # unknown true velocities among known ones are 0, too
        (
            "released",
            [
                (
                    make_detections((10, 0, 0.9), (30, 0, 0.5)),
                    make_truth((10, 0), (30, 0), velocity=[[math.nan] * 3, [0.0] * 3]),
                )
            ],
            {},
            {"errors": [UNREACHED] * 4},
        ),
        (
            "paper",
            [(make_detections((10, 0, 0.5), velocity=None), make_truth((10, 0)))],
            {},
            {"errors": [0, 0, 0, math.nan]},
        ),
        (
            "opencood",
            # an overlap of exactly the threshold is enough
            [(HALF_VAN, make_truth((10, 0), category="truck"))],
            {},
            {"AP": [100, 100, 0]},
        ),
        (
            "opencood",
            [detect_all(make_truth((10, 0), category="pedestrian"))],
            {},
            {"counted": [0, 0]},
        ),
        (
            "opencood",
            # only boxes wholly in range count
            [detect_all(make_truth((138.1, 0), (137.9, 0)))],
            {},
            {"counted": [1, 1]},
        ),
        (
            "opencood",
            [(make_detections((10, 0, 0.9)), make_truth((10, 0), (30, 0)))],
            {},
            {"AP": [50] * 3},
        ),
        (
            "paper",
            [(make_detections(*((*position, 0.9) for position in GRID[:10])), make_truth(*GRID))],
            {},
            {"errors": [1] * 4},
        ),
        (
            "paper",
            [(make_detections(*((*position, 0.9) for position in GRID[:11])), make_truth(*GRID))],
            {},
            {"errors": [0] * 4},
        ),
        # 12 of 100 are found, the least sure one 1.2 m off: the mean error is 0 up to recall 0.11,
        # and 0.1 m up to 0.12
        (
            "paper",
            [
                (
                    make_detections(
                        *((x, y, 0.9 - index / 100) for index, (x, y) in enumerate(GRID[:11])),
                        (GRID[11][0], GRID[11][1] + 1.2, 0.9 - 11 / 100),
                    ),
                    make_truth(*GRID),
                )
            ],
            {},
            {"errors": [0.05, 0, 0, 0]},
        ),
        # detections are ordered by all scores, or sample by sample
        ("opencood", [FIRST, SECOND], {}, {"AP": [100] * 3}),
        (
            "opencood",
            [FIRST, SECOND],
            {"global_sort": False},
            {"AP": [100 * (1 / 2 + 2 / 3 / 2)] * 3},
        ),
        (
            "opencood",
            [(make_detections(), make_truth())],
            {"absent_class_is_zero": True},
            {"mAP": 0},
        ),
        # at a recall of 1 the precision is that of all detections
        ("paper", [ONE_TOO_MANY], {}, {"mAP": 99.382716}),
        ("paper", [ONE_TOO_MANY], {"absent_class_is_zero": True}, {"mAP": 99.382716 / 6}),
    ],
)
def test_numbers_computed_by_hand(protocol, samples, switches, expected) -> None:
    numbers = read_numbers(evaluate(protocol, *samples, **switches).compute())
    for name, value in expected.items():
        assert numbers[name] == pytest.approx(value, abs=1e-6, nan_ok=True), name


@pytest.mark.parametrize("category", CATEGORIES)
def test_small_classes_have_thresholds_of_their_own(category: str) -> None:
    """The boxes overlap by a little more than one of the thresholds."""
    rows = []
    for overlap in (0.31, 0.21, 0.16, 0.11, 0.09):
        shift_m = 4 * (1 - overlap) / (1 + overlap)
        sample = (
            make_detections((10 + shift_m, 0, 0.5), category=category),
            make_truth((10, 0), category=category),
        )
        precision = evaluate("released_iou", sample).compute().average_precision
        rows.append((precision[CATEGORIES.index(category), 0] > 0).tolist())

    both, one, none = [True, True], [False, True], [False, False]
    if category in SMALL_CATEGORIES:
        assert rows == [both, both, one, one, none]
    else:
        assert rows == [both, one, one, none, none]


@pytest.mark.parametrize("protocol", sorted(DETECTION_PROTOCOLS))
def test_without_boxes_and_without_samples(protocol: str) -> None:
    empty_sample = (make_detections(), make_truth())
    for evaluator in (evaluate(protocol, empty_sample), DetectionEvaluator(protocol)):
        mean = evaluator.compute().mean_average_precision
        if DETECTION_PROTOCOLS[protocol].absent_class_is_zero:
            assert mean == 0
        else:
            assert math.isnan(mean)
        assert json.dumps(evaluator.compute().as_dict(), allow_nan=False)


def test_what_a_result_holds() -> None:
    samples = [
        (make_detections((10, 0, 0.9), (20, 0, 0.5)), make_truth((10.3, 0), (20.2, 0))),
        (make_detections((10, 0, 0.8), (-20, 0, 0.7)), make_truth((10.2, 0))),
    ]
    result = evaluate("paper", *samples).compute()
    car = {
        "thresholds": [1.0, 2.0, 4.0],
        "AP": [[pytest.approx(87.7746913580)] * 3],
        "mean_AP": pytest.approx(87.7746913580),
        "ATE": pytest.approx(0.2677259259),
        **dict.fromkeys(("ASE", "AOE", "AVE"), pytest.approx(0, abs=1e-9)),
        "truths": [3],
        "detections": [4],
    }
    absent = {
        "thresholds": [1.0, 2.0, 4.0],
        "AP": [[None] * 3],
        **dict.fromkeys(("mean_AP", "ATE", "ASE", "AOE", "AVE")),
        "truths": [0],
        "detections": [0],
    }
    assert result.as_dict() == {
        "samples": 2,
        "ranges": [[0.0, None]],
        "mAP": car["mean_AP"],
        **{f"m{name}": car[name] for name in ("ATE", "ASE", "AOE", "AVE")},
        "classes": {"car": car} | dict.fromkeys(CATEGORIES[1:], absent),
    }
    assert result.precision.shape == (6, 1, 3, 101)
    assert_array_equal(result.recall[0, 0, 0], np.linspace(0, 1, 101))

    one_of_two = (make_detections((10, 0, 0.9)), make_truth((10, 0), (30, 0)))
    opencood = evaluate("opencood", one_of_two).compute()
    assert opencood.classes == ("vehicle",)
    # beyond the recall that is reached the precision is 0
    assert opencood.precision[0, 0, 0].tolist() == [1.0] * 51 + [0.0] * 50


def test_a_box_with_a_corner_out_of_range_does_not_count() -> None:
    """Turned by 45°, a car of 4 × 2 m reaches 2.12 m along each axis, with another corner each
    time.
    """
    for reach, count in ((1.8, 0), (2.2, 4)):
        x, y = 140 - reach, 40 - reach
        truth = make_truth(
            (x, 0),
            (-x, 0),
            (0, y),
            (0, -y),
            yaw=math.pi / 4,
        )
        assert evaluate("opencood", detect_all(truth)).compute().truths[0, 0] == count


def test_unknown_velocities_are_equal() -> None:
    sample = (make_detections((10, 0, 0.5), velocity=None), make_truth((10, 0)))
    evaluator = evaluate("paper", sample)
    evaluator.update("s/ego_vehicle/000", *sample)
    assert evaluator.repeated == {"s/ego_vehicle/000"}
    assert evaluator.compute().as_dict()["mAVE"] is None


@pytest.mark.parametrize("protocol", DETECTION_PROTOCOLS)
def test_detections_match_as_they_are_counted(da_b: DeepAccident, protocol: str) -> None:
    """All detections arrive, so that the sums that are counted by arrival are the matches."""
    rules = DETECTION_PROTOCOLS[protocol]
    truth = detection_truth(
        da_b,
        da_b.sample[0]["token"],
        rules,
    )
    random = np.random.default_rng(1)
    rows = np.flatnonzero(random.random(len(truth)) < 0.7)
    noise = random.normal(0, 0.4, (len(rows), 3)) * (1, 1, 0)
    near = truth.center[rows] + noise
    far = truth.center[rows] + (9.0, 9.0, 0.0)
    detected = DetectedBoxes.from_arrays(
        np.vstack([near, far]),
        np.tile(truth.size[rows], (2, 1)),
        np.tile(truth.yaw[rows], 2),
        random.random(2 * len(rows)),
        category=np.tile(truth.category[rows], 2),
        frame=rules.frame,
    )

    counts = frame_counts(
        columns_of(detected.boxes, detected.scores),
        columns_of(truth),
        rules,
    )

    levels = np.array(counts["tp"][0], dtype=int) % len(rules.thresholds)
    for level, threshold in enumerate(rules.thresholds):
        matches = detection_matches(detected, truth, rules, threshold)
        assert len(matches.detection) == np.sum(levels == level)
        if rules.matching == "by_score":
            assert len(matches.detection) + len(matches.missed) == sum(counts["truths"])
            assert len(matches.detection) + len(matches.false) == len(counts["detections"][0])
        assert_array_equal(
            detected.boxes.category[matches.detection],
            truth.category[matches.truth],
        )
        assert len(np.unique(matches.truth)) == len(matches.truth)
        assert not np.isin(matches.truth, matches.missed).any()
        assert not np.isin(matches.detection, matches.false).any()


def detect_positions(*positions: tuple[float, float]) -> DetectedBoxes:
    return detect_all(make_truth(*positions))[0]


@pytest.mark.parametrize("protocol", DETECTION_PROTOCOLS)
@pytest.mark.parametrize("nearest", [0, 1])
def test_the_nearest_of_several_near_boxes_is_matched(protocol: str, nearest: int) -> None:
    """A detection looks for its true box or, in the released way, a true box for its detection:
    here one box has a choice of two.
    """
    rules = DETECTION_PROTOCOLS[protocol]
    by_score = rules.matching == "by_score"
    single = [(10.0, 0.0)]
    pair = [(10.3, 0.0), (10.3, 0.0)]
    pair[nearest] = (10.1, 0.0)
    detected, true = (single, pair) if by_score else (pair, single)

    matches = detection_matches(
        make_detections(*((x, y, 1.0) for x, y in detected)),
        make_truth(*true),
        rules,
        rules.thresholds[0],
    )

    assert (matches.truth if by_score else matches.detection).tolist() == [nearest]


def test_the_default_threshold_is_that_of_the_errors_or_the_middle_one() -> None:
    expected = {"released": 2.0, "released_iou": 0.15, "paper": 2.0, "opencood": 0.5}
    for protocol, threshold in expected.items():
        matches = detection_matches(detect_positions(), make_truth(), protocol)
        assert matches.threshold == threshold


def test_pairs_with_one_box_out_of_range_are_neither_matches_nor_errors() -> None:
    """The released range ends at x = 84.85 m: the first pair has its truth beyond it, the second
    its detection.
    """
    matches = detection_matches(
        detect_positions((84.5, 0), (85.0, 20), (50, 0), (10, 0), (40, 0)),
        make_truth((85.5, 0), (84.0, 20), (10, 0), (30, 0)),
        "released",
        4.0,
    )
    assert_indices(matches, detection=[3], truth=[2], false=[2, 4], missed=[3])


def assert_indices(matches: DetectionMatches, **expected: list[int]) -> None:
    assert {name: getattr(matches, name).tolist() for name in expected} == expected


def test_matches_are_within_one_ring() -> None:
    rules = detection_protocol(
        "paper",
        ranges=((0.0, 30.0), (30.0, 50.0)),
        area=(-30.0, 31.0, -49.9, 50.0),
        error_threshold=None,
    )
    is_inside = {
        (0, 0): True,
        (18, 24): True,
        (-30, 40): False,
        (-30, 0): True,
        (31, 0): True,
        (0, -49.9): True,
        (0, 50.0): False,
        (0, 29.9): True,
        (9, 40): True,
        (-31, 0): False,
    }
    for position, expected in is_inside.items():
        matches = detection_matches(detect_positions(position), make_truth(position), rules, 4.0)
        assert matches.truth.tolist() == ([0] if expected else []), position

    matches = detection_matches(
        detect_positions((0, 29), (0, 40)), make_truth((0, 30.5), (0, 41)), rules, 4.0
    )
    assert_indices(matches, detection=[1], truth=[1], false=[0], missed=[0])


def test_what_cannot_be_compared() -> None:
    world_boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
    world_detections = DetectedBoxes(boxes=world_boxes, scores=[])
    assert_raises(
        (
            lambda: DetectionEvaluator().update("a", make_detections(), world_boxes),
            GeometryError,
            ("a: truth", "'lidar'"),
        ),
        (
            lambda: DetectionEvaluator().update("a", world_detections, make_truth()),
            GeometryError,
            ("a: prediction", "'lidar'"),
        ),
        (
            lambda: detection_matches(detect_positions(), make_truth(), "paper", 77),
            ChoiceError,
            ("threshold", "1.0, 2.0, 4.0", "77"),
        ),
    )
