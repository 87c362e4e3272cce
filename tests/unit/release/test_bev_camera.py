import re
from pathlib import Path

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.release import read_bev, write_bev
from deepaccident_devkit.taxonomy import BEV_SHAPE


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "bev.npz"


@pytest.mark.parametrize("key", ["data", "arr_0"])
def test_channels(path: Path, key: str) -> None:
    raw = np.zeros((*BEV_SHAPE, 3), dtype=np.uint8)
    raw[10, 20] = 3, 200, 10  # high byte, low byte, vehicle
    np.savez(path, **{key: raw})

    image = read_bev(path)

    semantic = np.zeros(BEV_SHAPE, np.uint8)
    semantic[10, 20] = 10
    instance = np.zeros(BEV_SHAPE, np.uint16)
    instance[10, 20] = 3 * 256 + 200
    np.testing.assert_array_equal(image.semantic, semantic, strict=True)
    np.testing.assert_array_equal(image.instance, instance, strict=True)
    np.testing.assert_array_equal(read_bev(path, raw=True), raw)
    assert image.resolution == 0.1
    assert not image.semantic.flags.writeable
    assert not image.instance.flags.writeable


def test_written_channels(path: Path) -> None:
    semantic = np.zeros(BEV_SHAPE, dtype=np.uint8)
    semantic[1, 2] = 4
    instance = np.zeros(BEV_SHAPE, dtype=np.uint16)
    instance[1, 2] = 0xABCD

    write_bev(path, semantic, instance)

    raw = read_bev(path, raw=True)
    assert raw[1, 2].tolist() == [0xAB, 0xCD, 4]


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((1200, 1200), "u1"), ((600, 600, 3), "u1"), ((3, 1200, 1200), "u1"), ((1200, 1200, 3), "i2")],
)
def test_other_arrays_are_refused(
    path: Path, shape: tuple[int, ...], dtype: str, raw: bool
) -> None:
    np.savez_compressed(path, data=np.zeros(shape, dtype=dtype))
    actual_shape = re.escape(str(shape))
    message = (
        rf"^{path}: expected shape \(1200, 1200, 3\) of uint8, found {actual_shape} of "
        rf"{np.dtype(dtype)}; restore the file from its archive$"
    )
    assert_raises((lambda: read_bev(path, raw=raw), SensorFileError, message))
