"""The config of a training run, its device, and its state on disk, from which it resumes."""

import json
import math
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

import msgspec
import torch
from torch import Tensor, distributed, nn
from torch.optim import AdamW

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, shortened
from deepaccident_devkit.plugins.model.checkpoint import (
    OPTIMIZER_PREFIX,
    STATE_FILE,
    read_weights,
    short_reason,
    write_weights,
)
from deepaccident_devkit.selection.samples import Purpose
from deepaccident_devkit.support.arrays import checked_number, checked_whole
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import members_of, settle_choices
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.v2x import Agents
from deepaccident_devkit.v2x.agents import agents_note

# Integer field → lowest valid value.
_MIN_INTEGERS = {
    "steps": 1,
    "moments": 1,
    "validate_every": 1,
    "validation_samples": 0,
    "save_every": 1,
    "seed": 0,
}
_LARGEST_FLOAT = sys.float_info.max
_SHARE_RANGE = (0, 1, "a share from 0 to 1")
_POSITIVE_RANGE = (math.ulp(0), _LARGEST_FLOAT, "a number above 0")
# Number field → lowest and highest valid value, and what is expected, in words.
_NUMBER_RANGES = {
    "warm_up": _SHARE_RANGE,
    "partner_dropout": _SHARE_RANGE,
    "alone": _SHARE_RANGE,
    "learning_rate": _POSITIVE_RANGE,
    "clip": _POSITIVE_RANGE,
    "weight_decay": (0, _LARGEST_FLOAT, "a number from 0"),
}
_LOG_FILE = "log.jsonl"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """Rules of a training run; raises ConfigError or ChoiceError if a value is not valid.

    The optimizer is AdamW; the learning rate rises linearly and falls along a cosine to 0.

    Attributes:
        steps: Number of optimizer steps.
        moments: Number of moments per step and process; all agents of a moment are encoded once.
        egos: Number of a moment's agents that serve as the ego, drawn in each step; None for all
            agents.
        agents: The agents that cooperate with each ego (`v2x.cooperating_agents`); None for all
            agents.
        partner_dropout: Probability that a partner's data is dropped in a step.
        alone: Probability that all partners' data is dropped in a step.
        learning_rate: The highest learning rate.
        weight_decay: Weight decay of AdamW.
        warm_up: Fraction of the steps during which the rate rises.
        clip: Maximum norm of all gradients together.
        augment: Whether the ground is rotated, scaled and mirrored at random
            (`training.torch.RandomAugmentation`).
        split: Split to train on: `train`, `val`, … or a split file.
        validation: Split whose score selects the best checkpoint; None for no validation.
        samples: Which samples of `split` are used (`motion.samples`).
        validate_every: Steps between two validations.
        validation_samples: Number of the split's samples, evenly spaced; 0 for all.
        save_every: Steps between two checkpoints; a killed run loses at most that many.
        seed: Seed of the first weights, the order, and all random draws.
        bf16: Whether to compute in bfloat16 where autocast allows it; GPUs only.
        freeze: Prefixes of the names of parameters that are not trained.
    """

    # Data of a step.
    steps: int = 1500
    moments: int = 1
    egos: int | None = None
    agents: Agents = "all"
    partner_dropout: float = 0.3
    alone: float = 0.2
    # Optimizer.
    learning_rate: float = 2e-3
    weight_decay: float = 0.01
    warm_up: float = 0.05
    clip: float = 35.0
    # Samples.
    augment: bool = True
    split: str = "train"
    validation: str | None = "val"
    samples: Purpose = "all"
    # Validation and checkpoints.
    validate_every: int = 250
    validation_samples: int = 40
    save_every: int = 50
    # Computation.
    seed: int = 0
    bf16: bool = False
    freeze: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check all fields."""
        for name, min_integer in _MIN_INTEGERS.items():
            _check_integer(name, getattr(self, name), min_integer)
        if self.egos is not None:
            _check_integer("egos", self.egos, 1)
        for name, (lowest, highest, expected) in _NUMBER_RANGES.items():
            value = checked_number(name, getattr(self, name), "a number", ConfigError)
            if not lowest <= value <= highest:
                raise ConfigError(f"{name}: expected {expected}, found {value!r}")
        settle_choices(self, {"samples": get_args(Purpose)})
        prefixes = members_of("freeze", self.freeze, "beginnings of names", error=ConfigError)
        object.__setattr__(self, "freeze", tuple(prefixes))

    def as_dict(self) -> dict[str, Any]:
        """Return all fields in JSON types."""
        values = asdict(self)
        values["agents"] = agents_note(self.agents)
        return values


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondSource:
    """Another release, or nuScenes, to train on in addition to the first.

    Attributes:
        dataset: The release.
        split: Split of the release.
        mix: Fraction of all moments that come from this source.
    """

    dataset: Dataset
    split: str = "train"
    mix: float = 0.5

    def __post_init__(self) -> None:
        """Check the fraction; raise ConfigError unless it lies between 0 and 1."""
        share = checked_number("mix", self.mix, "a number", ConfigError)
        if not 0 < share < 1:
            raise ConfigError(f"mix: expected a share between 0 and 1, found {self.mix!r}")

    def as_dict(self) -> dict[str, Any]:
        """Return what a run's notes say about the source."""
        index = self.dataset.tables_folder.name
        return {"index": index, "split": self.split, "mix": self.mix}


