"""Warnings: hand-made recordings with known answers, laws of counting, and the labels of a synthetic release."""

import json
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from accident_scenes import as_heads, as_maps, scene, standing
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError
from deepaccident_devkit.evaluation import Accident, Resampling, breakdown, sample_attributes
from deepaccident_devkit.evaluation.metrics.accident import AccidentContext, BoxTruth, accident_context, box_truth
from deepaccident_devkit.evaluation.metrics.alarms.reading import AccidentReading
from deepaccident_devkit.evaluation.metrics.numbers import numbers_of
from deepaccident_devkit.evaluation.metrics.warning import WARNING_PROTOCOLS, WarningEvaluator, WarningProtocol

PAIR = (11, 22)
MEETING = np.array([[20.0, 10.0], [16.0, 10.0]])
LAST = 61
"""The recorded frame of the impact, or of the recording's end; samples are half a second apart."""


def alarm(x=0.0, score=1.0, time=1.0, ids=None) -> Accident:
    """At the meeting place, both positions `x` metres farther ahead."""
    return Accident(positions=MEETING + np.array([x, 0.0]), time=time, score=score, ids=ids)


RIGHT = alarm(ids=PAIR)
FALSE = alarm(x=50, ids=(33, 44))


def context(frame, kind="accident", last=LAST) -> AccidentContext:
    """Two stand apart where they will meet; the boxes are known for 2 s."""
    ahead = (last - frame) / 10
    moments = min(20, last - frame) + 1
    boxes = np.concatenate([MEETING, [[4.0, 2.0, 0.0]] * 2], axis=1)
    impact = Accident(positions=MEETING, time=ahead, ids=PAIR) if kind == "accident" else None
    truth = BoxTruth(
        time=np.arange(moments) / 10,
        actor_id=np.array(PAIR),
        footprint=np.tile(boxes, (moments, 1, 1)),
        accident=impact if ahead <= 2 else None,
        impact=impact,
    )
    return AccidentContext(
        pair=PAIR if impact else None,
        known=True,
        truth=truth,
        time_to_impact=ahead if impact else None,
        time_to_end=ahead,
        twin={"accident": False, "twins": True, "others": None}[kind],
    )


def drive(evaluator, name, alarms, kind="accident", last=LAST) -> None:
    """Samples of one recording: seconds before its last frame → alarms."""
    for ahead, raised in alarms.items():
        frame = last - round(10 * ahead)
        given_alarms = raised if isinstance(raised, list) else [raised]
        evaluator.update(f"t/{name}/ego_vehicle/{frame:03d}", given_alarms, None, context(frame, kind, last))


def result(*recordings, protocol="boxes"):
    """Each recording is alarms by seconds before its last frame, or those with its kind."""
    evaluator = WarningEvaluator(protocol)
    for number, each in enumerate(recordings):
        alarms, kind = each if isinstance(each, tuple) else (each, "accident")
        drive(evaluator, f"s{number}", alarms, kind)
    return evaluator.compute()


def every(start, stop=0.5, what=RIGHT, step=0.5):
    """The same alarms at all samples from `start` to `stop` seconds before the last frame."""
    return {ahead / 10: what for ahead in range(round(10 * start), round(10 * stop) - 1, -round(10 * step))}


def test_the_first_right_alarm_and_the_lasting_one() -> None:
    on_and_off = every(4, what=[]) | {3.0: RIGHT, 1.0: RIGHT, 0.5: RIGHT}
    at_last = every(4, what=FALSE) | {0.5: RIGHT}
    never = every(4, what=[])
    made = result(on_and_off, at_last, never)
    assert made.recordings == {"accident": 3, "normal": 0, "twins": 0, "others": 0}
    assert (made.warned_share, made.lasting_share) == (2 / 3, 2 / 3)
    assert_array_equal(made.warning_seconds, [0.5, 3.0])
    assert (made.mean_warning, made.median_warning) == (1.75, 1.75)
    assert (made.mean_lasting, made.median_lasting) == (0.75, 0.75)
    assert made.mean_reach == 4
    assert (made.alarms, made.precision) == (11, 4 / 11)


def test_a_lasting_alarm_ends_where_a_sample_is_missing() -> None:
    alarms = every(4)
    del alarms[2.0]
    assert result(alarms).mean_lasting == 1.5
    assert result(alarms).mean_warning == 4
    assert result(every(4) | {0.5: []}).lasting_share == 0


