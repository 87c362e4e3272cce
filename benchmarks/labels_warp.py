"""Measure warping all maps of a sample to the present; the released code takes 15 ms for it."""

import numpy as np

from benchmarks.measure import Figure, best_of, milliseconds, one_core
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.labels import MotionLabels

OBJECTS, REPEATS = 30, 100


def measure() -> list[Figure]:
    labels = make_labels(np.random.default_rng(0))
    with one_core():
        nearest_s = best_of(REPEATS, labels.to_present)
        bilinear_s = best_of(REPEATS, lambda: labels.to_present(centerness="bilinear"))
    return [
        milliseconds("warp_ms", nearest_s, bound=2.5, reference=15),
        milliseconds("warp_bilinear_ms", bilinear_s, bound=1.4, reference=15),
    ]


def make_labels(source: np.random.Generator) -> MotionLabels:
    """Return five frames of upright rectangles in cars' sizes, with centres, offsets and flow, and
    an ego that drives on.
    """
    config = MotionLabelConfig()
    frames, (height, width) = config.label_frames, config.grid.shape
    rows, columns = np.indices((height, width))
    instance = np.zeros((frames, height, width), dtype=np.int32)
    centerness = np.zeros((frames, 1, height, width), dtype=np.float32)
    offset = np.full((frames, 2, height, width), config.ignore_index, dtype=np.float32)
    flow = offset.copy()
    starts = source.uniform(0, height, (OBJECTS, 2))
    sizes = source.uniform((3, 7), (5, 12), (OBJECTS, 2))
    steps = source.normal(0, 4, (OBJECTS, 2))
    for frame in range(frames):
        for index, (start, size, step) in enumerate(zip(starts, sizes, steps, strict=True)):
            row, column = np.rint(start + frame * step)
            half_rows, half_columns = size / 2
            in_rows = np.abs(rows - row) <= half_rows
            mask = in_rows & (np.abs(columns - column) <= half_columns)
            instance[frame][mask] = index + 1
            squared = ((rows - row) ** 2 + (columns - column) ** 2).astype(np.float32)
            peak = np.exp(-squared / np.float32(9))
            np.maximum(centerness[frame, 0], peak, out=centerness[frame, 0])
            offset[frame][:, mask] = row - rows[mask], column - columns[mask]
            if frame < frames - 1:
                flow[frame][:, mask] = np.rint(step)[:, None]
    egomotion = source.normal(
        (-4, 0, 0, 0, 0, 0), (1, 0.2, 0.1, 0.01, 0.01, 0.05), (config.frames, 6)
    )
    return MotionLabels(
        config=config,
        segmentation=(instance > 0).astype(np.uint8),
        instance=instance,
        centerness=centerness,
        offset=offset,
        flow=flow,
        future_egomotion=egomotion.astype(np.float32),
        valid=np.ones(config.frames, dtype=bool),
        id_map={},
    )