def _check_integer(name: str, value: object, lowest: int) -> None:
    """Raise ConfigError unless a value is an integer that is at least `lowest`."""
    expected = f"a whole number from {lowest}"
    if checked_whole(name, value, expected, ConfigError) < lowest:
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunProcess:
    """One process of a run.

    Attributes:
        device: Device, such as `cpu` or `cuda:1`.
        rank: Number of the process, from 0.
        ranks: Number of processes.
    """

    device: str
    rank: int = 0
    ranks: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this is the first process, which writes the files."""
        return self.rank == 0


def checked_device(device: str) -> str:
    """Return a device that exists; `auto` is the first GPU if there is one, otherwise the CPU.

    Raises:
        ConfigError: There is no such device.
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
    """Yield this process of a run; raise ConfigError if the device or `torchrun` is unusable.

    Under `torchrun`, it is connected to the other processes until the block ends.
    """
    process_device = checked_device(device)
    ranks = os.environ.get("WORLD_SIZE", "1")
    rank = os.environ.get("RANK", "0")
    if ranks == "1":
        yield RunProcess(device=process_device)
        return
    try:
        if not 0 <= int(rank) < int(ranks):
            raise ValueError("RANK must be a number from 0 and less than WORLD_SIZE")
        if process_device == "cuda":
            process_device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
            torch.cuda.set_device(process_device)
        distributed.init_process_group("nccl" if process_device.startswith("cuda") else "gloo")
    except (RuntimeError, ValueError, TypeError) as error:
        raise ConfigError(
            f"WORLD_SIZE={shortened(ranks)}, RANK={shortened(rank)}: the processes cannot train "
            f"together ({shortened(str(error))}); start all of them with torchrun, or unset "
            "WORLD_SIZE to train in one process"
        ) from error
    try:
        yield RunProcess(
            device=process_device, rank=distributed.get_rank(), ranks=distributed.get_world_size()
        )
    finally:
        distributed.destroy_process_group()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use only one thread inside the block.

    The last bits of sums depend on the number of threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class _Row(msgspec.Struct):
    """The required fields of a row of the log."""

    step: Annotated[int, msgspec.Meta(ge=0, le=1 << 53)]
    losses: dict[str, float] | None = None
    validation: dict[str, float] | None = None


def read_log(folder: Path) -> list[NamedValues]:
    """Return the rows of a run's log in order; an empty list if it has no log.

    An incomplete last line is left out. Raise ConfigError if the log cannot be read, or if a line
    is not a JSON object that describes a step.
    """
    path = folder / _LOG_FILE
    if not path.is_file():
        return []
    try:
        lines = read_bytes(path, "bundle").split(b"\n")[:-1]
    except OSError as error:
        raise ConfigError(f"{path}: {fault_text(error)}; remove the file") from error
    rows = []
    for number, line in enumerate(lines, 1):
        rows.append(_parse_row(f"{path}:{number}", line))
    return rows


def cut_log(folder: Path, step: int) -> None:
    """Remove the log's rows after a step."""
    text = ""
    for row in read_log(folder):
        if row["step"] <= step:
            text += f"{json.dumps(row)}\n"
    write_bytes(folder / _LOG_FILE, text.encode())


def add_to_log(folder: Path, row: ReadOnlyValues) -> None:
    """Append a row to the log on disk."""
    with (folder / _LOG_FILE).open("a", encoding="utf-8") as file:
        file.write(f"{json.dumps(row)}\n")


