"""`train`: from a release to a folder with weights, log and curves; a killed run can be resumed."""

import json
import logging
import os
import time
from collections.abc import Callable, Sequence
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
    BEST_FILE,
    FINAL_FILE,
    load_weights,
    read_weights,
    write_weights,
)
from deepaccident_devkit.plugins.model.loading import name_worker_faults
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
    drop_partners,
    freeze,
    learning_rate,
    make_generator,
    make_optimizer,
    training_batch,
    validate_model,
    validation_samples,
)
from deepaccident_devkit.render.training import save_training
from deepaccident_devkit.support.files import writable_folder, write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import read_bytes, reason_text
from deepaccident_devkit.support.text import PathType, differing_text
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.support.version import __version__

logger = logging.getLogger(__name__)
RUN_FILE: Final = "run.json"
CURVES_FILE: Final = "curves.png"
Say = Callable[[str], None]


def train(  # noqa: PLR0913 - on what, to where, what, how, from what, and on which machine
    dataset: Dataset,
    out: PathType,
    choice: ModelChoice,
    config: TrainConfig | None = None,
    *,
    weights: PathType | None = None,
    device: str = "auto",
    workers: int = 0,
    images_cache: PathType | None = None,
    also: SecondSource | None = None,
    say: Say | None = None,
) -> Path:
    """Train a model; the same call resumes a run that was stopped or killed.

    On one CPU, with the same number of threads, a resumed run gives bit-identical weights to an
    uninterrupted one. `torchrun` starts it on several GPUs.

    Args:
        dataset: The release.
        out: The run's folder: `run.json`, `log.jsonl`, `curves.png`, `best.safetensors`,
            `last.safetensors`.
        choice: The preset and its changes.
        config: Rules of the training; None for the defaults.
        weights: Weights to start from (`checkpoint.read_weights`); missing parts start with random
            weights.
        device: `auto`, `cpu`, `cuda`, …
        workers: Number of processes that read; 0 for this process.
        images_cache: Cache of images, as in `V2XConfig`.
        also: Another source to train on; its moments are interleaved with `dataset`'s, and
            it is not used for validation.
        say: Function that is called with a text after each validation; None for no messages and no
            progress bar.

    Returns:
        The path of the best weights; the last ones if nothing was validated.

    Raises:
        ConfigError: The folder contains another run, there is no such device, or the weights do not
            fit.
        NotAvailableError: The split has no labelled samples, or the release lacks the sensors of
            the model.
        WorkerError: A worker process was killed, or cannot send the data that it has read.
        DeepAccidentError: As in `AllEgosDataset`.
    """
    config = config or TrainConfig()
    with processes(device) as process:
        if not process.is_first:
            say = None
        folder = writable_folder(out)
        own_moments = _find_moments(dataset, choice, config, images_cache)
        moments: Moments | MixedMoments = own_moments
        if also is not None:
            # nuScenes has no partners.
            also_config = replace(config, split=also.split, agents="available")
            also_moments = _find_moments(also.dataset, choice, also_config, None)
            moments = MixedMoments((own_moments, also_moments), also.mix)
        notes = _make_notes(dataset, choice, config, weights)
        if also:
            notes["also"] = also.as_dict()
        run = _Run(
            folder=folder,
            notes=notes,
            dataset=dataset,
            moments=moments,
            validation_tokens=validation_samples(dataset, config),
            config=config,
            process=process,
            predict=PredictConfig(
                agents=config.agents,
                device=process.device,
                workers=workers,
                images_cache=images_cache,
            ),
            say=say or _keep_silent,
            shows_progress=say is not None,
        )
        # Build the model before writing notes, so that wrong settings or weights leave no run
        # behind.
        model = new_model(choice, config, weights, run.say)
        if process.is_first:
            _claim_folder(folder, run.notes)
        with name_worker_faults():
            return run.train_model(model.to(process.device))


def _keep_silent(_text: str) -> None:
    """Ignore a message, for runs without output."""


def _find_moments(
    dataset: Dataset, choice: ModelChoice, config: TrainConfig, images_cache: Any
) -> Moments:
    """Return a source's moments; raise NotAvailableError if it lacks the model's sensors."""
    moments = Moments(dataset, choice.config, config, images_cache=images_cache)
    check_sensor_files(choice.config, dataset, moments.data.egos[0])
    return moments


def new_model(
    choice: ModelChoice, config: TrainConfig, weights: PathType | None, say: Say
) -> V2XFormer:
    """Return the model before the first step."""
    torch.manual_seed(config.seed)
    model = V2XFormer(choice.config)
    if weights is not None:
        loaded = load_weights(model, read_weights(weights))
        say(f"{weights}: {loaded.to_text()}")
    freeze(model, config.freeze)
    return model


def _make_notes(
    dataset: Dataset,
    choice: ModelChoice,
    config: TrainConfig,
    weights: PathType | None,
) -> NamedValues:
    """Return the notes that describe a run; a run is resumed only if they are equal."""
    return {
        **choice.as_dict(),
        "training": config.as_dict(),
        "from": None if weights is None else os.fspath(weights),
        "release": {"version": dataset.version, "index": dataset.tables_folder.name},
        "devkit": __version__,
    }


