"""Where a run computes: the device, and its processes if `torchrun` started several."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import distributed

from deepaccident_devkit.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """One process of a run.

    Attributes:
        device: such as `cpu` or `cuda:1`.
        rank: its number, from 0.
        ranks: how many there are.
    """

    device: str
    rank: int = 0
    ranks: int = 1

    @property
    def is_first(self) -> bool:
        """Whether it writes the files."""
        return self.rank == 0


def checked_device(device: str) -> str:
    """A device that is there; `auto` is the first GPU, or else the CPU.

    Raises:
        ConfigError: there is no such device.
    """
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:  # an AssertionError: torch without CUDA
        raise ConfigError(f"device: {device!r} cannot be used ({str(error).splitlines()[0]}); choose cpu") from error
    return device


@contextmanager
def processes(device: str) -> Iterator[Place]:
    """The place of this process; with `torchrun`, together with the others until the block ends.

    Raises:
        ConfigError: there is no such device.
    """
    ranks, local = int(os.environ.get("WORLD_SIZE", "1")), os.environ.get("LOCAL_RANK", "0")
    chosen = checked_device(device)
    if ranks == 1:
        yield Place(device=chosen)
        return
    if chosen == "cuda":
        chosen = f"cuda:{local}"
        torch.cuda.set_device(chosen)
    distributed.init_process_group("nccl" if chosen.startswith("cuda") else "gloo")
    try:
        yield Place(device=chosen, rank=distributed.get_rank(), ranks=distributed.get_world_size())
    finally:
        distributed.destroy_process_group()
