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


_FRAMES_PER_SECOND = round(1 / FRAME_PERIOD)
NO_IMPACT: Final = "no impact"
# Attributes that change within a recording; tasks that need whole recordings cannot use them.
WITHIN_RECORDINGS: Final = ("time_to_impact", "impact_step", "time_to_end", "accident_visibility")
# Token of a scene in our nuScenes export; a scene is one agent's recording of a scenario.
_NUSCENES_SCENE = re.compile(
    rf"^nuscenes/(\w+_(?:accident|normal))-(.+?)(?:-(?:{'|'.join(AGENTS)}))?$"
)
EVERYTHING: Final = "all"
_SAMPLE_ATTRIBUTES = (
    "agent",
    "accident_visibility",
    "time_to_impact",
    "impact_step",
    "time_to_end",
)
# Attributes by which results can be broken down; `all` puts all samples into one group.
ATTRIBUTES: Final = (
    EVERYTHING,
    *(name for name, field in FIELDS.items() if field.groups),
    *_SAMPLE_ATTRIBUTES,
)


def cluster_of(scenario: str) -> str:
    """Return the name of the cluster that an accident and its twin share.

    The two have the same junction, traffic and weather. A scene of our nuScenes export belongs to
    the cluster of its scenario, whichever agent recorded it.

    Args:
        scenario: Token of a scenario, such as `type1_subtype1_accident/Town03…`, or of a scene in
            our export, such as `nuscenes/type1_subtype1_accident-Town03…-ego_vehicle`.

    Returns:
        The token without `_accident` or `_normal`: `type1_subtype1/Town03…`.
    """
    token = _NUSCENES_SCENE.sub(r"\1/\2", scenario)
    scenario_type, slash, name = token.partition("/")
    family = scenario_type.rpartition("_")[0] or scenario_type
    return f"{family}{slash}{name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleAttributes(ShortRepr):
    """The attributes of a sample.

    Attributes:
        scenario: Token of the scenario.
        agent: Name of the agent.
        story: Attributes of the scenario, by name (`deepaccident_devkit.selection` explains them);
            None for unknown values.
        accident_visibility: `visible` or `invisible`, by the released rule
            (`v2x.accident_visible`); None if unknown.
        time_to_impact: `k s` if the recorded impact is more than k − 1 s and at most k s ahead; `no
            impact` if there is no collision; None if the scenario has no meta file.
        impact_step: Time to the impact in steps of 0.5 s, otherwise like `time_to_impact`.
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
        """Return an attribute's value, None if unknown; raise ChoiceError for any other name."""
        if name not in ATTRIBUTES:
            name = attribute_name(name)
        if name == EVERYTHING:
            return EVERYTHING
        if name not in _SAMPLE_ATTRIBUTES:
            return self.story[name]
        value: str | None = getattr(self, name)
        return value


def attribute_name(name: str) -> str:
    """Return the member of `ATTRIBUTES` with a name, ignoring case.

    Former names of attributes are accepted, too, with a warning.

    Raises:
        ChoiceError: If no attribute has this name.
    """
    return choice("by", full_name(name), ATTRIBUTES)


def sample_attributes(dataset: Dataset, tokens: Iterable[str]) -> dict[str, SampleAttributes]:
    """Look up the attributes of samples, by token.

    Raises:
        TokenError: If the release does not have a sample.
    """
    stories: dict[str, dict[str, str | None]] = {}
    attributes = {}
    for token in tokens:
        sample = dataset.sample.get(token)
        scenario = sample["scenario_token"]
        if scenario not in stories:
            stories[scenario] = group_texts(dataset, dataset.scenario.get(scenario))
        is_visible = accident_visible(dataset, token)
        attributes[token] = _make_attributes(sample, stories[scenario], visible=is_visible)
    return attributes


def tokens_by_value(
    attributes: Mapping[str, SampleAttributes], name: str
) -> dict[str | None, list[str]]:
    """Group tokens by the samples' value of an attribute, in order of appearance.

    Raises:
        ChoiceError: If the attribute does not exist.
    """
    name = attribute_name(name)
    tokens: dict[str | None, list[str]] = {}
    for token, sample in attributes.items():
        tokens.setdefault(sample.value(name), []).append(token)
    return tokens


def time_bin(frames: int, width: int) -> str:
    """Return the name of the bin that contains a time: the bin's upper end, such as `0.5 s`.

    Args:
        frames: Time as a number of recorded frames.
        width: Number of frames in a bin.
    """
    bins = -(-frames // width)  # rounded up
    return f"{bins * width / _FRAMES_PER_SECOND:g} s"


def _make_attributes(
    sample: SampleRecord, story: Mapping[str, str | None], *, visible: bool | None
) -> SampleAttributes:
    """Build the attributes of a sample from its record and the attributes of its scenario."""
    seconds = sample["time_to_impact"]
    if seconds is not None:
        frames = round(seconds * _FRAMES_PER_SECOND)
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
    """The samples that share one value of an attribute.

    Attributes:
        value: Value of the attribute; None for samples with an unknown value.
        result: Result of these samples only.
        samples: Number of samples.
        scenarios: Number of scenarios that the samples belong to.
        clusters: Number of clusters; an accident and its twin are one (`cluster_of`).
        intervals: Path of a number (`ranges/30x30/iou`) → (low, high). Numbers without an interval
            are left out: numbers that are NaN, and all numbers if there are fewer than 6 clusters.
        notes: Sentences that explain why numbers have no interval.
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
        groups: One group per value, over all samples; agents in the order of `taxonomy.AGENTS`.
        without_infrastructure: The same groups without the samples of the infrastructure, which is
            not a vehicle.
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
    """Compute the results of an evaluator's samples for each value of an attribute.

    The numbers are identical for any order of the samples, of the attributes, and of merged
    evaluators.

    Args:
        evaluator: Evaluator with all samples counted.
        attributes: Attributes of its samples, from `sample_attributes`; other samples are
            ignored.
        by: One of `ATTRIBUTES`; `all` puts all samples into one group.
        resampling: Settings of the intervals; None for the defaults.

    Raises:
        ChoiceError: If the attribute does not exist.
        EvaluationError: If a sample's attributes are missing.
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
    groups = _group_samples(evaluator, evaluated, by, settings)
    without_infrastructure = groups
    if len(vehicles) != len(evaluated):
        without_infrastructure = _group_samples(evaluator, vehicles, by, settings)
    return Breakdown(
        by=by,
        groups=groups,
        without_infrastructure=without_infrastructure,
        resampling=settings,
    )


def _group_samples(
    evaluator: Evaluator[_Result],
    attributes: Mapping[str, SampleAttributes],
    by: str,
    resampling: Resampling,
) -> tuple[Group[_Result], ...]:
    """Group samples by the values of an attribute; groups are in natural order of the values."""
    tokens = tokens_by_value(attributes, by)
    values: list[str | None] = sorted(tokens, key=natural_order)
    if by == "agent":
        values.sort(key=AGENTS.index)
    groups = []
    for value in values:
        groups.append(_make_group(evaluator, value, tokens[value], attributes, resampling))
    return tuple(groups)


def _make_group(
    evaluator: Evaluator[_Result],
    value: str | None,
    tokens: Sequence[str],
    attributes: Mapping[str, SampleAttributes],
    resampling: Resampling,
) -> Group[_Result]:
    """Compute the result and the intervals of one group of samples."""
    cluster_by_token = {token: cluster_of(attributes[token].scenario) for token in tokens}
    ordered_clusters = dict(sorted(cluster_by_token.items(), key=itemgetter(1)))
    clusters = evaluator.clustered(ordered_clusters)
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
