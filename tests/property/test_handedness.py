"""The sign changes, against formulas of the left-handed world that are written out here."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from strategies import ANGLES, arrays, matrices

from deepaccident_devkit.geometry import SE3, PinholeCamera, conventions
from deepaccident_devkit.release import read_calib, read_label, read_lidar, write_lidar
from deepaccident_devkit.release.calib import KEYS
from deepaccident_devkit.taxonomy import CAMERAS

CAMERA_YAWS = dict(zip(CAMERAS, (0, -55, 55, 180, -110, 110), strict=True))
FOCAL = dict.fromkeys(CAMERAS, 1142.5184) | {"Camera_Back": 560.166}


@pytest.mark.parametrize(
    ("flip", "shape"),
    [
        (conventions.flip_points, (4, 3)),
        (conventions.flip_vectors2, (4, 2)),
        (conventions.flip_yaw, (4,)),
        (conventions.flip_pose, (2, 4, 4)),
        (conventions.flip_six_vector, (4, 6)),
    ],
)
@given(data=st.data())
def test_flipping_twice_is_identity_and_changes_no_argument(flip, shape, data) -> None:
    values = data.draw(arrays(shape, 1e6))
    kept = values.copy()
    once = flip(values)
    assert_array_equal(flip(once), values)
    assert_array_equal(values, kept)
    assert once.dtype == np.float64
    assert not np.shares_memory(once, values)
    assert_array_equal(np.abs(once), np.abs(values))  # nothing but signs
    if np.all(values != 0):
        assert not np.array_equal(once, values)


@given(arrays((2, 4, 4), 1e3), arrays((2, 3, 3), 2e3))
def test_cameras_and_intrinsics_come_back(camera: np.ndarray, raw_intrinsic: np.ndarray) -> None:
    assert_array_equal(
        conventions.camera_from_lidar_to_raw(conventions.camera_from_lidar(camera)), camera
    )
    assert_array_equal(
        conventions.camera_from_lidar(conventions.camera_from_lidar_to_raw(camera)), camera
    )
    assert_array_equal(
        conventions.intrinsic_to_raw(conventions.intrinsic(raw_intrinsic)), raw_intrinsic
    )
    assert_array_equal(
        conventions.intrinsic(conventions.intrinsic_to_raw(raw_intrinsic)), raw_intrinsic
    )


@given(matrices(), arrays((5, 3), 100))
def test_flipped_pose_moves_flipped_points(pose: np.ndarray, points: np.ndarray) -> None:
    raw = (pose @ np.column_stack([points, np.ones(5)]).T).T[:, :3]
    flipped = SE3(conventions.flip_pose(pose)).apply(conventions.flip_points(points))
    assert_allclose(flipped * [1, -1, 1], raw, atol=1e-9)


@given(ANGLES)
def test_clockwise_yaw_becomes_counter_clockwise(raw_yaw: float) -> None:
    # clockwise seen from above, towards y right
    ahead = conventions.flip_points([np.cos(raw_yaw), np.sin(raw_yaw), 0.0])
    assert_allclose(
        SE3.from_yaw(float(conventions.flip_yaw(raw_yaw))).apply([1.0, 0.0, 0.0]), ahead, atol=1e-12
    )


@given(ANGLES, ANGLES, ANGLES, arrays((3,), 100))
def test_six_vector_flips_as_its_pose_does(
    rx: float, ry: float, rz: float, translation: np.ndarray
) -> None:
    """(tx, ty, tz, rx, ry, rz) with R = Rx(rx) Ry(ry) Rz(rz): turning about x and z changes sense,
    about y not.
    """

    def pose_of(six: np.ndarray) -> np.ndarray:
        (cx, cy, cz), (sx, sy, sz) = np.cos(six[3:]), np.sin(six[3:])
        pose = np.eye(4)
        pose[:3, :3] = (
            np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
            @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
            @ np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        )
        pose[:3, 3] = six[:3]
        return pose

    six = np.array([*translation, rx, ry, rz])
    assert_allclose(
        pose_of(conventions.flip_six_vector(six)), conventions.flip_pose(pose_of(six)), atol=1e-12
    )


def carla_matrix(location: np.ndarray, yaw: float, pitch: float, roll: float) -> np.ndarray:
    """The matrix that CARLA's Transform.get_matrix() returns: left-handed, nose up for a positive
    pitch.
    """
    cy, sy, cp, sp, cr, sr = (
        np.cos(yaw),
        np.sin(yaw),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(roll),
        np.sin(roll),
    )
    x, y, z = location
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )


def raw_calib(ego_to_world: np.ndarray, lidar_to_ego: np.ndarray) -> dict[str, np.ndarray]:
    """A calib file's dict as docs/format.md, Calib, describes it."""
    raw = {"ego_to_world": ego_to_world, "lidar_to_ego": lidar_to_ego}
    for camera, degrees in CAMERA_YAWS.items():
        c, s, f = np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), FOCAL[camera]
        lidar_to_cam = np.eye(4)
        lidar_to_cam[:3] = [[c, s, 0, -2.3], [-s, c, 0, 0.1], [0, 0, 1, 0.3]]
        raw[f"lidar_to_{camera}"] = lidar_to_cam
        raw[f"intrinsic_{camera}"] = np.array([[800, f, 0], [450, 0, -f], [1, 0, 0]])
    assert raw.keys() == KEYS.keys()
    return raw


