"""`train`: from a release to a folder with weights, log and curves; a killed run goes on where it was."""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.optim import AdamW
from tqdm.auto import tqdm

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.checkpoint import (
    BEST,
    FINAL,
    load_weights,
    read_weights,
    write_weights,
)
from deepaccident_devkit.plugins.model.loading import worker_faults_named
from deepaccident_devkit.plugins.model.network import V2XFormer
from deepaccident_devkit.plugins.model.presets import ModelChoice
from deepaccident_devkit.plugins.model.results import PredictConfig, check_sensor_files
from deepaccident_devkit.plugins.model.training_run import (
    RunProcess,
    SecondSource,
    TrainConfig,
    TrainingProgress,
    add_to_log,
    cut_log,
    load_state,
    processes,
    read_log,
    save_state,
)
from deepaccident_devkit.plugins.model.training_step import (
    SCORE,
    MixedMoments,
    Moments,
    TrainingStep,
    batches,
    freeze,
    generator_of,
    learning_rate,
    optimizer_of,
    training_batch,
    validated,
    validation_samples,
    with_dropped_partners,
)
from deepaccident_devkit.render.training import save_training
from deepaccident_devkit.support.files import writable_folder, write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import differing_text
from deepaccident_devkit.support.version import __version__

logger = logging.getLogger(__name__)
RUN: Final = "run.json"
CURVES: Final = "curves.png"
Say = Callable[[str], None]


def train(  # noqa: PLR0913 - on what, to where, what, how, from what, and on which machine
    dataset: Dataset,
    out: str | os.PathLike[str],
    choice: ModelChoice,
    config: TrainConfig | None = None,
    *,
    weights: str | os.PathLike[str] | None = None,
    device: str = "auto",
    workers: int = 0,
    images_cache: str | os.PathLike[str] | None = None,
    also: SecondSource | None = None,
    say: Say | None = None,
) -> Path:
    """Train a model; the same call goes on with a run that was stopped or killed.

    On one CPU, with the same number of threads, a run that was resumed has the bits of one that was not. `torchrun`
    starts it on several GPUs.

    Args:
        dataset: the release.
        out: the run's folder: `run.json`, `log.jsonl`, `curves.png`, `best.safetensors`, `last.safetensors`.
        choice: the preset and its changes.
        config: how to train; None for the defaults.
        weights: to begin from (`checkpoint.read_weights`); what they lack begins at random.
        device: `auto`, `cpu`, `cuda`, …
        workers: processes that read; 0 for this one.
        images_cache: of `V2XConfig`.
        also: another source to learn from, whose moments come between those of `dataset`; it is not validated.
        say: told each validation; None for silence, and no progress bar.

    Returns:
        The path of the best weights; the last ones if nothing was validated.

    Raises:
        ConfigError: another run is in the folder, there is no such device, or weights do not fit.
        NotAvailableError: the split has no labelled samples, or the release lacks what the model sees with.
        WorkerError: a worker process was killed, or cannot send what it has read.
        DeepAccidentError: as of `AllEgosDataset`.
    """
    config = TrainConfig() if config is None else config
    with processes(device) as place:
        say = say if place.is_first else None
        folder = writable_folder(out)
        moments: Moments | MixedMoments = (first := _moments(dataset, choice, config, images_cache))
        if also is not None:
            there = replace(
                config, split=also.split, agents="available"
            )  # nuScenes has no partners
            moments = MixedMoments((first, _moments(also.dataset, choice, there, None)), also.mix)
        run = _Run(
            folder=folder,
            notes=_notes(dataset, choice, config, weights)
            | ({"also": also.as_dict()} if also else {}),
            dataset=dataset,
            moments=moments,
            validated=validation_samples(dataset, config),
            config=config,
            place=place,
            predict=PredictConfig(
                agents=config.agents,
                device=place.device,
                workers=workers,
                images_cache=images_cache,
            ),
            say=say or (lambda _text: None),
            bar=say is not None,
        )
        model = new_model(choice, config, weights, run.say)  # what is refused leaves no run behind
        if place.is_first:
            _claim(folder, run.notes)
        with worker_faults_named():
            return run.trained(model.to(place.device))


def _moments(
    dataset: Dataset, choice: ModelChoice, config: TrainConfig, images_cache: Any
) -> Moments:
    """Those of a source that has what the model sees with."""
    moments = Moments(dataset, choice.config, config, images_cache=images_cache)
    check_sensor_files(choice.config, dataset, moments.data.egos[0])
    return moments


def new_model(
    choice: ModelChoice, config: TrainConfig, weights: str | os.PathLike[str] | None, say: Say
) -> V2XFormer:
    """The model before the first step."""
    torch.manual_seed(config.seed)
    model = V2XFormer(choice.config)
    if weights is not None:
        say(f"{weights}: {load_weights(model, read_weights(weights)).to_text()}")
    freeze(model, config.freeze)
    return model


def _notes(
    dataset: Dataset,
    choice: ModelChoice,
    config: TrainConfig,
    weights: str | os.PathLike[str] | None,
) -> dict[str, Any]:
    """What a run notes of itself, and what must be the same to go on with it."""
    return {
        **choice.as_dict(),
        "training": config.as_dict(),
        "from": None if weights is None else os.fspath(weights),
        "release": {"version": dataset.version, "index": dataset.tables_folder.name},
        "devkit": __version__,
    }


