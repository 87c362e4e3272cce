import math
from dataclasses import replace

import numpy as np
import pytest
from accident_scenes import FRAMES, as_heads, as_maps, scene, standing
from numpy.testing import assert_allclose

from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError
from deepaccident_devkit.evaluation.accident import AccidentEvaluator
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident_truth import AccidentContext, position_difference
from deepaccident_devkit.evaluation.map_accidents import AccidentReading, accident_of
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS

PAPER = PaperAccidents()


def follower(*gaps: float, y: float = 10.0):
    """A car whose front is so far behind the rear of one that stands at (20, y)."""
    return [(20.0 - 4.0 - gap, y) for gap in gaps]


HIT = {1: standing(20, 10), 2: follower(4, 3, 2, 0.5, 1.5)}
"""0.5 m apart 1.5 s ahead, at (20, 10) and (15.5, 10)."""
CALM = {1: standing(20, 10), 2: follower(9, 8, 7, 6, 5)}


def moved(cars, x: float = 0.0, y: float = 0.0):
    return {actor: [at and (at[0] + x, at[1] + y) for at in path] for actor, path in cars.items()}


def read(label, reading=PAPER.reading):
    return accident_of(label.instance, label.config.grid, label.config.rules, reading)


def result(prediction, label, protocol=PAPER, context=None):
    return protocol.result([protocol.counts(prediction, label, context or AccidentContext())])


def tallies(made) -> list[tuple[int, int, int]]:
    return [(each.tp, each.fp, each.fn) for each in made.within.values()]


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_two_boxes_at_a_known_gap_and_time(orientation) -> None:
    label = scene(HIT, orientation=orientation)
    found = read(label)
    assert found.contact.frame == 3
    assert found.contact.ids == (1, 2)
    assert found.contact.distance == 0.5
    assert_allclose(found.positions, [[20, 10], [15.5, 10]])


def test_a_metre_apart_is_no_accident_and_less_is() -> None:
    assert read(scene({1: standing(20, 10), 2: follower(4, 3, 2, 1, 1.5)})).contact is None
    assert read(scene({1: standing(20, 10), 2: follower(4, 3, 2, 0.5, 1.5)})).contact is not None


def test_positions_of_labels_without_the_half_cell_shift() -> None:
    """Corners on cell edges belong to the cell beyond, so that a car lies a quarter metre ahead and to the right."""
    label = scene(HIT, protocol="clean")
    assert_allclose(read(label).positions, [[20.25, 9.75], [15.75, 9.75]])


def test_perfect_instance_maps_score_all_and_say_what_they_were_compared_with() -> None:
    label = scene(HIT)
    made = result(as_maps(*[label] * 6), label)
    assert made.apa == 1
    assert (made.id_error, made.position_error, made.time_error) == (0, 0, 0)
    assert tallies(made) == [(1, 0, 0)] * 3
    assert "given as instance maps" in made.notes[0]
    assert made.beside["sample_choice=mean_first"].apa == 1


def test_perfect_heads_score_all_and_are_compared_with_what_the_released_grouping_makes_of_labels() -> None:
    label = scene(HIT)
    made = result(as_heads(*[label] * 6), label)
    assert made.apa == 1
    assert (made.id_error, made.position_error, made.time_error) == (0, 0, 0)
    assert made.notes == ()


def test_an_empty_prediction_scores_nothing() -> None:
    label = scene(HIT)
    nothing = MotionOutput(grid=label.config.grid, instances=np.zeros((6, FRAMES, 200, 200), dtype=np.int32))
    made = result(nothing, label)
    assert made.apa == 0
    assert tallies(made) == [(0, 0, 1)] * 3
    assert (made.id_error, made.position_error, made.time_error) == (None, None, None)
    empty = scene({})
    assert result(as_heads(empty), label).apa == 0


