"""A training step: batches of moments, their egos and partners, losses, and validation scores."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import AdamW
from torch.utils.data import Dataset as TorchDataset

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation import DetectionEvaluator, MotionEvaluator, detection_truth
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS, DetectedBoxes
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS
from deepaccident_devkit.motion import motion_labels_of
from deepaccident_devkit.plugins.model.detection import detection_losses, detection_targets
from deepaccident_devkit.plugins.model.inputs import ModelInputs, mirrored_boxes, model_inputs
from deepaccident_devkit.plugins.model.loading import read_batches
from deepaccident_devkit.plugins.model.motion import MotionTargets, frame_mask, motion_losses
from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.plugins.model.results import PredictConfig, predictions
from deepaccident_devkit.plugins.model.training_run import TrainConfig
from deepaccident_devkit.selection.samples import samples
from deepaccident_devkit.training.torch import (
    AllEgosDataset,
    RandomAugmentation,
    collate_all_egos,
    merged_evaluator,
)

# Name of the mean of IoU and VPQ at all distances, by which the best checkpoint is selected.
SCORE = "score"
_SCORE_RANGE = "100x100"
_LIST_FIELDS = ("boxes", "categories", "velocity_known")


class Moments(TorchDataset[dict[str, Any]]):
    """The moments of a split as in `AllEgosDataset`, numbered consecutively through the epochs."""

    def __init__(
        self, dataset: Dataset, model: ModelConfig, config: TrainConfig, *, images_cache: Any = None
    ) -> None:
        """Find the labelled moments of the training's split; `images_cache` is that of `V2XConfig`.

        Raises NotAvailableError: the split has no labelled samples; and the errors of
        `AllEgosDataset`.
        """
        self.model = model
        tokens = samples(dataset, config.split, config.samples)
        if not tokens:
            raise NotAvailableError(
                f"{config.split}: has no samples to learn from; choose another split"
            )
        inputs = model.inputs(
            config.agents,
            boxes="sample",
            labels=model.labels,
            augmentation=RandomAugmentation() if config.augment else None,
            seed=config.seed,
            images_cache=images_cache,
        )
        self.data = AllEgosDataset(dataset, tokens, inputs)

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, number: int) -> dict[str, Any]:
        """Return the moment with a number (epoch · moments + position)."""
        epoch, position = divmod(number, len(self.data))
        return self.data.item(position, epoch)

    def numbers(self, config: TrainConfig, **options: int) -> Iterator[Any]:
        """Return the endless numbers of a process's moments; arguments as in `positions`."""
        return positions(len(self), config, **options)


class MixedMoments(TorchDataset[dict[str, Any]]):
    """The moments of two sources in turn; a number is the source and the number of its moment."""

    def __init__(self, sources: tuple[Moments, Moments], mix: float) -> None:
        """Take `mix` of all moments from the second source."""
        self.sources, self.mix = sources, mix
        self.model, self.data = sources[0].model, sources[0].data

    def __getitem__(self, number: tuple[int, int]) -> dict[str, Any]:
        """Return the moment with a number."""
        return self.sources[number[0]][number[1]]

    def numbers(
        self, config: TrainConfig, *, start: int, rank: int = 0, ranks: int = 1
    ) -> Iterator[tuple[int, int]]:
        """Yield the endless numbers of a process's moments.

        Each source's moments are in its own order and evenly spread.
        """
        for number in count(start * ranks + rank, ranks):
            second_count = math.floor(number * self.mix)
            source = math.floor((number + 1) * self.mix) - second_count
            source_start = second_count if source else number - second_count
            yield source, next(positions(len(self.sources[source]), config, start=source_start))


def batches(
    moments: Moments | MixedMoments,
    numbers: Iterable[Any],
    config: TrainConfig,
    *,
    workers: int = 0,
) -> Iterator[dict[str, Any]]:
    """Read batches of moments in the order of their numbers (`positions`), as in `read_batches`."""
    return read_batches(
        moments, collate_all_egos, workers, batch_size=config.moments, sampler=numbers
    )


