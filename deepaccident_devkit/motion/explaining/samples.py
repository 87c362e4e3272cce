"""`explain_cell`: the same of a sample of a release, with the tokens of what it names."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from deepaccident_devkit.arrays import BoolArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.motion.cells.explanation import CellExplanation
from deepaccident_devkit.motion.cells.parts import CellBox
from deepaccident_devkit.motion.explaining.cells import explain_cell_from_boxes
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.sample_boxes import sample_boxes
from deepaccident_devkit.tables.opened import token_of


@dataclass(frozen=True, slots=True)
class SampleOrigin:
    """The sample that labels were made from, so that they can explain themselves.

    Attributes:
        dataset: the release.
        sample: token.
    """

    dataset: Dataset
    sample: str

    def explain(self, labels: MotionLabels, t: int, row: int, col: int, *, prediction: object) -> CellExplanation:
        """Explain a cell of the labels, as `MotionLabels.explain`."""
        return explain_cell(labels, t, row, col, dataset=self.dataset, sample=self.sample, prediction=prediction)


def explain_cell(
    labels: MotionLabels,
    t: int,
    row: int,
    col: int,
    *,
    dataset: Dataset,
    sample: RowArgument,
    prediction: object = None,
) -> CellExplanation:
    """How a cell of a sample's labels came to its values: `MotionLabels.explain` for labels that were read from files.

    Args:
        labels: of `sample`, from `LabelFiles`, another code's batches, or anywhere else.
        t: label frame, as in the arrays; 0 is the present.
        row: of the cell, in the labels' orientation.
        col: its column.
        dataset: the release that they were made from.
        sample: token or record.
        prediction: what a model put there, in any of the forms that `MotionLabels.explain` takes.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, or an agent whose sight counts is not in this release.
        ConfigError: the labels have other missing frames than the sample; they are of another one.
        GeometryError: there is no such cell, or the prediction has another shape.
    """
    token = token_of(sample)
    source = sample_boxes(dataset, token, labels.config)
    if not np.array_equal(source.valid, labels.valid):
        raise ConfigError(
            f"labels: have the frames {_marks(labels.valid)}, {token} has {_marks(source.valid)} (1: in the "
            "recording); give the sample that they were made from"
        )
    found = explain_cell_from_boxes(
        labels, source.frames, t, row, col, is_vehicle=source.is_vehicle, prediction=prediction
    )
    frame = _frame_sample(token, found, labels)

    def named(box: CellBox) -> CellBox:
        if box.row is None:
            return box
        annotation = f"{frame}/{box.row}"
        return replace(box, annotation=annotation, instance=dataset.get("annotation", annotation)["instance_token"])

    return replace(
        found,
        sample=token,
        frame_sample=frame,
        painter=None if found.painter is None else named(found.painter),
        nearest=None if found.nearest is None else named(found.nearest),
        covered=tuple(map(named, found.covered)),
        left_out=tuple(map(named, found.left_out)),
    )


def _frame_sample(sample: str, found: CellExplanation, labels: MotionLabels) -> str | None:
    if not found.recorded:
        return None
    recording, number = sample.rsplit("/", 1)
    return f"{recording}/{int(number) + found.t * labels.config.step:03d}"


def _marks(valid: BoolArray) -> str:
    return "".join("1" if one else "0" for one in valid)