@pytest.mark.parametrize(
    ("shift", "expected"),
    [
        (2, [(1, 0, 0), (1, 0, 0), (1, 0, 0)]),  # each of the two is 2 m off: 4 m
        (2.5, [(0, 1, 1), (1, 0, 0), (1, 0, 0)]),  # 5 m is not less than 5 m
        (6, [(0, 1, 1), (0, 1, 1), (1, 0, 0)]),
        (9, [(0, 1, 1), (0, 1, 1), (0, 1, 1)]),
    ],
)
def test_an_accident_elsewhere_is_false_and_leaves_the_true_one_missed(shift, expected) -> None:
    label = scene(HIT)
    made = result(as_maps(scene(moved(HIT, y=shift))), label)
    assert tallies(made) == expected
    assert made.position_error == (2 * shift if shift < 5 else None)
    assert made.within[15.0].position_error == (2 * shift if shift < 7.5 else None)


def test_the_better_pairing_of_positions_counts() -> None:
    here = np.array([[0.0, 0.0], [4.0, 3.0]])
    assert position_difference(here, here[::-1]) == 0
    assert position_difference(here, here + np.array([3, 4])) == 10
    label = scene(HIT)
    assert result(as_maps(scene({2: HIT[2], 1: HIT[1]})), label).position_error == 0


def test_one_seen_only_by_the_third_of_six_predictions() -> None:
    label, calm = scene(HIT), scene(CALM)
    samples = [calm, calm, scene(moved(HIT, y=1)), calm, calm, calm]
    for output in (as_maps(*samples), as_heads(*samples)):
        made = result(output, label)
        assert made.apa == 1
        assert made.position_error == 2
        assert made.beside["sample_choice=mean_first"].position_error == 2
        assert tallies(result(output, calm)) == [(0, 1, 0)] * 3


def test_which_of_several_predictions_is_compared() -> None:
    label, calm = scene(HIT), scene(CALM)
    near, far, farther = scene(moved(HIT, y=1)), scene(moved(HIT, y=3)), scene(moved(HIT, y=4))
    made = result(as_maps(far, near, calm, farther), label)
    assert made.position_error == 2
    assert made.beside["sample_choice=mean_first"].position_error == 8
    made = result(as_maps(far, near, farther, calm), label, replace(PAPER, sample_choice="mean_first"))
    assert made.position_error == 6  # the mean has none, so the first that has one
    assert made.beside["sample_choice=best"].position_error == 2


@pytest.mark.parametrize("seen", range(4))
def test_the_mean_or_else_the_first_is_compared_wherever_it_is(seen: int) -> None:
    """One of four predictions has an accident; or two, of which the later one is farther off."""
    label, calm = scene(HIT), scene(CALM)
    near, far = scene(moved(HIT, y=1)), scene(moved(HIT, y=3))
    samples = [far if at == seen else calm for at in range(4)]
    assert PAPER.counts(as_maps(*samples), label, AccidentContext())["mean_first"]["position"] == 6
    both = [near if at < seen else far if at == seen else calm for at in range(4)]
    made = PAPER.counts(as_maps(*both), label, AccidentContext())
    assert (made["mean_first"]["position"], made["best"]["position"]) == (2 if 0 < seen < 3 else 6, 2 if seen else 6)


@pytest.mark.parametrize(("time", "error"), [(1.74, 0), (1.75, 0), (1.2, 1), (1.26, 0)])
def test_an_explicit_accident_names_who_is_there_at_the_nearest_frame(time: float, error: int) -> None:
    """Of four frames the last one is the nearest up to the end of their time; before, another was there."""
    label = scene({1: standing(20, 10), 2: follower(20, 20, 20, 0.5), 3: follower(1.5, 1.5, 1.5, 20)}, frames=4)
    assert PAPER.counts([alarm(time=time, ids=None)], label, AccidentContext())["best"]["id"] == error


def test_time_error_and_each_sides_own_time() -> None:
    """Predicted half a second early, while the follower is 1 m behind where it will be."""
    label = scene(HIT)
    early = scene({1: standing(20, 10), 2: follower(4, 3, 0.5, 1.5, 2)})
    made = result(as_maps(early), label)
    assert (made.time_error, made.position_error, made.id_error) == (0.5, 0, 0)