def validation_samples(dataset: Dataset, config: TrainConfig) -> list[str]:
    """Return the samples that a run is validated with.

    They are two a second of the complete split, or evenly spaced ones of these.
    """
    if config.validation is None:
        return []
    try:
        tokens = samples(dataset, config.validation, "all")
    except NotAvailableError as error:
        raise NotAvailableError(f"{error} (--validation; none trains without it)") from error
    sample_count = config.validation_samples
    if not sample_count or sample_count >= len(tokens):
        return tokens
    return [tokens[index * len(tokens) // sample_count] for index in range(sample_count)]


def validated(
    model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig
) -> dict[str, float]:
    """Return IoU, VPQ and distance mAP of a model at samples, and the `score`; in [0, 1].

    NaN becomes 0. If several processes train, the tokens belong to this process, and the scores to
    all of them.
    """
    labels, detection_protocol = model.config.labels, DETECTION_PROTOCOLS["paper"]
    motion_protocol = replace(MOTION_PROTOCOLS["paper"], labels=model.config.labels_protocol)
    motion_evaluator = MotionEvaluator(motion_protocol, trajectories=False)
    detection_evaluator = DetectionEvaluator(detection_protocol)
    frame = detection_protocol.frame
    sample_predictions = predictions(model, dataset, tokens, config)
    all_labels = motion_labels_of(dataset, tokens, labels)
    for prediction, motion_truth in zip(sample_predictions, all_labels, strict=True):
        token = prediction.token
        motion_evaluator.update(token, prediction.motion, motion_truth)
        frame_from_world = dataset.world_from(token, frame).inverse()
        boxes = prediction.boxes.boxes.transform(frame_from_world, frame)
        detections = DetectedBoxes(boxes=boxes, scores=prediction.boxes.scores)
        box_truth = detection_truth(dataset, token, detection_protocol)
        detection_evaluator.update(token, detections, box_truth)
    motion_scores = merged_evaluator(motion_evaluator).compute().ranges[_SCORE_RANGE]
    detection_scores = merged_evaluator(detection_evaluator).compute()
    percentages = {
        "iou": motion_scores.iou,
        "vpq": motion_scores.pq,
        "map": detection_scores.mean_average_precision,
    }
    scores = {}
    for name, value in percentages.items():
        scores[name] = 0.0 if math.isnan(value) else value / 100
    return {**scores, SCORE: (scores["iou"] + scores["vpq"]) / 2}


def learning_rate(step: int, config: TrainConfig) -> float:
    """Return the learning rate of a step, from 0.

    It rises linearly over the warm-up, and then follows a cosine that ends at 0.
    """
    warm_up_steps = round(config.warm_up * config.steps)
    if step < warm_up_steps:
        return config.learning_rate * (step + 1) / warm_up_steps
    share = (step - warm_up_steps) / max(config.steps - warm_up_steps, 1)
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * share))


def freeze(model: nn.Module, beginnings: Sequence[str]) -> None:
    """Stop the training of parameters with names that begin with one of `beginnings`.

    Their batch statistics are still updated. Raises ConfigError.
    """
    names = [name for name, _ in model.named_parameters()]
    for beginning in beginnings:
        if not any(name.startswith(beginning) for name in names):
            parts = sorted({name.partition(".")[0] for name in names})
            raise ConfigError(
                f"freeze: no parameter's name begins with {beginning!r}; the parts are "
                f"{', '.join(parts)}"
            )
    for name, parameter in model.named_parameters():
        if name.startswith(tuple(beginnings)):
            parameter.requires_grad = False
    if not any(parameter.requires_grad for parameter in model.parameters()):
        raise ConfigError("freeze: nothing is left to train; freeze less")


def optimizer_of(model: nn.Module, config: TrainConfig) -> AdamW:
    """Return AdamW over the trained parameters; vectors (biases, norms) do not decay."""
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    matrices = [parameter for parameter in trained if parameter.ndim > 1]
    vectors = [parameter for parameter in trained if parameter.ndim <= 1]
    groups = [
        {"params": matrices, "weight_decay": config.weight_decay},
        {"params": vectors, "weight_decay": 0.0},
    ]
    return AdamW(groups, lr=config.learning_rate)