def vehicle_poses() -> st.SearchStrategy[np.ndarray]:
    """An agent on a slope: pitch and roll up to 20°."""
    slope = st.floats(-0.35, 0.35)
    return st.builds(carla_matrix, arrays((3,), 50), ANGLES, slope, slope)


LIDAR_TO_EGO = carla_matrix(np.array([0.1, -0.2, 1.94]), 0.12, 0.02, -0.03)
# front: upper left, upper right, lower right, lower left, then the same behind; y is right, so −1
# is left
RAW_CORNERS = np.array(
    [[x, y, z] for x in (1, -1) for y, z in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
)


@settings(max_examples=20)
@given(
    one_to_world=vehicle_poses(),
    other_to_world=vehicle_poses(),
    center=arrays((3,), 40),
    yaw=ANGLES,
    camera=st.sampled_from(CAMERAS),
)
def test_a_point_its_box_and_its_pixel_stay_together_on_the_way_to_another_agents_camera(
    scratch: Path,
    one_to_world: np.ndarray,
    other_to_world: np.ndarray,
    center: np.ndarray,
    yaw: float,
    camera: str,
) -> None:
    # the files of two agents, by CARLA's rules
    other = raw_calib(other_to_world, LIDAR_TO_EGO)
    (scratch / "one.pkl").write_bytes(pickle.dumps(raw_calib(one_to_world, LIDAR_TO_EGO)))
    (scratch / "other.pkl").write_bytes(pickle.dumps(other))
    x, y, z = center.tolist()
    (scratch / "label.txt").write_text(
        f"1 2\ncar {x} {y} {z} 4.2 1.9 1.5 {yaw} 3.0 -1.0 7 5 True\n"
    )

    # the left-handed way: the formulas of docs/format.md, Calib, and nothing else
    c, s = np.cos(yaw), np.sin(yaw)
    half = np.array([4.2, 1.9, 1.5]) / 2
    spots = (
        np.concatenate([[[0, 0, 0]], RAW_CORNERS, [[0.6, -0.8, 0.3]]]) * half
    )  # centre, corners, a point inside
    raw_lidar = center + spots @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    raw_world = (
        one_to_world @ LIDAR_TO_EGO @ np.column_stack([raw_lidar, np.ones(len(raw_lidar))]).T
    )
    in_other = np.linalg.inv(other_to_world @ LIDAR_TO_EGO) @ raw_world
    raw_camera = (other[f"lidar_to_{camera}"] @ in_other)[:3]
    raw_pixel = other[f"intrinsic_{camera}"] @ raw_camera
    assume((raw_pixel[2] > 1).all())
    raw_pixel = (raw_pixel[:2] / raw_pixel[2]).T
    raw_velocity = (one_to_world @ LIDAR_TO_EGO)[:3, :3] @ [3, -1, 0]

    # the devkit's way
    calib, calib_other = read_calib(scratch / "one.pkl"), read_calib(scratch / "other.pkl")
    world_from_lidar = calib.world_from_ego @ calib.ego_from_lidar
    in_world = read_label(scratch / "label.txt").boxes().transform(world_from_lidar, "world")
    world_from_other = calib_other.world_from_ego @ calib_other.ego_from_lidar
    camera_from_world = calib_other.camera_from_lidar[camera] @ world_from_other.inverse()
    in_camera = in_world.transform(camera_from_world, camera)
    pinhole = PinholeCamera(calib_other.intrinsic[camera], 1600, 900)
    write_lidar(scratch / "points.npz", raw_lidar * [1, -1, 1], np.zeros(len(raw_lidar)))
    cloud = read_lidar(scratch / "points.npz").transform(world_from_lidar, "world")

    assert_allclose(
        read_lidar(scratch / "points.npz", raw=True)[:, :3], raw_lidar, rtol=1e-6, atol=1e-5
    )
    assert_allclose(in_world.center[0], raw_world[:3, 0] * [1, -1, 1], atol=1e-9)
    assert_allclose(in_world.velocity[0], raw_velocity * [1, -1, 1], atol=1e-9)
    assert_allclose(in_world.corners()[0], raw_world[:3, 1:9].T * [1, -1, 1], atol=1e-9)
    assert_allclose(pinhole.project(in_camera.center)[0], raw_pixel[:1], atol=1e-6)
    assert_allclose(pinhole.project(in_camera.corners()[0])[0], raw_pixel[1:9], atol=1e-6)
    assert_allclose(
        pinhole.project(camera_from_world.apply(cloud.xyz))[0], raw_pixel, atol=0.05
    )  # float32 points
    assert_allclose(
        in_camera.center[0], (raw_camera[1, 0], -raw_camera[2, 0], raw_camera[0, 0]), atol=1e-9
    )
    assert in_world.contains(cloud.xyz[[0, 9]]).all()
    assert in_camera.contains(camera_from_world.apply(cloud.xyz[[0, 9]])).all()
