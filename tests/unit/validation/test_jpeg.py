"""Stretches of zero bytes in pictures are found wherever they lie, and never where an encoder
wrote them.
"""

import io

import numpy as np
import pytest
from PIL import Image

from deepaccident_devkit.validation.sensors import MIN_ZERO_BYTES, ends_early, zero_stretch


def encode_jpeg(image: np.ndarray, **options: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", **options)
    return file.getvalue()


def decode_image(content: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image.convert("RGB"))


def make_picture(seed: int = 0) -> np.ndarray:
    """Make a picture with some texture, shape (180, 320, 3)."""
    noise = np.random.default_rng(seed).normal(0, 6, (180, 320, 3))
    gradient = np.linspace(40, 200, 320)[None, :, None]
    return np.clip(gradient + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("subsampling", [0, 1, 2])
@pytest.mark.parametrize("stretch_bytes", [MIN_ZERO_BYTES, 512, 4096])
def test_a_stretch_is_found_wherever_it_lies(subsampling: int, stretch_bytes: int) -> None:
    content = encode_jpeg(make_picture(), quality=95, subsampling=subsampling)
    first = content.index(b"\xff\xda") + 14
    for start in np.linspace(first, len(content) - stretch_bytes, 9, dtype=int).tolist():
        damaged_content = content[:start] + bytes(stretch_bytes) + content[start + stretch_bytes :]
        stretch = zero_stretch(damaged_content)
        assert stretch is not None
        position, length = stretch
        assert abs(position - start) <= 8
        assert length >= stretch_bytes
    half = len(content) // 2

    assert zero_stretch(content[:half] + bytes(half)) is not None


COLOURS = [
    *((level, level, level) for level in (0, 127, 128, 255)),
    (255, 0, 0),
    (0, 255, 0),
    (0, 0, 255),
    (9, 200, 77),
]


def make_regular_pictures() -> dict[str, np.ndarray]:
    """Make pictures with coded data that are as poor as can be."""
    y, x = np.mgrid[:96, :160]
    board = ((y // 8 + x // 8) % 2)[..., None].repeat(3, axis=2)
    pictures = {f"flat {colour}": np.full((96, 160, 3), colour, np.uint8) for colour in COLOURS}
    pictures["board"] = (255 * board).astype(np.uint8)
    pictures["faint board"] = (128 - 2 * board).astype(np.uint8)
    pictures["noise"] = np.random.default_rng(1).integers(0, 256, (96, 160, 3), dtype=np.uint8)
    return pictures


@pytest.mark.parametrize("optimize", [False, True])
@pytest.mark.parametrize("progressive", [False, True])
def test_no_encoder_writes_such_a_stretch(
    optimize: bool, progressive: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("PIL.ImageFile.MAXBLOCK", 1 << 22)  # Pillow's buffer for optimised noise
    for name, picture in make_regular_pictures().items():
        for quality in (1, 50, 75, 90, 95, 100):
            for subsampling in (0, 2):
                options = {"quality": quality, "optimize": optimize, "progressive": progressive}
                content = encode_jpeg(picture, subsampling=subsampling, **options)
                assert zero_stretch(content) is None, (name, quality, subsampling)
            assert zero_stretch(encode_jpeg(picture[..., 0], **options)) is None, (name, quality)


def test_an_even_picture_with_tables_of_its_own_may_be_zeros() -> None:
    """This is the reason why the tables are looked at."""
    content = encode_jpeg(np.zeros((720, 1280, 3), np.uint8), quality=90, optimize=True)
    assert bytes(MIN_ZERO_BYTES) in content
    assert zero_stretch(content) is None


@pytest.mark.parametrize(
    "content",
    [b"", b"\xff", b"\xff\xd8", b"\xff\xd8\xff\xc4", b"\xff\xd8\xff\xda", b"\x89PNG" + bytes(999)],
)
def test_bytes_that_are_no_jpeg_have_no_stretch(content: bytes) -> None:
    assert zero_stretch(content) is None
    assert zero_stretch(content + bytes(1000)) is None


def test_damaged_headers_raise_no_error() -> None:
    content = encode_jpeg(make_picture(), quality=90)
    rng = np.random.default_rng(3)
    for _ in range(300):
        damaged_content = bytearray(content)
        for position in rng.integers(2, 700, 4).tolist():
            damaged_content[position] = int(rng.integers(256))
        zero_stretch(bytes(damaged_content))


@pytest.mark.parametrize("size", [(180, 320), (177, 313)])
@pytest.mark.parametrize(
    "options", [{"subsampling": 0}, {"subsampling": 1}, {"subsampling": 2, "optimize": True}]
)
def test_data_that_end_early_before_an_end_marker_are_recognised(
    size: tuple[int, int], options: dict[str, object]
) -> None:
    """Decoders fill the rest with grey silently; only the last block may lose some bits."""
    content = encode_jpeg(make_picture()[: size[0], : size[1]], quality=90, **options)
    assert not ends_early(content, decode_image(content))
    first = content.index(b"\xff\xda") + 14
    for stop in np.linspace(first, len(content) - 40, 20, dtype=int).tolist():
        short = content[:stop] + b"\xff\xd9"
        assert ends_early(short, decode_image(short))
