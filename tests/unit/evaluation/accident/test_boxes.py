import json
import math
from dataclasses import replace

import numpy as np
import pytest
from accident_scenes import as_heads, as_maps, scene, standing
from numpy.testing import assert_allclose

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import AccidentEvaluator, BoxTruth, accident_context, box_truth
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident_truth import UNPLACED_NOTE, AccidentContext
from deepaccident_devkit.evaluation.map_accidents import AccidentReading
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.motion import OWN_BOX_ID
from deepaccident_devkit.taxonomy import AGENTS

BOXES = BoxAccidents()
STEPS = 21
FIRST, SECOND, THIRD = 11, 22, 33


def truth_of(gaps, pair=(FIRST, SECOND), seconds=2.0, at=None) -> BoxTruth:
    """A car at (20, 10), one behind it with these gaps every tenth of a second, and others that stand `at` places."""
    count = len(gaps)
    rows = {
        FIRST: np.tile([20.0, 10.0], (count, 1)),
        SECOND: np.column_stack([20.0 - 4.0 - np.array(gaps), np.full(count, 10.0)]),
        **{actor: np.tile(place, (count, 1)) for actor, place in (at or {}).items()},
    }
    centers = np.stack([rows[actor] for actor in sorted(rows)], axis=1)
    boxes = np.concatenate([centers, np.broadcast_to([4.0, 2.0, 0.0], (*centers.shape[:2], 3))], axis=-1)
    accident = None
    if pair:
        accident = Accident(positions=np.array([rows[actor][-1] for actor in pair]), time=seconds, ids=pair)
    return BoxTruth(time=np.arange(count) / 10, actor_id=np.array(sorted(rows)), footprint=boxes, accident=accident)


CRASH = truth_of(np.linspace(10, 0, STEPS))
PASSING = truth_of(np.linspace(20, 10, STEPS), pair=None)
META = AccidentContext(pair=(SECOND, FIRST), known=True)


def alarm(x=0.0, time=2.0, score=1.0, ids=None) -> Accident:
    """Of the crash, both `x` metres farther ahead than they are."""
    return Accident(positions=np.array([[16.0 + x, 10.0], [20.0 + x, 10.0]]), time=time, score=score, ids=ids)


def lateral(y) -> Accident:
    """Of the crash, the second one so many metres to the left."""
    return Accident(positions=np.array([[20.0, 10.0], [16.0, 10.0 + y]]), time=2.0)


def counted(prediction, truth, protocol=BOXES, context=META):
    return protocol.counts(prediction, None, replace(context, truth=truth))


def result(prediction, truth, protocol=BOXES):
    return protocol.result([counted(prediction, truth, protocol)])


def tallies(made):
    return [(each.tp, each.fp, each.fn) for each in made.within.values()]


def test_the_right_alarm() -> None:
    made = result([alarm(ids=(FIRST, SECOND))], CRASH)
    assert (made.apa, made.precision, made.recall, made.average_precision) == (1, 1, 1, 1)
    assert (made.id_error, made.position_error, made.time_error, made.lateness) == (0, 0, 0, 0)
    assert made.truths["meta"] == 1
    assert made.false_alarm_rate is None


def test_no_alarm_and_nothing_to_warn_of() -> None:
    missed, calm = result([], CRASH), result([], PASSING)
    assert tallies(missed) == [(0, 0, 1)] * 3
    assert (missed.recall, missed.average_precision, missed.precision) == (0, 0, None)
    assert tallies(calm) == [(0, 0, 0)] * 3
    assert math.isnan(calm.apa)
    assert (calm.recall, calm.false_alarm_rate, calm.negatives) == (None, 0, 1)


@pytest.mark.parametrize(("x", "tp"), [(2, [1, 1, 1]), (2.5, [0, 1, 1]), (5, [0, 0, 1]), (7.5, [0, 0, 0])])
def test_an_alarm_elsewhere(x, tp) -> None:
    made = result([alarm(x)], CRASH)
    assert tallies(made) == [(hit, 1 - hit, 1 - hit) for hit in tp]


def test_every_alarm_counts_and_the_surest_of_those_near_enough_is_the_right_one() -> None:
    alarms = [alarm(1, time=1.5, score=0.6), alarm(40, score=0.9), alarm(2, time=2.5, score=0.7)]
    made = result(alarms, CRASH)
    assert tallies(made) == [(1, 2, 0)] * 3
    assert made.position_error == 4
    assert (made.time_error, made.lateness) == (0.5, 0.5)
    assert made.average_precision == 0.5  # the surer alarm was false
    assert made.precision == pytest.approx(1 / 3)
    below = [*alarms, alarm(0, score=-0.1)]  # none
    assert tallies(result(below, CRASH)) == [(1, 2, 0)] * 3


