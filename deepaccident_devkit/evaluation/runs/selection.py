"""`SampleSelection`: which samples of a release an evaluation is of; `coverage`: whether results have exactly these."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, get_args

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError, TokenError
from deepaccident_devkit.motion import samples
from deepaccident_devkit.motion.sample_labels import no_samples_text
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.text import choice, settle_choices, spelled
from deepaccident_devkit.taxonomy import AGENTS, MINI_SPLITS, SPLITS

SampleList = Literal["evaluate", "all"]
ScopeName = Literal["accident", "all"]
_SHOWN: Final = 3
"""Samples that a message names."""
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
    horizon: float = 2.0

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage(ShortRepr):
    """Results against the list of samples that are evaluated; tokens in order.

    Attributes:
        expected: how many samples the list has.
        missing: of the list, without a prediction.
        extra: samples of this release with a prediction that are not in the list.
        unknown: tokens of predictions that are no samples of this release.
        splits: that the predictions are of.
        agents: likewise, in the order of `taxonomy.AGENTS`.
    """

    expected: int
    missing: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    agents: tuple[str, ...] = ()

    @property
    def is_complete(self) -> bool:
        """Whether the results have each sample of the list, and no other."""
        return not (self.missing or self.extra or self.unknown)

    def to_text(self) -> str:
        """The differences: how many, three of each, and what predictions there are; or that all are there."""
        if self.is_complete:
            return f"all {self.expected} samples have a prediction, and nothing else has"
        parts = [
            _named(self.missing, f"of {self.expected} samples have no prediction"),
            _named(self.extra, "predictions are of samples that are not evaluated"),
            _named(self.unknown, "predictions are of no sample of this release"),
        ]
        if self.extra and not (self.missing or self.unknown):
            parts.append(
                "leave them out with --allow-partial (allow_partial=True); no sample lacks a prediction, so the "
                "numbers are not partial then"
            )
        if self.agents:
            parts.append(
                f"the predictions are of the splits {', '.join(self.splits)} and the agents {', '.join(self.agents)}"
            )
        return "; ".join(part for part in parts if part)


def coverage(dataset: Dataset, results: Collection[str], selection: SampleSelection) -> Coverage:
    """Compare the tokens of results with the samples that a selection has.

    Args:
        dataset: the release.
        results: tokens of the predictions.
        selection: what is to be evaluated.

    Raises:
        ChoiceError: as of `SampleSelection.tokens`, of the selection itself.
        ConfigError: likewise.
        NotAvailableError: likewise.
    """
    expected, given = selection.tokens(dataset), set(results)
    others = sorted(given.difference(expected))
    unknown = {token for token in others if not _is_sample(dataset, token)}
    present = {agent_of(token) for token in given - unknown}
    splits = {dataset.get("scenario", name)["split"] for name in set(map(scenario_of, given - unknown))}
    return Coverage(
        expected=len(expected),
        missing=tuple(token for token in expected if token not in given),
        extra=tuple(token for token in others if token not in unknown),
        unknown=tuple(token for token in others if token in unknown),
        splits=tuple(name for name in SPLITS if name in splits),
        agents=tuple(name for name in AGENTS if name in present),
    )


def _is_sample(dataset: Dataset, token: str) -> bool:
    try:
        dataset.getind("sample", token)
    except TokenError:
        return False
    return True


def _named(tokens: Sequence[str], what: str) -> str:
    if not tokens:
        return ""
    more = ", …" if len(tokens) > _SHOWN else ""
    return f"{len(tokens)} {what} ({', '.join(tokens[:_SHOWN])}{more})"
