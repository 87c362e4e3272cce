"""How a model is trained, where a run computes, and its state on disk, from which a killed run goes on."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final, get_args

import msgspec
import torch
from torch import Tensor, distributed, nn
from torch.optim import AdamW

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, shortened
from deepaccident_devkit.plugins.model.checkpoint import (
    LAST,
    OPTIMIZER,
    read_weights,
    reason_of,
    write_weights,
)
from deepaccident_devkit.selection.samples import Purpose
from deepaccident_devkit.support.arrays import checked_number, checked_whole
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import members_of, settle_choices
from deepaccident_devkit.v2x import Agents
from deepaccident_devkit.v2x.agents import agents_note

_WHOLE: Final = {
    "steps": 1,
    "moments": 1,
    "validate_every": 1,
    "validation_samples": 0,
    "save_every": 1,
    "seed": 0,
}
# Field → least and highest value, and what is expected.
_NUMBERS: Final = {
    **dict.fromkeys(("warm_up", "partner_dropout", "alone"), (0, 1, "a share from 0 to 1")),
    **dict.fromkeys(
        ("learning_rate", "clip"), (math.ulp(0), sys.float_info.max, "a number above 0")
    ),
    "weight_decay": (0, sys.float_info.max, "a number from 0"),
}
_LOG_FILE = "log.jsonl"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """How a model is trained; checked when made, raises ConfigError or ChoiceError.

    The optimizer is AdamW; the learning rate rises linearly and falls along a cosine to 0.

    Attributes:
        steps: of the optimizer.
        moments: of a step, on each process; all agents of a moment are encoded once.
        egos: of a moment, how many agents are the ego in turn, drawn in each step; None for all that are there.
        agents: who cooperates with each ego (`v2x.cooperating_agents`); None for all that are there.
        partner_dropout: the probability that a partner is not heard in a step.
        alone: the probability that none is heard.
        learning_rate: the highest.
        weight_decay: of AdamW.
        warm_up: share of the steps in which the rate rises.
        clip: the largest norm of all gradients together.
        augment: whether the ground is turned, scaled and mirrored at random (`training.torch.RandomAugmentation`).
        split: to learn from: `train`, `val`, … or a split file.
        validation: the split whose score chooses the best checkpoint; None for none.
        samples: which samples of `split` (`motion.samples`).
        validate_every: steps from one validation to the next.
        validation_samples: how many of the split's, evenly chosen; 0 for all.
        save_every: steps from one checkpoint to the next, which a killed run can lose.
        seed: of the first weights, the order, and all that is drawn.
        bf16: whether to compute in bfloat16 where autocast does, on GPUs.
        freeze: beginnings of the names of parameters that stay as they are.
    """

    steps: int = 1500
    moments: int = 1
    egos: int | None = None
    agents: Agents = "all"
    partner_dropout: float = 0.3
    alone: float = 0.2
    learning_rate: float = 2e-3
    weight_decay: float = 0.01
    warm_up: float = 0.05
    clip: float = 35.0
    augment: bool = True
    split: str = "train"
    validation: str | None = "val"
    samples: Purpose = "all"
    validate_every: int = 250
    validation_samples: int = 40
    save_every: int = 50
    seed: int = 0
    bf16: bool = False
    freeze: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check all fields."""
        for name, least in _WHOLE.items():
            _check_whole(name, getattr(self, name), least)
        if self.egos is not None:
            _check_whole("egos", self.egos, 1)
        for name, (lowest, highest, expected) in _NUMBERS.items():
            value = checked_number(name, getattr(self, name), "a number", ConfigError)
            if not lowest <= value <= highest:
                raise ConfigError(f"{name}: expected {expected}, found {value!r}")
        settle_choices(self, {"samples": get_args(Purpose)})
        object.__setattr__(
            self,
            "freeze",
            tuple(members_of("freeze", self.freeze, "beginnings of names", error=ConfigError)),
        )

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        return {**asdict(self), "agents": agents_note(self.agents)}


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondSource:
    """Another release, or nuScenes, to learn from beside the first.

    Attributes:
        dataset: of it.
        split: of it.
        mix: share of all moments that are from it.
    """

    dataset: Dataset
    split: str = "train"
    mix: float = 0.5

    def __post_init__(self) -> None:
        """Check the share; raises ConfigError."""
        if not 0 < checked_number("mix", self.mix, "a number", ConfigError) < 1:
            raise ConfigError(f"mix: expected a share between 0 and 1, found {self.mix!r}")

    def as_dict(self) -> dict[str, Any]:
        """What a run notes of it."""
        return {"index": self.dataset.tables_folder.name, "split": self.split, "mix": self.mix}


