"""A run's state on disk: weights, optimizer and step in one file, from which a killed run goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import AdamW

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.checkpoint import LAST, OPTIMIZER, read_weights, write_weights


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


def load_state(folder: Path, model: nn.Module, optimizer: AdamW) -> Progress:
    """Put the last checkpoint into model and optimizer; how far the run was, nothing done if there is none.

    Raises:
        ConfigError: the checkpoint cannot be read, or is of another model.
    """
    path = folder / LAST
    if not path.is_file():
        return Progress()
    weights = read_weights(path)
    states: dict[int, dict[str, Tensor]] = {}
    for name, each in weights.tensors.items():
        if name.startswith(OPTIMIZER):
            number, _, part = name.removeprefix(OPTIMIZER).partition(".")
            states.setdefault(int(number), {})[part] = each
    own = {name: each for name, each in weights.tensors.items() if not name.startswith(OPTIMIZER)}
    try:
        model.load_state_dict(own)
        optimizer.load_state_dict({"state": states, "param_groups": optimizer.state_dict()["param_groups"]})
        return Progress(step=int(weights.meta["step"]), best=weights.meta["best"])
    except (RuntimeError, KeyError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{path}: is no checkpoint of this run ({reason}); remove it, or train elsewhere") from error
