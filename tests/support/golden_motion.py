"""Read golden predictions of motion, quantised as tests/data/golden/README.md describes."""

from typing import Any

import numpy as np

from deepaccident_devkit.geometry.bev_grid import cells_in
from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import LinkedInstances


def read_heads(golden: Any, orientation: str, source: str = "released") -> MotionHeads:
    """Return a stored prediction, turned from its source orientation."""
    logit = golden["seg_q"].astype(np.float32) / 16
    return MotionHeads(
        segmentation=np.stack([-logit, logit], axis=1),
        centerness=golden["center_q"].astype(np.float32) / 255,
        offset=golden["off_q"].astype(np.float32) / 4,
        flow=golden["flow_q"].astype(np.float32) / 4,
        orientation=source,
    ).in_orientation(orientation)


def column_row_centers(linked: LinkedInstances, target: str = "released") -> dict[str, list]:
    """Return the centres of each instance as (column, row) in the target orientation."""
    shape = linked.instance.shape[1:]
    centers = {}
    for name, points in linked.centers.items():
        rows, columns = cells_in(*points.T, shape, linked.orientation, target)
        centers[str(name)] = np.stack([columns, rows], axis=-1).tolist()
    return centers
