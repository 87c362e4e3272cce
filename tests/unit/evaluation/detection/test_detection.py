"""Detection metrics on cases whose numbers can be told by hand, the evaluator around them, and who
is matched.
"""

import json
import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.evaluation.detection import (
    DETECTION_PROTOCOLS,
    DetectedBoxes,
    DetectionEvaluator,
    DetectionResult,
    detection_matches,
    detection_protocol,
    detection_truth,
)
from deepaccident_devkit.evaluation.detection.boxes import columns_of
from deepaccident_devkit.evaluation.detection.matching import frame_counts
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, SMALL_CATEGORIES

SIZE = (4.0, 2.0, 1.5)
PROTOCOLS = sorted(DETECTION_PROTOCOLS)


def truth_at(
    *places: tuple[float, float],
    category: str = "car",
    size: Any = SIZE,
    yaw: float = 0.0,
    **columns,
) -> Boxes:
    """On the ground, standing if nothing else is said; velocity None for unknown."""
    count = len(places)
    center = np.array([(*place, 0.75) for place in places]).reshape(count, 3)
    columns = {"velocity": np.zeros((count, 3)), "category": [category] * count, **columns}
    columns = {name: each for name, each in columns.items() if each is not None}
    return Boxes.from_arrays(
        center, np.tile(size, (count, 1)), np.full(count, yaw), frame="lidar", **columns
    )


def found_at(*places: tuple[float, float, float], **columns) -> DetectedBoxes:
    """Boxes at x, y with a score each."""
    boxes = truth_at(*(place[:2] for place in places), **columns)
    return DetectedBoxes(boxes=boxes, scores=np.array([place[2] for place in places]))


def evaluated(
    protocol: str, *samples: tuple[DetectedBoxes, Boxes], **switches
) -> DetectionEvaluator:
    evaluator = DetectionEvaluator(protocol, **switches)
    for number, (prediction, truth) in enumerate(samples):
        evaluator.update(f"s/ego_vehicle/{number:03d}", prediction, truth)
    return evaluator


def perfect(truth: Boxes) -> tuple[DetectedBoxes, Boxes]:
    return DetectedBoxes(boxes=truth, scores=np.linspace(0.9, 0.1, len(truth))), truth


def shown(result: DetectionResult) -> dict[str, Any]:
    """Of the first class and range; precision and recall at the first point, at all thresholds."""
    return {
        "mAP": result.mean_average_precision,
        "AP": result.average_precision[0, 0].tolist(),
        "precision": result.precision[0, 0, :, 0].tolist(),
        "recall": result.recall[0, 0, :, 0].tolist(),
        "errors": result.errors[0].tolist(),
        "counted": [int(result.truths[0, 0]), int(result.detections[0, 0])],
    }


THREE = truth_at((10, 0), (20, 5), (-30, -8))
OWN = truth_at((10, 0), (51.3, 0), (0, -51.3), (0, 0), actor_id=[1, 2, 3, OWN_ACTOR_ID])
HIGH = Boxes.from_arrays([[10, 1.0, 9]], [SIZE], [0.0], frame="lidar")
TURNED = found_at((10.3, 0.4, 0.5), size=(4, 2, 3.0), yaw=-3.0, velocity=[[0.0, 4.0, 0]])
TURNED_TRUTH = truth_at((10, 0), velocity=[[3.0, 0, 0]])
HALF = found_at((10, 0, 0.5), size=(2, 2, 1.5), category="van")
GRID = [(9.0 * row - 45, 9.0 * column - 45) for row in range(10) for column in range(10)]
FIRST = found_at((10, 0, 0.9), (30, 0, 0.1)), truth_at((10, 0))
SECOND = found_at((10, 0, 0.8)), truth_at((10, 0))
SPARE = found_at((10, 0, 0.5), (20, 0, 0.4)), truth_at((10, 0))
NEVER = 1 / 36
"""Sums of 1/40 in double precision end above 1, which no recall exceeds: the last of 36 points is
never reached, and counts as 0 in precision and as 1 in errors."""
ALL = 35 / 36


