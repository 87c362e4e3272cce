"""Contacts of a braking actor with others: a follower, and who does not count."""

import numpy as np
import pytest
from replayed_accidents import CAR, rear_end, straight

from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.safety.avoidability import secondary_contacts
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.v2x.tracks import ScenarioTracks

CASE = rear_end(20, 10)
"""The first drives from x = 0 to 100 m in 5 s."""


def tracks_of(others: dict[int, tuple[range, FloatArray]]) -> ScenarioTracks:
    """Tracks of the pair of `CASE` and of others: frames and their x, y, yaw."""
    rows = [(frame, 11 + which, path[frame - 1]) for which, path in enumerate(CASE.paths) for frame in range(1, 52)]
    for actor, (frames, path) in others.items():
        rows += [(frame, actor, pose) for frame, pose in zip(frames, path, strict=True)]
    rows.sort(key=lambda row: row[:2])
    poses = np.array([pose for _, _, pose in rows])
    count = len(rows)
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
    return ScenarioTracks(boxes=boxes, index=np.array([frame for frame, _, _ in rows]), agents=np.ones(count, np.uint8))


FOLLOWER = straight((-10, 0), 0, 20, 51)
STARTS, HARD = np.array([[2.0, np.inf], [np.inf, np.inf]]), np.array([8.0, 8.0])


def test_a_follower_runs_into_who_brakes() -> None:
    (found,) = secondary_contacts(CASE, tracks_of({30: (range(1, 52), FOLLOWER)}), STARTS, HARD)
    assert (found.replay, found.actor_id, found.other_id, found.category) == (0, 11, 30, "car")
    assert found.time == pytest.approx(2 + np.sqrt(2 * 6 / 8), abs=1e-5)  # a gap of 6 m
    assert not found.extrapolated


def test_a_contact_after_the_recording_says_so() -> None:
    far = straight((-72, 0), 0, 20, 51)
    (found,) = secondary_contacts(CASE, tracks_of({30: (range(1, 52), far)}), STARTS, HARD)
    assert found.extrapolated
    assert found.time > 5


def test_who_does_not_count() -> None:
    others = {
        30: (range(1, 52), straight((-10, 30), 0, 20, 51)),  # another lane
        31: (range(1, 52), np.tile([20.0, 1.0, 0.0], (51, 1))),  # touched in the recording too
        32: (range(30, 31), np.array([[60.0, 0.0, 0.0]])),  # one frame alone
        33: (range(1, 20), FOLLOWER[:19]),  # gone before they would touch
        34: (range(1, 52), np.tile([300.0, 0.0, 0.0], (51, 1))),  # never reached
    }
    for actor, other in others.items():
        assert secondary_contacts(CASE, tracks_of({actor: other}), STARTS, HARD) == [], actor
    assert secondary_contacts(CASE, tracks_of({30: (range(1, 52), FOLLOWER)}), STARTS[1:], HARD[1:]) == []


def test_one_that_comes_into_sight_late_counts_from_there() -> None:
    (found,) = secondary_contacts(CASE, tracks_of({30: (range(38, 52), FOLLOWER[37:])}), STARTS, HARD)
    assert found.time == pytest.approx(3.7)


def test_by_replay_and_time() -> None:
    starts, hard = np.array([[np.inf, 1.0], [2.0, 2.0], [1.0, np.inf]]), np.array([4.0, 8.0, 6.0])
    crossing = np.column_stack([np.full(51, 60.0), np.linspace(-40, 60, 51), np.full(51, np.pi / 2)])
    tracks = tracks_of({30: (range(1, 52), FOLLOWER), 31: (range(1, 52), crossing)})
    found = secondary_contacts(CASE, tracks, starts, hard)
    keys = [(each.replay, each.time) for each in found]
    assert keys == sorted(keys)
    assert {each.replay for each in found} >= {1, 2}
