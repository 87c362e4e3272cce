"""A training step: batches of moments, their egos and partners, losses, and validation scores."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
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
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.training.torch import (
    AllEgosDataset,
    RandomAugmentation,
    collate_all_egos,
    merged_evaluator,
)

# Name of the mean of IoU and VPQ over all ranges, by which the best checkpoint is selected.
SCORE = "score"
_SCORE_RANGE = "100x100"


class Moments(TorchDataset[NamedValues]):
    """A split's moments as in `AllEgosDataset`, numbered consecutively over all epochs."""

    def __init__(
        self, dataset: Dataset, model: ModelConfig, config: TrainConfig, *, images_cache: Any = None
    ) -> None:
        """Find the labelled moments of the training split; `images_cache` is as in `V2XConfig`.

        Raises NotAvailableError if the split has no labelled samples, and the errors of
        `AllEgosDataset`.
        """
        self.model = model
        tokens = samples(dataset, config.split, config.samples)
        if not tokens:
            raise NotAvailableError(
                f"{config.split}: has no samples to train on; choose another split"
            )
        augmentation = RandomAugmentation() if config.augment else None
        inputs = model.inputs(
            config.agents,
            boxes="sample",
            labels=model.labels,
            augmentation=augmentation,
            seed=config.seed,
            images_cache=images_cache,
        )
        self.data = AllEgosDataset(dataset, tokens, inputs)

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, number: int) -> NamedValues:
        """Return the moment with the number epoch · moments + position."""
        epoch, position = divmod(number, len(self.data))
        return self.data.item(position, epoch)

    def numbers(self, config: TrainConfig, **options: int) -> Iterator[Any]:
        """Yield the numbers of a process's moments without end; arguments are as in `positions`."""
        return positions(len(self), config, **options)


class MixedMoments(TorchDataset[NamedValues]):
    """Moments from two sources in turn; a key is the source and the number of its moment."""

    def __init__(self, sources: tuple[Moments, Moments], mix: float) -> None:
        """Take the fraction `mix` of all moments from the second source."""
        self.sources = sources
        self.mix = mix
        self.model = sources[0].model
        self.data = sources[0].data

    def __getitem__(self, number: tuple[int, int]) -> NamedValues:
        """Return the moment with a number of one of the sources."""
        source, source_number = number
        return self.sources[source][source_number]

    def numbers(
        self, config: TrainConfig, *, start: int, rank: int = 0, ranks: int = 1
    ) -> Iterator[tuple[int, int]]:
        """Yield the numbers of a process's moments without end.

        Each source's moments keep that source's order, and are evenly spread.
        """
        for number in count(start * ranks + rank, ranks):
            earlier_of_second = math.floor(number * self.mix)
            source = math.floor((number + 1) * self.mix) - earlier_of_second
            source_start = earlier_of_second
            if source == 0:
                source_start = number - earlier_of_second
            source_positions = positions(len(self.sources[source]), config, start=source_start)
            yield source, next(source_positions)


def batches(
    moments: Moments | MixedMoments,
    numbers: Iterable[Any],
    config: TrainConfig,
    *,
    workers: int = 0,
) -> Iterator[NamedValues]:
    """Read batches of moments in the order of their numbers, as `read_batches` does."""
    return read_batches(
        moments, collate_all_egos, workers, batch_size=config.moments, sampler=numbers
    )


