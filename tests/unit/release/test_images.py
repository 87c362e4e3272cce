import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from support.expected_errors import assert_raises
from support.strategies import mutations

from deepaccident_devkit.errors import ConfigError, MissingFileError, SensorFileError
from deepaccident_devkit.release import read_image, write_image
from deepaccident_devkit.release.images import aspect_fault, fitting_size

REMEDY = "; restore the file from its archive"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "image.jpg"


@pytest.fixture
def quarters() -> np.ndarray:
    """Make an image that is red and green above, blue and grey below, so that colours, rows and
    columns cannot be confused.
    """
    image = np.zeros((32, 64, 3), dtype=np.uint8)
    image[:16, :32] = 255, 0, 0
    image[:16, 32:] = 0, 255, 0
    image[16:, :32] = 0, 0, 255
    image[16:, 32:] = 128
    return image


@pytest.mark.parametrize("raw", [False, True])
def test_colours_are_rgb_in_their_places(path: Path, quarters: np.ndarray, raw: bool) -> None:
    write_image(path, quarters)

    for image in (read_image(path, raw=raw), np.asarray(Image.open(path))):
        assert image.shape == quarters.shape
        assert image.dtype == np.uint8
        difference = image.astype(int) - quarters
        assert np.abs(difference[4::8, 4::8]).max() < 8


def test_a_grey_image_is_grey_when_raw_and_rgb_otherwise(path: Path) -> None:
    grey = np.tile(np.arange(0, 240, 10, dtype=np.uint8), (16, 1))
    Image.fromarray(grey).save(path, quality=95)

    raw = read_image(path, raw=True)
    rgb = read_image(path)

    assert raw.shape == grey.shape
    assert rgb.shape == (*grey.shape, 3)
    assert np.abs(raw.astype(int) - grey).max() < 8
    np.testing.assert_array_equal(rgb, np.repeat(raw[..., None], 3, axis=2))


@pytest.mark.parametrize("raw", [False, True])
def test_truncated_garbage_empty_and_missing(path: Path, quarters: np.ndarray, raw: bool) -> None:
    missing = ("image.jpg: no such file", "unpack the archive that contains it")
    assert_raises((lambda: read_image(path, raw=raw), MissingFileError, missing))

    write_image(path, quarters)
    whole = path.read_bytes()
    ends = (1, 20, len(whole) // 4, len(whole) // 2, len(whole) * 3 // 4)
    unreadable = rf"^{path}: not a readable image \((?!cannot be read).*\){REMEDY}$"
    for content in (b"", b"garbage", bytes(1000), *(whole[:end] for end in ends)):
        path.write_bytes(content)
        assert_raises((lambda: read_image(path, raw=raw), SensorFileError, unreadable))


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("size", [0xFFFF, 0x2800], ids=["bomb", "large"])
def test_a_damaged_size_is_no_decompression_bomb(
    path: Path, quarters: np.ndarray, size: int, raw: bool
) -> None:
    write_image(path, quarters)
    content = bytearray(path.read_bytes())
    start = content.find(b"\xff\xc0") + 5
    content[start : start + 4] = size.to_bytes(2, "big") * 2
    path.write_bytes(content)
    assert_raises((lambda: read_image(path, raw=raw), SensorFileError, f"(?s)^{path}: .*{REMEDY}$"))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((16, 24), dtype=np.uint8),
        np.zeros((16, 24, 4), dtype=np.uint8),
        np.zeros((16, 24, 2), dtype=np.uint8),
        np.zeros((0, 24, 3), dtype=np.uint8),
        np.zeros((16, 24, 3), dtype=np.float64),
    ],
    ids=["grey", "rgba", "two-channels", "empty", "floats"],
)
def test_writing_other_than_rgb_is_refused_and_leaves_nothing(
    path: Path, image: np.ndarray
) -> None:
    assert_raises((lambda: write_image(path, image), SensorFileError, r"image\.jpg: .*shape"))
    assert list(path.parent.iterdir()) == []


@given(st.data())
def test_damage_raises_our_error_or_nothing(
    tmp_path_factory: pytest.TempPathFactory, outcome, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.jpg"
    row = np.arange(0, 240, 10, dtype=np.uint8)
    write_image(path, np.tile(row[:, None], (16, 1, 3)))
    path.write_bytes(data.draw(mutations(path.read_bytes())))

    image, message = outcome(SensorFileError, read_image, path)

    if message is None:
        assert image.dtype == np.uint8
    else:
        assert str(path) in message


@pytest.mark.parametrize("kind", ["GIF", "TIFF", "BMP", "EPS", "PPM", "WEBP"])
def test_other_formats_are_refused_whatever_their_name(
    path: Path, quarters: np.ndarray, kind: str
) -> None:
    """Decoders of some start programs: EPS starts Ghostscript."""
    Image.fromarray(quarters).save(path, kind)
    assert_raises(
        (
            lambda: read_image(path),
            SensorFileError,
            r"not a readable image \(expected JPEG or PNG\)",
        )
    )


def test_a_picture_of_too_many_pixels_is_refused_before_it_is_decoded(path: Path) -> None:
    Image.new("1", (9000, 9000)).save(path, "PNG")  # a few kilobytes
    words = (
        "takes 243,000,000 bytes",
        "more than 33,554,432",
        "set DEEPACCIDENT_LIMITS=image=232M",
    )
    tracemalloc.start()
    assert_raises((lambda: read_image(path), SensorFileError, words))
    _, peak_bytes = tracemalloc.get_traced_memory()
    assert peak_bytes < 10 << 20
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("size", "example"),
    [
        ((640, 480), "640x360"),
        ((640, 361), "640x360"),
        ((641, 360), "640x360"),
        ((3200, 1800), "1600x900"),
        ((1600, 901), "1600x900"),
        ((100, 100), "96x54"),
        ((0, 0), "1600x900"),
    ],
)
def test_a_size_that_distorts_or_enlarges_images_is_refused_with_one_that_fits(
    size: tuple[int, int], example: str
) -> None:
    width, height = size
    words = (f"{width}x{height}", "images of 1600x900", "a multiple of 16x9", f"such as {example}")
    assert_raises((lambda: fitting_size(size, (1600, 900)), ConfigError, words))


@pytest.mark.parametrize("size", [(640, 360), (1600, 900), (854, 480), (400, 225), (1, 1)])
def test_smaller_sizes_of_the_same_aspect_ratio_fit(size: tuple[int, int]) -> None:
    assert fitting_size(size, (1600, 900)) == size


def test_without_a_size_images_keep_their_own() -> None:
    assert fitting_size(None, (1600, 900)) == (1600, 900)


SIDES = st.integers(1, 4096)


@given(SIDES, SIDES, SIDES)
def test_a_side_can_be_chosen_and_the_other_one_rounded(width: int, height: int, side: int) -> None:
    new_width = min(width, side)
    new_height = max(1, round(new_width * height / width))

    fault = aspect_fault((new_width, new_height), (width, height))

    is_too_flat = new_width * height < width / 2
    assert (fault is None) is not is_too_flat


@given(st.tuples(st.integers(0, 5000), st.integers(0, 5000)), st.tuples(SIDES, SIDES))
def test_a_size_that_a_refusal_names_fits(
    size: tuple[int, int], image_size: tuple[int, int]
) -> None:
    fault = aspect_fault(size, image_size)
    if fault is not None:
        width, height = map(int, fault.rpartition(" ")[2].split("x"))
        assert aspect_fault((width, height), image_size) is None
        assert width * image_size[1] == height * image_size[0]
