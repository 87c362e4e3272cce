"""Bringing all maps of a sample to the present; the released code takes 15 ms for it."""

import numpy as np

from benchmarks.measure import Figure, best_of, one_core
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.labels import MotionLabels

OBJECTS, REPEATS = 30, 100


def measure() -> list[Figure]:
    labels = make_labels(np.random.default_rng(0))
    with one_core():
        seconds = {
            "warp": best_of(REPEATS, labels.to_present),
            "warp_bilinear": best_of(REPEATS, lambda: labels.to_present(centerness="bilinear")),
        }
    return [
        Figure(name="warp_ms", value=seconds["warp"] * 1e3, unit="ms", bound=2.5, reference=15),
        Figure(
            name="warp_bilinear_ms",
            value=seconds["warp_bilinear"] * 1e3,
            unit="ms",
            bound=1.4,
            reference=15,
        ),
    ]


def make_labels(source: np.random.Generator) -> MotionLabels:
    """Five frames of upright rectangles in cars' sizes, with centres, offsets and flow, and an ego
    that drives on.
    """
    config = MotionLabelConfig()
    frames, (height, width) = config.label_frames, config.grid.shape
    rows, columns = np.indices((height, width))
    instance = np.zeros((frames, height, width), dtype=np.int32)
    centerness = np.zeros((frames, 1, height, width), dtype=np.float32)
    offset, flow = (
        np.full((frames, 2, height, width), config.ignore_index, dtype=np.float32) for _ in range(2)
    )
    places, sizes = (
        source.uniform(0, height, (OBJECTS, 2)),
        source.uniform((3, 7), (5, 12), (OBJECTS, 2)),
    )
    steps = source.normal(0, 4, (OBJECTS, 2))
    for frame in range(frames):
        for number, (place, size, step) in enumerate(
            zip(places, sizes, steps, strict=True), start=1
        ):
            row, column = np.rint(place + frame * step)
            mask = (np.abs(rows - row) <= size[0] / 2) & (np.abs(columns - column) <= size[1] / 2)
            instance[frame][mask] = number
            squared = ((rows - row) ** 2 + (columns - column) ** 2).astype(np.float32)
            np.maximum(
                centerness[frame, 0], np.exp(-squared / np.float32(9)), out=centerness[frame, 0]
            )
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
