"""Post-process one cell and one instance at a time, as docs/released_code.md, Post-processing,
describes it.

The devkit's arrays must give the same.
"""

import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import FOREGROUND_THRESHOLD, PostProcessing

F = np.float32


def frame_instances(heads: MotionHeads, settings: PostProcessing) -> np.ndarray:
    """Return each frame's own instances, shape (T, H, W), of heads in their scan order."""
    frames = [frame_ids(heads, settings, t) for t in range(len(heads.offset))]
    return np.stack(frames)


def frame_ids(heads: MotionHeads, settings: PostProcessing, t: int) -> np.ndarray:
    heat = heads.centerness[t, 0]
    height, width = heat.shape
    peaks = []
    for r, c in np.ndindex(height, width):
        neighbours = heat[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]
        if heat[r, c] > F(settings.center_threshold) and heat[r, c] == neighbours.max():
            peaks.append((r, c))
    peaks = peaks[: settings.max_centers]

    result = np.zeros((height, width), dtype=np.int64)
    if peaks:
        for r, c in np.ndindex(height, width):
            if is_actor(heads.segmentation, settings, t, r, c):
                y = F(r) + heads.offset[t, 0, r, c]
                x = F(c) + heads.offset[t, 1, r, c]
                distances = [
                    np.sqrt((F(peak_y) - y) ** 2 + (F(peak_x) - x) ** 2) for peak_y, peak_x in peaks
                ]
                result[r, c] = 1 + distances.index(min(distances))
    _, consecutive = np.unique(result, return_inverse=True)
    return consecutive.reshape(height, width)


def is_actor(logits: np.ndarray, settings: PostProcessing, t: int, r: int, c: int) -> bool:
    background, actor = logits[t, :, r, c].tolist()
    if settings.foreground == "argmax":
        return actor > background
    if logits.max() == 10 and logits.min() == 0:
        return actor > FOREGROUND_THRESHOLD
    return 1 / (1 + math.exp(-actor)) > FOREGROUND_THRESHOLD


def link_instances(raw: np.ndarray, flow: np.ndarray, distance: float) -> np.ndarray:
    """Return the same instances with consistent ids, shape (T, H, W)."""
    result = [raw[0]]
    newest = int(raw[0].max())
    grid = np.indices(raw.shape[1:]).astype(np.float32)
    for t in range(len(raw) - 1):
        following = raw[t + 1]
        known = np.unique(result[-1])[1:].tolist()
        if not known or not following.any():
            result.append(following)
            continue
        moved = grid + flow[t]
        before = [masked_mean(moved, result[-1] == instance) for instance in known]
        following_ids = range(1, int(following.max()) + 1)
        after = [masked_mean(grid, following == instance) for instance in following_ids]
        costs = np.array(
            [[np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2) for a in after] for b in before]
        )

        linked_ids = {}
        for i, j in zip(*linear_sum_assignment(costs), strict=True):
            if costs[i, j] < distance:
                linked_ids[int(j) + 1] = known[i]
        unmatched = set(np.unique(following)).difference(set(linked_ids))
        unmatched.remove(0)
        for instance in unmatched:
            newest += 1
            linked_ids[int(instance)] = newest

        linked = np.zeros(following.shape, dtype=np.int64)
        for instance, linked_id in linked_ids.items():
            linked[following == instance] = linked_id
        result.append(linked)
    return np.stack(result)


def masked_mean(grid: np.ndarray, mask: np.ndarray) -> np.ndarray:
    cells = grid[:, mask].astype(np.float64)
    mean = cells.sum(axis=1) / mask.sum()
    return mean.astype(np.float32)


def centroid_paths(ids: np.ndarray) -> dict[int, list[list[float]]]:
    """Return the mean row and column in each frame that holds it, for each id of the first."""
    grid = np.indices(ids.shape[1:])
    paths = {}
    for instance in np.unique(ids[0])[1:].tolist():
        masks = [frame == instance for frame in ids]
        paths[instance] = [masked_mean(grid, mask).tolist() for mask in masks if mask.any()]
    return paths
