"""`MotionLabelConfig`: content and form of labels, with presets for the papers' settings.

A `LabelProtocol` has the quirks of the released label code, each with a name.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.support.arrays import checked_count, checked_flag, checked_setting
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.v2x import AgentConfig, Agents
from deepaccident_devkit.v2x.agents import checked_agents, is_available

WarpRule = Literal["stretched", "exact", "fiery"]
"""Sampling rule for a raster that is warped to another frame, see `motion.warping`."""
DrawnWhen = Literal["present", "since", "now"]
SightRule = Literal["released", "camera"]
PoseRule = Literal["whole", "yaw"]
_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "warp": get_args(WarpRule),
    "drawn_when": get_args(DrawnWhen),
    "native": ORIENTATIONS,
    "sight": get_args(SightRule),
    "pose": get_args(PoseRule),
}
_STEPS_PER_SECOND: Final = 2
_MAX_BYTE: Final = 255
_MAX_FRAMES: Final = 1000
_COUNTS: Final = {
    "receptive_field": "frames up to the present, the present included",
    "future_frames": "frames after the present; labels of motion need at least one",
    "step": "recorded frames from one label frame to the next, 5 for 2 Hz",
}
_MIN_SIGMA_CELLS: Final = 0.01
_MAX_SIGMA_CELLS: Final = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelProtocol:
    """Rules by which labels are rasterised and warped.

    A flag is True for the released code's quirk. Change one with
    `dataclasses.replace(LABEL_PROTOCOLS["released"], half_cell_shift=False)`. Sources:
    docs/released_code.md, Motion labels, Warps, and FIERY's own labels.

    Attributes:
        own_box_moved_twice: Whether the ego's own row is moved to the ego frame twice, with the
            released box constructor in between; if False, once.
        own_box_default: Whether a box of 3.99 m x 1.85 m at the LiDAR replaces the ego's own box if
            not exactly one row is the ego's own; if False, the first own row is rasterised, if
            there is one.
        own_box_not_augmented: Whether an augmentation moves all boxes except the ego's own.
        half_cell_shift: Whether the corners of boxes are rounded to the nearest *edge* between
            cells, so that boxes lie half a cell too far along both axes; if False, corners are
            rounded to their cell.
        drawn_when: Rule for the visible actors that are rasterised at a frame. `present`: actors
            that are visible at the present frame (released: an actor that appears later is never
            rasterised); `since`: actors that are visible at that frame or at an earlier one since
            the present; `now`: actors that are visible at that frame (FIERY and BEVerse).
        untracked_share_an_id: Whether all rasterised untracked rows (−1) are one instance; if
            False, each row of each frame is an instance of its own.
        missing_frames_are_empty: Whether a frame beyond the recording is all zeros, as if it had no
            actors (offset and flow 255); if False, it is all `ignore_index`.
        outside_is_zero: Whether cells that a warp samples outside the grid are 0 in every map; if
            False, they are 0 in segmentation, instance and centerness, and `ignore_index` in offset
            and flow.
        vectors_not_rotated: Whether offset and flow keep their values when a warp turns their
            cells; if False, they turn with the cells.
        ids_kept_between_samples: Whether samples may continue the ids of an earlier one (`id_map`).
            The released code does so while a worker reads samples of one scenario and agent: ids
            depend on the samples that the worker read before. If False, ids count from 1 in every
            sample.
        warp: Sampling rule: `stretched` (released and BEVerse: sample points 0.50125 m apart),
            `exact` (cell centres, complete transforms) or `fiery` (cell centres; only yaw and
            planar translation of the 6-vector).
        native: Orientation in which corners are rounded, centres are computed and rasters are
            sampled; boxes and motions have its handedness in these steps. The warp `fiery` needs
            `fiery`. It decides how halves of a cell are rounded; `MotionLabelConfig.grid` has the
            orientation of the labels.
        sight: Rule for the actors that an agent sees: `released`, by points and cameras, and
            untracked rows never; `camera`, if a camera of the agent sees the actor (FIERY drops
            nuScenes' visibility 1), of any class in nuScenes (`Dataset.with_ignored`). Only the
            sample's own agent then sees an untracked row.
        pose: Transform of boxes to the ego's frame: `whole`, by the complete pose, each as an
            upright box in that frame; `yaw` (FIERY), only by the position and the yaw of the pose,
            in double precision, so that a box that leans has the footprint of its leaning bottom.
            The yaw is the sixth number of the pose's 6-vector, which differs from the heading where
            the agent leans.
    """

    # Boxes.
    own_box_moved_twice: bool
    own_box_default: bool
    own_box_not_augmented: bool
    half_cell_shift: bool
    drawn_when: DrawnWhen
    # Ids, missing frames and values of maps.
    untracked_share_an_id: bool
    missing_frames_are_empty: bool
    outside_is_zero: bool
    vectors_not_rotated: bool
    ids_kept_between_samples: bool
    # Frames and sampling.
    warp: WarpRule
    native: Orientation
    sight: SightRule = "released"
    pose: PoseRule = "whole"

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError or ConfigError."""
        for option in fields(self):
            name = f"label protocol: {option.name}"
            value = getattr(self, option.name)
            choices = _CHOICES.get(option.name)
            if choices is None:
                checked_value: object = checked_flag(name, value)
            else:
                checked_value = choice(name, value, choices)
            object.__setattr__(self, option.name, checked_value)
        if self.warp == "fiery" and self.native != "fiery":
            raise ConfigError(
                f"label protocol: warp 'fiery' needs native 'fiery', found {self.native!r}"
            )

    @property
    def right_handed(self) -> bool:
        """Whether boxes and motions are right-handed in the native orientation.

        If not, y and all turns are negated.
        """
        return self.native != "released"

    @property
    def place_in_cell(self) -> tuple[float, float]:
        """Point for which a rasterised cell stands, in cells along x and y from its low corner.

        With `half_cell_shift` it is the corner with the lowest row and column in the native
        orientation.
        """
        if not self.half_cell_shift:
            return 0.5, 0.5
        return 0.0, 0.0 if self.right_handed else 1.0


_RELEASED: Final = LabelProtocol(
    own_box_moved_twice=True,
    own_box_default=True,
    own_box_not_augmented=True,
    half_cell_shift=True,
    drawn_when="present",
    untracked_share_an_id=True,
    missing_frames_are_empty=True,
    outside_is_zero=True,
    vectors_not_rotated=True,
    ids_kept_between_samples=True,
    warp="stretched",
    native="released",
)
_FIERY: Final = replace(
    _RELEASED,
    drawn_when="now",
    untracked_share_an_id=False,
    missing_frames_are_empty=False,
    warp="fiery",
    native="fiery",
    sight="camera",
    pose="yaw",
)
LABEL_PROTOCOLS: Final[Mapping[str, LabelProtocol]] = MappingProxyType(
    {
        "released": _RELEASED,
        "clean": LabelProtocol(
            own_box_moved_twice=False,
            own_box_default=False,
            own_box_not_augmented=False,
            half_cell_shift=False,
            drawn_when="since",
            untracked_share_an_id=False,
            missing_frames_are_empty=False,
            outside_is_zero=False,
            vectors_not_rotated=False,
            ids_kept_between_samples=False,
            warp="exact",
            native="released",
        ),
        "beverse": replace(
            _RELEASED,
            drawn_when="now",
            missing_frames_are_empty=False,
            ids_kept_between_samples=False,
            warp="stretched",
            native="devkit",
        ),
        "fiery": _FIERY,
    }
)
"""Protocols by name.

They are the released code, the same without its quirks, and the two codes that it is based on.
"""
NO_PRESETS: Final[Mapping[str, str]] = MappingProxyType(
    {
        name: f"; {name!r} is a protocol of labels: give protocol={name!r}"
        for name in LABEL_PROTOCOLS
    }
)
"""Protocol's name → end of the error message if it is used as the name of a preset."""
_PROTOCOL_NAMES: Final = {rules: name for name, rules in LABEL_PROTOCOLS.items()}


def label_protocol(protocol: str | LabelProtocol) -> LabelProtocol:
    """Return a protocol by its name, or a protocol unchanged; raises ChoiceError."""
    if isinstance(protocol, LabelProtocol):
        return protocol
    return LABEL_PROTOCOLS[choice("protocol", protocol, LABEL_PROTOCOLS)]


def slip_names() -> list[str]:
    """Return the names of the flags of `LabelProtocol`."""
    return [field.name for field in fields(LabelProtocol) if field.name not in _CHOICES]


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionLabelConfig:
    """Content of motion labels; the defaults are the released ones in the devkit's orientation.

    Attributes:
        grid: Cells, right-handed metres, and their orientation in arrays (`grid.orientation`).
        receptive_field: Number of frames up to the present that a model sees, the present included.
        future_frames: Number of frames after the present that labels show.
        step: Number of recorded frames (0.1 s) from one label frame to the next; 5 is 2 Hz.
        only_vehicle: leave out pedestrians (two-wheelers are vehicles, as in all three codes).
        filter_invisible: Whether to rasterise only actors that the cooperating agents see, by the
            protocol's `sight` (docs/released_code.md, Visibility and attributes).
        agents: Agents with views that count; None for all agents of the recording, as in the
            released code; `single` for only the sample's own, as in FIERY. Names are stored as a
            tuple, and `available` as None.
        draw_ego: Whether to rasterise the ego's own box (the infrastructure has none).
        ignore_index: Value of offset and flow outside instances, and of missing frames that are
            ignored: 255, or a number of at least the grid's longer side in cells, which no vector
            can have.
        orientation: New orientation of `grid`, only an argument of the constructor; None keeps the
            grid's own. The field itself is always None.
        sigma: Radius of the centres' peaks, cells: exp(−d² / σ²), as in FIERY.
        protocol: `released`, `clean`, `beverse`, `fiery`, or a `LabelProtocol` of your own. A
            protocol that equals a named one is replaced by the name.
        augmentation: Rotation, scale and flip in each frame's ego frame; None for no change.
    """

    # Cells and frames.
    grid: BevGrid = field(default_factory=BevGrid)
    receptive_field: int = 3
    future_frames: int = 4
    step: int = 5
    # Actors.
    only_vehicle: bool = False
    filter_invisible: bool = True
    agents: Agents = None
    draw_ego: bool = True
    # Form of the maps.
    ignore_index: int = 255
    orientation: Orientation | None = None
    sigma: float = 3.0
    protocol: str | LabelProtocol = "released"
    augmentation: Augmentation | None = None

    def __post_init__(self) -> None:
        """Check and complete the values; raises ConfigError or ChoiceError with the remedy."""
        if not isinstance(self.grid, BevGrid):
            raise ConfigError(
                f"grid: expected a BevGrid, found {self.grid!r}; "
                "BevGrid(x=(-50, 50, 0.5)) makes one"
            )
        grid = self.grid
        if self.orientation is not None:
            grid = grid.with_orientation(self.orientation)
        values: dict[str, object] = {
            "grid": grid,
            "orientation": None,
            "ignore_index": _checked_ignore_index(self.ignore_index, grid),
            "sigma": checked_setting(
                "sigma",
                self.sigma,
                "cells from 0.01 to 10,000, such as 3",
                _MIN_SIGMA_CELLS,
                _MAX_SIGMA_CELLS,
            ),
            # `available` and None have the same digest.
            "agents": None if is_available(self.agents) else checked_agents(self.agents),
            "protocol": _PROTOCOL_NAMES.get(label_protocol(self.protocol), self.protocol),
        }
        for name, meaning in _COUNTS.items():
            values[name] = checked_count(name, getattr(self, name), meaning, _MAX_FRAMES)
        for name in ("only_vehicle", "filter_invisible", "draw_ego"):
            values[name] = checked_flag(name, getattr(self, name))
        if not isinstance(self.augmentation, Augmentation | None):
            raise ConfigError(
                f"augmentation: expected an Augmentation or None, found {self.augmentation!r}"
            )
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def preset(cls, name: str, **changes: Any) -> MotionLabelConfig:
        """Return a preset of `PRESETS`, with some fields changed.

        A grid in the default orientation `devkit` gets the preset's orientation; any other grid
        keeps its own.

        Raises:
            ChoiceError: No such preset.
            ConfigError: No such field, or an impossible value.
        """
        preset = PRESETS[choice("preset", name, PRESETS, elsewhere=NO_PRESETS)]
        unknown = sorted(set(changes) - set(cls.__dataclass_fields__))
        if unknown:
            names = ", ".join(cls.__dataclass_fields__)
            raise ConfigError(f"preset: there is no field {unknown[0]!r}; there are {names}")
        grid = changes.get("grid")
        if isinstance(grid, BevGrid) and grid.orientation == "devkit":
            if changes.get("orientation") is None:
                changes["orientation"] = preset.grid.orientation
        return replace(preset, **changes)

    @property
    def rules(self) -> LabelProtocol:
        """Options of the protocol."""
        return label_protocol(self.protocol)

    @property
    def label_frames(self) -> int:
        """Number of frames that labels show: the present and the future ones."""
        return 1 + self.future_frames

    @property
    def frames(self) -> int:
        """Number of frames from the first past to the last future one.

        It is the number of rows of `future_egomotion`.
        """
        return self.receptive_field + self.future_frames

    @property
    def offsets(self) -> range:
        """Numbers of recorded frames from the present to each of `frames`, the past negative."""
        first = -(self.receptive_field - 1) * self.step
        return range(first, self.future_frames * self.step + 1, self.step)

    def as_dict(self) -> dict[str, Any]:
        """Return all that affects the labels' values, in types of JSON.

        The protocol is a dictionary of its options. An option with a default is newer than the
        first label files. It appears only with another value, so that older configurations still
        have the same digest.
        """
        rules = self.rules
        protocol = {}
        for option in fields(rules):
            value = getattr(rules, option.name)
            if value != option.default:
                protocol[option.name] = value
        return {
            **asdict(self),
            "grid": {"x": list(self.grid.x), "y": list(self.grid.y)},
            "orientation": self.grid.orientation,
            "protocol": protocol,
            "agents": _agents_in_json(self.agents),
        }

    @classmethod
    def from_dict(cls, described: Mapping[str, Any]) -> MotionLabelConfig:
        """Return the configuration that `as_dict` describes.

        Raises:
            ConfigError: It is not the description of a configuration.
            ChoiceError: A choice in it does not exist.
        """
        try:
            values = dict(described)
            grid = values.pop("grid")
            protocol = LabelProtocol(**values.pop("protocol"))
            augmentation = values.pop("augmentation")
            agents = values.pop("agents")
            bev_grid = BevGrid(tuple(grid["x"]), tuple(grid["y"]))
            if augmentation is not None:
                augmentation = Augmentation(**augmentation)
            if isinstance(agents, dict):
                agents = AgentConfig(agents["name"], tuple(agents["partners"]))
            return cls(
                grid=bev_grid,
                protocol=protocol,
                augmentation=augmentation,
                agents=agents,
                **values,
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"label configuration: cannot be read ({error})") from error

    @property
    def digest(self) -> str:
        """Short hash of `as_dict`: equal exactly for configurations that give the same labels."""
        text = json.dumps(self.as_dict(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _agents_in_json(agents: Agents) -> Any:
    """Return agents in types of JSON."""
    if isinstance(agents, AgentConfig):
        return {"name": agents.name, "partners": list(agents.partners)}
    return agents if agents is None or isinstance(agents, str) else list(agents)


def resolved_label_config(config: MotionLabelConfig | str | None) -> MotionLabelConfig:
    """Return a configuration unchanged, by a preset's name, or the released one for None.

    Raises ChoiceError or ConfigError.
    """
    if config is None:
        return MotionLabelConfig()
    if isinstance(config, str):
        return MotionLabelConfig.preset(config)
    if not isinstance(config, MotionLabelConfig):
        raise ConfigError(
            f"config: expected a MotionLabelConfig or the name of a preset, found {config!r}"
        )
    return config


def _checked_ignore_index(ignore_index: object, grid: BevGrid) -> int:
    """Return the `ignore_index` if it fits into a byte and is no vector's; raises ConfigError.

    Both components of a vector are less than the longer side, so that a larger number never occurs,
    even after a turn. On grids with a side of more than 255 cells only 255 is possible. On them the
    vector (255, 255) is 360 cells long, farther than an actor extends from its centre or moves in a
    step.
    """
    index = checked_count(
        "ignore_index", ignore_index, "a value that no vector has, such as 255", _MAX_BYTE
    )
    min_index = min(max(grid.shape), _MAX_BYTE)
    if index < min_index:
        raise ConfigError(
            f"ignore_index: {index} may also be a number of cells in offset and flow; "
            f"choose {min_index} to {_MAX_BYTE}"
        )
    return index


_DEEPACCIDENT: Final = MotionLabelConfig()
_BEVERSE: Final = MotionLabelConfig(only_vehicle=True, draw_ego=False, protocol="beverse")
PRESETS: Final[Mapping[str, MotionLabelConfig]] = MappingProxyType(
    {
        "deepaccident": _DEEPACCIDENT,
        **{
            f"deepaccident-{seconds}s": replace(
                _DEEPACCIDENT, future_frames=seconds * _STEPS_PER_SECOND
            )
            for seconds in (3, 4, 5)
        },
        "beverse": _BEVERSE,
        "fiery": replace(_BEVERSE, agents="single", protocol="fiery", orientation="fiery"),
    }
)
"""Presets by name.

They are the released labels (2 s ahead), the same 3, 4 and 5 s ahead, and the labels of the two
codes that they are based on.
"""
