"""Results by scenario type, town, weather, …: of any evaluator, with bootstrap intervals over scenarios.

Samples of a scenario show the same few seconds, so that they say much less than as many samples of as many scenarios:
the bootstrap draws whole scenarios.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.metrics.attributes import SampleAttributes, tokens_by_value
from deepaccident_devkit.evaluation.metrics.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
from deepaccident_devkit.taxonomy import INFRASTRUCTURE

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True, kw_only=True)
class Bootstrap:
    """How intervals are drawn.

    Attributes:
        resamples: how often as many scenarios as there are are drawn anew, with replacement; 0 for no intervals.
        confidence: share of the resamples' values that an interval spans, the middle ones.
        seed: equal ones draw equally.
    """

    resamples: int = 1000
    confidence: float = 0.95
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        if type(self.resamples) is not int or self.resamples < 0:
            raise ConfigError(f"resamples: expected a whole number from 0, found {self.resamples!r}")
        if not 0 < self.confidence < 1:
            raise ConfigError(f"confidence: expected a share between 0 and 1, such as 0.95, found {self.confidence!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Group(FrozenMappings, Generic[Result]):
    """The samples that share a value.

    Attributes:
        value: of the attribute; None for the samples whose value is not known.
        result: of these samples alone.
        samples: how many.
        scenarios: how many they are of.
        intervals: number of the result, by its path (`ranges/30x30/iou`) → (low, high); none of a single scenario,
            which says nothing of how others would do. Resamples in which a number is NaN are left out of its interval.
    """

    value: str | None
    result: Result
    samples: int
    scenarios: int
    intervals: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakdown(FrozenMappings, Generic[Result]):
    """Results by one attribute.

    Attributes:
        by: the attribute.
        groups: of all samples, by value.
        without_infrastructure: the same without the samples of the roadside pole, which no vehicle drives.
        bootstrap: how the intervals were drawn.
    """

    by: str
    groups: tuple[Group[Result], ...]
    without_infrastructure: tuple[Group[Result], ...]
    bootstrap: Bootstrap


def breakdown(
    evaluator: Evaluator[Result],
    attributes: Mapping[str, SampleAttributes],
    by: str,
    bootstrap: Bootstrap | None = None,
) -> Breakdown[Result]:
    """Results of an evaluator's samples, by the values of an attribute.

    The same bits for any order of the samples, of the attributes, and of the parts that were merged.

    Args:
        evaluator: with all samples counted.
        attributes: of its samples, from `sample_attributes`; those of others do not matter.
        by: one of `sample_attributes.ATTRIBUTES`; `all` for one group.
        bootstrap: how to draw intervals; None for the defaults.

    Raises:
        ChoiceError: no such attribute.
        EvaluationError: a sample's attributes are missing.
    """
    missing = sorted(evaluator.tokens - attributes.keys())
    if missing:
        raise EvaluationError(
            f"{len(missing)} samples have no attributes, such as {missing[0]}; pass sample_attributes(dataset, "
            "evaluator.tokens)"
        )
    here = {token: attributes[token] for token in sorted(evaluator.tokens)}
    vehicles = {token: each for token, each in here.items() if each.agent != INFRASTRUCTURE}
    chosen = bootstrap or Bootstrap()
    everyone = _groups(evaluator, here, by, chosen)
    without = everyone if len(vehicles) == len(here) else _groups(evaluator, vehicles, by, chosen)
    return Breakdown(by=by, groups=everyone, without_infrastructure=without, bootstrap=chosen)


def numbers_of(result: object) -> dict[str, float]:
    """The floats of a result by their path in it: `min_ade`, `ranges/30x30/iou`; whole numbers, texts and None not."""
    return dict(_numbers(result, ""))


def _groups(
    evaluator: Evaluator[Result], attributes: Mapping[str, SampleAttributes], by: str, bootstrap: Bootstrap
) -> tuple[Group[Result], ...]:
    by_value = sorted(tokens_by_value(attributes, by).items(), key=lambda item: _rank(item[0]))
    return tuple(_group(evaluator, value, tokens, attributes, bootstrap) for value, tokens in by_value)


def _group(
    evaluator: Evaluator[Result],
    value: str | None,
    tokens: Sequence[str],
    attributes: Mapping[str, SampleAttributes],
    bootstrap: Bootstrap,
) -> Group[Result]:
    scenarios: dict[str, list[Counts]] = {}
    counts = evaluator.counts
    for token in tokens:
        scenarios.setdefault(attributes[token].scenario, []).append(counts[token])
    parts = [scenarios[name] for name in sorted(scenarios)]
    return Group(
        value=value,
        result=evaluator.compute(tokens),
        samples=len(tokens),
        scenarios=len(scenarios),
        intervals=_intervals(evaluator, parts, bootstrap) if len(parts) > 1 else {},
    )


def resampled(
    evaluator: Evaluator[Any], scenarios: Sequence[Sequence[Counts]], bootstrap: Bootstrap
) -> list[dict[str, float]]:
    """The numbers (`numbers_of`) of each resample; of as many scenarios and an equal bootstrap, the same are drawn.

    Args:
        evaluator: whose numbers.
        scenarios: the counts of each scenario's samples.
        bootstrap: how to draw.
    """
    count, source = len(scenarios), np.random.default_rng(bootstrap.seed)
    drawn = source.integers(count, size=(bootstrap.resamples, count))
    times = np.array([np.bincount(each, minlength=count) for each in drawn]).reshape(-1, count)
    return [numbers_of(result) for result in evaluator.resampled(scenarios, times)]


def middle(values: Iterable[float], confidence: float) -> tuple[float, float]:
    """Between which of the values their middle share lies; NaN without any. Those that are NaN do not count."""
    known = sorted(value for value in values if not math.isnan(value))
    if not known:
        return math.nan, math.nan
    beside = math.floor(len(known) * (1 - confidence) / 2)
    return known[beside], known[-1 - beside]


def _intervals(
    evaluator: Evaluator[Any], scenarios: Sequence[Sequence[Counts]], bootstrap: Bootstrap
) -> dict[str, tuple[float, float]]:
    values: dict[str, list[float]] = {}
    for numbers in resampled(evaluator, scenarios, bootstrap):
        for name, each in numbers.items():
            values.setdefault(name, []).append(each)
    return {name: middle(each, bootstrap.confidence) for name, each in values.items()}


def _rank(value: str | None) -> tuple[bool, float, str]:
    """Texts by their alphabet, times by their length, what is not known last."""
    text = value or ""
    try:
        return value is None, float(text.split(" ")[0]), text
    except ValueError:
        return value is None, math.inf, text


def _numbers(value: object, path: str) -> Iterator[tuple[str, float]]:
    parts: Mapping[Any, object] = {}
    if isinstance(value, float):
        yield path, value
    elif is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in fields(value)}
    elif isinstance(value, Mapping):
        parts = value
    elif isinstance(value, (list, tuple)):
        parts = dict(enumerate(value))
    for key, part in parts.items():
        name = f"{key:g}" if isinstance(key, float) else str(key)
        yield from _numbers(part, f"{path}/{name}" if path else name)
