"""`TrainConfig`: how a model is trained."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from typing import Any, Final, get_args

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.motion.sample_labels import Purpose
from deepaccident_devkit.support.arrays import checked_number, checked_whole
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.v2x import AgentConfig, Agents

_WHOLE: Final = {
    "steps": 1,
    "moments": 1,
    "validate_every": 1,
    "validation_samples": 0,
    "save_every": 1,
    "seed": 0,
}
_SHARES: Final = ("warm_up", "partner_dropout", "alone")
_ABOVE_ZERO: Final = ("learning_rate", "clip")


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
        augment: whether the ground is turned, scaled and mirrored at random (`export.torch.RandomAugmentation`).
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
        for name in (*_SHARES, *_ABOVE_ZERO, "weight_decay"):
            value = checked_number(name, getattr(self, name), "a number", ConfigError)
            if not 0 <= value <= (1 if name in _SHARES else sys.float_info.max) or (name in _ABOVE_ZERO and not value):
                raise ConfigError(f"{name}: expected {_expected(name)}, found {value!r}")
        settle_choices(self, {"samples": get_args(Purpose)})
        object.__setattr__(self, "freeze", tuple(self.freeze))

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        described = asdict(self)
        agents = self.agents
        described["agents"] = agents.name if isinstance(agents, AgentConfig) else agents
        return described


def _expected(name: str) -> str:
    return "a share from 0 to 1" if name in _SHARES else f"a number {'above' if name in _ABOVE_ZERO else 'from'} 0"


def _check_whole(name: str, value: object, least: int) -> None:
    if checked_whole(name, value, f"a whole number from {least}", ConfigError) < least:
        raise ConfigError(f"{name}: expected a whole number from {least}, found {value!r}")