def test_equally_sure_alarms_are_one_step_of_the_precision() -> None:
    made = result([alarm(40, time=1.0, score=0.5), alarm(0, score=0.5)], CRASH)
    assert made.average_precision == 0.5


def test_ids_are_those_of_actors_in_any_order() -> None:
    assert result([alarm(ids=(FIRST, THIRD))], CRASH).id_error == 1
    assert result([alarm(ids=(SECOND, FIRST))], CRASH).id_error == 0


def test_without_ids_the_nearest_boxes_at_that_time_are_named() -> None:
    assert result([alarm()], CRASH).id_error == 0
    assert result([alarm(x=-1.9)], CRASH).id_error == 0
    beside = truth_of(np.linspace(10, 0, STEPS), at={THIRD: (16.0, 12.0)})
    assert result([alarm()], beside).id_error == 0
    assert result([lateral(1.1)], beside).id_error == 1  # the other car is nearer
    left = truth_of(np.linspace(10, 0, STEPS), at={THIRD: (16.0, 10.0)})
    boxes = left.footprint.copy()
    boxes[-1, 2] = np.nan
    before = replace(left, footprint=boxes)
    assert result([alarm(time=1.9)], before).id_error == 1  # then the other was there
    assert result([alarm(time=2.0)], before).id_error == 0


def test_who_is_named_later_than_the_truth_goes_on_is_near_at_its_last_moment() -> None:
    assert result([alarm(time=7.0)], CRASH).id_error == 0


def test_two_positions_name_two_actors() -> None:
    """The second position is nearer to the first car, which is taken; nobody else is near enough, or near at all."""
    close = Accident(positions=np.array([[20.0, 10.0], [18.5, 10.0]]), time=2.0)
    assert result([close], CRASH).id_error == 0
    nobody = replace(CRASH, footprint=np.full_like(CRASH.footprint, np.nan))
    assert result([alarm()], nobody).id_error == 1


def test_what_the_recording_cannot_refute_is_not_judged() -> None:
    calm = result([alarm(time=2.1)], PASSING)
    assert (tallies(calm)[0], calm.unjudged) == ((0, 0, 0), 1)
    refuted = result([alarm(time=2.0)], PASSING)
    assert (tallies(refuted)[0], refuted.unjudged, refuted.false_alarm_rate) == ((0, 1, 0), 0, 1)


def test_whom_the_boxes_bring_near() -> None:
    def named(truth, context=META):
        return counted([], truth, context=context)["named"]

    assert named(CRASH) == "meta"
    assert named(CRASH, AccidentContext(pair=(FIRST, THIRD), known=True)) == "another"
    assert named(CRASH, AccidentContext()) == "unknown"
    assert named(PASSING) == "none"
    assert truth_of(np.linspace(10, 1, STEPS)).nearest_pair(1.0) is None
    assert truth_of(np.linspace(10, 0.9, STEPS)).nearest_pair(1.0) == (FIRST, SECOND)
    parked = truth_of(np.linspace(10, 0.9, STEPS), at={THIRD: (40.0, 30.0), 44: (40.0, 32.5)})
    assert parked.nearest_pair(1.0) == (FIRST, SECOND)  # the two that stand side by side are none
    touched_first = truth_of(np.linspace(5, 0, STEPS), at={THIRD: (11.0, 12.1)})
    assert touched_first.nearest_pair(1.0) == (FIRST, SECOND)


def test_maps_are_one_alarm_as_sure_as_the_share_of_them_that_see_it() -> None:
    cars = {1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]}
    right, calm = scene(cars), scene({1: standing(20, 10)})
    for output in (as_maps(calm, right, right, calm), as_heads(calm, right, right, calm)):
        counts = counted(output, CRASH)
        assert [(one["score"], one["time"], one["id"]) for one in counts["alarms"]] == [(0.5, 0, 0)]
        assert counts["alarms"][0]["position"] == pytest.approx(0.5, abs=0.3)
    assert counted(as_maps(calm), CRASH)["alarms"] == []
    other = scene({1: standing(20, 12), 2: [(x, 12.5) for x, _ in cars[2]]})
    assert counted(as_maps(right, other), CRASH)["alarms"][0]["position"] == pytest.approx(4.5, abs=0.5)  # the mean's
    assert counted(as_maps(other, right), CRASH)["alarms"][0]["position"] == pytest.approx(0.5, abs=0.3)
    strangers = {1: standing(20, 30), 2: [(16.0 - gap, 30.5) for gap in (10, 7.5, 5, 2.5, 0)]}
    assert counted(as_maps(scene(strangers)), CRASH)["alarms"][0]["id"] == 1


