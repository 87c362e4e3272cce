"""Measure motion labels: from boxes, at the present, read off predictions, written for a split; 5
frames, 30 objects.

`labels_from_tables_five_ms` is the time of one sample if a moment's five agents are made together.
"""

import functools
from collections import deque

import numpy as np

from benchmarks import labels_postprocess, labels_warp
from benchmarks.measure import Figure, best_of, milliseconds, one_core, temporary_folder
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
"""Milliseconds that the released code needs for such a sample, from boxes."""
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
    frames = make_frames(np.random.default_rng(0))
    motion = make_motion()
    quads, image = make_quads(np.random.default_rng(1))
    configs = {name: MotionLabelConfig(protocol=name) for name in LABEL_PROTOCOLS}
    seconds = {}
    with one_core():
        for name, config in configs.items():
            work = functools.partial(motion_labels_from_boxes, frames, motion, config)
            seconds[name] = best_of(REPEATS, work)
        filling_s = best_of(REPEATS, lambda: filled_cells(quads, (200, 200), image, 5))
        floor_s = best_of(REPEATS, lambda: LabelMaps.empty(configs["released"]))
    released_s = seconds.pop("released")
    figures = [
        milliseconds("labels_ms", released_s, bound=RELEASED_MS / 45, reference=RELEASED_MS),
        milliseconds("labels_floor_ms", floor_s),  # the maps' bytes, written once
        Figure("labels_floors", released_s / floor_s, "floors"),
        milliseconds("labels_fill_150_quads_ms", filling_s, bound=0.6),
    ]
    for name, value in seconds.items():
        figures.append(milliseconds(f"labels_{name}_ms", value))
    return figures


def split_samples_per_s() -> list[Figure]:
    """Measure the label files of a whole release, from its tables; and one sample from tables, from
    files, and together with the other four agents.
    """
    with temporary_folder() as folder:
        root = labels_only_release(folder, scenarios=SCENARIOS, frames=FRAMES)
        dataset = DeepAccident(dataroot=root, verbose=False)
        tokens = [sample["token"] for sample in dataset.sample]
        rates = {}
        for workers in (1, 2):
            out = folder / f"{workers}"
            work = functools.partial(write_label_files, dataset, out, tokens, workers=workers)
            rates[workers] = len(tokens) / best_of(1, work)
        files = LabelFiles(folder / "1")
        sample = dataset.sample[len(tokens) // 2]
        moment = [record["token"] for record in dataset.samples_of(sample["frame_token"])]
        with one_core():
            from_tables_s = best_of(REPEATS, lambda: dataset.motion_labels(sample))
            from_files_s = best_of(REPEATS, lambda: files[sample["token"]])
            five_s = best_of(REPEATS, lambda: deque(dataset.motion_labels_of(moment), maxlen=0))
    return [
        milliseconds(
            "labels_from_tables_ms",
            from_tables_s,
            bound=RELEASED_MS / 40,
            reference=RELEASED_MS,
        ),
        milliseconds("labels_from_tables_five_ms", five_s / len(moment), bound=1.32),
        milliseconds("labels_from_files_ms", from_files_s),
        Figure("split_samples_per_s_1_worker", rates[1], "samples/s"),
        Figure(
            "split_samples_per_s_2_workers",
            rates[2],
            "samples/s",
            bound=400,
            higher_is_better=True,
        ),
    ]


def make_frames(source: np.random.Generator) -> list[FrameBoxes]:
    """Return the boxes of the ego and of 30 actors around it in frames half a second apart, most of
    them in sight and on the grid.
    """
    count = OBJECTS + 1
    start = np.vstack([np.zeros(2), source.uniform(-55, 55, (OBJECTS, 2))])
    yaw = np.append(0, source.uniform(-np.pi, np.pi, OBJECTS))
    speed = np.append(0, source.uniform(0, 10, OBJECTS))
    size = source.uniform([3.6, 1.6, 1.4], [9, 2.6, 3.5], (count, 3))
    is_visible = np.append(False, source.random(OBJECTS) < 0.9)
    frames = []
    for frame in range(5):
        position = start + STEP * frame * speed[:, None] * heading(yaw)
        frames.append(
            FrameBoxes(
                center=np.column_stack([position, np.zeros(count)]),
                size=size,
                yaw=yaw,
                actor_id=np.append(-100, np.arange(OBJECTS) + 200),
                category=np.zeros(count),
                visible=is_visible,
                ego_from_lidar=np.eye(4),
            )
        )
    return frames


def heading(yaw: np.ndarray) -> np.ndarray:
    """Return the unit vectors (N, 2) of headings in radians."""
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def make_motion() -> np.ndarray:
    """Return the motion of an ego that drives 10 m/s in a bend."""
    return np.tile([-5.0, 0, 0, 0, 0, -0.05], (7, 1))


def make_quads(source: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return 150 quadrangles of cars' and trucks' sizes in cells, all over five images, some across
    the border; and the image of each.
    """
    count = 5 * OBJECTS
    size = source.uniform([7, 3.2], [18, 5.2], (count, 2))
    ahead = heading(source.uniform(-np.pi, np.pi, count))
    left = ahead[:, ::-1] * [-1, 1]
    corners = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) / 2
    axes = np.stack([ahead, left], axis=1)
    offsets = np.einsum("vk,nk,nkd->nvd", corners, size, axes)
    center = source.uniform(0, 200, (count, 1, 2))
    quads = np.rint(center + offsets).astype(np.int64)
    return quads, np.repeat(np.arange(5), OBJECTS)
