"""`CellExplanation`: how one cell of motion labels came to its values."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.motion.cells.parts import (
    Cell,
    CellBox,
    CellPeak,
    CellPrediction,
    CellQuirk,
    CellSource,
    CellValues,
    Pair,
)

_SMALL: Final = 0.001
"""Sentences about centerness begin here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CellExplanation(ShortRepr):
    """One cell of motion labels: its values, the box that painted it, and all that acted on it.

    Cells are (row, column) in the orientation of the labels. Who painted the cell is found from the boxes, not read
    from the labels: `disagrees` says where the two differ.

    Attributes:
        t: label frame; 0 is the present.
        cell: row and column.
        seconds: from the present to the frame.
        at_present: whether the labels lie in the present ego frame; if not, each frame lies in its own.
        recorded: whether the frame is in the recording.
        center: (x, y) of the cell's middle, metres, right-handed, in the ego frame in which the labels lie.
        values: of the labels.
        source: the cell in the frame's own raster from which the values come.
        painter: the box whose actor the cell shows; None for nobody.
        covered: boxes under the painter's, the uppermost first: later boxes overwrite earlier ones.
        left_out: boxes that would cover the cell, but are not rasterised; `CellBox.left_out` says why.
        nearest: of an empty cell, the rasterised box that is nearest to it; None if there is none.
        peak: the centre that gives the centerness; None if the frame shows nobody, or the cell comes from outside.
        quirks: the switches of the protocol that acted on the cell.
        disagrees: what the labels and the boxes do not agree about: names of maps, and `painter`.
        protocol: its name; `own` if it has none.
        sample: token of the present's sample; None without a release.
        frame_sample: token of the frame's sample, whose label has the boxes; None beyond the recording.
        prediction: what it put there; None without one.
    """

    t: int
    cell: Cell
    seconds: float
    at_present: bool
    recorded: bool
    center: Pair
    values: CellValues
    source: CellSource
    painter: CellBox | None
    covered: tuple[CellBox, ...]
    left_out: tuple[CellBox, ...]
    nearest: CellBox | None
    peak: CellPeak | None
    quirks: tuple[CellQuirk, ...]
    disagrees: tuple[str, ...]
    protocol: str
    sample: str | None = None
    frame_sample: str | None = None
    prediction: CellPrediction | None = None

    @property
    def text(self) -> str:
        """The explanation in sentences, one fact a line."""
        lines = [self._place_text(), f"Values: {self.values.text}.", self._painter_text()]
        lines += [f"Under it, overwritten: {box.text}." for box in self.covered]
        if self.nearest is not None:
            where = (
                "covers the cell's middle" if self.nearest.distance == 0 else f"is {self.nearest.distance:.2f} m away"
            )
            lines.append(f"The nearest box that is rasterised: {self.nearest.text}; it {where}.")
        lines += [f"Left out, though it would cover the cell: {box.text}; {box.left_out}." for box in self.left_out]
        lines.append(self.source.text)
        if self.peak is not None and self.values.centerness >= _SMALL:
            lines.append(self.peak.text)
        lines += [f"Quirk {quirk.text}" for quirk in self.quirks]
        if self.disagrees:
            lines.append(
                f"The boxes do not give what the labels have ({', '.join(self.disagrees)}): the labels were changed, "
                "or made from another sample, release or configuration."
            )
        if self.prediction is not None:
            lines.append(self.prediction.text)
        return "\n".join(line for line in lines if line)

    def to_dict(self) -> dict[str, Any]:
        """All fields in types that JSON has, tuples among them, and `text`."""
        return {**asdict(self), "text": self.text}

    def _place_text(self) -> str:
        when = "the present" if self.t == 0 else f"{self.seconds:+.1f} s"
        sample = f", {self.frame_sample}" if self.frame_sample else ""
        whose = "the present ego frame" if self.at_present or self.t == 0 else "the ego frame of that moment"
        x, y = self.center
        return (
            f"Cell (row {self.cell[0]}, column {self.cell[1]}) of frame {self.t} ({when}{sample}), protocol "
            f"{self.protocol}: its middle lies at ({x:.2f}, {y:.2f}) m in {whose}."
        )

    def _painter_text(self) -> str:
        if not self.recorded:
            return "Nobody painted it: the recording ends before this frame."
        if self.source.cell is None:
            return "Nobody painted it: the cell comes from outside the frame's own raster."
        if self.painter is None:
            return "Nobody painted it."
        box, where = self.painter, "covers the cell's middle"
        if self.painter.distance:
            where = f"ends {self.painter.distance:.2f} m from the cell's middle"
        known = f", id {box.label_id} of the labels" if box.label_id is not None else ""
        return f"Painted by {box.text}{known}. Its footprint {where}; it has {box.cells} cells. {box.place_text}"
