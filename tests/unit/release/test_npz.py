import io
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import assert_refused
from strategies import mutations

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


def npy(array: np.ndarray) -> bytes:
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
    def read(write: Callable[[], object]) -> object:
        write()
        return read_npz(path, "lidar")

    expected = (f"{path}: expected an array named 'data'", REMEDY)
    assert_refused(
        (
            lambda: read(lambda: np.savez(path, points=DATA, intensity=DATA)),
            SensorFileError,
            (*expected, "points, intensity"),
        ),
        (
            lambda: read(lambda: write_members(path, {})),
            SensorFileError,
            (*expected, "found no array"),
        ),
        (
            lambda: read(lambda: path.write_bytes(npy(DATA))),
            SensorFileError,
            (f"{path}: expected an npz archive, found a bare array", REMEDY),
        ),
    )


def test_objects_empty_truncated_garbage_and_missing(path: Path) -> None:
    """Objects are never unpickled."""
    assert_refused(
        (
            lambda: read_npz(path, "lidar"),
            MissingFileError,
            ("points.npz: no such file", "unpack the archive"),
        )
    )
    np.savez(path, data=np.array([{"a": 1}]))
    objects = path.read_bytes()
    np.savez(path, data=DATA)
    whole = path.read_bytes()
    cut = (whole[:end] for end in range(1, len(whole), 7))
    for content in (objects, pickle.dumps([1]), b"", b"garbage", bytes(1000), *cut):
        path.write_bytes(content)
        said = r"the file is empty" if not content else ".*"
        message = rf"(?s)^{path}: not a readable npz archive \({said}\){REMEDY}$"
        assert_refused((lambda: read_npz(path, "lidar"), SensorFileError, message))


def with_field(content: bytes, local: int, central: int, value: int) -> bytes:
    """A field of both headers of the archive's only member, set to a value."""
    damaged, entry = bytearray(content), content.rfind(b"PK\x01\x02")
    damaged[local], damaged[entry + central] = value, value
    return bytes(damaged)


def huge_header() -> bytes:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (10**13, 4)}
    )
    return header.getvalue()


@pytest.mark.parametrize(
    ("members", "fields"),
    [
        ({"data": b"hello"}, None),
        ({"readme.txt": b"hello"}, None),
        ({"data.npy": b""}, None),
        ({"data.npy": huge_header()}, None),
        ({"data.npy": npy(DATA)}, (6, 8, 1)),
        ({"data.npy": npy(DATA)}, (8, 10, 99)),
        ({"data.npy": npy(DATA)}, (4, 6, 255)),
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
        path.write_bytes(with_field(path.read_bytes(), *fields))
    assert_refused((lambda: read_npz(path, "lidar"), SensorFileError, rf"^{path}: .*{REMEDY}$"))


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
