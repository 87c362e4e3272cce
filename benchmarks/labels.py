"""Motion labels: from boxes, at the present, read off predictions, written for a split; 5 frames,
30 objects.

`labels_from_tables_five_ms` is of one sample, where those of a moment's five agents are made
together.
"""

import functools
import tempfile
from collections import deque
from pathlib import Path

import numpy as np

from benchmarks import labels_postprocess, labels_warp
from benchmarks.measure import Figure, best_of, one_core
from benchmarks.releases import labels_only_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    FrameBoxes,
    LabelFiles,
    MotionLabelConfig,
    motion_labels_from_boxes,
    write_label_files,
)
from deepaccident_devkit.motion.drawing import LabelMaps
from deepaccident_devkit.motion.reference_arithmetic.polygon_fill import filled_cells

OBJECTS, STEP = 30, 0.5
RELEASED_MS = 112
"""The released code's labels of such a sample, from boxes."""
REPEATS = 200
SCENARIOS, FRAMES = 8, 40


def measure() -> list[Figure]:
    return [
        *labels_ms(),
        *labels_warp.measure(),
        *labels_postprocess.measure(),
        *split_samples_per_s(),
    ]


def labels_ms() -> list[Figure]:
    frames, motion = make_frames(np.random.default_rng(0)), make_motion()
    quads, image = make_quads(np.random.default_rng(1))
    configs = {name: MotionLabelConfig(protocol=name) for name in LABEL_PROTOCOLS}
    with one_core():
        milliseconds = {
            name: 1e3
            * best_of(
                REPEATS, lambda config=config: motion_labels_from_boxes(frames, motion, config)
            )
            for name, config in configs.items()
        }
        filling = 1e3 * best_of(REPEATS, lambda: filled_cells(quads, (200, 200), image, 5))
        floor = 1e3 * best_of(REPEATS, lambda: LabelMaps.empty(configs["released"]))
    released = milliseconds.pop("released")
    return [
        Figure(
            name="labels_ms",
            value=released,
            unit="ms",
            bound=RELEASED_MS / 45,
            reference=RELEASED_MS,
        ),
        Figure(name="labels_floor_ms", value=floor, unit="ms"),  # the maps' bytes, written once
        Figure(name="labels_floors", value=released / floor, unit="floors"),
        Figure(name="labels_fill_150_quads_ms", value=filling, unit="ms", bound=0.6),
        *(
            Figure(name=f"labels_{name}_ms", value=value, unit="ms")
            for name, value in milliseconds.items()
        ),
    ]


def split_samples_per_s() -> list[Figure]:
    """Label files of a whole release, from its tables; one sample from tables and files, and five
    agents' together.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = labels_only_release(Path(folder), scenarios=SCENARIOS, frames=FRAMES)
        dataset = DeepAccident(dataroot=root, verbose=False)
        tokens = [sample["token"] for sample in dataset.sample]
        rates = {}
        for workers in (1, 2):
            work = functools.partial(
                write_label_files, dataset, Path(folder) / f"{workers}", tokens, workers=workers
            )
            rates[workers] = len(tokens) / best_of(1, work)
        files, sample = LabelFiles(Path(folder) / "1"), dataset.sample[len(tokens) // 2]
        five = [each["token"] for each in dataset.samples_of(sample["frame_token"])]
        with one_core():
            from_tables, from_files, together = (
                1e3 * best_of(REPEATS, work)
                for work in (
                    lambda: dataset.motion_labels(sample),
                    lambda: files[sample["token"]],
                    lambda: deque(dataset.motion_labels_of(five), maxlen=0),
                )
            )
    return [
        Figure(
            name="labels_from_tables_ms",
            value=from_tables,
            unit="ms",
            bound=RELEASED_MS / 40,
            reference=RELEASED_MS,
        ),
        Figure(
            name="labels_from_tables_five_ms", value=together / len(five), unit="ms", bound=1.32
        ),
        Figure(name="labels_from_files_ms", value=from_files, unit="ms"),
        Figure(name="split_samples_per_s_1_worker", value=rates[1], unit="samples/s"),
        Figure(
            name="split_samples_per_s_2_workers",
            value=rates[2],
            unit="samples/s",
            bound=400,
            higher_is_better=True,
        ),
    ]


def make_frames(source: np.random.Generator) -> list[FrameBoxes]:
    """The ego and 30 actors around it, most of them in sight and on the grid, half a second
    apart.
    """
    count = OBJECTS + 1
    start = np.vstack([np.zeros(2), source.uniform(-55, 55, (OBJECTS, 2))])
    yaw = np.append(0, source.uniform(-np.pi, np.pi, OBJECTS))
    speed = np.append(0, source.uniform(0, 10, OBJECTS))
    size = source.uniform([3.6, 1.6, 1.4], [9, 2.6, 3.5], (count, 3))
    seen = np.append(False, source.random(OBJECTS) < 0.9)
    return [
        FrameBoxes(
            center=np.column_stack(
                [start + STEP * t * speed[:, None] * heading(yaw), np.zeros(count)]
            ),
            size=size,
            yaw=yaw,
            actor_id=np.append(-100, np.arange(OBJECTS) + 200),
            category=np.zeros(count),
            visible=seen,
            ego_from_lidar=np.eye(4),
        )
        for t in range(5)
    ]


def heading(yaw: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def make_motion() -> np.ndarray:
    """An ego that drives 10 m/s in a bend."""
    return np.tile([-5.0, 0, 0, 0, 0, -0.05], (7, 1))


def make_quads(source: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """150 quadrangles of cars' and trucks' sizes in cells, all over five images, some across the
    border.
    """
    count = 5 * OBJECTS
    size = source.uniform([7, 3.2], [18, 5.2], (count, 2))
    ahead = heading(source.uniform(-np.pi, np.pi, count))
    left = ahead[:, ::-1] * [-1, 1]
    ends = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) / 2
    around = np.einsum("vk,nk,nkd->nvd", ends, size, np.stack([ahead, left], axis=1))
    quads = np.rint(source.uniform(0, 200, (count, 1, 2)) + around).astype(np.int64)
    return quads, np.repeat(np.arange(5), OBJECTS)
