"""Which switches of the protocol acted on a cell: the labels are made once more with each of them as in `clean`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Final

import numpy as np

from deepaccident_devkit.motion.cells.parts import Cell, CellChange, CellQuirk, CellValues
from deepaccident_devkit.motion.drawing.box_polygons import FrameBoxes
from deepaccident_devkit.motion.drawing.from_boxes import motion_labels_from_boxes
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.protocols import LABEL_PROTOCOLS, LabelProtocol
from deepaccident_devkit.motion.warps.warping import WarpMode
from deepaccident_devkit.taxonomy import UNTRACKED_ID

WORDS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "own_box_moved_twice": "the ego's own row is moved from the LiDAR to the ego frame twice",
        "own_box_default": "where not exactly one row is the ego's own, a box at the LiDAR stands in for it",
        "own_box_not_augmented": "the augmentation moves all boxes but the ego's own",
        "half_cell_shift": "corners are rounded to the nearest edge between cells, so that boxes lie half a cell too "
        "far",
        "drawn_when": "when somebody has to see an actor for it to be rasterised",
        "untracked_share_an_id": "all untracked rows are one instance",
        "missing_frames_are_empty": "a frame beyond the recording is all 0, as if nobody were there",
        "outside_is_zero": "what a warp takes from outside the grid is 0 in all maps, in offset and flow too",
        "vectors_not_rotated": "a warp turns the cells of offset and flow, but not the vectors in them",
        "ids_kept_between_samples": "ids go on from an earlier sample",
        "warp": "a warp does not sample exactly at the middles of the cells",
    }
)
"""What each switch does where it is not as in `clean`."""
_VECTORS_AND_PEAKS: Final = ("centerness", "offset", "flow")
_TOLD: Final = 0.01
"""How much these have to differ, as in docs/motion_labels.md, How much each switch changes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Remaker:
    """What a cell's labels are made from, to make them once more.

    Attributes:
        labels: as they are.
        frames: the boxes of each label frame.
        is_vehicle: whether the agent has a box of its own.
    """

    labels: MotionLabels
    frames: Sequence[FrameBoxes | None]
    is_vehicle: bool

    def own_frames(self, rules: LabelProtocol | None = None) -> MotionLabels:
        """The labels, each frame in its own ego frame; with other rules, if some are given."""
        given, config = self.labels, self.labels.config
        if rules is not None:
            config = replace(config, protocol=rules)
        keeps = config.rules.ids_kept_between_samples and bool(given.id_map)
        return motion_labels_from_boxes(
            self.frames,
            given.future_egomotion,
            config,
            valid=given.valid,
            is_vehicle=self.is_vehicle,
            id_map=given.id_map if keeps else None,
        )

    def like_given(self, own_frames: MotionLabels, centerness: WarpMode) -> MotionLabels:
        """Remade labels at the present, if the given ones are."""
        return own_frames.to_present(centerness) if self.labels.at_present else own_frames

    def quirks(self, remade: MotionLabels, t: int, cell: Cell, centerness: WarpMode) -> tuple[CellQuirk, ...]:
        """The switches that acted on a cell of frame t, in the order of `LabelProtocol`'s fields."""
        rules, clean = self.labels.config.rules, LABEL_PROTOCOLS["clean"]
        here, found = cell_values(remade, t, cell), []
        for switch in (field.name for field in fields(rules) if field.name in WORDS):
            value = getattr(rules, switch)
            if value == getattr(clean, switch) or not self._may_act(switch, t):
                continue
            other = replace(rules, **{switch: getattr(clean, switch)})
            without = self.like_given(self.own_frames(other), centerness)
            changes = _changes((remade, here), (without, cell_values(without, t, cell)))
            if switch == "ids_kept_between_samples":
                changes += _changed_id(here, cell_values(without, t, cell))
            if changes:
                found.append(CellQuirk(switch=switch, value=value, words=WORDS[switch], changes=changes))
        return tuple(found)

    def _may_act(self, switch: str, t: int) -> bool:
        """False for switches that cannot act on frame t: making labels once more for each of them takes a while."""
        labels, config = self.labels, self.labels.config
        if switch in ("outside_is_zero", "vectors_not_rotated"):
            return labels.at_present and t > 0
        if switch == "missing_frames_are_empty":
            return not labels.label_valid[t]
        if switch.startswith("own_box"):
            augmented = switch != "own_box_not_augmented" or config.augmentation is not None
            return config.draw_ego and self.is_vehicle and augmented
        return True


def cell_values(labels: MotionLabels, t: int, cell: Cell) -> CellValues:
    """The values of a cell of frame t in all maps."""
    place = (..., *cell)
    down, along = labels.offset[t][place].tolist()
    next_down, next_along = labels.flow[t][place].tolist()
    return CellValues(
        segmentation=int(labels.segmentation[t][place]),
        instance=int(labels.instance[t][place]),
        centerness=float(labels.centerness[t, 0][place]),
        offset=(down, along),
        flow=(next_down, next_along),
    )


def actor_of(labels: MotionLabels, values: CellValues) -> int | None:
    """The key in `id_map` of the actor that a cell shows, −1 if its id is in no entry; None for nobody."""
    if values.segmentation != 1:
        return None
    keys = [key for key, identity in labels.id_map.items() if identity == values.instance]
    return keys[0] if keys else UNTRACKED_ID


def _changes(here: tuple[MotionLabels, CellValues], without: tuple[MotionLabels, CellValues]) -> tuple[CellChange, ...]:
    """What differs. Ids are compared as actors: a switch that shows one more actor changes the ids of others."""
    actors = actor_of(*here), actor_of(*without)
    changes = [CellChange(what="actor", here=actors[0], without=actors[1])] if actors[0] != actors[1] else []
    if not changes and here[1].segmentation != without[1].segmentation:  # as in missing frames
        changes.append(CellChange(what="segmentation", here=here[1].segmentation, without=without[1].segmentation))
    for name in _VECTORS_AND_PEAKS:
        one, other = getattr(here[1], name), getattr(without[1], name)
        if np.abs(np.subtract(one, other)).max() > _TOLD:
            changes.append(CellChange(what=name, here=one, without=other))
    return tuple(changes)


def _changed_id(here: CellValues, without: CellValues) -> tuple[CellChange, ...]:
    if here.instance == without.instance:
        return ()
    return (CellChange(what="instance", here=here.instance, without=without.instance),)
