"""Results without a file: predictions held in memory, for tests of what reads results."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results import MotionForm


@dataclass(frozen=True)
class MemoryResults:
    """What `evaluation.results.Results` offers to loaders.

    Attributes:
        task: of the predictions.
        predictions: by token.
        labels: protocol of the labels that maps were learned from.
    """

    task: str
    predictions: Mapping[str, Any]
    labels: str | None = "released"

    @property
    def path(self) -> Path:
        """Where a file would be."""
        return Path("memory")

    @property
    def form(self) -> MotionForm | None:
        """Of the first prediction."""
        one = next(iter(self.predictions.values()))
        if not isinstance(one, MotionOutput):
            return None
        stored, maps = "instances", one.instances
        frames = len(one.heads[0].segmentation) if maps is None else maps.shape[1]
        if maps is None:
            stored = "heads"
        return MotionForm(
            stored=stored, grid=one.grid, predictions=len(one), frames=frames, labels=self.labels
        )

    def prediction(self, token: str) -> Any:
        """As it was given."""
        return self.predictions[token]
