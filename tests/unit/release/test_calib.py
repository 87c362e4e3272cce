import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import CalibError
from deepaccident_devkit.geometry import PinholeCamera
from deepaccident_devkit.release import read_calib, read_calibs, write_calib
from deepaccident_devkit.release.calib import KEYS
from deepaccident_devkit.taxonomy import CAMERAS

RawCalib = dict[str, np.ndarray]
REMEDY = "; restore the file from its archive"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "calib.pkl"


def write_pickle(path: Path, raw: object, protocol: int = 2) -> Path:
    path.write_bytes(pickle.dumps(raw, protocol))
    return path


def test_the_example_of_the_format_page(path: Path, raw_calib: RawCalib) -> None:
    back = np.diag([-1.0, -1, 1, 1])
    back[:3, 3] = -2.096, 0, 0.3
    back_intrinsic = np.array([[800, 560.166, 0], [450, 0, -560.166], [1, 0, 0]])
    raw = {
        **raw_calib,
        "lidar_to_Camera_Back": back,
        "intrinsic_Camera_Back": back_intrinsic,
    }

    calib = read_calib(write_pickle(path, raw))

    intrinsic = calib.intrinsic["Camera_Back"]
    assert_array_equal(intrinsic, [[560.166, 0, 800], [0, 560.166, 450], [0, 0, 1]])

    # 10 m behind, 1 m left, 1 m up in the LiDAR frame: to the right of the middle, above it
    in_camera = calib.camera_from_lidar["Camera_Back"].apply([[-10.0, 1, 1]])
    assert_allclose(in_camera, [[1, -1.3, 7.904]])

    (pixel,), _ = PinholeCamera(intrinsic, 1600, 900).project(in_camera)
    assert_allclose(pixel, [800 + 560.166 / 7.904, 450 - 560.166 * 1.3 / 7.904])
    raw_pixel = back_intrinsic @ (back @ [-10, -1, 1, 1])[:3]
    assert_allclose(pixel, raw_pixel[:2] / raw_pixel[2])


def test_poses_mirror_at_y(path: Path, raw_calib: RawCalib) -> None:
    mirror = np.diag([1, -1, 1, 1])

    calib = read_calib(write_pickle(path, raw_calib))

    ego_from_lidar = mirror @ raw_calib["lidar_to_ego"] @ mirror
    world_from_ego = mirror @ raw_calib["ego_to_world"] @ mirror
    assert_array_equal(calib.ego_from_lidar.matrix, ego_from_lidar)
    assert_array_equal(calib.world_from_ego.matrix, world_from_ego)
    assert list(calib.camera_from_lidar) == list(CAMERAS)
    assert list(calib.intrinsic) == list(CAMERAS)


@pytest.mark.parametrize(
    ("protocols", "ego_to_world"),
    [
        ((2, 2), np.eye(4)),
        ((4, 4), np.eye(4)),  # of one layout, as the next two are
        ((4, 4), np.eye(4, dtype=">f4")),
        ((4, 4), np.asfortranarray(np.eye(4) + np.eye(4, k=3))),
        ((4, 3), np.eye(4, dtype=np.int64)),
    ],
)
def test_several_files_are_stacked(
    tmp_path: Path, raw_calib: RawCalib, protocols: tuple[int, int], ego_to_world: np.ndarray
) -> None:
    first = {**raw_calib, "ego_to_world": ego_to_world}
    second = {**first, "lidar_to_ego": np.eye(4)}
    paths = [
        write_pickle(tmp_path / "1.pkl", first, protocols[0]),
        write_pickle(tmp_path / "2.pkl", second, protocols[1]),
    ]

    calibs = read_calibs(paths)

    assert len(calibs) == 2
    for index, path in enumerate(paths):
        single = read_calib(path)
        assert_array_equal(calibs.world_from_ego[index], single.world_from_ego.matrix)
        assert_array_equal(calibs.ego_from_lidar[index], single.ego_from_lidar.matrix)
        for number, camera in enumerate(CAMERAS):
            camera_from_lidar = single.camera_from_lidar[camera].matrix
            assert_array_equal(calibs.camera_from_lidar[index, number], camera_from_lidar)
            assert_array_equal(calibs.intrinsic[index, number], single.intrinsic[camera])
    with pytest.raises(ValueError, match="read-only"):
        calibs.world_from_ego[0] = 0
    assert len(read_calibs([])) == 0


def with_array(key: str, change: Callable[[np.ndarray], object]) -> Callable[[RawCalib], RawCalib]:
    """Return a function that replaces one array of a calibration."""

    def replace_array(raw: RawCalib) -> RawCalib:
        return {**raw, key: change(raw[key].copy())}

    return replace_array


