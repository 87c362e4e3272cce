"""`StudyConfig`: how a study of V2X is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import get_args

from deepaccident_devkit.baselines.motion_models import MotionModel
from deepaccident_devkit.baselines.outlook import MOTION_MODELS
from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.metrics.accident import PROTOCOLS
from deepaccident_devkit.motion.sample_lists import Scope
from deepaccident_devkit.taxonomy import AGENTS, VEHICLE_AGENTS
from deepaccident_devkit.text import choice, settle_choices


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyConfig:
    """How a study is made.

    Attributes:
        egos: agents whose samples are taken, kept as a tuple. The released evaluation takes all five agents. But
            the infrastructure is no vehicle, and the vehicles of both sides show an accident twice: so it is one here.
        scope: `accident` for scenarios that were designed to end in one, `all` for normal ones too.
        model: how actors go on.
        protocol: of the accidents that are read off maps: `released`, `paper` or `boxes`. Those named explicitly are
            always evaluated by `boxes`.
        quick: fewer horizons and steps of noise and latency.
        seeds: of the links' draws of pose noise, kept as a tuple: a noisy row is of all of them together.
        resampling: how intervals are made.
    """

    egos: Sequence[str] = VEHICLE_AGENTS[:1]
    scope: Scope = "accident"
    model: MotionModel = "constant_velocity"
    protocol: str = "paper"
    quick: bool = False
    seeds: Sequence[int] = (0, 1, 2)
    resampling: Resampling = field(default_factory=Resampling)

    def __post_init__(self) -> None:
        """Check the choices; raises ChoiceError, and ConfigError for impossible seeds."""
        if isinstance(self.egos, str):
            raise ChoiceError(f"egos: expected several agents, found {self.egos!r}; give [{self.egos!r}] for one")
        object.__setattr__(self, "egos", tuple(choice("egos", ego, AGENTS) for ego in self.egos))
        if not self.egos:
            raise ChoiceError("egos: expected at least one agent, found none")
        settle_choices(self, {"scope": get_args(Scope), "model": MOTION_MODELS, "protocol": PROTOCOLS})
        object.__setattr__(self, "seeds", tuple(self.seeds))
        whole = [each for each in self.seeds if type(each) is int]
        if not whole or len(set(whole)) < len(self.seeds):
            raise ConfigError(f"seeds: expected one or more whole numbers, each once, found {self.seeds}")
