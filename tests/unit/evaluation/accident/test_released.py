"""The protocol `released`: each quirk is tested on a scene that shows it.

tests/parity/test_accident.py has the golden file.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.accident_scenes import (
    FRAMES,
    motion_labels_of,
    parked_path,
    shift_cars,
    to_heads_output,
    to_instance_output,
)
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import AccidentContext, AccidentEvaluator
from deepaccident_devkit.evaluation.accident.released import (
    DrawnPaths,
    ReleasedAccidents,
    accident_counts,
    drawn_collision,
    padded_paths,
    paths_of_heads,
    paths_of_instances,
)
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS
from deepaccident_devkit.motion import MotionHeads

RELEASED = ReleasedAccidents()
UNKNOWN = AccidentContext()


def make_path(*xs: float, y: float = 10.0):
    """Return the path of a car that drives to one that stands at (20, y)."""
    return [(x, y) for x in xs]


# They overlap only in the last frame: cars of 4 m, 3 m from centre to centre.
HIT = {1: parked_path(20, 10), 2: make_path(4, 8, 12, 15, 17), 3: parked_path(-20, -20)}
# 2.5 m apart at the end: an accident for a prediction, none in truth.
NEAR_MISS = {1: parked_path(20, 10), 2: make_path(4, 7, 10, 12, 13.5), 3: parked_path(-20, -20)}
CALM = {1: parked_path(20, 10), 2: parked_path(4, 10), 3: parked_path(-20, -20)}


def count_accidents(prediction, label, context=UNKNOWN):
    return RELEASED.counts(prediction, label, context)


def read_case_counts(counts) -> list[tuple[int, int, int]]:
    """Return true positives, false positives and missed accidents by the distance allowed."""
    return list(zip(counts["tp"], counts["fp"], counts["fn"], strict=True))


TRUE, FALSE, MISSED, NEITHER = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)
PASSING = HIT | {2: make_path(4, 12, 17, 10, 4)}
STOPPING_HALFWAY = HIT | {2: make_path(4, 12, 17, 4, 4)}
SHORT_PATHS = {
    1: [*parked_path(20, 10)[:3], None, None],
    2: [(4, 10), (12, 10), (17, 10), None, None],
}
OTHERS = {1: parked_path(20, 10), 2: parked_path(6, 30), 3: make_path(-20, -10, 0, 10, 17)}
in_both_forms = pytest.mark.parametrize("form", [to_heads_output, to_instance_output])


@pytest.mark.parametrize(
    ("predicted", "true", "expected", "position"),
    [
        ([HIT] * 2, HIT, [TRUE] * 3, [0] * 3),
        ([{}], HIT, [MISSED] * 3, [0] * 3),
        ([{}], {}, [NEITHER] * 3, [0] * 3),
        ([HIT], {}, [FALSE] * 3, [0] * 3),
        # true cars must overlap, predicted cars need only be near
        ([NEAR_MISS], NEAR_MISS, [FALSE] * 3, [0] * 3),
        # only the last frame counts
        ([PASSING], PASSING, [NEITHER] * 3, [0] * 3),
        # the last frame is that of the longest true path
        ([SHORT_PATHS], SHORT_PATHS, [TRUE] * 3, [0] * 3),
        # exactly as far as allowed
        ([shift_cars(HIT, y=2.5)], HIT, [TRUE] * 3, [5] * 3),
        # elsewhere, and nothing is missed
        ([shift_cars(HIT, y=3.5)], HIT, [FALSE, TRUE, TRUE], [0, 7, 7]),
        # no prediction counts if the first one is empty
        ([{}, HIT, HIT], HIT, [MISSED] * 3, [0] * 3),
        ([{}, HIT, HIT], CALM, [NEITHER] * 3, [0] * 3),
        # any prediction may foresee the accident
        ([CALM, CALM, HIT, CALM], HIT, [TRUE] * 3, [0] * 3),
        # only the mean gives a false alarm
        ([CALM, CALM, HIT, CALM], CALM, [NEITHER] * 3, [0] * 3),
        ([CALM, HIT], CALM, [FALSE] * 3, [0] * 3),
        # the nearest prediction counts
        (
            [shift_cars(HIT, y=3), shift_cars(HIT, y=1), shift_cars(HIT, y=2)],
            HIT,
            [TRUE] * 3,
            [2] * 3,
        ),
    ],
)
@in_both_forms
def test_what_predictions_score(form, predicted, true, expected, position) -> None:
    counts = count_accidents(
        form(*map(motion_labels_of, predicted)),
        motion_labels_of(true),
    )
    assert read_case_counts(counts) == expected
    # means of float32 and of float64
    assert counts["position"] == pytest.approx(position, abs=1e-5)
    assert (counts["id"], counts["time"]) == ([0] * 3, [0] * 3)
    assert counts["positive"] == (true in (HIT, SHORT_PATHS))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_maps_may_lie_in_any_orientation(orientation) -> None:
    label = motion_labels_of(HIT, orientation=orientation)
    counts = count_accidents(to_heads_output(label, label), label)
    assert read_case_counts(counts) == [TRUE] * 3


@in_both_forms
def test_the_last_frame_is_the_last_that_is_recorded(form) -> None:
    """Where the recording ends early, labels and predictions are cut, so that their last frames
    are the same.
    """
    counts = count_accidents(
        form(motion_labels_of(STOPPING_HALFWAY)),
        motion_labels_of(STOPPING_HALFWAY, frames=3),
    )
    assert read_case_counts(counts) == [TRUE] * 3


def test_others_in_the_accident_are_an_id_error() -> None:
    counts = count_accidents(
        to_heads_output(motion_labels_of(OTHERS)),
        motion_labels_of(HIT),
    )
    assert (counts["tp"], counts["id"]) == ([1, 1, 1], [1, 1, 1])


def test_instance_maps_are_drawn_like_heads() -> None:
    label = motion_labels_of(HIT)
    grid = label.config.grid
    from_heads, present = paths_of_heads(MotionHeads.from_labels(label), grid)
    from_maps = paths_of_instances(label.instance * 7, grid)
    assert sorted(from_maps.paths) == [7, 14, 21]
    np.testing.assert_array_equal(
        from_maps.drawn > 0,
        from_heads.drawn > 0,
    )
    assert set(np.unique(present)) == {0, 1, 2, 3}


def test_paths_go_on_faster_and_faster() -> None:
    """A path that ends in frame 2 of 5 with a step of 3 m goes 3 + 6 m further, not 3 + 3 m."""
    label = motion_labels_of({1: [(4, 10), (7, 10), (10, 10), None, None]})
    ending, _ = paths_of_heads(MotionHeads.from_labels(label), BevGrid())
    x, y = ending.paths[1][-1]
    other = np.zeros((FRAMES, 2))
    truth = DrawnPaths(
        paths={1: np.tile([x + 6, y], (FRAMES, 1)), 2: other},
        drawn=draw_touching_cars(),
    )
    prediction = DrawnPaths(
        paths={1: ending.paths[1], 2: other},
        drawn=draw_touching_cars(),
    )

    counts, pair = accident_counts([padded_paths(prediction, FRAMES)], truth, [[(1, 1), (2, 2)]])

    assert pair == (1, 2)
    assert counts["position"] == pytest.approx([3] * 3)


def draw_touching_cars() -> np.ndarray:
    maps = np.zeros((FRAMES, 50, 50), dtype=np.int32)
    maps[:, 10:14, 10:18] = 1
    maps[:, 10:14, 18:26] = 2
    return maps


def test_of_several_overlapping_pairs_the_first_ids_count() -> None:
    drawn = draw_touching_cars()
    drawn[:, 14:18, 10:26] = 3
    path = np.zeros((FRAMES, 2))
    for ids, pair in (([1, 2, 3], (1, 2)), ([2, 3], (2, 3)), ([], None)):
        paths = dict.fromkeys(ids, path)
        assert drawn_collision(DrawnPaths(paths=paths, drawn=drawn), 4, 5.0) == pair


def test_an_instance_with_one_cell_left_is_drawn_as_long_as_at_first() -> None:
    maps = np.zeros((FRAMES, 200, 200), dtype=np.int32)
    maps[0, 100:104, 100:108] = 5
    maps[1:, 102, 104] = 5
    drawn = paths_of_instances(maps, BevGrid()).drawn == 5
    assert (drawn.sum(axis=(1, 2)) > 20).all()


PAIR = {"pair": (2, 1), "known": True}
THIRD_CAR = {3: [(4, 13), (4, 10.5), (4, 13), (4, 13), (4, 13)]}


@pytest.mark.parametrize(
    ("cars", "id_map", "context", "named"),
    [
        (HIT, None, PAIR, "meta"),
        (HIT, None, {"pair": (1, 3), "known": True}, "another"),
        (HIT, None, {"known": True}, "another"),
        (HIT, None, {}, "unknown"),
        (CALM, None, PAIR, "none"),
        (HIT, {}, PAIR, "unknown"),
        (HIT, {-101: 1, 2: 2}, {"pair": (2, 77), "known": True, "own_actor_id": 77}, "meta"),
        (HIT, {-101: 1, 2: 2}, {"pair": (2, 77), "known": True}, "unknown"),
        (
            # others are drawn first
            {9: parked_path(-20, -20), 8: parked_path(-20, 20), **HIT},
            None,
            PAIR,
            "meta",
        ),
        # the present counts: later a third car is where one of the two was
        (HIT | THIRD_CAR, None, PAIR, "meta"),
    ],
)
def test_actors_that_the_truth_names(cars, id_map, context, named) -> None:
    label = motion_labels_of(cars)
    if id_map is not None:
        label = replace(label, id_map=id_map)
    counts = count_accidents(to_heads_output(label), label, AccidentContext(**context))
    assert (counts["named"], counts["positive"]) == (named, named != "none")


def test_what_results_hold() -> None:
    """The samples are a true positive, one 7 m off, a missed accident and a false alarm."""
    evaluator = AccidentEvaluator()
    hit = motion_labels_of(HIT)
    calm = motion_labels_of(CALM)
    cases = {
        "a": (hit, hit),
        "b": (motion_labels_of(shift_cars(HIT, y=3.5)), hit),
        "c": (calm, hit),
        "d": (hit, calm),
    }
    for token, (predicted, label) in cases.items():
        evaluator.update(token, to_heads_output(predicted), label, AccidentContext(**PAIR))

    def within(distance, tp, fp, fn, accuracy, position_error):
        return {
            "distance": distance,
            "tp": tp,
            "fp": fp,
            "fn": fn,
            "accuracy": accuracy,
            "id_error": 0,
            "position_error": position_error,
            "time_error": 0,
        }

    assert evaluator.compute().as_dict() == {
        "within": {
            "5": within(5, 1, 2, 1, 1 / 2.5, 0),
            "10": within(10, 2, 1, 1, 2 / 3, 3.5),
            "15": within(15, 2, 1, 1, 2 / 3, 3.5),
        },
        "apa": pytest.approx((0.4 + 4 / 3) / 3),
        "id_error": 0,
        "position_error": pytest.approx((0 + 3.5 + 3.5) / 3),
        "time_error": 0,
        "samples": 4,
        "positives": 3,
        "negatives": 1,
        "truths": {"meta": 3, "another": 0, "none": 1, "unknown": 0},
        "notes": [],
        "beside": {},
    }
    missed = evaluator.compute(["c"])
    errors = (missed.id_error, missed.position_error, missed.time_error)
    assert (missed.apa, *errors) == (0, 1, 20, 1)


def test_what_cannot_be_evaluated() -> None:
    label = motion_labels_of(HIT)
    few = MotionOutput(grid=label.config.grid, instances=label.instance[None, :3])
    elsewhere = MotionOutput(grid=BevGrid((-51, 49, 0.5)), instances=label.instance[None])
    explicit = [Accident(positions=np.zeros((2, 2)), time=1.0)]
    assert_raises(
        (
            lambda: count_accidents(explicit, label),
            EvaluationError,
            ("give a MotionOutput", "protocol='paper' or 'boxes'"),
        ),
        (
            lambda: count_accidents(to_heads_output(label), None),
            EvaluationError,
            ("motion labels",),
        ),
        (lambda: count_accidents(few, label), EvaluationError, ("at least 5 frames", "found 3")),
        (lambda: count_accidents(elsewhere, label), EvaluationError, ("same grid",)),
    )
