"""A scenario as one MCAP file, which Foxglove and rerun open as an interactive 3D scene (the extra `mcap`).

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.mcap import export_mcap

    da = DeepAccident(dataroot="data/DeepAccident")
    export_mcap(da, da.scenario[0], "accident.mcap")

docs/interactive_3d.md lists the topics and says how to view them. Only this package imports mcap, and only when
`export_mcap` is called.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, MissingExtraError
from deepaccident_devkit.export.mcap.config import EPOCH, McapConfig, Predictions
from deepaccident_devkit.support.text import path_of

__all__ = ["EPOCH", "McapConfig", "Predictions", "export_mcap"]


def export_mcap(
    dataset: Dataset,
    scenario: RowArgument,
    path: str | os.PathLike[str],
    *,
    prediction: Predictions | None = None,
    progress: bool = False,
    **choices: Any,
) -> Path:
    """Write a scenario into an MCAP file: poses, images, point clouds, boxes and labels of all agents on one timeline.

    Messages are Foxglove's, as protobuf. Images have the bytes of their files. The same release and choices give the
    same bytes, with the same versions of the libraries. The file is written completely or not at all.

    Args:
        dataset: the release.
        scenario: token or record.
        path: path of the file; an existing file is replaced.
        prediction: results, or a mapping from sample token to prediction; rendered in addition to the labels.
        progress: whether to show a bar.
        **choices: the fields of `McapConfig`: `agents`, `channels`, `frames`, `points`, `motion_labels`.

    Returns:
        The path.

    Raises:
        MissingExtraError: the extra `mcap` is not installed.
        TokenError: no such scenario.
        ChoiceError: no such choice, agent, channel or frame, or the path is a folder.
        NotAvailableError: an agent is not in this (partial) release, or no sample in the file has a prediction.
        SensorFileError: a sensor file cannot be read.
    """
    config = McapConfig.of(**choices)
    target = path_of(path)
    if target.is_dir():
        raise ChoiceError(f"path: expected a file, such as {target / 'accident.mcap'}, found the folder {target}")
    try:
        from deepaccident_devkit.export.mcap.scenario import write_scenario
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "google"):
            raise
        raise MissingExtraError(f"the MCAP export needs {error.name}: in a checkout, pip install '.[mcap]'") from error
    return write_scenario(dataset, scenario, target, config, prediction=prediction, progress=progress)
