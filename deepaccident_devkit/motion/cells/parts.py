"""The parts of a `CellExplanation`, each with its sentences: values, boxes, the warp, quirks, a prediction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.taxonomy import UNTRACKED_ID
from deepaccident_devkit.text import fixed_text

OWN_BOX_ID: Final = -101
"""Key of the ego's own box in `MotionLabels.id_map`, as the released code has it."""
Pair = tuple[float, float]
Cell = tuple[int, int]
Corners = tuple[Pair, ...]
Outcome = Literal["found", "missed", "false alarm", "empty", "outside", "no such frame"]
_OUTCOMES: Final[dict[str, str]] = {
    "found": "labels and prediction both show an actor here",
    "missed": "the prediction misses the actor here",
    "false alarm": "the prediction shows an actor where the labels show none",
    "empty": "labels and prediction both show nobody here",
    "outside": "the cell lies outside the prediction's grid",
    "no such frame": "the prediction ends before this frame",
}


def actor_text(actor: int | None, category: str = "actor") -> str:
    """How sentences call the actor of a key of `MotionLabels.id_map`; None is nobody."""
    if actor is None:
        return "nobody"
    if actor == OWN_BOX_ID:
        return "the ego's own box"
    return f"an untracked {category}" if actor == UNTRACKED_ID else f"{category} {actor}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CellValues(ShortRepr):
    """The values of one cell in the maps of `MotionLabels`.

    Attributes:
        segmentation: 1 on an actor.
        instance: id.
        centerness: 0 to 1.
        offset: cells down the rows and along the columns to the instance's centre.
        flow: cells (rows, columns) to where the instance is at the next frame.
    """

    segmentation: int
    instance: int
    centerness: float
    offset: Pair
    flow: Pair

    @property
    def text(self) -> str:
        """All values, with their names."""
        names = ("segmentation", "instance", "centerness", "offset", "flow")
        return ", ".join(f"{name} {value_text(getattr(self, name))}" for name in names)


@dataclass(frozen=True, slots=True, kw_only=True)
class CellBox(ShortRepr):
    """A box of the label file of the cell's frame.

    Attributes:
        actor_id: as in `MotionLabels.id_map`: −101 is the ego's own box, −1 an untracked actor.
        category: its class; `car` for the box that stands in for a missing own row.
        row: which of the boxes of the sample, from 0; None for the box that stands in for a missing own row.
        annotation: its token; None without a release.
        instance: token of the actor's instance; None without a release, and for untracked actors.
        label_id: its id in the labels' `instance`; None if it has none there, or an untracked actor's cannot be known.
        corners: (x, y) of its footprint's four corners in the ego frame of its own moment, metres, right-handed; with
            the labels' augmentation.
        corners_at_present: the same in the present ego frame.
        raster: (row, column) of the corners as they were rounded, in the frame's own raster; may lie outside.
        cells: how many cells its polygon covers there, those under other boxes included.
        distance: metres from the middle of the cell to the footprint, 0 inside.
        seen_at: label frames at which an agent whose sight counts sees the actor.
        left_out: why the labels do not show it; empty if they do.
    """

    actor_id: int
    category: str
    row: int | None
    corners: Corners
    corners_at_present: Corners
    raster: tuple[Cell, ...]
    cells: int
    distance: float
    seen_at: tuple[int, ...]
    left_out: str
    label_id: int | None = None
    annotation: str | None = None
    instance: str | None = None

    @property
    def name(self) -> str:
        """Such as `van 1300`."""
        return actor_text(self.actor_id, self.category)

    @property
    def text(self) -> str:
        """Who it is, and which row of the frame's label."""
        if self.row is None:
            return f"{self.name} (no row of the label; it stands in for the ego's own row)"
        return f"{self.name} (row {self.row} of the frame's boxes)"

    @property
    def place_text(self) -> str:
        """Where its corners lie, in metres and in cells."""
        own, present = (
            ", ".join(f"({fixed_text(x, 2)}, {fixed_text(y, 2)})" for x, y in corners)
            for corners in (self.corners, self.corners_at_present)
        )
        cells = ", ".join(map(str, self.raster))
        told = f"Its corners: {own} m in the ego frame of that moment, rounded to cells {cells} of its raster"
        return f"{told}; {present} m in the present one." if own != present else f"{told}."


@dataclass(frozen=True, slots=True, kw_only=True)
class CellSource(ShortRepr):
    """Where a cell's values were before the warp to the present; without a warp, the cell itself.

    Attributes:
        warped: whether the labels are at the present, and this frame is a later one.
        rule: the protocol's sampling rule (`motion.warps.warping`).
        motion: x, y, metres, and yaw, radians, of this frame's ego seen from the present one.
        sample_point: row and column, fractional, at which the frame's own raster is sampled; 0 is the middle of the
            first cell.
        cell: the nearest cell there, whose values segmentation, instance, offset and flow take; None outside the grid.
        center: (x, y) of that cell's middle, metres, in the frame's own ego frame; None outside.
        centerness: how it was sampled; None if no mode gives the labels' values.
        blended: with `bilinear`, the cells of the sample and their weights.
    """

    warped: bool
    rule: str
    motion: tuple[float, float, float]
    sample_point: Pair
    cell: Cell | None
    center: Pair | None
    centerness: Literal["nearest", "bilinear"] | None
    blended: tuple[tuple[Cell, float], ...] = ()

    @property
    def text(self) -> str:
        """The warp in words; empty without one."""
        if not self.warped:
            return ""
        x, y, yaw = (fixed_text(value, 2) for value in self.motion)
        point = f"({', '.join(fixed_text(value, 2) for value in self.sample_point)})"
        taken = "which is outside the grid" if self.cell is None else f"nearest to its cell {self.cell}"
        text = (
            f"Warped to the present (rule '{self.rule}'): the ego is then at ({x}, {y}) m, turned by {yaw} rad; the "
            f"value comes from row and column {point} of that frame's own raster, {taken}."
        )
        if self.blended:
            parts = ", ".join(f"{weight:.2f} of {cell}" for cell, weight in self.blended)
            text += f" Centerness is a mean of cells: {parts}."
        return text