def positions(
    count: int, config: TrainConfig, *, start: int, rank: int = 0, ranks: int = 1
) -> Iterator[int]:
    """Yield the endless moments of a process, as numbers (epoch · count + position).

    Each epoch has its own order. The orders only depend on the seed, so that a resumed run
    continues where it stopped, after the `start` moments that this process has had. Processes
    (`rank` of `ranks`) take turns.
    """
    order: torch.Tensor | None = None
    order_epoch = -1
    number = start * ranks + rank
    while True:
        epoch, position = divmod(number, count)
        if order is None or epoch != order_epoch:
            order = torch.randperm(count, generator=generator_of(config.seed, epoch))
            order_epoch = epoch
        yield epoch * count + int(order[position])
        number += ranks


def generator_of(*numbers: int) -> torch.Generator:
    """Return a generator on the CPU that only depends on these non-negative numbers."""
    seed = 0
    for number in numbers:
        seed = (seed * 1_000_003 + number + 1) % (1 << 62)
    return torch.Generator().manual_seed(seed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Targets:
    """The targets of G egos, in the model's frame.

    Attributes:
        motion: Motion labels, all frames at the present.
        boxes: G tensors (M, 9): x y z l w h yaw vx vy.
        categories: G tensors (M,) int64.
        velocity_known: G tensors (M,) bool.
    """

    motion: MotionTargets
    boxes: list[Tensor]
    categories: list[Tensor]
    velocity_known: list[Tensor]

    def to(self, device: torch.device | str) -> Targets:
        """Return the same targets on another device."""
        lists = {}
        for name in _LIST_FIELDS:
            lists[name] = [tensor.to(device) for tensor in getattr(self, name)]
        motion = MotionTargets(*(tensor.to(device) for tensor in self.motion))
        return replace(self, motion=motion, **lists)


def training_batch(
    batch: Mapping[str, Any], model: ModelConfig, config: TrainConfig, generator: torch.Generator
) -> tuple[ModelInputs, Targets]:
    """Return the inputs and targets of a batch of `collate_all_egos`.

    If the training limits the egos, they are drawn at random.
    """
    inputs = model_inputs(batch, model.handedness)
    rows = torch.arange(len(inputs.ego_rows))
    if config.egos is not None:
        draws = torch.rand(len(rows), generator=generator)
        moment = inputs.ego_rows[:, 0]
        is_smaller = (moment[:, None] == moment) & (draws[:, None] < draws)
        rows = rows[is_smaller.sum(1) < config.egos]
    moment, agent = inputs.ego_rows[rows].unbind(1)
    mask = frame_mask(batch["label_valid"][rows], inputs.frame_valid[moment, agent, :-1])
    motion_targets = MotionTargets(
        segmentation=batch["segmentation"][rows],
        centerness=batch["centerness"][rows],
        offset=batch["offset"][rows],
        flow=batch["flow"][rows],
        frame_mask=mask,
    )
    row_list = rows.tolist()
    targets = Targets(
        motion=motion_targets,
        boxes=[mirrored_boxes(batch["boxes"][row], model.handedness) for row in row_list],
        categories=[batch["categories"][row] for row in row_list],
        velocity_known=[batch["velocity_known"][row] for row in row_list],
    )
    return inputs.of_egos(rows), targets


def with_dropped_partners(
    inputs: ModelInputs, config: TrainConfig, generator: torch.Generator
) -> ModelInputs:
    """Return the inputs with some partners dropped at random, but never the ego itself.

    Each partner is dropped with one probability, and all partners with another.
    """
    shape = inputs.partners.shape
    is_heard = torch.rand(shape, generator=generator) >= config.partner_dropout
    is_heard &= torch.rand(shape[0], 1, generator=generator) >= config.alone
    is_ego = torch.nn.functional.one_hot(inputs.ego_rows[:, 1], shape[1]).bool()
    return replace(inputs, partners=inputs.partners & (is_heard | is_ego))


class TrainingStep(nn.Module):
    """The model with its losses: a module, so that `DistributedDataParallel` can wrap it."""

    def __init__(self, model: V2XFormer) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, inputs: ModelInputs, targets: Targets, noise: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return the weighted losses of G egos by name; training reduces their sum.

        The noise of the latents is drawn if None.
        """
        config = self.model.config
        outputs = self.model(inputs, targets.motion, noise=noise)
        losses = motion_losses(outputs.motion, targets.motion, config.motion_loss)
        box_targets = detection_targets(
            targets.boxes,
            targets.categories,
            config.detection,
            config.targets,
            velocity_known=targets.velocity_known,
        )
        return losses | detection_losses(outputs.detection, box_targets, config.detection_loss)
