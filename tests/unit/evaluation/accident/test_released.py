"""The protocol `released`: each quirk on a scene that shows it; tests/parity/test_accident.py has the golden file."""

import json
from dataclasses import replace

import numpy as np
import pytest
from accident_scenes import FRAMES, as_heads, as_maps, scene, standing

from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation.accident import PROTOCOLS, AccidentContext, AccidentEvaluator
from deepaccident_devkit.evaluation.accident.released import (
    DrawnPaths,
    ReleasedAccidents,
    accident_counts,
    collision,
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


def moved(cars, y: float):
    return {actor: [(at[0], at[1] + y) for at in path] for actor, path in cars.items()}


def counts(prediction, label, context=UNKNOWN):
    return RELEASED.counts(prediction, label, context)


def tallies(found) -> list[tuple[int, int, int]]:
    return list(zip(found["tp"], found["fp"], found["fn"], strict=True))


TRUE, FALSE, MISSED, NEITHER = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_perfect_prediction(orientation) -> None:
    label = scene(HIT, orientation=orientation)
    found = counts(as_heads(*[label] * 6), label)
    assert tallies(found) == [TRUE] * 3
    assert [found[name] for name in ("id", "position", "time")] == [[0] * 3] * 3
    assert found["positive"]


def test_instance_maps_are_drawn_like_heads() -> None:
    label = scene(HIT)
    from_heads, present = paths_of_heads(MotionHeads.from_labels(label), label.config.grid)
    from_maps = paths_of_instances(np.where(label.instance > 0, label.instance * 7, 0), label.config.grid)
    assert sorted(from_maps.paths) == [7, 14, 21]
    assert (from_maps.drawn > 0).sum() == (from_heads.drawn > 0).sum()
    np.testing.assert_array_equal(from_maps.drawn > 0, from_heads.drawn > 0)
    assert set(np.unique(present)) == {0, 1, 2, 3}
    found = counts(as_maps(*[label] * 6), label)
    assert tallies(found) == [TRUE] * 3
    assert found["position"] == pytest.approx([0] * 3, abs=1e-5)  # means of float32 and of float64


@pytest.mark.parametrize("given", [as_heads, as_maps])
def test_no_instances_at_all_are_no_accident(given) -> None:
    nobody, label = scene({}), scene(HIT)
    assert tallies(counts(given(nobody), label)) == [MISSED] * 3
    assert tallies(counts(given(nobody), nobody)) == [NEITHER] * 3
    assert tallies(counts(given(label), nobody)) == [FALSE] * 3


def test_the_true_ones_must_overlap_and_the_predicted_ones_be_near() -> None:
    near = scene(NEAR)
    assert tallies(counts(as_heads(near), near)) == [FALSE] * 3
    assert tallies(counts(as_heads(near), scene(HIT))) == [TRUE] * 3


def test_only_the_last_frame_counts() -> None:
    passing = {**HIT, 2: approaching(4, 12, 17, 10, 4)}
    label = scene(passing)
    assert tallies(counts(as_heads(label), label)) == [NEITHER] * 3


def test_the_last_frame_is_the_last_that_is_recorded() -> None:
    """Where the recording ends earlier, labels and predictions are cut, so that their last frames are the same."""
    cars = {**HIT, 2: approaching(4, 12, 17, 4, 4)}
    label = scene(cars, frames=3)
    assert tallies(counts(as_heads(scene(cars)), label)) == [TRUE] * 3


def test_the_last_frame_is_that_of_the_longest_true_path() -> None:
    cars = {1: [*standing(20, 10)[:3], None, None], 2: [(4, 10), (12, 10), (17, 10), None, None]}
    label = scene(cars)
    assert tallies(counts(as_heads(label), label)) == [TRUE] * 3


def test_an_accident_elsewhere_is_false_and_nothing_is_missed() -> None:
    label, elsewhere = scene(HIT), scene(moved(HIT, 3.5))
    found = counts(as_heads(elsewhere), label)
    assert tallies(found) == [FALSE, TRUE, TRUE]
    assert found["position"] == [0, 7, 7]


def test_exactly_as_far_as_allowed_is_within() -> None:
    label = scene(HIT)
    assert tallies(counts(as_heads(scene(moved(HIT, 2.5))), label)) == [TRUE] * 3


def test_an_empty_first_prediction_ends_it() -> None:
    nobody, label, calm = scene({}), scene(HIT), scene(CALM)
    told = [nobody, label, label]
    assert tallies(counts(as_heads(*told), label)) == [MISSED] * 3
    assert tallies(counts(as_heads(*told), calm)) == [NEITHER] * 3


def test_any_prediction_may_foresee_but_only_the_mean_gives_a_false_alarm() -> None:
    label, calm = scene(HIT), scene(CALM)
    third = [calm, calm, label, calm, calm, calm]
    assert tallies(counts(as_heads(*third), label)) == [TRUE] * 3
    assert tallies(counts(as_heads(*third), calm)) == [NEITHER] * 3
    assert tallies(counts(as_heads(calm, label), calm)) == [FALSE] * 3


def test_the_nearest_of_the_predictions_counts() -> None:
    label = scene(HIT)
    found = counts(as_heads(scene(moved(HIT, 3)), scene(moved(HIT, 1)), scene(moved(HIT, 2))), label)
    assert found["position"] == [2, 2, 2]


def test_others_in_the_accident_are_an_id_error() -> None:
    label = scene(HIT)
    others = scene({1: standing(20, 10), 2: standing(6, 30), 3: approaching(-20, -10, 0, 10, 17)})
    found = counts(as_heads(others), label)
    assert found["tp"] == [1, 1, 1]
    assert found["id"] == [1, 1, 1]


def test_paths_go_on_faster_and_faster() -> None:
    """A path that ends in frame 2 of 5 with a step of 3 m goes 3 + 6 m further, not 3 + 3 m."""
    heads = MotionHeads.from_labels(scene({1: [(4, 10), (7, 10), (10, 10), None, None]}))
    ending, _ = paths_of_heads(heads, BevGrid())
    x, y = ending.paths[1][-1]
    other = np.tile([0.0, 0.0], (FRAMES, 1))
    truth = DrawnPaths(paths={1: np.tile([x + 6, y], (FRAMES, 1)), 2: other}, drawn=touching())
    predicted = padded_paths(DrawnPaths(paths={1: ending.paths[1], 2: other}, drawn=touching()), FRAMES)
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
    assert collision(DrawnPaths(paths=paths, drawn=drawn), 4, 5.0) == (1, 2)
    assert collision(DrawnPaths(paths={2: paths[2], 3: paths[3]}, drawn=drawn), 4, 5.0) == (2, 3)
    assert collision(DrawnPaths(paths={}, drawn=drawn), 4, 5.0) is None


def test_an_instance_of_which_one_cell_is_left_is_drawn_as_long_as_at_first() -> None:
    maps = np.zeros((FRAMES, 200, 200), dtype=np.int32)
    maps[0, 100:104, 100:108], maps[1:, 102, 104] = 5, 5
    drawn = paths_of_instances(maps, BevGrid()).drawn == 5
    assert (drawn.sum(axis=(1, 2)) > 20).all()


def test_whom_the_truth_names() -> None:
    label = scene(HIT)
    predicted = as_heads(label)

    def name(of=label, **known) -> str:
        return counts(predicted, of, context=AccidentContext(**known))["named"]

    assert name(pair=(2, 1), known=True) == "meta"
    assert name(pair=(1, 3), known=True) == "another"
    assert name(known=True) == "another"
    assert name() == "unknown"
    assert name(scene(CALM), pair=(2, 1), known=True) == "none"
    assert name(replace(label, id_map={}), pair=(2, 1), known=True) == "unknown"
    ego = replace(label, id_map={-101: label.id_map[1], 2: label.id_map[2]})
    assert name(ego, pair=(2, 77), known=True, own_actor_id=77) == "meta"
    assert name(ego, pair=(2, 77), known=True) == "unknown"


def test_whom_the_truth_names_among_others() -> None:
    """A third car, drawn first, is none of the two."""
    label = scene({9: standing(-20, -20), 8: standing(-20, 20), **HIT})
    found = counts(as_heads(label), label, AccidentContext(pair=(1, 2), known=True))
    assert (found["positive"], found["named"]) == (True, "meta")


def test_the_truth_names_who_is_there_at_the_present() -> None:
    """A frame later a third car is where one of the two was."""
    there, passing = (4, 13), (4, 10.5)
    label = scene({**HIT, 3: [there, passing, there, there, there]})
    found = counts(as_heads(label), label, AccidentContext(pair=(1, 2), known=True))
    assert (found["positive"], found["named"]) == (True, "meta")


def evaluated(evaluator: AccidentEvaluator | None = None, tokens: str = "abcd") -> AccidentEvaluator:
    """A true positive, one 7 m off, a missed one, a false alarm."""
    evaluator = AccidentEvaluator() if evaluator is None else evaluator
    hit, near, calm = scene(HIT), scene(moved(HIT, 3.5)), scene(CALM)
    cases = {"a": (hit, hit), "b": (near, hit), "c": (calm, hit), "d": (hit, calm)}
    for token in tokens:
        predicted, label = cases[token]
        evaluator.update(token, as_heads(predicted), label, AccidentContext(pair=(1, 2), known=True))
    return evaluator


def test_rates_and_errors() -> None:
    result = evaluated().compute()
    assert [(each.tp, each.fp, each.fn) for each in result.within.values()] == [(1, 2, 1), (2, 1, 1), (2, 1, 1)]
    assert [each.accuracy for each in result.within.values()] == [1 / 2.5, 2 / 3, 2 / 3]
    assert result.apa == pytest.approx((0.4 + 4 / 3) / 3)
    assert result.position_error == pytest.approx((0 + 3.5 + 3.5) / 3)
    assert (result.id_error, result.time_error) == (0, 0)
    assert (result.samples, result.positives, result.negatives) == (4, 3, 1)
    assert result.truths == {"meta": 3, "another": 0, "none": 1, "unknown": 0}
    assert json.loads(json.dumps(result.as_dict()))["within"]["10"]["tp"] == 2


def test_nothing_foreseen_has_the_released_errors() -> None:
    result = evaluated(tokens="c").compute()
    assert result.apa == 0
    assert (result.id_error, result.position_error, result.time_error) == (1, 20, 1)


def test_what_cannot_be_evaluated() -> None:
    label = scene(HIT)
    for error, words, refused in (
        (
            EvaluationError,
            "give a MotionOutput",
            lambda: counts([Accident(positions=np.zeros((2, 2)), time=1.0)], label),
        ),
        (EvaluationError, "motion labels", lambda: counts(as_heads(label), None)),
        (
            EvaluationError,
            "frames",
            lambda: counts(MotionOutput(grid=label.config.grid, instances=label.instance[None, :3]), label),
        ),
        (
            EvaluationError,
            "grid",
            lambda: counts(MotionOutput(grid=BevGrid((-51, 49, 0.5)), instances=label.instance[None]), label),
        ),
        (ChoiceError, "released, paper, boxes", lambda: AccidentEvaluator("official")),
    ):
        with pytest.raises(error, match=words):
            refused()
    assert set(PROTOCOLS) == {"released", "paper", "boxes"}
