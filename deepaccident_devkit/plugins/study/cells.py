"""The cells of a study, each made once and stored: releases, and each seed's weights and rows.

A cell's key is a digest of everything that determines it: its part of the recipe, the keys of the
cells that it depends on, and the devkit's version. A study that runs again thus only makes missing
cells: after a kill the remaining ones, after a change of the recipe those that it affects. Studies
in the same folder share their common cells. The folder contains

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
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.plugins.model import ModelChoice, SecondSource, TrainConfig
    from deepaccident_devkit.support.parallel import Engine

# Notes of a cell, which can be written as JSON.
Notes = dict[str, Any]
# Function that makes a cell in its folder, and returns its notes.
_MakeCell = Callable[[Path], Notes]


@dataclass(frozen=True, slots=True)
class Workspace:
    """The folder in which cells are made, and the device; cheap to pickle.

    Attributes:
        out: Absolute path of the folder.
        device: Device on which models run.
    """

    out: Path
    device: str = "cpu"

    @property
    def store(self) -> Store:
        """The store of finished cells."""
        return Store(self.out / "cells", self.out, "is computing cells of a study", ConfigError)

    def cell(self, kind: str, name: str, work: _MakeCell, **decides: Any) -> StudyCell:
        """Describe a cell; `decides` is everything that determines its content, as JSON values."""
        key = digest_of({"devkit": __version__, "kind": kind, **decides})
        return StudyCell(self, kind, name, key, work)

    def split(self, scenarios: Sequence[str]) -> Path:
        """Write a split file whose name is a digest of its content; return its path."""
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
        """Make the missing cells; cells with equal keys are only made once.

        Args:
            cells: The cells.
            label: What is made; shown by the progress bar.
            reads: Folders outside the workspace that workers read from.
            **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

        Raises:
            SomeFailedError: If some cells failed; the others are finished.
            DeepAccidentError: For the reasons in `Store.run`.
        """
        missing_cells = {}
        for cell in cells:
            if cell.notes is None:
                missing_cells[cell.store_name] = cell
        places = Places(reads=reads, writes=(self.out,))
        self.store.run(make_cell, missing_cells, label=label, places=places, **engine)


@dataclass(frozen=True, slots=True)
class StudyCell:
    """A cell of a study; cheap to pickle.

    Attributes:
        workspace: The folder in which it is made, and the device.
        kind: `release`, `weights` or `row`.
        name: Name in the recipe, with the seed.
        key: Digest of everything that determines the cell.
        work: Function that makes the cell.
    """

    workspace: Workspace
    kind: str
    name: str
    key: str
    work: _MakeCell

    @property
    def store_name(self) -> str:
        """The cell's name in the store, which is also the path of its folder."""
        return f"{self.kind}/{self.key}"

    @property
    def folder(self) -> Path:
        """The folder that contains the cell's files."""
        return self.workspace.out / self.store_name

    @property
    def notes(self) -> Notes | None:
        """The stored notes of the cell; None if they or its folder are missing."""
        content = self.workspace.store.read_result(self.store_name, self.key, "results")
        if content is None or not self.folder.is_dir():
            return None
        notes: Notes = parsed_json(gzip.decompress(content), constants=True)
        return notes


def make_cell(cell: StudyCell) -> None:
    """Make a cell if it is missing; errors get its name as a prefix."""
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
    cell.workspace.store.write_result(cell.store_name, cell.key, content)


def machine_text(device: str) -> str:
    """Describe the machine, to explain durations and differences in the last digits."""
    torch = sys.modules.get("torch")
    packages = f"numpy {np.__version__}"
    if torch:
        packages += f", torch {torch.__version__}"
    python = f"Python {platform.python_version()}"
    return f"{platform.platform()}, {usable_cores()} cores, {python}, {packages}, {device}"


def copy_weights(file: Path, folder: Path) -> Notes:
    """Copy existing weights into a cell's folder, so that the original may change later."""
    from deepaccident_devkit.plugins.model.checkpoint import FINAL_FILE

    weights = read_bytes(file, "weights")
    write_bytes(folder / FINAL_FILE, weights)
    return {}


def train_weights(
    dataset: DeepAccident,
    choice: ModelChoice,
    config: TrainConfig,
    start: Path | None,
    also: SecondSource | None,
    device: str,
    folder: Path,
) -> Notes:
    """Train weights on one or two releases.

    Args:
        dataset: The release to learn from.
        choice: The model.
        config: The training settings.
        start: Weights to start from; None for random ones.
        also: A second release to learn from; None for none.
        device: Device on which the model runs.
        folder: Folder of the training.

    Returns:
        Mean loss of the last 50 steps, and duration of all steps in seconds, also before a kill.
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
    """The work on one row with one seed: predict the samples, and count the results.

    Attributes:
        dataset: The release on which it is tested.
        row: The row of the recipe.
        selection: The selected samples.
        labels: Config of the motion labels to predict, with the row's horizon.
        weights: Weights of the model; None if the row has no model.
        device: Device of the model.
    """

    dataset: DeepAccident
    row: StudyRow
    selection: SampleSelection
    labels: MotionLabelConfig
    weights: Path | None
    device: str

    def __call__(self, folder: Path) -> Notes:
        """Write the results files if they are missing, and evaluate them.

        The returned notes have `counts`: evaluator → token → counts.
        """
        if not folder.is_dir():
            self._write_results(folder)
        counts = {}
        for task, setup in self._evaluation_setups.items():
            if task == "accident" and self.dataset.layout == "nuScenes":
                continue  # nuScenes contains no accidents
            path = folder / RESULTS_NAMES[task]
            run = evaluate_results(self.dataset, path, setup, self.selection, workers=1)
            counts[str(task)] = dict(run.evaluator.counts)
        counts[HIDDEN] = self._hidden_actor_counts(folder)
        return {"counts": counts}

    def _hidden_actor_counts(self, folder: Path) -> NamedValues:
        """Count hidden actors; return sample token → counts."""
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
    def _evaluation_setups(self) -> Mapping[ResultsTask, EvaluationSetup]:
        horizon = self.labels.future_frames * self.labels.step * FRAME_PERIOD
        return setups_of(str(self.labels.protocol), horizon)

    def _write_results(self, path: Path) -> None:
        """Predict all samples, and write one results file per task into a new folder."""
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
            for task in self._evaluation_setups:
                options = motion_options if task == "motion" else {}
                results_path = folder / RESULTS_NAMES[task]
                writers.append(ResultsWriter(results_path, task, meta=meta, **options))
            for writer in writers:
                stack.enter_context(writer)
            predictions = predictions_of(
                self.row, self.weights, self.device, self.dataset, tokens, labels
            )
            for token, outputs in predictions:
                for writer, output in zip(writers, cast("Any", outputs), strict=True):
                    writer.add(token, output)
