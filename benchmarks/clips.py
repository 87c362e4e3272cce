"""Measure how much processor time `export clips` takes beside PyAV encoding the same frames, which
are in memory, as MP4.

The bound is that of PyAV with its default options, times 1.3 at 1600×900 and 2.5 at 640×360.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import av
import cv2
import numpy as np

from benchmarks.measure import Figure, one_core, temporary_folder
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.clips import Clips
from deepaccident_devkit.release import read_image
from deepaccident_devkit.release.images import write_image
from deepaccident_devkit.support.arrays import ByteArray
from deepaccident_devkit.testing import SmallRelease, write_small_release

FRAMES = 60
IMAGE_SIZE = (1600, 900)
FACTORS = {IMAGE_SIZE: 1.3, (640, 360): 2.5}
"""Size of the pictures → largest ratio to the time of PyAV alone."""
RELEASE = SmallRelease(
    splits=("val",),
    agents=("ego_vehicle",),
    channels=("Camera_Front",),
    frames=FRAMES,
    image_size=IMAGE_SIZE,
)
REPEATS = 3


def measure() -> list[Figure]:
    with temporary_folder() as folder, one_core():
        write_small_release(folder / "release", RELEASE)
        paths = sorted((folder / "release").rglob("*.jpg"))
        for number, path in enumerate(paths):
            write_image(path, draw_scene(number))
        dataset = DeepAccident(dataroot=folder / "release", verbose=False)
        figures = []
        for size, factor in FACTORS.items():
            pictures = [read_picture(path, size) for path in paths]
            plain = folder / "plain.mp4"
            plain_seconds = least_processor_time(lambda: encode(plain, pictures))  # noqa: B023
            targets = iter([folder / f"{size[0]} {number}" for number in range(REPEATS)])
            seconds = least_processor_time(
                lambda: export_release(dataset, next(targets), Clips(size=size), workers=1)  # noqa: B023
            )
            figures.append(
                Figure(
                    f"clips_{size[0]}x{size[1]}_ms_per_frame",
                    1e3 * seconds / FRAMES,
                    "ms",
                    bound=1e3 * factor * plain_seconds / FRAMES,
                )
            )
        return figures


def draw_scene(number: int) -> ByteArray:
    """Draw a picture with fine structure that moves between frames."""
    width, height = IMAGE_SIZE
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (height // 20, width // 20 + FRAMES, 3), dtype=np.uint8)
    part = noise[:, number : number + width // 20]
    scene = cv2.resize(part, IMAGE_SIZE, interpolation=cv2.INTER_CUBIC)
    grain = np.random.default_rng(number).normal(0, 1, (*scene.shape[:2], 1))
    return np.asarray(np.clip(scene + grain, 0, 255), dtype=np.uint8)


def read_picture(path: Path, size: tuple[int, int]) -> ByteArray:
    picture = cv2.resize(read_image(path), size, interpolation=cv2.INTER_AREA)
    return np.asarray(picture, dtype=np.uint8)


def encode(path: Path, pictures: Sequence[ByteArray]) -> None:
    """Encode pictures with PyAV as its documentation does."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "20"})
        stream.codec_context.thread_count = 1
        stream.pix_fmt = "yuv420p"
        stream.height, stream.width = pictures[0].shape[:2]
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))


def least_processor_time(work: Callable[[], object]) -> float:
    """Return the processor seconds of the fastest of several runs."""
    seconds = []
    for _ in range(REPEATS):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return min(seconds)