def validation_samples(dataset: Dataset, config: TrainConfig) -> list[str]:
    """Return the samples on which a run is validated.

    These are two samples a second of the complete split, or an evenly spaced selection of them.
    """
    if config.validation is None:
        return []
    try:
        tokens = samples(dataset, config.validation, "all")
    except NotAvailableError as error:
        raise NotAvailableError(f"{error} (--validation none trains without it)") from error
    sample_count = config.validation_samples
    if not sample_count or sample_count >= len(tokens):
        return tokens
    return [tokens[index * len(tokens) // sample_count] for index in range(sample_count)]


def validate_model(
    model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig
) -> dict[str, float]:
    """Evaluate a model on samples: IoU, VPQ, distance mAP and the `score`, in [0, 1].

    NaN is replaced by 0. If several processes train, `tokens` are this process's samples, and the
    scores are computed over the samples of all processes.
    """
    detection_protocol = DETECTION_PROTOCOLS["paper"]
    motion_protocol = replace(MOTION_PROTOCOLS["paper"], labels=model.config.labels_protocol)
    motion_evaluator = MotionEvaluator(motion_protocol, trajectories=False)
    detection_evaluator = DetectionEvaluator(detection_protocol)
    frame = detection_protocol.frame
    sample_predictions = predictions(model, dataset, tokens, config)
    all_labels = motion_labels_of(dataset, tokens, model.config.labels)
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
    for name, percentage in percentages.items():
        scores[name] = 0.0 if math.isnan(percentage) else percentage / 100
    scores[SCORE] = (scores["iou"] + scores["vpq"]) / 2
    return scores


def learning_rate(step: int, config: TrainConfig) -> float:
    """Return the learning rate at a step; the first step is 0.

    The rate rises linearly over the warm-up, and then falls along a cosine to 0.
    """
    warm_up_steps = round(config.warm_up * config.steps)
    if step < warm_up_steps:
        return config.learning_rate * (step + 1) / warm_up_steps
    later_steps = config.steps - warm_up_steps
    share = (step - warm_up_steps) / max(later_steps, 1)
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * share))


def freeze(model: nn.Module, beginnings: Sequence[str]) -> None:
    """Freeze the parameters whose names begin with one of `beginnings`.

    Their batch statistics are still updated. Raise ConfigError if a prefix matches no name, or if
    nothing is left to train.
    """
    names = [name for name, _ in model.named_parameters()]
    for beginning in beginnings:
        if not any(name.startswith(beginning) for name in names):
            part_names = sorted({name.partition(".")[0] for name in names})
            raise ConfigError(
                f"freeze: no parameter's name begins with {beginning!r}; the parts are "
                f"{', '.join(part_names)}"
            )
    for name, parameter in model.named_parameters():
        if name.startswith(tuple(beginnings)):
            parameter.requires_grad = False
    if not any(parameter.requires_grad for parameter in model.parameters()):
        raise ConfigError("freeze: no parameter is left to train; freeze fewer parameters")


def make_optimizer(model: nn.Module, config: TrainConfig) -> AdamW:
    """Build AdamW for the trained parameters; vectors (biases, norms) have no weight decay."""
    matrices = []
    vectors = []
    for parameter in model.parameters():
        if parameter.requires_grad and parameter.ndim > 1:
            matrices.append(parameter)
        elif parameter.requires_grad:
            vectors.append(parameter)
    groups = [
        {"params": matrices, "weight_decay": config.weight_decay},
        {"params": vectors, "weight_decay": 0.0},
    ]
    return AdamW(groups, lr=config.learning_rate)


def positions(
    count: int, config: TrainConfig, *, start: int, rank: int = 0, ranks: int = 1
) -> Iterator[int]:
    """Yield a process's moments without end, as numbers epoch · count + position.

    Each epoch has its own order. The orders depend only on the seed, so a resumed run continues
    where it stopped: after the `start` moments that this process has already read. Processes
    (`rank` of `ranks`) take turns.
    """
    order_epoch = -1
    order = torch.empty(0)
    number = start * ranks + rank
    while True:
        epoch, position = divmod(number, count)
        if epoch != order_epoch:
            generator = make_generator(config.seed, epoch)
            order = torch.randperm(count, generator=generator)
            order_epoch = epoch
        yield epoch * count + int(order[position])
        number += ranks


