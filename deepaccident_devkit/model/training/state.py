"""Where a run computes, and its state on disk, from which a killed run goes on: log, weights, optimizer, step."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import torch
from torch import Tensor, distributed, nn
from torch.optim import AdamW

from deepaccident_devkit.errors import ConfigError, shortened
from deepaccident_devkit.model.checkpoint import LAST, OPTIMIZER, read_weights, reason_of, write_weights
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import as_record, parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes


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


NAME = "log.jsonl"


class _Row(msgspec.Struct):
    """What readers need of a row."""

    step: Annotated[int, msgspec.Meta(ge=0, le=1 << 53)]
    losses: dict[str, float] | None = None
    validation: dict[str, float] | None = None


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The rows of a run's log, in order; none if it has no log. A last line that is cut off is left out.

    Raises:
        ConfigError: it cannot be read, or a line is no JSON object of a step.
    """
    path = folder / NAME
    if not path.is_file():
        return []
    try:
        lines = read_bytes(path, "bundle").split(b"\n")[:-1]
    except OSError as error:
        raise ConfigError(f"{path}: {fault_text(error)}; remove the file") from error
    return [_row(f"{path}:{number}", line) for number, line in enumerate(lines, 1)]


def cut_log(folder: Path, step: int) -> None:
    """Drop the rows after a step."""
    kept = [row for row in read_log(folder) if row["step"] <= step]
    write_bytes(folder / NAME, "".join(f"{json.dumps(row)}\n" for row in kept).encode())


def add_to_log(folder: Path, row: Mapping[str, Any]) -> None:
    """Add a row, and have it on disk."""
    with (folder / NAME).open("a", encoding="utf-8") as file:
        file.write(f"{json.dumps(row)}\n")


def _row(where: str, line: bytes) -> dict[str, Any]:
    try:
        row: dict[str, Any] = parsed_json(line)
        as_record(row, _Row)
    except ValueError as error:
        raise ConfigError(
            f"{where}: expected a JSON object with a step ({error}); remove the line, or the file"
        ) from error
    return row


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far a run is.

    Attributes:
        step: how many steps are done.
        best: the best score so far; None before the first validation.
    """

    step: Annotated[int, msgspec.Meta(ge=0)]
    best: Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)] | None


def save_state(folder: Path, model: nn.Module, optimizer: AdamW, progress: Progress, meta: Mapping[str, Any]) -> None:
    """Write the last checkpoint, completely or not at all."""
    tensors = dict(model.state_dict())
    for number, state in optimizer.state_dict()["state"].items():
        tensors |= {f"{OPTIMIZER}{number}.{name}": torch.as_tensor(each) for name, each in state.items()}
    noted = {**meta, "step": progress.step, "best": progress.best}
    write_weights(folder / LAST, tensors, noted)


def load_state(folder: Path, model: nn.Module, optimizer: AdamW, steps: int) -> Progress:
    """Put the last checkpoint into model and optimizer; how far the run was, nothing done if there is none.

    Args:
        folder: of the run.
        model: before its first step.
        optimizer: of that model.
        steps: of the whole run.

    Raises:
        ConfigError: the checkpoint cannot be read, or is of another model or run.
    """
    path = folder / LAST
    if not (path.is_file() or path.is_dir()):
        return Progress(step=0, best=None)
    weights = read_weights(path)
    try:
        noted = as_record(weights.meta, Progress)
        if noted.step > steps:
            raise ValueError(f"it has {noted.step} steps, and the run {steps}")
        states = _states(weights.tensors, model, optimizer)
        for state in states.values():
            if not 1 <= float(state["step"]) <= noted.step:
                raise ValueError(f"its optimizer has {float(state['step'])} steps of {noted.step}")
    except ValueError as error:
        raise ConfigError(
            f"{path}: is no checkpoint of this run ({reason_of(error)}); remove it, or train elsewhere"
        ) from error
    model.load_state_dict({name: weights.tensors[name] for name in model.state_dict()})
    optimizer.load_state_dict({"state": states, "param_groups": optimizer.state_dict()["param_groups"]})
    return noted


def _states(tensors: Mapping[str, Tensor], model: nn.Module, optimizer: AdamW) -> dict[int, dict[str, Tensor]]:
    """The optimizer's state of each parameter; raises ValueError if tensors are not just the model's and those."""
    wanted, states = dict(model.state_dict()), {}
    for number, parameter in enumerate(each for group in optimizer.param_groups for each in group["params"]):
        likes = {"step": torch.zeros(()), "exp_avg": parameter, "exp_avg_sq": parameter}
        names = {part: f"{OPTIMIZER}{number}.{part}" for part in likes}
        if not tensors.keys().isdisjoint(names.values()):  # a parameter without any gradient has no state
            wanted |= {names[part]: like for part, like in likes.items()}
            states[number] = names
    if strange := sorted(tensors.keys() ^ wanted.keys()):
        raise ValueError(f"{shortened(strange[0])!r} is missing, or should not be there")
    for name, like in wanted.items():
        if _form(tensors[name]) != _form(like):
            raise ValueError(f"{name} is {_form(tensors[name])}, not {_form(like)}")
    return {number: {part: tensors[name] for part, name in names.items()} for number, names in states.items()}


def _form(tensor: Tensor) -> str:
    return f"{shortened(str(tuple(tensor.shape)))} of {tensor.dtype}"
