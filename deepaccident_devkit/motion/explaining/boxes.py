"""The boxes of a label frame as labels rasterise them, each on its own: which cover a cell, and which are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.geometry.bev_grid import Orientation
from deepaccident_devkit.geometry.footprints import gaps_of_pairs
from deepaccident_devkit.motion.cells.parts import OWN_BOX_ID, Cell, CellBox, Corners, Pair
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.drawing.box_polygons import FrameBoxes, box_polygons, drawn_rows
from deepaccident_devkit.motion.drawing.from_boxes import raster_corners
from deepaccident_devkit.motion.drawing.polygon_fill import filled_cells
from deepaccident_devkit.motion.explaining.sources import place_in
from deepaccident_devkit.motion.orientations import cells_in
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameCandidates:
    """All boxes of one label frame, n in all, in the order in which they are rasterised, or would be.

    Attributes:
        frames: the boxes of all label frames.
        t: which of these.
        config: of the labels.
        present_from_frame: (4, 4) right-handed.
        corners: (n, 4, 2) float32, x and y in the frame's ego frame, metres.
        key: (n,) as in `MotionLabels.id_map`.
        row: (n,) rows of the frame's boxes; −1 for the box that stands in for a missing own row.
        drawn: (n,) which of them the labels show.
    """

    frames: Sequence[FrameBoxes | None]
    t: int
    config: MotionLabelConfig
    present_from_frame: FloatArray
    corners: AnyArray
    key: IntArray
    row: IntArray
    drawn: AnyArray

    @classmethod
    def of(
        cls,
        frames: Sequence[FrameBoxes | None],
        t: int,
        config: MotionLabelConfig,
        present_from_frame: FloatArray,
        *,
        is_vehicle: bool,
    ) -> FrameCandidates | None:
        """The boxes of frame t; None beyond the recording."""
        everything = replace(config, filter_invisible=False, only_vehicle=False, draw_ego=True)
        polygons, frame = box_polygons(frames, everything, is_vehicle=is_vehicle)[t], frames[t]
        shown = drawn_rows(frames, config)[t]
        if polygons is None or frame is None or shown is None:
            return None
        is_own = frame.actor_id == OWN_ACTOR_ID
        own, others = np.flatnonzero(is_own), np.flatnonzero(~is_own)
        own_boxes = len(polygons.key) - len(others)  # 1 or none
        stands_in = config.rules.own_box_default and len(own) != 1
        own_row = np.array([-1] if stands_in else own[:1], dtype=np.int64)[:own_boxes]
        return cls(
            frames=frames,
            t=t,
            config=config,
            present_from_frame=present_from_frame,
            corners=polygons.corners,
            key=polygons.key,
            row=np.concatenate([own_row, others]),
            drawn=np.concatenate([np.full(own_boxes, config.draw_ego), shown[others]]),
        )

    def covering(self, cell: Cell) -> list[int]:
        """The numbers of the boxes whose polygons cover a cell of the frame's own raster, in order."""
        native = self.config.grid.with_orientation(self.config.rules.native)
        row, column = (int(one) for one in place_in(*cell, native, self._orientation, native.orientation))
        vertices = raster_corners(self.corners, self.config)
        near = ((vertices.min(axis=1) <= (column, row)) & (vertices.max(axis=1) >= (column, row))).all(axis=1)
        place = row * native.shape[1] + column
        return [
            number
            for number in np.flatnonzero(near).tolist()
            if place in filled_cells(vertices[number : number + 1], native.shape)[0]
        ]

    def distances(self, point: Pair) -> FloatArray:
        """(n,) metres from a point of the frame's ego frame to each footprint, 0 inside."""
        corners = self.corners.astype(np.float64)
        side, ahead = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1]
        footprints = np.column_stack(
            [corners.mean(axis=1), np.hypot(*ahead.T), np.hypot(*side.T), np.arctan2(ahead[:, 1], ahead[:, 0])]
        )
        return gaps_of_pairs(np.array([*point, 0, 0, 0]), footprints)

    def box(self, number: int, point: Pair) -> CellBox:
        """A box in words and numbers; `point` is the middle of the cell in the frame's ego frame."""
        config, corners = self.config, self.corners[number].astype(np.float64)
        native = config.grid.with_orientation(config.rules.native)
        vertices = raster_corners(self.corners[number : number + 1], config)
        rows, columns = cells_in(
            vertices[0, :, 1], vertices[0, :, 0], native.shape, native.orientation, self._orientation
        )
        at_present = self.present_from_frame @ np.column_stack([corners, np.zeros(4), np.ones(4)]).T
        row, key = int(self.row[number]), int(self.key[number])
        return CellBox(
            actor_id=key,
            category="car" if row < 0 else CATEGORIES[int(self._frame.category[row])],
            row=None if row < 0 else row,
            corners=_corners(corners),
            corners_at_present=_corners(at_present[:2].T),
            raster=tuple(zip(rows.tolist(), columns.tolist(), strict=True)),
            cells=len(filled_cells(vertices, native.shape)[0]),
            distance=float(self.distances(point)[number]),
            seen_at=self._seen_at(key),
            left_out="" if self.drawn[number] else self._why_not(number),
        )

    @property
    def _orientation(self) -> Orientation:
        return self.config.grid.orientation

    @property
    def _frame(self) -> FrameBoxes:
        return self.frames[self.t]  # type: ignore[return-value]  # `of` looked

    def _seen_at(self, key: int) -> tuple[int, ...]:
        if key in (OWN_BOX_ID, UNTRACKED_ID):
            return ()
        return tuple(
            t
            for t, frame in enumerate(self.frames)
            if frame is not None and bool(frame.visible[frame.actor_id == key].any())
        )

    def _why_not(self, number: int) -> str:
        key, row, config = int(self.key[number]), int(self.row[number]), self.config
        if key == OWN_BOX_ID:
            return "draw_ego is off"
        if config.only_vehicle and CATEGORIES[int(self._frame.category[row])] == "pedestrian":
            return "only_vehicle leaves out pedestrians"
        if key == UNTRACKED_ID and config.rules.sight == "released":
            return "filter_invisible is on, and untracked rows (id −1) count as seen by nobody"
        when = {
            "present": "at the present",
            "since": "at the present or later up to this frame",
            "now": "at this frame",
        }[config.rules.drawn_when]
        seen = ", ".join(map(str, self._seen_at(key)))
        others = f"; one does at label frame {seen}" if seen else ", nor at any other label frame"
        return f"no agent whose sight counts sees it {when} (drawn_when='{config.rules.drawn_when}'){others}"


def _corners(values: AnyArray) -> Corners:
    return tuple((x, y) for x, y in np.asarray(values, dtype=np.float64).tolist())