def with_item(key: str, index: tuple[int, int], value: float) -> Callable[[RawCalib], RawCalib]:
    """Return a function that sets one number of a calibration."""

    def set_item(array: np.ndarray) -> np.ndarray:
        array[index] = value
        return array

    return with_array(key, set_item)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda raw: {k: v for k, v in raw.items() if k != "ego_to_world"}, "lacks ego_to_world"),
        (
            lambda raw: {"lidar_to_ego": raw["lidar_to_ego"]},
            "lacks ego_to_world, lidar_to_Camera_Front, .*BackRight",
        ),
        (lambda _: {}, "lacks lidar_to_ego"),
        (lambda raw: list(raw.values()), "expected a dict of arrays, found list"),
        (lambda _: None, "expected a dict of arrays, found NoneType"),
        (
            with_array("lidar_to_ego", lambda a: a[:3]),
            r"lidar_to_ego: expected numbers of shape \(4, 4\), found \(3, 4\) of",
        ),
        (
            with_array("intrinsic_Camera_Back", lambda _: np.eye(4)),
            r"intrinsic_Camera_Back: .*\(3, 3\), found \(4, 4\) of",
        ),
        (with_array("ego_to_world", lambda a: a[None]), r"ego_to_world: .*found \(1, 4, 4\)"),
        (with_array("ego_to_world", lambda a: a > 0), r"ego_to_world: .*found \(4, 4\) of bool"),
        (with_array("ego_to_world", lambda a: a.tolist()), "ego_to_world: .*found list"),
        (with_array("ego_to_world", lambda _: None), "ego_to_world: .*found NoneType"),
        (with_array("ego_to_world", lambda _: "eye"), "ego_to_world: .*found str"),
        (with_item("ego_to_world", (0, 0), np.nan), "ego_to_world: contains NaN or infinity"),
        (with_item("ego_to_world", (0, 3), np.inf), "ego_to_world: contains NaN or infinity"),
        (
            with_item("ego_to_world", (0, 3), -1e300),
            "ego_to_world: contains NaN or infinity, or a number beyond 1e",
        ),
        (
            with_item("intrinsic_Camera_Front", (1, 2), 1e39),
            "intrinsic_Camera_Front: contains NaN or infinity, or a",
        ),
        (
            with_item("lidar_to_Camera_Front", (2, 1), np.inf),
            "lidar_to_Camera_Front: contains NaN or infinity",
        ),
        (
            with_item("intrinsic_Camera_Front", (0, 0), np.nan),
            "intrinsic_Camera_Front: contains NaN or infinity",
        ),
        (with_item("lidar_to_ego", (0, 0), 1e200), "lidar_to_ego: its rotation is not orthonormal"),
        (
            with_array("lidar_to_Camera_Back", lambda a: a * 1.01),
            "lidar_to_Camera_Back: its last row is",
        ),
        (
            with_array("lidar_to_ego", lambda a: a @ np.diag([1.01, 1, 1, 1])),
            "lidar_to_ego: its rotation is not ortho",
        ),
        (
            with_array("lidar_to_ego", lambda a: a @ np.diag([1, -1, 1, 1])),
            "lidar_to_ego: its rotation is a mirror image",
        ),
        (with_array("ego_to_world", lambda a: a.T), "ego_to_world: its last row is"),
        (with_array("ego_to_world", np.zeros_like), "ego_to_world: its last row is"),
    ],
)
def test_faults_name_file_key_and_remedy(
    path: Path, raw_calib: RawCalib, spoil: Callable, message: str
) -> None:
    write_pickle(path, spoil(raw_calib))
    pattern = f"^{path}: {message}.*{REMEDY}$"
    assert_raises(
        (lambda: read_calib(path), CalibError, pattern),
        (lambda: read_calib(path, raw=True), CalibError, pattern),
        (lambda: read_calibs([path]), CalibError, pattern),
    )


def test_damaged_files(path: Path, raw_calib: RawCalib) -> None:
    whole = pickle.dumps(raw_calib, 2)
    truncated = [whole[:end] for end in range(0, len(whole), 37)]
    for content in (b"", bytes(100), b"garbage", b"\xff\xd8\xff\xe0JFIF", *truncated):
        path.write_bytes(content)
        fault = r"not a readable calibration \(" if len(content) <= 100 else ""
        assert_raises((lambda: read_calib(path), CalibError, f"(?s)^{path}: {fault}.*{REMEDY}$"))


def test_slightly_imprecise_poses_are_taken(path: Path, raw_calib: RawCalib) -> None:
    single_precision = {key: array.astype(np.float32) for key, array in raw_calib.items()}

    calib = read_calib(write_pickle(path, single_precision))

    assert calib.world_from_ego.matrix.dtype == np.float64
    translation = raw_calib["ego_to_world"][:3, 3] * [1, -1, 1]
    assert_allclose(calib.world_from_ego.translation, translation, rtol=1e-6)


def test_written_files_hold_the_raw_values_under_names_that_every_numpy_knows(
    tmp_path: Path, path: Path, raw_calib: RawCalib
) -> None:
    calib = read_calib(write_pickle(tmp_path / "given.pkl", raw_calib))

    write_calib(path, calib)

    content = path.read_bytes()
    assert b"numpy._core" not in content
    written = pickle.loads(content)
    assert written.keys() == KEYS.keys()
    for key, array in raw_calib.items():
        assert_array_equal(written[key], array)
        zeros = written[key][written[key] == 0]
        assert not np.signbit(zeros).any()