@pytest.mark.parametrize(
    ("protocol", "samples", "switches", "expected"),
    [
        (
            "paper",
            [perfect(THREE), perfect(truth_at((5, 5)))],
            {},
            {"mAP": 100, "errors": [0] * 4, "counted": [4, 4]},
        ),
        (
            "opencood",
            [perfect(THREE), perfect(truth_at((5, 5)))],
            {},
            {"mAP": 100, "AP": [100] * 3},
        ),
        (
            "released",
            [perfect(THREE)],
            {},
            {"AP": [100 * ALL] * 4, "errors": [NEVER] * 4, "mAP": 100 * ALL / 6},
        ),
        # beyond |x| = 84.85 m a detection does not count, but uses up the truth, neither found nor
        # missed
        (
            "released",
            [(found_at((85.0, 0, 0.9), (10, 0, 0.5)), truth_at((84.0, 0), (10, 0)))],
            {},
            {"counted": [2, 1], "precision": [1] * 4, "recall": [0.5, 0.5, 1, 1]},
        ),
        # at 2 m the score pass gives the truth to the one that does not count: no match, no points
        (
            "released",
            [(found_at((85.0, 0, 0.9), (83.0, 1.0, 0.5)), truth_at((84.0, 0)))],
            {},
            {"AP": [0] * 4, "errors": [1] * 4},
        ),
        (  # one that counts goes before one that does not
            "released",
            [(found_at((85.0, 0, 0.4), (83.0, 1.0, 0.5)), truth_at((84.0, 0)))],
            {},
            {"recall": [0, 0, 1, 1], "AP": [0, 0, 100 * ALL, 100 * ALL]},
        ),
        (  # the other way round: at 2 m and 4 m the two match, and there is no false alarm
            "released",
            [(found_at((84.5, 0, 0.9), (10, 0, 0.5)), truth_at((85.5, 0), (10, 0)))],
            {},
            {"counted": [1, 2], "precision": [0.5, 0.5, 1, 1]},
        ),
        (
            "released",
            [perfect(truth_at((10, 200)))],
            {},
            {"counted": [1, 1]},
        ),  # the range is of x alone
        (
            "released",
            [perfect(truth_at((10, 200)))],
            {"range_from_x_alone": False},
            {"counted": [0, 0]},
        ),
        (
            "paper",
            [(found_at((10, 0, 0.5), (60, 0, 0.9)), OWN)],
            {},
            {"counted": [1, 1], "mAP": 100},
        ),
        ("paper", [(found_at(), OWN)], {"own_box": True}, {"counted": [2, 0]}),
        ("paper", [(found_at(), OWN)], {"area": None}, {"counted": [3, 0]}),
        (
            "paper",
            [(DetectedBoxes(boxes=HIGH, scores=[1.0]), truth_at((10, 0)))],
            {},
            {"AP": [0, 100, 100]},
        ),  # strict
        (
            "released",
            [(DetectedBoxes(boxes=HIGH, scores=[1.0]), truth_at((10, 0)))],
            {},
            {"AP": [0] * 4},
        ),
        ("paper", [(TURNED, TURNED_TRUTH)], {}, {"errors": [0.5, 0.5, 3, 5]}),
        (
            "paper",
            [(TURNED, truth_at((10, 0), yaw=3.0))],
            {},
            {"errors": [0.5, 0.5, 2 * math.pi - 6, 4]},
        ),
        # the heading is not wrapped, the scale not aligned, and an unknown true velocity is one of
        # 0
        (
            "released",
            [
                (
                    found_at((11, 0, 0.5), yaw=-0.1, velocity=[[3.0, 4.0, 0]]),
                    truth_at((10, 0), yaw=0.1, velocity=None),
                )
            ],
            {},
            {
                "errors": [
                    1,
                    0.462387148 * ALL + NEVER,
                    (6.2831852 - 0.2) * ALL + NEVER,
                    5 * ALL + NEVER,
                ]
            },
        ),
        (  # of several true velocities those not known are 0
            "released",
            [
                (
                    found_at((10, 0, 0.9), (30, 0, 0.5)),
                    truth_at((10, 0), (30, 0), velocity=[[math.nan] * 3, [0.0] * 3]),
                )
            ],
            {},
            {"errors": [NEVER] * 4},
        ),
        (
            "paper",
            [(found_at((10, 0, 0.5), velocity=None), truth_at((10, 0)))],
            {},
            {"errors": [0, 0, 0, math.nan]},
        ),
        (
            "opencood",
            [(HALF, truth_at((10, 0), category="truck"))],
            {},
            {"AP": [100, 100, 0]},
        ),  # the threshold too
        ("opencood", [perfect(truth_at((10, 0), category="pedestrian"))], {}, {"counted": [0, 0]}),
        (
            "opencood",
            [perfect(truth_at((138.1, 0), (137.9, 0)))],
            {},
            {"counted": [1, 1]},
        ),  # wholly in range
        ("opencood", [(found_at((10, 0, 0.9)), truth_at((10, 0), (30, 0)))], {}, {"AP": [50] * 3}),
        (
            "paper",
            [(found_at(*((*place, 0.9) for place in GRID[:10])), truth_at(*GRID))],
            {},
            {"errors": [1] * 4},
        ),
        (
            "paper",
            [(found_at(*((*place, 0.9) for place in GRID[:11])), truth_at(*GRID))],
            {},
            {"errors": [0] * 4},
        ),
        # 12 of 100 are found, the least sure one 1.2 m off: 0 on average up to recall 0.11, 0.1 m
        # up to 0.12
        (
            "paper",
            [
                (
                    found_at(
                        *(
                            (x, y + 1.2 * (at == 11), 0.9 - at / 100)
                            for at, (x, y) in enumerate(GRID[:12])
                        )
                    ),
                    truth_at(*GRID),
                )
            ],
            {},
            {"errors": [0.05, 0, 0, 0]},
        ),
        ("opencood", [FIRST, SECOND], {}, {"AP": [100] * 3}),  # the order of all scores
        (
            "opencood",
            [FIRST, SECOND],
            {"global_sort": False},
            {"AP": [100 * (1 / 2 + 2 / 3 / 2)] * 3},
        ),  # or by sample
        ("opencood", [(found_at(), truth_at())], {"absent_class_is_zero": True}, {"mAP": 0}),
        ("paper", [SPARE], {}, {"mAP": 99.382716}),  # at a recall of 1 the precision is that of all
        ("paper", [SPARE], {"absent_class_is_zero": True}, {"mAP": 99.382716 / 6}),
    ],
)
def test_numbers_that_can_be_told_by_hand(protocol, samples, switches, expected) -> None:
    found = shown(evaluated(protocol, *samples, **switches).compute())
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, abs=1e-6, nan_ok=True), name