def make_generator(*seeds: int) -> torch.Generator:
    """Make a CPU generator that depends only on these non-negative numbers."""
    joint_seed = 0
    for seed in seeds:
        joint_seed = (joint_seed * 1_000_003 + seed + 1) % (1 << 62)
    return torch.Generator().manual_seed(joint_seed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Targets:
    """The targets of G egos, in the model's frame.

    Attributes:
        motion: Motion labels, with all frames in the present ego frame.
        boxes: Each ego's boxes, G tensors (M, 9): x y z l w h yaw vx vy; metres, radians, m/s.
        categories: Each box's index into `taxonomy.CATEGORIES`, G tensors (M,) int64.
        velocity_known: Whether each box's velocity is known, G tensors (M,) bool.
    """

    motion: MotionTargets
    boxes: list[Tensor]
    categories: list[Tensor]
    velocity_known: list[Tensor]

    def to(self, device: torch.device | str) -> Targets:
        """Return the same targets on another device."""
        motion = [tensor.to(device) for tensor in self.motion]
        return Targets(
            motion=MotionTargets(*motion),
            boxes=[boxes.to(device) for boxes in self.boxes],
            categories=[categories.to(device) for categories in self.categories],
            velocity_known=[is_known.to(device) for is_known in self.velocity_known],
        )


def training_batch(
    batch: ReadOnlyValues, model: ModelConfig, config: TrainConfig, generator: torch.Generator
) -> tuple[ModelInputs, Targets]:
    """Return the inputs and targets of a batch of `collate_all_egos`.

    If `config.egos` limits the egos per moment, they are drawn at random.
    """
    inputs = model_inputs(batch, model.handedness)
    rows = torch.arange(len(inputs.ego_rows))
    if config.egos is not None:
        draws = torch.rand(len(rows), generator=generator)
        moment = inputs.ego_rows[:, 0]
        # Keep those egos of each moment that have the fewest draws above their own.
        is_smaller = (moment[:, None] == moment) & (draws[:, None] < draws)
        rows = rows[is_smaller.sum(1) < config.egos]
    moment, agent = inputs.ego_rows[rows].unbind(1)
    past_valid = inputs.frame_valid[moment, agent, :-1]
    mask = frame_mask(batch["label_valid"][rows], past_valid)
    motion_targets = MotionTargets(
        segmentation=batch["segmentation"][rows],
        centerness=batch["centerness"][rows],
        offset=batch["offset"][rows],
        flow=batch["flow"][rows],
        frame_mask=mask,
    )
    targets = Targets(motion=motion_targets, boxes=[], categories=[], velocity_known=[])
    for row in rows.tolist():
        boxes = mirrored_boxes(batch["boxes"][row], model.handedness)
        targets.boxes.append(boxes)
        targets.categories.append(batch["categories"][row])
        targets.velocity_known.append(batch["velocity_known"][row])
    return inputs.of_egos(rows), targets


def drop_partners(
    inputs: ModelInputs, config: TrainConfig, generator: torch.Generator
) -> ModelInputs:
    """Drop some partners at random, but never the ego itself.

    A partner is dropped with the probability `partner_dropout`, and all of an ego's partners with
    the probability `alone`.
    """
    egos, agents = inputs.partners.shape
    partner_draws = torch.rand(egos, agents, generator=generator)
    ego_draws = torch.rand(egos, 1, generator=generator)
    is_heard = (partner_draws >= config.partner_dropout) & (ego_draws >= config.alone)
    is_ego = nn.functional.one_hot(inputs.ego_rows[:, 1], agents).bool()
    return replace(inputs, partners=inputs.partners & (is_heard | is_ego))


class TrainingStep(nn.Module):
    """The model with its losses, in one module that `DistributedDataParallel` can wrap."""

    def __init__(self, model: V2XFormer) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, inputs: ModelInputs, targets: Targets, noise: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return the weighted losses of G egos by name; training reduces their sum.

        If `noise` is None, the latents' noise is drawn.
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
        losses |= detection_losses(outputs.detection, box_targets, config.detection_loss)
        return losses
