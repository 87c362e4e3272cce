"""`PillarEncoder`: an agent's LiDAR points → a BEV feature map (PointPillars).

Lang et al., CVPR 2019. Each point is encoded independently, in the frame of its vertical pillar; a
pillar's features are the maxima over its points, and an empty pillar's are zeros. Two convolutions
reduce the pillars to the cells of the maps that agents share.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.support.arrays import check_minima

# Inputs of a point: offset in its pillar (2), height, intensity, position (2) and distance.
_POINT_INPUTS = 7


@dataclass(frozen=True, slots=True, kw_only=True)
class PillarConfig:
    """Sizes of the point encoder.

    Attributes:
        channels: Channels of the map.
        grid: Cells of the map.
        split: Number of pillars along a side of a cell; finer pillars retain more of the shape of
            objects.
        height: Range of heights above the road, metres; points outside it are ignored.
        width: Number of features of a point and of a pillar.
    """

    channels: int
    grid: BevGrid
    split: int = 2
    height: tuple[float, float] = (-0.5, 4.0)
    width: int = 16

    def __post_init__(self) -> None:
        """Check the sizes; raise ConfigError if one is not valid."""
        check_minima(self, channels=1, split=1, width=1)
        if not self.height[0] < self.height[1]:
            raise ConfigError(
                f"height: expected the lower end, then the higher end, found {self.height}"
            )


class PillarEncoder(nn.Module):
    """Encoder that turns each frame's points into one map."""

    def __init__(self, config: PillarConfig) -> None:
        super().__init__()
        self.config = config
        self.point = nn.Linear(_POINT_INPUTS, config.width)
        self.cells = nn.Sequential(
            nn.Conv2d(config.width, config.channels, 3, stride=config.split, padding=1, bias=False),
            nn.BatchNorm2d(config.channels),
            nn.ReLU(),
            nn.Conv2d(config.channels, config.channels, 3, padding=1, bias=False),
            nn.BatchNorm2d(config.channels),
            nn.ReLU(),
        )

    def forward(self, points: Tensor, frame: Tensor, frames: int) -> Tensor:
        """Encode the points of all frames as maps, shape (frames, channels, Y, X).

        Rows are ordered by ascending y, columns by ascending x.

        Args:
            points: x, y, z (metres, z above the road) and intensity, shape (K, 4).
            frame: Index of each point's frame, int64, shape (K,).
            frames: Number of frames.
        """
        config = self.config
        low, high, size = points.new_tensor([config.grid.x, config.grid.y]).unbind(1)
        rows = config.split * config.grid.shape[0]
        columns = config.split * config.grid.shape[1]
        position = (points[:, :2] - low) / size * config.split
        index = position.floor().long()
        counts = index.new_tensor([columns, rows])
        in_range = ((index >= 0) & (index < counts)).all(1)
        lowest, highest = config.height
        height = points[:, 2]
        in_range &= (height >= lowest) & (height < highest)
        points = points[in_range]
        position = position[in_range]
        index = index[in_range]
        column, row = index.unbind(1)
        pillar = (frame[in_range] * rows + row) * columns + column
        scaled_xy = points[:, :2] / (high - low)
        distance = scaled_xy.norm(dim=1, keepdim=True)
        offset = position - index - 0.5
        inputs = torch.cat([offset, points[:, 2:], scaled_xy, distance], 1)
        features = self.point(inputs).relu()
        # The initial zeros also take part in the maximum of non-empty pillars, which is at least
        # 0.
        pillars = features.new_zeros(frames * rows * columns, config.width)
        target = pillar[:, None].expand_as(features)
        pillars = pillars.scatter_reduce(0, target, features, "amax")
        maps = pillars.view(frames, rows, columns, -1).permute(0, 3, 1, 2)
        return self.cells(maps.contiguous())
