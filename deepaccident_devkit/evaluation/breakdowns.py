"""Results by scenario type, town, weather, …: of any evaluator, with intervals over clusters (`intervals`).

The attributes are those of scenarios (`selection`), and of samples.
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
# Attributes that differ within a recording: of no use to a task on whole recordings.
WITHIN_RECORDINGS: Final = ("time_to_impact", "impact_step", "time_to_end", "accident_visibility")


# The token of a scene of our export to nuScenes, which stands for one agent's recording of a scenario.
_NUSCENES_SCENE: Final = re.compile(
    rf"^nuscenes/(\w+_(?:accident|normal))-(.+?)(?:-(?:{'|'.join(AGENTS)}))?$"
)


def cluster_of(scenario: str) -> str:
    """Return the cluster of an accident and its twin, of the same junction, traffic and weather.

    A scene of our export to nuScenes is of the cluster of its scenario, whichever agent recorded it.

    Args:
        scenario: its token, such as `type1_subtype1_accident/Town03…`, or as
            `nuscenes/type1_subtype1_accident-Town03…-ego_vehicle` of the export.

    Returns:
        The token without the ending of its type: `type1_subtype1/Town03…`.
    """
    kind, slash, name = _NUSCENES_SCENE.sub(r"\1/\2", scenario).partition("/")
    return f"{kind.rpartition('_')[0] or kind}{slash}{name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleAttributes(ShortRepr):
    """The attributes of a sample.

    Attributes:
        scenario: token of its scenario.
        agent: whose it is.
        story: the values of its scenario, by name (`deepaccident_devkit.selection` explains them); None unknown.
        accident_visibility: `visible` or `invisible`, by the released rule (`v2x.accident_visible`); None where
            that cannot be told.
        time_to_impact: `k s`: the recorded impact is more than k − 1 s ahead and at most k s; `no impact` if nobody
            collides, None without meta.
        impact_step: likewise in steps of 0.5 s.
        time_to_end: seconds to the scenario's last frame, such as `1.5`, as the released evaluation has it.
    """

    scenario: str
    agent: str
    story: Mapping[str, str | None]
    accident_visibility: str | None
    time_to_impact: str | None
    impact_step: str | None
    time_to_end: str

    def value(self, name: str) -> str | None:
        """The value of one of `ATTRIBUTES`; None where it is not known. Raises ChoiceError."""
        if name not in ATTRIBUTES:
            name = attribute_name(name)
        if name == EVERYTHING:
            return EVERYTHING
        value: str | None = getattr(self, name) if name in _OF_SAMPLES else self.story[name]
        return value


EVERYTHING: Final = "all"
_OF_SAMPLES: Final = (
    "agent",
    "accident_visibility",
    "time_to_impact",
    "impact_step",
    "time_to_end",
)
# What results can be broken down by; `all` is not to break them down.
ATTRIBUTES: Final = (
    EVERYTHING,
    *(name for name, field in FIELDS.items() if field.groups),
    *_OF_SAMPLES,
)


def attribute_name(name: str) -> str:
    """The one of `ATTRIBUTES` that a name stands for, whatever its case; an old name warns. Raises ChoiceError."""
    return choice("by", full_name(name), ATTRIBUTES)


def sample_attributes(dataset: Dataset, tokens: Iterable[str]) -> dict[str, SampleAttributes]:
    """The attributes of samples, by token.

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
        result[token] = _attributes(
            sample, stories[scenario], visible=accident_visible(dataset, token)
        )
    return result


def tokens_by_value(
    attributes: Mapping[str, SampleAttributes], name: str
) -> dict[str | None, list[str]]:
    """The samples that have each value of an attribute; values in the order met. Raises ChoiceError."""
    name = attribute_name(name)
    result: dict[str | None, list[str]] = {}
    for token, each in attributes.items():
        result.setdefault(each.value(name), []).append(token)
    return result


def time_bin(frames: int, width: int) -> str:
    """The time from a recorded frame to one `frames` later as the end of its bin of `width` frames: `2 s`, `0.5 s`."""
    return f"{-(-frames // width) * width / _FRAMES_PER_SECOND:g} s"


def _attributes(
    sample: SampleRecord, story: Mapping[str, str | None], *, visible: bool | None
) -> SampleAttributes:
    ahead, left = sample["time_to_impact"], sample["time_to_end"]
    frames = None if ahead is None else round(ahead * _FRAMES_PER_SECOND)
    without = None if story["collision_status"] is None else NO_IMPACT
    return SampleAttributes(
        scenario=sample["scenario_token"],
        agent=sample["agent"],
        story=story,
        accident_visibility=None if visible is None else "visible" if visible else "invisible",
        time_to_impact=without if frames is None else time_bin(frames, _FRAMES_PER_SECOND),
        impact_step=without if frames is None else time_bin(frames, _FRAMES_PER_SECOND // 2),
        time_to_end=f"{left:.1f}",
    )


_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True, kw_only=True)
class Group(FrozenMappings, Generic[_Result]):
    """The samples that share a value.

    Attributes:
        value: of the attribute; None for the samples whose value is not known.
        result: of these samples alone.
        samples: how many.
        scenarios: how many they are of.
        clusters: how many these are, where an accident and its twin are one (`cluster_of`).
        intervals: number of the result, by its path (`ranges/30x30/iou`) → (low, high); those without one, NaN and all
            of fewer than 6 clusters among them, are not there.
        notes: sentences that say why numbers have no interval.
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
        by: the attribute.
        groups: of all samples, by value; agents in the order of `taxonomy.AGENTS`.
        without_infrastructure: the same without the samples of the roadside pole, which no vehicle drives.
        resampling: how the intervals were made.
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
    """Results of an evaluator's samples, by the values of an attribute.

    The same bits for any order of the samples, of the attributes, and of the parts that were merged.

    Args:
        evaluator: with all samples counted.
        attributes: of its samples, from `sample_attributes`; those of other samples are ignored.
        by: one of `ATTRIBUTES`; `all` for one group.
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
    evaluator: Evaluator[_Result],
    attributes: Mapping[str, SampleAttributes],
    by: str,
    resampling: Resampling,
) -> tuple[Group[_Result], ...]:
    by_value = tokens_by_value(attributes, by)
    ordered: list[str | None] = sorted(by_value, key=natural_order)
    if by == "agent":
        ordered.sort(key=AGENTS.index)
    return tuple(
        _group(evaluator, value, by_value[value], attributes, resampling) for value in ordered
    )


def _group(
    evaluator: Evaluator[_Result],
    value: str | None,
    tokens: Sequence[str],
    attributes: Mapping[str, SampleAttributes],
    resampling: Resampling,
) -> Group[_Result]:
    names = {token: cluster_of(attributes[token].scenario) for token in tokens}
    clusters = evaluator.clustered(dict(sorted(names.items(), key=itemgetter(1))))
    result = evaluator.compute(tokens)
    made = intervals_of(evaluator, clusters, result, resampling)
    return Group(
        value=value,
        result=result,
        samples=len(tokens),
        scenarios=len({attributes[token].scenario for token in tokens}),
        clusters=len(clusters),
        intervals=made.ends,
        notes=made.notes,
    )
