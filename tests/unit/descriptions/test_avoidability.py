"""The last moment to brake, against closed forms; and what a dataset says."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused
from replayed_accidents import CAR, accident, head_on, rear_end, straight

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import Accident, accidents_of, outcomes_of, undisturbed
from deepaccident_devkit.collisions.contact import pair_of
from deepaccident_devkit.collisions.outcomes import delta_v_ranges
from deepaccident_devkit.descriptions import avoidability, avoidability_of
from deepaccident_devkit.descriptions.avoidability import (
    BRAKERS,
    MASKS,
    last_moments,
    secondary_contacts,
)
from deepaccident_devkit.errors import GeometryError, NotAvailableError
from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.v2x.tracks import ScenarioTracks


def scanned(case: Accident, brakers: tuple[bool, bool], *decelerations: float) -> Any:
    return last_moments(pair_of(case.paths, case.sizes), brakers, decelerations)


FIRST, SECOND, BOTH = MASKS


@pytest.mark.parametrize("deceleration", [4.0, 5.0, 8.0])
def test_the_last_moment_of_a_striker(deceleration: float) -> None:
    """10 m/s of closing speed are gone after 10/a s, in which they need 10²/(2a) m: half of that
    time more.
    """
    last = np.floor((5 - 10 / (2 * deceleration)) * 100 + 1e-6) / 100
    (found,) = scanned(rear_end(20, 10), FIRST, deceleration).time
    assert found in (pytest.approx(last), pytest.approx(last - 0.01))  # at the very edge they touch


def test_two_that_both_brake_head_on() -> None:
    """Each needs v²/(2a), which it drives in v/(2a) s."""
    assert scanned(head_on(10), BOTH, 5.0, 8.0).time == pytest.approx([4.0, 4.37], abs=0.0101)


def test_one_that_brakes_head_on_is_hit_by_who_goes_on() -> None:
    case = head_on(10.0, 3.0)
    moments = scanned(case, FIRST, 5.0)
    # the other's front is 64 − 2 − 60 = 2 m beyond the first's centre at 6 s: it gets through to
    # where the first began
    assert np.isnan(moments.time).all()
    assert (moments.extrapolated.tolist(), moments.switches.tolist()) == ([True], [0])
    assert not scanned(case, BOTH, 5.0).extrapolated.any()


def test_what_nothing_avoids_within_the_recording_is_not_extrapolated() -> None:
    """The second stands inside the way of the first, which is too fast to stop within 0.5 s."""
    case = accident(straight((0, 0), 0, 30, 6), np.tile([15.0, 0.0, 0.0], (6, 1)))
    moments = scanned(case, FIRST, 4.0)
    assert (np.isnan(moments.time[0]), moments.extrapolated[0]) == (True, False)


def test_answers_that_change_three_times() -> None:
    """After 4 s the second crosses the lane at 20 m, where the first is if it stopped there, and
    meets it later.
    """
    nodes = np.array([[0.0, 20, -40], [4, 20, 0], [4.6, 20, 12], [5.0, 50, 12], [6, 60, 1.9]])
    x, y = (np.interp(np.arange(61) / 10, nodes[:, 0], nodes[:, axis]) for axis in (1, 2))
    case = accident(straight((0, 0), 0, 10, 61), np.column_stack([x, y, np.full(61, np.pi / 2)]))
    moments = scanned(case, FIRST, 8.0)
    assert (moments.switches.tolist(), moments.time[0] > 4) == ([3], True)
    at = [
        outcomes_of(case, FIRST, [start]).outcome[0, 2] for start in (0.0, 0.9, 3.0)
    ]  # 0.5 s to react, 8 m/s²
    assert [code == 0 for code in at] == [True, False, True]


def test_the_tables_of_an_accident() -> None:
    case = rear_end(20, 10)
    found = avoidability_of(case)
    assert (found.decelerations.tolist(), found.slack.shape) == ([4, 6, 8], (len(BRAKERS), 3))
    np.testing.assert_allclose(found.slack.ravel(), 5 - found.last_moments.time)
    np.testing.assert_allclose(found.slack[0], [1.25, 0.84, 0.63], atol=0.011)
    assert np.isnan(found.slack[1]).all()  # the leader, who brakes, is hit all the sooner
    assert found.leads[[0, 1, -1]] == pytest.approx([0, 0.1, 5])
    for mask, outcomes in zip(MASKS, found.outcomes, strict=True):
        np.testing.assert_array_equal(outcomes.time, outcomes_of(case, mask, 5 - found.leads).time)
    assert (found.secondary, found.head_on, found.pedestrian) == ((), False, False)
    assert found.relative_speed == pytest.approx(10)
    walking = replace(case, categories=("car", "pedestrian"))
    assert (avoidability_of(head_on(10, 2)).head_on, avoidability_of(walking).pedestrian) == (
        True,
        True,
    )


def test_what_cannot_be_told_is_refused() -> None:
    case = rear_end()
    farther = replace(case, paths=np.add(case.paths, [[[0.0, 0, 0]], [[2.5, 0, 0]]]))
    assert_refused(
        (
            lambda: avoidability_of(farther),
            NotAvailableError,
            ("11 and 12", "2.50 m apart at their last frame"),
        ),
        (
            lambda: last_moments(pair_of(case.paths, case.sizes), FIRST, 4.0),
            GeometryError,
            ("decelerations",),
        ),
    )


def test_in_time_is_what_the_last_moment_says() -> None:
    """The outcomes by warning time and the scan of starts are computed apart, and agree."""
    found = avoidability_of(rear_end(18, 7))
    columns = np.searchsorted(found.decelerations, [each.deceleration for each in found.brakings])
    needed = found.slack[0, columns] + [each.reaction for each in found.brakings]
    np.testing.assert_array_equal(
        found.outcomes[0].outcome == 0, found.leads[:, None] >= needed - 1e-9
    )


def test_values_for_json() -> None:
    told = json.loads(json.dumps(avoidability_of(rear_end(20, 10)).to_dict(), allow_nan=False))
    assert told["actors"][0] == {
        "actor_id": 11,
        "category": "car",
        "agent": "ego_vehicle",
        "mass": 1500,
    }
    ranges = np.round(delta_v_ranges([1500, 1500], 10.0), 3).tolist()
    assert (told["recorded"]["delta_v"], told["recorded"]["delta_v_ranges"]) == ([5, 5], ranges)
    first, leader = told["last_moments"][0], told["last_moments"][3]
    assert (first["avoidable"], first["slack"], first["switches"]) == (
        True,
        pytest.approx(1.25, abs=0.011),
        1,
    )
    assert (leader["avoidable"], leader["last_moment"], leader["slack"]) == (False, None, None)
    worst = told["warnings"][9]
    assert (worst["brakers"], worst["outcome"][-1]) == ("second", "worsened")
    assert "warnings" not in avoidability_of(rear_end()).to_dict(warnings=False)


def test_of_a_scenario(da_motion: DeepAccident) -> None:
    crashed, normal = da_motion.find(collision=True)[0], da_motion.find(collision=False)[0]
    found = avoidability(da_motion, crashed)
    assert (found.check.usable, found.accident.scenario) == (True, crashed["token"])
    assert avoidability(da_motion, normal) is None
    assert {each.other_id for each in found.secondary}.isdisjoint(found.accident.actor_ids)


def test_every_generated_accident_collides_by_its_end(
    da_b: DeepAccident, da_motion: DeepAccident
) -> None:
    found = [
        (undisturbed(each), each)
        for dataset in (da_b, da_motion)
        for each in accidents_of(dataset)[0]
    ]
    assert len(found) > 3
    assert [
        each.scenario for check, each in found if not check.usable or check.time > each.duration
    ] == []


CASE = rear_end(20, 10)
"""The first drives from x = 0 to 100 m in 5 s."""


def tracks_of(others: dict[int, tuple[range, FloatArray]]) -> ScenarioTracks:
    """Tracks of the pair of `CASE` and of others: frames and their x, y, yaw."""
    rows = [
        (frame, 11 + which, path[frame - 1])
        for which, path in enumerate(CASE.paths)
        for frame in range(1, 52)
    ]
    for actor, (frames, path) in others.items():
        rows += [(frame, actor, pose) for frame, pose in zip(frames, path, strict=True)]
    rows.sort(key=lambda row: row[:2])
    poses, count = np.array([pose for _, _, pose in rows]), len(rows)
    boxes = Boxes(
        frame="world",
        center=np.column_stack([poses[:, :2], np.zeros(count)]),
        size=np.tile(CAR, (count, 1)),
        rotation=quaternions.from_yaw(poses[:, 2]),
        velocity=np.zeros((count, 3)),
        category=np.zeros(count, dtype=np.int8),
        actor_id=np.array([actor for _, actor, _ in rows]),
        num_lidar_pts=np.zeros(count, dtype=np.int64),
        camera_visible=np.zeros(count, dtype=bool),
        row=np.arange(count),
    )
    return ScenarioTracks(
        boxes=boxes,
        index=np.array([frame for frame, _, _ in rows]),
        agents=np.ones(count, np.uint8),
    )


FOLLOWER, ALL = straight((-10, 0), 0, 20, 51), range(1, 52)
STARTS, HARD = np.array([[2.0, np.inf], [np.inf, np.inf]]), np.array([8.0, 8.0])


def contacts(
    others: dict[int, tuple[range, FloatArray]], starts: Any = None, hard: Any = None
) -> Any:
    """Those of who brakes from 2 s on, or from other starts."""
    return secondary_contacts(
        CASE,
        tracks_of(others),
        STARTS if starts is None else starts,
        HARD if hard is None else hard,
    )


def test_a_follower_runs_into_who_brakes() -> None:
    (found,) = contacts({30: (ALL, FOLLOWER)})
    assert (found.replay, found.actor_id, found.other_id, found.category) == (0, 11, 30, "car")
    assert found.time == pytest.approx(2 + np.sqrt(2 * 6 / 8), abs=1e-5)  # a gap of 6 m
    (late,) = contacts(
        {30: (range(38, 52), FOLLOWER[37:])}
    )  # who comes into sight late counts from there
    assert late.time == pytest.approx(3.7)
    (after,) = contacts({30: (ALL, straight((-72, 0), 0, 20, 51))})
    assert (found.extrapolated, after.extrapolated, after.time > 5) == (False, True, True)


def test_who_does_not_count() -> None:
    others = {
        30: (ALL, straight((-10, 30), 0, 20, 51)),  # another lane
        31: (ALL, np.tile([20.0, 1.0, 0.0], (51, 1))),  # touched in the recording too
        32: (range(30, 31), np.array([[60.0, 0.0, 0.0]])),  # one frame alone
        33: (range(1, 20), FOLLOWER[:19]),  # gone before they would touch
        34: (ALL, np.tile([300.0, 0.0, 0.0], (51, 1))),  # never reached
    }
    assert [actor for actor, other in others.items() if contacts({actor: other})] == []
    assert contacts({30: (ALL, FOLLOWER)}, STARTS[1:], HARD[1:]) == []
