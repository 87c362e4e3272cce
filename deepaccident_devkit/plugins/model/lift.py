"""`LiftSplat`: image features → a BEV map, by a distribution over depths.

Philion and Fidler, ECCV 2020. Each pixel of a feature map represents a ray. Points at fixed depths
along the ray get its features, weighted by the probability of the depth, and each map cell is the
sum or the mean of its points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

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
# Smallest height above the origin of a camera that belongs to a vehicle: the release's cameras are
# about 1.6 m above the origin, or at it.
_MIN_VEHICLE_CAMERA_HEIGHT_M = 1.0
# Added to a cell's sum of probabilities, so that a cell that gets almost no probability stays
# near 0.
_MASS_OFFSET = 0.01
# Fraction of a step by which a range may deviate from an integer number of steps, as in
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
        z: Heights of the points that are pooled, as a range of one step.
        image_size: Height and width of the images, pixels.
        stride: Pixels of the image per cell of the features.
        frustum: Points at which the features' rays pass through the image: `centres` of the cells,
            or, by the release's rule, `corners`, which spreads the rays from the first to the last
            pixel.
        voxel_rounding: `floor`, or the release's `trunc`: rounding to zero, so that points up to a
            step below a range fall into its first cell.
        band: Heights above the road of the points that are pooled, so that depths need not be
            learned from scratch; None for all heights in `z`, as in the release. The road is at the
            height of the origin, or 4 m below it for cameras that are not above the origin, but on
            a pole (docs/format.md).
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
        """Check the values.

        Raise ConfigError for a wrong range, and ChoiceError for an unknown choice.
        """
        words = {
            "frustum": get_args(Frustum),
            "voxel_rounding": get_args(Rounding),
            "pooling": get_args(Pooling),
        }
        settle_choices(self, words)
        grid = BevGrid(x=self.x, y=self.y)
        object.__setattr__(self, "x", grid.x)
        object.__setattr__(self, "y", grid.y)
        _count_steps("depth", self.depth)
        if _count_steps("z", self.z) != 1:
            low, high, _ = self.z
            raise ConfigError(f"z: expected one step, as in ({low}, {high}, {high - low})")
        if self.band is not None and not self.band[0] < self.band[1]:
            raise ConfigError(
                f"band: expected the lower end, then the higher end, found {self.band}"
            )
        for pixels in self.image_size:
            if pixels < self.stride or pixels % self.stride:
                raise ConfigError(
                    "image_size: expected height and width in multiples of the stride "
                    f"{self.stride}, found {self.image_size}; resize, crop or fill the images"
                )

    @property
    def grid_shape(self) -> tuple[int, int]:
        """Rows and columns of the map."""
        grid = BevGrid(x=self.x, y=self.y)
        return grid.shape

    @property
    def frustum_shape(self) -> tuple[int, int, int]:
        """Depths of a ray, rows and columns of the features."""
        height, width = self.image_size
        depths = _count_steps("depth", self.depth)
        return depths, height // self.stride, width // self.stride


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraGeometry:
    """Geometry of N cameras in P frames of B samples: from the network's pixels to the ego frame.

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
        """Merge the agent axis into the sample axis: B samples of A agents become B · A samples.

        The tensors of this object have shape (B, A, P, N, …).
        """
        return CameraGeometry(
            rotation=self.rotation.flatten(0, 1),
            translation=self.translation.flatten(0, 1),
            intrinsics=self.intrinsics.flatten(0, 1),
        )


