from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.v2x import future_egomotion, relative_pose_to_ego

POSES = [SE3.from_six([600, -600, 1, 0.01, 0.02, 2.0]), SE3.from_six([590, -580, 2, 0, 0.01, 1.0]), SE3.identity()]


def test_transforms_are_taken_as_they_are() -> None:
    matrices = np.stack([pose.matrix for pose in POSES])
    for given in (POSES, tuple(POSES), [POSES[0], POSES[1].matrix, POSES[2].matrix.tolist()]):
        assert_array_equal(relative_pose_to_ego(given), relative_pose_to_ego(matrices))
        assert_array_equal(future_egomotion(given), future_egomotion(matrices))
    assert_allclose(relative_pose_to_ego(POSES)[1], (POSES[0].inverse() @ POSES[1]).to_six(), atol=1e-9)
    assert_allclose(future_egomotion(POSES)[0], (POSES[1].inverse() @ POSES[0]).to_six(), atol=1e-9)
    valid = [True, False, True]
    assert_array_equal(future_egomotion([POSES[0], np.full((4, 4), np.nan), POSES[2]], valid), np.zeros((2, 6)))


def test_rounded_poses_are_zero_away_from_themselves() -> None:
    rounded = np.stack([pose.matrix for pose in POSES]).round(4)
    assert_allclose(relative_pose_to_ego(rounded)[0], 0, atol=1e-9)
    assert_allclose(future_egomotion(rounded[[0, 0]]), 0, atol=1e-9)


@pytest.mark.parametrize("poses", [None, "abc", SE3.identity(), [], np.eye(4), [np.eye(3)], [SE3.identity(), None]])
def test_what_is_no_poses_is_refused(poses: object) -> None:
    assert_refused(
        *[
            (partial(function, poses), GeometryError, r"world_from_(agent|ego): expected")
            for function in (relative_pose_to_ego, future_egomotion)
        ],
    )


def test_a_pose_without_an_inverse_is_refused() -> None:
    assert_refused(
        (
            lambda: relative_pose_to_ego(np.zeros((2, 4, 4))),
            GeometryError,
            "a transform has no inverse: its rotation is no rotation",
        ),
    )
