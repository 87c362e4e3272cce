"""`SampleSelection`: which samples of a release an evaluation is of; `coverage`: whether results have exactly these."""

from __future__ import annotations

import os
import shlex
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal, get_args

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError, TokenError
from deepaccident_devkit.motion import samples
from deepaccident_devkit.motion.sample_lists import no_samples_text
from deepaccident_devkit.taxonomy import AGENTS, MINI_SPLITS, SPLITS
from deepaccident_devkit.text import choice, settle_choices, spelled

SampleList = Literal["evaluate", "all"]
ScopeName = Literal["accident", "all"]
_SHOWN: Final = 3
"""Samples that a message names."""
_LISTS: Final[tuple[tuple[SampleList, ScopeName, float], ...]] = (
    ("evaluate", "accident", 2.0),
    ("evaluate", "all", 2.0),
    ("evaluate", "accident", 3.0),
    ("evaluate", "accident", 4.0),
    ("evaluate", "all", 3.0),
    ("evaluate", "all", 4.0),
    ("all", "all", 2.0),
    ("all", "accident", 2.0),
)
"""The lists of a split's samples that a user could mean."""
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage(ShortRepr):
    """Results against the list of samples that are evaluated; tokens in order.

    Attributes:
        expected: how many samples the list has.
        missing: of the list, without a prediction.
        extra: samples of this release with a prediction that are not in the list.
        unknown: tokens of predictions that are no samples of this release.
        guess: the list that the results were probably made for; None where they cover theirs, or fit none.
        guess_share: the share of samples that this list and the results have in common, of all in either.
    """

    expected: int
    missing: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    guess: SampleSelection | None = None
    guess_share: float = 0.0

    @property
    def is_complete(self) -> bool:
        """Whether the results have each sample of the list, and no other."""
        return not (self.missing or self.extra or self.unknown)

    def to_text(self) -> str:
        """The differences: how many, three of each, and the list that was probably meant; or that all are there."""
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
        if self.guess is not None:
            shared = "they have just its samples" if self.guess_share == 1 else f"{self.guess_share:.0%} in common"
            parts += [f"the results were probably made for {self.guess.text()} ({shared})", _again(self.guess)]
        return "; ".join(part for part in parts if part)


def _again(guess: SampleSelection) -> str:
    """How to evaluate another list, with options of the command line and in Python."""
    choices = guess.choices()
    words = {name: ",".join(value) if name == "agents" else str(value) for name, value in choices.items()}
    options = " ".join(f"--{name} {shlex.quote(value)}" for name, value in words.items())
    arguments = ", ".join(f"{name}={value!r}" for name, value in choices.items())
    return f"repeat with {options}, in Python with SampleSelection({arguments})"


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
    found = Coverage(
        expected=len(expected),
        missing=tuple(token for token in expected if token not in given),
        extra=tuple(token for token in others if token not in unknown),
        unknown=tuple(token for token in others if token in unknown),
    )
    if found.is_complete:
        return found
    guess, share = _probably_meant(dataset, given, selection)
    return found if guess is None else replace(found, guess=guess, guess_share=share)


def _probably_meant(
    dataset: Dataset, given: Collection[str], selection: SampleSelection
) -> tuple[SampleSelection | None, float]:
    """The list with the largest share of common samples, the first of equal ones; none if the asked one is no worse."""
    present = {agent_of(token) for token in given}
    here = {agent["name"] for agent in dataset.agent}  # a partial release may lack some
    agents = None if present.issuperset(here) else tuple(name for name in AGENTS if name in present)
    best, most = None, _overlap(given, selection.tokens(dataset))
    for candidate in _candidates(selection, agents):
        try:
            share = _overlap(given, candidate.tokens(dataset))
        except (ChoiceError, NotAvailableError):  # this release has no such split, or nothing of it
            continue
        if share > most:
            best, most = candidate, share
    return best, most


def _candidates(selection: SampleSelection, agents: Sequence[str] | None) -> Iterator[SampleSelection]:
    whose = None if agents is None else tuple(agents)
    if whose == ():
        return
    for split in dict.fromkeys([selection.split, *SPLITS, *MINI_SPLITS]):
        for name, scope, horizon in _LISTS:
            yield SampleSelection(split=split, samples=name, scope=scope, agents=whose, horizon=horizon)


def _overlap(first: Collection[str], second: Collection[str]) -> float:
    common = len(set(first).intersection(second))
    return common / (len(first) + len(second) - common) if common else 0.0


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
