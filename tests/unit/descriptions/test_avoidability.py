"""The last moment to brake, against closed forms and on the accidents of a dataset."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.braking_accidents import (
    CAR_SIZE,
    head_on_accident,
    make_accident,
    rear_end_accident,
    straight_path,
)
from support.expected_errors import assert_raises

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


def find_last_moments(accident: Accident, brakers: tuple[bool, bool], *decelerations: float) -> Any:
    return last_moments(pair_of(accident.paths, accident.sizes), brakers, decelerations)


FIRST_BRAKES, SECOND_BRAKES, BOTH_BRAKE = MASKS


@pytest.mark.parametrize("deceleration", [4.0, 5.0, 8.0])
def test_the_last_moment_of_a_striker(deceleration: float) -> None:
    """To lose 10 m/s of closing speed takes 10/a s and 10²/(2a) m, which the gap must hold."""
    expected = np.floor((5 - 10 / (2 * deceleration)) * 100 + 1e-6) / 100
    (last,) = find_last_moments(rear_end_accident(20, 10), FIRST_BRAKES, deceleration).time
    # at the very edge they touch
    assert last in (pytest.approx(expected), pytest.approx(expected - 0.01))


def test_two_that_both_brake_head_on() -> None:
    """Each needs v²/(2a), which it drives in v/(2a) s."""
    moments = find_last_moments(head_on_accident(10), BOTH_BRAKE, 5.0, 8.0)
    assert moments.time == pytest.approx([4.0, 4.37], abs=0.0101)


def test_one_that_brakes_head_on_is_hit_by_the_one_that_goes_on() -> None:
    accident = head_on_accident(10.0, 3.0)
    moments = find_last_moments(accident, FIRST_BRAKES, 5.0)
    # the other's front is 64 − 2 − 60 = 2 m beyond the first's centre at 6 s: it gets through to
    # where the first began
    assert np.isnan(moments.time).all()
    assert moments.extrapolated.tolist() == [True]
    assert moments.switches.tolist() == [0]
    assert not find_last_moments(accident, BOTH_BRAKE, 5.0).extrapolated.any()


def test_what_nothing_avoids_within_the_recording_is_not_extrapolated() -> None:
    """The second stands on the path of the first, which is too fast to stop within 0.5 s."""
    standing_path = np.tile([15.0, 0.0, 0.0], (6, 1))
    accident = make_accident(straight_path((0, 0), 0, 30, 6), standing_path)
    moments = find_last_moments(accident, FIRST_BRAKES, 4.0)
    assert np.isnan(moments.time[0])
    assert not moments.extrapolated[0]


def test_answers_that_change_three_times() -> None:
    """At 4 s the second crosses the lane at 20 m, where the first may have stopped.

    Otherwise they meet later.
    """
    times = np.arange(61) / 10
    node_times = [0.0, 4, 4.6, 5.0, 6]
    path = np.full((61, 3), np.pi / 2)
    path[:, 0] = np.interp(times, node_times, [20, 20, 20, 50, 60])
    path[:, 1] = np.interp(times, node_times, [-40, 0, 12, 12, 1.9])
    accident = make_accident(straight_path((0, 0), 0, 10, 61), path)
    moments = find_last_moments(accident, FIRST_BRAKES, 8.0)
    assert moments.switches.tolist() == [3]
    assert moments.time[0] > 4
    for warning_time, is_avoided in ((0.0, True), (0.9, False), (3.0, True)):
        outcomes = outcomes_of(accident, FIRST_BRAKES, [warning_time])
        # 0.5 s to react, 8 m/s²
        assert (outcomes.outcome[0, 2] == 0) == is_avoided


def test_the_tables_of_an_accident() -> None:
    accident = rear_end_accident(20, 10)
    tables = avoidability_of(accident)
    assert tables.decelerations.tolist() == [4, 6, 8]
    assert tables.slack.shape == (len(BRAKERS), 3)
    np.testing.assert_allclose(tables.slack.ravel(), 5 - tables.last_moments.time)
    np.testing.assert_allclose(tables.slack[0], [1.25, 0.84, 0.63], atol=0.011)
    assert np.isnan(tables.slack[1]).all()  # the leader, who brakes, is hit all the sooner
    assert tables.leads[[0, 1, -1]] == pytest.approx([0, 0.1, 5])
    for mask, outcomes in zip(MASKS, tables.outcomes, strict=True):
        np.testing.assert_array_equal(
            outcomes.time, outcomes_of(accident, mask, 5 - tables.leads).time
        )
    assert (tables.secondary, tables.head_on, tables.pedestrian) == ((), False, False)
    assert tables.relative_speed == pytest.approx(10)
    assert avoidability_of(head_on_accident(10, 2)).head_on is True
    pedestrian_accident = replace(accident, categories=("car", "pedestrian"))
    assert avoidability_of(pedestrian_accident).pedestrian is True


def test_an_accident_without_contact_and_decelerations_of_another_shape_are_refused() -> None:
    accident = rear_end_accident()
    paths = np.add(accident.paths, [[[0.0, 0, 0]], [[2.5, 0, 0]]])
    accident_without_contact = replace(accident, paths=paths)
    assert_raises(
        (
            lambda: avoidability_of(accident_without_contact),
            NotAvailableError,
            ("11 and 12", "2.50 m apart at their last frame"),
        ),
        (
            lambda: last_moments(pair_of(accident.paths, accident.sizes), FIRST_BRAKES, 4.0),
            GeometryError,
            ("decelerations",),
        ),
    )


def test_in_time_is_what_the_last_moment_says() -> None:
    """The outcomes by warning time and the scan of starts are computed separately, and agree."""
    tables = avoidability_of(rear_end_accident(18, 7))
    decelerations = [braking.deceleration for braking in tables.brakings]
    reactions = [braking.reaction for braking in tables.brakings]
    columns = np.searchsorted(tables.decelerations, decelerations)
    needed_leads = tables.slack[0, columns] + reactions
    is_in_time = tables.leads[:, None] >= needed_leads - 1e-9
    np.testing.assert_array_equal(tables.outcomes[0].outcome == 0, is_in_time)


def test_values_for_json() -> None:
    tables = avoidability_of(rear_end_accident(20, 10))
    content = json.loads(json.dumps(tables.to_dict(), allow_nan=False))
    assert content["actors"][0] == {
        "actor_id": 11,
        "category": "car",
        "agent": "ego_vehicle",
        "mass": 1500,
    }
    ranges = np.round(delta_v_ranges([1500, 1500], 10.0), 3).tolist()
    assert content["recorded"]["delta_v"] == [5, 5]
    assert content["recorded"]["delta_v_ranges"] == ranges
    striker, leader = content["last_moments"][0], content["last_moments"][3]
    assert (striker["avoidable"], striker["switches"]) == (True, 1)
    assert striker["slack"] == pytest.approx(1.25, abs=0.011)
    assert (leader["avoidable"], leader["last_moment"], leader["slack"]) == (False, None, None)
    worst = content["warnings"][9]
    assert (worst["brakers"], worst["outcome"][-1]) == ("second", "worsened")
    assert "warnings" not in avoidability_of(rear_end_accident()).to_dict(warnings=False)


def test_of_a_scenario(da_motion: DeepAccident) -> None:
    scenario = da_motion.find(collision=True)[0]
    tables = avoidability(da_motion, scenario)
    assert tables.check.usable is True
    assert tables.accident.scenario == scenario["token"]
    other_ids = {contact.other_id for contact in tables.secondary}
    assert other_ids.isdisjoint(tables.accident.actor_ids)
    assert avoidability(da_motion, da_motion.find(collision=False)[0]) is None


def test_every_generated_accident_collides_by_its_end(
    da_b: DeepAccident, da_motion: DeepAccident
) -> None:
    accidents = [*accidents_of(da_b)[0], *accidents_of(da_motion)[0]]
    assert len(accidents) > 3
    for accident in accidents:
        check = undisturbed(accident)
        assert check.usable, accident.scenario
        assert check.time <= accident.duration, accident.scenario


REAR_END = rear_end_accident(20, 10)
"""The first drives from x = 0 to 100 m in 5 s."""


def make_tracks(other_tracks: dict[int, tuple[range, FloatArray]]) -> ScenarioTracks:
    """Make tracks of the pair of `REAR_END` and of others: frames, and their x, y and yaw."""
    first_path, second_path = REAR_END.paths
    actors = {11: (range(1, 52), first_path), 12: (range(1, 52), second_path), **other_tracks}
    rows = []
    for actor, (frames, path) in actors.items():
        rows += [(frame, actor, pose) for frame, pose in zip(frames, path, strict=True)]
    rows.sort(key=lambda row: row[:2])
    poses = np.array([pose for _, _, pose in rows])
    count = len(rows)
    boxes = Boxes(
        frame="world",
        center=np.column_stack([poses[:, :2], np.zeros(count)]),
        size=np.tile(CAR_SIZE, (count, 1)),
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


FOLLOWER = straight_path((-10, 0), 0, 20, 51)
ALL_FRAMES = range(1, 52)
BRAKES_AT_2_S = np.array([[2.0, np.inf], [np.inf, np.inf]])


def find_contacts(
    other_tracks: dict[int, tuple[range, FloatArray]], starts: FloatArray = BRAKES_AT_2_S
) -> Any:
    decelerations = np.full(len(starts), 8.0)
    return secondary_contacts(REAR_END, make_tracks(other_tracks), starts, decelerations)


def test_a_follower_runs_into_the_car_that_brakes() -> None:
    (contact,) = find_contacts({30: (ALL_FRAMES, FOLLOWER)})
    assert (contact.replay, contact.actor_id, contact.other_id) == (0, 11, 30)
    assert contact.category == "car"
    assert contact.time == pytest.approx(2 + np.sqrt(2 * 6 / 8), abs=1e-5)  # a gap of 6 m
    assert not contact.extrapolated

    # a follower that comes into sight late counts from there
    (late_contact,) = find_contacts({30: (range(38, 52), FOLLOWER[37:])})
    assert late_contact.time == pytest.approx(3.7)

    (extrapolated_contact,) = find_contacts({30: (ALL_FRAMES, straight_path((-72, 0), 0, 20, 51))})
    assert extrapolated_contact.extrapolated
    assert extrapolated_contact.time > 5


def test_actors_that_do_not_count() -> None:
    other_tracks = {
        30: (ALL_FRAMES, straight_path((-10, 30), 0, 20, 51)),  # another lane
        31: (ALL_FRAMES, np.tile([20.0, 1.0, 0.0], (51, 1))),  # touched in the recording too
        32: (range(30, 31), np.array([[60.0, 0.0, 0.0]])),  # only one frame
        33: (range(1, 20), FOLLOWER[:19]),  # gone before they would touch
        34: (ALL_FRAMES, np.tile([300.0, 0.0, 0.0], (51, 1))),  # never reached
    }
    for actor, track in other_tracks.items():
        assert not find_contacts({actor: track}), actor
    nobody_brakes = BRAKES_AT_2_S[1:]
    assert find_contacts({30: (ALL_FRAMES, FOLLOWER)}, nobody_brakes) == []
