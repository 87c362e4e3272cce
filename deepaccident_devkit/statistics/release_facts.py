"""The facts that others measured of the real release, beside what a release has: `deepaccident info --facts`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.collisions.recorded import each_scenario, those_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.statistics.real_facts import FACTS, Fact, FactVerdict
from deepaccident_devkit.statistics.scenario_facts import ScenarioFacts, counted_scenario_facts
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.reports import CheckReport
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

FEWEST: Final = 10
"""Scenarios with a case, from which on a share, mean, median, percentile or AUC says something."""
MANY: Final = 50
"""Real cases from which on a real share is taken as it is."""
# Standard errors of a 95 % interval; words that are listed, the most common ones.
_Z, _SHOWN = 1.96, 20
# Fact → what the message of a scenario that breaks it says.
_BROKEN: Final[Mapping[str, str]] = {"fields": "expected 13 fields", "gapless": "lacks frames"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseFacts(CheckReport):
    """All facts of a release. Nothing in it names a path, or whose release it is.

    Attributes:
        devkit: its version.
        version: `v1` or `v1-mini`.
        scenarios: how many were looked at.
        left_out: how many are broken.
        facts: `FACTS`, compared.
        counts: what was counted, such as `weather` → word → scenarios (of `label ids`, rows).
    """

    devkit: str
    version: str
    scenarios: int
    left_out: int
    facts: tuple[Fact, ...]
    counts: Mapping[str, Mapping[str, int]]

    def named_tables(self) -> dict[str, list[tuple[str, ...]]]:
        """The facts; and how many scenarios there are, facts agree, and have which word or kind of id."""
        counts = {
            "scenarios": {"looked at": self.scenarios, "left out as broken": self.left_out},
            "facts": Counter(str(fact.verdict) for fact in self.facts),
            **self.counts,
        }
        return {
            "facts": [
                ("fact", "conf.", "others", "here", "cases", "verdict"),
                *(fact.texts() for fact in self.facts),
            ],
            "counts": [
                ("of", "what", "number"),
                *(
                    (name, word, f"{number:,}")
                    for name, words in counts.items()
                    for word, number in words.items()
                ),
            ],
        }


def release_facts(
    dataset: Dataset, scenarios: Iterable[RowArgument] | None = None, **how: Unpack[Engine]
) -> ReleaseFacts:
    """Compare a release with what others measured of the real one, and with what our readers take for granted.

    Labels, meta and calib are enough; the tables are read, and each scenario's meta file.

    Args:
        dataset: the release, opened with `on_error="skip"` if some of its scenarios are broken.
        scenarios: tokens or records of its scenarios to look at alone; None for all.
        **how: `workers`, `executor` and `progress` of these, as `parallel.Engine` says.

    Raises:
        TokenError: something is no scenario of the release.
        MetaError: a meta file has changed since the release was opened, and cannot be read.
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    found = those_of(
        ScenarioFacts,
        each_scenario(counted_scenario_facts, dataset, scenarios, label="facts", **how),
    )
    broken = [" ".join(problem.messages) for problem in dataset.problems]
    parts = {
        fact.key: [each.values[fact.key] for each in found if fact.key in each.values]
        for fact in FACTS
    }
    for key, phrase in _BROKEN.items():
        parts[key] = [np.ones(1)] * len(found) + [np.zeros(1) for text in broken if phrase in text]
    counts = {
        name: sum((Counter(each.counts.get(name)) for each in found), Counter[str]())
        for name in dict.fromkeys(name for each in found for name in each.counts)
    }
    facts = tuple(_compared(fact, parts[fact.key]) for fact in FACTS)
    return ReleaseFacts(
        compared={f"of {len(facts)} facts": sum(fact.verdict != "cannot say" for fact in facts)},
        devkit=__version__,
        version=dataset.version,
        scenarios=len(found),
        left_out=len(broken),
        facts=facts,
        counts={name: dict(words.most_common(_SHOWN)) for name, words in counts.items()},
    )


def _compared(fact: Fact, parts: Sequence[FloatArray]) -> Fact:
    """A fact beside the values of each scenario."""
    here, ends = _measured(fact, parts) if parts else (None, None)
    found = replace(fact, here=here, ends=ends, cases=sum(map(len, parts)), scenarios=len(parts))
    return found if here is None else replace(found, verdict=_verdict(found, here))


def _measured(
    fact: Fact, parts: Sequence[FloatArray]
) -> tuple[float | None, tuple[float, float] | None]:
    """A release's number, and its ends; the scenarios, not their cases, are what is independent."""
    values, number = np.concatenate(parts), len(parts)
    if fact.kind == "area":
        hit = values[:, 1] > 0
        smaller = (
            np.sign(np.subtract.outer(values[~hit, 0], values[hit, 0])) / 2 + 0.5
        )  # ties count half
        return (float(smaller.mean()) if smaller.size else None), None
    if fact.kind in ("few", "median", "range", "most", "least"):
        half = min(_Z / 2 / math.sqrt(number), 0.5)
        levels = {"few": (0.05, 0.5, 0.95), "most": (1, 1, 1), "least": (0, 0, 0)}
        low, here, high = np.quantile(
            values, levels.get(fact.kind, (0.5 - half, 0.5, 0.5 + half))
        ).tolist()
        return here, (low, high)
    mean = float(values.mean())
    off = np.array([(each - mean).sum() for each in parts]) / len(values)
    spread = float(np.square(off).sum())
    if fact.kind == "mean":
        half = _Z * math.sqrt(spread * number / max(number - 1, 1))
        return mean, (mean - half, mean + half)
    return mean, _wilson(mean, min(mean * (1 - mean) / spread, len(values)) if spread else number)


def _wilson(share: float, number: float) -> tuple[float, float]:
    """The ends of Wilson's 95 % interval of a share of so many cases."""
    half = _Z * math.sqrt(share * (1 - share) / number + (_Z / 2 / number) ** 2)
    low, high = (
        (share + _Z**2 / 2 / number + each) / (1 + _Z**2 / number) for each in (-half, half)
    )
    return max(low, 0.0), min(high + 1e-12, 1.0)  # which rounding would keep from 1


def _verdict(fact: Fact, here: float) -> FactVerdict:
    """Whether a release that has `here` agrees with a fact; docs/validation.md says when."""
    low, high = fact.ends or (here, here)
    agrees = fact.limits[0] <= here <= fact.limits[1]
    if fact.kind == "few":
        agrees = low <= min(fact.real) and max(fact.real) <= high
    if fact.kind in ("share", "mean", "median"):
        known = (
            _wilson(fact.real[0], fact.real_cases)
            if fact.kind == "share" and fact.real_cases < MANY
            else fact.real
        )
        agrees = 2 * low - here <= known[-1] and known[0] <= 2 * high - here
    certain = fact.kind == "all" or (agrees and fact.kind in ("some", "most", "least"))
    return (
        "cannot say" if fact.scenarios < FEWEST and not certain else "agree" if agrees else "differ"
    )
