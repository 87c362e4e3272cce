"""CARLA's poses against CARLA's own formula, and the moments that formats annotate."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import matrices

from deepaccident_devkit.export.frames import KEY_STEP, keyframe_after, keyframes
from deepaccident_devkit.export.opencood import carla_six
from deepaccident_devkit.geometry.conventions import flip_pose

DEGREES = st.floats(-179.9, 179.9)


def carla_matrix(x: float, y: float, z: float, roll: float, yaw: float, pitch: float) -> np.ndarray:
    """What `carla.Transform.get_matrix` gives: metres and degrees, left-handed, as its `Transform` computes it."""
    (cr, cy, cp), (sr, sy, sp) = np.cos(np.radians([roll, yaw, pitch])), np.sin(np.radians([roll, yaw, pitch]))
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )


@given(roll=DEGREES, yaw=DEGREES, pitch=st.floats(-89, 89), place=st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_a_carla_transform_there_and_back(roll: float, yaw: float, pitch: float, place: tuple[float, ...]) -> None:
    six = carla_six(flip_pose(carla_matrix(*place, roll, yaw, pitch)))
    assert_allclose(six, [*place, roll, yaw, pitch], rtol=0, atol=1e-9)


@given(matrices())
def test_a_pose_there_and_back(pose: np.ndarray) -> None:
    """Also near pitches of 90°, where angles are not unique; arcsin is flat there, and keeps eight digits."""
    assert_allclose(flip_pose(carla_matrix(*carla_six(pose))), pose, rtol=0, atol=1e-7)


def test_directions_are_carlas() -> None:
    """Ahead and to the left by 1 m, turned to the left and nose up: y, yaw and pitch of CARLA's sign."""
    turned, raised = np.eye(4), np.eye(4)
    turned[:3, 3], turned[:2, :2] = (1, 1, 0), [[0, -1], [1, 0]]
    raised[:3, :3] = [[np.sqrt(0.5), 0, -np.sqrt(0.5)], [0, 1, 0], [np.sqrt(0.5), 0, np.sqrt(0.5)]]
    assert_allclose(carla_six([turned, raised]), [[1, -1, 0, 0, -90, 0], [0, 0, 0, 0, 0, 45]], atol=1e-9)


@given(last=st.integers(1, 400), number=st.integers(1, 400))
def test_keyframes_lead_to_the_last_frame(last: int, number: int) -> None:
    keys = keyframes(last)
    assert keys[-1] == last
    assert 1 <= keys[0] <= KEY_STEP
    assert set(np.diff(keys)) <= {KEY_STEP}
    if number <= last:
        after = keyframe_after(number, last)
        assert after == min(key for key in keys if key >= number)
