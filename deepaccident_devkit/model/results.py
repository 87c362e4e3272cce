"""Results files of a model's predictions, which `deepaccident evaluate` takes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from deepaccident_devkit._version import __version__
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation import ResultsWriter
from deepaccident_devkit.evaluation.results import RESULTS_NAMES, ResultsTask
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.model.network import V2XFormer
from deepaccident_devkit.model.predicting import PredictConfig, predictions
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import AgentConfig


def predict_results(
    model: V2XFormer,
    dataset: Dataset,
    tokens: Sequence[str],
    out: str | os.PathLike[str],
    config: PredictConfig | None = None,
    *,
    progress: bool = False,
) -> dict[ResultsTask, Path]:
    """Predict samples, each once for all tasks, and write the results; nothing is left of a call that breaks off.

    Args:
        model: on the configuration's device.
        dataset: the release.
        tokens: of the samples.
        out: the folder to write into.
        config: who cooperates, and how; None for all agents on the CPU.
        progress: whether to show a bar.

    Returns:
        Task → the file or folder written.

    Raises:
        ResultsError: results are there already, or cannot be written.
        DeepAccidentError: as of `predicting.predictions`.
    """
    config = config or PredictConfig()
    folder = writable_folder(out)
    paths = {task: folder / name for task, name in RESULTS_NAMES.items()}
    meta = _meta(model, dataset, config)
    labels = model.config.labels
    form: dict[str, Any] = {
        "grid": labels.grid,
        "step": labels.step * FRAME_PERIOD,
        "labels": model.config.labels_protocol,
    }
    with ExitStack() as stack:
        writers = {
            task: ResultsWriter(path, task, meta=meta, **(form if task == "motion" else {}))
            for task, path in paths.items()
        }
        for writer in writers.values():
            stack.enter_context(writer)
        for found in predictions(model, dataset, tokens, config, progress=progress):
            writers["motion"].add(found.token, found.motion)
            writers["accident"].add(found.token, found.accidents)
            writers["detection"].add(found.token, found.boxes)
    return paths


def _meta(model: V2XFormer, dataset: Dataset, config: PredictConfig) -> dict[str, Any]:
    """The notes in the results."""
    agents = config.agents.name if isinstance(config.agents, AgentConfig) else config.agents
    return {
        "method": "V2XFormer of the devkit",
        "model": dict(model.notes),
        "agents": agents if agents is None or isinstance(agents, str) else list(agents),
        "link": None if config.link is None else asdict(config.link),
        "seed": config.seed,
        "release": {"version": dataset.version, "index": dataset.tables_folder.name},
        "devkit": __version__,
    }
