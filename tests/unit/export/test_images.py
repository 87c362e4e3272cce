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
from deepaccident_devkit.errors import ConfigError, SensorFileError
from deepaccident_devkit.export.images import ImageConfig, VirtualCamera, resized_part
from deepaccident_devkit.geometry import PinholeCamera
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


def test_scaled_has_the_same_intrinsic_and_nearly_the_same_pixels(
    da: DeepAccident, camera: str
) -> None:
    for resize in ((18, 32), (9, 16), (17, 40), (36, 64), (72, 128)):
        crop = (1, 2, resize[0] - 3, resize[1] - 4)
        full, scaled = (
            ImageConfig(resize=resize, crop=crop, decode=each).load(da, camera)
            for each in ("full", "scaled")
        )
        assert full[0].shape == scaled[0].shape
        np.testing.assert_array_equal(full[1], scaled[1])
        assert np.abs(full[0].astype(int) - scaled[0]).mean() < 6


def test_scaled_without_a_size_is_full(da: DeepAccident, camera: str) -> None:
    np.testing.assert_array_equal(
        ImageConfig(decode="scaled").load(da, camera)[0], da.load_image(camera)
    )


@pytest.mark.parametrize(
    ("least", "shape"),
    [
        ((34, 60), (66, 120)),
        ((32, 60), (33, 60)),
        ((16, 20), (17, 30)),
        ((8, 15), (9, 15)),
        ((1, 1), (9, 15)),
    ],
)
def test_a_jpeg_is_decoded_no_smaller(
    tmp_path: Path, least: tuple[int, int], shape: tuple[int, int]
) -> None:
    write_image(tmp_path / "image.jpg", picture(66, 120))
    assert read_image(tmp_path / "image.jpg", min_size=least).shape == (*shape, 3)


def test_a_png_is_decoded_whole(tmp_path: Path) -> None:
    Image.fromarray(picture(64, 120)).save(tmp_path / "image.jpg", format="PNG")
    np.testing.assert_array_equal(
        read_image(tmp_path / "image.jpg", min_size=(8, 8)), picture(64, 120)
    )


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_truncated_jpeg_is_no_half_grey_picture(tmp_path: Path, share: float) -> None:
    path = tmp_path / "image.jpg"
    write_image(path, picture(64, 120))
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    assert_refused(
        (
            lambda: read_image(path, min_size=(16, 16)),
            SensorFileError,
            r"image\.jpg: not a readable image",
        )
    )


@pytest.mark.parametrize("decode", ["full", "scaled"])
@given(st.data())
def test_a_part_is_what_pillow_or_opencv_makes_of_the_whole(
    decode: str, data: st.DataObject
) -> None:
    """At most 1 of 255 from it, shrunk or grown; where an image does both, OpenCV's area filter is
    another one.
    """
    old = data.draw(st.tuples(st.integers(1, 60), st.integers(1, 60)))
    size = data.draw(st.tuples(st.integers(1, 60), st.integers(1, 60)))
    assume(decode == "full" or (size[0] - old[0]) * (size[1] - old[1]) >= 0)
    top, left = (data.draw(st.integers(0, each - 1)) for each in size)
    height, width = (
        data.draw(st.integers(1, size[0] - top)),
        data.draw(st.integers(1, size[1] - left)),
    )
    image = np.random.default_rng(sum(old)).integers(0, 2, (*old, 3), dtype=np.uint8) * 255
    if decode == "full":
        whole = np.asarray(Image.fromarray(image).resize(size[::-1], Image.Resampling.BILINEAR))
    else:
        whole = (
            image if old == size else cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
        )
    part = resized_part(image, size, (top, left, height, width), decode)
    difference = np.abs(part.astype(int) - whole[top : top + height, left : left + width])
    assert (difference.shape, difference.max() <= 1) == ((height, width, 3), True)


@given(
    st.floats(0.5, 2.0),
    st.floats(0.4, 0.6),
    st.floats(0.4, 0.6),
    st.floats(20, 120),
    st.integers(20, 90),
    st.integers(20, 90),
)
def test_a_virtual_camera_sees_the_same_in_the_same_directions(
    zoom: float, across: float, down: float, focal: float, height: int, width: int
) -> None:
    """Colours say where in the whole image a pixel was; by K, that is where its direction meets the
    whole image.
    """
    v, u = np.mgrid[0:120, 0:160]
    whole = np.stack([u, v, np.full_like(u, 200)], axis=-1).astype(np.uint8)
    own = np.array([[100 * zoom, 0, 160 * across], [0, 110 * zoom, 120 * down], [0, 0, 1]])
    image, intrinsic = VirtualCamera(focal, height, width).capture(
        whole, PinholeCamera(own, 160, 120), "full"
    )
    assert image.shape == (height, width, 3)
    half_a_pixel = np.diag(own)[:2] / (160, 120) / 2  # of the scaled whole image's size
    assert (np.abs(np.diag(intrinsic)[:2] - focal) <= half_a_pixel + 1e-9).all()
    np.testing.assert_allclose(intrinsic[:2, 2], (width / 2, height / 2), atol=0.5 + 1e-9)
    row, column = np.nonzero(image[..., 2] == 200)
    rays = np.linalg.inv(intrinsic) @ np.stack([column + 0.5, row + 0.5, np.ones(len(row))])
    at = (own @ rays)[:2] - 0.5
    inner = ((at > 3) & (at < np.array([[156], [116]]))).all(axis=0)
    np.testing.assert_allclose(image[row, column][inner, :2], at.T[inner], atol=2.1)
    black = np.nonzero(image[..., 2] == 0)
    rays = np.linalg.inv(intrinsic) @ np.stack(
        [black[1] + 0.5, black[0] + 0.5, np.ones(len(black[0]))]
    )
    beyond = (own @ rays)[:2]
    assert ((beyond < 1.5 / zoom + 3) | (beyond > np.array([[156], [116]]))).any(axis=0).all()


def test_a_virtual_camera_takes_the_place_of_resizing(da: DeepAccident, camera: str) -> None:
    image, intrinsic = ImageConfig(virtual_camera=VirtualCamera(40, 30, 50)).load(da, camera)
    assert image.shape == (30, 50, 3)
    assert intrinsic[0, 0] == pytest.approx(40, rel=0.02)


@pytest.mark.parametrize(
    "wrong",
    [
        {"virtual_camera": (0, 9, 9)},
        {"virtual_camera": (9, 0, 9)},
        {"virtual_camera": (9, 9, 9), "resize": (9, 9)},
    ],
)
def test_a_virtual_camera_that_cannot_be(wrong: dict) -> None:
    with pytest.raises(ConfigError, match=r"virtual_camera: expected"):
        ImageConfig(**wrong)
