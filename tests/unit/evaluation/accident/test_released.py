"""The protocol `released`: each quirk on a scene that shows it; tests/parity/test_accident.py has
the golden file.
"""

from dataclasses import replace

import numpy as np
import pytest
from accident_scenes import FRAMES, as_heads, as_maps, scene, standing
from refusals import assert_refused

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

RELEASED, UNKNOWN = ReleasedAccidents(), AccidentContext()


def approaching(*centers: float, y: float = 10.0):
    """A car that drives to one that stands at (20, y)."""
    return [(x, y) for x in centers]


HIT = {1: standing(20, 10), 2: approaching(4, 8, 12, 15, 17), 3: standing(-20, -20)}
"""They touch in the last frame alone: 4 m long cars, 3 m apart."""
NEAR = {1: standing(20, 10), 2: approaching(4, 7, 10, 12, 13.5), 3: standing(-20, -20)}
"""2.5 m apart at the end: an accident for a prediction, none in truth."""
CALM = {1: standing(20, 10), 2: standing(4, 10), 3: standing(-20, -20)}


def moved(y: float):
    return {actor: [(at[0], at[1] + y) for at in path] for actor, path in HIT.items()}


def counts(prediction, label, context=UNKNOWN):
    return RELEASED.counts(prediction, label, context)


def tallies(found) -> list[tuple[int, int, int]]:
    return list(zip(found["tp"], found["fp"], found["fn"], strict=True))


TRUE, FALSE, MISSED, NEITHER = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)
PASSING = HIT | {2: approaching(4, 12, 17, 10, 4)}
ENDING = HIT | {2: approaching(4, 12, 17, 4, 4)}
SHORT = {1: [*standing(20, 10)[:3], None, None], 2: [(4, 10), (12, 10), (17, 10), None, None]}
OTHERS = {1: standing(20, 10), 2: standing(6, 30), 3: approaching(-20, -10, 0, 10, 17)}
both = pytest.mark.parametrize("form", [as_heads, as_maps])


@pytest.mark.parametrize(
    ("predicted", "true", "expected", "position"),
    [
        ([HIT] * 2, HIT, [TRUE] * 3, [0] * 3),
        ([{}], HIT, [MISSED] * 3, [0] * 3),
        ([{}], {}, [NEITHER] * 3, [0] * 3),
        ([HIT], {}, [FALSE] * 3, [0] * 3),
        (
            [NEAR],
            NEAR,
            [FALSE] * 3,
            [0] * 3,
        ),  # the true ones must overlap, the predicted ones be near
        ([PASSING], PASSING, [NEITHER] * 3, [0] * 3),  # only the last frame counts
        ([SHORT], SHORT, [TRUE] * 3, [0] * 3),  # which is that of the longest true path
        ([moved(2.5)], HIT, [TRUE] * 3, [5] * 3),  # exactly as far as allowed
        ([moved(3.5)], HIT, [FALSE, TRUE, TRUE], [0, 7, 7]),  # elsewhere, and nothing is missed
        ([{}, HIT, HIT], HIT, [MISSED] * 3, [0] * 3),  # an empty first prediction ends it
        ([{}, HIT, HIT], CALM, [NEITHER] * 3, [0] * 3),
        ([CALM, CALM, HIT, CALM], HIT, [TRUE] * 3, [0] * 3),  # any prediction may foresee
        (
            [CALM, CALM, HIT, CALM],
            CALM,
            [NEITHER] * 3,
            [0] * 3,
        ),  # only the mean gives a false alarm
        ([CALM, HIT], CALM, [FALSE] * 3, [0] * 3),
        ([moved(3), moved(1), moved(2)], HIT, [TRUE] * 3, [2] * 3),  # the nearest
    ],
)
@both
def test_what_predictions_score(form, predicted, true, expected, position) -> None:
    found = counts(form(*map(scene, predicted)), scene(true))
    assert tallies(found) == expected
    assert found["position"] == pytest.approx(position, abs=1e-5)  # means of float32 and of float64
    assert (found["id"], found["time"]) == ([0] * 3, [0] * 3)
    assert found["positive"] == (true in (HIT, SHORT))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_maps_may_lie_in_any_orientation(orientation) -> None:
    label = scene(HIT, orientation=orientation)
    assert tallies(counts(as_heads(*[label] * 2), label)) == [TRUE] * 3


@both
def test_the_last_frame_is_the_last_that_is_recorded(form) -> None:
    """Where the recording ends earlier, labels and predictions are cut, so that their last frames
    are the same.
    """
    assert tallies(counts(form(scene(ENDING)), scene(ENDING, frames=3))) == [TRUE] * 3


def test_others_in_the_accident_are_an_id_error() -> None:
    found = counts(as_heads(scene(OTHERS)), scene(HIT))
    assert (found["tp"], found["id"]) == ([1, 1, 1], [1, 1, 1])


def test_instance_maps_are_drawn_like_heads() -> None:
    label = scene(HIT)
    from_heads, present = paths_of_heads(MotionHeads.from_labels(label), label.config.grid)
    from_maps = paths_of_instances(
        np.where(label.instance > 0, label.instance * 7, 0), label.config.grid
    )
    assert sorted(from_maps.paths) == [7, 14, 21]
    np.testing.assert_array_equal(from_maps.drawn > 0, from_heads.drawn > 0)
    assert set(np.unique(present)) == {0, 1, 2, 3}


