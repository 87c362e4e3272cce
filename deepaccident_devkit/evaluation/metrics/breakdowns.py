"""Results by scenario type, town, weather, …: of any evaluator, with intervals over clusters (`intervals`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.attributes import (
    SampleAttributes,
    attribute_name,
    cluster_of,
    tokens_by_value,
)
from deepaccident_devkit.evaluation.metrics.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
from deepaccident_devkit.evaluation.metrics.intervals import Resampling, intervals_of
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE
from deepaccident_devkit.text import natural_order

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True, kw_only=True)
class Group(FrozenMappings, Generic[Result]):
    """The samples that share a value.

    Attributes:
        value: of the attribute; None for the samples whose value is not known.
        result: of these samples alone.
        samples: how many.
        scenarios: how many they are of.
        clusters: how many these are, where an accident and its twin are one (`attributes.cluster_of`).
        intervals: number of the result, by its path (`ranges/30x30/iou`) → (low, high); those without one, NaN and all
            of fewer than 6 clusters among them, are not there.
        notes: sentences that say why numbers have no interval.
    """

    value: str | None
    result: Result
    samples: int
    scenarios: int
    clusters: int
    intervals: Mapping[str, tuple[float, float]]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakdown(FrozenMappings, Generic[Result]):
    """Results by one attribute.

    Attributes:
        by: the attribute.
        groups: of all samples, by value; agents in the order of `taxonomy.AGENTS`.
        without_infrastructure: the same without the samples of the roadside pole, which no vehicle drives.
        resampling: how the intervals were made.
    """

    by: str
    groups: tuple[Group[Result], ...]
    without_infrastructure: tuple[Group[Result], ...]
    resampling: Resampling


def breakdown(
    evaluator: Evaluator[Result],
    attributes: Mapping[str, SampleAttributes],
    by: str,
    resampling: Resampling | None = None,
) -> Breakdown[Result]:
    """Results of an evaluator's samples, by the values of an attribute.

    The same bits for any order of the samples, of the attributes, and of the parts that were merged.

    Args:
        evaluator: with all samples counted.
        attributes: of its samples, from `sample_attributes`; those of other samples are ignored.
        by: one of `attributes.ATTRIBUTES`; `all` for one group.
        resampling: how to make intervals; None for the defaults.

    Raises:
        ChoiceError: no such attribute.
        EvaluationError: a sample's attributes are missing.
    """
    by = attribute_name(by)
    missing = sorted(evaluator.tokens - attributes.keys())
    if missing:
        raise EvaluationError(
            f"{len(missing)} samples have no attributes, such as {missing[0]}; pass sample_attributes(dataset, "
            "evaluator.tokens)"
        )
    here = {token: attributes[token] for token in sorted(evaluator.tokens)}
    vehicles = {token: each for token, each in here.items() if each.agent != INFRASTRUCTURE}
    chosen = resampling or Resampling()
    everyone = _groups(evaluator, here, by, chosen)
    without = everyone if len(vehicles) == len(here) else _groups(evaluator, vehicles, by, chosen)
    return Breakdown(by=by, groups=everyone, without_infrastructure=without, resampling=chosen)


def _groups(
    evaluator: Evaluator[Result], attributes: Mapping[str, SampleAttributes], by: str, resampling: Resampling
) -> tuple[Group[Result], ...]:
    by_value = tokens_by_value(attributes, by)
    ordered: list[str | None] = sorted(by_value, key=natural_order)
    if by == "agent":
        ordered.sort(key=AGENTS.index)
    return tuple(_group(evaluator, value, by_value[value], attributes, resampling) for value in ordered)


def _group(
    evaluator: Evaluator[Result],
    value: str | None,
    tokens: Sequence[str],
    attributes: Mapping[str, SampleAttributes],
    resampling: Resampling,
) -> Group[Result]:
    clusters: dict[str, list[Counts]] = {}
    counts = evaluator.counts
    for token in tokens:
        clusters.setdefault(cluster_of(attributes[token].scenario), []).append(counts[token])
    result = evaluator.compute(tokens)
    made = intervals_of(evaluator, [clusters[name] for name in sorted(clusters)], result, resampling)
    return Group(
        value=value,
        result=result,
        samples=len(tokens),
        scenarios=len({attributes[token].scenario for token in tokens}),
        clusters=len(clusters),
        intervals=made.ends,
        notes=made.notes,
    )