def test_detected_in_time_is_a_share_of_the_recordings_that_reach_back_so_far() -> None:
    early, late, short = every(4), every(4, what=[]) | {1.0: RIGHT}, every(1.5)
    made = result(early, late, short)
    assert made.detection_rate == {1.0: 1.0, 2.0: 0.5, 3.0: 0.5}
    assert made.detection_recordings == {1.0: 3, 2.0: 2, 3.0: 2}
    assert "only 2 of 3 accident recordings have samples 3 s before the impact" in made.notes


def test_leads_have_half_a_recorded_frame_of_slack() -> None:
    protocol = WarningProtocol(leads=(1.04, 1.06))
    made = result({1.5: [], 1.0: RIGHT}, protocol=protocol)
    assert made.detection_rate == {1.04: 1.0, 1.06: 0.0}


def test_at_the_impact_nobody_can_be_warned() -> None:
    made = result({0.5: [], 0.0: RIGHT}, {0.0: RIGHT})
    assert (made.samples, made.recordings["accident"]) == (3, 1)
    assert (made.warned_share, made.alarms) == (0, 0)


def test_false_alarms_a_minute_count_episodes() -> None:
    """Two, of which one lasts for a second; in twelve samples of half a second."""
    alarms = every(5.5, 0.0, []) | dict.fromkeys((5.0, 4.5, 4.0, 2.0), FALSE)
    made = result((alarms, "twins"), (every(5.5, 0.0, []), "others"), every(6))
    assert made.minutes == {"accident": 0.1, "normal": 0.2, "twins": 0.1, "others": 0.1}
    assert made.false_alarms == {"accident": 0, "normal": 2, "twins": 2, "others": 0}
    assert made.false_alarms_per_minute == pytest.approx({"accident": 0, "normal": 10, "twins": 20, "others": 0})


def test_a_missing_sample_ends_an_episode_and_is_not_counted_as_driven() -> None:
    alarms = every(5.5, 0.0, FALSE)
    assert result((alarms, "others")).false_alarms["normal"] == 1
    del alarms[3.0]
    made = result((alarms, "others"))
    assert made.false_alarms["normal"] == 2
    assert made.minutes["normal"] == pytest.approx(11 * 0.5 / 60)


def test_a_single_sample_stands_for_the_smallest_step_of_all() -> None:
    made = result(({2.0: FALSE}, "others"), every(2, step=0.2), every(2))
    assert made.minutes["others"] == pytest.approx(0.2 / 60)
    assert any("1 recordings have a single sample" in note for note in made.notes)
    alone = result(({2.0: FALSE}, "others"))
    assert (alone.false_alarms["others"], math.isnan(alone.false_alarms_per_minute["others"])) == (1, True)


def test_false_alarms_before_an_accident_count_apart() -> None:
    made = result(every(3, what=[]) | {3.0: [FALSE, RIGHT], 1.0: FALSE})
    assert made.false_alarms == {"accident": 2, "normal": 0, "twins": 0, "others": 0}
    assert made.false_alarms_per_minute["accident"] == pytest.approx(2 / (6 * 0.5 / 60))
    assert (made.warned_share, made.precision) == (1, 1 / 3)
    assert "no recording without an accident was evaluated" in made.notes[0]


def test_every_share_is_of_its_own_whole() -> None:
    """Three accidents, one of them warned of and one short; alarms in vain, and one that nothing refutes."""
    told = every(3, what=[]) | {2.0: RIGHT, 1.0: [RIGHT, FALSE, alarm(x=60)]}
    twin = every(5.5, 0.0, []) | {5.0: [FALSE, FALSE], 1.0: replace(FALSE, time=1.5)}
    recordings = told, every(3, what=[]), every(1.5, what=[]), (twin, "twins"), (every(5.5, 0.0, []), "others")
    made = result(*recordings, protocol=WarningProtocol(curve_lead=2.0))
    assert (made.samples, made.alarms, made.unjudged) == (39, 6, 1)
    assert (made.warned_share, made.lasting_share, made.precision) == (1 / 3, 0, 2 / 6)
    assert made.detection_rate == {1.0: 1 / 3, 2.0: 1 / 2, 3.0: 0}
    assert made.curve.detection_rate[-1] == 1 / 2
    assert made.false_alarms == {"accident": 1, "normal": 1, "twins": 1, "others": 0}
    minutes = {"accident": 0.125, "normal": 0.2, "twins": 0.1, "others": 0.1}
    assert made.minutes == pytest.approx(minutes)
    assert made.false_alarms_per_minute == pytest.approx({"accident": 8, "normal": 5, "twins": 10, "others": 0})
    nobody_told = result(every(3, what=[]))
    assert (nobody_told.warned_share, math.isnan(nobody_told.mean_warning)) == (0, True)
    assert math.isnan(nobody_told.precision)


