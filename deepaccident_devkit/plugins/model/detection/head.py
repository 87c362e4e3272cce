"""The detection head: maps of box centres and box codes from BEV features (CenterPoint)."""

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Axis
from deepaccident_devkit.support.arrays import check_minima
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import CATEGORIES

ClassSlots = tuple[tuple[int | None, ...], ...]
Branches = Literal["separate", "joint"]

# Channels of a task's maps except the heatmap, in the order of the box code.
CODE_CHANNELS = {"reg": 2, "height": 1, "dim": 3, "rot": 2, "vel": 2}
CODE_SIZE = sum(CODE_CHANNELS.values())
# Our tasks: cars; trucks and vans; cyclists and motorcycles; pedestrians.
CLASS_SLOTS: ClassSlots = ((0,), (1, 2), (3, 4), (5,))
RELEASED_CLASS_SLOTS: ClassSlots = (*CLASS_SLOTS, (None, None), (None, None))
"""The release's six tasks with ten slots, by the categories that they are trained on.

The release names them (car) (truck, van) (invalid1, invalid2) (invalid3) (motorcycle, cyclist)
(pedestrian, invalid4), but compares dataset indices with slot numbers, so that its last two tasks
never see a box.
"""
# All classes in one task, as in the small model.
ONE_TASK: ClassSlots = (tuple(range(len(CATEGORIES))),)


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionConfig:
    """Sizes, cells and classes of a `CenterHead`.

    Attributes:
        in_channels: Channels of the features.
        shared_channels: Channels of the convolution that all tasks share, and of the branches.
        class_slots: For each task, the category of each heatmap channel: an index into
            `taxonomy.CATEGORIES`, or None for a channel that no box trains. Boxes of a category
            without a slot are background.
        x: Start, end and cell size of the output's columns, metres, ego frame.
        y: Start, end and cell size of the output's rows, metres, ego frame.
        branches: `separate` for the released two convolutions for each quantity, `joint` for one
            1×1 convolution for each task.
        upsample: Factor between the rows and columns of the output and of the features.
        heatmap_bias: Initial bias of the heatmap channels; −2.19 makes every cell a centre with
            probability 0.1.
    """

    in_channels: int = 256
    shared_channels: int = 64
    class_slots: ClassSlots = CLASS_SLOTS
    x: Axis = (-51.2, 51.2, 0.8)
    y: Axis = (-51.2, 51.2, 0.8)
    branches: Branches = "separate"
    upsample: int = 1
    heatmap_bias: float = -2.19

    def __post_init__(self) -> None:
        """Check the values; raise ConfigError or ChoiceError if one is not valid."""
        settle_choices(self, {"branches": get_args(Branches)})
        BevGrid(x=self.x, y=self.y)  # checks both axes
        check_minima(self, in_channels=1, shared_channels=1, upsample=1)
        _check_slots(self.class_slots)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (y) and columns (x) of the output."""
        grid = BevGrid(x=self.x, y=self.y)
        return grid.shape


class TaskMaps(NamedTuple):
    """The head's output for one task, for each of H × W cells.

    Rows are ordered by ascending y, columns by ascending x.

    Attributes:
        reg: x and y of the centre from the cell's lower corner, in cells, shape (B, 2, H, W).
        height: z of the centre, metres, shape (B, 1, H, W).
        dim: Logarithms of length, width, height in metres, shape (B, 3, H, W).
        rot: Sine and cosine of the yaw, up to a common positive factor, shape (B, 2, H, W).
        vel: vx, vy, m/s, shape (B, 2, H, W).
        heatmap: Logits of each slot's centres, shape (B, slots, H, W).
    """

    reg: Tensor
    height: Tensor
    dim: Tensor
    rot: Tensor
    vel: Tensor
    heatmap: Tensor

    @property
    def code(self) -> Tensor:
        """The box code: all maps except the heatmap, (B, 10, H, W)."""
        return torch.cat(self[:-1], dim=1)


class ConvBlock(nn.Module):
    """A 3×3 convolution without bias, a batch norm and a ReLU; height and width stay the same."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(in_channels, out_channels, 3, padding=1, bias=False)
        self.bn = nn.BatchNorm2d(out_channels)

    def forward(self, features: Tensor) -> Tensor:
        """Transform (B, in, H, W) to (B, out, H, W)."""
        return functional.relu(self.bn(self.conv(features)))


