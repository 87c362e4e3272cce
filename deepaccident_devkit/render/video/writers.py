"""Writing pictures into a video file: MP4 by PyAV (the extra `video`), GIF and WebP by pillow."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.arrays import ByteArray
from deepaccident_devkit.errors import ChoiceError, MissingExtraError
from deepaccident_devkit.files import replacing

if TYPE_CHECKING:
    from PIL.Image import Image

_CRF: Final = "20"
"""Quality of H.264: 0 loses nothing, 51 is the worst."""
_WEBP_QUALITY: Final = 70
_COLORS: Final = 255
"""Colours of a GIF; one more is kept for pixels that do not change."""
_LOOKED_AT: Final = 2_000_000
"""About so many pixels of all pictures are used to choose the palette."""


def check_target(path: Path, *, size: tuple[int, int], fps: float) -> None:
    """Check before anything is rendered that the file can be written; raises ChoiceError and MissingExtraError."""
    if path.suffix.lower() not in SUFFIXES:
        raise ChoiceError(f"path: expected a file that ends in {', '.join(SUFFIXES)}, found {str(path)!r}")
    if path.is_dir():
        raise ChoiceError(f"path: expected a file, found the folder {path}")
    folder = next(each for each in path.absolute().parents if each.exists())
    if not os.access(folder, os.W_OK):
        raise ChoiceError(f"path: nothing can be written into {folder}; choose another folder")
    if not 0 < fps <= 100:
        raise ChoiceError(f"fps: expected frames a second, above 0 and at most 100, found {fps!r}")
    if min(size) < 16:
        raise ChoiceError(f"size: expected width and height of at least 16 pixels, found {size}")
    if path.suffix.lower() == ".mp4":
        if any(side % 2 for side in size):
            raise ChoiceError(f"size: expected an even width and height, which MP4 needs, found {size}")
        try:
            import av  # noqa: F401 - whether it is installed
        except ImportError:
            raise MissingExtraError(
                f"{path}: MP4 needs PyAV: in a checkout, pip install '.[video]'; or choose .gif or .webp"
            ) from None


def write_video(path: Path, pictures: Iterable[ByteArray], *, fps: float) -> None:
    """Write pictures, one after the other, as the video that the path's suffix says, atomically.

    Args:
        path: of one of `SUFFIXES`; a file that is there is replaced.
        pictures: (H, W, 3) uint8, RGB, all of one size, H and W even for MP4; at least one.
        fps: pictures a second.
    """
    with replacing(path) as temporary:
        SUFFIXES[path.suffix.lower()](temporary, pictures, fps)


def _write_mp4(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    """H.264 in yuv420p with its index in front: browsers play it, and begin before it is complete."""
    import av

    with av.open(os.fspath(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = None
        for picture in pictures:
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
                # in a virtual machine, x264's code for AVX-512 made other bytes in 2 of 100 files of the same pictures
                stream.options = {"crf": _CRF, "x264-params": "asm=sse4.2"}
                stream.codec_context.thread_count = 1  # the bytes depend on the number of threads
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if stream is not None:
            container.mux(stream.encode(None))


def _write_gif(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    """One palette for all pictures, without dithering: pixels that stay the same are stored once and do not flicker."""
    import numpy as np
    from PIL import Image

    drawn = list(pictures)
    every = max(1, round((sum(picture.size / 3 for picture in drawn) / _LOOKED_AT) ** 0.5))
    looked_at = np.concatenate([picture[::every, ::every].reshape(-1, 3) for picture in drawn])
    palette = Image.fromarray(looked_at[None]).quantize(_COLORS, Image.Quantize.MAXCOVERAGE)
    images = [Image.fromarray(picture) for picture in drawn]
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    _save_animation(path, images, fps, format="GIF", optimize=True)


def _write_webp(path: Path, pictures: Iterable[ByteArray], fps: float) -> None:
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    _save_animation(path, images, fps, format="WEBP", quality=_WEBP_QUALITY, method=4)


def _save_animation(path: Path, images: Sequence[Image], fps: float, **how: Any) -> None:
    """Write pillow's images as an animation that repeats forever."""
    first, *others = images
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0, **how)


SUFFIXES: Final[Mapping[str, Callable[[Path, Iterable[ByteArray], float], None]]] = {
    ".mp4": _write_mp4,
    ".gif": _write_gif,
    ".webp": _write_webp,
}
"""Suffix → the writer of such files."""