@pytest.mark.parametrize(
    ("raised", "by_pair", "by_place"),
    [
        (alarm(ids=(22, 11)), True, True),
        (alarm(x=50, ids=PAIR), True, False),
        (alarm(ids=(11, 33)), False, True),
        (alarm(x=50, ids=(11, 33)), False, False),
        (alarm(x=1), True, True),  # without ids: the boxes at that time
        (alarm(x=4.5), False, True),
        (alarm(x=5), False, False),  # the differences of the two add up to 10 m
    ],
)
def test_what_makes_an_alarm_right(raised, by_pair, by_place) -> None:
    def warned(**choices):
        return result({1.0: raised}, protocol=WarningProtocol(**choices)).warned_share == 1

    assert warned() == (by_pair or by_place)
    assert warned(correct_by="pair") == by_pair
    assert warned(correct_by="place") == by_place


def test_choices_of_naming_and_time() -> None:
    def warned(raised, **choices):
        return result({1.0: raised}, protocol=WarningProtocol(**choices)).warned_share == 1

    assert warned(alarm(x=1), correct_by="pair")
    assert not warned(alarm(x=1), correct_by="pair", naming="given")
    assert not warned(alarm(x=1), correct_by="pair", match_distance=0.5)
    assert warned(alarm(x=4.5))
    assert not warned(alarm(x=4.5), distance=9.0)
    late = alarm(time=1.6, ids=PAIR)
    assert warned(late)
    assert not warned(late, time_tolerance=0.5)
    assert warned(late, time_tolerance=0.6)
    assert not warned(alarm(score=0.4), min_score=0.5)


def test_the_impact_may_be_later_than_the_model_looks_ahead() -> None:
    made = result({4.0: alarm(time=2.0), 3.5: []})
    assert made.mean_warning == 4


def test_what_the_recording_cannot_refute_is_left_out() -> None:
    def false(time, **choices):
        alarms = every(3, 0, []) | {1.0: replace(FALSE, time=time)}
        made = result((alarms, "others"), protocol=WarningProtocol(**choices))
        return made.false_alarms["normal"], made.unjudged

    assert false(1.0) == (1, 0)
    assert false(1.04) == (1, 0)  # within half a recorded frame
    assert false(1.06) == (0, 1)
    assert false(1.1, unjudged_are_false=True) == (1, 0)
    assert result(({3.0: replace(FALSE, time=2.9), 2.5: []}, "others")).unjudged == 0  # beyond the boxes' 2 s


def test_the_curve_over_the_score() -> None:
    sure, unsure = replace(RIGHT, score=0.9), replace(RIGHT, score=0.3)
    first = every(3, what=[]) | {3.0: unsure, 1.0: sure, 0.5: sure}
    second = every(3, what=[]) | {0.5: replace(RIGHT, score=0.6)}
    calm = every(5.5, 0.0, []) | {5.0: replace(FALSE, score=0.6), 4.5: replace(FALSE, score=0.3), 4.0: FALSE}
    made = result(first, second, (calm, "others"))
    curve = made.curve
    assert_array_equal(curve.threshold, [1.0, 0.9, 0.6, 0.3])
    assert_array_equal(curve.detection_rate, [0, 0.5, 0.5, 0.5])
    assert_allclose(curve.mean_warning, [np.nan, 1.0, 0.75, 1.75])
    assert_allclose(curve.false_alarms_per_minute, [10, 10, 20, 10])  # the last one: all three are one alarm
    assert_array_equal(curve.false_alarms_in_accidents, [0] * 4)
    assert curve.mean_warning[-1] == made.mean_warning
    assert curve.detection_rate[-1] == made.detection_rate[1.0]
    assert curve.false_alarms_per_minute[-1] == made.false_alarms_per_minute["normal"]


def test_a_curve_has_so_many_rows_at_most() -> None:
    alarms = {
        ahead: replace(RIGHT, score=score)
        for ahead, score in zip(every(6), np.linspace(0, 1, 12).tolist(), strict=True)
    }
    rows = result(alarms, protocol=WarningProtocol(curve_rows=4)).curve
    assert len(rows.threshold) == 4
    assert (rows.threshold[0], rows.threshold[-1]) == (1, 0)
    assert len(result(alarms).curve.threshold) == 12


