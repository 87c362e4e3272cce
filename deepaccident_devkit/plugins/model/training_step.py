"""A training step: moments in batches, their egos and partners, and the losses; and the score on validation samples."""

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

# The mean of the IoU and the VPQ at all distances: what the best checkpoint has most of.
SCORE = "score"
_WIDE = "100x100"
_LISTS = ("boxes", "categories", "velocity_known")


class Moments(TorchDataset[dict[str, Any]]):
    """The moments of a split as `AllEgosDataset` has them, numbered on through the epochs."""

    def __init__(
        self, dataset: Dataset, model: ModelConfig, config: TrainConfig, *, images_cache: Any = None
    ) -> None:
        """Find the labelled moments of the training's split; `images_cache` is that of `V2XConfig`.

        Raises NotAvailableError: the split has no labelled samples; and the errors of `AllEgosDataset`.
        """
        self.model = model
        tokens = samples(dataset, config.split, config.samples)
        if not tokens:
            raise NotAvailableError(
                f"{config.split}: has no samples to learn from; choose another split"
            )
        self.data = AllEgosDataset(
            dataset,
            tokens,
            model.inputs(
                config.agents,
                boxes="sample",
                labels=model.labels,
                augmentation=RandomAugmentation() if config.augment else None,
                seed=config.seed,
                images_cache=images_cache,
            ),
        )

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, number: int) -> dict[str, Any]:
        """The moment of a number (epoch · moments + position)."""
        epoch, position = divmod(number, len(self.data))
        return self.data.item(position, epoch)

    def numbers(self, config: TrainConfig, **place: int) -> Iterator[Any]:
        """The numbers of a process's moments, without end; arguments as of `positions`."""
        return positions(len(self), config, **place)


class MixedMoments(TorchDataset[dict[str, Any]]):
    """The moments of two sources by turns; a number says which one, and which of its moments."""

    def __init__(self, sources: tuple[Moments, Moments], mix: float) -> None:
        """Take `mix` of all moments from the second source."""
        self.sources, self.mix = sources, mix
        self.model, self.data = sources[0].model, sources[0].data

    def __getitem__(self, number: tuple[int, int]) -> dict[str, Any]:
        """The moment of a number."""
        return self.sources[number[0]][number[1]]

    def numbers(
        self, config: TrainConfig, *, first: int, rank: int = 0, ranks: int = 1
    ) -> Iterator[tuple[int, int]]:
        """The numbers of a process's moments, without end: each source's in its own order, spread evenly."""
        for number in count(first * ranks + rank, ranks):
            before = math.floor(number * self.mix)
            source = math.floor((number + 1) * self.mix) - before
            ahead = before if source else number - before
            yield source, next(positions(len(self.sources[source]), config, first=ahead))


def batches(
    moments: Moments | MixedMoments,
    numbers: Iterable[Any],
    config: TrainConfig,
    *,
    workers: int = 0,
) -> Iterator[dict[str, Any]]:
    """Read batches of moments in the order of their numbers (`positions`), as of `read_batches`."""
    return read_batches(
        moments, collate_all_egos, workers, batch_size=config.moments, sampler=numbers
    )


def validation_samples(dataset: Dataset, config: TrainConfig) -> list[str]:
    """Those that a run is validated with: two a second of the whole split, or evenly chosen ones of them."""
    if config.validation is None:
        return []
    try:
        listed = samples(dataset, config.validation, "all")
    except NotAvailableError as error:
        raise NotAvailableError(f"{error} (--validation; none trains without it)") from error
    wanted = config.validation_samples
    if not wanted or wanted >= len(listed):
        return listed
    return [listed[index * len(listed) // wanted] for index in range(wanted)]


def validated(
    model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig
) -> dict[str, float]:
    """IoU, VPQ and distance mAP of a model at samples (tokens), in [0, 1], and the `score`; NaN becomes 0.

    Where several processes train, the tokens are this one's, and the scores are of all of them.
    """
    labels, rules = model.config.labels, DETECTION_PROTOCOLS["paper"]
    counted = replace(MOTION_PROTOCOLS["paper"], labels=model.config.labels_protocol)
    motion, detection = MotionEvaluator(counted, trajectories=False), DetectionEvaluator(rules)
    made = predictions(model, dataset, tokens, config)
    for found, truth in zip(made, motion_labels_of(dataset, tokens, labels), strict=True):
        motion.update(found.token, found.motion, truth)
        pose = dataset.world_from(found.token, rules.frame).inverse()
        boxes = DetectedBoxes(
            boxes=found.boxes.boxes.transform(pose, rules.frame), scores=found.boxes.scores
        )
        detection.update(found.token, boxes, detection_truth(dataset, found.token, rules))
    wide = merged_evaluator(motion).compute().ranges[_WIDE]
    percent = {
        "iou": wide.iou,
        "vpq": wide.pq,
        "map": merged_evaluator(detection).compute().mean_average_precision,
    }
    known = {name: 0.0 if math.isnan(value) else value / 100 for name, value in percent.items()}
    return {**known, SCORE: (known["iou"] + known["vpq"]) / 2}


def learning_rate(step: int, config: TrainConfig) -> float:
    """The rate of a step, from 0: rising linearly over the warm-up, then a cosine that ends at 0."""
    rising = round(config.warm_up * config.steps)
    if step < rising:
        return config.learning_rate * (step + 1) / rising
    done = (step - rising) / max(config.steps - rising, 1)
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * done))


