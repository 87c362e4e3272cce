"""The cells of a study, each made once and stored: releases, and weights and rows of each seed.

A cell's key is a digest of everything that decides it: its part of the recipe, the keys of the
cells that it depends on, and the devkit's version. So a study that runs again only makes what is
missing: after a kill the remaining cells, after a change of the recipe the changed ones; and
studies with the same folder share their common cells. The folder has

    release/KEY         a synthetic release
    weights/KEY         a training, which resumes from its latest checkpoint
    row/KEY             a row's results files, as `deepaccident predict` writes them
    splits/DIGEST.txt   a list of scenarios
    cells/              the store of finished cells: notes, and the counts of each row
"""

from __future__ import annotations

import gzip
import json
import platform
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError, DeepAccidentError
from deepaccident_devkit.evaluation import DetectedBoxes, ResultsWriter, read_results
from deepaccident_devkit.evaluation.results import RESULTS_NAMES, ResultsTask
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.study.numbers import HIDDEN, HiddenActors, setups_of
from deepaccident_devkit.plugins.study.predict import predictions_of
from deepaccident_devkit.plugins.study.recipe import StudyRow
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.release.layout import write_split_file
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.files import replacing_folder, write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.parallel import Places, Store
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.plugins.model import ModelChoice, SecondSource, TrainConfig
    from deepaccident_devkit.support.parallel import Engine

