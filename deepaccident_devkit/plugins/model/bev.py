"""BEV features cropped to a task's grid, and the encoders in front of a task's head.

Every task has its own crop and encoder, as in BEVerse (the released `BevFeatureSlicer` and
`BevEncode`). `BevUNet` is the devkit's small encoder; its output has half the grid's resolution.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Axis, axes_of
from deepaccident_devkit.plugins.model.warps import precise
from deepaccident_devkit.support.arrays import check_minima


def crop(features: Tensor, source: BevGrid, target: BevGrid) -> Tensor:
    """Sample features at another grid's cell centres (the released `BevFeatureSlicer`).

    Sampling is bilinear. Both grids are in metres of the same ego frame and in the same
    orientation. Features are zero outside the source grid, and fade to zero from half a cell inside
    its edge to half a cell outside. If the grids are equal, the features are returned unchanged.

    Args:
        features: Features on the source grid, shape (N, C, H, W).
        source: Grid of the features.
        target: Grid of the result.

    Raises:
        GeometryError: The features do not fit the source grid, or the orientations differ.
    """
    rows, columns = source.shape
    if features.dim() != 4 or tuple(features.shape[-2:]) != (rows, columns):
        raise GeometryError(
            f"features: expected (N, C, {rows}, {columns}), found {tuple(features.shape)}"
        )
    if source.orientation != target.orientation:
        raise GeometryError(
            f"target: expected a grid in the source's orientation, {source.orientation!r}, found "
            f"{target.orientation!r}; take target.with_orientation({source.orientation!r})"
        )
    if source == target:
        return features
    coordinates = []
    for target_axis, source_axis in zip(axes_of(target), axes_of(source), strict=True):
        coordinates.append(_scale_centers(target_axis, source_axis, features.device))
    vertical, horizontal = coordinates
    grid = torch.meshgrid(horizontal, vertical, indexing="xy")
    points = torch.stack(grid, dim=-1)
    # Half precision cannot distinguish neighbouring cells of a large grid.
    precise_features = precise(features)
    points = points.to(precise_features.dtype).expand(len(features), -1, -1, -1)
    sampled = functional.grid_sample(precise_features, points, align_corners=True)
    return sampled.to(features.dtype)


def _scale_centers(target: Axis, source: Axis, device: torch.device) -> Tensor:
    """Return a target axis's cell centres, scaled to the source axis.

    −1 and 1 are the centres of the source axis's first and last cell.
    """
    low, high, size = target
    count = round((high - low) / size)
    steps = torch.arange(count, device=device, dtype=torch.float64)
    centers = low + (steps + 0.5) * size
    low, high, size = source
    return (2 * centers - (low + high)) / (high - low - size)


@dataclass(frozen=True, slots=True, kw_only=True)
class BevEncodeConfig:
    """Sizes of the released encoder; the defaults are the released ones.

    Attributes:
        in_channels: Channels of the features after fusion.
        out_channels: Channels of the result.
        widths: Channels of the three stages, at 1/2, 1/4 and 1/8 of the input's resolution.
    """

    in_channels: int = 64
    out_channels: int = 256
    widths: tuple[int, int, int] = (128, 256, 512)

    def __post_init__(self) -> None:
        """Check the sizes; raise ConfigError if one is not valid."""
        _check_sizes(self, 3)


class BevEncode(nn.Module):
    """The released `BevEncode`: three stages, and a decoder back to the input's resolution.

    Each stage has two residual blocks.
    """

    def __init__(self, config: BevEncodeConfig) -> None:
        """Build the layers of the given sizes."""
        super().__init__()
        inputs = config.in_channels
        self.layers = nn.ModuleList()
        for width in config.widths:
            halving_block = _ResidualBlock(inputs, width, stride=2)
            self.layers.append(nn.Sequential(halving_block, _ResidualBlock(width, width)))
            inputs = width
        hidden_channels = 2 * config.out_channels
        self.up1 = _UpAndJoin(config.widths[0] + config.widths[-1], hidden_channels)
        self.up2 = nn.Sequential(
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            *_make_convolution(hidden_channels, config.out_channels),
            nn.Conv2d(config.out_channels, config.out_channels, 1),
        )

    def forward(self, features: Tensor) -> Tensor:
        """Encode features (N, in_channels, H, W), H and W even; return (N, out_channels, H, W)."""
        fine_stage, middle_stage, coarse_stage = self.layers
        fine = fine_stage(features)
        coarse = coarse_stage(middle_stage(fine))
        joined = self.up1(coarse, fine)
        return self.up2(joined)


@dataclass(frozen=True, slots=True, kw_only=True)
class BevUNetConfig:
    """Sizes of the small encoder; the defaults are as in `tiny`.

    Attributes:
        in_channels: Channels of the features after fusion.
        out_channels: Channels of the result.
        widths: Channels of the two stages, at 1/2 and 1/4 of the input's resolution.
    """

    in_channels: int = 32
    out_channels: int = 32
    widths: tuple[int, int] = (32, 64)

    def __post_init__(self) -> None:
        """Check the sizes; raise ConfigError if one is not valid."""
        _check_sizes(self, 2)


class BevUNet(nn.Module):
    """The small encoder: residual blocks at 1/2 and 1/4 of the resolution, joined at 1/2."""

    def __init__(self, config: BevUNetConfig) -> None:
        """Build the layers of the given sizes."""
        super().__init__()
        fine, coarse = config.widths
        self.fine = _ResidualBlock(config.in_channels, fine, stride=2)
        self.coarse = _ResidualBlock(fine, coarse, stride=2)
        self.join = nn.Sequential(*_make_convolution(fine + coarse, config.out_channels))

    def forward(self, features: Tensor) -> Tensor:
        """Encode features (N, in_channels, H, W); return (N, out_channels, H / 2, W / 2).

        Odd sizes are rounded up.
        """
        fine = self.fine(features)
        coarse = self.coarse(fine)
        enlarged = functional.interpolate(
            coarse, fine.shape[-2:], mode="bilinear", align_corners=False
        )
        return self.join(torch.cat([fine, enlarged], dim=1))


class _ResidualBlock(nn.Module):
    """Two convolutions and a skip.

    As released, a skip that changes the size is a 3 × 3 convolution without norm.
    """

    def __init__(self, inputs: int, outputs: int, *, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample: nn.Module = nn.Identity()
        if stride > 1:
            self.downsample = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        """Transform features (N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        hidden = self.bn1(self.conv1(features)).relu_()
        hidden = self.bn2(self.conv2(hidden))
        return (hidden + self.downsample(features)).relu_()


class _UpAndJoin(nn.Module):
    """Two convolutions of fine features concatenated with enlarged coarse ones."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(
            *_make_convolution(inputs, outputs), *_make_convolution(outputs, outputs)
        )

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """Merge coarse maps (N, C, h, w) and fine maps (N, C', H, W) into (N, outputs, H, W)."""
        enlarged = functional.interpolate(
            coarse, fine.shape[-2:], mode="bilinear", align_corners=True
        )
        return self.conv(torch.cat([fine, enlarged], dim=1))


def _make_convolution(inputs: int, outputs: int) -> list[nn.Module]:
    """Return a 3 × 3 convolution with batch norm and ReLU."""
    convolution = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
    return [convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]


def _check_sizes(config: BevEncodeConfig | BevUNetConfig, stages: int) -> None:
    """Check the numbers of channels and stages; raise ConfigError if one is not valid."""
    if len(config.widths) != stages or min(config.widths) < 1:
        example = (32, 64, 128)[:stages]
        raise ConfigError(
            f"widths: expected the channels of {stages} stages, such as {example}, found "
            f"{config.widths!r}"
        )
    check_minima(config, in_channels=1, out_channels=1)
