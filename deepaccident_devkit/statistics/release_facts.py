"""Comparison of a release with facts measured on the real one: `deepaccident info --facts`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.collisions.recorded import map_scenarios, select_results
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.statistics.real_facts import FACTS, Fact, FactVerdict
from deepaccident_devkit.statistics.scenario_facts import ScenarioFacts, counted_scenario_facts
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.reports import CheckReport
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

MIN_SCENARIOS = 10
"""Fewest scenarios with a case for which a share, mean, median, percentile or AUC is judged."""
MIN_REAL_CASES = 50
"""Fewest real cases for which a share of the real release is taken as exact."""
# Half the width of a 95 % interval in standard errors.
_Z_95 = 1.96
# Number of the most common words of a count that are listed.
_MAX_WORDS = 20
# Fact → phrase for the error message of a scenario that violates it.
_PROBLEM_PHRASES = {
    "fields": "expected 13 fields",
    "gapless": "missing frames: ",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseFacts(CheckReport):
    """All facts about a release. They contain neither its path nor its owner.

    Attributes:
        devkit: Version of the devkit.
        version: `v1` or `v1-mini`.
        scenarios: Number of scenarios examined.
        left_out: Number of broken scenarios.
        facts: `FACTS`, with the values of this release.
        counts: What is counted, such as `weather` → word → number of scenarios (for `label ids`,
            number of rows).
    """

    devkit: str
    version: str
    scenarios: int
    left_out: int
    facts: tuple[Fact, ...]
    counts: Mapping[str, Mapping[str, int]]

    def named_tables(self) -> dict[str, list[tuple[str, ...]]]:
        """Return the tables of facts, scenarios, verdicts, words and label ids."""
        counts = {
            "scenarios": {"examined": self.scenarios, "excluded as broken": self.left_out},
            "facts": Counter(str(fact.verdict) for fact in self.facts),
            **self.counts,
        }
        count_rows: list[tuple[str, ...]] = [("of", "what", "number")]
        for name, words in counts.items():
            for word, number in words.items():
                count_rows.append((name, word, f"{number:,}"))
        heading = ("fact", "conf.", "others", "here", "cases", "verdict")
        fact_rows = [heading, *(fact.texts() for fact in self.facts)]
        return {"facts": fact_rows, "counts": count_rows}


def release_facts(
    dataset: Dataset, scenarios: Iterable[RowArgument] | None = None, **engine: Unpack[Engine]
) -> ReleaseFacts:
    """Compare a release with measurements of the real one, and with assumptions of our readers.

    Labels, meta and calib suffice. The tables and each scenario's meta file are read.

    A release agrees with a fact

    - that holds always, if it holds in every case (a broken rule is reported with any number of
      scenarios);
    - that is a share, mean or median, if the real value lies within twice the half widths of the
      interval of 95 % over scenarios, or, for a share of fewer than 50 real cases, if the interval
      of the real share reaches that far;
    - of few real cases, if the 5th and 95th percentiles enclose them;
    - that is an AUC, if it differs by at most 0.08 for 1 and 2 s, or 0.1 from 3 s on; the AUC of
      the length must be 0.95 to 1;
    - that is an extreme (fastest, steepest, shortest), if the real value is reached.

    The rows are defined as follows.

    - Collisions, folders, length: meta names the collision. Less than 5 s before means fewer than
      51 frames. In the AUC of the length, shorter clips stand for collisions.
    - Pairs: by the ids in the first line of meta. Background is an id other than 0 that no agent
      has.
    - Colliders: outlines from above, without a margin. The depth is the smallest push that
      separates them. The second of the impact is the whole second, counted from the first frame,
      that contains the last frame. Heading and relative speed belong to the frame before the first
      touch, or before the last frame if there is no touch.
    - Agents: samples of the four vehicles, by line 1 of their labels. The times below 0.5 m/s and
      above 15 m/s are one share per scenario.
    - Labels of the ego: vehicles are all actors except pedestrians and untracked ones. Touching
      counts as an overlap, also with the ego itself. A vehicle stands up to 0.5 m/s.
    - Next 2 s: at each whole second from the first frame on, the smallest gap in the next 20 frames
      between two vehicles in the ego's labels, if one of them is moving now. They touch below
      0.01 m.
    - AUC of constant velocity: at each whole second from 1 s on and before the impact, all actors
      of all labels keep the mean velocity of the last half second. The smallest gap is taken in
      steps of 0.1 s, in (k − 1, k] s ahead. This is a hit if the impact lies there, and otherwise
      counts if that time is recorded. All pairs include pairs in which both actors stand.
    - ADE and FDE: all actors at each half second, at 1 to 5 s ahead as far as they are seen. ADE is
      the mean error, FDE the last one.
    - Gap at the end: at most the distance closed in the last 0.1 s plus 0.3 m.
    - Infrastructure: height of its origin above the ego frame of the nearest vehicle.
    - Jitter: largest difference between a sensor's position and its first calib.
    - Velocity: the frame that fits displacements best.

    Args:
        dataset: Release, opened with `on_error="skip"` if any of its scenarios is broken.
        scenarios: Tokens or records of the scenarios to examine; None for all.
        **engine: `workers`, `executor` and `progress` (`parallel.Engine`).

    Raises:
        TokenError: If a token belongs to no scenario in the release.
        MetaError: If a meta file has changed since the release was opened, and is now unreadable.
        ChoiceError: If `workers` is less than 1.
        WorkerError: If a worker was killed, or cannot do the work.
    """
    results = map_scenarios(
        counted_scenario_facts, dataset, scenarios, label="Measuring scenarios", **engine
    )
    scenario_facts = select_results(ScenarioFacts, results)
    problems = [" ".join(problem.messages) for problem in dataset.problems]
    values: dict[str, list[FloatArray]] = {fact.key: [] for fact in FACTS}
    counters: dict[str, Counter[str]] = {}
    for scenario in scenario_facts:
        for key in values.keys() & scenario.values.keys():
            values[key].append(scenario.values[key])
        for name, words in scenario.counts.items():
            counters[name] = counters.get(name, Counter()) + Counter(words)
    for key, phrase in _PROBLEM_PHRASES.items():
        broken = [np.zeros(1) for problem in problems if phrase in problem]
        values[key] = [np.ones(1)] * len(scenario_facts) + broken
    facts = tuple(_compare_fact(fact, values[fact.key]) for fact in FACTS)
    num_decided = sum(fact.verdict != "cannot say" for fact in facts)
    return ReleaseFacts(
        compared={f"of {len(facts)} facts": num_decided},
        devkit=__version__,
        version=dataset.version,
        scenarios=len(scenario_facts),
        left_out=len(problems),
        facts=facts,
        counts={name: dict(words.most_common(_MAX_WORDS)) for name, words in counters.items()},
    )


def _compare_fact(fact: Fact, values_by_scenario: Sequence[FloatArray]) -> Fact:
    """Return the fact with the release's value and verdict filled in.

    Args:
        fact: The fact.
        values_by_scenario: Values of the fact in each scenario that has any.
    """
    if not values_by_scenario:
        return replace(fact, here=None, ends=None, cases=0, scenarios=0)
    value, ends = _measure_fact(fact, values_by_scenario)
    cases = sum(map(len, values_by_scenario))
    measured = replace(fact, here=value, ends=ends, cases=cases, scenarios=len(values_by_scenario))
    if value is None:
        return measured
    return replace(measured, verdict=_judge_fact(measured, value))


def _measure_fact(
    fact: Fact, values_by_scenario: Sequence[FloatArray]
) -> tuple[float | None, tuple[float, float] | None]:
    """Compute the release's value of a fact, and the ends of its interval.

    Scenarios are taken as independent; cases within a scenario are not.
    """
    values = np.concatenate(values_by_scenario)
    number = len(values_by_scenario)
    if fact.kind == "area":
        return _area_under_curve(values), None
    if fact.kind in ("few", "median", "range", "most", "least"):
        half = min(_Z_95 / 2 / math.sqrt(number), 0.5)
        levels_by_kind = {"few": (0.05, 0.5, 0.95), "most": (1, 1, 1), "least": (0, 0, 0)}
        levels = levels_by_kind.get(fact.kind, (0.5 - half, 0.5, 0.5 + half))
        low, value, high = np.quantile(values, levels).tolist()
        return value, (low, high)
    mean = float(values.mean())
    sums = [(scenario_values - mean).sum() for scenario_values in values_by_scenario]
    deviations = np.array(sums) / len(values)
    spread = float(np.square(deviations).sum())
    if fact.kind == "mean":
        unbiased_spread = spread * number / max(number - 1, 1)
        half = _Z_95 * math.sqrt(unbiased_spread)
        return mean, (mean - half, mean + half)
    cases: float = number
    if spread:
        cases = min(mean * (1 - mean) / spread, len(values))
    return mean, _wilson_interval(mean, cases)


def _area_under_curve(values: FloatArray) -> float | None:
    """Return the AUC of rows (N, 2) of a value and whether a collision came; ties count half."""
    collided = values[:, 1] > 0
    differences = np.subtract.outer(values[~collided, 0], values[collided, 0])
    is_smaller = np.sign(differences) / 2 + 0.5
    if not is_smaller.size:
        return None
    return float(is_smaller.mean())


def _wilson_interval(share: float, cases: float) -> tuple[float, float]:
    """Return the ends of Wilson's 95 % interval for a share observed in a number of cases."""
    variance = share * (1 - share) / cases
    half = _Z_95 * math.sqrt(variance + (_Z_95 / 2 / cases) ** 2)
    centre = share + _Z_95**2 / 2 / cases
    scale = 1 + _Z_95**2 / cases
    low = (centre - half) / scale
    # Without 1e-12, rounding would keep the upper end for a share of 1 just below 1.
    high = (centre + half) / scale + 1e-12
    return max(low, 0.0), min(high, 1.0)


def _judge_fact(fact: Fact, value: float) -> FactVerdict:
    """Judge whether a release with this value agrees with a fact; see `release_facts`."""
    low, high = fact.ends or (value, value)
    agrees_with_real = fact.limits[0] <= value <= fact.limits[1]
    if fact.kind == "few":
        agrees_with_real = low <= min(fact.real) and max(fact.real) <= high
    if fact.kind in ("share", "mean", "median"):
        real = fact.real
        if fact.kind == "share" and fact.real_cases < MIN_REAL_CASES:
            real = _wilson_interval(fact.real[0], fact.real_cases)
        agrees_with_real = 2 * low - value <= real[-1] and real[0] <= 2 * high - value
    is_certain = fact.kind == "all" or (agrees_with_real and fact.kind in ("some", "most", "least"))
    if fact.scenarios < MIN_SCENARIOS and not is_certain:
        return "cannot say"
    if agrees_with_real:
        return "agree"
    return "differ"