@dataclass(frozen=True, slots=True, kw_only=True)
class CellPeak(ShortRepr):
    """The centre that is nearest to the cell in the frame's own raster: its peak gives the centerness.

    Attributes:
        actor_id: as in `MotionLabels.id_map`; −1 if that does not say it.
        center: row and column.
        distance: cells from the source cell.
    """

    actor_id: int
    center: Cell
    distance: float

    @property
    def text(self) -> str:
        """A sentence."""
        return (
            f"The nearest centre is that of {actor_text(self.actor_id)}, at cell {self.center}, "
            f"{self.distance:.1f} cells away."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CellChange(ShortRepr):
    """What a switch changes in the cell.

    Attributes:
        what: `actor` (as in `id_map`, None for nobody), or the name of a map.
        here: with the switch as it is.
        without: with the switch as the protocol `clean` has it.
    """

    what: str
    here: Any
    without: Any

    @property
    def text(self) -> str:
        """Such as `centerness 0.5 in place of 0.4`: what would be, and what is."""
        if self.what == "actor":
            return f"{actor_text(self.without)} in place of {actor_text(self.here)}"
        return f"{self.what} {value_text(self.without)} in place of {value_text(self.here)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CellQuirk(ShortRepr):
    """A switch of the protocol that acted on the cell: with it alone set as in `clean`, the cell would differ.

    Centerness, offset and flow must differ by more than 0.01 to count.

    Attributes:
        switch: its name, a field of `LabelProtocol`.
        value: its value.
        words: what it does.
        changes: what it changes here.
    """

    switch: str
    value: bool | str
    words: str
    changes: tuple[CellChange, ...]

    @property
    def text(self) -> str:
        """A sentence."""
        name = self.switch if self.value is True else f"{self.switch}='{self.value}'"
        return f"{name}: {self.words}. Without it: {'; '.join(change.text for change in self.changes)}."


@dataclass(frozen=True, slots=True, kw_only=True)
class CellPrediction(ShortRepr):
    """What a prediction put at the cell; of several predictions the last one, which VPQ and IoU take.

    Attributes:
        outcome: compared with the labels.
        frames: how many frames are predicted.
        cell: row and column in the prediction's own raster, which lies in the present ego frame; None outside it.
        instance: id; with heads, after the released post-processing for VPQ; 0 for nobody.
        probability: of an actor, with heads.
        probabilities: the same of each prediction, the last one among them.
        centerness: with heads.
        offset: with heads; rows and columns of the labels' orientation.
        flow: with heads; the same.
        instance_cells: how many cells of this frame the instance has.
        mostly: the labels' actor with which it shares the most cells of this frame, as in `id_map`; None for nobody,
            or if the grids differ or the labels are not at the present.
        shared_cells: how many.
    """

    outcome: Outcome
    frames: int
    cell: Cell | None = None
    instance: int | None = None
    probability: float | None = None
    probabilities: tuple[float, ...] = ()
    centerness: float | None = None
    offset: Pair | None = None
    flow: Pair | None = None
    instance_cells: int = 0
    mostly: int | None = None
    shared_cells: int = 0

    @property
    def text(self) -> str:
        """Some sentences."""
        parts = [f"Prediction: {_OUTCOMES[self.outcome]}."]
        if self.instance is None:
            return parts[0]
        who = f"instance {self.instance}" if self.instance else "nobody"
        told = f"It has {who} at cell {self.cell} of its raster"
        if self.probability is not None:
            told += f", actor with probability {self.probability:.2f}"
            told += f" (all {len(self.probabilities)}: {_row_text(self.probabilities)})" * (len(self.probabilities) > 1)
            values = {"centerness": self.centerness, "offset": self.offset, "flow": self.flow}
            told += "".join(f", {name} {value_text(value)}" for name, value in values.items())
        parts.append(f"{told}.")
        if self.instance:
            shared = f", {self.shared_cells} of them on {actor_text(self.mostly)}" if self.mostly is not None else ""
            parts.append(f"That instance has {self.instance_cells} cells in this frame{shared}.")
        return " ".join(parts)


def value_text(value: Any) -> str:
    """A number, or a pair of numbers, with at most three decimals."""
    if isinstance(value, tuple):
        return f"({', '.join(map(value_text, value))})"
    return f"{round(value, 3) + 0.0:g}"


def _row_text(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
