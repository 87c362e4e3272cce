"""The attributes by which results are broken down: place, weather, story, and how near the accident is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.selection import accident_visible
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.text import choice

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import SampleRecord, ScenarioRecord

_FRAMES_PER_SECOND: Final = round(1 / FRAME_PERIOD)
_WEATHER_GROUPS: Final = {"Rain": "Rainy", "Cloudy": "Cloudy", "Clear": "Clear"}
STRAIGHT: Final = "straight_straight"
TURNING: Final = "one_of_the_agents_turning"
NO_IMPACT: Final = "no impact"
WITHIN_RECORDINGS: Final = ("time_to_impact", "impact_step", "time_to_end", "accident_visibility")
"""Attributes that differ within a recording: of no use to a task on whole recordings."""


def cluster_of(scenario: str) -> str:
    """The cluster of an accident and its twin, of the same junction, traffic and weather: `type1_subtype1/Town03…`.

    Args:
        scenario: its token, `type1_subtype1_accident/Town03…`.
    """
    kind, slash, name = scenario.partition("/")
    return f"{kind.rpartition('_')[0] or kind}{slash}{name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioAttributes:
    """What a scenario's name and meta file say, in the released evaluation's words; None unknown.

    See docs/released_code.md, Visibility and attributes.

    Attributes:
        scenario_type: such as `type1_subtype1_accident`.
        town: such as `Town03`.
        weather: as meta has it, such as `HardRain`.
        weather_group: `Rainy`, `Cloudy` or `Clear`, by the word in it; a weather with none of them stays as it is.
        time_of_day: `Noon`, `Sunset` or `Night`.
        time_of_day_group: `Night`, or `Daytime` for all else.
        collision_status: `no_collision`, `collides_with_pedestrian` or `collides_between_vehicles`.
        junction: `four_way_junction` or `three_way_junction`.
        trajectory_type: `straight_straight` if both drive straight on at a four-way junction, else
            `one_of_the_agents_turning`: also where both drive straight on at a three-way one.
    """

    scenario_type: str
    town: str
    weather: str | None
    weather_group: str | None
    time_of_day: str | None
    time_of_day_group: str | None
    collision_status: str | None
    junction: str | None
    trajectory_type: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleAttributes:
    """The attributes of a sample.

    Attributes:
        scenario: token of its scenario.
        agent: whose it is.
        story: what its scenario's name and meta say.
        accident_visibility: `visible` or `invisible`, by the released rule (`selection.accident_visible`); None where
            that cannot be told.
        time_to_impact: `k s`: the recorded impact is more than k − 1 s ahead and at most k s; `no impact` if nobody
            collides, None without meta.
        impact_step: likewise in steps of 0.5 s.
        time_to_end: seconds to the scenario's last frame, such as `1.5`, as the released evaluation has it.
    """

    scenario: str
    agent: str
    story: ScenarioAttributes
    accident_visibility: str | None
    time_to_impact: str | None
    impact_step: str | None
    time_to_end: str

    def value(self, name: str) -> str | None:
        """The value of one of `ATTRIBUTES`; None where it is not known. Raises ChoiceError."""
        name = choice("by", name, ATTRIBUTES)
        if name == EVERYTHING:
            return EVERYTHING
        value: str | None = getattr(self.story if name in ScenarioAttributes.__dataclass_fields__ else self, name)
        return value


EVERYTHING: Final = "all"
ATTRIBUTES: Final = (
    EVERYTHING,
    *ScenarioAttributes.__dataclass_fields__,
    "agent",
    "accident_visibility",
    "time_to_impact",
    "impact_step",
    "time_to_end",
)
"""What results can be broken down by; `all` is not to break them down."""


def sample_attributes(dataset: Dataset, tokens: Iterable[str]) -> dict[str, SampleAttributes]:
    """The attributes of samples, by token.

    Raises:
        TokenError: no such sample.
    """
    stories: dict[str, ScenarioAttributes] = {}
    result = {}
    for token in tokens:
        sample = dataset.sample.get(token)
        scenario = dataset.scenario.get(sample["scenario_token"])
        story = stories.setdefault(scenario["token"], scenario_attributes(scenario))
        result[token] = _attributes(sample, story, visible=accident_visible(dataset, token))
    return result


def scenario_attributes(scenario: ScenarioRecord) -> ScenarioAttributes:
    """The attributes of a scenario's record."""
    weather, time_of_day, road = scenario["weather"], scenario["time_of_day"], scenario["road_type"]
    return ScenarioAttributes(
        scenario_type=scenario["scenario_type"],
        town=scenario["town"],
        weather=weather,
        weather_group=weather and next((name for word, name in _WEATHER_GROUPS.items() if word in weather), weather),
        time_of_day=time_of_day,
        time_of_day_group=time_of_day and ("Night" if time_of_day == "Night" else "Daytime"),
        collision_status=_collision_status(scenario),
        junction=road and road.replace("-", "_").replace(" ", "_"),
        trajectory_type=_trajectory_type(scenario),
    )


def tokens_by_value(attributes: Mapping[str, SampleAttributes], name: str) -> dict[str | None, list[str]]:
    """The samples that have each value of an attribute; values in the order met. Raises ChoiceError."""
    result: dict[str | None, list[str]] = {}
    for token, each in attributes.items():
        result.setdefault(each.value(name), []).append(token)
    return result


def time_bin(frames: int, width: int) -> str:
    """The time from a recorded frame to one `frames` later as the end of its bin of `width` frames: `2 s`, `0.5 s`."""
    return f"{-(-frames // width) * width / _FRAMES_PER_SECOND:g} s"


def _attributes(sample: SampleRecord, story: ScenarioAttributes, *, visible: bool | None) -> SampleAttributes:
    ahead, left = sample["time_to_impact"], sample["time_to_end"]
    frames = None if ahead is None else round(ahead * _FRAMES_PER_SECOND)
    without = None if story.collision_status is None else NO_IMPACT
    return SampleAttributes(
        scenario=sample["scenario_token"],
        agent=sample["agent"],
        story=story,
        accident_visibility=None if visible is None else "visible" if visible else "invisible",
        time_to_impact=without if frames is None else time_bin(frames, _FRAMES_PER_SECOND),
        impact_step=without if frames is None else time_bin(frames, _FRAMES_PER_SECOND // 2),
        time_to_end=f"{left:.1f}",
    )


def _collision_status(scenario: ScenarioRecord) -> str | None:
    collision = scenario["collision"]
    if collision is None:
        return None if scenario["weather"] is None else "no_collision"  # no weather: no meta
    return "collides_with_pedestrian" if "pedestrian" in collision["classes"] else "collides_between_vehicles"


def _trajectory_type(scenario: ScenarioRecord) -> str | None:
    road, directions = scenario["road_type"], (scenario["ego_direction"], scenario["other_direction"])
    if road is None or None in directions:
        return None
    return STRAIGHT if road.startswith("four") and directions == ("straight", "straight") else TURNING
