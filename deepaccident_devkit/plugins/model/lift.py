"""`LiftSplat`: image features → a map seen from above, by a distribution over depths.

Philion and Fidler, ECCV 2020. Each pixel of a feature map represents a ray. The points of the ray
at fixed depths receive its features, weighted by the probability of the depth, and each cell of the
map is the sum or the mean of its points.
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
# Height above its origin from which on a camera belongs to a vehicle: the release's cameras are
# about 1.6 m above the origin, or at it.
_MIN_VEHICLE_CAMERA_HEIGHT_M: Final = 1.0
# Added to a cell's sum of probabilities, so that a cell that hardly any point reaches stays near 0.
_MASS_OFFSET: Final = 0.01
# Share of a step by which a range may deviate from an integer number of steps, as in
# `geometry.BevGrid`.
_STEP_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class LiftConfig:
    """Sizes and rules of the lift. Ranges are metres (start, end, step) in the ego frame.

    Attributes:
        in_channels: Channels of the image features.
        channels: Channels of the map.
        depth: Depths along the optical axis, without the end.
        x: Columns of the map, ascending.
        y: Rows of the map, ascending.
        z: Height of the points that count: one step.
        image_size: Height and width of the images, pixels.
        stride: Pixels of the image per cell of the features.
        frustum: Where a feature's ray passes through the image: `centres` of its cells; `corners`
            spreads the rays from the first to the last pixel, the release's rule.
        voxel_rounding: `floor`, or the release's `trunc`: rounding to zero, with which points up to
            a step below a range fall into its first cell.
        band: Heights above the road of the points that count, so that depths need not be learned
            from scratch; None for all heights in `z`, as in the release. The road is at the height
            of the origin, or 4 m below it for cameras that are not above the origin, but on a pole
            (docs/format.md).
        pooling: Pooling of the points in a cell: their `sum`, the release's rule, or their `mean`
            weighted by their probabilities, which does not grow with the number of pixels that see
            a cell.
    """

    # Channels.
    in_channels: int
    channels: int
    # Ranges.
    depth: Axis
    x: Axis
    y: Axis
    z: Axis
    # Images.
    image_size: tuple[int, int]
    stride: int
    # Rules.
    frustum: Frustum = "centres"
    voxel_rounding: Rounding = "floor"
    band: tuple[float, float] | None = None
    pooling: Pooling = "sum"

    def __post_init__(self) -> None:
        """Check the ranges and words; raises ConfigError, or ChoiceError for an unknown word."""
        words = {
            "frustum": get_args(Frustum),
            "voxel_rounding": get_args(Rounding),
            "pooling": get_args(Pooling),
        }
        settle_choices(self, words)
        grid = BevGrid(x=self.x, y=self.y)
        object.__setattr__(self, "x", grid.x)
        object.__setattr__(self, "y", grid.y)
        _step_count("depth", self.depth)
        if _step_count("z", self.z) != 1:
            raise ConfigError(
                f"z: expected one step, as in ({self.z[0]}, {self.z[1]}, {self.z[1] - self.z[0]})"
            )
        if self.band is not None and not self.band[0] < self.band[1]:
            raise ConfigError(f"band: expected a lower and a higher end, found {self.band}")
        if any(size < self.stride or size % self.stride for size in self.image_size):
            raise ConfigError(
                "image_size: expected height and width in multiples of the stride "
                f"{self.stride}, found {self.image_size}; resize, crop or fill the images"
            )

    @property
    def grid_shape(self) -> tuple[int, int]:
        """Rows and columns of the map."""
        return BevGrid(x=self.x, y=self.y).shape

    @property
    def frustum_shape(self) -> tuple[int, int, int]:
        """Depths of a ray, rows and columns of the features."""
        height, width = self.image_size
        return _step_count("depth", self.depth), height // self.stride, width // self.stride


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraGeometry:
    """The cameras of B samples, P frames, N cameras: from the network's pixels to the ego frame.

    Attributes:
        rotation: Rotation of `ego_from_camera`, shape (B, P, N, 3, 3); camera axes are x right, y
            down, z forward.
        translation: Translation of `ego_from_camera` in metres, shape (B, P, N, 3).
        intrinsics: Camera matrices K in pixels, shape (B, P, N, 3, 3).
    """

    rotation: Tensor
    translation: Tensor
    intrinsics: Tensor

    def flattened(self) -> CameraGeometry:
        """Return the cameras of (B, A, P, N, …) tensors, with A agents, as of B · A samples."""
        tensors = {field.name: getattr(self, field.name).flatten(0, 1) for field in fields(self)}
        return CameraGeometry(**tensors)


class LiftSplat(nn.Module):
    """Lifts features of all cameras into one map (the released TransformerLSS).

    A state dict has the released names. `frustum`, pixels u, v of the image and depth in metres,
    shape (D, h', w', 3), is part of the state dict as in the release.
    """

    frustum: Tensor

    def __init__(self, config: LiftConfig) -> None:
        super().__init__()
        self.config = config
        self.depthnet = nn.Conv2d(config.in_channels, config.frustum_shape[0] + config.channels, 1)
        self.register_buffer("frustum", _frustum(config))

    def forward(self, features: Tensor, cameras: CameraGeometry) -> Tensor:
        """Lift features (B, P, N, C, h', w') to one map a frame, (B, P, `channels`, Y, X).

        The map is float32, under autocast too. Rows are ordered by ascending y, columns by
        ascending x. Raises GeometryError if features or cells do not have the configured shape.
        """
        depths, rows, columns = self.config.frustum_shape
        if tuple(features.shape[-2:]) != (rows, columns):
            raise GeometryError(
                f"features: expected (…, {rows}, {columns}) of images of {self.config.image_size} "
                f"pixels, found {tuple(features.shape)}"
            )
        cells = self.cells(cameras)
        expected = (*features.shape[:3], depths, rows, columns)
        if cells.shape != expected:
            raise GeometryError(
                f"cameras: expected cells {expected} for these features, found {tuple(cells.shape)}"
            )
        # Sums of thousands of points need more than half precision.
        logits = precise(self.depthnet(features.flatten(0, 2)))
        return self._splat(logits[:, :depths].softmax(1), logits[:, depths:], cells)

    @torch.no_grad()
    def cells(self, cameras: CameraGeometry) -> Tensor:
        """Return the cell of each frustum point, (B, P, N, D, h', w') int64.

        A cell is row · X + column; −1 if the point does not count.
        """
        config = self.config
        points = self.points(cameras)
        axes = (config.x, config.y, config.z)
        step = points.new_tensor([size for _, _, size in axes])
        # In this order, rounding puts points on a border into the same cells as the release does.
        lower = points.new_tensor([low + size / 2 for low, _, size in axes]) - step / 2
        steps = (points - lower) / step
        steps = steps.trunc() if config.voxel_rounding == "trunc" else steps.floor()
        rows, columns = config.grid_shape
        is_counted = ((steps >= 0) & (steps < steps.new_tensor([columns, rows, 1]))).all(-1)
        if config.band is not None:
            is_vehicle = cameras.translation[..., 2] > _MIN_VEHICLE_CAMERA_HEIGHT_M
            road = torch.where(is_vehicle, 0.0, -POLE_HEIGHT)[..., None, None, None]
            height = points[..., 2] - road
            is_counted &= (height >= config.band[0]) & (height < config.band[1])
        column, row, _ = torch.where(is_counted[..., None], steps, 0).long().unbind(-1)
        return torch.where(is_counted, row * columns + column, -1)

    @torch.no_grad()
    def points(self, cameras: CameraGeometry) -> Tensor:
        """Return the frustum's points in the ego frame in metres, (B, P, N, D, h', w', 3)."""
        dtype = torch.promote_types(cameras.rotation.dtype, torch.float32)
        with torch.autocast(self.frustum.device.type, enabled=False):
            rotation, shift = cameras.rotation.to(dtype), cameras.translation.to(dtype)
            pixels = self.frustum.to(dtype).flatten(0, 2)
            rays = torch.cat([pixels[..., :2] * pixels[..., 2:], pixels[..., 2:]], -1)
            ego_from_ray = rotation @ torch.linalg.inv(cameras.intrinsics.to(dtype))
            points = rays @ ego_from_ray.transpose(-1, -2) + shift[..., None, :]
        return points.unflatten(-2, self.config.frustum_shape)

    def _splat(self, depth: Tensor, context: Tensor, cells: Tensor) -> Tensor:
        """Pool (M, D, h', w') · (M, C, h', w') of M = B · P · N cameras in the cells."""
        samples, frames = cells.shape[:2]
        rows, columns = self.config.grid_shape
        camera_points = cells.shape[3:].numel()
        camera_pixels = cells.shape[4:].numel()
        # The product is only computed for points that count: it takes most of this model's memory.
        flat_cells = cells.flatten()
        point = (flat_cells >= 0).nonzero().squeeze(1)
        pixel = point.div(camera_points, rounding_mode="floor") * camera_pixels
        pixel += point % camera_pixels
        frame = point.div(camera_points * cells.shape[2], rounding_mode="floor")
        probabilities = depth.flatten().index_select(0, point)[:, None]
        features = context.flatten(2).transpose(1, 2).flatten(0, 1).index_select(0, pixel)
        features = features * probabilities
        cell = flat_cells[point] + frame * (rows * columns)
        maps = features.new_zeros(samples * frames * rows * columns, context.shape[1])
        maps = maps.index_add_(0, cell, features)
        if self.config.pooling == "mean":
            mass = probabilities.new_zeros(len(maps), 1).index_add_(0, cell, probabilities)
            maps = maps / (mass + _MASS_OFFSET)
        return maps.view(samples, frames, rows, columns, -1).permute(0, 1, 4, 2, 3).contiguous()


def _frustum(config: LiftConfig) -> Tensor:
    """Return u, v in pixels of the image and depth in metres, (D, h', w', 3)."""
    height, width = config.image_size
    depths, rows, columns = config.frustum_shape
    if config.frustum == "corners":
        u, v = torch.linspace(0, width - 1, columns), torch.linspace(0, height - 1, rows)
    else:
        u, v = ((torch.arange(count) + 0.5) * config.stride for count in (columns, rows))
    start, _, step = config.depth
    depth = start + step * torch.arange(depths, dtype=u.dtype)
    return torch.stack(torch.meshgrid(depth, v, u, indexing="ij")[::-1], -1)


def _step_count(name: str, axis: Axis) -> int:
    """Return the number of steps of a range; raises ConfigError if it is no positive integer."""
    start, end, step = axis
    count = (end - start) / step if step > 0 else 0.0
    if round(count) < 1 or abs(count - round(count)) > _STEP_TOLERANCE:
        raise ConfigError(
            f"{name}: expected start, end and step with a whole number of steps between, found "
            f"{axis}"
        )
    return round(count)
