import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

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


def dump(path: Path, raw: object, protocol: int = 2) -> Path:
    path.write_bytes(pickle.dumps(raw, protocol))
    return path


def test_format_mds_example(path: Path, raw_calib: RawCalib) -> None:
    back = np.diag([-1.0, -1, 1, 1])
    back[:3, 3] = -2.096, 0, 0.3
    raw = raw_calib | {
        "lidar_to_Camera_Back": back,
        "intrinsic_Camera_Back": np.array([[800, 560.166, 0], [450, 0, -560.166], [1, 0, 0]]),
    }
    calib = read_calib(dump(path, raw))
    assert_array_equal(
        calib.intrinsic["Camera_Back"], [[560.166, 0, 800], [0, 560.166, 450], [0, 0, 1]]
    )
    # 10 m behind, 1 m left, 1 m up in the LiDAR frame: to the right of the middle, above it
    in_camera = calib.camera_from_lidar["Camera_Back"].apply([[-10.0, 1, 1]])
    assert_allclose(in_camera, [[1, -1.3, 7.904]])
    pixel = PinholeCamera(calib.intrinsic["Camera_Back"], 1600, 900).project(in_camera)[0][0]
    assert_allclose(pixel, [800 + 560.166 / 7.904, 450 - 560.166 * 1.3 / 7.904])
    raw_pixel = raw["intrinsic_Camera_Back"] @ (back @ [-10, -1, 1, 1])[:3]
    assert_allclose(pixel, raw_pixel[:2] / raw_pixel[2])


def test_poses_mirror_at_y(path: Path, raw_calib: RawCalib) -> None:
    calib = read_calib(dump(path, raw_calib))
    mirror = np.diag([1, -1, 1, 1])
    assert_array_equal(calib.ego_from_lidar.matrix, mirror @ raw_calib["lidar_to_ego"] @ mirror)
    assert_array_equal(calib.world_from_ego.matrix, mirror @ raw_calib["ego_to_world"] @ mirror)
    assert list(calib.camera_from_lidar) == list(calib.intrinsic) == list(CAMERAS)


@pytest.mark.parametrize(
    ("protocols", "moved"),
    [
        ((2, 2), np.eye(4)),
        ((4, 4), np.eye(4)),  # of one layout, as the next two are
        ((4, 4), np.eye(4, dtype=">f4")),
        ((4, 4), np.asfortranarray(np.eye(4) + np.eye(4, k=3))),
        ((4, 3), np.eye(4, dtype=np.int64)),
    ],
)
def test_several_files_are_stacked(
    tmp_path: Path, raw_calib: RawCalib, protocols: tuple[int, int], moved: np.ndarray
) -> None:
    first = raw_calib | {"ego_to_world": moved}
    contents = first, first | {"lidar_to_ego": np.eye(4)}
    paths = [
        dump(tmp_path / f"{name}.pkl", raw, protocol)
        for name, raw, protocol in zip("12", contents, protocols, strict=True)
    ]
    calibs = read_calibs(paths)
    assert len(calibs) == 2
    for index, single in enumerate(map(read_calib, paths)):
        assert_array_equal(calibs.world_from_ego[index], single.world_from_ego.matrix)
        assert_array_equal(calibs.ego_from_lidar[index], single.ego_from_lidar.matrix)
        for number, camera in enumerate(CAMERAS):
            assert_array_equal(
                calibs.camera_from_lidar[index, number], single.camera_from_lidar[camera].matrix
            )
            assert_array_equal(calibs.intrinsic[index, number], single.intrinsic[camera])
    with pytest.raises(ValueError, match="read-only"):
        calibs.world_from_ego[0] = 0
    assert len(read_calibs([])) == 0


def changed(key: str, change: Callable[[np.ndarray], object]) -> Callable[[RawCalib], RawCalib]:
    return lambda raw: raw | {key: change(raw[key].copy())}


