"""The quirks of the released label code, each by its name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Final, Literal, get_args

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation
from deepaccident_devkit.motion.settings import flag
from deepaccident_devkit.support.text import choice

WarpRule = Literal["stretched", "exact", "fiery"]
"""How a raster is sampled when it is warped to another frame: see `motion.warps.warping`."""
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
            a camera of the agent sees it (FIERY drops nuScenes' visibility 1). An untracked row is then seen by the
            sample's own agent alone.
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
        for field in fields(self):
            name, value = f"label protocol: {field.name}", getattr(self, field.name)
            allowed = _CHOICES.get(field.name)
            object.__setattr__(self, field.name, flag(name, value) if allowed is None else choice(name, value, allowed))
        if self.warp == "fiery" and self.native != "fiery":
            raise ConfigError(f"label protocol: warp 'fiery' needs native 'fiery', found {self.native!r}")

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


def label_protocol(protocol: str | LabelProtocol) -> LabelProtocol:
    """A protocol by its name, or as it is given; raises ChoiceError."""
    if isinstance(protocol, LabelProtocol):
        return protocol
    return LABEL_PROTOCOLS[choice("protocol", protocol, LABEL_PROTOCOLS)]


def slip_names() -> list[str]:
    """The names of the quirks of `LabelProtocol` that are either kept or not."""
    return [field.name for field in fields(LabelProtocol) if field.name not in _CHOICES]
