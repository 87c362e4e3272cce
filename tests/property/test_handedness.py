"""The sign changes, against formulas of the left-handed world that are written out here."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from support.strategies import ANGLES, arrays, matrices

from deepaccident_devkit.geometry import SE3, PinholeCamera, conventions
from deepaccident_devkit.release import read_calib, read_label, read_lidar, write_lidar
from deepaccident_devkit.release.calib import KEYS
from deepaccident_devkit.taxonomy import CAMERAS

CAMERA_YAWS_DEG = dict(zip(CAMERAS, (0, -55, 55, 180, -110, 110), strict=True))
FOCAL_LENGTHS_PX = dict.fromkeys(CAMERAS, 1142.5184) | {"Camera_Back": 560.166}


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
    copy = values.copy()
    flipped = flip(values)
    assert_array_equal(flip(flipped), values)
    assert_array_equal(values, copy)
    assert flipped.dtype == np.float64
    assert not np.shares_memory(flipped, values)
    assert_array_equal(np.abs(flipped), np.abs(values))  # only signs change
    if np.all(values != 0):
        assert not np.array_equal(flipped, values)


@given(arrays((2, 4, 4), 1e3), arrays((2, 3, 3), 2e3))
def test_cameras_and_intrinsics_come_back(camera: np.ndarray, raw_intrinsic: np.ndarray) -> None:
    from_raw, to_raw = conventions.camera_from_lidar, conventions.camera_from_lidar_to_raw
    assert_array_equal(to_raw(from_raw(camera)), camera)
    assert_array_equal(from_raw(to_raw(camera)), camera)

    from_raw, to_raw = conventions.intrinsic, conventions.intrinsic_to_raw
    assert_array_equal(to_raw(from_raw(raw_intrinsic)), raw_intrinsic)
    assert_array_equal(from_raw(to_raw(raw_intrinsic)), raw_intrinsic)


@given(matrices(), arrays((5, 3), 100))
def test_flipped_pose_moves_flipped_points(pose: np.ndarray, points: np.ndarray) -> None:
    raw_points = points @ pose[:3, :3].T + pose[:3, 3]
    flipped_pose = SE3(conventions.flip_pose(pose))
    flipped_points = flipped_pose.apply(conventions.flip_points(points))
    assert_allclose(flipped_points * [1, -1, 1], raw_points, atol=1e-9)


@given(ANGLES)
def test_clockwise_yaw_becomes_counter_clockwise(raw_yaw: float) -> None:
    # clockwise seen from above, towards y right
    expected = conventions.flip_points([np.cos(raw_yaw), np.sin(raw_yaw), 0.0])
    pose = SE3.from_yaw(float(conventions.flip_yaw(raw_yaw)))
    assert_allclose(pose.apply([1.0, 0.0, 0.0]), expected, atol=1e-12)


@given(ANGLES, ANGLES, ANGLES, arrays((3,), 100))
def test_six_vector_flips_as_its_pose_does(
    rx: float, ry: float, rz: float, translation: np.ndarray
) -> None:
    """Rotations about x and z change their sense, the one about y does not.

    The vector is (tx, ty, tz, rx, ry, rz) with R = Rx(rx) Ry(ry) Rz(rz).
    """

    def make_pose(six: np.ndarray) -> np.ndarray:
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
    flipped_pose = make_pose(conventions.flip_six_vector(six))
    assert_allclose(flipped_pose, conventions.flip_pose(make_pose(six)), atol=1e-12)


def carla_matrix(location: np.ndarray, yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Return the matrix of CARLA's Transform.get_matrix(): left-handed, nose up for pitch > 0."""
    cy, cp, cr = np.cos([yaw, pitch, roll])
    sy, sp, sr = np.sin([yaw, pitch, roll])
    x, y, z = location
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )


def make_raw_calib(ego_to_world: np.ndarray, lidar_to_ego: np.ndarray) -> dict[str, np.ndarray]:
    """Make the dictionary of a calib file, as docs/format.md, Calib, describes it."""
    raw = {"ego_to_world": ego_to_world, "lidar_to_ego": lidar_to_ego}
    for camera, degrees in CAMERA_YAWS_DEG.items():
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        f = FOCAL_LENGTHS_PX[camera]
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
# front: upper left, upper right, lower right, lower left, then the same at the back; y is right,
# so −1 is left
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
    # arrange: write the files of two agents, by CARLA's rules
    other = make_raw_calib(other_to_world, LIDAR_TO_EGO)
    (scratch / "one.pkl").write_bytes(pickle.dumps(make_raw_calib(one_to_world, LIDAR_TO_EGO)))
    (scratch / "other.pkl").write_bytes(pickle.dumps(other))
    x, y, z = center.tolist()
    (scratch / "label.txt").write_text(
        f"1 2\ncar {x} {y} {z} 4.2 1.9 1.5 {yaw} 3.0 -1.0 7 5 True\n"
    )

    # the left-handed way, only with the formulas of docs/format.md, Calib
    c, s = np.cos(yaw), np.sin(yaw)
    half_size = np.array([4.2, 1.9, 1.5]) / 2
    # the centre, the corners, and a point inside
    unit_points = np.concatenate([[[0, 0, 0]], RAW_CORNERS, [[0.6, -0.8, 0.3]]])
    raw_rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    raw_lidar = center + (unit_points * half_size) @ raw_rotation.T
    lidar_to_world = one_to_world @ LIDAR_TO_EGO
    raw_world = lidar_to_world @ np.column_stack([raw_lidar, np.ones(len(raw_lidar))]).T
    raw_other = np.linalg.inv(other_to_world @ LIDAR_TO_EGO) @ raw_world
    raw_camera = (other[f"lidar_to_{camera}"] @ raw_other)[:3]
    raw_pixel = other[f"intrinsic_{camera}"] @ raw_camera
    assume((raw_pixel[2] > 1).all())
    raw_pixel = (raw_pixel[:2] / raw_pixel[2]).T
    raw_velocity = lidar_to_world[:3, :3] @ [3, -1, 0]

    # the devkit's way
    calib = read_calib(scratch / "one.pkl")
    calib_other = read_calib(scratch / "other.pkl")
    world_from_lidar = calib.world_from_ego @ calib.ego_from_lidar
    in_world = read_label(scratch / "label.txt").boxes().transform(world_from_lidar, "world")
    world_from_other = calib_other.world_from_ego @ calib_other.ego_from_lidar
    camera_from_world = calib_other.camera_from_lidar[camera] @ world_from_other.inverse()
    in_camera = in_world.transform(camera_from_world, camera)
    pinhole = PinholeCamera(calib_other.intrinsic[camera], 1600, 900)
    write_lidar(scratch / "points.npz", raw_lidar * [1, -1, 1], np.zeros(len(raw_lidar)))
    cloud = read_lidar(scratch / "points.npz").transform(world_from_lidar, "world")

    raw_cloud = read_lidar(scratch / "points.npz", raw=True)
    assert_allclose(raw_cloud[:, :3], raw_lidar, rtol=1e-6, atol=1e-5)
    assert_allclose(in_world.center[0], raw_world[:3, 0] * [1, -1, 1], atol=1e-9)
    assert_allclose(in_world.velocity[0], raw_velocity * [1, -1, 1], atol=1e-9)
    assert_allclose(in_world.corners()[0], raw_world[:3, 1:9].T * [1, -1, 1], atol=1e-9)
    assert_allclose(pinhole.project(in_camera.center)[0], raw_pixel[:1], atol=1e-6)
    assert_allclose(pinhole.project(in_camera.corners()[0])[0], raw_pixel[1:9], atol=1e-6)
    camera_points = camera_from_world.apply(cloud.xyz)
    assert_allclose(pinhole.project(camera_points)[0], raw_pixel, atol=0.05)  # float32 points
    raw_x, raw_y, raw_z = raw_camera[:, 0]
    assert_allclose(in_camera.center[0], (raw_y, -raw_z, raw_x), atol=1e-9)
    assert in_world.contains(cloud.xyz[[0, 9]]).all()
    assert in_camera.contains(camera_points[[0, 9]]).all()
