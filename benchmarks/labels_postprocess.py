"""Instances read off a prediction of 5 frames, 30 objects, 200 × 200 cells; and off noise, the
worst that can come.
"""

import numpy as np

from benchmarks.measure import Figure, best_of, one_core
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
    return Figure(name=name, value=1e3 * seconds, unit="ms", bound=bound, reference=reference)


def clear_heads(seed: int = 0) -> MotionHeads:
    """What a good model says: cars that drive on, their outlines and vectors a little off."""
    source = np.random.default_rng(seed)
    row, column = np.indices((CELLS, CELLS), dtype=np.float32)
    start, heading = (
        source.uniform(10, CELLS - 10, (OBJECTS, 2)),
        source.uniform(-np.pi, np.pi, OBJECTS),
    )
    along = np.stack([np.sin(heading), np.cos(heading)], axis=1)
    half = np.stack([source.uniform(3, 6, OBJECTS), source.uniform(1.5, 2.5, OBJECTS)], axis=1)
    step = along * source.uniform(0, 8, (OBJECTS, 1))
    logit = np.full((FRAMES, CELLS, CELLS), -3, dtype=np.float32)
    centerness = np.zeros_like(logit)
    vectors = np.zeros((2, FRAMES, 2, CELLS, CELLS), dtype=np.float32)
    for frame in range(FRAMES):
        middle = start + frame * step
        for center, axis, (long, wide), move in zip(middle, along, half, step, strict=True):
            peak = np.exp(-((row - center[0]) ** 2 + (column - center[1]) ** 2) / 9)
            np.maximum(centerness[frame], peak, out=centerness[frame])
            across = np.array([axis[1], -axis[0]])
            corners = [
                center + a * long * axis + b * wide * across
                for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
            ]
            cells, _ = filled_cells(np.rint([corners])[..., ::-1], (CELLS, CELLS))
            at = np.unravel_index(cells, (CELLS, CELLS))
            logit[frame][at] = 3
            vectors[0, frame][:, at[0], at[1]] = [center[0] - at[0], center[1] - at[1]]
            vectors[1, frame][:, at[0], at[1]] = move[:, None]
    vectors += source.normal(0, 0.3, vectors.shape).astype(np.float32)
    logit += source.normal(0, 0.8, logit.shape).astype(np.float32)
    return MotionHeads(
        segmentation=np.stack([-logit, logit], axis=1),
        centerness=centerness,
        offset=vectors[0],
        flow=vectors[1],
    )


def noisy_heads(seed: int = 0) -> MotionHeads:
    """What an untrained model says: thousands of centres a frame, half of all cells foreground."""
    source = np.random.default_rng(seed)

    def maps(channels: int, scale: float) -> np.ndarray:
        return source.normal(0, scale, (FRAMES, channels, CELLS, CELLS)).astype(np.float32)

    return MotionHeads(
        segmentation=maps(2, 1),
        centerness=source.random((FRAMES, 1, CELLS, CELLS), dtype=np.float32),
        offset=maps(2, 4),
        flow=maps(2, 4),
    )