scores = st.lists(st.tuples(st.sampled_from([0.2, 0.5, 0.8]), st.booleans()), max_size=2)
recordings = st.lists(
    st.tuples(
        st.sampled_from(["accident", "twins", "others"]), st.dictionaries(st.integers(0, 12), scores, min_size=1)
    ),
    min_size=1,
    max_size=4,
)


@given(recordings, st.randoms(use_true_random=False))
def test_a_curve_is_what_each_score_as_the_least_gives(drives, random) -> None:
    """Also: no order of samples, no parts and no pooling change a bit."""
    samples = []
    for number, (kind, alarms) in enumerate(drives):
        for place, raised in alarms.items():
            frame = LAST - 5 * place
            given_alarms = [replace(RIGHT if right else FALSE, score=score) for score, right in raised]
            samples.append((f"t/{number}/ego_vehicle/{frame:03d}", given_alarms, None, context(frame, kind)))
    whole = counted(samples)
    made = whole.compute()
    random.shuffle(samples)
    parts = counted(samples[::2]).merge(counted(samples[1::2]))
    assert bits(parts.compute()) == bits(made)
    by_recording: dict[str, list] = {}
    for token, counts in whole.counts.items():
        by_recording.setdefault(token.split("/")[1], []).append(counts)
    pooled = [tally for each in by_recording.values() for tally in whole.pooled(each)]
    assert bits(whole.result_of(pooled)) == bits(made)
    for row, threshold in enumerate(made.curve.threshold.tolist()):
        harder = counted(samples, WarningProtocol(min_score=threshold)).compute()
        assert_array_equal(made.curve.detection_rate[row], harder.detection_rate[1.0])
        assert_array_equal(made.curve.mean_warning[row], harder.mean_warning)
        assert_array_equal(made.curve.false_alarms_per_minute[row], harder.false_alarms_per_minute["normal"])
        assert_array_equal(made.curve.false_alarms_in_accidents[row], harder.false_alarms_per_minute["accident"])


def counted(samples, protocol="boxes") -> WarningEvaluator:
    evaluator = WarningEvaluator(protocol)
    for sample in samples:
        evaluator.update(*sample)
    return evaluator


def bits(made) -> str:
    return json.dumps(made.as_dict(), sort_keys=True)


def test_a_scenario_that_is_drawn_twice_counts_twice() -> None:
    evaluator = WarningEvaluator("boxes")
    drive(evaluator, "s", every(3))
    drive(evaluator, "n", every(3, 0, FALSE), "twins")
    pooled = evaluator.pooled(list(evaluator.counts.values()))
    twice = evaluator.result_of([*pooled, *pooled])
    once = evaluator.compute()
    assert twice.recordings == {kind: 2 * count for kind, count in once.recordings.items()}
    assert twice.false_alarms["twins"] == 2 * once.false_alarms["twins"]
    assert (twice.mean_warning, twice.warned_share) == (once.mean_warning, once.warned_share)


def test_maps_are_one_alarm_as_sure_as_the_share_of_them_that_see_it() -> None:
    cars = {1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]}
    hit, calm = scene(cars), scene({1: standing(20, 10)})
    for output in (as_maps(calm, hit), as_heads(hit, calm)):
        evaluator = WarningEvaluator("boxes")
        evaluator.update("t/s/ego_vehicle/041", output, hit, context(41))
        [counts] = evaluator.counts.values()
        assert counts["alarms"] == [[0.5, 1]]
    careful = WarningEvaluator(
        WarningProtocol(reading=AccidentReading(present=False, moment="last", danger_distance=0.1))
    )
    careful.update("t/s/ego_vehicle/041", as_maps(calm), None, context(41))
    assert careful.compute().alarms == 0


def test_results_can_be_copied_written_and_resumed(tmp_path) -> None:
    evaluator = WarningEvaluator("boxes")
    drive(evaluator, "s", every(3))
    drive(evaluator, "n", every(3, 0, []), "twins")
    made = evaluator.compute()
    assert bits(pickle.loads(pickle.dumps(made))) == bits(made)
    assert json.loads(json.dumps(made.as_dict(), allow_nan=False))["detection_rate"] == {"1": 1, "2": 1, "3": 1}
    with pytest.raises(ValueError, match="read-only"):
        made.curve.threshold[:] = 0
    with pytest.raises(TypeError, match="cannot be changed"):
        made.recordings["accident"] = 5
    assert bits(WarningEvaluator("boxes").resume(evaluator.save(tmp_path / "w.json")).compute()) == bits(made)
    empty = WarningEvaluator("boxes").compute()
    assert (empty.samples, len(empty.curve.threshold), empty.notes) == (0, 0, ())
    assert set(empty.minutes.values()) == {0}
    json.dumps(empty.as_dict(), allow_nan=False)