def with_item(key: str, place: tuple[int, int], value: float) -> Callable[[RawCalib], RawCalib]:
    def put(array: np.ndarray) -> np.ndarray:
        array[place] = value
        return array

    return changed(key, put)


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
            changed("lidar_to_ego", lambda a: a[:3]),
            r"lidar_to_ego: expected numbers of shape \(4, 4\), found \(3, 4\) of",
        ),
        (
            changed("intrinsic_Camera_Back", lambda _: np.eye(4)),
            r"intrinsic_Camera_Back: .*\(3, 3\), found \(4, 4\) of",
        ),
        (changed("ego_to_world", lambda a: a[None]), r"ego_to_world: .*found \(1, 4, 4\)"),
        (changed("ego_to_world", lambda a: a > 0), r"ego_to_world: .*found \(4, 4\) of bool"),
        (changed("ego_to_world", lambda a: a.tolist()), "ego_to_world: .*found list"),
        (changed("ego_to_world", lambda _: None), "ego_to_world: .*found NoneType"),
        (changed("ego_to_world", lambda _: "eye"), "ego_to_world: .*found str"),
        (with_item("ego_to_world", (0, 0), np.nan), "ego_to_world: holds NaN or infinity"),
        (with_item("ego_to_world", (0, 3), np.inf), "ego_to_world: holds NaN or infinity"),
        (
            with_item("ego_to_world", (0, 3), -1e300),
            "ego_to_world: holds NaN or infinity, or a number beyond 1e",
        ),
        (
            with_item("intrinsic_Camera_Front", (1, 2), 1e39),
            "intrinsic_Camera_Front: holds NaN or infinity, or a",
        ),
        (
            with_item("lidar_to_Camera_Front", (2, 1), np.inf),
            "lidar_to_Camera_Front: holds NaN or infinity",
        ),
        (
            with_item("intrinsic_Camera_Front", (0, 0), np.nan),
            "intrinsic_Camera_Front: holds NaN or infinity",
        ),
        (with_item("lidar_to_ego", (0, 0), 1e200), "lidar_to_ego: its rotation is not orthonormal"),
        (
            changed("lidar_to_Camera_Back", lambda a: a * 1.01),
            "lidar_to_Camera_Back: its last row is",
        ),
        (
            changed("lidar_to_ego", lambda a: a @ np.diag([1.01, 1, 1, 1])),
            "lidar_to_ego: its rotation is not ortho",
        ),
        (
            changed("lidar_to_ego", lambda a: a @ np.diag([1, -1, 1, 1])),
            "lidar_to_ego: its rotation is a mirror image",
        ),
        (changed("ego_to_world", lambda a: a.T), "ego_to_world: its last row is"),
        (changed("ego_to_world", np.zeros_like), "ego_to_world: its last row is"),
    ],
)
def test_faults_name_file_key_and_remedy(
    path: Path, raw_calib: RawCalib, spoil: Callable, message: str
) -> None:
    dump(path, spoil(raw_calib))
    for read in (
        read_calib,
        lambda path: read_calib(path, raw=True),
        lambda path: read_calibs([path]),
    ):
        with pytest.raises(CalibError, match=f"^{path}: {message}.*{REMEDY}$"):
            read(path)


def test_damaged_files(path: Path, raw_calib: RawCalib) -> None:
    whole = pickle.dumps(raw_calib, 2)
    cut = [whole[:end] for end in range(0, len(whole), 37)]
    for content in (b"", bytes(100), b"garbage", b"\xff\xd8\xff\xe0JFIF", *cut):
        path.write_bytes(content)
        said = r"not a readable calibration \(" if len(content) <= 100 else ""
        assert_refused((lambda: read_calib(path), CalibError, f"(?s)^{path}: {said}.*{REMEDY}$"))


def test_slightly_imprecise_poses_are_taken(path: Path, raw_calib: RawCalib) -> None:
    single = {key: array.astype(np.float32) for key, array in raw_calib.items()}
    calib = read_calib(dump(path, single))
    assert calib.world_from_ego.matrix.dtype == np.float64
    assert_allclose(
        calib.world_from_ego.translation, raw_calib["ego_to_world"][:3, 3] * [1, -1, 1], rtol=1e-6
    )


def test_written_files_hold_the_raw_values_under_names_that_every_numpy_knows(
    tmp_path: Path, path: Path, raw_calib: RawCalib
) -> None:
    write_calib(path, read_calib(dump(tmp_path / "given.pkl", raw_calib)))
    content = path.read_bytes()
    assert b"numpy._core" not in content
    written = pickle.loads(content)
    assert written.keys() == KEYS.keys()
    for key, array in raw_calib.items():
        assert_array_equal(written[key], array)
        assert not np.signbit(written[key][written[key] == 0]).any()
