"""The cells of a study: releases, weights of each seed, rows of each seed. Each is made once, and kept under its key.

A key is a digest of all that decides a cell: its part of the recipe, the keys of the cells that it stands on, and the
devkit's version. So a study that is run again makes what is not there: after a kill the rest, after a change of the
recipe what has changed; and studies with the same folder share what they have in common. The folder has

    release/KEY         a release that was made
    weights/KEY         a training, which goes on from its own last checkpoint
    row/KEY             a row's results files, as `deepaccident predict` writes them
    splits/DIGEST.txt   a list of scenarios
    cells/              the store of what is done: notes, and the counts of each row
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

# Makes a cell in its folder, and gives what is kept of it, as JSON holds it.
_Work = Callable[[Path], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Bench:
    """Where cells are made; cheap to pickle.

    Attributes:
        out: the folder; absolute.
        device: of models.
    """

    out: Path
    device: str = "cpu"

    @property
    def store(self) -> Store:
        """What is done."""
        return Store(self.out / "cells", self.out, "makes cells of a study", ConfigError)

    def cell(self, kind: str, name: str, work: _Work, **decides: Any) -> StudyCell:
        """A cell, with all that decides it, as JSON holds it."""
        return StudyCell(
            self, kind, name, digest_of({"devkit": __version__, "kind": kind, **decides}), work
        )

    def split(self, scenarios: Sequence[str]) -> Path:
        """A split file of scenarios, named by what it holds."""
        path = self.out / "splits" / f"{digest_of(scenarios)}.txt"
        write_split_file(path, scenarios)
        return path

    def make(
        self, cells: Iterable[StudyCell], label: str, reads: tuple[Path, ...], **how: Unpack[Engine]
    ) -> None:
        """Make the cells that are not there, those of one key once; raises SomeFailedError and more, as `Store.run`.

        `reads` are folders outside that workers must see.
        """
        missing = {f"{each.kind}/{each.key}": each for each in cells if each.kept is None}
        self.store.run(
            make, missing, label=label, places=Places(reads=reads, writes=(self.out,)), **how
        )


@dataclass(frozen=True, slots=True)
class StudyCell:
    """A cell; cheap to pickle.

    Attributes:
        bench: where it is made.
        kind: `release`, `weights` or `row`.
        name: in the recipe, with the seed.
        key: the digest of all that decides it.
        work: makes it.
    """

    bench: Bench
    kind: str
    name: str
    key: str
    work: _Work

    @property
    def folder(self) -> Path:
        """Of its files."""
        return self.bench.out / self.kind / self.key

    @property
    def kept(self) -> dict[str, Any] | None:
        """What was kept of it; None if it, or its folder, is not there."""
        content = self.bench.store.kept(f"{self.kind}/{self.key}", self.key, "results")
        if content is None or not self.folder.is_dir():
            return None
        told: dict[str, Any] = parsed_json(gzip.decompress(content), constants=True)
        return told


def make(cell: StudyCell) -> None:
    """Make a cell, if it is not there; its error names it."""
    if cell.kept is not None:
        return
    began = time.monotonic()
    try:
        told = cell.work(cell.folder)
    except DeepAccidentError as error:
        raise type(error)(f"{cell.name}: {error}") from error
    notes = {
        "seconds": round(time.monotonic() - began, 1),
        "machine": machine(cell.bench.device),
        **told,
    }
    cell.bench.store.keep(
        f"{cell.kind}/{cell.key}", cell.key, gzip.compress(json.dumps(notes).encode(), mtime=0)
    )


def machine(device: str) -> str:
    """What one needs to know of a machine to understand times and last digits."""
    torch = sys.modules.get("torch")
    packages = f"numpy {np.__version__}" + (f", torch {torch.__version__}" if torch else "")
    return f"{platform.platform()}, {usable_cores()} cores, Python {platform.python_version()}, {packages}, {device}"


def taken(file: Path, folder: Path) -> dict[str, Any]:
    """The work on weights that are there: a copy of them, so that they stay as they are."""
    from deepaccident_devkit.plugins.model.checkpoint import FINAL

    write_bytes(folder / FINAL, read_bytes(file, "weights"))
    return {}


def trained(
    dataset: DeepAccident,
    choice: ModelChoice,
    config: TrainConfig,
    start: Path | None,
    also: SecondSource | None,
    device: str,
    folder: Path,
) -> dict[str, Any]:
    """The work on weights that are trained, on a release or two, from others or from random ones (None).

    It notes the mean loss of the last 50 steps, and the seconds of all, before a kill too.
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
class Counting:
    """The work on a row with one seed: its samples are predicted and counted.

    Attributes:
        dataset: the release of the test.
        row: of the recipe.
        selection: the samples.
        labels: of which motion is predicted, as far ahead as the row looks.
        weights: of a model.
        device: where it is.
    """

    dataset: DeepAccident
    row: StudyRow
    selection: SampleSelection
    labels: MotionLabelConfig
    weights: Path | None
    device: str

    def __call__(self, folder: Path) -> dict[str, Any]:
        """Write the results files, if they are not there; `counts`: what evaluates them → token → counts."""
        if not folder.is_dir():
            self._predict(folder)
        dataset, counts, hidden = self.dataset, {}, HiddenActors()
        for task, setup in self._setups.items():
            if task == "accident" and dataset.layout == "nuScenes":
                continue  # it has none
            run = evaluate_results(
                dataset, folder / RESULTS_NAMES[task], setup, self.selection, workers=1
            )
            counts[str(task)] = dict(run.evaluator.counts)
        motion, boxes = (
            read_results(folder / RESULTS_NAMES[task]) for task in ("motion", "detection")
        )
        for token in self.selection.tokens(dataset):
            moved, found = (
                cast("Any", motion.prediction(token)),
                cast("Any", boxes.prediction(token)),
            )
            own = found.boxes.transform(dataset.world_from(token, "ego").inverse(), "ego")
            hidden.update(
                token, dataset, self.labels, moved, DetectedBoxes(boxes=own, scores=found.scores)
            )
        return {"counts": {**counts, HIDDEN: dict(hidden.counts)}}

    @property
    def _setups(self) -> Mapping[ResultsTask, EvaluationSetup]:
        horizon = self.labels.future_frames * self.labels.step * FRAME_PERIOD
        return setups_of(str(self.labels.protocol), horizon)

    def _predict(self, place: Path) -> None:
        labels, tokens, dataset = self.labels, self.selection.tokens(self.dataset), self.dataset
        motion: Any = {
            "grid": labels.grid,
            "step": labels.step * FRAME_PERIOD,
            "labels": labels.protocol,
        }
        meta = {"method": self.row.name, "devkit": __version__}
        with replacing_folder(place) as folder, ExitStack() as stack:
            writers = [
                ResultsWriter(
                    folder / RESULTS_NAMES[task],
                    task,
                    meta=meta,
                    **(motion if task == "motion" else {}),
                )
                for task in self._setups
            ]
            for writer in writers:
                stack.enter_context(writer)
            for token, found in predictions_of(
                self.row, self.weights, self.device, dataset, tokens, labels
            ):
                for writer, each in zip(writers, cast("Any", found), strict=True):
                    writer.add(token, each)
