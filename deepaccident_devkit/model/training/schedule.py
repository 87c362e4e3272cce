"""The learning rate of a step, the parameters that are trained, and the random numbers of a step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import nn
from torch.optim import AdamW

from deepaccident_devkit.errors import ConfigError
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