class SeparateHead(nn.Module):
    """One task's released branches: a `ConvBlock` and a 3×3 convolution for each quantity."""

    def __init__(self, channels: int, slots: int, heatmap_bias: float) -> None:
        super().__init__()
        for name, count in {**CODE_CHANNELS, "heatmap": slots}.items():
            output_conv = nn.Conv2d(channels, count, 3, padding=1)
            if name == "heatmap":
                nn.init.constant_(output_conv.bias, heatmap_bias)  # type: ignore[arg-type]  # it has one
            self.add_module(name, nn.Sequential(ConvBlock(channels, channels), output_conv))

    def forward(self, features: Tensor) -> TaskMaps:
        """Return the maps of features (B, channels, H, W), with the same cells."""
        maps = []
        for name in TaskMaps._fields:
            branch = self.get_submodule(name)
            maps.append(branch(features))
        return TaskMaps(*maps)


class JointHead(nn.Module):
    """One task's maps from one 1×1 convolution."""

    def __init__(self, channels: int, slots: int, heatmap_bias: float) -> None:
        super().__init__()
        self._sizes = [*CODE_CHANNELS.values(), slots]
        self.maps = nn.Conv2d(channels, sum(self._sizes), 1)
        with torch.no_grad():
            self.maps.bias[CODE_SIZE:] = heatmap_bias  # type: ignore[index]  # it has one

    def forward(self, features: Tensor) -> TaskMaps:
        """Return the maps of features (B, channels, H, W), with the same cells."""
        stacked_maps = self.maps(features)
        return TaskMaps(*stacked_maps.split(self._sizes, dim=1))


class CenterHead(nn.Module):
    """Boxes as points on the ground: a shared convolution, then maps for each task.

    With `branches="separate"` and no upsampling it is the released CenterHeadv1, with the same
    keys.
    """

    def __init__(self, config: DetectionConfig) -> None:
        """Build the head of a configuration."""
        super().__init__()
        self.config = config
        self.shared_conv = ConvBlock(config.in_channels, config.shared_channels)
        head_class = SeparateHead if config.branches == "separate" else JointHead
        self.task_heads = nn.ModuleList(
            head_class(config.shared_channels, len(slots), config.heatmap_bias)
            for slots in config.class_slots
        )

    def forward(self, features: Tensor) -> list[TaskMaps]:
        """Return the maps of each task.

        Args:
            features: Features of the configured grid divided by `upsample`, shape (B, in_channels,
                rows, columns).

        Raises:
            ConfigError: The features have another height or width.
        """
        config = self.config
        rows, columns = config.shape
        upsampled_rows = features.shape[-2] * config.upsample
        upsampled_columns = features.shape[-1] * config.upsample
        if (upsampled_rows, upsampled_columns) != (rows, columns):
            raise ConfigError(
                f"features: {upsampled_rows} × {upsampled_columns} cells after upsampling by "
                f"{config.upsample}, expected {rows} × {columns} of x={config.x}, y={config.y}; "
                "change x and y, or upsample"
            )
        shared = self.shared_conv(features)
        if config.upsample > 1:
            shared = functional.interpolate(
                shared, config.shape, mode="bilinear", align_corners=False
            )
        return [head(shared) for head in self.task_heads]


def _check_slots(class_slots: ClassSlots) -> None:
    """Check the slots of all tasks; raise ConfigError if one is not valid."""
    if not class_slots or not all(class_slots):
        raise ConfigError(
            f"class_slots: expected tasks with one slot or more, found {class_slots!r}"
        )
    categories = []
    for slots in class_slots:
        categories += [category for category in slots if category is not None]
    is_repeated = len(set(categories)) < len(categories)
    is_known = set(categories) <= set(range(len(CATEGORIES)))
    if is_repeated or not is_known:
        raise ConfigError(
            f"class_slots: expected each category 0 to {len(CATEGORIES) - 1} at most once, and "
            f"None for slots that nothing trains; found {class_slots!r}"
        )