def test_choices_are_checked() -> None:
    protocol = WARNING_PROTOCOLS["boxes"]
    assert json.loads(json.dumps(protocol.settings())) == protocol.settings()
    assert WarningProtocol(leads=[1, 2]).leads == (1.0, 2.0)
    for choices, message in (
        ({"correct_by": "luck"}, "correct_by: expected one of either, pair, place"),
        ({"naming": "all"}, "naming: expected one of nearest, given"),
    ):
        with pytest.raises(ChoiceError, match=message):
            WarningProtocol(**choices)
    for choices, message in (
        ({"min_score": math.nan}, "min_score: expected a number"),
        ({"distance": 0}, "distance: expected metres above 0"),
        ({"match_distance": math.inf}, "match_distance: expected metres above 0"),
        ({"time_tolerance": -1}, "time_tolerance: expected seconds from 0"),
        ({"leads": (0.0,)}, "leads, curve_lead: expected seconds above 0, found 0.0"),
        ({"curve_lead": math.nan}, "leads, curve_lead: expected seconds above 0"),
        ({"curve_rows": 1}, "curve_rows: expected a whole number from 2"),
    ):
        with pytest.raises(ConfigError, match=message):
            WarningProtocol(**choices)
    with pytest.raises(ChoiceError, match="protocol: expected one of clean, boxes, field, found"):
        WarningEvaluator("released")


@pytest.mark.parametrize(
    ("token", "prediction", "label", "known", "message"),
    [
        ("s/ego_vehicle/x", [], None, context(41), "token: expected a sample's.*found 's/ego_vehicle/x'"),
        (41, [], None, context(41), "token: expected a sample's"),
        ("t/s/ego_vehicle/041", RIGHT, None, context(41), "wrap a single Accident in a list"),
        ("t/s/ego_vehicle/041", [], context(41), None, "label: expected MotionLabels or None, found AccidentContext"),
        ("t/s/ego_vehicle/041", [], None, None, "context: expected an AccidentContext, found NoneType"),
        ("t/s/ego_vehicle/041", [], None, AccidentContext(), "give accident_context.dataset, sample, horizon=2.0."),
    ],
)
def test_what_cannot_be_evaluated(token, prediction, label, known, message) -> None:
    with pytest.raises(EvaluationError, match=message):
        WarningEvaluator("boxes").update(token, prediction, label, known)


@pytest.fixture(scope="module")
def foreseen(da_motion: DeepAccident) -> WarningEvaluator:
    """Of two agents, every half second: foreseen for the last 2 s, and in the twin falsely 1 s before its end."""
    evaluator = WarningEvaluator("boxes")
    for scenario in da_motion.scenario:
        for agent in ("ego_vehicle", "infrastructure"):
            for frame in range(scenario["num_frames"], 0, -5):
                token = f"{scenario['token']}/{agent}/{frame:03d}"
                known = accident_context(da_motion, token, 2.0)
                here = known.truth.accident
                alarms = [replace(here, ids=None)] if here else []
                if known.twin and known.time_to_end == pytest.approx(1.0):
                    alarms = [alarm()]
                evaluator.update(token, alarms, None, known)
    return evaluator


def test_the_scenarios_of_a_release(da_motion: DeepAccident, foreseen: WarningEvaluator) -> None:
    made = foreseen.compute()
    assert made.recordings == {"accident": 2, "normal": 2, "twins": 2, "others": 0}
    assert made.warning_seconds.tolist() == [2.0, 2.0]
    assert (made.mean_lasting, made.mean_reach) == (2, 3)
    assert made.detection_rate == {1.0: 1.0, 2.0: 1.0, 3.0: 0.0}
    assert made.false_alarms == {"accident": 0, "normal": 2, "twins": 2, "others": 0}
    assert made.minutes["twins"] == pytest.approx(2 * 7 * 0.5 / 60)


def test_breakdowns_take_whole_clusters(da_motion: DeepAccident, foreseen: WarningEvaluator) -> None:
    attributes = sample_attributes(da_motion, foreseen.tokens)
    [everything] = breakdown(foreseen, attributes, "all", Resampling(resamples=20)).groups
    assert bits(everything.result) == bits(foreseen.compute())
    assert (everything.clusters, dict(everything.intervals)) == (1, {})
    assert not any("curve" in name for name in numbers_of(everything.result))
    by_agent = breakdown(foreseen, attributes, "agent", Resampling(resamples=2)).groups
    assert [group.result.recordings["accident"] for group in by_agent] == [1, 1]


