"""A replay among many: where one cannot be made, the others are."""

from __future__ import annotations

from pathlib import Path

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError, SensorFileError
from deepaccident_devkit.render.replay.replay import render_replay
from deepaccident_devkit.render.replay.verdicts import Foreseen


def tried_replay(dataset: Dataset, scenario: str, path: Path, *, prediction: Foreseen | None = None) -> str | None:
    """Write a scenario's replay; None, or why there is none: a file cannot be read, or the prediction not be shown.

    Args:
        dataset: the release.
        scenario: token.
        path: the file to write.
        prediction: as of `render_replay`.
    """
    try:
        render_replay(dataset, scenario, path, prediction=prediction)
    except (NotAvailableError, SensorFileError) as error:
        return str(error)
    return None
