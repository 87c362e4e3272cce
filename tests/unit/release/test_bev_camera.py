from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

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
    semantic, instance = np.zeros(BEV_SHAPE, np.uint8), np.zeros(BEV_SHAPE, np.uint16)
    semantic[10, 20], instance[10, 20] = 10, 3 * 256 + 200
    np.testing.assert_array_equal(image.semantic, semantic, strict=True)
    np.testing.assert_array_equal(image.instance, instance, strict=True)
    np.testing.assert_array_equal(read_bev(path, raw=True), raw)
    assert (image.resolution, image.semantic.flags.writeable, image.instance.flags.writeable) == (
        0.1,
        False,
        False,
    )


def test_written_channels(path: Path) -> None:
    semantic, instance = np.zeros(BEV_SHAPE, dtype=np.uint8), np.zeros(BEV_SHAPE, dtype=np.uint16)
    semantic[1, 2], instance[1, 2] = 4, 0xABCD
    write_bev(path, semantic, instance)
    assert read_bev(path, raw=True)[1, 2].tolist() == [0xAB, 0xCD, 4]


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((1200, 1200), "u1"), ((600, 600, 3), "u1"), ((3, 1200, 1200), "u1"), ((1200, 1200, 3), "i2")],
)
def test_other_arrays_are_refused(
    path: Path, shape: tuple[int, ...], dtype: str, raw: bool
) -> None:
    np.savez_compressed(path, data=np.zeros(shape, dtype=dtype))
    found = f"found {shape} of {np.dtype(dtype)}".replace("(", r"\(").replace(")", r"\)")
    message = (
        rf"^{path}: expected shape \(1200, 1200, 3\) of uint8, {found}; restore "
        rf"the file from its archive$"
    )
    assert_refused((lambda: read_bev(path, raw=raw), SensorFileError, message))