def test_what_a_release_knows_of_a_sample(da_motion: DeepAccident) -> None:
    accident, normal = sorted(da_motion.scenario, key=lambda each: each["collision"] is None)
    token = f"{accident['token']}/ego_vehicle/{accident['num_frames'] - 30:03d}"
    known = accident_context(da_motion, token, 2.0)
    assert (known.time_to_impact, known.time_to_end, known.twin) == (pytest.approx(3), pytest.approx(3), False)
    assert known.truth.accident is None  # later than the horizon
    assert known.truth.impact.ids == known.pair
    farther = box_truth(da_motion, token, horizon=3.0)
    assert_array_equal(farther.accident.positions, known.truth.impact.positions)
    calm = accident_context(da_motion, f"{normal['token']}/ego_vehicle/005", 2.0)
    assert (calm.time_to_impact, calm.time_to_end, calm.twin) == (None, pytest.approx(3), True)
    assert calm.truth.impact is None


def test_twins_that_are_not_there_or_not_known(da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
    accident, normal = sorted(da_motion.scenario, key=lambda each: each["collision"] is None)
    token, found = f"{normal['token']}/ego_vehicle/005", da_motion.scenario.get

    def with_twin(**changed):
        def get(asked):
            assert asked == accident["token"]
            return {**found(asked), **changed}

        table = type("Table", (), {"get": staticmethod(get)})()
        monkeypatch.setattr(type(da_motion), "scenario", table, raising=False)
        return accident_context(da_motion, token).twin

    assert with_twin() is True
    assert with_twin(collision=None) is False
    assert with_twin(weather=None) is None


def test_a_siren_pays_in_precision_and_in_the_time_it_lasts() -> None:
    """Three recordings of accidents, of which it misses none, and three normal ones, in which it never stops."""
    siren = result(*[every(3)] * 3, *[(every(2.5, 0, FALSE), "twins")] * 3)
    assert (siren.warned_share, siren.tta0, siren.mean_warning) == (1, 3, 3)
    assert siren.recording_precision == 0.5
    assert (siren.time_in_alarm["normal"], siren.alarm_seconds_per_minute["normal"]) == (1, 60)
    assert siren.time_in_alarm["accident"] == 0
    assert siren.false_alarms["normal"] == 3


def test_shares_of_recordings_and_of_samples_are_of_all_of_them() -> None:
    """One of two accidents is warned of, two seconds before; one normal recording of four has an alarm, at a sixth."""
    warned, missed = every(3, what=[]) | {2.0: RIGHT}, every(3, what=[])
    alarmed, quiet = (every(2.5, 0, []) | {1.0: FALSE}, "twins"), (every(2.5, 0, []), "others")
    made = result(warned, missed, alarmed, quiet, quiet, quiet)
    assert (made.warned_share, made.tta0, made.mean_warning) == (1 / 2, 1, 2)
    assert made.recording_precision == 1 / 2
    assert made.time_in_alarm == {"accident": 0, "normal": 1 / 24, "twins": 1 / 6, "others": 0}
    assert made.alarm_seconds_per_minute["normal"] == 2.5


def test_an_alarm_for_later_than_the_horizon_is_none() -> None:
    evaluator = WarningEvaluator("boxes")
    there = context(31)
    evaluator.update("t/s/ego_vehicle/031", [alarm(time=900.0, ids=PAIR)], None, there)
    assert evaluator.compute().warned_share == 1  # nothing bounds this context
    evaluator = WarningEvaluator("boxes")
    bounded = replace(there, truth=replace(there.truth, horizon=2.0))
    evaluator.update("t/s/ego_vehicle/031", [alarm(time=900.0, ids=PAIR)], None, bounded)
    made = evaluator.compute()
    assert (made.warned_share, made.alarms, made.beyond) == (0, 0, 1)


def test_the_notes_say_what_was_not_evaluated() -> None:
    def notes(kind: str) -> str:
        evaluator = WarningEvaluator("boxes")
        drive(evaluator, "t/s", every(2.0), kind)
        return "\n".join(evaluator.compute().notes)

    assert "no recording of an accident was evaluated" in notes("twins")
    assert "no recording of an accident was evaluated" not in notes("accident")
    assert "no recording without an accident was evaluated" in notes("accident")