def test_side_by_side_is_an_accident_in_maps_by_the_papers_reading_alone() -> None:
    """Cells of neighbours are 0.5 m apart, and so are those of two that touch squarely along the grid."""
    beside = {1: standing(20, 10), 2: [(15.0 + 2.5 * frame, 12.5) for frame in range(5)]}
    squarely = {1: standing(20, 10), 2: [(16.0 - gap, 10.0) for gap in (10, 7.5, 5, 2.5, 0)]}
    stricter = BoxAccidents(reading=AccidentReading(danger_distance=0.5))
    for cars in (beside, squarely):
        assert len(counted(as_maps(scene(cars)), PASSING)["alarms"]) == 1
        assert counted(as_maps(scene(cars)), PASSING, stricter)["alarms"] == []


def test_tracks_at_the_frames_of_maps() -> None:
    center = truth_of(np.linspace(2, 0, 16)).tracks(0.5, 5).center
    assert_allclose(center[:, 1, 0], [14, 14 + 2 / 3, 14 + 4 / 3, 16, np.nan])


def test_maps_are_not_cut_at_the_end_of_the_recording() -> None:
    """The impact is half a second ahead; the model sees it a second ahead."""
    soon = truth_of(np.linspace(2, 0, 6), seconds=0.5)
    cars = {1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (2, 1.0, 0, 1.0, 2)]}
    made = result(as_maps(scene(cars)), soon)
    assert (made.recall, made.lateness) == (1, 0.5)


def test_the_labels_of_a_release(da_motion: DeepAccident) -> None:
    scenario = next(each for each in da_motion.scenario if each["collision"])
    token = f"{scenario['token']}/other_vehicle/{scenario['num_frames'] - 15:03d}"
    truth = box_truth(da_motion, token)
    contact = da_motion.collision(scenario)
    assert truth.accident.time == pytest.approx(1.5)
    assert truth.accident.ids == contact.actor_ids
    assert len(truth.time) == 16
    world_from_ego = da_motion.world_from(token, "ego")
    for actor, position in zip(contact.actor_ids, truth.accident.positions, strict=True):
        path = da_motion.trajectory(f"{scenario['token']}/actor/{actor}", token, "ego")
        assert_allclose(position, path.center[-1, :2], atol=1e-9)
        [seen] = np.flatnonzero(truth.actor_id == actor)
        assert_allclose(truth.footprint[:, seen, :2], path.center[-16:, :2], atol=1e-9)
        assert_allclose(
            world_from_ego @ path.center, da_motion.trajectory(f"{scenario['token']}/actor/{actor}").center, atol=1e-6
        )
    assert set(truth.nearest_pair(1.0)) == set(contact.actor_ids)
    context = accident_context(da_motion, token, horizon=2.0)
    perfect = [Accident(positions=truth.accident.positions[::-1], time=1.5, ids=contact.actor_ids)]
    made = BOXES.result([BOXES.counts(perfect, None, context)])
    assert (made.apa, made.truths["meta"]) == (1, 1)
    assert box_truth(da_motion, token, horizon=1.0).accident is None
    # half a recorded frame of slack
    assert box_truth(da_motion, token, horizon=1.46).accident.time == truth.accident.time
    assert box_truth(da_motion, token, horizon=1.44).accident is None
    assert len(box_truth(da_motion, token, horizon=1.0).time) == 11


def test_normal_scenarios_have_no_accident(da_motion: DeepAccident) -> None:
    scenario = next(each for each in da_motion.scenario if not each["collision"])
    context = accident_context(da_motion, f"{scenario['token']}/infrastructure/010", horizon=2.0)
    assert context.truth.accident is None
    assert context.known
    assert context.pair is None
    assert context.own_actor_id is None
    assert accident_context(da_motion, f"{scenario['token']}/ego_vehicle/010").truth is None


