"""Offer results without a file: predictions held in memory, for tests of what reads results."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results import MotionForm


@dataclass(frozen=True)
class MemoryResults:
    """Stands in for `evaluation.results.Results` where a loader reads it.

    Attributes:
        task: Task of the predictions.
        predictions: Predictions by sample token.
        labels: Protocol of the labels that maps were learned from.
    """

    task: str
    predictions: Mapping[str, Any]
    labels: str | None = "released"

    @property
    def path(self) -> Path:
        """Return where a file would lie."""
        return Path("memory")

    @property
    def form(self) -> MotionForm | None:
        """Return the form of the first prediction, None unless it is of motion."""
        output = next(iter(self.predictions.values()))
        if not isinstance(output, MotionOutput):
            return None
        if output.instances is None:
            stored = "heads"
            frames = len(output.heads[0].segmentation)
        else:
            stored = "instances"
            frames = output.instances.shape[1]
        return MotionForm(
            stored=stored,
            grid=output.grid,
            predictions=len(output),
            frames=frames,
            labels=self.labels,
        )

    def prediction(self, token: str) -> Any:
        """Return the prediction of a sample, unchanged."""
        return self.predictions[token]