@pytest.mark.parametrize("category", CATEGORIES)
def test_small_classes_have_thresholds_of_their_own(category: str) -> None:
    """Of boxes that overlap by a little more than one of the thresholds."""
    found, at = [], CATEGORIES.index(category)
    for overlap in (0.31, 0.21, 0.16, 0.11, 0.09):
        ahead = 4 * (1 - overlap) / (1 + overlap)
        sample = (
            found_at((10 + ahead, 0, 0.5), category=category),
            truth_at((10, 0), category=category),
        )
        found.append(
            (evaluated("released_iou", sample).compute().average_precision[at, 0] > 0).tolist()
        )
    both, one, none = [True, True], [False, True], [False, False]
    small = category in SMALL_CATEGORIES
    assert found == ([both, both, one, one, none] if small else [both, one, one, none, none])


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_nothing_there_and_no_samples(protocol: str) -> None:
    zero = DETECTION_PROTOCOLS[protocol].absent_class_is_zero
    for evaluator in (evaluated(protocol, (found_at(), truth_at())), DetectionEvaluator(protocol)):
        mean = evaluator.compute().mean_average_precision
        assert mean == 0 if zero else math.isnan(mean)
        assert json.dumps(evaluator.compute().as_dict(), allow_nan=False)


def test_what_a_result_holds() -> None:
    first = found_at((10, 0, 0.9), (20, 0, 0.5)), truth_at((10.3, 0), (20.2, 0))
    second = found_at((10, 0, 0.8), (-20, 0, 0.7)), truth_at((10.2, 0))
    result = evaluated("paper", first, second).compute()
    car = {
        "thresholds": [1.0, 2.0, 4.0],
        "AP": [[pytest.approx(87.7746913580)] * 3],
        "mean_AP": pytest.approx(87.7746913580),
        "ATE": pytest.approx(0.2677259259),
        **dict.fromkeys(("ASE", "AOE", "AVE"), pytest.approx(0, abs=1e-9)),
        "truths": [3],
        "detections": [4],
    }
    unknown = {"AP": [[None] * 3], **dict.fromkeys(("mean_AP", "ATE", "ASE", "AOE", "AVE"))}
    absent = car | unknown | {"truths": [0], "detections": [0]}
    assert result.as_dict() == {
        "samples": 2,
        "ranges": [[0.0, None]],
        "mAP": car["mean_AP"],
        **{f"m{name}": car[name] for name in ("ATE", "ASE", "AOE", "AVE")},
        "classes": {"car": car} | dict.fromkeys(CATEGORIES[1:], absent),
    }
    assert (result.precision.shape, result.recall[0, 0, 0].tolist()) == (
        (6, 1, 3, 101),
        np.linspace(0, 1, 101).tolist(),
    )
    opencood = evaluated("opencood", (found_at((10, 0, 0.9)), truth_at((10, 0), (30, 0)))).compute()
    assert opencood.classes == ("vehicle",)
    assert (
        opencood.precision[0, 0, 0].tolist() == [1.0] * 51 + [0.0] * 50
    )  # beyond the recall that is reached


