import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.expected_errors import assert_raises
from support.strategies import mutations

from deepaccident_devkit.errors import MissingFileError, SensorFileError
from deepaccident_devkit.release.npz import read_npz, write_npz

REMEDY = "; restore the file from its archive"
DATA = np.arange(12, dtype=np.float32).reshape(3, 4)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "points.npz"


def write_members(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def make_npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_the_array_named_data_or_the_only_one(path: Path, save) -> None:
    save(path, data=DATA)
    np.testing.assert_array_equal(read_npz(path, "lidar"), DATA, strict=True)
    save(path, arr_0=DATA)
    np.testing.assert_array_equal(read_npz(path, "lidar"), DATA, strict=True)
    save(path, other=DATA + 1, data=DATA)
    np.testing.assert_array_equal(read_npz(path, "lidar"), DATA, strict=True)


@pytest.mark.parametrize(
    "array", [DATA, DATA.T, DATA[:0], DATA.astype(">f8"), np.arange(3, dtype=np.uint8), DATA[::2]]
)
def test_written_arrays_come_back_and_bytes_are_the_same_twice(
    path: Path, array: np.ndarray
) -> None:
    write_npz(path, array)
    np.testing.assert_array_equal(read_npz(path, "lidar"), array, strict=True)
    with np.load(path) as archive:
        assert archive.files == ["data"]
    first = path.read_bytes()
    write_npz(path, array)
    assert path.read_bytes() == first


def test_two_arrays_none_named_data_and_a_bare_array(path: Path) -> None:
    not_named_data = (f"{path}: expected an array named 'data'", REMEDY)

    np.savez(path, points=DATA, intensity=DATA)
    words = (*not_named_data, "points, intensity")
    assert_raises((lambda: read_npz(path, "lidar"), SensorFileError, words))

    write_members(path, {})
    words = (*not_named_data, "found no array")
    assert_raises((lambda: read_npz(path, "lidar"), SensorFileError, words))

    path.write_bytes(make_npy(DATA))
    words = (f"{path}: expected an npz archive, found a bare array", REMEDY)
    assert_raises((lambda: read_npz(path, "lidar"), SensorFileError, words))


def test_objects_empty_truncated_garbage_and_missing(path: Path) -> None:
    """Objects are never unpickled."""
    words = ("points.npz: no such file", "unpack the archive")
    assert_raises((lambda: read_npz(path, "lidar"), MissingFileError, words))

    np.savez(path, data=np.array([{"a": 1}]))
    objects = path.read_bytes()
    np.savez(path, data=DATA)
    whole = path.read_bytes()
    truncated = (whole[:end] for end in range(1, len(whole), 7))
    for content in (objects, pickle.dumps([1]), b"", b"garbage", bytes(1000), *truncated):
        path.write_bytes(content)
        reason = ".*" if content else r"the file is empty"
        message = rf"(?s)^{path}: not a readable npz archive \({reason}\){REMEDY}$"
        assert_raises((lambda: read_npz(path, "lidar"), SensorFileError, message))


def set_field(content: bytes, local_offset: int, central_offset: int, value: int) -> bytes:
    """Set a field in both headers of the archive's only member."""
    damaged = bytearray(content)
    central_header = content.rfind(b"PK\x01\x02")
    damaged[local_offset] = value
    damaged[central_header + central_offset] = value
    return bytes(damaged)


def make_huge_header() -> bytes:
    header = io.BytesIO()
    description = {"descr": "<f4", "fortran_order": False, "shape": (10**13, 4)}
    np.lib.format.write_array_header_1_0(header, description)
    return header.getvalue()


@pytest.mark.parametrize(
    ("members", "fields"),
    [
        ({"data": b"hello"}, None),
        ({"readme.txt": b"hello"}, None),
        ({"data.npy": b""}, None),
        ({"data.npy": make_huge_header()}, None),
        ({"data.npy": make_npy(DATA)}, (6, 8, 1)),
        ({"data.npy": make_npy(DATA)}, (8, 10, 99)),
        ({"data.npy": make_npy(DATA)}, (4, 6, 255)),
    ],
    ids=[
        "text-as-data",
        "text",
        "empty-member",
        "more-than-fits",
        "encrypted",
        "unknown-compression",
        "new-version",
    ],
)
def test_archives_that_are_not_numpys(
    path: Path, members: dict[str, bytes], fields: tuple | None
) -> None:
    write_members(path, members)
    if fields:
        assert read_npz(path, "lidar").shape == DATA.shape
        path.write_bytes(set_field(path.read_bytes(), *fields))
    assert_raises((lambda: read_npz(path, "lidar"), SensorFileError, rf"^{path}: .*{REMEDY}$"))


@settings(max_examples=150)
@given(st.data())
def test_damage_raises_our_error_or_the_array_is_whole(
    tmp_path_factory: pytest.TempPathFactory, outcome, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.npz"
    write_npz(path, DATA)
    path.write_bytes(data.draw(mutations(path.read_bytes())))
    array, message = outcome(SensorFileError, read_npz, path, "lidar")
    if message is None:
        np.testing.assert_array_equal(array, DATA)
    else:
        assert message.startswith(f"{path}: ")
