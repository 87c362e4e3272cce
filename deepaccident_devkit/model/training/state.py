"""A run's state on disk: weights, optimizer and step in one file, from which a killed run goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import torch
from torch import Tensor, nn
from torch.optim import AdamW

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.json_text import as_record
from deepaccident_devkit.model.checkpoint import LAST, OPTIMIZER, read_weights, reason_of, write_weights
from deepaccident_devkit.reading import shortened


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far a run is.

    Attributes:
        step: how many steps are done.
        best: the best score so far; None before the first validation.
    """

    step: int = 0
    best: float | None = None


def save_state(folder: Path, model: nn.Module, optimizer: AdamW, progress: Progress, meta: Mapping[str, Any]) -> None:
    """Write the last checkpoint, completely or not at all."""
    tensors = dict(model.state_dict())
    for number, state in optimizer.state_dict()["state"].items():
        tensors |= {f"{OPTIMIZER}{number}.{name}": torch.as_tensor(each) for name, each in state.items()}
    noted = {**meta, "step": progress.step, "best": progress.best}
    write_weights(folder / LAST, tensors, noted)


class _Noted(msgspec.Struct):
    """What a checkpoint notes of `Progress`."""

    step: Annotated[int, msgspec.Meta(ge=0)]
    best: Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)] | None


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
        return Progress()
    weights = read_weights(path)
    try:
        noted = as_record(weights.meta, _Noted)
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
    return Progress(step=noted.step, best=noted.best)


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