def test_ids_are_judged_by_a_match_of_all_instances() -> None:
    """The right two collide in one prediction; in the other one, a third car collides with the first."""
    third = {3: standing(20, 30)}
    label = scene(HIT | third)
    assert result(as_maps(scene({7: HIT[2], 8: third[3], 9: HIT[1]})), label).id_error == 0
    calm = {2: follower(4, 3, 2, 1.5, 1.5), 1: standing(20, 10), 3: standing(20, 12.5)}
    wrong = result(as_maps(scene(calm)), scene(HIT | {3: standing(20, 15)}))
    assert wrong.within[5.0].tp == 0
    assert wrong.within[15.0].tp == 1
    assert wrong.within[15.0].id_error == 1


def test_instances_beyond_the_gate_are_no_match() -> None:
    label = scene(HIT)
    near, far = as_maps(scene(moved(HIT, y=4))), as_maps(scene(moved(HIT, y=4.5)))
    assert result(near, label).id_error == 0
    assert result(far, label).id_error == 1


def test_ties() -> None:
    """Pairs that come to within 0.5 m: the earlier; at one time, those with the nearer centres; then lower ids."""
    ahead = lambda gap, y: [(0.0, y), (4.0 + gap, y)]  # noqa: E731
    beside = lambda gap, y: [(0.0, y), (0.0, y + 2 + gap)]  # noqa: E731

    def contact(*pairs):
        cars = {}
        for number, path in enumerate(pairs):
            for which in (0, 1):
                cars[2 * number + which + 1] = [at[which] for at in path]
        return read(scene(cars)).contact

    late = [ahead(gap, -20) for gap in (2, 2, 2, 2, 0.5)]
    early = [ahead(gap, 0) for gap in (2, 2, 0.5, 2, 0.5)]
    assert (contact(late, early).frame, contact(late, early).ids) == (2, (3, 4))
    near_centers = [beside(gap, 20) for gap in (2, 2, 0.5, 2, 2)]
    assert contact(early, near_centers).ids == (3, 4)
    again = [ahead(gap, -40) for gap in (2, 2, 0.5, 2, 2)]
    assert contact(again, early).ids == (1, 2)


def test_no_accident_anywhere() -> None:
    label = scene(CALM)
    made = result(as_maps(*[label] * 6), label)
    assert tallies(made) == [(0, 0, 0)] * 3
    assert math.isnan(made.apa)
    assert (made.positives, made.negatives, made.samples) == (0, 1, 1)
    assert made.truths["none"] == 1
    assert math.isnan(result(as_maps(scene({})), scene({})).apa)
    assert math.isnan(PAPER.result([]).apa)


def test_an_instance_that_leaves_the_grid() -> None:
    """It is half out when it collides, so that its mean cell is nearer; beyond it is nowhere, and matched before."""
    leaving = [(46.0, 0.0), (48.0, 0.0), (50.0, 0.0), None, None]
    cars = {1: leaving, 2: [(x - 4.5 + 0.5 * (t != 2) * -4, 0.0) for t, (x, _) in enumerate(leaving[:3])] + [None] * 2}
    label = scene(cars)
    found = read(label)
    assert found.contact.frame == 2
    assert found.contact.distance == 0.5
    assert found.positions[0, 0] == pytest.approx((48.0 + 49.5) / 2)
    assert np.isnan(found.tracks.center[3:]).all()
    made = result(as_maps(label), label)
    assert (made.apa, made.id_error) == (1, 0)
    never = read(scene({1: standing(100, 0), 2: standing(20, 0)}))
    assert never.tracks.identity.tolist() == [2]


def test_boxes_that_touch_share_their_outermost_cells() -> None:
    """The one drawn later has them: in rasters even those that touch are a cell apart."""
    assert read(scene({1: standing(20, 10), 2: follower(4, 3, 2, 0, 1.5)})).contact.distance == 0.5