def test_a_box_of_which_a_corner_is_out_of_range_does_not_count() -> None:
    """Turned by 45°, a car of 4 × 2 m reaches 2.12 m along each axis, with another corner each
    time.
    """
    for reach, counted in ((1.8, 0), (2.2, 4)):
        truth = truth_at(
            (140 - reach, 0), (reach - 140, 0), (0, 40 - reach), (0, reach - 40), yaw=math.pi / 4
        )
        assert evaluated("opencood", perfect(truth)).compute().truths[0, 0] == counted


def test_unknown_equals_unknown() -> None:
    evaluator = evaluated("paper", (found_at((10, 0, 0.5), velocity=None), truth_at((10, 0))))
    evaluator.update("s/ego_vehicle/000", found_at((10, 0, 0.5), velocity=None), truth_at((10, 0)))
    assert evaluator.repeated == {"s/ego_vehicle/000"}
    assert evaluator.compute().as_dict()["mAVE"] is None


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


def detected_at(*places: tuple[float, float]) -> DetectedBoxes:
    return perfect(truth_at(*places))[0]


@pytest.mark.parametrize("protocol", DETECTION_PROTOCOLS)
@pytest.mark.parametrize("nearest", [0, 1])
def test_of_several_that_are_near_enough_the_nearest_is_matched(
    protocol: str, nearest: int
) -> None:
    """A detection looks for its true box or, in the released way, a true box for its detection:
    here one for two.
    """
    rules = DETECTION_PROTOCOLS[protocol]
    one, two = [(10.0, 0.0)], [(10.3, 0.0)] * 2
    two[nearest] = (10.1, 0.0)
    by_score = rules.matching == "by_score"
    detected = found_at(*((*place, 1.0) for place in (one if by_score else two)))
    found = detection_matches(
        detected, truth_at(*(two if by_score else one)), rules, rules.thresholds[0]
    )
    assert (found.truth if by_score else found.detection).tolist() == [nearest]


def test_the_threshold_that_is_not_given_is_that_of_the_errors_or_the_middle_one() -> None:
    expected = {"released": 2.0, "released_iou": 0.15, "paper": 2.0, "opencood": 0.5}
    assert {
        name: detection_matches(detected_at(), truth_at(), name).threshold for name in expected
    } == expected


def test_pairs_of_which_one_is_out_of_range_are_neither_matches_nor_errors() -> None:
    """The released range ends at x = 84.85 m: the first pair has its truth beyond, the second its
    detection.
    """
    truth = truth_at((85.5, 0), (84.0, 20), (10, 0), (30, 0))
    found = detection_matches(
        detected_at((84.5, 0), (85.0, 20), (50, 0), (10, 0), (40, 0)), truth, "released", 4.0
    )
    columns = (found.detection, found.truth, found.false, found.missed)
    assert [each.tolist() for each in columns] == [[3], [2], [2, 4], [3]]


def test_matches_are_within_one_ring() -> None:
    rules = detection_protocol(
        "paper",
        ranges=((0.0, 30.0), (30.0, 50.0)),
        area=(-30.0, 31.0, -49.9, 50.0),
        error_threshold=None,
    )
    places = [
        (0, 0),
        (18, 24),
        (-30, 40),
        (-30, 0),
        (31, 0),
        (0, -49.9),
        (0, 50.0),
        (0, 29.9),
        (9, 40),
        (-31, 0),
    ]
    rows = [
        detection_matches(detected_at(place), truth_at(place), rules, 4.0).truth.tolist()
        for place in places
    ]
    assert rows == [[0], [0], [], [0], [0], [0], [], [0], [0], []]
    across = detection_matches(
        detected_at((0, 29), (0, 40)), truth_at((0, 30.5), (0, 41)), rules, 4.0
    )
    assert [
        each.tolist() for each in (across.detection, across.truth, across.false, across.missed)
    ] == [
        [1],
        [1],
        [0],
        [0],
    ]


def test_what_cannot_be_compared() -> None:
    nothing = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert_refused(
        (
            lambda: DetectionEvaluator().update("a", found_at(), nothing),
            GeometryError,
            ("a: truth", "'lidar'"),
        ),
        (
            lambda: DetectionEvaluator().update(
                "a", DetectedBoxes(boxes=nothing, scores=[]), truth_at()
            ),
            GeometryError,
            ("a: prediction", "'lidar'"),
        ),
        (
            lambda: detection_matches(detected_at(), truth_at(), "paper", 77),
            ChoiceError,
            ("threshold", "1.0, 2.0, 4.0", "77"),
        ),
    )
