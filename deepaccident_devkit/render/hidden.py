"""LiDAR points of other agents that a camera's own agent would not see.

They are hidden if its own LiDAR has something in front of them.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.render.captions import has_cloud
from deepaccident_devkit.support.arrays import IntArray
from deepaccident_devkit.v2x import map_pointcloud_to_image
from deepaccident_devkit.v2x.poses import ImagePoints, camera_of

# Number of square cells across an image.
_COLUMN_COUNT = 50
# A point is visible up to its cell's depth times this factor, plus this margin in metres.
_DEPTH_FACTOR = 1.1
_DEPTH_MARGIN_M = 1.0


def hidden_points_filter(
    dataset: Dataset, camera: RowArgument
) -> Callable[[ImagePoints], ImagePoints]:
    """Return a function that removes hidden points from the mask of points in an image.

    Points are hidden by the cloud of the image's agent. The image is divided into square cells, a
    fiftieth of its width. A cell's depth is the depth of the agent's farthest point in it. An empty
    cell between two LiDAR rings takes the depth of the cell above it; empty cells above the highest
    ring, where walls continue, take the depth of the cell below. Nothing is hidden in a column
    without points, or if the cloud was not downloaded.

    Args:
        dataset: The release.
        camera: Token or record of the image (sample data).
    """
    lens = camera_of(dataset, camera)
    row_count = -(-_COLUMN_COUNT * lens.height // lens.width)
    depths = np.zeros((row_count, _COLUMN_COUNT))

    def find_cells(points: ImagePoints) -> tuple[IntArray, IntArray]:
        pixels = points.pixels[points.mask]
        cells = pixels * _COLUMN_COUNT / lens.width
        column, row = cells.astype(np.int64).T
        return row, column

    sample = dataset.get("sample_data", camera)["sample_token"]
    if has_cloud(dataset, sample):
        own_points = map_pointcloud_to_image(dataset, camera, colors=False)
        own_depths = own_points.depth[own_points.mask]
        np.maximum.at(depths, find_cells(own_points), own_depths)
    for rows in (depths, depths[::-1]):
        for row_before, row in pairwise(rows):
            np.copyto(row, row_before, where=row == 0)
    depths[depths == 0] = np.inf

    def remove_hidden(points: ImagePoints) -> ImagePoints:
        mask = points.mask.copy()
        cell_depths = depths[find_cells(points)]
        max_depths = _DEPTH_FACTOR * cell_depths + _DEPTH_MARGIN_M
        mask[mask] = points.depth[mask] <= max_depths
        return replace(points, mask=mask)

    return remove_hidden
