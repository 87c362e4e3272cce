"""Poses and transforms, also of rounded matrices, which stay within 1e-4 m there and back."""

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support import tiny_release
from support.expected_errors import assert_raises

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


def test_poses_may_be_transforms_matrices_or_lists() -> None:
    matrices = np.stack([pose.matrix for pose in POSES])
    for poses in (POSES, tuple(POSES), [POSES[0], POSES[1].matrix, POSES[2].matrix.tolist()]):
        assert_array_equal(relative_pose_to_ego(poses), relative_pose_to_ego(matrices))
        assert_array_equal(future_egomotion(poses), future_egomotion(matrices))

    first_from_second = POSES[0].inverse() @ POSES[1]
    second_from_first = POSES[1].inverse() @ POSES[0]
    assert_allclose(relative_pose_to_ego(POSES)[1], first_from_second.to_six(), atol=1e-9)
    assert_allclose(future_egomotion(POSES)[0], second_from_first.to_six(), atol=1e-9)

    gap = [POSES[0], np.full((4, 4), np.nan), POSES[2]]
    assert_array_equal(future_egomotion(gap, [True, False, True]), np.zeros((2, 6)))


def test_a_rounded_pose_relative_to_itself_is_zero() -> None:
    rounded = np.stack([pose.matrix for pose in POSES]).round(4)
    assert_allclose(relative_pose_to_ego(rounded)[0], 0, atol=1e-9)
    assert_allclose(future_egomotion(rounded[[0, 0]]), 0, atol=1e-9)


def test_values_that_are_no_poses_are_refused() -> None:
    assert_raises(
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
            ("has no inverse", "not a rotation"),
        ),
    )


FRAMES = ("world", "ego", "lidar", "Camera_Front", "Camera_BackRight")
MATRIX_CHANGES = {
    "single": lambda pose: pose.astype(np.float32),
    "rounded": lambda pose: pose.round(4),
    "off": lambda pose: pose + np.pad(4e-4 * np.sin(np.arange(9)).reshape(3, 3), (0, 1)),
    "last row": lambda pose: pose + np.diag([0, 0, 0, 5e-4]),
}


def tilted_pose(agent: str, frame: int) -> np.ndarray:
    """Return a pose about 600 m from the origin, on a slope."""
    index = AGENTS.index(agent)
    cosine = np.cos(0.03)
    sine = np.sin(0.03)
    slope = np.array([[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]])
    yaw = 37.0 * index + frame
    return tiny_release.pose(yaw, x=600.0 - 7 * index, y=-600.0 + 3 * frame, z=index) @ slope


@pytest.fixture(params=sorted(MATRIX_CHANGES))
def change_matrix(request: pytest.FixtureRequest) -> Callable[[np.ndarray], np.ndarray]:
    return MATRIX_CHANGES[request.param]


@pytest.fixture
def da(change_matrix, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DeepAccident:
    make_calib = tiny_release.make_calib

    def make_changed_calib(ego_to_world: np.ndarray, *, height: float) -> dict[str, np.ndarray]:
        calib = make_calib(ego_to_world, height=height)
        for name in calib:
            if "intrinsic" not in name:
                calib[name] = change_matrix(calib[name])
        return calib

    monkeypatch.setattr(tiny_release, "ego_to_world", tilted_pose)
    monkeypatch.setattr(tiny_release, "make_calib", make_changed_calib)
    return DeepAccident(dataroot=tiny_release.write_tiny_release(tmp_path, frames=2), verbose=False)


def list_samples(da: DeepAccident) -> list[str]:
    return [
        f"{tiny_release.SCENARIO_TOKEN}/{agent}/{frame:03d}" for agent in AGENTS for frame in (1, 2)
    ]


def test_a_transform_and_its_reverse_are_the_identity(da: DeepAccident) -> None:
    for (a, b), frame in itertools.product(itertools.combinations(list_samples(da), 2), FRAMES):
        a_from_b = da.transform(a, b, frame, "lidar")
        b_from_a = da.transform(b, a, "lidar", frame)
        assert_allclose((a_from_b @ b_from_a).matrix, np.eye(4), atol=1e-9)
        assert_allclose(a_from_b.inverse().matrix, b_from_a.matrix, atol=1e-9)


def test_poses_are_the_numbers_of_the_files(da: DeepAccident, change_matrix) -> None:
    expected = change_matrix(tilted_pose("ego_vehicle_behind", 2)).astype(np.float64)
    flip = np.diag([1.0, -1, 1, 1])
    world_from_ego = da.world_from(list_samples(da)[3], "ego").matrix
    assert_array_equal(world_from_ego[:3], (flip @ expected @ flip)[:3])
    assert_array_equal(world_from_ego[3], [0, 0, 0, 1])
