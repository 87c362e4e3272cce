"""Poses and transforms; rounded ones too: still there and back within 1e-4 m."""

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import future_egomotion, relative_pose_to_ego

POSES = [
    SE3.from_six([600, -600, 1, 0.01, 0.02, 2.0]),
    SE3.from_six([590, -580, 2, 0, 0.01, 1.0]),
    SE3.identity(),
]


def test_transforms_are_taken_as_they_are() -> None:
    matrices = np.stack([pose.matrix for pose in POSES])
    for given in (POSES, tuple(POSES), [POSES[0], POSES[1].matrix, POSES[2].matrix.tolist()]):
        assert_array_equal(relative_pose_to_ego(given), relative_pose_to_ego(matrices))
        assert_array_equal(future_egomotion(given), future_egomotion(matrices))
    assert_allclose(
        relative_pose_to_ego(POSES)[1], (POSES[0].inverse() @ POSES[1]).to_six(), atol=1e-9
    )
    assert_allclose(future_egomotion(POSES)[0], (POSES[1].inverse() @ POSES[0]).to_six(), atol=1e-9)
    assert_array_equal(
        future_egomotion([POSES[0], np.full((4, 4), np.nan), POSES[2]], [True, False, True]),
        np.zeros((2, 6)),
    )


def test_rounded_poses_are_zero_away_from_themselves() -> None:
    rounded = np.stack([pose.matrix for pose in POSES]).round(4)
    assert_allclose(relative_pose_to_ego(rounded)[0], 0, atol=1e-9)
    assert_allclose(future_egomotion(rounded[[0, 0]]), 0, atol=1e-9)


def test_what_is_no_poses_is_refused() -> None:
    assert_refused(
        *[
            (partial(function, poses), GeometryError, r"world_from_(agent|ego): expected")
            for function in (relative_pose_to_ego, future_egomotion)
            for poses in (
                None,
                "abc",
                SE3.identity(),
                [],
                np.eye(4),
                [np.eye(3)],
                [SE3.identity(), None],
            )
        ],
        (
            lambda: relative_pose_to_ego(np.zeros((2, 4, 4))),
            GeometryError,
            ("has no inverse", "no rotation"),
        ),
    )


FRAMES = ("world", "ego", "lidar", "Camera_Front", "Camera_BackRight")
WAYS = {
    "single": lambda pose: pose.astype(np.float32),
    "rounded": lambda pose: pose.round(4),
    "off": lambda pose: pose + np.pad(4e-4 * np.sin(np.arange(9)).reshape(3, 3), (0, 1)),
    "last row": lambda pose: pose + np.diag([0, 0, 0, 5e-4]),
}


def tilted(agent: str, frame: int) -> np.ndarray:
    """A pose some 600 m out, on a slope."""
    at = AGENTS.index(agent)
    c, s = np.cos(0.03), np.sin(0.03)
    slope = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])
    return tiny.pose(37.0 * at + frame, x=600.0 - 7 * at, y=-600.0 + 3 * frame, z=at) @ slope


@pytest.fixture(params=sorted(WAYS))
def way(request: pytest.FixtureRequest) -> Callable[[np.ndarray], np.ndarray]:
    return WAYS[request.param]


@pytest.fixture
def da(way, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DeepAccident:
    exact = tiny.calib

    def changed(ego_to_world: np.ndarray, *, height: float) -> dict[str, np.ndarray]:
        return {
            name: array if "intrinsic" in name else way(array)
            for name, array in exact(ego_to_world, height=height).items()
        }

    monkeypatch.setattr(tiny, "ego_to_world", tilted)
    monkeypatch.setattr(tiny, "calib", changed)
    return DeepAccident(dataroot=tiny.write_tiny_release(tmp_path, frames=2), verbose=False)


def samples(da: DeepAccident) -> list[str]:
    return [f"{tiny.TOKEN}/{agent}/{frame:03d}" for agent in AGENTS for frame in (1, 2)]


def test_there_and_back_is_the_identity(da: DeepAccident) -> None:
    for (a, b), frame in itertools.product(itertools.combinations(samples(da), 2), FRAMES):
        there, back = da.transform(a, b, frame, "lidar"), da.transform(b, a, "lidar", frame)
        assert_allclose((there @ back).matrix, np.eye(4), atol=1e-9)
        assert_allclose(there.inverse().matrix, back.matrix, atol=1e-9)


def test_poses_are_the_files_numbers(da: DeepAccident, way) -> None:
    sample, expected = samples(da)[3], way(tilted("ego_vehicle_behind", 2)).astype(np.float64)
    flip = np.diag([1.0, -1, 1, 1])
    assert_array_equal(da.world_from(sample, "ego").matrix[:3], (flip @ expected @ flip)[:3])
    assert_array_equal(da.world_from(sample, "ego").matrix[3], [0, 0, 0, 1])
