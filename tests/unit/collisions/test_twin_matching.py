from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.collisions.twin_matching import (
    TwinRecording,
    matched_rows,
    shift_of,
    shifted_recording,
)

FRAMES = 30


def make_recording(
    starts: list[tuple[float, float]],
    *,
    ids: list[int] | None = None,
    agents: dict[str, int] | None = None,
    categories: list[int] | None = None,
    frames: int = FRAMES,
) -> TwinRecording:
    """Make a recording of actors that drive to the right, each 1 m/s faster than the one before."""
    count = len(starts)
    speeds = 8.0 + np.arange(count)[:, None]
    poses = np.zeros((count, frames, 3))
    poses[..., 0] = np.array(starts)[:, :1] + speeds * np.arange(frames) / 10
    poses[..., 1] = np.array(starts)[:, 1:]

    return TwinRecording(
        scenario="type1_subtype1_accident/x",
        actor_id=np.array(ids or range(count)),
        category=np.array(categories or [0] * count, dtype=np.int8),
        size=np.ones((count, 3)),
        poses=poses,
        speeds=np.broadcast_to(speeds, (count, frames)),
        agents=agents or {},
    )


def test_agents_are_matched_by_name_wherever_they_are() -> None:
    first = make_recording(
        [(0, 0), (50, 5)],
        ids=[3, 7],
        agents={"ego_vehicle": 3, "other_vehicle": 7},
    )
    second = make_recording(
        [(0, 40), (90, 0)],
        ids=[3, 7],
        agents={"ego_vehicle": 7, "other_vehicle": 3},
    )
    assert matched_rows(first, second) == {0: (1, "agent"), 1: (0, "agent")}


def test_ids_count_if_the_agents_have_equal_ones() -> None:
    ids = [1, 2, 5, 6]
    agents = {"ego_vehicle": 1, "other_vehicle": 2}
    first = make_recording(
        [(0, 0), (0, 9), (0, 20), (0, 30)],
        ids=ids,
        agents=agents,
        categories=[0, 0, 0, 5],
    )
    starts = [(0, 0), (0, 9), (70, 70), (0, 30)]
    second = make_recording(starts, ids=ids, agents=agents, categories=[0, 0, 0, 4])
    assert matched_rows(first, second) == {0: (0, "agent"), 1: (1, "agent"), 2: (2, "id")}

    only_ego = make_recording(starts, ids=ids, agents={"ego_vehicle": 1})
    rows = matched_rows(first, only_ego)
    assert rows[1] == (1, "start")
    assert 2 not in rows


def test_starts_are_matched_with_the_least_total_distance() -> None:
    first = make_recording(
        [(0.0, 0), (1.5, 0), (0, 50)],
        ids=[1, 2, 3],
    )
    second = make_recording(
        [(-1.9, 0), (0.1, 0), (0, 52.1)],
        ids=[11, 12, 13],
    )
    assert matched_rows(first, second) == {0: (0, "start"), 1: (1, "start")}


@given(st.integers(-20, 20))
def test_the_shift_is_found_though_two_agents_go_their_own_ways(shift: int) -> None:
    agents = {
        "ego_vehicle": 0,
        "ego_vehicle_behind": 1,
        "other_vehicle": 2,
        "other_vehicle_behind": 3,
    }
    whole = make_recording([(0, 0), (-10, 0), (0, 40), (-10, 40)], agents=agents, frames=90)
    poses = whole.poses[:, max(0, -shift) :].copy()
    poses[2:, :, 0] += [[30], [60]]
    first = replace(whole, poses=whole.poses[:, max(0, shift) :])
    second = replace(whole, poses=poses)
    assert shift_of(first, second) == shift

    shifted = shifted_recording(second, shift)
    frames = slice(max(0, -shift), 60)
    np.testing.assert_allclose(shifted.poses[:2, frames], first.poses[:2, frames], atol=1e-9)
