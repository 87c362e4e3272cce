"""Kinds of files that need PyTorch: weights in three formats, and the state of a training run."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from campaign import plain, weights_mutations
from campaign.healthy import open_release
from campaign.kind import Action, Kind, Output, Workspace

assert weights_mutations  # importing it registers the mutations for these kinds


@cache
def _make_network() -> Any:
    """Return a network that all cases share."""
    from campaign.healthy_weights import small_network

    return small_network()


def _read_weights(workspace: Workspace) -> Output:
    from deepaccident_devkit.plugins.model.checkpoint import read_weights

    return dict(read_weights(workspace.changed_file).tensors)


def _load_weights(workspace: Workspace) -> Output:
    """Load weights into a network that has the healthy ones, as `predict` does."""
    import torch

    from deepaccident_devkit.plugins.model.checkpoint import load_weights, read_weights

    torch.manual_seed(0)
    network = _make_network()
    report = load_weights(network, read_weights(workspace.changed_file), whole=True)
    state = network.state_dict()
    report.to_text()
    return {name: state[name] for name in report.loaded}


def _judge_weights(workspace: Workspace, tensors: Output) -> str | None:
    path = workspace.changed_file
    if path.suffix == ".safetensors":
        expected, _ = plain.read_safetensors(path)
    else:
        expected = plain.read_checkpoint(path)
    return _find_tensor_fault(tensors, expected)


def _find_tensor_fault(
    tensors: Output, expected_tensors: Mapping[str, plain.FlatTensor]
) -> str | None:
    """Return the first tensor that differs from what a plain reader reads.

    Types such as float16 may be widened, and names may have lost a prefix.
    """
    for name, tensor in tensors.items():
        names = (name, f"module.{name}", name.removeprefix("img_backbone."))
        known_names = [known_name for known_name in names if known_name in expected_tensors]
        if not known_names:
            return f"{name[:100]} is not in the file"
        shape, numbers = tensor if isinstance(tensor, tuple) else plain.flatten(tensor)
        expected_shape, expected_numbers = expected_tensors[known_names[0]]
        expected_numbers = expected_numbers.astype(numbers.dtype)
        is_float = numbers.dtype.kind == "f"
        is_same = np.array_equal(numbers, expected_numbers, equal_nan=is_float)
        if shape != expected_shape or not is_same:
            return f"{name[:100]} has another shape or other numbers"
    return None


def _resume_run(workspace: Workspace) -> Output:
    """Resume a complete run, which writes the weights of its state; return them."""
    from campaign.healthy_weights import TRAINING, train_small_model

    dataset = _open_cameras(workspace.home)
    tensors, _ = plain.read_safetensors(train_small_model(dataset, workspace.folder, TRAINING))
    return tensors


@cache
def _open_cameras(home: Path) -> Any:
    return open_release(home / "cameras", home / "index_of_cameras")


def _judge_run(workspace: Workspace, tensors: Output) -> str | None:
    if not workspace.changed_file.is_file():
        return None
    expected_tensors, notes = plain.read_safetensors(workspace.changed_file)
    if notes.get("step") != 1:
        return None  # it began again, and took a step
    return _find_tensor_fault(tensors, expected_tensors)


_WEIGHT_ACTIONS = (Action(_read_weights, _judge_weights), Action(_load_weights, _judge_weights))
_RUN_ACTION = Action(_resume_run, _judge_run)
KINDS = (
    Kind("weights", "safetensors", "weights", "*.safetensors", _WEIGHT_ACTIONS, "torch"),
    Kind("weights of PyTorch", "pt", "weights", "*.pt", _WEIGHT_ACTIONS, "torch"),
    Kind("weights of old PyTorch", "pth", "weights", "*.pth", _WEIGHT_ACTIONS, "torch"),
    Kind(
        "training state",
        "safetensors",
        "run",
        "last.safetensors",
        (_RUN_ACTION,),
        "torch",
        writes=True,
    ),
)