def test_only_frames_that_exist_count() -> None:
    """The recording ends after three frames: the accident that is predicted later is not seen."""
    cars = {1: standing(20, 10), 2: follower(4, 3, 2, 0.5, 1.5)}
    label = scene(cars, frames=3)
    made = result(as_maps(scene(cars)), label)
    assert tallies(made) == [(0, 0, 0)] * 3
    assert tallies(result(as_heads(scene(cars)), label)) == [(0, 0, 0)] * 3


def test_whom_the_truth_names() -> None:
    label = scene(HIT | {3: standing(20, 30)})

    def named(*contexts, of=label):
        outputs = as_maps(of)
        return PAPER.result([PAPER.counts(outputs, of, context) for context in contexts]).truths

    meta, another = (AccidentContext(pair=pair, known=True) for pair in ((2, 1), (1, 3)))
    normal, silent = AccidentContext(known=True), AccidentContext()
    assert named(meta, another, normal, silent) == {"meta": 1, "another": 2, "none": 0, "unknown": 1}
    assert named(meta, of=scene(CALM))["none"] == 1


def test_the_ego_s_own_box_is_the_agent_itself() -> None:
    label = scene({5: [(20 - 4 * t, 0.0) for t in range(4)] + [(4.5, 0.0)]}, draw_ego=True)
    own = AccidentContext(pair=(5, 77), known=True, own_actor_id=77)
    for output in (as_maps(label), as_heads(label)):
        assert PAPER.counts(output, label, own)["named"] == "meta"
        assert PAPER.counts(output, label, replace(own, own_actor_id=None))["named"] == "unknown"


def test_what_cannot_be_compared() -> None:
    label, other = scene(HIT), BevGrid(x=(-25, 25, 0.25), y=(-25, 25, 0.25))
    for error, words, refused in (
        (
            EvaluationError,
            "expected a MotionOutput or a list of Accidents",
            lambda: PAPER.counts([(20.0, 10.0)], label, AccidentContext()),
        ),
        (EvaluationError, "needs the sample's motion labels", lambda: PAPER.counts([alarm()], None, AccidentContext())),
        (
            EvaluationError,
            "needs the sample's motion labels",
            lambda: PAPER.counts(as_maps(label), None, AccidentContext()),
        ),
        (
            EvaluationError,
            "expected those of the label protocol 'released'",
            lambda: PAPER.counts(as_maps(label), scene(HIT, protocol="clean"), AccidentContext()),
        ),
        (
            EvaluationError,
            "expected at least 5 frames from the present on, found 3",
            lambda: PAPER.counts(
                MotionOutput(grid=label.config.grid, instances=label.instance[None, :3]), label, AccidentContext()
            ),
        ),
        (
            EvaluationError,
            "make both with the same grid",
            lambda: PAPER.counts(MotionOutput(grid=other, instances=label.instance[None]), label, AccidentContext()),
        ),
        (
            EvaluationError,
            "present frame is not in the recording",
            lambda: PAPER.counts(as_maps(label), scene(HIT, frames=0), AccidentContext()),
        ),
        (ChoiceError, "sample_choice: expected one of best, mean_first", lambda: PaperAccidents(sample_choice="worst")),
        (ConfigError, "danger_distance", lambda: AccidentReading(danger_distance=0)),
    ):
        with pytest.raises(error, match=words):
            refused()


def alarm(x=0.0, score=1.0, time=1.5, ids=None) -> Accident:
    """Of HIT, both positions `x` metres farther ahead."""
    return Accident(positions=np.array([[15.5 + x, 10.0], [20.0 + x, 10.0]]), time=time, score=score, ids=ids)


