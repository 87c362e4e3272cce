"""Measure reading instances off a prediction of 5 frames, 30 objects, 200 × 200 cells; and off
noise, the worst case.
"""

import numpy as np

from benchmarks.measure import Figure, best_of, milliseconds, one_core
from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import predict_instances
from deepaccident_devkit.motion.reference_arithmetic.polygon_fill import filled_cells

FRAMES, OBJECTS, CELLS = 5, 30, 200
REPEATS, NOISY_REPEATS = 40, 10


def measure() -> list[Figure]:
    clear, noisy = clear_heads(), noisy_heads()
    with one_core():
        return [
            figure("postprocess_ms", clear, "motion", REPEATS, 6.0, 497),
            figure("postprocess_noisy_ms", noisy, "motion", NOISY_REPEATS, 20.0),
            figure("postprocess_accident_ms", clear, "accident", REPEATS, 10.0, 499),
            figure("postprocess_accident_noisy_ms", noisy, "accident", NOISY_REPEATS, 60.0),
        ]


def figure(
    name: str,
    heads: MotionHeads,
    settings: str,
    repeats: int,
    bound: float,
    reference: float | None = None,
) -> Figure:
    seconds = best_of(repeats, lambda: predict_instances(heads, settings))
    return milliseconds(name, seconds, bound, reference)


def clear_heads(seed: int = 0) -> MotionHeads:
    """Return what a good model predicts: cars that drive on, with outlines and vectors a little
    off.
    """
    source = np.random.default_rng(seed)
    rows, columns = np.indices((CELLS, CELLS), dtype=np.float32)
    start = source.uniform(10, CELLS - 10, (OBJECTS, 2))
    heading = source.uniform(-np.pi, np.pi, OBJECTS)
    axes = np.stack([np.sin(heading), np.cos(heading)], axis=1)
    half_length = source.uniform(3, 6, OBJECTS)
    half_width = source.uniform(1.5, 2.5, OBJECTS)
    half_size = np.stack([half_length, half_width], axis=1)
    steps = axes * source.uniform(0, 8, (OBJECTS, 1))
    logit = np.full((FRAMES, CELLS, CELLS), -3, dtype=np.float32)
    centerness = np.zeros_like(logit)
    vectors = np.zeros((2, FRAMES, 2, CELLS, CELLS), dtype=np.float32)
    for frame in range(FRAMES):
        centers = start + frame * steps
        for center, axis, (long, wide), step in zip(centers, axes, half_size, steps, strict=True):
            peak = np.exp(-((rows - center[0]) ** 2 + (columns - center[1]) ** 2) / 9)
            np.maximum(centerness[frame], peak, out=centerness[frame])
            across = np.array([axis[1], -axis[0]])
            corners = [
                center + a * long * axis + b * wide * across
                for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
            ]
            cells, _ = filled_cells(np.rint([corners])[..., ::-1], (CELLS, CELLS))
            row, column = np.unravel_index(cells, (CELLS, CELLS))
            logit[frame][row, column] = 3
            vectors[0, frame][:, row, column] = [center[0] - row, center[1] - column]
            vectors[1, frame][:, row, column] = step[:, None]
    vectors += source.normal(0, 0.3, vectors.shape).astype(np.float32)
    logit += source.normal(0, 0.8, logit.shape).astype(np.float32)
    return MotionHeads(
        segmentation=np.stack([-logit, logit], axis=1),
        centerness=centerness,
        offset=vectors[0],
        flow=vectors[1],
    )


def noisy_heads(seed: int = 0) -> MotionHeads:
    """Return what an untrained model predicts: thousands of centres in a frame, half of all cells
    foreground.
    """
    source = np.random.default_rng(seed)

    def maps(channels: int, scale: float) -> np.ndarray:
        return source.normal(0, scale, (FRAMES, channels, CELLS, CELLS)).astype(np.float32)

    return MotionHeads(
        segmentation=maps(2, 1),
        centerness=source.random((FRAMES, 1, CELLS, CELLS), dtype=np.float32),
        offset=maps(2, 4),
        flow=maps(2, 4),
    )
