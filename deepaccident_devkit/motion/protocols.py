"""What the released label code does otherwise than one would, each slip by its name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Final, Literal, get_args

from deepaccident_devkit.errors import ChoiceError

WarpRule = Literal["stretched", "exact", "fiery"]
"""How a raster is sampled when it is warped to another frame: see `motion.warps.warping`."""
DrawnWhen = Literal["present", "since", "now"]
_CHOICES: Final = {"warp": get_args(WarpRule), "drawn_when": get_args(DrawnWhen)}


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelProtocol:
    """How labels are drawn and warped; a flag is True where the released code's slip is kept.

    Change one with `dataclasses.replace(LABEL_PROTOCOLS["released"], half_cell_shift=False)`. Sources: evaluation.md a
    and h.

    Attributes:
        own_box_moved_twice: the ego's own row is taken to the ego frame twice, with the released box constructor
            between; else once.
        own_box_default: where not exactly one row is the ego's own, a box of 3.99 m x 1.85 m at the LiDAR is drawn in
            its place; else the first own row is drawn, and none if there is none.
        own_box_not_augmented: an augmentation moves all boxes but the ego's own.
        half_cell_shift: the corners of boxes are rounded to the nearest *edge* between cells, so that boxes lie half a
            cell too far along both axes; else to the cell that they lie in.
        drawn_when: which of the actors that somebody sees are drawn at a frame: those seen at the `present` frame and
            no others (released: who appears later never is), those seen at that frame or `since` the present at an
            earlier one, or those seen `now`, at that frame (FIERY and BEVerse).
        untracked_share_an_id: all untracked rows (−1), where they are drawn at all, are one instance; else each row
            of each frame is one of its own.
        missing_frames_are_empty: a frame beyond the recording is all zeros, as though nobody were there (offset and
            flow 255); else it is all `ignore_index`.
        outside_is_zero: what a warp brings in from outside the grid is 0 in every map; else 0 in segmentation,
            instance and centerness, and `ignore_index` in offset and flow.
        vectors_not_rotated: offset and flow keep their values when a warp turns the cells that they stand in; else
            they turn along.
        warp: the sampling rule: `stretched` (released and BEVerse: sample points 0.50125 m apart), `exact` (cell
            centres, whole transforms) or `fiery` (cell centres; yaw and planar translation of the 6-vector alone).
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
    warp: WarpRule

    def __post_init__(self) -> None:
        """Check the choices; raises ChoiceError."""
        for field in fields(self):
            value = getattr(self, field.name)
            allowed = _CHOICES.get(field.name, (True, False))
            if value not in allowed:
                raise ChoiceError(f"label protocol: {field.name} is one of {allowed}, found {value!r}")


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
    warp="stretched",
)
_BEVERSE: Final = replace(_RELEASED, drawn_when="now", missing_frames_are_empty=False)
LABEL_PROTOCOLS: Final[Mapping[str, LabelProtocol]] = {
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
        warp="exact",
    ),
    "beverse": _BEVERSE,
    "fiery": replace(_BEVERSE, warp="fiery"),
}
"""By name: the released code, that without its slips, and the two codes that it comes from."""


def label_protocol(protocol: str | LabelProtocol) -> LabelProtocol:
    """A protocol by its name, or as it is given; raises ChoiceError."""
    if isinstance(protocol, LabelProtocol):
        return protocol
    if protocol not in LABEL_PROTOCOLS:
        raise ChoiceError(f"protocol: expected one of {', '.join(LABEL_PROTOCOLS)}, found {protocol!r}")
    return LABEL_PROTOCOLS[protocol]


def slip_names() -> list[str]:
    """The fields of `LabelProtocol` that are either kept or not."""
    return [field.name for field in fields(LabelProtocol) if field.name not in _CHOICES]
