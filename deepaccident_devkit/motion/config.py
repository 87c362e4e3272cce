"""`MotionLabelConfig`: what labels show and how, with presets for the papers' settings.

A `LabelProtocol` has the quirks of the released label code, each by its name.
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
"""How a raster is sampled when it is warped to another frame: see `motion.warping`."""
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
_BYTE: Final = 255
_MOST_FRAMES: Final = 1000
_COUNTS: Final = {
    "receptive_field": "frames up to the present, the present included",
    "future_frames": "frames after the present; labels of motion need at least one",
    "step": "recorded frames from one label frame to the next, 5 for 2 Hz",
}
_SIGMAS: Final = (0.01, 10_000.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelProtocol:
    """How labels are rasterised and warped; a flag is True where the released code's quirk is kept.

    Change one with `dataclasses.replace(LABEL_PROTOCOLS["released"], half_cell_shift=False)`. Sources:
    docs/released_code.md, Motion labels, Warps, and FIERY's own labels.

    Attributes:
        own_box_moved_twice: the ego's own row is moved to the ego frame twice, and the released box constructor runs
            in between; if False, once.
        own_box_default: if not exactly one row is the ego's own, a box of 3.99 m x 1.85 m at the LiDAR is rasterised
            in its place; if False, the first own row is rasterised, if there is one.
        own_box_not_augmented: an augmentation moves all boxes except the ego's own.
        half_cell_shift: the corners of boxes are rounded to the nearest *edge* between cells, so boxes lie half a cell
            too far along both axes; if False, to the cell that they lie in.
        drawn_when: which visible actors are rasterised at a frame. `present`: those seen at the present frame
            (released: who appears later is never rasterised); `since`: those seen at that frame or at an earlier one
            since the present; `now`: those seen at that frame (FIERY and BEVerse).
        untracked_share_an_id: all untracked rows (−1) that are rasterised are one instance; if False, each row of each
            frame is an instance of its own.
        missing_frames_are_empty: a frame beyond the recording is all zeros, as if nobody were there (offset and
            flow 255); if False, it is all `ignore_index`.
        outside_is_zero: cells that a warp takes from outside the grid are 0 in every map; if False, 0 in segmentation,
            instance and centerness, and `ignore_index` in offset and flow.
        vectors_not_rotated: offset and flow keep their values when a warp turns their cells; if False, they turn with
            the cells.
        ids_kept_between_samples: samples may continue the ids of an earlier one (`id_map`). The released code does so
            while a worker reads samples of one scenario and agent: ids depend on what the worker read before. If False,
            ids count from 1 in every sample.
        warp: the sampling rule: `stretched` (released and BEVerse: sample points 0.50125 m apart), `exact` (cell
            centres, whole transforms) or `fiery` (cell centres; only yaw and planar translation of the 6-vector).
        native: the orientation in which corners are rounded, centres are computed and rasters are sampled; boxes and
            motions have its handedness in these steps. The warp `fiery` needs `fiery`. It decides how halves of a cell
            are rounded; `MotionLabelConfig.grid` has the orientation of the labels.
        sight: when an agent sees an actor: `released`, by points and cameras, and untracked rows never; `camera`, where
            a camera of the agent sees it (FIERY drops nuScenes' visibility 1), of whatever class it is in nuScenes
            (`Dataset.with_ignored`). An untracked row is then seen by the sample's own agent alone.
        pose: how boxes come to the ego's frame: `whole`, by the whole pose, each as an upright box there; `yaw`
            (FIERY), by the position and the yaw of the pose alone, in double precision, so that a box that leans has
            the footprint of its leaning bottom. The yaw is the sixth number of the pose's 6-vector, which differs from
            the heading where the agent leans.
    """

    own_box_moved_twice: bool
    own_box_default: bool
    own_box_not_augmented: bool
    half_cell_shift: bool
    drawn_when: DrawnWhen
    untracked_share_an_id: bool
    missing_frames_are_empty: bool
    outside_is_zero: bool
    vectors_not_rotated: bool
    ids_kept_between_samples: bool
    warp: WarpRule
    native: Orientation
    sight: SightRule = "released"
    pose: PoseRule = "whole"

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError or ConfigError."""
        for one in fields(self):
            name, value = f"label protocol: {one.name}", getattr(self, one.name)
            allowed = _CHOICES.get(one.name)
            object.__setattr__(
                self,
                one.name,
                checked_flag(name, value) if allowed is None else choice(name, value, allowed),
            )
        if self.warp == "fiery" and self.native != "fiery":
            raise ConfigError(
                f"label protocol: warp 'fiery' needs native 'fiery', found {self.native!r}"
            )

    @property
    def right_handed(self) -> bool:
        """Whether boxes and motions are right-handed in the native orientation; if not, y and all turns are negated."""
        return self.native != "released"

    @property
    def place_in_cell(self) -> tuple[float, float]:
        """The point for which a rasterised cell stands, in cells along x and y from its low corner.

        With `half_cell_shift` it is the corner with the lowest row and column in the native orientation.
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
"""By name: the released code, the same without its quirks, and the two codes that it is based on."""
NO_PRESETS: Final[Mapping[str, str]] = MappingProxyType(
    {
        name: f"; {name!r} is a protocol of labels: give protocol={name!r}"
        for name in LABEL_PROTOCOLS
    }
)
"""What to say of a protocol's name that is given as a preset's."""
_NAMES: Final = {rules: name for name, rules in LABEL_PROTOCOLS.items()}


def label_protocol(protocol: str | LabelProtocol) -> LabelProtocol:
    """A protocol by its name, or as it is given; raises ChoiceError."""
    if isinstance(protocol, LabelProtocol):
        return protocol
    return LABEL_PROTOCOLS[choice("protocol", protocol, LABEL_PROTOCOLS)]


def slip_names() -> list[str]:
    """The names of the quirks of `LabelProtocol` that are either kept or not."""
    return [field.name for field in fields(LabelProtocol) if field.name not in _CHOICES]


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionLabelConfig:
    """What motion labels show; the defaults are the released ones in the devkit's orientation.

    Attributes:
        grid: the cells, right-handed metres, and how they lie in arrays (`grid.orientation`).
        receptive_field: frames up to the present that a model sees, the present included.
        future_frames: frames after the present that labels show.
        step: recorded frames (0.1 s) from one label frame to the next; 5 is 2 Hz.
        only_vehicle: leave out pedestrians (two-wheelers are vehicles, as in all three codes).
        filter_invisible: rasterise only what the cooperating agents see, by the protocol's `sight`
            (docs/released_code.md, Visibility and attributes).
        agents: the agents whose sight counts; None for all that are there, as in the released code; `single` for the
            sample's own alone, as in FIERY. Names are kept as a tuple, and `available` as None.
        draw_ego: rasterise the ego's own box (the infrastructure has none).
        ignore_index: the value of offset and flow outside instances, and of missing frames that are ignored: 255, or a
            number of at least the grid's longer side in cells, which no vector can have.
        orientation: only an argument of the constructor: the new orientation of `grid`; None keeps the grid's own. The
            field itself is always None.
        sigma: radius of the centres' peaks, cells: exp(−d² / σ²), as in FIERY.
        protocol: `released`, `clean`, `beverse`, `fiery`, or a `LabelProtocol` of your own. One that is equal to a
            named protocol is replaced by the name.
        augmentation: a rotation, scale and flip in each frame's ego frame; None for none.
    """

    grid: BevGrid = field(default_factory=BevGrid)
    receptive_field: int = 3
    future_frames: int = 4
    step: int = 5
    only_vehicle: bool = False
    filter_invisible: bool = True
    agents: Agents = None
    draw_ego: bool = True
    ignore_index: int = 255
    orientation: Orientation | None = None
    sigma: float = 3.0
    protocol: str | LabelProtocol = "released"
    augmentation: Augmentation | None = None

    def __post_init__(self) -> None:
        """Check and complete; raises ConfigError or ChoiceError, each with the remedy."""
        if not isinstance(self.grid, BevGrid):
            raise ConfigError(
                f"grid: expected a BevGrid, found {self.grid!r}; BevGrid(x=(-50, 50, 0.5)) makes one"
            )
        grid = (
            self.grid if self.orientation is None else self.grid.with_orientation(self.orientation)
        )
        values: dict[str, object] = {
            "grid": grid,
            "orientation": None,
            "ignore_index": _checked_mark(self.ignore_index, grid),
            "sigma": checked_setting(
                "sigma", self.sigma, "cells from 0.01 to 10,000, such as 3", *_SIGMAS
            ),
            "agents": None
            if is_available(self.agents)
            else checked_agents(self.agents),  # one digest for both
            "protocol": _NAMES.get(label_protocol(self.protocol), self.protocol),
            **{
                name: checked_count(name, getattr(self, name), what, _MOST_FRAMES)
                for name, what in _COUNTS.items()
            },
            **{
                name: checked_flag(name, getattr(self, name))
                for name in ("only_vehicle", "filter_invisible", "draw_ego")
            },
        }
        if not isinstance(self.augmentation, Augmentation | None):
            raise ConfigError(
                f"augmentation: expected an Augmentation or None, found {self.augmentation!r}"
            )
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def preset(cls, name: str, **changes: Any) -> MotionLabelConfig:
        """A preset of `PRESETS`, with some fields changed.

        A grid in the default orientation `devkit` gets the preset's orientation; any other grid keeps its own.

        Raises:
            ChoiceError: no such preset.
            ConfigError: no such field, or an impossible value.
        """
        preset = PRESETS[choice("preset", name, PRESETS, elsewhere=NO_PRESETS)]
        unknown = sorted(set(changes) - set(cls.__dataclass_fields__))
        if unknown:
            raise ConfigError(
                f"preset: there is no field {unknown[0]!r}; there are {', '.join(cls.__dataclass_fields__)}"
            )
        given = changes.get("grid")
        if (
            isinstance(given, BevGrid)
            and given.orientation == "devkit"
            and changes.get("orientation") is None
        ):
            changes["orientation"] = preset.grid.orientation
        return replace(preset, **changes)

    @property
    def rules(self) -> LabelProtocol:
        """The protocol's switches."""
        return label_protocol(self.protocol)

    @property
    def label_frames(self) -> int:
        """Frames that labels show: the present and the future ones."""
        return 1 + self.future_frames

    @property
    def frames(self) -> int:
        """Frames from the first past to the last future one: the rows of `future_egomotion`."""
        return self.receptive_field + self.future_frames

    @property
    def offsets(self) -> range:
        """Recorded frames from the present to each of `frames`, the past negative."""
        return range(
            -(self.receptive_field - 1) * self.step, self.future_frames * self.step + 1, self.step
        )

    def as_dict(self) -> dict[str, Any]:
        """All that affects the labels' values, in types that JSON has; the protocol as its switches.

        A switch with a default is younger than the first label files. It is there only with another value, so that a
        configuration of then has the same digest now.
        """
        return {
            **asdict(self),
            "grid": {"x": list(self.grid.x), "y": list(self.grid.y)},
            "orientation": self.grid.orientation,
            "protocol": {
                one.name: getattr(self.rules, one.name)
                for one in fields(self.rules)
                if getattr(self.rules, one.name) != one.default
            },
            "agents": _agents_text(self.agents),
        }

    @classmethod
    def from_dict(cls, described: Mapping[str, Any]) -> MotionLabelConfig:
        """The configuration that `as_dict` describes.

        Raises:
            ConfigError: it is not the description of a configuration.
            ChoiceError: a choice in it does not exist.
        """
        try:
            values = dict(described)
            grid = values.pop("grid")
            protocol = LabelProtocol(**values.pop("protocol"))
            augmentation, agents = values.pop("augmentation"), values.pop("agents")
            return cls(
                grid=BevGrid(tuple(grid["x"]), tuple(grid["y"])),
                protocol=protocol,
                augmentation=None if augmentation is None else Augmentation(**augmentation),
                agents=AgentConfig(agents["name"], tuple(agents["partners"]))
                if isinstance(agents, dict)
                else agents,
                **values,
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"label configuration: cannot be read ({error})") from error

    @property
    def digest(self) -> str:
        """A short hash of `as_dict`: equal exactly for configurations that give the same labels."""
        return hashlib.sha256(json.dumps(self.as_dict(), sort_keys=True).encode()).hexdigest()[:16]


def _agents_text(agents: Agents) -> Any:
    if isinstance(agents, AgentConfig):
        return {"name": agents.name, "partners": list(agents.partners)}
    return agents if agents is None or isinstance(agents, str) else list(agents)


def resolved_label_config(config: MotionLabelConfig | str | None) -> MotionLabelConfig:
    """A configuration as given, by a preset's name, or the released one for None; raises ChoiceError or ConfigError."""
    if config is None or isinstance(config, str):
        return MotionLabelConfig() if config is None else MotionLabelConfig.preset(config)
    if not isinstance(config, MotionLabelConfig):
        raise ConfigError(
            f"config: expected a MotionLabelConfig or the name of a preset, found {config!r}"
        )
    return config


def _checked_mark(ignore_index: object, grid: BevGrid) -> int:
    """The `ignore_index`, checked: it fits into a byte, and no vector has it as both components.

    Both components of a vector are less than the longer side, so a larger number never occurs, even after a turn. On
    grids with a side of more than 255 cells only 255 is possible. There the vector (255, 255) is 360 cells long,
    farther than an actor reaches from its centre or moves in a step.
    """
    mark = checked_count(
        "ignore_index", ignore_index, "a value that no vector has, such as 255", _BYTE
    )
    least = min(max(grid.shape), _BYTE)
    if mark < least:
        raise ConfigError(
            f"ignore_index: {mark} may also be a number of cells in offset and flow; choose {least} to {_BYTE}"
        )
    return mark


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
"""The released labels (2 s ahead), the same 3, 4 and 5 s ahead, and those of the two codes that it is based on."""
