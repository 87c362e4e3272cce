"""Which samples and configurations of a release the study compares: the same samples everywhere."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.motion import evaluation_samples
from deepaccident_devkit.motion.sample_lists import Scope
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import AGENT_CONFIGS
from deepaccident_devkit.v2x.configurations import agents_of


@dataclass(frozen=True, slots=True, kw_only=True)
class StudySamples:
    """What is compared.

    Attributes:
        tokens: horizon in seconds → the samples evaluated so far before the end.
        agents: names of the configurations of which all agents are there.
        notes: what was left out, in sentences.
    """

    tokens: Mapping[float, tuple[str, ...]]
    agents: tuple[str, ...]
    notes: tuple[str, ...]


def study_samples(
    dataset: Dataset,
    split: str | os.PathLike[str],
    horizons: Collection[float],
    *,
    egos: Sequence[str],
    scope: Scope = "accident",
    latest: float = 0.0,
) -> StudySamples:
    """The samples and configurations that a release has for the study.

    A configuration is left out if one of its agents is nowhere in the release; a sample, if its scenario lacks an
    agent that others have, or begins later than the largest latency before it.

    Args:
        dataset: the release.
        split: name of a split, or a split file.
        horizons: seconds.
        egos: names of the agents whose samples are taken.
        scope: as of `motion.evaluation_samples`.
        latest: seconds of latency that there must be a past for.

    Raises:
        ChoiceError: no such split.
        NotAvailableError: the split has no samples for it here.
        ConfigError: a horizon that no frames fit.
    """
    found = {
        horizon: [
            token
            for token in evaluation_samples(dataset, split, "paper", horizon=horizon, scope=scope)
            if token.rsplit("/", 2)[1] in egos
        ]
        for horizon in horizons
    }
    there = {token.rsplit("/", 2)[0] for tokens in found.values() for token in tokens}
    agents = {scenario: set(agents_of(dataset, scenario)) for scenario in there}
    known = set().union(*agents.values())
    needed = {name: {each for ego in egos for each in config.agents_for(ego)} for name, config in AGENT_CONFIGS.items()}
    possible = tuple(name for name, names in needed.items() if names <= known)
    wanted = set().union(*(needed[name] for name in possible))
    complete = {scenario for scenario, names in agents.items() if wanted <= names}
    tokens = {
        horizon: tuple(token for token in each if _is_usable(token, complete, latest))
        for horizon, each in found.items()
    }
    if not any(tokens.values()):
        raise NotAvailableError(
            f"{split}: no sample here of {', '.join(egos)} can be compared; unpack more agents, or choose other egos"
        )
    return StudySamples(
        tokens=tokens, agents=possible, notes=(*_absent_text(possible), *_left_out_texts(found, tokens, latest))
    )


def _absent_text(possible: Collection[str]) -> list[str]:
    absent = [name for name in AGENT_CONFIGS if name not in possible]
    return [f"left out, since an agent is not in this release: {', '.join(absent)}"] if absent else []


def _left_out_texts(
    found: Mapping[float, Sequence[str]], tokens: Mapping[float, Sequence[str]], latest: float
) -> list[str]:
    """How many samples of each horizon are not compared, and why."""
    return [
        f"{horizon:g} s ahead: {len(each) - len(tokens[horizon])} of {len(each)} samples are left out, since their "
        f"scenario lacks an agent or has no past of {latest:g} s"
        for horizon, each in found.items()
        if len(tokens[horizon]) < len(each)
    ]


def _is_usable(token: str, complete: Collection[str], latest: float) -> bool:
    scenario, _, number = token.rsplit("/", 2)
    return scenario in complete and int(number) > round(latest / FRAME_PERIOD)