def test_paths_go_on_faster_and_faster() -> None:
    """A path that ends in frame 2 of 5 with a step of 3 m goes 3 + 6 m further, not 3 + 3 m."""
    heads = MotionHeads.from_labels(scene({1: [(4, 10), (7, 10), (10, 10), None, None]}))
    ending, _ = paths_of_heads(heads, BevGrid())
    x, y = ending.paths[1][-1]
    other = np.tile([0.0, 0.0], (FRAMES, 1))
    truth = DrawnPaths(paths={1: np.tile([x + 6, y], (FRAMES, 1)), 2: other}, drawn=touching())
    predicted = padded_paths(
        DrawnPaths(paths={1: ending.paths[1], 2: other}, drawn=touching()), FRAMES
    )
    found, pair = accident_counts([predicted], truth, [[(1, 1), (2, 2)]])
    assert pair == (1, 2)
    assert found["position"] == pytest.approx([3] * 3)


def touching() -> np.ndarray:
    drawn = np.zeros((FRAMES, 50, 50), dtype=np.int32)
    drawn[:, 10:14, 10:18], drawn[:, 10:14, 18:26] = 1, 2
    return drawn


def test_of_several_overlapping_pairs_the_first_ids_count() -> None:
    drawn = touching()
    drawn[:, 14:18, 10:26] = 3
    paths = {name: np.zeros((FRAMES, 2)) for name in (1, 2, 3)}
    assert drawn_collision(DrawnPaths(paths=paths, drawn=drawn), 4, 5.0) == (1, 2)
    assert drawn_collision(DrawnPaths(paths={2: paths[2], 3: paths[3]}, drawn=drawn), 4, 5.0) == (
        2,
        3,
    )
    assert drawn_collision(DrawnPaths(paths={}, drawn=drawn), 4, 5.0) is None


def test_an_instance_of_which_one_cell_is_left_is_drawn_as_long_as_at_first() -> None:
    maps = np.zeros((FRAMES, 200, 200), dtype=np.int32)
    maps[0, 100:104, 100:108], maps[1:, 102, 104] = 5, 5
    drawn = paths_of_instances(maps, BevGrid()).drawn == 5
    assert (drawn.sum(axis=(1, 2)) > 20).all()


PAIR = {"pair": (2, 1), "known": True}
ABOUT = {3: [(4, 13), (4, 10.5), (4, 13), (4, 13), (4, 13)]}


@pytest.mark.parametrize(
    ("cars", "ids", "context", "named"),
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
            {9: standing(-20, -20), 8: standing(-20, 20), **HIT},
            None,
            PAIR,
            "meta",
        ),  # others are drawn first
        (
            HIT | ABOUT,
            None,
            PAIR,
            "meta",
        ),  # who is there at the present: later a third car is where one was
    ],
)
def test_whom_the_truth_names(cars, ids, context, named) -> None:
    label = scene(cars)
    label = label if ids is None else replace(label, id_map=ids)
    found = counts(as_heads(label), label, AccidentContext(**context))
    assert (found["named"], found["positive"]) == (named, named != "none")


def test_what_results_hold() -> None:
    """Of a true positive, one 7 m off, a missed one and a false alarm."""
    evaluator, hit, calm = AccidentEvaluator(), scene(HIT), scene(CALM)
    cases = {"a": (hit, hit), "b": (scene(moved(3.5)), hit), "c": (calm, hit), "d": (hit, calm)}
    for token, (predicted, label) in cases.items():
        evaluator.update(token, as_heads(predicted), label, AccidentContext(**PAIR))
    names = ("distance", "tp", "fp", "fn", "accuracy", "id_error", "position_error", "time_error")
    rows = [
        (5, 1, 2, 1, 1 / 2.5, 0, 0, 0),
        *((distance, 2, 1, 1, 2 / 3, 0, 3.5, 0) for distance in (10, 15)),
    ]
    assert evaluator.compute().as_dict() == {
        "within": {str(row[0]): dict(zip(names, row, strict=True)) for row in rows},
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
    nothing = evaluator.compute(["c"])
    assert (nothing.apa, nothing.id_error, nothing.position_error, nothing.time_error) == (
        0,
        1,
        20,
        1,
    )


def test_what_cannot_be_evaluated() -> None:
    label = scene(HIT)
    few = MotionOutput(grid=label.config.grid, instances=label.instance[None, :3])
    elsewhere = MotionOutput(grid=BevGrid((-51, 49, 0.5)), instances=label.instance[None])
    explicit = [Accident(positions=np.zeros((2, 2)), time=1.0)]
    assert_refused(
        (
            lambda: counts(explicit, label),
            EvaluationError,
            ("give a MotionOutput", "protocol='paper' or 'boxes'"),
        ),
        (lambda: counts(as_heads(label), None), EvaluationError, ("motion labels",)),
        (lambda: counts(few, label), EvaluationError, ("at least 5 frames", "found 3")),
        (lambda: counts(elsewhere, label), EvaluationError, ("same grid",)),
    )
