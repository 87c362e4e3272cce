"""Which pictures of a recording are read."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.maps import TownMapConfig
from deepaccident_devkit.maps.counting import chosen_frames, looks_of
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA


def test_who_stands_is_read_every_two_seconds_and_at_the_end() -> None:
    assert chosen_frames(np.zeros((45, 2)), TownMapConfig()).tolist() == [0, 20, 40, 44]
    assert chosen_frames(np.zeros((1, 2)), TownMapConfig()).tolist() == [0]


def test_who_drives_is_read_every_ten_metres() -> None:
    xy = np.column_stack([np.arange(14) * 3.0, np.arange(14) * 4.0])  # 5 m a frame
    assert chosen_frames(xy, TownMapConfig()).tolist() == [0, 2, 4, 6, 8, 10, 12, 13]


@given(st.lists(st.floats(0, 3), min_size=1, max_size=90), st.floats(1, 30), st.floats(0.3, 4))
def test_between_two_pictures_nothing_is_far(speeds: list[float], travel: float, period: float) -> None:
    """A picture is due in each stretch of the way and of time, so that two of them are at most two stretches apart."""
    travelled = np.concatenate([[0.0], np.cumsum(speeds)])
    config = TownMapConfig(travel=travel, period=period)
    frames = chosen_frames(np.column_stack([travelled, 0 * travelled]), config)
    assert (frames[0], frames[-1]) == (0, len(travelled) - 1)
    gaps = np.diff(frames)
    assert (gaps > 0).all()
    assert (gaps * 0.1 <= period + 0.1 + 1e-6).all()
    assert (np.diff(travelled[frames]) <= travel + 3 + 1e-6).all()


def test_the_looks_are_the_agents_own_samples_with_their_poses(da: DeepAccident) -> None:
    token = da.scenario[1]["token"]
    recordings = looks_of(da, 1, TownMapConfig())
    assert len(recordings) == len(AGENTS)
    for agent, looks in zip(AGENTS, recordings, strict=True):
        samples = [f"{token}/{agent}/{frame:03d}" for frame in (1, 6)]
        assert [da.sample[row]["token"] for row in looks.sample_rows.tolist()] == samples
        assert [*looks.files(da)] == [da.sensor_path(sample, BEV_CAMERA) for sample in samples]
        for sample, pose in zip(samples, looks.poses, strict=True):
            np.testing.assert_array_equal(pose, da.world_from(sample, "ego").matrix)