def _parse_row(location: str, line: bytes) -> NamedValues:
    """Parse a line of the log; raise a ConfigError that names its location if it is not valid."""
    try:
        # A log may have a million lines, and msgspec is ten times as fast as other readers.
        row: NamedValues = msgspec.json.decode(line)
        as_record(row, _Row)
    except (ValueError, msgspec.DecodeError, RecursionError) as error:
        raise ConfigError(
            f"{location}: expected a JSON object with a step ({shortened(str(error))}); remove the "
            "line, or the file"
        ) from error
    return row


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingProgress:
    """The progress of a run.

    Attributes:
        step: Number of finished steps.
        best: The best score so far; None before the first validation.
    """

    step: Annotated[int, msgspec.Meta(ge=0)]
    best: Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)] | None


def save_state(
    folder: Path,
    model: nn.Module,
    optimizer: AdamW,
    progress: TrainingProgress,
    meta: ReadOnlyValues,
) -> None:
    """Write the state of a run atomically."""
    tensors = dict(model.state_dict())
    for number, state in optimizer.state_dict()["state"].items():
        for name, value in state.items():
            tensors[f"{OPTIMIZER_PREFIX}{number}.{name}"] = torch.as_tensor(value)
    notes = {**meta, "step": progress.step, "best": progress.best}
    write_weights(folder / STATE_FILE, tensors, notes)


def load_state(folder: Path, model: nn.Module, optimizer: AdamW, steps: int) -> TrainingProgress:
    """Load a run's state into model and optimizer; return its progress.

    If there is no state, nothing is loaded and the progress is 0. Raise ConfigError if the state
    cannot be read, or belongs to another model or to a run with another number of steps.
    """
    path = folder / STATE_FILE
    if not path.exists():
        return TrainingProgress(step=0, best=None)
    weights = read_weights(path)
    try:
        progress = as_record(weights.meta, TrainingProgress)
        if progress.step > steps:
            raise ValueError(f"it has {progress.step} steps, but the run has {steps}")
        states = _find_optimizer_states(weights.tensors, model, optimizer)
        for state in states.values():
            optimizer_steps = float(state["step"])
            if not 1 <= optimizer_steps <= progress.step:
                raise ValueError(
                    f"its optimizer has made {optimizer_steps} steps, but the run has made "
                    f"{progress.step}"
                )
    except ValueError as error:
        raise ConfigError(
            f"{path}: is not a checkpoint of this run ({short_reason(error)}); remove it, or "
            "choose another folder"
        ) from error
    model.load_state_dict({name: weights.tensors[name] for name in model.state_dict()})
    optimizer_state = optimizer.state_dict()
    optimizer_state["state"] = states
    optimizer.load_state_dict(optimizer_state)
    return progress


def _find_optimizer_states(
    tensors: Mapping[str, Tensor], model: nn.Module, optimizer: AdamW
) -> dict[int, dict[str, Tensor]]:
    """Return the optimizer's state of each parameter.

    Raise ValueError if a tensor belongs to neither the model nor the optimizer, or if one is
    missing.
    """
    expected = dict(model.state_dict())
    states: dict[int, dict[str, Tensor]] = {}
    parameters: list[Tensor] = []
    for group in optimizer.param_groups:
        parameters += group["params"]
    for number, parameter in enumerate(parameters):
        templates = {"step": torch.zeros(()), "exp_avg": parameter, "exp_avg_sq": parameter}
        names = {key: f"{OPTIMIZER_PREFIX}{number}.{key}" for key in templates}
        # A parameter that never had a gradient has no state.
        if not tensors.keys().isdisjoint(names.values()):
            states[number] = {}
            for key, name in names.items():
                expected[name] = templates[key]
                if name in tensors:
                    states[number][key] = tensors[name]
    differing_names = sorted(tensors.keys() ^ expected.keys())
    if differing_names:
        raise ValueError(f"{shortened(differing_names[0])!r} is missing or unexpected")
    for name, template in expected.items():
        found_form = _describe_form(tensors[name])
        expected_form = _describe_form(template)
        if found_form != expected_form:
            raise ValueError(f"{name} is {found_form}, not {expected_form}")
    return states


def _describe_form(tensor: Tensor) -> str:
    """Return the shape and the dtype of a tensor as text."""
    shape = str(tuple(tensor.shape))
    return f"{shortened(shape)} of {tensor.dtype}"
