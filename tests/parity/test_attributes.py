"""The golden attributes (tests/data/golden: a_labels, d_accident), by which the released evaluation
groups its results.

a_labels has meta lines and the values that the released code read from them, d_accident the samples
of a run that have each value (docs/released_code.md, Visibility and attributes). The words are
equal. `test_visibility` tests `accident_visibility` itself.
"""

from typing import Any

import pytest

from deepaccident_devkit.evaluation.breakdowns import SampleAttributes, tokens_by_value
from deepaccident_devkit.selection.fields import FIELDS

_TIMES_OF_DAY = ("Noon", "Sunset", "Night")
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
"""Our name of each released attribute."""
_ROADS = {"four_way_junction": "four-way junction", "three_way_junction": "three-way junction"}
"""Our word for a released value that the meta files, and so our table, spell differently."""
_VISIBILITY = {"True": "visible", "False": "invisible"}


def make_record(golden) -> dict[str, Any]:
    """Return a scenario's record with the fields of the stored meta lines and sample name."""
    first_line, *lines = golden.entry["meta"]
    word, _, class1, _, class2 = first_line.split()[:5]
    meta = dict(line.split(": ", 1) for line in lines if ": " in line)
    time = next(time for time in _TIMES_OF_DAY if word.endswith(time))
    sample_name = golden.entry["sample_idx"]
    return {
        "scenario_type": sample_name.split("_accident_")[0] + "_accident",
        "town": next(part for part in sample_name.split("_") if part.startswith("Town")),
        "weather": word.removesuffix(time),
        "time_of_day": time,
        "collision": None if class1 == class2 == "-1" else {"classes": [class1, class2]},
        "road_type": meta["junction type"],
        "ego_direction": meta["self direction"],
        "other_direction": meta["other direction"],
    }


@pytest.mark.golden_cases("a_labels", "scenes")
def test_attributes_of_meta_equal_the_released_codes(golden) -> None:
    record = make_record(golden)
    for name, value in golden.entry["scene_attributes"].items():
        attribute = FIELDS[_NAMES[name]].read(None, record)  # type: ignore[arg-type]
        assert attribute == _ROADS.get(value, value), name


def make_attributes(entry: dict[str, Any]) -> SampleAttributes:
    story = {_NAMES[name]: value for name, value in entry["meta"].items()}
    return SampleAttributes(
        scenario=entry["sample_idx"],
        agent=entry["agent"],
        story=story,
        accident_visibility=_VISIBILITY[str(entry["accident_visibility"])],
        time_to_impact=None,
        impact_step=None,
        time_to_end=f"{(entry['scenario_length'] - entry['timestamp']) / 10:.1f}",
    )


@pytest.mark.golden_cases("d_accident", "attributes_counter")
def test_samples_are_grouped_by_attribute_value(golden) -> None:
    name, indices_by_value = list(golden.whole["attributes_counter"].items())[golden.index]
    expected = {
        _VISIBILITY.get(value, value): [str(index) for index in indices]
        for value, indices in indices_by_value.items()
    }
    attributes = {
        str(index): make_attributes(entry) for index, entry in enumerate(golden.whole["samples"])
    }

    tokens = tokens_by_value(attributes, _NAMES[name])

    assert tokens == expected
    assert list(tokens) == list(expected)
