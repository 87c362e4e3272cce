"""Post-processing a cell and an instance at a time, as docs/released_code.md, Post-processing,
reads.

The devkit's arrays must give the same.
"""

import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import FOREGROUND_THRESHOLD, PostProcessing

F = np.float32


def frame_instances(heads: MotionHeads, settings: PostProcessing) -> np.ndarray:
    """(T, H, W) each frame's own instances, of heads that lie as they are scanned."""
    return np.stack([one_frame(heads, settings, t) for t in range(len(heads.offset))])


def one_frame(heads: MotionHeads, settings: PostProcessing, t: int) -> np.ndarray:
    heat = heads.centerness[t, 0]
    height, width = heat.shape
    peaks = [
        (r, c)
        for r in range(height)
        for c in range(width)
        if heat[r, c] > F(settings.center_threshold)
        and heat[r, c] == heat[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].max()
    ][: settings.max_centers]
    result = np.zeros((height, width), dtype=np.int64)
    for r in range(height) if peaks else ():
        for c in range(width):
            if is_actor(heads.segmentation, settings, t, r, c):
                at = F(r) + heads.offset[t, 0, r, c], F(c) + heads.offset[t, 1, r, c]
                distances = [np.sqrt((F(y) - at[0]) ** 2 + (F(x) - at[1]) ** 2) for y, x in peaks]
                result[r, c] = 1 + distances.index(min(distances))
    return np.unique(result, return_inverse=True)[1].reshape(height, width)


def is_actor(logits: np.ndarray, settings: PostProcessing, t: int, r: int, c: int) -> bool:
    background, actor = logits[t, :, r, c].tolist()
    if settings.foreground == "argmax":
        return actor > background
    if logits.max() == 10 and logits.min() == 0:
        return actor > FOREGROUND_THRESHOLD
    return 1 / (1 + math.exp(-actor)) > FOREGROUND_THRESHOLD


def linked(raw: np.ndarray, flow: np.ndarray, distance: float) -> np.ndarray:
    """(T, H, W) the same instances with consistent ids."""
    result, newest = [raw[0]], int(raw[0].max())
    grid = np.indices(raw.shape[1:]).astype(np.float32)
    for t in range(len(raw) - 1):
        known, following = np.unique(result[-1])[1:].tolist(), raw[t + 1]
        if not known or not following.any():
            result.append(following)
            continue
        moved = grid + flow[t]
        before = [mean(moved, result[-1] == name) for name in known]
        after = [mean(grid, following == name) for name in range(1, int(following.max()) + 1)]
        costs = np.array(
            [[np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2) for a in after] for b in before]
        )
        names = {
            int(j) + 1: known[i]
            for i, j in zip(*linear_sum_assignment(costs), strict=True)
            if costs[i, j] < distance
        }
        unmatched = set(np.unique(following)).difference(set(names))
        unmatched.remove(0)
        for name in unmatched:
            newest += 1
            names[int(name)] = newest
        result.append(
            np.vectorize(lambda name, names=names: names.get(name, 0), otypes=[np.int64])(following)
        )
    return np.stack(result)


def mean(grid: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return (grid[:, mask].astype(np.float64).sum(axis=1) / mask.sum()).astype(np.float32)


def paths(ids: np.ndarray) -> dict[int, list[list[float]]]:
    """By id of the first frame: row and column of its mean in each frame that it is in."""
    grid = np.indices(ids.shape[1:])
    return {
        int(name): [mean(grid, frame == name).tolist() for frame in ids if (frame == name).any()]
        for name in np.unique(ids[0])[1:]
    }
