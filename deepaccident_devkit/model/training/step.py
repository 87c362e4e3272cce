"""One step of a training: its learning rate, its random numbers, and one batch → its losses, with partner dropout."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import AdamW

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.detection import detection_losses, detection_targets
from deepaccident_devkit.model.entry import ModelInputs, mirrored_boxes, model_inputs
from deepaccident_devkit.model.motion import MotionTargets, frame_mask, motion_losses
from deepaccident_devkit.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.model.training.config import TrainConfig


def learning_rate(step: int, config: TrainConfig) -> float:
    """The rate of a step, from 0: rising linearly over the warm-up, then a cosine that ends at 0."""
    rising = round(config.warm_up * config.steps)
    if step < rising:
        return config.learning_rate * (step + 1) / rising
    done = (step - rising) / max(config.steps - rising, 1)
    return config.learning_rate * 0.5 * (1 + math.cos(math.pi * done))


def freeze(model: nn.Module, beginnings: Sequence[str]) -> None:
    """Stop parameters from being trained whose names begin so; their batch statistics go on.

    Raises:
        ConfigError: no parameter has such a name, or none is left to train.
    """
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
        {"params": [each for each in trained if each.ndim > 1], "weight_decay": config.weight_decay},
        {"params": [each for each in trained if each.ndim <= 1], "weight_decay": 0.0},
    ]
    return AdamW(groups, lr=config.learning_rate)


def positions(count: int, config: TrainConfig, *, first: int, rank: int = 0, ranks: int = 1) -> Iterator[int]:
    """The moments of a process, without end: numbers of (epoch · count + position), each epoch in an order of its own.

    They depend on the seed alone, so that a resumed run goes on where it stopped.

    Args:
        count: moments of the release.
        config: its seed.
        first: how many moments this process has had before.
        rank: this process, from 0, of `ranks`, which take turns.
        ranks: how many processes.
    """
    order: torch.Tensor | None = None
    ordered = -1
    number = first * ranks + rank
    while True:
        epoch, position = divmod(number, count)
        if order is None or epoch != ordered:
            order, ordered = torch.randperm(count, generator=generator_of(config.seed, epoch)), epoch
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
        return replace(self, motion=MotionTargets(*(each.to(device) for each in self.motion)), **lists)


_LISTS = ("boxes", "categories", "velocity_known")


def training_batch(
    batch: Mapping[str, Any], model: ModelConfig, config: TrainConfig, generator: torch.Generator
) -> tuple[ModelInputs, Targets]:
    """The inputs and targets of a batch of `collate_all_egos`, some of whose egos are drawn if the training says so.

    Args:
        batch: with labels and boxes.
        model: its frame.
        config: its number of egos.
        generator: draws them.
    """
    inputs = model_inputs(batch, model.handedness)
    rows = torch.arange(len(inputs.ego_rows))
    if config.egos is not None:
        chance = torch.rand(len(rows), generator=generator)
        moment = inputs.ego_rows[:, 0]
        better = (moment[:, None] == moment) & (chance[:, None] < chance)
        rows = rows[better.sum(1) < config.egos]
    moment, agent = inputs.ego_rows[rows].unbind(1)
    mask = frame_mask(batch["label_valid"][rows], inputs.frame_valid[moment, agent, :-1])
    names = ("segmentation", "centerness", "offset", "flow")
    kept = rows.tolist()
    targets = Targets(
        motion=MotionTargets(**{name: batch[name][rows] for name in names}, frame_mask=mask),
        boxes=[mirrored_boxes(batch["boxes"][row], model.handedness) for row in kept],
        categories=[batch["categories"][row] for row in kept],
        velocity_known=[batch["velocity_known"][row] for row in kept],
    )
    return inputs.of_egos(rows), targets


def with_dropped_partners(inputs: ModelInputs, config: TrainConfig, generator: torch.Generator) -> ModelInputs:
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

    def forward(self, inputs: ModelInputs, targets: Targets, noise: Tensor | None = None) -> dict[str, Tensor]:
        """The weighted losses by name; their sum is what is minimised.

        Args:
            inputs: with G egos.
            targets: theirs.
            noise: of the latents; drawn from torch's own generator if None.
        """
        config = self.model.config
        predicted = self.model(inputs, targets.motion, noise=noise)
        losses = motion_losses(predicted.motion, targets.motion, config.motion_loss)
        wanted = detection_targets(
            targets.boxes, targets.categories, config.detection, config.targets, velocity_known=targets.velocity_known
        )
        return losses | detection_losses(predicted.detection, wanted, config.detection_loss)
