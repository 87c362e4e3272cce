"""Stretches of zero bytes in pictures: found wherever they lie, and never where an encoder wrote
them.
"""

import io

import numpy as np
import pytest
from PIL import Image

from deepaccident_devkit.validation.sensors import MIN_ZERO_BYTES, ends_early, zero_stretch


def jpeg(image: np.ndarray, **options: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", **options)
    return file.getvalue()


def decoded(content: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image.convert("RGB"))


def scene(seed: int = 0) -> np.ndarray:
    """A picture with some texture."""
    noise = np.random.default_rng(seed).normal(0, 6, (180, 320, 3))
    return np.clip(np.linspace(40, 200, 320)[None, :, None] + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("subsampling", [0, 1, 2])
@pytest.mark.parametrize("stretch", [MIN_ZERO_BYTES, 512, 4096])
def test_a_stretch_is_found_wherever_it_lies(subsampling: int, stretch: int) -> None:
    content = jpeg(scene(), quality=95, subsampling=subsampling)
    first = content.index(b"\xff\xda") + 14
    for start in np.linspace(first, len(content) - stretch, 9, dtype=int).tolist():
        place, length = zero_stretch(
            content[:start] + bytes(stretch) + content[start + stretch :]
        ) or (-99, 0)
        assert (abs(place - start) <= 8, length >= stretch) == (True, True)
    assert zero_stretch(content[: len(content) // 2] + bytes(len(content) // 2)) is not None


COLOURS = [
    *((level, level, level) for level in (0, 127, 128, 255)),
    (255, 0, 0),
    (0, 255, 0),
    (0, 0, 255),
    (9, 200, 77),
]


def even_and_regular() -> dict[str, np.ndarray]:
    """Pictures whose coded data are as poor as can be."""
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
    for name, picture in even_and_regular().items():
        for quality in (1, 50, 75, 90, 95, 100):
            for subsampling in (0, 2):
                options = {"quality": quality, "optimize": optimize, "progressive": progressive}
                content = jpeg(picture, subsampling=subsampling, **options)
                assert zero_stretch(content) is None, (name, quality, subsampling)
            assert zero_stretch(jpeg(picture[..., 0], **options)) is None, (name, quality)


def test_an_even_picture_with_tables_of_its_own_may_be_zeros() -> None:
    """The reason why the tables are looked at."""
    content = jpeg(np.zeros((720, 1280, 3), np.uint8), quality=90, optimize=True)
    assert bytes(MIN_ZERO_BYTES) in content
    assert zero_stretch(content) is None


@pytest.mark.parametrize(
    "content",
    [b"", b"\xff", b"\xff\xd8", b"\xff\xd8\xff\xc4", b"\xff\xd8\xff\xda", b"\x89PNG" + bytes(999)],
)
def test_what_is_no_jpeg_has_no_stretch(content: bytes) -> None:
    assert zero_stretch(content) is None
    assert zero_stretch(content + bytes(1000)) is None


def test_damaged_headers_end_nothing() -> None:
    content = jpeg(scene(), quality=90)
    rng = np.random.default_rng(3)
    for _ in range(300):
        damaged = bytearray(content)
        for place in rng.integers(2, 700, 4).tolist():
            damaged[place] = int(rng.integers(256))
        zero_stretch(bytes(damaged))


@pytest.mark.parametrize("size", [(180, 320), (177, 313)])
@pytest.mark.parametrize(
    "options", [{"subsampling": 0}, {"subsampling": 1}, {"subsampling": 2, "optimize": True}]
)
def test_data_that_end_before_an_end_marker_are_told(
    size: tuple[int, int], options: dict[str, object]
) -> None:
    """Decoders fill the rest with grey and say nothing; the last block alone may lose some bits."""
    content = jpeg(scene()[: size[0], : size[1]], quality=90, **options)
    assert not ends_early(content, decoded(content))
    first = content.index(b"\xff\xda") + 14
    for stop in np.linspace(first, len(content) - 40, 20, dtype=int).tolist():
        short = content[:stop] + b"\xff\xd9"
        assert ends_early(short, decoded(short))
