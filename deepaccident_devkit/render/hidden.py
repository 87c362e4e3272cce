"""Which points of other agents a camera's own agent would not see, because its LiDAR has something in front of them."""

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
_COLUMNS: Final = 50
# A point is seen up to its cell's depth times this, and so many metres more.
_SHARE, _METRES = 1.1, 1.0


def hiding(dataset: Dataset, camera: RowArgument) -> Callable[[ImagePoints], ImagePoints]:
    """What takes out of the mask of points in an image (a token or record) those that its own agent's cloud hides.

    A cell of the image, a fiftieth of its width, is as deep as the farthest of the agent's own points in it. Between
    two rings of the LiDAR a cell has the depth above it; above the highest ring, where walls go on, that below it.
    Nothing is hidden in a column without a point, or if the cloud was not downloaded.
    """
    lens = camera_of(dataset, camera)
    depths = np.zeros((-(-_COLUMNS * lens.height // lens.width), _COLUMNS))

    def cells(points: ImagePoints) -> tuple[IntArray, IntArray]:
        column, row = (points.pixels[points.mask] * _COLUMNS / lens.width).astype(np.int64).T
        return row, column

    if has_cloud(dataset, dataset.get("sample_data", camera)["sample_token"]):
        own = map_pointcloud_to_image(dataset, camera, colors=False)
        np.maximum.at(depths, cells(own), own.depth[own.mask])
    for rows in (depths, depths[::-1]):
        for before, row in pairwise(rows):
            np.copyto(row, before, where=row == 0)
    depths[depths == 0] = np.inf

    def seen(points: ImagePoints) -> ImagePoints:
        mask = points.mask.copy()
        mask[mask] = points.depth[mask] <= _SHARE * depths[cells(points)] + _METRES
        return replace(points, mask=mask)

    return seen
