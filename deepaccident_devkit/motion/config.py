"""`MotionLabelConfig`: what labels contain and how, with presets for the papers' settings.

A `LabelProtocol` lists the quirks of the released label code, each as a named option.
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
_CHOICES = {
    "warp": get_args(WarpRule),
    "drawn_when": get_args(DrawnWhen),
    "native": ORIENTATIONS,
    "sight": get_args(SightRule),
    "pose": get_args(PoseRule),
}
_STEPS_PER_SECOND = 2
_MAX_BYTE = 255
_MAX_FRAMES = 1000
_COUNTS = {
    "receptive_field": "frames up to the present, the present included",
    "future_frames": "frames after the present; labels of motion need at least one",
    "step": "recorded frames from one label frame to the next, 5 for 2 Hz",
}
_MIN_SIGMA_CELLS = 0.01
_MAX_SIGMA_CELLS = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelProtocol:
    """Rules for rasterising and warping labels.

    A flag is True for the released code's quirk. Change one with
    `dataclasses.replace(LABEL_PROTOCOLS["released"], half_cell_shift=False)`. Sources:
    docs/released_code.md, Motion labels, Warps, and FIERY's own labels.

    Attributes:
        own_box_moved_twice: Whether the ego's own row is transformed to the ego frame twice, with
            the released box constructor in between; if False, it is transformed once.
        own_box_default: Whether a box of 3.99 m x 1.85 m at the LiDAR replaces the ego's own box
            unless exactly one row is the ego's; if False, the first of the ego's rows is
            rasterised, if there is one.
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
        outside_is_zero: Whether cells that a warp samples from outside the grid are 0 in every map;
            if False, they are 0 in segmentation, instance and centerness, and `ignore_index` in
            offset and flow.
        vectors_not_rotated: Whether offset and flow keep their values when a warp turns their
            cells; if False, they turn with the cells.
        ids_kept_between_samples: Whether samples may continue the ids of an earlier one (`id_map`).
            The released code does so while a worker reads samples of one scenario and agent: ids
            depend on the samples that the worker read before. If False, ids count from 1 in every
            sample.
        warp: Sampling rule of warps: `stretched` (released and BEVerse: sample points 0.50125 m
            apart), `exact` (cell centres, complete transforms) or `fiery` (cell centres; only yaw
            and planar translation of the 6-vector).
        native: Orientation in which corners are rounded, centres are computed and rasters are
            sampled; boxes and motions have its handedness in these steps. The warp rule `fiery`
            requires the orientation `fiery`. The native orientation decides how half cells are
            rounded; the finished labels have the orientation of `MotionLabelConfig.grid`.
        sight: Rule for which actors an agent sees. `released`: decided by LiDAR points and cameras;
            untracked rows are never seen. `camera`: an actor is seen if a camera of the agent sees
            it (FIERY drops nuScenes' visibility 1); in nuScenes it may be of any class
            (`Dataset.with_ignored`), and an untracked row is seen only by the sample's own agent.
        pose: Transform of boxes to the ego frame. `whole`: by the complete pose; each box is then
            upright in that frame. `yaw` (FIERY): only by the pose's position and yaw, in double
            precision, so that a box with roll or pitch has the footprint of its tilted bottom. The
            yaw is the sixth number of the pose's 6-vector, which differs from the heading if the
            agent has roll or pitch.
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
        """Check the values; raise ChoiceError or ConfigError if one is not valid."""
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
        """The point that a rasterised cell represents, in cells along x and y from its low corner.

        With `half_cell_shift`, it is the corner with the lowest row and column in the native
        orientation; otherwise the cell's centre.
        """
        if not self.half_cell_shift:
            return 0.5, 0.5
        if self.right_handed:
            return 0.0, 0.0
        return 0.0, 1.0


_RELEASED = LabelProtocol(
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
_FIERY = replace(
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

They are the rules of the released code, the same rules without its quirks, and the rules of the two
code bases that it is based on.
"""
NO_PRESETS: Final[Mapping[str, str]] = MappingProxyType(
    {
        name: f"; {name!r} is a protocol of labels: give protocol={name!r}"
        for name in LABEL_PROTOCOLS
    }
)
"""Name of a protocol → end of the error message if it is used as the name of a preset."""
_PROTOCOL_NAMES = {rules: name for name, rules in LABEL_PROTOCOLS.items()}


def label_protocol(protocol: str | LabelProtocol) -> LabelProtocol:
    """Look up a protocol by name; a `LabelProtocol` is returned unchanged.

    Raise ChoiceError for an unknown name.
    """
    if isinstance(protocol, LabelProtocol):
        return protocol
    return LABEL_PROTOCOLS[choice("protocol", protocol, LABEL_PROTOCOLS)]


def slip_names() -> list[str]:
    """List the names of the flags of `LabelProtocol`."""
    names = []
    for option in fields(LabelProtocol):
        if option.name not in _CHOICES:
            names.append(option.name)
    return names


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionLabelConfig:
    """Configuration of motion labels; defaults are the release's, in the devkit's orientation.

    Attributes:
        grid: Extent and size of the cells, right-handed metres, and their orientation in arrays
            (`grid.orientation`).
        receptive_field: Number of frames up to and including the present that a model sees.
        future_frames: Number of frames after the present that labels cover.
        step: Number of recorded frames (0.1 s) from one label frame to the next; 5 is 2 Hz.
        only_vehicle: Whether to leave out pedestrians; two-wheelers are vehicles, as in all three
            public code bases.
        filter_invisible: Whether to rasterise only actors that the cooperating agents see, by the
            protocol's `sight` (docs/released_code.md, Visibility and attributes).
        agents: Agents whose views count for visibility; None for all agents of the recording, as in
            the released code; `single` for only the sample's own agent, as in FIERY. Names are
            stored as a tuple, and `available` as None.
        draw_ego: Whether to rasterise the ego's own box (the infrastructure has none).
        ignore_index: Value of offset and flow outside instances, and of missing frames that are
            ignored: 255, or a number not less than the grid's longer side in cells, which no vector
            component can reach.
        orientation: Constructor argument that replaces the orientation of `grid`; None keeps the
            grid's orientation. The field itself is always None.
        sigma: Radius of the centres' peaks, cells: exp(−d² / σ²), as in FIERY.
        protocol: `released`, `clean`, `beverse`, `fiery`, or a `LabelProtocol` of your own. A
            protocol that equals a named one is replaced by the name.
        augmentation: Rotation, scale and flip, applied in each frame's ego frame; None for no
            change.
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
        """Check and complete the values; raise ConfigError or ChoiceError with the remedy."""
        if not isinstance(self.grid, BevGrid):
            raise ConfigError(
                f"grid: expected a BevGrid, found {self.grid!r}; "
                "BevGrid(x=(-50, 50, 0.5)) makes one"
            )
        grid = self.grid
        if self.orientation is not None:
            grid = grid.with_orientation(self.orientation)
        ignore_index = _check_ignore_index(self.ignore_index, grid)
        expected_sigma = "cells from 0.01 to 10,000, such as 3"
        sigma = checked_setting(
            "sigma", self.sigma, expected_sigma, _MIN_SIGMA_CELLS, _MAX_SIGMA_CELLS
        )
        agents = None
        # `available` and None have the same digest.
        if not is_available(self.agents):
            agents = checked_agents(self.agents)
        rules = label_protocol(self.protocol)
        values: dict[str, object] = {
            "grid": grid,
            "orientation": None,
            "ignore_index": ignore_index,
            "sigma": sigma,
            "agents": agents,
            "protocol": _PROTOCOL_NAMES.get(rules, self.protocol),
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

        If `changes` contains a grid with the default orientation `devkit`, it takes the preset's
        orientation; any other grid keeps its own orientation.

        Raises:
            ChoiceError: There is no preset of that name.
            ConfigError: There is no such field, or a value is not valid.
        """
        preset = PRESETS[choice("preset", name, PRESETS, elsewhere=NO_PRESETS)]
        unknown = sorted(set(changes) - set(cls.__dataclass_fields__))
        if unknown:
            names = ", ".join(cls.__dataclass_fields__)
            raise ConfigError(f"preset: no field {unknown[0]!r}; the fields are {names}")
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
        """Number of frames that labels cover: the present and the future ones."""
        return 1 + self.future_frames

    @property
    def frames(self) -> int:
        """Number of frames from the first past to the last future one.

        It is the number of rows of `future_egomotion`.
        """
        return self.receptive_field + self.future_frames

    @property
    def offsets(self) -> range:
        """Offsets of `frames` from the present in recorded frames (0.1 s); the past is negative."""
        first = -(self.receptive_field - 1) * self.step
        last = self.future_frames * self.step
        return range(first, last + 1, self.step)

    def as_dict(self) -> dict[str, Any]:
        """Return everything that affects the labels' values, in JSON types.

        The protocol is a dictionary of its options. Options that are newer than the first label
        files have a default, and appear only with another value, so that older configurations keep
        their digest.
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
            "agents": _encode_agents(self.agents),
        }

    @classmethod
    def from_dict(cls, described: Mapping[str, Any]) -> MotionLabelConfig:
        """Return the configuration that `as_dict` describes.

        Raises:
            ConfigError: The dictionary does not describe a configuration.
            ChoiceError: The dictionary contains an unknown choice, such as a protocol's name.
        """
        try:
            values = dict(described)
            grid = values["grid"]
            values["protocol"] = LabelProtocol(**values["protocol"])
            augmentation = values["augmentation"]
            agents = values["agents"]
            values["grid"] = BevGrid(tuple(grid["x"]), tuple(grid["y"]))
            if augmentation is not None:
                values["augmentation"] = Augmentation(**augmentation)
            if isinstance(agents, dict):
                values["agents"] = AgentConfig(agents["name"], tuple(agents["partners"]))
            return cls(**values)
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"label configuration: cannot be read ({error})") from error

    @property
    def digest(self) -> str:
        """Short hash of `as_dict`; equal if and only if two configurations give the same labels."""
        text = json.dumps(self.as_dict(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _encode_agents(agents: Agents) -> Any:
    """Return the agents in JSON types."""
    if isinstance(agents, AgentConfig):
        return {"name": agents.name, "partners": list(agents.partners)}
    if agents is None or isinstance(agents, str):
        return agents
    return list(agents)


def resolved_label_config(config: MotionLabelConfig | str | None) -> MotionLabelConfig:
    """Return a configuration unchanged, the preset of a name, or for None the released preset.

    Raise ChoiceError if there is no such preset, and ConfigError for any other type.
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


def _check_ignore_index(ignore_index: object, grid: BevGrid) -> int:
    """Return `ignore_index`; raise ConfigError unless it fits into a byte and no vector reaches it.

    Both components of a vector are less than the grid's longer side, so a number not less than that
    never occurs, even after a rotation. On grids with a side of more than 255 cells, only 255 is
    possible. There the vector (255, 255) is 360 cells long, farther than an actor extends from its
    centre or moves in one step.
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


_DEEPACCIDENT = MotionLabelConfig()
_BEVERSE = MotionLabelConfig(only_vehicle=True, draw_ego=False, protocol="beverse")
PRESETS: Final[Mapping[str, MotionLabelConfig]] = MappingProxyType(
    {
        "deepaccident": _DEEPACCIDENT,
        "deepaccident-3s": replace(_DEEPACCIDENT, future_frames=3 * _STEPS_PER_SECOND),
        "deepaccident-4s": replace(_DEEPACCIDENT, future_frames=4 * _STEPS_PER_SECOND),
        "deepaccident-5s": replace(_DEEPACCIDENT, future_frames=5 * _STEPS_PER_SECOND),
        "beverse": _BEVERSE,
        "fiery": replace(_BEVERSE, agents="single", protocol="fiery", orientation="fiery"),
    }
)
"""Presets by name.

They are the released labels (2 s ahead), the same labels 3, 4 and 5 s ahead, and the labels of the
two code bases that the released code is based on.
"""