def freeze(model: nn.Module, beginnings: Sequence[str]) -> None:
    """Stop parameters from being trained whose names begin so; their batch statistics go on. Raises ConfigError."""
    names = [name for name, _ in model.named_parameters()]
    for beginning in beginnings:
        if not any(name.startswith(beginning) for name in names):
            parts = sorted({name.partition(".")[0] for name in names})
            raise ConfigError(
                f"freeze: no parameter's name begins with {beginning!r}; the parts are {', '.join(parts)}"
            )
    for name, parameter in model.named_parameters():
        if name.startswith(tuple(beginnings)):
            parameter.requires_grad = False
    if not any(parameter.requires_grad for parameter in model.parameters()):
        raise ConfigError("freeze: nothing is left to train; freeze less")


def optimizer_of(model: nn.Module, config: TrainConfig) -> AdamW:
    """AdamW over what is trained; vectors (biases, norms) do not decay."""
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    groups = [
        {
            "params": [each for each in trained if each.ndim > 1],
            "weight_decay": config.weight_decay,
        },
        {"params": [each for each in trained if each.ndim <= 1], "weight_decay": 0.0},
    ]
    return AdamW(groups, lr=config.learning_rate)


def positions(
    count: int, config: TrainConfig, *, first: int, rank: int = 0, ranks: int = 1
) -> Iterator[int]:
    """The moments of a process, without end: numbers of (epoch · count + position), each epoch in an order of its own.

    They depend on the seed alone, so that a resumed run goes on where it stopped, after the `first` moments that this
    process has had. Processes (`rank` of `ranks`) take turns.
    """
    order: torch.Tensor | None = None
    ordered = -1
    number = first * ranks + rank
    while True:
        epoch, position = divmod(number, count)
        if order is None or epoch != ordered:
            order, ordered = (
                torch.randperm(count, generator=generator_of(config.seed, epoch)),
                epoch,
            )
        yield epoch * count + int(order[position])
        number += ranks


def generator_of(*numbers: int) -> torch.Generator:
    """A generator on the CPU that depends on these numbers from 0 alone."""
    seed = 0
    for number in numbers:
        seed = (seed * 1_000_003 + number + 1) % (1 << 62)
    return torch.Generator().manual_seed(seed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Targets:
    """What G egos learn, in the model's frame.

    Attributes:
        motion: motion labels, all frames at the present.
        boxes: G tensors (M, 9): x y z l w h yaw vx vy.
        categories: G tensors (M,) int64.
        velocity_known: G tensors (M,) bool.
    """

    motion: MotionTargets
    boxes: list[Tensor]
    categories: list[Tensor]
    velocity_known: list[Tensor]

    def to(self, device: torch.device | str) -> Targets:
        """The same on another device."""
        lists = {name: [each.to(device) for each in getattr(self, name)] for name in _LISTS}
        return replace(
            self, motion=MotionTargets(*(each.to(device) for each in self.motion)), **lists
        )


def training_batch(
    batch: Mapping[str, Any], model: ModelConfig, config: TrainConfig, generator: torch.Generator
) -> tuple[ModelInputs, Targets]:
    """The inputs and targets of a batch of `collate_all_egos`, some of whose egos are drawn if the training says so."""
    inputs = model_inputs(batch, model.handedness)
    rows = torch.arange(len(inputs.ego_rows))
    if config.egos is not None:
        chance = torch.rand(len(rows), generator=generator)
        moment = inputs.ego_rows[:, 0]
        better = (moment[:, None] == moment) & (chance[:, None] < chance)
        rows = rows[better.sum(1) < config.egos]
    moment, agent = inputs.ego_rows[rows].unbind(1)
    mask = frame_mask(batch["label_valid"][rows], inputs.frame_valid[moment, agent, :-1])
    kept = rows.tolist()
    targets = Targets(
        motion=MotionTargets(
            **{
                name: batch[name][rows] for name in ("segmentation", "centerness", "offset", "flow")
            },
            frame_mask=mask,
        ),
        boxes=[mirrored_boxes(batch["boxes"][row], model.handedness) for row in kept],
        categories=[batch["categories"][row] for row in kept],
        velocity_known=[batch["velocity_known"][row] for row in kept],
    )
    return inputs.of_egos(rows), targets


def with_dropped_partners(
    inputs: ModelInputs, config: TrainConfig, generator: torch.Generator
) -> ModelInputs:
    """The inputs with some partners not heard: each with one probability, all with another; never the ego itself."""
    shape = inputs.partners.shape
    kept = torch.rand(shape, generator=generator) >= config.partner_dropout
    kept &= torch.rand(shape[0], 1, generator=generator) >= config.alone
    own = torch.nn.functional.one_hot(inputs.ego_rows[:, 1], shape[1]).bool()
    return replace(inputs, partners=inputs.partners & (kept | own))


class TrainingStep(nn.Module):
    """The model with its losses: a module, so that `DistributedDataParallel` can wrap it."""

    def __init__(self, model: V2XFormer) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, inputs: ModelInputs, targets: Targets, noise: Tensor | None = None
    ) -> dict[str, Tensor]:
        """The weighted losses of G egos by name, whose sum is minimised; noise of the latents is drawn if None."""
        config = self.model.config
        predicted = self.model(inputs, targets.motion, noise=noise)
        losses = motion_losses(predicted.motion, targets.motion, config.motion_loss)
        wanted = detection_targets(
            targets.boxes,
            targets.categories,
            config.detection,
            config.targets,
            velocity_known=targets.velocity_known,
        )
        return losses | detection_losses(predicted.detection, wanted, config.detection_loss)
