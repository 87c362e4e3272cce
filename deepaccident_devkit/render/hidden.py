"""LiDAR points of other agents that a camera's own agent would not see.

They are hidden if its own LiDAR has something in front of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.render.captions import has_cloud
from deepaccident_devkit.support.arrays import IntArray
from deepaccident_devkit.v2x import map_pointcloud_to_image
from deepaccident_devkit.v2x.poses import ImagePoints, camera_of

# Square cells across an image.
_COLUMN_COUNT: Final = 50
# A point is visible up to its cell's depth times a factor, plus a margin in metres.
_DEPTH_FACTOR, _DEPTH_MARGIN_M = 1.1, 1.0


def hiding(dataset: Dataset, camera: RowArgument) -> Callable[[ImagePoints], ImagePoints]:
    """Return a function that removes hidden points from the mask of points in an image.

    The image is a token or record; the cloud of its own agent hides points. A cell of the image, a
    fiftieth of its width, is as deep as the farthest of the agent's own points in it. Between two
    rings of the LiDAR a cell has the depth above it; above the highest ring, where walls go on, the
    depth below it. Nothing is hidden in a column without a point, or if the cloud was not
    downloaded.
    """
    lens = camera_of(dataset, camera)
    row_count = -(-_COLUMN_COUNT * lens.height // lens.width)
    depths = np.zeros((row_count, _COLUMN_COUNT))

    def cells(points: ImagePoints) -> tuple[IntArray, IntArray]:
        scaled = points.pixels[points.mask] * _COLUMN_COUNT / lens.width
        column, row = scaled.astype(np.int64).T
        return row, column

    if has_cloud(dataset, dataset.get("sample_data", camera)["sample_token"]):
        own_points = map_pointcloud_to_image(dataset, camera, colors=False)
        np.maximum.at(depths, cells(own_points), own_points.depth[own_points.mask])
    for rows in (depths, depths[::-1]):
        for row_before, row in pairwise(rows):
            np.copyto(row, row_before, where=row == 0)
    depths[depths == 0] = np.inf

    def without_hidden(points: ImagePoints) -> ImagePoints:
        mask = points.mask.copy()
        max_depth = _DEPTH_FACTOR * depths[cells(points)] + _DEPTH_MARGIN_M
        mask[mask] = points.depth[mask] <= max_depth
        return replace(points, mask=mask)

    return without_hidden
