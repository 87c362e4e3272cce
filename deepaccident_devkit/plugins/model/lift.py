"""`LiftSplat`: image features → a map seen from above, by a distribution over depths (Philion and Fidler, ECCV 2020).

Each pixel of a feature map stands for a ray. The points of the ray at fixed depths receive its features, weighed by the
probability of the depth, and each cell of the map is the sum or the mean of the points in it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final, Literal, get_args

import torch
from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Axis
from deepaccident_devkit.plugins.model.warps import precise
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import POLE_HEIGHT

Frustum = Literal["corners", "centres"]
Rounding = Literal["trunc", "floor"]
Pooling = Literal["sum", "mean"]
# Metres above its origin from which a camera is a vehicle's: those of the release are some 1.6 m above, or at 0.
_LEAST_CAMERA: Final = 1.0
# What is added to a cell's sum of probabilities, so that one that hardly any point reaches stays near 0.
_LEAST_MASS: Final = 0.01
# Share of a step by which a range may miss a whole number of steps, as in `geometry.BevGrid`.
_WHOLE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class LiftConfig:
    """Sizes and rules of the lift. Ranges are metres (start, end, step) in the ego frame.

    Attributes:
        in_channels: of the image features.
        channels: of the map.
        depth: the depths along the optical axis; the end is not among them.
        x: columns of the map, ascending.
        y: rows of the map, ascending.
        z: height of the points that count: one step.
        image_size: height and width of the images, pixels.
        stride: pixels of the image a step of the features.
        frustum: where a feature's ray passes through the image: `centres` of its cells; `corners` spreads the rays from
            the first to the last pixel, the release's rule.
        voxel_rounding: `floor`, or the release's `trunc`: rounding to zero, by which points up to a step below a range
            fall into its first cell.
        band: heights above the road of the points that count, so that depths need not be learned from nothing; None for
            all in `z`, as in the release. The road is at the height of the origin, or 4 m below it for cameras that are
            not above the origin: a pole's (docs/format.md).
        pooling: of the points in a cell: their `sum`, the release's rule, or their `mean` by their probabilities, which
            does not grow with the number of pixels that see a cell.
    """

    in_channels: int
    channels: int
    depth: Axis
    x: Axis
    y: Axis
    z: Axis
    image_size: tuple[int, int]
    stride: int
    frustum: Frustum = "centres"
    voxel_rounding: Rounding = "floor"
    band: tuple[float, float] | None = None
    pooling: Pooling = "sum"

    def __post_init__(self) -> None:
        """Check the ranges and words; raises ConfigError, or ChoiceError for an unknown word."""
        words = {"frustum": Frustum, "voxel_rounding": Rounding, "pooling": Pooling}
        settle_choices(self, {name: get_args(each) for name, each in words.items()})
        grid = BevGrid(x=self.x, y=self.y)
        object.__setattr__(self, "x", grid.x)
        object.__setattr__(self, "y", grid.y)
        _steps("depth", self.depth)
        if _steps("z", self.z) != 1:
            raise ConfigError(
                f"z: expected one step, as in ({self.z[0]}, {self.z[1]}, {self.z[1] - self.z[0]})"
            )
        if self.band is not None and not self.band[0] < self.band[1]:
            raise ConfigError(f"band: expected a lower and a higher end, found {self.band}")
        if any(size < self.stride or size % self.stride for size in self.image_size):
            raise ConfigError(
                f"image_size: expected height and width in multiples of the stride {self.stride}, found "
                f"{self.image_size}; resize, crop or fill the images"
            )

    @property
    def grid_shape(self) -> tuple[int, int]:
        """Rows and columns of the map."""
        return BevGrid(x=self.x, y=self.y).shape

    @property
    def frustum_shape(self) -> tuple[int, int, int]:
        """Depths of a ray, rows and columns of the features."""
        height, width = self.image_size
        return _steps("depth", self.depth), height // self.stride, width // self.stride


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraGeometry:
    """The cameras of B samples, P frames, N cameras: from the pixels that the network sees to the ego frame.

    Attributes:
        rotation: (B, P, N, 3, 3) of `ego_from_camera`; camera axes are x right, y down, z forward.
        translation: (B, P, N, 3) of `ego_from_camera`, metres.
        intrinsics: (B, P, N, 3, 3) K, pixels.
    """

    rotation: Tensor
    translation: Tensor
    intrinsics: Tensor

    def flattened(self) -> CameraGeometry:
        """The cameras of (B, A, P, N, …) tensors, with A agents, as those of B · A samples."""
        return CameraGeometry(
            **{each.name: getattr(self, each.name).flatten(0, 1) for each in fields(self)}
        )


class LiftSplat(nn.Module):
    """Lifts features of all cameras into one map (the released TransformerLSS); a state dict has the released names.

    `frustum`, (D, h', w', 3) pixels u, v of the image and depth in metres, is part of the state dict as in the release.
    """

    frustum: Tensor

    def __init__(self, config: LiftConfig) -> None:
        super().__init__()
        self.config = config
        self.depthnet = nn.Conv2d(config.in_channels, config.frustum_shape[0] + config.channels, 1)
        self.register_buffer("frustum", _frustum(config))

    def forward(self, features: Tensor, cameras: CameraGeometry) -> Tensor:
        """Features (B, P, N, C, h', w') → one map of each frame, (B, P, `channels`, Y, X); float32 under autocast too.

        Row = y ascending, column = x ascending. Raises GeometryError: features or cells do not have the configured
        shape.
        """
        depths, rows, columns = self.config.frustum_shape
        if tuple(features.shape[-2:]) != (rows, columns):
            raise GeometryError(
                f"features: expected (…, {rows}, {columns}) of images of {self.config.image_size} pixels, found "
                f"{tuple(features.shape)}"
            )
        cells = self.cells(cameras)
        expected = (*features.shape[:3], depths, rows, columns)
        if cells.shape != expected:
            raise GeometryError(
                f"cameras: expected cells {expected} for these features, found {tuple(cells.shape)}"
            )
        # sums of thousands of points need more than half precision
        logits = precise(self.depthnet(features.flatten(0, 2)))
        return self._splat(logits[:, :depths].softmax(1), logits[:, depths:], cells)

    @torch.no_grad()
    def cells(self, cameras: CameraGeometry) -> Tensor:
        """The cell of each frustum point, (B, P, N, D, h', w') int64: row · X + column, −1 if it does not count."""
        config = self.config
        points = self.points(cameras)
        axes = (config.x, config.y, config.z)
        step = points.new_tensor([size for _, _, size in axes])
        # in this order rounding lets points on a border fall where the release has them
        lower = points.new_tensor([low + size / 2 for low, _, size in axes]) - step / 2
        steps = (points - lower) / step
        steps = steps.trunc() if config.voxel_rounding == "trunc" else steps.floor()
        rows, columns = config.grid_shape
        inside = ((steps >= 0) & (steps < steps.new_tensor([columns, rows, 1]))).all(-1)
        if config.band is not None:
            road = torch.where(cameras.translation[..., 2] > _LEAST_CAMERA, 0.0, -POLE_HEIGHT)[
                ..., None, None, None
            ]
            above = points[..., 2] - road
            inside &= (above >= config.band[0]) & (above < config.band[1])
        column, row, _ = torch.where(inside[..., None], steps, 0).long().unbind(-1)
        return torch.where(inside, row * columns + column, -1)

    @torch.no_grad()
    def points(self, cameras: CameraGeometry) -> Tensor:
        """The frustum's points (B, P, N, D, h', w', 3) in the ego frame, metres."""
        dtype = torch.promote_types(cameras.rotation.dtype, torch.float32)
        with torch.autocast(self.frustum.device.type, enabled=False):
            rotation, shift = cameras.rotation.to(dtype), cameras.translation.to(dtype)
            pixels = self.frustum.to(dtype).flatten(0, 2)
            rays = torch.cat([pixels[..., :2] * pixels[..., 2:], pixels[..., 2:]], -1)
            ego_from_ray = rotation @ torch.linalg.inv(cameras.intrinsics.to(dtype))
            points = rays @ ego_from_ray.transpose(-1, -2) + shift[..., None, :]
        return points.unflatten(-2, self.config.frustum_shape)

    def _splat(self, depth: Tensor, context: Tensor, cells: Tensor) -> Tensor:
        """Sum (M, D, h', w') · (M, C, h', w') of M = B · P · N cameras over the cells."""
        samples, frames = cells.shape[:2]
        rows, columns = self.config.grid_shape
        of_camera = cells.shape[3:].numel()
        of_pixel = cells.shape[4:].numel()
        # the product is made for points that count only: most of the memory of this model is here
        flat = cells.flatten()
        point = (flat >= 0).nonzero().squeeze(1)
        pixel = point.div(of_camera, rounding_mode="floor") * of_pixel + point % of_pixel
        frame = point.div(of_camera * cells.shape[2], rounding_mode="floor")
        chances = depth.flatten().index_select(0, point)[:, None]
        features = context.flatten(2).transpose(1, 2).flatten(0, 1).index_select(0, pixel) * chances
        cell = flat[point] + frame * (rows * columns)
        maps = features.new_zeros(samples * frames * rows * columns, context.shape[1])
        maps = maps.index_add_(0, cell, features)
        if self.config.pooling == "mean":
            maps = maps / (
                chances.new_zeros(len(maps), 1).index_add_(0, cell, chances) + _LEAST_MASS
            )
        return maps.view(samples, frames, rows, columns, -1).permute(0, 1, 4, 2, 3).contiguous()


def _frustum(config: LiftConfig) -> Tensor:
    """(D, h', w', 3): u, v in pixels of the image, depth in metres."""
    height, width = config.image_size
    depths, rows, columns = config.frustum_shape
    if config.frustum == "corners":
        u, v = torch.linspace(0, width - 1, columns), torch.linspace(0, height - 1, rows)
    else:
        u, v = ((torch.arange(count) + 0.5) * config.stride for count in (columns, rows))
    start, _, step = config.depth
    depth = start + step * torch.arange(depths, dtype=u.dtype)
    return torch.stack(torch.meshgrid(depth, v, u, indexing="ij")[::-1], -1)


def _steps(name: str, axis: Axis) -> int:
    """Steps of a range; raises ConfigError if they are not a whole number from 1."""
    start, end, step = axis
    count = (end - start) / step if step > 0 else 0.0
    if round(count) < 1 or abs(count - round(count)) > _WHOLE:
        raise ConfigError(
            f"{name}: expected start, end and step with a whole number of steps between, found {axis}"
        )
    return round(count)
