"""What happens after a sample: whose boxes come near, and what constant velocities lead to."""

import math
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.alarms.truth import (
    AccidentContext,
    BoxTruth,
    accident_context,
    box_truth,
    checked_facts,
    constant_velocity_alarms,
)
from deepaccident_devkit.evaluation.metrics.predictions import Accident
from deepaccident_devkit.geometry import Boxes


def truth_of(*paths: list[tuple[float, float]], **columns: Any) -> BoxTruth:
    """Cars of 4 m × 2 m that look ahead, by their places at each tenth of a second."""
    center = np.array(paths, dtype=np.float64).swapaxes(0, 1)
    footprint = np.concatenate([center, np.broadcast_to([4.0, 2.0, 0.0], (*center.shape[:2], 3))], axis=2)
    values = {"accident": None, "actor_id": np.arange(1, len(paths) + 1) * 10, **columns}
    return BoxTruth(time=np.arange(len(center)) / 10, footprint=footprint, **values)


def test_who_stands_all_the_time_is_in_no_pair_with_another_who_does() -> None:
    still = [(0.0, 0.0)] * 3
    for moved, pair in ((0.49, None), (0.5, (10, 20))):
        assert truth_of(still, [(0, 2.0), (0, 2.0 + moved), (0, 2.0)]).nearest_pair(1.0) == pair
    both = truth_of([(0, 0), (1, 0)], [(0, 2.5), (1, 2.5)])
    assert (both.nearest_pair(0.5), both.nearest_pair(0.51)) == (None, (10, 20))


def test_of_several_pairs_the_nearest_is_taken_then_the_earliest_then_that_of_the_first_rows() -> None:
    far, away, moving = (90.0, 90.0), (-90.0, 90.0), [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
    nearest = truth_of(moving, [(0, 2.9), far, far], [away, away, (2, 2.2)])
    assert nearest.nearest_pair(1.0) == (10, 30)
    earliest = truth_of(moving, [far, far, (2, 2.5)], [away, (1, 2.5), away])
    assert earliest.nearest_pair(1.0) == (10, 30)
    first = truth_of(moving, [far, (1, 2.5), far], [away, (1, -2.5), away])
    assert first.nearest_pair(1.0) == (10, 20)
    gone = truth_of(moving, [(math.nan, math.nan), (1, 2.5), (math.nan, math.nan)])
    assert gone.nearest_pair(1.0) == (10, 20)
    assert truth_of(moving).nearest_pair(1.0) is None


def test_tracks_end_with_the_window() -> None:
    truth = truth_of([(float(frame), 0.0) for frame in range(6)])
    assert truth.tracks(0.25, 3).center[:, 0, 0].tolist() == [0, 2, 5]
    ended = truth.tracks(0.3, 3).center
    assert (ended[:2, 0, 0].tolist(), bool(np.isnan(ended[2]).all())) == ([0, 3], True)
    assert truth.tracks(0.1, 0).center.shape == (0, 1, 2)


@pytest.mark.parametrize(("unplaced", "said"), [(None, False), (2.05, True), (2.06, False), (0.0, True)])
def test_an_unplaced_accident_comes_within_half_a_frame_of_the_horizon(unplaced: float | None, said: bool) -> None:
    assert truth_of([(0.0, 0.0)], horizon=2.0, unplaced=unplaced).is_unplaced is said


def test_a_context_without_facts_knows_nothing() -> None:
    context = AccidentContext()
    assert (context.pair, context.known, context.own_actor_id, context.truth, context.references) == (
        None,
        False,
        None,
        None,
        {},
    )
    assert truth_of([(0.0, 0.0)]).horizon == math.inf
    checked_facts(None, None)
    checked_facts(None, context)
    for label, given, words in (
        (context, None, "label: expected MotionLabels or None, found AccidentContext"),
        (None, 3, "context: expected AccidentContext or None, found int"),
    ):
        with pytest.raises(EvaluationError, match=words):
            checked_facts(label, given)


def moving(*rows: tuple[float, float, float]) -> Boxes:
    """Cars of 4 m × 2 m at x, y with a speed ahead each; ids 1, 2, …"""
    center = np.array([(x, y, 0.0) for x, y, _ in rows])
    velocity = np.array([(speed, 0.0, 0.0) for *_, speed in rows])
    size, yaw, ids = np.tile([4.0, 2.0, 1.5], (len(rows), 1)), np.zeros(len(rows)), np.arange(1, len(rows) + 1)
    return Boxes.from_arrays(center, size, yaw, frame="ego", velocity=velocity, actor_id=ids)


@pytest.mark.parametrize(
    ("gap", "speed", "seconds"), [(5.8, 2.0, 2.9), (6.0, 2.0, None), (0.0, 2.0, 0.0), (0.1, 0.1, 1)]
)
def test_who_collides_in_less_than_3_seconds_raises_an_alarm(gap: float, speed: float, seconds: float | None) -> None:
    found = constant_velocity_alarms(moving((0, 0, speed), (4 + gap, 0, 0.0)), {}, None)
    assert [each.time for each in found] == pytest.approx([] if seconds is None else [seconds])
    if seconds is not None:
        assert found[0].score == pytest.approx(1 - seconds / 3)
        assert found[0].positions.tolist() == [pytest.approx([gap, 0]), [4 + gap, 0]]
        assert found[0].ids == (1, 2)


def test_slower_than_a_tenth_of_a_metre_a_second_is_no_danger() -> None:
    assert constant_velocity_alarms(moving((0, 0, 0.09), (4.1, 0, 0.0)), {}, None) == ()
    unknown = moving((0, 0, math.nan), (4.1, 0, -1.0))
    assert [each.time for each in constant_velocity_alarms(unknown, {}, None)] == pytest.approx([0.1])


def test_alarms_of_constant_velocities_come_the_soonest_first_and_of_own_pairs_alone() -> None:
    boxes = moving((0, 0, 2.0), (8, 0, 0.0), (0, 50, 1.0), (5, 50, 0.0), (6, 0, -1.0))
    found = constant_velocity_alarms(boxes, {4: 44, 3: None}, None)
    assert [each.time for each in found] == sorted(each.time for each in found)
    assert [each.ids for each in found] == [(2, 5), (1, 5), None, (1, 2)]
    assert [each.ids for each in constant_velocity_alarms(boxes, {}, 1)] == [(1, 5), (1, 2)]
    assert [each.ids for each in constant_velocity_alarms(boxes, {2: 99}, 99)] == [(99, 5), (1, 99)]
    assert constant_velocity_alarms(boxes, {}, 77) == ()


def test_the_horizon_that_is_not_given_is_of_2_seconds(da_motion: DeepAccident) -> None:
    token = f"{da_motion.scenario[0]['token']}/ego_vehicle/010"
    truth = box_truth(da_motion, token)
    assert (truth.horizon, len(truth.time), truth.time[-1]) == (2.0, 21, pytest.approx(2.0))
    there = accident_context(da_motion, token)
    assert (there.truth, there.references, there.known) == (None, {}, True)
    last = box_truth(da_motion, token, 100.0)
    frames = da_motion.scenario[0]["num_frames"]
    assert len(last.time) == frames - 10 + 1
    assert isinstance(last.impact, Accident) == (da_motion.scenario[0]["collision"] is not None)