def test_label_maps_against_the_boxes_of_a_release(da_motion: DeepAccident) -> None:
    """Of the colliding pair alone, where both are seen: nothing is lost in the rasters but half a cell of place."""
    evaluator = AccidentEvaluator(protocol=BOXES)
    scenario = next(each for each in da_motion.scenario if each["collision"])
    for agent in AGENTS:
        token = f"{scenario['token']}/{agent}/{scenario['num_frames'] - 10:03d}"
        label = da_motion.motion_labels(token).to_present("bilinear")
        ids = dict(label.id_map)
        own = da_motion.get("agent", f"{scenario['token']}/{agent}")["actor_id"]
        pair = [ids.get(OWN_BOX_ID if actor == own else actor) for actor in scenario["collision"]["ids"]]
        if None not in pair:
            of_pair = replace(label, instance=np.where(np.isin(label.instance, pair), label.instance, 0))
            evaluator.update(token, as_maps(of_pair), label, accident_context(da_motion, token, horizon=2.0))
    made = evaluator.compute()
    assert len(evaluator.counts) > 1
    json.dumps([made.as_dict(), evaluator.settings, dict(evaluator.counts)])
    assert made.recall == 1
    assert made.id_error == 0
    assert made.position_error < 0.71


def test_what_cannot_be_evaluated(da_motion: DeepAccident) -> None:
    with pytest.raises(EvaluationError, match="accident_context"):
        BOXES.counts([alarm()], None, META)
    with pytest.raises(EvaluationError, match="list of Accidents"):
        counted([(1, 2)], CRASH)


def test_a_pair_that_no_label_shows(da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = next(each for each in da_motion.scenario if each["collision"])
    token = f"{scenario['token']}/ego_vehicle/{scenario['num_frames'] - 10:03d}"
    given = da_motion.get

    def get(table, row):
        record = given(table, row)
        if table == "scenario":
            record["collision"] = {**record["collision"], "ids": [999_999, 999_998]}
        return record

    monkeypatch.setattr(da_motion, "get", get)
    truth = box_truth(da_motion, token)
    assert (truth.accident, truth.impact, truth.unplaced) == (None, None, pytest.approx(1.0))
    made = result([alarm(time=1.0)], truth)
    assert (made.unplaced, made.samples, made.precision) == (1, 0, None)
    assert UNPLACED_NOTE.format(1) in made.notes
    assert result([alarm(time=0.5)], replace(truth, horizon=0.5)).unplaced == 0  # it comes later: nothing is left out


def test_counts_that_earlier_versions_kept_do_not_say_what_was_unplaced() -> None:
    kept = [counted([alarm()], CRASH), counted([], PASSING)]
    for now in (kept, BOXES.pooled(kept)):
        before = [{name: value for name, value in each.items() if name != "unplaced"} for each in now]
        assert BOXES.result(before) == BOXES.result(kept)


def test_an_alarm_for_later_than_the_horizon_is_none() -> None:
    """900 s off it was as good as the truth once."""
    crash = replace(CRASH, horizon=2.0)
    made = result([alarm(time=900.0)], crash)
    assert (made.apa, made.precision, made.recall, made.beyond) == (0, None, 0, 1)
    assert tallies(made) == [(0, 0, 1)] * 3
    assert result([alarm(time=2.04)], crash).apa == 1
    assert result([alarm(time=2.06)], crash).beyond == 1
    assert result([alarm(time=900.0, score=0.9), alarm(score=0.5)], crash).apa == 1
    assert "1 alarms are for later than the horizon and do not count" in made.notes


def test_at_the_impact_itself_nothing_is_foreseen() -> None:
    impact = truth_of([0.0], seconds=0.0)
    made = result([alarm(time=0.0)], impact)
    assert (made.samples, made.positives, made.negatives, made.at_impact) == (0, 0, 0, 1)
    assert math.isnan(made.apa)
    assert (made.precision, made.false_alarm_rate) == (None, None)
    both = BOXES.result([counted([alarm(time=0.0)], impact), counted([alarm()], CRASH)])
    assert replace(both, at_impact=0) == result([alarm()], CRASH)
    assert result([alarm(time=0.1)], truth_of([0.5, 0.0], seconds=0.1)).apa == 1


def test_where_no_accident_comes_there_is_no_accuracy_but_false_alarms() -> None:
    """An APA of 0.000 said nothing: no predictor could have had more."""
    made = result([alarm(time=1.0)], PASSING)
    assert math.isnan(made.apa)
    assert all(math.isnan(each.accuracy) for each in made.within.values())
    assert (made.recall, made.false_alarm_rate) == (None, 1.0)
    assert tallies(made) == [(0, 1, 0)] * 3
    some = BOXES.result([counted([alarm(time=1.0)], PASSING), counted([alarm()], CRASH)])
    assert some.apa == pytest.approx(1 / 1.5)
