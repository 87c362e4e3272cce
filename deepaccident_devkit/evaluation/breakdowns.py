"""Results of any evaluator by scenario type, town, weather, …, with intervals (`intervals`).

The attributes belong to scenarios (`selection`), or to samples.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.intervals import Resampling, intervals_of
from deepaccident_devkit.evaluation.task import FrozenMappings
from deepaccident_devkit.selection.fields import FIELDS, full_name, group_texts
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.text import choice, natural_order
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, INFRASTRUCTURE
from deepaccident_devkit.v2x import accident_visible

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import SampleRecord


_FRAMES_PER_SECOND: Final = round(1 / FRAME_PERIOD)
NO_IMPACT: Final = "no impact"
# Attributes that differ within a recording: of no use to a task that needs complete recordings.
WITHIN_RECORDINGS: Final = ("time_to_impact", "impact_step", "time_to_end", "accident_visibility")
# Token of a scene of our export to nuScenes, which is one agent's recording of a scenario.
_NUSCENES_SCENE: Final = re.compile(
    rf"^nuscenes/(\w+_(?:accident|normal))-(.+?)(?:-(?:{'|'.join(AGENTS)}))?$"
)
EVERYTHING: Final = "all"
_SAMPLE_ATTRIBUTES: Final = (
    "agent",
    "accident_visibility",
    "time_to_impact",
    "impact_step",
    "time_to_end",
)
# Attributes by which results can be broken down; `all` for one group.
ATTRIBUTES: Final = (
    EVERYTHING,
    *(name for name, field in FIELDS.items() if field.groups),
    *_SAMPLE_ATTRIBUTES,
)


def cluster_of(scenario: str) -> str:
    """Return the cluster of an accident and its twin, of the same junction, traffic and weather.

    A scene of our export to nuScenes is in the cluster of its scenario, for every agent.

    Args:
        scenario: Token, such as `type1_subtype1_accident/Town03…`, or
            `nuscenes/type1_subtype1_accident-Town03…-ego_vehicle` for the export.

    Returns:
        The token without the ending of its type: `type1_subtype1/Town03…`.
    """
    kind, slash, name = _NUSCENES_SCENE.sub(r"\1/\2", scenario).partition("/")
    return f"{kind.rpartition('_')[0] or kind}{slash}{name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleAttributes(ShortRepr):
    """The attributes of a sample.

    Attributes:
        scenario: Token of its scenario.
        agent: Name of its agent.
        story: Values of its scenario, by name (`deepaccident_devkit.selection` explains them); None
            for unknown ones.
        accident_visibility: `visible` or `invisible`, by the released rule
            (`v2x.accident_visible`); None where that is not known.
        time_to_impact: `k s`: the recorded impact is more than k − 1 s ahead and at most k s; `no
            impact` if nobody collides, None without meta.
        impact_step: The same in steps of 0.5 s.
        time_to_end: Seconds to the scenario's last frame, such as `1.5`, as in the released
            evaluation.
    """

    scenario: str
    agent: str
    story: Mapping[str, str | None]
    accident_visibility: str | None
    time_to_impact: str | None
    impact_step: str | None
    time_to_end: str

    def value(self, name: str) -> str | None:
        """Return the value of one of `ATTRIBUTES`; None if it is not known. Raises ChoiceError."""
        if name not in ATTRIBUTES:
            name = attribute_name(name)
        if name == EVERYTHING:
            return EVERYTHING
        if name not in _SAMPLE_ATTRIBUTES:
            return self.story[name]
        value: str | None = getattr(self, name)
        return value


def attribute_name(name: str) -> str:
    """Return the one of `ATTRIBUTES` that a name stands for, in any case; an old name warns.

    Raises:
        ChoiceError: no such attribute.
    """
    return choice("by", full_name(name), ATTRIBUTES)


def sample_attributes(dataset: Dataset, tokens: Iterable[str]) -> dict[str, SampleAttributes]:
    """Return the attributes of samples, by token.

    Raises:
        TokenError: no such sample.
    """
    stories: dict[str, dict[str, str | None]] = {}
    result = {}
    for token in tokens:
        sample = dataset.sample.get(token)
        scenario = sample["scenario_token"]
        if scenario not in stories:
            stories[scenario] = group_texts(dataset, dataset.scenario.get(scenario))
        is_visible = accident_visible(dataset, token)
        result[token] = _attributes(sample, stories[scenario], visible=is_visible)
    return result


def tokens_by_value(
    attributes: Mapping[str, SampleAttributes], name: str
) -> dict[str | None, list[str]]:
    """Return the samples of each value of an attribute; values in order of appearance.

    Raises:
        ChoiceError: no such attribute.
    """
    name = attribute_name(name)
    result: dict[str | None, list[str]] = {}
    for token, sample in attributes.items():
        result.setdefault(sample.value(name), []).append(token)
    return result


def time_bin(frames: int, width: int) -> str:
    """Return the bin of a time as the end of the bin: `2 s`, `0.5 s`.

    Args:
        frames: Time as a number of recorded frames.
        width: Number of frames in a bin.
    """
    bins = -(-frames // width)
    return f"{bins * width / _FRAMES_PER_SECOND:g} s"


def _attributes(
    sample: SampleRecord, story: Mapping[str, str | None], *, visible: bool | None
) -> SampleAttributes:
    """Return the attributes of a sample from its record and the values of its scenario."""
    ahead = sample["time_to_impact"]
    if ahead is not None:
        frames = round(ahead * _FRAMES_PER_SECOND)
        time_to_impact: str | None = time_bin(frames, _FRAMES_PER_SECOND)
        impact_step: str | None = time_bin(frames, _FRAMES_PER_SECOND // 2)
    else:
        time_to_impact = None if story["collision_status"] is None else NO_IMPACT
        impact_step = time_to_impact
    accident_visibility = None
    if visible is not None:
        accident_visibility = "visible" if visible else "invisible"
    return SampleAttributes(
        scenario=sample["scenario_token"],
        agent=sample["agent"],
        story=story,
        accident_visibility=accident_visibility,
        time_to_impact=time_to_impact,
        impact_step=impact_step,
        time_to_end=f"{sample['time_to_end']:.1f}",
    )


_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True, kw_only=True)
class Group(FrozenMappings, Generic[_Result]):
    """The samples that share a value.

    Attributes:
        value: Value of the attribute; None for samples without a known value.
        result: Result of these samples only.
        samples: Number of samples.
        scenarios: Number of their scenarios.
        clusters: Number of clusters, where an accident and its twin are one (`cluster_of`).
        intervals: Path of a number (`ranges/30x30/iou`) → (low, high); numbers without an interval
            are missing, such as NaN and all numbers of fewer than 6 clusters.
        notes: Sentences on why numbers have no interval.
    """

    value: str | None
    result: _Result
    samples: int
    scenarios: int
    clusters: int
    intervals: Mapping[str, tuple[float, float]]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakdown(FrozenMappings, Generic[_Result]):
    """Results by one attribute.

    Attributes:
        by: Name of the attribute.
        groups: Groups of all samples, by value; agents in the order of `taxonomy.AGENTS`.
        without_infrastructure: The same without the samples of the roadside pole, which no vehicle
            drives.
        resampling: Settings of the intervals.
    """

    by: str
    groups: tuple[Group[_Result], ...]
    without_infrastructure: tuple[Group[_Result], ...]
    resampling: Resampling


def breakdown(
    evaluator: Evaluator[_Result],
    attributes: Mapping[str, SampleAttributes],
    by: str,
    resampling: Resampling | None = None,
) -> Breakdown[_Result]:
    """Return the results of an evaluator's samples, by the values of an attribute.

    The result has the same bits for any order of the samples, of the attributes, and of the parts
    that were merged.

    Args:
        evaluator: Evaluator with all samples counted.
        attributes: Attributes of its samples, from `sample_attributes`; other samples are ignored.
        by: One of `ATTRIBUTES`; `all` for one group.
        resampling: Settings of the intervals; None for the defaults.

    Raises:
        ChoiceError: no such attribute.
        EvaluationError: a sample's attributes are missing.
    """
    by = attribute_name(by)
    missing = sorted(evaluator.tokens - attributes.keys())
    if missing:
        raise EvaluationError(
            f"{len(missing)} samples have no attributes, such as {missing[0]}; pass "
            "sample_attributes(dataset, evaluator.tokens)"
        )
    evaluated = {token: attributes[token] for token in sorted(evaluator.tokens)}
    vehicles = {}
    for token, sample in evaluated.items():
        if sample.agent != INFRASTRUCTURE:
            vehicles[token] = sample
    settings = resampling or Resampling()
    groups = _groups(evaluator, evaluated, by, settings)
    without_infrastructure = groups
    if len(vehicles) != len(evaluated):
        without_infrastructure = _groups(evaluator, vehicles, by, settings)
    return Breakdown(
        by=by,
        groups=groups,
        without_infrastructure=without_infrastructure,
        resampling=settings,
    )


def _groups(
    evaluator: Evaluator[_Result],
    attributes: Mapping[str, SampleAttributes],
    by: str,
    resampling: Resampling,
) -> tuple[Group[_Result], ...]:
    """Return the groups of samples by the values of an attribute, in natural order."""
    by_value = tokens_by_value(attributes, by)
    ordered: list[str | None] = sorted(by_value, key=natural_order)
    if by == "agent":
        ordered.sort(key=AGENTS.index)
    groups = []
    for value in ordered:
        groups.append(_group(evaluator, value, by_value[value], attributes, resampling))
    return tuple(groups)


def _group(
    evaluator: Evaluator[_Result],
    value: str | None,
    tokens: Sequence[str],
    attributes: Mapping[str, SampleAttributes],
    resampling: Resampling,
) -> Group[_Result]:
    """Return one group of samples with its result and intervals."""
    names = {token: cluster_of(attributes[token].scenario) for token in tokens}
    clusters = evaluator.clustered(dict(sorted(names.items(), key=itemgetter(1))))
    result = evaluator.compute(tokens)
    intervals = intervals_of(evaluator, clusters, result, resampling)
    return Group(
        value=value,
        result=result,
        samples=len(tokens),
        scenarios=len({attributes[token].scenario for token in tokens}),
        clusters=len(clusters),
        intervals=intervals.ends,
        notes=intervals.notes,
    )
