"""Prepare images: whole or scaled decoding, resizing and cropping."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from PIL import Image

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, SensorFileError
from deepaccident_devkit.export.images import ImageConfig, VirtualCamera, resized_part
from deepaccident_devkit.geometry import PinholeCamera
from deepaccident_devkit.release import read_image, write_image


def make_picture(height: int, width: int) -> np.ndarray:
    v, u = np.mgrid[0:height, 0:width]
    channels = [
        u * 255 // width,
        v * 255 // height,
        (u + v) % 256,
    ]
    return np.stack(channels, axis=-1).astype(np.uint8)


@pytest.fixture
def camera(da: DeepAccident) -> str:
    return f"{da.scenario[0]['token']}/ego_vehicle/004/Camera_Front"


def test_full_decoding_is_pillows_bilinear_filter(da: DeepAccident, camera: str) -> None:
    image, _ = ImageConfig(resize=(18, 30), crop=(2, 3, 12, 20)).load(da, camera)
    whole = Image.fromarray(da.load_image(camera))
    resized = np.asarray(whole.resize((30, 18), Image.Resampling.BILINEAR))
    np.testing.assert_allclose(
        image.astype(int),
        resized[2:14, 3:23],
        rtol=0,
        atol=1,
    )


def test_scaled_decoding_has_the_same_intrinsic_and_nearly_the_same_pixels(
    da: DeepAccident, camera: str
) -> None:
    for resize in ((18, 32), (9, 16), (17, 40), (36, 64), (72, 128)):
        crop = (1, 2, resize[0] - 3, resize[1] - 4)
        full_config = ImageConfig(resize=resize, crop=crop, decode="full")
        full, full_intrinsic = full_config.load(da, camera)
        scaled_config = ImageConfig(resize=resize, crop=crop, decode="scaled")
        scaled, scaled_intrinsic = scaled_config.load(da, camera)
        assert full.shape == scaled.shape
        np.testing.assert_array_equal(full_intrinsic, scaled_intrinsic)
        assert np.abs(full.astype(int) - scaled).mean() < 6


def test_scaled_decoding_without_a_size_is_full(da: DeepAccident, camera: str) -> None:
    image, _ = ImageConfig(decode="scaled").load(da, camera)
    np.testing.assert_array_equal(image, da.load_image(camera))


@pytest.mark.parametrize(
    ("min_size", "decoded_size"),
    [
        ((34, 60), (66, 120)),
        ((32, 60), (33, 60)),
        ((16, 20), (17, 30)),
        ((8, 15), (9, 15)),
        ((1, 1), (9, 15)),
    ],
)
def test_a_jpeg_is_decoded_no_smaller(
    tmp_path: Path, min_size: tuple[int, int], decoded_size: tuple[int, int]
) -> None:
    path = tmp_path / "image.jpg"
    write_image(path, make_picture(66, 120))
    assert read_image(path, min_size=min_size).shape == (*decoded_size, 3)


def test_a_png_is_decoded_whole(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    Image.fromarray(make_picture(64, 120)).save(path, format="PNG")
    np.testing.assert_array_equal(read_image(path, min_size=(8, 8)), make_picture(64, 120))


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_truncated_jpeg_is_no_half_grey_picture(tmp_path: Path, share: float) -> None:
    path = tmp_path / "image.jpg"
    write_image(path, make_picture(64, 120))
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(SensorFileError, match=r"image\.jpg: not a readable image"):
        read_image(path, min_size=(16, 16))


@pytest.mark.parametrize("decode", ["full", "scaled"])
@given(st.data())
def test_a_resized_part_equals_the_part_of_the_resized_whole(
    decode: str, data: st.DataObject
) -> None:
    """Pillow and OpenCV resize the whole, which differs by at most 1 of 255. Images that shrink in
    one direction and grow in the other are skipped, because OpenCV's area filter differs there.
    """
    sizes = st.tuples(st.integers(1, 60), st.integers(1, 60))
    old_size = data.draw(sizes)
    size = data.draw(sizes)
    assume(decode == "full" or (size[0] - old_size[0]) * (size[1] - old_size[1]) >= 0)
    top = data.draw(st.integers(0, size[0] - 1))
    left = data.draw(st.integers(0, size[1] - 1))
    height = data.draw(st.integers(1, size[0] - top))
    width = data.draw(st.integers(1, size[1] - left))
    random = np.random.default_rng(sum(old_size))
    image = random.integers(0, 2, (*old_size, 3), dtype=np.uint8) * 255

    if decode == "full":
        whole = np.asarray(Image.fromarray(image).resize(size[::-1], Image.Resampling.BILINEAR))
    elif old_size == size:
        whole = image
    else:
        whole = cv2.resize(
            image,
            size[::-1],
            interpolation=cv2.INTER_AREA,
        )
    part = resized_part(
        image,
        size,
        (top, left, height, width),
        decode,
    )
    difference = np.abs(part.astype(int) - whole[top : top + height, left : left + width])

    assert difference.shape == (height, width, 3)
    assert difference.max() <= 1


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
    """The colour of a pixel encodes its position in the whole image, which must be where the
    pixel's direction meets that image.
    """
    v, u = np.mgrid[0:120, 0:160]
    whole = np.stack([u, v, np.full_like(u, 200)], axis=-1).astype(np.uint8)
    whole_intrinsic = np.array(
        [[100 * zoom, 0, 160 * across], [0, 110 * zoom, 120 * down], [0, 0, 1]]
    )
    camera = PinholeCamera(whole_intrinsic, 160, 120)
    image, intrinsic = VirtualCamera(focal, height, width).capture(
        whole,
        camera,
        "full",
    )

    assert image.shape == (height, width, 3)

    half_a_pixel = np.diag(whole_intrinsic)[:2] / (160, 120) / 2  # of the scaled whole image
    focal_error = np.abs(np.diag(intrinsic)[:2] - focal)
    assert (focal_error <= half_a_pixel + 1e-9).all()
    np.testing.assert_allclose(
        intrinsic[:2, 2],
        (width / 2, height / 2),
        atol=0.5 + 1e-9,
    )

    def positions_in_whole(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
        return (whole_intrinsic @ np.linalg.inv(intrinsic) @ pixels)[:2].T

    end = np.array([156, 116])
    rows, columns = np.nonzero(image[..., 2] == 200)
    positions = positions_in_whole(rows, columns) - 0.5
    is_inner = ((positions > 3) & (positions < end)).all(axis=1)
    colors = image[rows, columns][:, :2]

    np.testing.assert_allclose(
        colors[is_inner],
        positions[is_inner],
        atol=2.1,
    )

    black_positions = positions_in_whole(*np.nonzero(image[..., 2] == 0))
    is_outside = (black_positions < 1.5 / zoom + 3) | (black_positions > end)
    assert is_outside.any(axis=1).all()


def test_a_virtual_camera_replaces_resizing(da: DeepAccident, camera: str) -> None:
    config = ImageConfig(virtual_camera=VirtualCamera(40, 30, 50))
    image, intrinsic = config.load(da, camera)
    assert image.shape == (30, 50, 3)
    assert intrinsic[0, 0] == pytest.approx(40, rel=0.02)


@pytest.mark.parametrize(
    "options",
    [
        {"virtual_camera": (0, 9, 9)},
        {"virtual_camera": (9, 0, 9)},
        {"virtual_camera": (9, 9, 9), "resize": (9, 9)},
    ],
)
def test_an_impossible_virtual_camera_is_refused(options: dict) -> None:
    with pytest.raises(ConfigError, match=r"virtual_camera: expected"):
        ImageConfig(**options)