def test_an_explicit_accident_is_compared_with_the_labels_instance_map() -> None:
    label = scene(HIT)
    made = result([alarm()], label)
    assert tallies(made) == [(1, 0, 0)] * 3
    assert (made.id_error, made.position_error, made.time_error) == (0, 0, 0)
    assert "1 of 1 predictions were given as explicit accidents" in made.notes[0]
    assert tallies(result([alarm(x=3)], label)) == [(0, 1, 1), (1, 0, 0), (1, 0, 0)]
    assert result([alarm(time=1.2)], label).time_error == pytest.approx(0.3)
    assert tallies(result([], label)) == [(0, 0, 1)] * 3
    assert tallies(result([alarm()], scene(CALM))) == [(0, 1, 0)] * 3
    assert tallies(result([], scene(CALM))) == [(0, 0, 0)] * 3


def test_the_surest_explicit_accident_counts_and_of_equally_sure_ones_the_earliest() -> None:
    label = scene(HIT)
    unsure, elsewhere = alarm(score=0.5), alarm(x=40)
    for alarms in ([unsure, elsewhere], [elsewhere, unsure]):
        assert tallies(result(alarms, label)) == [(0, 1, 1)] * 3
    early, late = alarm(x=1, time=1.0), alarm(time=1.5)
    assert result([late, early], label).position_error == 2


def test_explicit_accidents_after_the_labels_end_are_cut_like_maps() -> None:
    label = scene({1: standing(20, 10), 2: follower(4, 0.5, 1.5, 9, 9)}, frames=3)
    assert tallies(result([alarm(time=1.25)], label)) == [(1, 0, 0)] * 3
    later = [alarm(time=1.3), alarm(score=0.5, time=1.0)]
    assert result(later, label).time_error == 0.5
    assert tallies(result(later[:1], label)) == [(0, 0, 1)] * 3


def test_whom_an_explicit_accident_names() -> None:
    label = scene(HIT | {3: standing(15.5, 13)})
    assert result([alarm(ids=(2, 1))], label).id_error == 0
    assert result([alarm(ids=(2, 3))], label).id_error == 1
    aside = Accident(positions=np.array([[15.5, 11.6], [20.0, 10.0]]), time=1.5)
    assert result([aside], label).id_error == 1  # the third is nearer
    assert result([replace(aside, positions=aside.positions - [0, 0.2])], label).id_error == 0
    assert result([alarm(time=0.2)], label).id_error == 1  # the second is still 3.5 m behind, the third there
    assert result([alarm(x=4.1)], label).id_error == 1


def test_ids_of_an_explicit_accident_are_actors_the_own_one_among_them() -> None:
    label = scene({5: [(20 - 4 * t, 0.0) for t in range(4)] + [(4.5, 0.0)]}, draw_ego=True)
    own = AccidentContext(pair=(5, 77), known=True, own_actor_id=77)
    predicted = [Accident(positions=np.array([[4.5, 0.0], [0.0, 0.0]]), time=2.0, ids=(77, 5))]
    assert result(predicted, label, context=own).id_error == 0
    assert result(predicted, label, context=replace(own, own_actor_id=76)).id_error == 1
    assert result(predicted, label, context=replace(own, own_actor_id=None)).id_error is None


def test_orientations_of_prediction_and_label_may_differ() -> None:
    label, predicted = scene(HIT), scene(moved(HIT, y=1))
    expected = PAPER.counts(as_maps(predicted), label, AccidentContext())
    for orientation in ORIENTATIONS:
        lying = scene(moved(HIT, y=1), orientation=orientation)
        assert PAPER.counts(as_maps(lying), label, AccidentContext()) == expected


def test_choices_change_the_result() -> None:
    label = scene(HIT)

    def evaluated(**choices: object) -> AccidentEvaluator:
        evaluator = AccidentEvaluator(protocol=replace(PAPER, **choices))
        evaluator.update("one", as_heads(*[scene(moved(HIT, y=2.5))] * 2), label)
        evaluator.update("two", as_maps(label), label)
        return evaluator

    assert evaluated().compute().within[5.0].tp == 1
    assert evaluated(reading=AccidentReading(danger_distance=0.5)).compute().positives == 0
