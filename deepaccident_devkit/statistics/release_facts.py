"""A release compared with facts measured on the real one: `deepaccident info --facts`."""

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

MIN_SCENARIOS: Final = 10
"""Scenarios with a case that a share, mean, median, percentile or AUC needs for a verdict."""
MIN_REAL_CASES: Final = 50
"""Real cases that a real share needs to be taken as exact."""
# Standard errors in half a 95 % interval.
_Z_95: Final = 1.96
# The most common words of a count that are listed.
_MAX_WORDS: Final = 20
# Fact → phrase in the error message of a scenario that breaks it.
_PROBLEM_PHRASES: Final[Mapping[str, str]] = {
    "fields": "expected 13 fields",
    "gapless": "lacks frames",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseFacts(CheckReport):
    """All facts of a release. It names neither a path nor the owner of the release.

    Attributes:
        devkit: Version of the devkit.
        version: `v1` or `v1-mini`.
        scenarios: Number of scenarios examined.
        left_out: Number of broken scenarios.
        facts: `FACTS`, compared.
        counts: What was counted, such as `weather` → word → scenarios (for `label ids`, rows).
    """

    devkit: str
    version: str
    scenarios: int
    left_out: int
    facts: tuple[Fact, ...]
    counts: Mapping[str, Mapping[str, int]]

    def named_tables(self) -> dict[str, list[tuple[str, ...]]]:
        """Return the table of facts, and counts of scenarios, of verdicts, of words and of ids."""
        counts = {
            "scenarios": {"looked at": self.scenarios, "left out as broken": self.left_out},
            "facts": Counter(str(fact.verdict) for fact in self.facts),
            **self.counts,
        }
        count_rows: list[tuple[str, ...]] = [("of", "what", "number")]
        for name, words in counts.items():
            for word, number in words.items():
                count_rows.append((name, word, f"{number:,}"))
        heading = ("fact", "conf.", "others", "here", "cases", "verdict")
        return {"facts": [heading, *(fact.texts() for fact in self.facts)], "counts": count_rows}


def release_facts(
    dataset: Dataset, scenarios: Iterable[RowArgument] | None = None, **engine: Unpack[Engine]
) -> ReleaseFacts:
    """Compare a release with measurements of the real one and with assumptions of our readers.

    Labels, meta and calib are enough; the tables are read, and each scenario's meta file.

    Args:
        dataset: Release, opened with `on_error="skip"` if any of its scenarios is broken.
        scenarios: Tokens or records of the only scenarios to examine; None for all.
        **engine: `workers`, `executor` and `progress` (`parallel.Engine`).

    Raises:
        TokenError: A token names no scenario of the release.
        MetaError: A meta file has changed since the release was opened, and cannot be read.
        ChoiceError: `workers` is less than 1.
        WorkerError: A worker was killed, or cannot do the work.
    """
    results = each_scenario(counted_scenario_facts, dataset, scenarios, label="facts", **engine)
    scenario_facts = those_of(ScenarioFacts, results)
    problems = [" ".join(problem.messages) for problem in dataset.problems]
    parts: dict[str, list[FloatArray]] = {fact.key: [] for fact in FACTS}
    counters: dict[str, Counter[str]] = {}
    for scenario in scenario_facts:
        for key in parts.keys() & scenario.values.keys():
            parts[key].append(scenario.values[key])
        for name, words in scenario.counts.items():
            counters[name] = counters.get(name, Counter()) + Counter(words)
    for key, phrase in _PROBLEM_PHRASES.items():
        broken = [np.zeros(1) for problem in problems if phrase in problem]
        parts[key] = [np.ones(1)] * len(scenario_facts) + broken
    facts = tuple(_compare(fact, parts[fact.key]) for fact in FACTS)
    return ReleaseFacts(
        compared={f"of {len(facts)} facts": sum(fact.verdict != "cannot say" for fact in facts)},
        devkit=__version__,
        version=dataset.version,
        scenarios=len(scenario_facts),
        left_out=len(problems),
        facts=facts,
        counts={name: dict(words.most_common(_MAX_WORDS)) for name, words in counters.items()},
    )


def _compare(fact: Fact, parts: Sequence[FloatArray]) -> Fact:
    """Return a fact with a release's number and the verdict, from the values of each scenario."""
    if not parts:
        return replace(fact, here=None, ends=None, cases=0, scenarios=0)
    value, ends = _measure(fact, parts)
    cases = sum(map(len, parts))
    measured = replace(fact, here=value, ends=ends, cases=cases, scenarios=len(parts))
    if value is None:
        return measured
    return replace(measured, verdict=_judge(measured, value))


def _measure(
    fact: Fact, parts: Sequence[FloatArray]
) -> tuple[float | None, tuple[float, float] | None]:
    """Return a release's number and the ends of its interval.

    Scenarios are independent, their cases are not.
    """
    values = np.concatenate(parts)
    number = len(parts)
    if fact.kind == "area":
        return _area_under_curve(values), None
    if fact.kind in ("few", "median", "range", "most", "least"):
        half = min(_Z_95 / 2 / math.sqrt(number), 0.5)
        levels_by_kind = {"few": (0.05, 0.5, 0.95), "most": (1, 1, 1), "least": (0, 0, 0)}
        levels = levels_by_kind.get(fact.kind, (0.5 - half, 0.5, 0.5 + half))
        low, value, high = np.quantile(values, levels).tolist()
        return value, (low, high)
    mean = float(values.mean())
    deviations = np.array([(part - mean).sum() for part in parts]) / len(values)
    spread = float(np.square(deviations).sum())
    if fact.kind == "mean":
        half = _Z_95 * math.sqrt(spread * number / max(number - 1, 1))
        return mean, (mean - half, mean + half)
    cases: float = number
    if spread:
        cases = min(mean * (1 - mean) / spread, len(values))
    return mean, _wilson_interval(mean, cases)


def _area_under_curve(values: FloatArray) -> float | None:
    """Return the AUC of rows (N, 2), value and whether the collision came, ties counting half."""
    collided = values[:, 1] > 0
    differences = np.subtract.outer(values[~collided, 0], values[collided, 0])
    is_smaller = np.sign(differences) / 2 + 0.5
    if not is_smaller.size:
        return None
    return float(is_smaller.mean())


def _wilson_interval(share: float, cases: float) -> tuple[float, float]:
    """Return the ends of Wilson's 95 % interval of a share of a number of cases."""
    half = _Z_95 * math.sqrt(share * (1 - share) / cases + (_Z_95 / 2 / cases) ** 2)
    centre = share + _Z_95**2 / 2 / cases
    scale = 1 + _Z_95**2 / cases
    low = (centre - half) / scale
    high = (centre + half) / scale
    # Without 1e-12, rounding would keep the upper end of a share of 1 just under 1.
    return max(low, 0.0), min(high + 1e-12, 1.0)


def _judge(fact: Fact, value: float) -> FactVerdict:
    """Return whether a release with this value agrees with a fact; docs/validation.md says when."""
    low, high = fact.ends or (value, value)
    agrees = fact.limits[0] <= value <= fact.limits[1]
    if fact.kind == "few":
        agrees = low <= min(fact.real) and max(fact.real) <= high
    if fact.kind in ("share", "mean", "median"):
        real = fact.real
        if fact.kind == "share" and fact.real_cases < MIN_REAL_CASES:
            real = _wilson_interval(fact.real[0], fact.real_cases)
        agrees = 2 * low - value <= real[-1] and real[0] <= 2 * high - value
    certain = fact.kind == "all" or (agrees and fact.kind in ("some", "most", "least"))
    if fact.scenarios < MIN_SCENARIOS and not certain:
        return "cannot say"
    return "agree" if agrees else "differ"