def _claim(folder: Path, notes: Mapping[str, Any]) -> None:
    """Write a run's notes, or compare them with those that are there; raises ConfigError if they differ."""
    path = folder / RUN
    if path.is_file():
        try:
            there = parsed_json(read_bytes(path, "bundle"))
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{path}: cannot be read ({fault_text(error)}); remove it, or train elsewhere"
            ) from error
        if text := differing_text(there if isinstance(there, dict) else {}, notes):
            raise ConfigError(
                f"{path}: is of another run ({text}); give the same options to go on with it, or another folder"
            )
        return
    write_bytes(path, json.dumps(notes, indent=1).encode())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Run:
    """A run on one process."""

    folder: Path
    notes: Mapping[str, Any]
    dataset: Dataset
    moments: Moments | MixedMoments
    validated: Sequence[str]
    config: TrainConfig
    place: RunProcess
    predict: PredictConfig
    say: Say
    bar: bool

    def trained(self, model: V2XFormer) -> Path:
        """Take all steps that are left."""
        optimizer = optimizer_of(model, self.config)
        progress = load_state(self.folder, model, optimizer, self.config.steps)
        step = self._wrapped(model)
        if self.place.is_first:
            cut_log(self.folder, progress.step)
        numbers = self.moments.numbers(
            self.config,
            first=progress.step * self.config.moments,
            rank=self.place.rank,
            ranks=self.place.ranks,
        )
        given = batches(self.moments, numbers, self.config, workers=self.predict.workers)
        steps = range(progress.step, self.config.steps)
        with tqdm(
            steps, initial=progress.step, total=self.config.steps, unit="step", disable=not self.bar
        ) as bar:
            for number in bar:
                row = self._step(number, step, optimizer, given)
                bar.set_postfix(loss=f"{row['loss']:.3g}")
                progress = self._after(number + 1, row, model, optimizer, progress)
        best = self.folder / BEST
        return best if best.is_file() else self._weights(model, progress)

    def _wrapped(self, model: V2XFormer) -> nn.Module:
        if self.place.ranks == 1:
            return TrainingStep(model)
        if self.place.device.startswith("cuda"):
            model = nn.SyncBatchNorm.convert_sync_batchnorm(model)
        return DistributedDataParallel(TrainingStep(model))

    def _step(self, number: int, step: nn.Module, optimizer: AdamW, given: Any) -> dict[str, Any]:
        """One step of the optimizer; all that is random depends on its number."""
        began = time.perf_counter()
        step.train()
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(number, self.config)
        optimizer.zero_grad(set_to_none=True)
        asked = time.perf_counter()
        batch = next(given)
        waited = time.perf_counter() - asked
        losses = self._losses(step, batch, number)
        torch.stack(list(losses.values())).sum().backward()
        trained = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        norm = float(nn.utils.clip_grad_norm_(trained, self.config.clip))
        optimizer.step()
        values = {name: float(loss.detach()) for name, loss in losses.items()}
        return {
            "step": number + 1,
            "loss": sum(values.values()),
            "losses": values,
            "rate": learning_rate(number, self.config),
            "norm": norm,
            "seconds": time.perf_counter() - began,
            "waiting": waited,
        }

    def _losses(self, step: nn.Module, batch: Mapping[str, Any], number: int) -> dict[str, Tensor]:
        seeds = (
            self.config.seed,
            number,
            0,
            self.place.rank,
        )  # the 0 keeps the draws of published runs
        generator = generator_of(*seeds)
        torch.manual_seed(generator_of(*seeds).initial_seed())  # dropout, and the latents' noise
        inputs, targets = training_batch(batch, self.moments.model, self.config, generator)
        inputs = with_dropped_partners(inputs, self.config, generator)
        device = self.place.device
        kind = torch.device(device).type
        with torch.autocast(kind, dtype=torch.bfloat16, enabled=self.config.bf16):
            losses: dict[str, Tensor] = step(inputs.to(device), targets.to(device))
        return losses

    def _after(
        self,
        done: int,
        row: dict[str, Any],
        model: V2XFormer,
        optimizer: AdamW,
        progress: TrainingProgress,
    ) -> TrainingProgress:
        """Log a step and, every now and then, validate and save."""
        config, last = self.config, done == self.config.steps
        progress = replace(progress, step=done)
        if self.validated and (done % config.validate_every == 0 or last):
            own = self.validated[self.place.rank :: self.place.ranks]
            scores = validated(model, self.dataset, own, self.predict)
            row["validation"] = scores
            self.say(
                f"step {done:,}: {', '.join(f'{name} {value:.3f}' for name, value in scores.items())}"
            )
            if progress.best is None or scores[SCORE] > progress.best:
                progress = replace(progress, best=scores[SCORE])
                self._weights(model, progress, BEST)
        if self.place.is_first:
            add_to_log(self.folder, row)
            if last or done % config.save_every == 0 or "validation" in row:
                save_state(self.folder, model, optimizer, progress, self.notes)
            if last or "validation" in row:
                save_training(read_log(self.folder), self.folder.name, self.folder / CURVES)
        return progress

    def _weights(self, model: V2XFormer, progress: TrainingProgress, name: str = FINAL) -> Path:
        """Write the weights alone, on the first process."""
        path = self.folder / name
        if self.place.is_first:
            write_weights(
                path,
                model.state_dict(),
                {**self.notes, "step": progress.step, "score": progress.best},
            )
        return path
