"""The golden attributes (tests/data/golden: a_labels, d_accident), by which the released evaluation
sorts its results.

a_labels has meta lines and what the released code read in them, d_accident which samples of a run
have which value (docs/released_code.md, Visibility and attributes). Equal words.
`accident_visibility` itself is `test_visibility`'s.
"""

from typing import Any

import pytest

from deepaccident_devkit.evaluation.breakdowns import SampleAttributes, tokens_by_value
from deepaccident_devkit.selection.fields import FIELDS

_TIMES = ("Noon", "Sunset", "Night")
_NAMES = {
    "scenario_type": "scenario_type",
    "town_name": "town",
    "weather": "weather_group",
    "time_of_the_day": "time_of_day_group",
    "collision_status": "collision_status",
    "junction_type": "road_type",
    "trajectory_type": "trajectory_type",
    "accident_visibility": "accident_visibility",
    "seconds_before_end_of_scenario": "time_to_end",
}
"""The released names → ours."""
_ROADS = {"four_way_junction": "four-way junction", "three_way_junction": "three-way junction"}
"""The released words that meta, and so our table, has otherwise."""
_VISIBILITY = {"True": "visible", "False": "invisible"}


def record_of(golden) -> dict[str, Any]:
    """The fields of a scenario's record that the stored meta lines and sample name say."""
    first, *lines = golden.entry["meta"]
    word, _, class1, _, class2 = first.split()[:5]
    said = dict(line.split(": ", 1) for line in lines if ": " in line)
    time = next(time for time in _TIMES if word.endswith(time))
    return {
        "scenario_type": golden.entry["sample_idx"].split("_accident_")[0] + "_accident",
        "town": next(
            part for part in golden.entry["sample_idx"].split("_") if part.startswith("Town")
        ),
        "weather": word.removesuffix(time),
        "time_of_day": time,
        "collision": None if class1 == class2 == "-1" else {"classes": [class1, class2]},
        "road_type": said["junction type"],
        "ego_direction": said["self direction"],
        "other_direction": said["other direction"],
    }


@pytest.mark.golden_cases("a_labels", "scenes")
def test_attributes_of_meta_equal_the_released_codes(golden) -> None:
    expected = golden.entry["scene_attributes"]
    found = {name: FIELDS[_NAMES[name]].read(None, record_of(golden)) for name in expected}  # type: ignore[arg-type]
    assert found == {name: _ROADS.get(value, value) for name, value in expected.items()}


def attributes_of(entry: dict[str, Any]) -> SampleAttributes:
    said = {_NAMES[name]: value for name, value in entry["meta"].items()}
    return SampleAttributes(
        scenario=entry["sample_idx"],
        agent=entry["agent"],
        story=said,
        accident_visibility=_VISIBILITY[str(entry["accident_visibility"])],
        time_to_impact=None,
        impact_step=None,
        time_to_end=f"{(entry['scenario_length'] - entry['timestamp']) / 10:.1f}",
    )


@pytest.mark.golden_cases("d_accident", "attributes_counter")
def test_who_has_which_value(golden) -> None:
    name = list(golden.whole["attributes_counter"])[golden.index]
    attributes = {
        str(index): attributes_of(entry) for index, entry in enumerate(golden.whole["samples"])
    }
    found = tokens_by_value(attributes, _NAMES[name])
    expected = golden.whole["attributes_counter"][name]
    as_ours = {
        _VISIBILITY.get(value, value): [str(index) for index in each]
        for value, each in expected.items()
    }
    assert found == as_ours
    assert list(found) == list(as_ours)