class LiftSplat(nn.Module):
    """Layer that lifts the features of all cameras into one map (the released TransformerLSS).

    State-dict keys are the released names. `frustum`, pixels u, v of the image and depth in metres,
    shape (D, h', w', 3), is part of the state dict as in the release.
    """

    frustum: Tensor

    def __init__(self, config: LiftConfig) -> None:
        super().__init__()
        self.config = config
        depths = config.frustum_shape[0]
        out_channels = depths + config.channels
        self.depthnet = nn.Conv2d(config.in_channels, out_channels, 1)
        self.register_buffer("frustum", _make_frustum(config))

    def forward(self, features: Tensor, cameras: CameraGeometry) -> Tensor:
        """Lift features (B, P, N, C, h', w') to one map per frame, (B, P, `channels`, Y, X).

        The map is float32, even under autocast. Rows are ordered by ascending y, columns by
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
        output = precise(self.depthnet(features.flatten(0, 2)))
        depth = output[:, :depths].softmax(1)
        return self._pool_points(depth, output[:, depths:], cells)

    @torch.no_grad()
    def cells(self, cameras: CameraGeometry) -> Tensor:
        """Return the cell of each frustum point, (B, P, N, D, h', w') int64.

        A cell is row · X + column; −1 if the point is not pooled.
        """
        config = self.config
        points = self.points(cameras)
        axes = (config.x, config.y, config.z)
        step = points.new_tensor([size for _, _, size in axes])
        # In this order, rounding puts points on a border into the same cells as the release does.
        first_centers = points.new_tensor([low + size / 2 for low, _, size in axes])
        lower = first_centers - step / 2
        steps = (points - lower) / step
        if config.voxel_rounding == "trunc":
            steps = steps.trunc()
        else:
            steps = steps.floor()
        rows, columns = config.grid_shape
        step_counts = steps.new_tensor([columns, rows, 1])
        is_counted = ((steps >= 0) & (steps < step_counts)).all(-1)
        if config.band is not None:
            lowest, highest = config.band
            is_vehicle = cameras.translation[..., 2] > _MIN_VEHICLE_CAMERA_HEIGHT_M
            road = torch.where(is_vehicle, 0.0, -POLE_HEIGHT)[..., None, None, None]
            height = points[..., 2] - road
            is_counted &= (height >= lowest) & (height < highest)
        counted_steps = torch.where(is_counted[..., None], steps, 0).long()
        column, row, _ = counted_steps.unbind(-1)
        return torch.where(is_counted, row * columns + column, -1)

    @torch.no_grad()
    def points(self, cameras: CameraGeometry) -> Tensor:
        """Return the frustum's points in the ego frame in metres, (B, P, N, D, h', w', 3)."""
        dtype = torch.promote_types(cameras.rotation.dtype, torch.float32)
        with torch.autocast(self.frustum.device.type, enabled=False):
            rotation = cameras.rotation.to(dtype)
            shift = cameras.translation.to(dtype)
            frustum = self.frustum.to(dtype).flatten(0, 2)
            depth = frustum[..., 2:]
            rays = torch.cat([frustum[..., :2] * depth, depth], -1)
            camera_from_ray = torch.linalg.inv(cameras.intrinsics.to(dtype))
            ego_from_ray = rotation @ camera_from_ray
            points = rays @ ego_from_ray.transpose(-1, -2) + shift[..., None, :]
        return points.unflatten(-2, self.config.frustum_shape)

    def _pool_points(self, depth: Tensor, context: Tensor, cells: Tensor) -> Tensor:
        """Return the pooled features of each cell, (B, P, C, Y, X).

        Args:
            depth: Probabilities of the depths of M = B · P · N cameras, shape (M, D, h', w').
            context: Features of the cameras' pixels, shape (M, C, h', w').
            cells: Cell of each frustum point, as `cells` returns it.
        """
        samples, frames = cells.shape[:2]
        rows, columns = self.config.grid_shape
        camera_points = cells.shape[3:].numel()
        camera_pixels = cells.shape[4:].numel()
        # Compute the product only for points that are pooled: it takes most of this model's
        # memory.
        flat_cells = cells.flatten()
        point = (flat_cells >= 0).nonzero().squeeze(1)
        pixel = point // camera_points * camera_pixels
        pixel += point % camera_pixels
        frame = point // (camera_points * cells.shape[2])
        probabilities = depth.flatten().index_select(0, point)[:, None]
        pixel_features = context.flatten(2).transpose(1, 2).flatten(0, 1)
        features = pixel_features.index_select(0, pixel) * probabilities
        cell = flat_cells[point] + frame * (rows * columns)
        maps = features.new_zeros(samples * frames * rows * columns, context.shape[1])
        maps = maps.index_add_(0, cell, features)
        if self.config.pooling == "mean":
            mass = probabilities.new_zeros(len(maps), 1)
            mass = mass.index_add_(0, cell, probabilities)
            maps = maps / (mass + _MASS_OFFSET)
        maps = maps.view(samples, frames, rows, columns, -1)
        return maps.permute(0, 1, 4, 2, 3).contiguous()


def _make_frustum(config: LiftConfig) -> Tensor:
    """Return u, v in pixels of the image and depth in metres, (D, h', w', 3)."""
    height, width = config.image_size
    depths, rows, columns = config.frustum_shape
    if config.frustum == "corners":
        u = torch.linspace(0, width - 1, columns)
        v = torch.linspace(0, height - 1, rows)
    else:
        u = (torch.arange(columns) + 0.5) * config.stride
        v = (torch.arange(rows) + 0.5) * config.stride
    start, _, step = config.depth
    depth = start + step * torch.arange(depths, dtype=u.dtype)
    depth_v_u = torch.meshgrid(depth, v, u, indexing="ij")
    return torch.stack(depth_v_u[::-1], -1)


def _count_steps(name: str, axis: Axis) -> int:
    """Return a range's number of steps; raise ConfigError unless it is a positive integer."""
    start, end, step = axis
    count = 0
    deviation = 0.0
    if step > 0:
        steps = (end - start) / step
        count = round(steps)
        deviation = abs(steps - count)
    if count < 1 or deviation > _STEP_TOLERANCE:
        raise ConfigError(
            f"{name}: expected start, end and step with a whole number of steps from start to "
            f"end, found {axis}"
        )
    return count
