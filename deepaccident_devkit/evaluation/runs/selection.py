"""`SampleSelection`: which samples of a release an evaluation is of."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, get_args

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.motion import samples
from deepaccident_devkit.motion.sample_lists import no_samples_text
from deepaccident_devkit.taxonomy import AGENTS, MINI_SPLITS, SPLITS
from deepaccident_devkit.text import choice, settle_choices, spelled

SampleList = Literal["evaluate", "all"]
ScopeName = Literal["accident", "all"]
_DEFAULT_HORIZON: Final = 2.0
LIST_STEP: Final = 0.5
"""Seconds from one sample of a list to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleSelection:
    """A list of samples, as `motion.samples` makes it.

    Attributes:
        split: `train`, `val`, … or the path of a split file.
        samples: `evaluate` for those within the horizon before the end, `all` for two a second of whole scenarios.
        scope: `accident` for scenarios designed to end in one, `all` for the normal ones, too.
        agents: whose samples, in the order of `taxonomy.AGENTS`; None for all.
        horizon: seconds before the end; only to `evaluate`.
    """

    split: str
    samples: SampleList = "evaluate"
    scope: ScopeName = "accident"
    agents: tuple[str, ...] | None = None
    horizon: float = _DEFAULT_HORIZON

    def __post_init__(self) -> None:
        """Check and put the agents in order; raises ChoiceError."""
        object.__setattr__(self, "split", spelled(os.fspath(self.split), (*SPLITS, *MINI_SPLITS)))
        settle_choices(self, {"samples": get_args(SampleList), "scope": get_args(ScopeName)})
        if self.agents is not None:
            object.__setattr__(self, "agents", _agents(self.agents))

    def tokens(self, dataset: Dataset) -> list[str]:
        """The samples' tokens by scenario, agent and time.

        Raises:
            ChoiceError: no such split.
            ConfigError: `evaluate` with a horizon that is no number of steps of 0.5 s.
            NotAvailableError: this release has no such samples with labels.
        """
        horizon = self.horizon if self.samples == "evaluate" else LIST_STEP
        steps = horizon / LIST_STEP
        if abs(steps - round(steps)) > 1e-6:
            raise ConfigError(
                f"horizon: samples to evaluate are {LIST_STEP} s apart, so that {horizon:g} s does not say which; "
                f"choose a multiple, or samples='all'"
            )
        listed = samples(dataset, self.split, self.samples, "paper", horizon=horizon, scope=self.scope)
        if self.samples == "all" and self.scope == "accident":
            listed = [token for token in listed if _designed_accident(token)]
        chosen = [token for token in listed if self.agents is None or agent_of(token) in self.agents]
        if not chosen:
            whose = "" if self.agents is None else f" of {', '.join(self.agents)}"
            raise NotAvailableError(
                f"{self.split}: this release has no labelled samples{whose} there ({self.text()}); "
                f"{no_samples_text(dataset, self.split, self.scope)}"
            )
        return chosen

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON holds it."""
        return asdict(self) | {"agents": None if self.agents is None else list(self.agents)}

    def text(self) -> str:
        """In words: `split val, samples evaluate (the last 2 s), scope accident, all agents`."""
        within = f" (the last {self.horizon:g} s)" if self.samples == "evaluate" else ""
        whose = "all agents" if self.agents is None else f"agents {', '.join(self.agents)}"
        return f"split {self.split}, samples {self.samples}{within}, scope {self.scope}, {whose}"

    def choices(self) -> dict[str, Any]:
        """The fields that say which list it is: all but agents and a horizon that are the default."""
        named: dict[str, Any] = {"split": self.split, "samples": self.samples, "scope": self.scope}
        if self.agents is not None:
            named["agents"] = self.agents
        if self.samples == "evaluate" and self.horizon != _DEFAULT_HORIZON:
            named["horizon"] = self.horizon
        return named


def scenario_of(token: str) -> str:
    """The scenario's token in a sample's."""
    return token.rsplit("/", 2)[0]


def agent_of(token: str) -> str:
    """The agent's name in a sample's token; empty if it is no sample's token."""
    return token.rsplit("/", 2)[1] if token.count("/") > 1 else ""


def _designed_accident(token: str) -> bool:
    return token.split("/", 1)[0].endswith("_accident")


def _agents(given: Sequence[str]) -> tuple[str, ...]:
    names = [choice("agents", name, AGENTS) for name in ([given] if isinstance(given, str) else given)]
    if not names:
        raise ChoiceError("agents: expected at least one agent, or None for all, found none")
    return tuple(name for name in AGENTS if name in names)
