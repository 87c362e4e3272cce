from collections.abc import Sequence

import numpy as np
import pytest

from deepaccident_devkit.baselines import Outlook, SeenActors
from deepaccident_devkit.baselines.predict import accidents_ahead
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID

CAR = (4.0, 2.0, 1.5)


def ahead(
    *actors: tuple[int, float, float, float, float, float], own: int | None = 50, on_foot: Sequence[int] = ()
) -> Outlook:
    """Cars, or whom ids say to be on foot, by actor id, x, y, yaw, speed along x, speed along y."""
    rows: Sequence[tuple[float, ...]] = actors
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    boxes = Boxes.from_arrays(
        np.column_stack([table[:, 1:3], np.zeros(len(table))]),
        np.tile(CAR, (len(table), 1)),
        table[:, 3],
        frame="ego",
        actor_id=table[:, 0].astype(np.int64),
        velocity=np.column_stack([table[:, 4:6], np.zeros(len(table))]),
        category=np.where(np.isin(table[:, 0], on_foot), CATEGORIES.index("pedestrian"), 0),
    )
    seen = SeenActors(boxes=boxes, seen_by=np.zeros(len(table), np.uint8), own_actor_id=own)
    return Outlook(seen=seen, turn_rate=np.zeros(len(table)))


EGO = (OWN_ACTOR_ID, 0, 0, 0, 10, 0)
CROSSING = (7, 15, -15, np.pi / 2, 0, 10)


def test_crossing_paths_collide_where_the_boxes_first_come_near() -> None:
    (alarm,) = accidents_ahead(ahead(EGO, CROSSING), 2.0)
    # at t the centres are (10 t, 0) and (15, −15 + 10 t): the boxes touch once 15 − 10 t ≤ 3
    assert alarm.time == pytest.approx(1.2)
    np.testing.assert_allclose(alarm.positions, [[12, 0], [15, -3]], atol=1e-9)
    assert alarm.ids == (50, 7)
    assert alarm.score == pytest.approx(1 / 2.2)


def test_nothing_is_foreseen_beyond_the_horizon() -> None:
    assert accidents_ahead(ahead(EGO, CROSSING), 1.1) == []


def test_a_pass_within_the_danger_distance_is_an_alarm_of_less_weight() -> None:
    passing = (7, 20, 2.2, np.pi, -10, 0)  # on the next lane: 0.2 m between the sides
    (alarm,) = accidents_ahead(ahead(EGO, passing), 2.0)
    assert alarm.score == pytest.approx((1 - 0.2 / 0.25) / (1 + alarm.time))
    assert accidents_ahead(ahead(EGO, passing), 2.0, danger_distance=0.1) == []


def test_those_who_stand_or_come_no_nearer_are_in_no_danger() -> None:
    parked = [(1, 0, 20, 0, 0, 0), (2, 4.1, 20, 0, 0, 0)]
    side_by_side = [(3, 0, 40, 0, 5, 0), (4, 0, 42.1, 0, 5, 0)]
    assert accidents_ahead(ahead(*parked, *side_by_side), 2.0) == []


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_who_drives_up_to_a_queue_brakes(yaw: float) -> None:
    """At constant velocity the follower is through the one that stands within 2 s."""
    along = np.array([np.cos(yaw), np.sin(yaw)])

    def follower(aside: float, turned: float) -> tuple[int, float, float, float, float, float]:
        place = -12 * along + aside * np.array([-along[1], along[0]])
        return 2, *place, yaw + turned, *(8 * along)

    stands = (1, 0, 0, yaw, 0, 0)
    assert accidents_ahead(ahead(stands, follower(0.5, 0.0)), 2.0) == []
    assert accidents_ahead(ahead(follower(0.5, 0.0), stands), 2.0) == []
    assert len(accidents_ahead(ahead(stands, follower(1.5, 0.0)), 2.0)) == 1  # it comes from the next lane
    assert len(accidents_ahead(ahead(stands, follower(0.5, 0.6)), 2.0)) == 1  # it slides


def test_two_pedestrians_are_in_no_danger_of_each_other() -> None:
    met = [(1, 0, 0, 0, 1.5, 0), (2, 6, 0.5, np.pi, -1.5, 0)]
    assert len(accidents_ahead(ahead(*met), 3.0)) == 1
    assert len(accidents_ahead(ahead(*met, on_foot=[2]), 3.0)) == 1
    assert accidents_ahead(ahead(*met, on_foot=[1, 2]), 3.0) == []


def test_two_that_overlap_now_are_the_surest_alarm() -> None:
    (alarm,) = accidents_ahead(ahead((1, 0, 0, 0, 5, 0), (2, 1, 0, 0, 5, 0)), 2.0)
    assert (alarm.time, alarm.score) == (0, 1)


def test_of_alarms_at_one_place_the_surest_is_kept() -> None:
    followers = [(8, -8, 0, 0, 10, 0), (9, 15, -23, np.pi / 2, 0, 10)]
    far_away = [(10, 0, 100, 0, 10, 0), (11, 17, 85, np.pi / 2, 0, 10)]
    alarms = accidents_ahead(ahead(EGO, CROSSING, *followers, *far_away), 3.0)
    assert [alarm.ids for alarm in alarms] == [(50, 7), (10, 11)]
    assert alarms[0].score > alarms[1].score


def test_ids_are_unknown_where_meta_does_not_say_who_the_ego_is() -> None:
    (alarm,) = accidents_ahead(ahead(EGO, CROSSING, own=None), 2.0)
    assert alarm.ids is None


@pytest.mark.parametrize("actors", [(), (EGO,)])
def test_who_sees_nobody_expects_nothing(actors: tuple[tuple[int, float, float, float, float, float], ...]) -> None:
    assert accidents_ahead(ahead(*actors), 2.0) == []
