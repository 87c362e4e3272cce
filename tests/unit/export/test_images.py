"""How images are prepared: whole or scaled decoding, resizing and cropping."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from PIL import Image
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import SensorFileError
from deepaccident_devkit.export.images import ImageConfig, resized_part
from deepaccident_devkit.release import read_image, write_image


def picture(height: int, width: int) -> np.ndarray:
    v, u = np.mgrid[0:height, 0:width]
    return np.stack([u * 255 // width, v * 255 // height, (u + v) % 256], axis=-1).astype(np.uint8)


@pytest.fixture
def camera(da: DeepAccident) -> str:
    return f"{da.scenario[0]['token']}/ego_vehicle/004/Camera_Front"


def test_full_is_pillows_bilinear_filter(da: DeepAccident, camera: str) -> None:
    whole = Image.fromarray(da.load_image(camera)).resize((30, 18), Image.Resampling.BILINEAR)
    image, _ = ImageConfig(resize=(18, 30), crop=(2, 3, 12, 20)).load(da, camera)
    np.testing.assert_allclose(image.astype(int), np.asarray(whole)[2:14, 3:23], rtol=0, atol=1)


def test_scaled_has_the_same_intrinsic_and_nearly_the_same_pixels(da: DeepAccident, camera: str) -> None:
    for resize in ((18, 32), (9, 16), (17, 40), (36, 64), (72, 128)):
        crop = (1, 2, resize[0] - 3, resize[1] - 4)
        full, scaled = (
            ImageConfig(resize=resize, crop=crop, decode=each).load(da, camera) for each in ("full", "scaled")
        )
        assert full[0].shape == scaled[0].shape
        np.testing.assert_array_equal(full[1], scaled[1])
        assert np.abs(full[0].astype(int) - scaled[0]).mean() < 6


def test_scaled_without_a_size_is_full(da: DeepAccident, camera: str) -> None:
    np.testing.assert_array_equal(ImageConfig(decode="scaled").load(da, camera)[0], da.load_image(camera))


@pytest.mark.parametrize(
    ("least", "shape"),
    [((34, 60), (66, 120)), ((32, 60), (33, 60)), ((16, 20), (17, 30)), ((8, 15), (9, 15)), ((1, 1), (9, 15))],
)
def test_a_jpeg_is_decoded_no_smaller(tmp_path: Path, least: tuple[int, int], shape: tuple[int, int]) -> None:
    write_image(tmp_path / "image.jpg", picture(66, 120))
    assert read_image(tmp_path / "image.jpg", least=least).shape == (*shape, 3)


def test_a_png_is_decoded_whole(tmp_path: Path) -> None:
    Image.fromarray(picture(64, 120)).save(tmp_path / "image.jpg", format="PNG")
    np.testing.assert_array_equal(read_image(tmp_path / "image.jpg", least=(8, 8)), picture(64, 120))


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_truncated_jpeg_is_no_half_grey_picture(tmp_path: Path, share: float) -> None:
    path = tmp_path / "image.jpg"
    write_image(path, picture(64, 120))
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    assert_refused((lambda: read_image(path, least=(16, 16)), SensorFileError, r"image\.jpg: not a readable image"))


@pytest.mark.parametrize("decode", ["full", "scaled"])
@given(st.data())
def test_a_part_is_what_pillow_or_opencv_makes_of_the_whole(decode: str, data: st.DataObject) -> None:
    """At most 1 of 255 from it, shrunk or grown; where an image does both, OpenCV's area filter is another one."""
    old = data.draw(st.tuples(st.integers(1, 60), st.integers(1, 60)))
    size = data.draw(st.tuples(st.integers(1, 60), st.integers(1, 60)))
    assume(decode == "full" or (size[0] - old[0]) * (size[1] - old[1]) >= 0)
    top, left = (data.draw(st.integers(0, each - 1)) for each in size)
    height, width = data.draw(st.integers(1, size[0] - top)), data.draw(st.integers(1, size[1] - left))
    image = np.random.default_rng(sum(old)).integers(0, 2, (*old, 3), dtype=np.uint8) * 255
    if decode == "full":
        whole = np.asarray(Image.fromarray(image).resize(size[::-1], Image.Resampling.BILINEAR))
    else:
        whole = image if old == size else cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
    part = resized_part(image, size, (top, left, height, width), decode)
    difference = np.abs(part.astype(int) - whole[top : top + height, left : left + width])
    assert (difference.shape, difference.max() <= 1) == ((height, width, 3), True)
