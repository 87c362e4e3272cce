"""`PillarEncoder`: an agent's LiDAR points → features of a map seen from above (PointPillars, Lang et al., CVPR 2019).

Each point is seen by itself, in the frame of the vertical pillar that it is in; a pillar has the largest of its points'
features, an empty one zeros. Two convolutions bring the pillars to the cells of the maps that agents share.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.support.arrays import check_least


@dataclass(frozen=True, slots=True, kw_only=True)
class PillarConfig:
    """Sizes of the encoder of points.

    Attributes:
        channels: of the map.
        grid: the map's cells.
        split: pillars along a side of a cell: finer ones keep more of the shape of what is in it.
        height: metres above the road of the points that count, from and to.
        width: features of a point, and of a pillar.
    """

    channels: int
    grid: BevGrid
    split: int = 2
    height: tuple[float, float] = (-0.5, 4.0)
    width: int = 16

    def __post_init__(self) -> None:
        """Check the sizes; raises ConfigError."""
        check_least(self, channels=1, split=1, width=1)
        if not self.height[0] < self.height[1]:
            raise ConfigError(f"height: expected a lower and a higher end, found {self.height}")


# Numbers of a point: where it is in its pillar, its height and intensity, and where and how far away it is.
_POINT = 7


class PillarEncoder(nn.Module):
    """Points → a map of each frame."""

    def __init__(self, config: PillarConfig) -> None:
        super().__init__()
        self.config = config
        self.point = nn.Linear(_POINT, config.width)
        self.cells = nn.Sequential(
            nn.Conv2d(config.width, config.channels, 3, stride=config.split, padding=1, bias=False),
            nn.BatchNorm2d(config.channels),
            nn.ReLU(),
            nn.Conv2d(config.channels, config.channels, 3, padding=1, bias=False),
            nn.BatchNorm2d(config.channels),
            nn.ReLU(),
        )

    def forward(self, points: Tensor, frame: Tensor, frames: int) -> Tensor:
        """Points of some frames → maps (frames, channels, Y, X); row = y ascending, column = x ascending.

        Args:
            points: (K, 4) x y z in metres, z above the road, and the intensity.
            frame: (K,) int64, the frame that each is of.
            frames: how many there are.
        """
        config = self.config
        low, high, size = points.new_tensor([config.grid.x, config.grid.y]).unbind(1)
        rows, columns = (config.split * cells for cells in config.grid.shape)
        place = (points[:, :2] - low) / size * config.split
        index = place.floor().long()
        inside = ((index >= 0) & (index < index.new_tensor([columns, rows]))).all(1)
        inside &= (points[:, 2] >= config.height[0]) & (points[:, 2] < config.height[1])
        points, place, index = points[inside], place[inside], index[inside]
        pillar = (frame[inside] * rows + index[:, 1]) * columns + index[:, 0]
        where = points[:, :2] / (high - low)
        features = self.point(
            torch.cat(
                [place - index - 0.5, points[:, 2:], where, where.norm(dim=1, keepdim=True)], 1
            )
        )
        features = features.relu()
        # an empty pillar's zeros take part in the maximum of others too: it is at least 0 there already
        pillars = features.new_zeros(frames * rows * columns, config.width)
        pillars = pillars.scatter_reduce(0, pillar[:, None].expand_as(features), features, "amax")
        return self.cells(pillars.view(frames, rows, columns, -1).permute(0, 3, 1, 2).contiguous())
