"""Files of weights, healthy and hostile, and how they are read; all of it needs PyTorch."""

import io
import pickle
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from campaign.room import Action, Kind, Room
from deepaccident_devkit.model.checkpoint import LAST, load_weights, read_weights, write_weights
from deepaccident_devkit.model.training.state import Progress, load_state, save_state

STEPS = 3
_FIRST = "img_backbone.0"
FOLDER = "weights"


def tiny_model() -> nn.Module:
    """A model of two layers with names of the release's, always the same."""
    torch.manual_seed(0)
    return nn.ModuleDict({"img_backbone": nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4))})


def write_weights_of_all_kinds(folder: Path) -> None:
    """Ours, PyTorch's new and old files, and the state of a run."""
    model, home = tiny_model(), folder / FOLDER
    home.mkdir()
    held = {"meta": {"epoch": 3, "mmdet_version": "2.1"}, "state_dict": model.state_dict()}
    write_weights(home / "ours.safetensors", model.state_dict(), {"preset": "tiny", "note": "a healthy one"})
    torch.save(held, home / "new.pt")
    torch.save(held, home / "old.pth", _use_new_zipfile_serialization=False)
    optimizer = _trained(model)
    save_state(home, model, optimizer, Progress(step=1, best=0.5), {"preset": "tiny"})


def _trained(model: nn.Module) -> torch.optim.AdamW:
    """After one step."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.1)
    model.get_submodule("img_backbone")(torch.ones(1, 3, 5, 5)).square().sum().backward()
    optimizer.step()
    return optimizer


def _arrays(tensors: Any) -> dict[str, np.ndarray]:
    return {name: each.float().numpy() for name, each in tensors.items()}


def _read(room: Room) -> Any:
    weights = read_weights(room.victim)
    model = tiny_model()
    load_weights(model, weights)
    return _arrays(weights.tensors)


def _state(room: Room) -> Any:
    model = tiny_model()
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.1)
    progress = load_state(room.tree, model, optimizer, STEPS)
    return progress.step, progress.best, _arrays(model.state_dict())


def _ours(path: Path) -> dict[str, np.ndarray]:
    from safetensors.torch import load

    return _arrays(load(path.read_bytes()))


def _judge_ours(room: Room, read: Any) -> str | None:
    return _difference(read, _ours(room.victim))


def _judge_foreign(room: Room, read: Any) -> str | None:
    """PyTorch's own restricted reader is the plain one; what it refuses for members without tensors is as before."""
    held: Any = {}
    for path in (room.victim, room.healthy):
        with suppress(RuntimeError, UnicodeDecodeError):
            held = torch.load(io.BytesIO(path.read_bytes()), weights_only=True)
            break
    tensors = {
        name: each for name, each in held["state_dict"].items() if type(name) is str and isinstance(each, torch.Tensor)
    }
    return _difference(read, _arrays({name.removeprefix("module."): each for name, each in tensors.items()}))


def _judge_state(room: Room, read: Any) -> str | None:
    step, best, arrays = read
    if not room.victim.is_file():
        return None if step == 0 else "a state, though there is no file"
    if not (0 <= step <= STEPS and (best is None or np.isfinite(best))):
        return f"step {step}, best {best}"
    stored = _ours(room.victim)
    return _difference(arrays, {name: stored[name] for name in arrays})


def _difference(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> str | None:
    if found.keys() != expected.keys():
        return "other names"
    wrong = [name for name, array in found.items() if not np.array_equal(array, expected[name], equal_nan=True)]
    return f"{wrong[0]} differs" if wrong else None


WEIGHTS_KINDS = (
    Kind("weights", "safetensors", FOLDER, "ours.safetensors", (Action(_read, _judge_ours),), apart=True),
    Kind("weights of PyTorch", "checkpoint", FOLDER, "new.pt", (Action(_read, _judge_foreign),), apart=True),
    Kind("old weights of PyTorch", "old checkpoint", FOLDER, "old.pth", (Action(_read, _judge_foreign),), apart=True),
    Kind("training state", "safetensors", FOLDER, LAST, (Action(_state, _judge_state),), apart=True),
)


# ---- hostile ones


class Asks:
    """What a pickle asks its reader to call."""

    def __init__(self, function: Any, *arguments: object) -> None:
        self._call = (function, arguments)

    def __reduce__(self) -> Any:
        return self._call


def hostile_tensors(rng: np.random.Generator) -> Any:
    """A state dict of what no weights have."""
    one = torch.ones(2, 3)
    odd: list[Any] = [
        torch.empty(2, 3, device="meta"),
        one.to_sparse(),
        one.to(torch.complex64),
        one.double(),
        one.bool(),
        one.to(torch.float8_e4m3fn),
        torch.quantize_per_tensor(one, 0.1, 0, torch.qint8),
        torch.ones(1).expand(1 << 18, 1 << 16),  # a gigabyte times 64 of one stored number
        torch.ones(1).as_strided((1 << 30,), (0,)),
        torch.empty(0, 1 << 40),
        one.reshape((1,) * 60 + (2, 3)),
        one.t(),
        nn.Parameter(one),
        [one, one],
        {"deep": {"deeper": one}},
        one[:, 1:],
        torch.full((2, 3), float("nan")),
    ]
    names: list[Any] = [
        f"{_FIRST}.weight",
        f"{_FIRST}.bias",
        7,
        b"name",
        1.5,
        None,
        (1, 2),
        "\x1b[31mred",
        "x" * 5_000_000,
        "",
    ]
    held = dict(tiny_model().state_dict())
    name = names[int(rng.integers(len(names)))]
    return {**held, name: odd[int(rng.integers(len(odd)))]} if rng.integers(2) else {**held, name: one}


def hostile_pickle(marker: Path, rng: np.random.Generator) -> bytes:
    """A pickle that asks for memory, or runs code."""
    import os

    asks: list[Any] = [
        Asks(bytearray, 6_000_000_000),
        Asks(bytes, 6_000_000_000),
        Asks(os.mkdir, str(marker)),
        Asks(torch.zeros, 1 << 36),
        Asks(eval, f"__import__('os').mkdir({str(marker)!r})"),
        Asks(getattr, "text", "join"),
        Asks(torch._utils._rebuild_tensor_v2, torch.ones(1).untyped_storage(), 0, (1 << 34,), (0,), False, None),
        [bytearray(10)] * 100_000,
    ]
    held = {"state_dict": {f"{_FIRST}.weight": asks[int(rng.integers(len(asks)))]}}
    return pickle.dumps(held, protocol=2)


def saved(held: Any, *, old: bool) -> bytes:
    """As `torch.save` writes it."""
    buffer = io.BytesIO()
    torch.save(held, buffer, _use_new_zipfile_serialization=not old)
    return buffer.getvalue()