def _claim_folder(folder: Path, notes: ReadOnlyValues) -> None:
    """Write a run's notes; raise ConfigError if the folder has different ones."""
    path = folder / RUN_FILE
    if not path.is_file():
        write_bytes(path, json.dumps(notes, indent=1).encode())
        return
    try:
        stored_notes = parsed_json(read_bytes(path, "bundle"))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: cannot be read ({reason_text(error)}); remove it, or choose another folder"
        ) from error
    if not isinstance(stored_notes, dict):
        stored_notes = {}
    difference = differing_text(stored_notes, notes)
    if difference:
        raise ConfigError(
            f"{path}: belongs to another run ({difference}); use the same options to continue that "
            "run, or choose another folder"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Run:
    """A run on one process."""

    # Files.
    folder: Path
    notes: ReadOnlyValues
    # Data.
    dataset: Dataset
    moments: Moments | MixedMoments
    validation_tokens: Sequence[str]
    # Rules.
    config: TrainConfig
    process: RunProcess
    predict: PredictConfig
    # Messages.
    say: Say
    shows_progress: bool

    def train_model(self, model: V2XFormer) -> Path:
        """Take all remaining steps, and return the path of the weights."""
        config = self.config
        optimizer = make_optimizer(model, config)
        progress = load_state(self.folder, model, optimizer, config.steps)
        training_step = self._make_training_step(model)
        if self.process.is_first:
            cut_log(self.folder, progress.step)
        numbers = self.moments.numbers(
            config,
            start=progress.step * config.moments,
            rank=self.process.rank,
            ranks=self.process.ranks,
        )
        moment_batches = batches(self.moments, numbers, config, workers=self.predict.workers)
        with tqdm(
            range(progress.step, config.steps),
            initial=progress.step,
            total=config.steps,
            unit="step",
            desc="Training",
            disable=not self.shows_progress,
        ) as bar:
            for number in bar:
                row = self._take_step(number, training_step, optimizer, moment_batches)
                bar.set_postfix(loss=f"{row['loss']:.3g}")
                progress = self._finish_step(number + 1, row, model, optimizer, progress)
        best_path = self.folder / BEST_FILE
        if best_path.is_file():
            return best_path
        return self._write_weights(model, progress)

    def _make_training_step(self, model: V2XFormer) -> nn.Module:
        """Return the model with its losses, connected to the other processes."""
        if self.process.ranks == 1:
            return TrainingStep(model)
        if self.process.device.startswith("cuda"):
            model = nn.SyncBatchNorm.convert_sync_batchnorm(model)
        return DistributedDataParallel(TrainingStep(model))

    def _take_step(
        self, number: int, training_step: nn.Module, optimizer: AdamW, moment_batches: Any
    ) -> NamedValues:
        """Take a step of the optimizer; return its row of the log.

        All random draws depend on the number of the step.
        """
        start_time = time.perf_counter()
        training_step.train()
        rate = learning_rate(number, self.config)
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.zero_grad(set_to_none=True)
        request_time = time.perf_counter()
        batch = next(moment_batches)
        waiting_seconds = time.perf_counter() - request_time
        losses = self._compute_losses(training_step, batch, number)
        total_loss = torch.stack(list(losses.values())).sum()
        total_loss.backward()
        parameters = []
        for group in optimizer.param_groups:
            parameters += group["params"]
        norm = nn.utils.clip_grad_norm_(parameters, self.config.clip)
        optimizer.step()
        loss_values = {name: float(loss.detach()) for name, loss in losses.items()}
        return {
            "step": number + 1,
            "loss": sum(loss_values.values()),
            "losses": loss_values,
            "rate": rate,
            "norm": float(norm),
            "seconds": time.perf_counter() - start_time,
            "waiting": waiting_seconds,
        }

    def _compute_losses(
        self, training_step: nn.Module, batch: ReadOnlyValues, number: int
    ) -> dict[str, Tensor]:
        """Return the losses of a batch by name."""
        # The 0 keeps the random draws of published runs.
        seeds = (self.config.seed, number, 0, self.process.rank)
        generator = make_generator(*seeds)
        torch.manual_seed(generator.initial_seed())  # dropout, and the latents' noise
        inputs, targets = training_batch(batch, self.moments.model, self.config, generator)
        inputs = drop_partners(inputs, self.config, generator)
        device = self.process.device
        device_type = torch.device(device).type
        with torch.autocast(device_type, dtype=torch.bfloat16, enabled=self.config.bf16):
            losses: dict[str, Tensor] = training_step(inputs.to(device), targets.to(device))
        return losses

    def _finish_step(
        self,
        step_count: int,
        row: NamedValues,
        model: V2XFormer,
        optimizer: AdamW,
        progress: TrainingProgress,
    ) -> TrainingProgress:
        """Log a step, and at regular intervals validate and save; return the progress."""
        config = self.config
        is_last = step_count == config.steps
        is_validated = is_last or step_count % config.validate_every == 0
        progress = replace(progress, step=step_count)
        if self.validation_tokens and is_validated:
            tokens = self.validation_tokens[self.process.rank :: self.process.ranks]
            scores = validate_model(model, self.dataset, tokens, self.predict)
            row["validation"] = scores
            scores_text = ", ".join(f"{name} {value:.3f}" for name, value in scores.items())
            self.say(f"step {step_count:,}: {scores_text}")
            if progress.best is None or scores[SCORE] > progress.best:
                progress = replace(progress, best=scores[SCORE])
                self._write_weights(model, progress, BEST_FILE)
        if self.process.is_first:
            add_to_log(self.folder, row)
            if is_last or step_count % config.save_every == 0 or "validation" in row:
                save_state(self.folder, model, optimizer, progress, self.notes)
            if is_last or "validation" in row:
                save_training(read_log(self.folder), self.folder.name, self.folder / CURVES_FILE)
        return progress

    def _write_weights(
        self, model: V2XFormer, progress: TrainingProgress, name: str = FINAL_FILE
    ) -> Path:
        """Write the weights without the optimizer, on the first process; return their path."""
        path = self.folder / name
        if self.process.is_first:
            notes = {**self.notes, "step": progress.step, "score": progress.best}
            write_weights(path, model.state_dict(), notes)
        return path
