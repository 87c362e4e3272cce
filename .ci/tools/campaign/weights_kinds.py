"""Kinds of files that PyTorch is needed for: weights in three formats, and the state of a run."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from campaign import plain, weights_mutations
from campaign.healthy import opened
from campaign.kind import Action, Kind, Room

assert weights_mutations  # made for these


@cache
def _network() -> Any:
    from campaign.healthy_weights import small_network

    return small_network()


def _read(room: Room) -> dict[str, Any]:
    from deepaccident_devkit.plugins.model.checkpoint import read_weights

    return dict(read_weights(room.victim).tensors)


def _loaded(room: Room) -> dict[str, Any]:
    """Put into a network, as `predict` does it; it has the healthy ones before."""
    import torch

    from deepaccident_devkit.plugins.model.checkpoint import load_weights, read_weights

    torch.manual_seed(0)
    network = _network()
    done = load_weights(network, read_weights(room.victim), whole=True)
    state = network.state_dict()
    done.to_text()
    return {name: state[name] for name in done.loaded}


def _judge(room: Room, read: Mapping[str, Any]) -> str | None:
    if room.victim.suffix == ".safetensors":
        return _same(read, plain.safetensors(room.victim)[0])
    return _same(read, plain.checkpoint(room.victim))


def _same(read: Mapping[str, Any], said: Mapping[str, Any]) -> str | None:
    """A tensor that differs from a plain reader's; float16 and the like are widened, and names may
    lose a beginning.
    """
    for name, tensor in read.items():
        names = (name, f"module.{name}", name.removeprefix("img_backbone."))
        there = next((said[each] for each in names if each in said), None)
        if there is None:
            return f"{name[:100]} is not in the file"
        (shape, found), (same, expected) = (
            tensor if isinstance(tensor, tuple) else plain.flat(tensor),
            there,
        )
        if shape != same or not np.array_equal(
            found, expected.astype(found.dtype), equal_nan=found.dtype.kind == "f"
        ):
            return f"{name[:100]} has another shape or other numbers"
    return None


def _resumed(room: Room) -> dict[str, Any]:
    """Go on with the run, which was at its end: its last weights come out of the state."""
    from campaign.healthy_weights import TRAINING, trained

    return plain.safetensors(trained(_cameras(room.home), room.tree, TRAINING))[0]


@cache
def _cameras(home: Path) -> Any:
    return opened(home / "cameras", home / "index_of_cameras")


def _judge_resumed(room: Room, read: Mapping[str, Any]) -> str | None:
    if not room.victim.is_file() or plain.safetensors(room.victim)[1].get("step") != 1:
        return None  # it began again, and took a step
    return _same(read, plain.safetensors(room.victim)[0])


_WEIGHTS = (Action(_read, _judge), Action(_loaded, _judge))
KINDS = (
    Kind("weights", "safetensors", "weights", "*.safetensors", _WEIGHTS, "torch"),
    Kind("weights of PyTorch", "pt", "weights", "*.pt", _WEIGHTS, "torch"),
    Kind("weights of old PyTorch", "pth", "weights", "*.pth", _WEIGHTS, "torch"),
    Kind(
        "training state",
        "safetensors",
        "run",
        "last.safetensors",
        (Action(_resumed, _judge_resumed),),
        "torch",
        writes=True,
    ),
)
