"""MP4 files of pictures: H.264 in yuv420p, which browsers play."""

from __future__ import annotations

import os
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Final

from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.support.arrays import ByteArray

MP4_QUALITY: Final = 20
"""Default constant rate factor of H.264, from 0 (best) to 51 (worst)."""


def check_pyav(purpose: str, remedy: str = "") -> None:
    """Raise MissingExtraError unless PyAV is installed.

    Args:
        purpose: What needs PyAV, for the message.
        remedy: What else to do about it, for the message.
    """
    try:
        import av  # noqa: F401 - whether it is installed
    except ImportError:
        raise MissingExtraError(
            f"{purpose} needs PyAV; run pip install '.[video]' in a checkout{remedy}"
        ) from None


def write_mp4(
    path: Path,
    pictures: Iterable[ByteArray],
    fps: float,
    *,
    quality: int = MP4_QUALITY,
    preset: str = "medium",
    keyframe_step: int | None = None,
) -> None:
    """Write pictures with the index at the start of the file.

    Browsers can then start to play before they have loaded the whole file. Equal pictures give
    equal bytes.

    Args:
        path: File to write.
        pictures: Pictures of one size, (H, W, 3) uint8, RGB; H and W are even.
        fps: Pictures per second.
        quality: Constant rate factor of H.264.
        preset: Compromise of x264 between time and size.
        keyframe_step: Number of pictures from one keyframe to the next one; None leaves the choice
            of keyframes to the encoder.
    """
    import av

    # in a virtual machine, x264's AVX-512 code produced different bytes for the same pictures in 2
    # of 100 files
    encoder_options = "asm=sse4.2"
    if keyframe_step is not None:
        encoder_options += f":keyint={keyframe_step}:scenecut=0"
    options = {"movflags": "+faststart"}
    with av.open(os.fspath(path), "w", format="mp4", options=options) as container:
        stream = None
        for picture in pictures:
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.options = {
                    "crf": str(quality),
                    "preset": preset,
                    "x264-params": encoder_options,
                }
                stream.codec_context.thread_count = 1  # the bytes depend on the number of threads
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if stream is not None:
            container.mux(stream.encode(None))