def _check_whole(name: str, value: object, least: int) -> None:
    if checked_whole(name, value, f"a whole number from {least}", ConfigError) < least:
        raise ConfigError(f"{name}: expected a whole number from {least}, found {value!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunProcess:
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
        raise ConfigError(
            f"device: {device!r} cannot be used ({str(error).splitlines()[0]}); choose cpu"
        ) from error
    return device


@contextmanager
def processes(device: str) -> Iterator[RunProcess]:
    """The place of this process, with `torchrun` together with the others until the block ends; raises ConfigError."""
    chosen = checked_device(device)
    ranks, rank = os.environ.get("WORLD_SIZE", "1"), os.environ.get("RANK", "0")
    if ranks == "1":
        yield RunProcess(device=chosen)
        return
    try:
        if not 0 <= int(rank) < int(ranks):
            raise ValueError("RANK must be a number from 0 and less than WORLD_SIZE")
        if chosen == "cuda":
            chosen = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
            torch.cuda.set_device(chosen)
        distributed.init_process_group("nccl" if chosen.startswith("cuda") else "gloo")
    except (RuntimeError, ValueError, TypeError) as error:
        raise ConfigError(
            f"WORLD_SIZE={shortened(ranks)}, RANK={shortened(rank)}: the processes cannot train together "
            f"({shortened(str(error))}); start all of them by torchrun, or unset WORLD_SIZE to train in this one"
        ) from error
    try:
        yield RunProcess(
            device=chosen, rank=distributed.get_rank(), ranks=distributed.get_world_size()
        )
    finally:
        distributed.destroy_process_group()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread in the block: the bits of sums depend on how many there are."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class _Row(msgspec.Struct):
    """What readers need of a row."""

    step: Annotated[int, msgspec.Meta(ge=0, le=1 << 53)]
    losses: dict[str, float] | None = None
    validation: dict[str, float] | None = None


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The rows of a run's log, in order; none if it has no log. A last line that is cut off is left out.

    Raises ConfigError: it cannot be read, or a line is no JSON object of a step.
    """
    path = folder / _LOG_FILE
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
    write_bytes(folder / _LOG_FILE, "".join(f"{json.dumps(row)}\n" for row in kept).encode())


def add_to_log(folder: Path, row: Mapping[str, Any]) -> None:
    """Add a row, and have it on disk."""
    with (folder / _LOG_FILE).open("a", encoding="utf-8") as file:
        file.write(f"{json.dumps(row)}\n")


def _row(where: str, line: bytes) -> dict[str, Any]:
    try:
        row: dict[str, Any] = msgspec.json.decode(
            line
        )  # a log may have a million lines: ten times as fast as others
        as_record(row, _Row)
    except (ValueError, msgspec.DecodeError, RecursionError) as error:
        raise ConfigError(
            f"{where}: expected a JSON object with a step ({shortened(str(error))}); remove the line, or the file"
        ) from error
    return row


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingProgress:
    """How far a run is.

    Attributes:
        step: how many steps are done.
        best: the best score so far; None before the first validation.
    """

    step: Annotated[int, msgspec.Meta(ge=0)]
    best: Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)] | None


def save_state(
    folder: Path,
    model: nn.Module,
    optimizer: AdamW,
    progress: TrainingProgress,
    meta: Mapping[str, Any],
) -> None:
    """Write the last checkpoint, completely or not at all."""
    tensors = dict(model.state_dict())
    for number, state in optimizer.state_dict()["state"].items():
        tensors |= {
            f"{OPTIMIZER}{number}.{name}": torch.as_tensor(each) for name, each in state.items()
        }
    write_weights(folder / LAST, tensors, {**meta, "step": progress.step, "best": progress.best})


def load_state(folder: Path, model: nn.Module, optimizer: AdamW, steps: int) -> TrainingProgress:
    """Put a run's last checkpoint into model and optimizer; how far it was, nothing done if there is none.

    Raises ConfigError: the checkpoint cannot be read, or is of another model or run of so many steps.
    """
    path = folder / LAST
    if not path.exists():
        return TrainingProgress(step=0, best=None)
    weights = read_weights(path)
    try:
        noted = as_record(weights.meta, TrainingProgress)
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
    optimizer.load_state_dict(
        {"state": states, "param_groups": optimizer.state_dict()["param_groups"]}
    )
    return noted


def _states(
    tensors: Mapping[str, Tensor], model: nn.Module, optimizer: AdamW
) -> dict[int, dict[str, Tensor]]:
    """The optimizer's state of each parameter; raises ValueError if tensors are not just the model's and those."""
    wanted, states = dict(model.state_dict()), {}
    for number, parameter in enumerate(
        each for group in optimizer.param_groups for each in group["params"]
    ):
        likes = {"step": torch.zeros(()), "exp_avg": parameter, "exp_avg_sq": parameter}
        names = {part: f"{OPTIMIZER}{number}.{part}" for part in likes}
        if not tensors.keys().isdisjoint(
            names.values()
        ):  # a parameter without any gradient has no state
            wanted |= {names[part]: like for part, like in likes.items()}
            states[number] = names
    if strange := sorted(tensors.keys() ^ wanted.keys()):
        raise ValueError(f"{shortened(strange[0])!r} is missing, or should not be there")
    for name, like in wanted.items():
        if _form(tensors[name]) != _form(like):
            raise ValueError(f"{name} is {_form(tensors[name])}, not {_form(like)}")
    return {
        number: {part: tensors[name] for part, name in names.items()}
        for number, names in states.items()
    }


def _form(tensor: Tensor) -> str:
    return f"{shortened(str(tuple(tensor.shape)))} of {tensor.dtype}"