# Makes a cell in its folder and returns its notes, as JSON holds them.
_Work = Callable[[Path], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Workspace:
    """The folder and the device that cells are made with; cheap to pickle.

    Attributes:
        out: Absolute path of the folder.
        device: Device of models.
    """

    out: Path
    device: str = "cpu"

    @property
    def store(self) -> Store:
        """The store of finished cells."""
        return Store(self.out / "cells", self.out, "makes cells of a study", ConfigError)

    def cell(self, kind: str, name: str, work: _Work, **decides: Any) -> StudyCell:
        """Return a cell; `decides` is everything that decides it, as JSON holds it."""
        key = digest_of({"devkit": __version__, "kind": kind, **decides})
        return StudyCell(self, kind, name, key, work)

    def split(self, scenarios: Sequence[str]) -> Path:
        """Write a split file of scenarios, named by a digest of its content; return its path."""
        path = self.out / "splits" / f"{digest_of(scenarios)}.txt"
        write_split_file(path, scenarios)
        return path

    def make_cells(
        self,
        cells: Iterable[StudyCell],
        label: str,
        reads: tuple[Path, ...],
        **engine: Unpack[Engine],
    ) -> None:
        """Make the missing cells; cells with the same key are made once.

        `reads` are folders outside the workspace that workers read. Raises SomeFailedError, and the
        errors of `Store.run`.
        """
        missing = {}
        for cell in cells:
            if cell.notes is None:
                missing[f"{cell.kind}/{cell.key}"] = cell
        places = Places(reads=reads, writes=(self.out,))
        self.store.run(make_cell, missing, label=label, places=places, **engine)


@dataclass(frozen=True, slots=True)
class StudyCell:
    """A cell; cheap to pickle.

    Attributes:
        workspace: The folder and the device to make it with.
        kind: `release`, `weights` or `row`.
        name: Name in the recipe, with the seed.
        key: Digest of everything that decides the cell.
        work: Function that makes the cell.
    """

    workspace: Workspace
    kind: str
    name: str
    key: str
    work: _Work

    @property
    def folder(self) -> Path:
        """The folder of its files."""
        return self.workspace.out / self.kind / self.key

    @property
    def notes(self) -> dict[str, Any] | None:
        """The stored notes of the cell; None if they or its folder are missing."""
        content = self.workspace.store.kept(f"{self.kind}/{self.key}", self.key, "results")
        if content is None or not self.folder.is_dir():
            return None
        notes: dict[str, Any] = parsed_json(gzip.decompress(content), constants=True)
        return notes


def make_cell(cell: StudyCell) -> None:
    """Make a cell if it is missing; errors are prefixed with its name."""
    if cell.notes is not None:
        return
    start_time = time.monotonic()
    try:
        work_notes = cell.work(cell.folder)
    except DeepAccidentError as error:
        raise type(error)(f"{cell.name}: {error}") from error
    notes = {
        "seconds": round(time.monotonic() - start_time, 1),
        "machine": machine_text(cell.workspace.device),
        **work_notes,
    }
    content = gzip.compress(json.dumps(notes).encode(), mtime=0)
    cell.workspace.store.keep(f"{cell.kind}/{cell.key}", cell.key, content)


def machine_text(device: str) -> str:
    """Return a description of the machine, which explains durations and last digits."""
    torch = sys.modules.get("torch")
    packages = f"numpy {np.__version__}" + (f", torch {torch.__version__}" if torch else "")
    python = f"Python {platform.python_version()}"
    return f"{platform.platform()}, {usable_cores()} cores, {python}, {packages}, {device}"


def copy_weights(file: Path, folder: Path) -> dict[str, Any]:
    """Copy existing weights into a cell's folder, so that the file may change later."""
    from deepaccident_devkit.plugins.model.checkpoint import FINAL_FILE

    write_bytes(folder / FINAL_FILE, read_bytes(file, "weights"))
    return {}


def train_weights(
    dataset: DeepAccident,
    choice: ModelChoice,
    config: TrainConfig,
    start: Path | None,
    also: SecondSource | None,
    device: str,
    folder: Path,
) -> dict[str, Any]:
    """Train weights on one or two releases, from other weights or from random ones (`start` None).

    Returns the mean loss of the last 50 steps, and the seconds of all steps, including steps before
    a kill.
    """
    from deepaccident_devkit.plugins.model import train
    from deepaccident_devkit.plugins.model.training_run import one_thread, read_log

    with one_thread():
        train(dataset, folder, choice, config, weights=start, device=device, also=also)
    log = read_log(folder)
    return {
        "loss": fmean(row["loss"] for row in log[-50:]),
        "seconds": round(sum(row["seconds"] for row in log), 1),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class RowEvaluation:
    """The work on a row with one seed: its samples are predicted and counted.

    Attributes:
        dataset: The release of the test.
        row: The row of the recipe.
        selection: The selected samples.
        labels: Config of the motion labels that are predicted; it has the row's horizon.
        weights: Weights of a model; None without a model.
        device: Device of the model.
    """

    dataset: DeepAccident
    row: StudyRow
    selection: SampleSelection
    labels: MotionLabelConfig
    weights: Path | None
    device: str

    def __call__(self, folder: Path) -> dict[str, Any]:
        """Write the results files, if they are missing, and count them.

        Returns `counts`: evaluator → token → counts.
        """
        if not folder.is_dir():
            self._write_results(folder)
        counts = {}
        for task, setup in self._setups.items():
            if task == "accident" and self.dataset.layout == "nuScenes":
                continue  # nuScenes has no accidents
            path = folder / RESULTS_NAMES[task]
            run = evaluate_results(self.dataset, path, setup, self.selection, workers=1)
            counts[str(task)] = dict(run.evaluator.counts)
        counts[HIDDEN] = self._hidden_actor_counts(folder)
        return {"counts": counts}

    def _hidden_actor_counts(self, folder: Path) -> dict[str, Any]:
        """Return the counts of hidden actors by sample token."""
        hidden_actors = HiddenActors()
        motion_results = read_results(folder / RESULTS_NAMES["motion"])
        detection_results = read_results(folder / RESULTS_NAMES["detection"])
        for token in self.selection.tokens(self.dataset):
            motion = cast("Any", motion_results.prediction(token))
            detections = cast("Any", detection_results.prediction(token))
            ego_from_world = self.dataset.world_from(token, "ego").inverse()
            ego_detections = DetectedBoxes(
                boxes=detections.boxes.transform(ego_from_world, "ego"), scores=detections.scores
            )
            hidden_actors.update(token, self.dataset, self.labels, motion, ego_detections)
        return dict(hidden_actors.counts)

    @property
    def _setups(self) -> Mapping[ResultsTask, EvaluationSetup]:
        horizon = self.labels.future_frames * self.labels.step * FRAME_PERIOD
        return setups_of(str(self.labels.protocol), horizon)

    def _write_results(self, path: Path) -> None:
        """Predict all samples and write one results file a task into a new folder."""
        labels = self.labels
        tokens = self.selection.tokens(self.dataset)
        meta = {"method": self.row.name, "devkit": __version__}
        motion_options: Any = {
            "grid": labels.grid,
            "step": labels.step * FRAME_PERIOD,
            "labels": labels.protocol,
        }
        with replacing_folder(path) as folder, ExitStack() as stack:
            writers = []
            for task in self._setups:
                options = motion_options if task == "motion" else {}
                writers.append(
                    ResultsWriter(folder / RESULTS_NAMES[task], task, meta=meta, **options)
                )
            for writer in writers:
                stack.enter_context(writer)
            predictions = predictions_of(
                self.row, self.weights, self.device, self.dataset, tokens, labels
            )
            for token, outputs in predictions:
                for writer, output in zip(writers, cast("Any", outputs), strict=True):
                    writer.add(token, output)
