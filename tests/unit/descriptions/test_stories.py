import copy
import functools
import json
import operator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from support.expected_errors import assert_raises
from support.text_contents import contained_parts, missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.descriptions import stories, story_text
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.plugins.safety import lead_times
from deepaccident_devkit.plugins.safety.cli import safety
from deepaccident_devkit.testing import SmallRelease, write_small_release

PAIR = [
    {"actor_id": 1, "category": "car", "agent": "ego_vehicle", "turn": "straight"}
    | {"speed": 12.1, "side": "right", "delta_v": 3.2},
    {"actor_id": 2, "category": "truck", "agent": None, "turn": "left"}
    | {"speed": 8.4, "side": "front", "delta_v": 0.6},
]
ACCIDENT: dict[str, Any] = {
    "scenario": "type1_subtype1_accident/x",
    "town": "Town03",
    "road_type": "four-way junction",
    "signalized": True,
    "weather": "HardRain",
    "time_of_day": "Night",
    "duration": 7.0,
    "collision": True,
    "accident": {
        "pair": PAIR,
        "time": 7.0,
        "gap": 0.14,
        "touching": None,
        "apart": False,
        "closing_speed": 9.5,
        "impact_angle": 90,
        "seen": {"ego_vehicle": 1.4, "infrastructure": 3.7},
        "braking": {"by": ["ego_vehicle"], "deceleration": 6.0, "avoidable": True, "slack": 1.1},
    },
    "nearest": None,
    "unknown": [],
}
NORMAL: dict[str, Any] = ACCIDENT | {
    "collision": False,
    "accident": None,
    "nearest": {
        "pair": [
            {"actor_id": 3, "category": "van", "agent": "other_vehicle"},
            {"actor_id": 4, "category": "cyclist", "agent": None},
        ],
        "min_ttc": 0.8,
        "min_gap": 2.3,
    },
}
CLAUSES = {
    ("town",): "in Town03",
    ("road_type",): "four-way junction",
    ("signalized",): "with traffic lights",
    ("weather",): "HardRain",
    ("time_of_day",): "Night",
    ("accident", "pair", 0, "category"): "a car",
    ("accident", "pair", 0, "agent"): "the ego,",
    ("accident", "pair", 0, "turn"): "going straight",
    ("accident", "pair", 0, "speed"): "12.1 m/s",
    ("accident", "pair", 0, "side"): "on its right side",
    ("accident", "pair", 0, "delta_v"): "3.2",
    ("accident", "pair", 1, "category"): "truck",
    ("accident", "pair", 1, "turn"): "turning left",
    ("accident", "pair", 1, "speed"): "8.4 m/s",
    ("accident", "pair", 1, "delta_v"): "0.6",
    ("accident", "closing_speed"): "closing at 9.5 m/s",
    ("accident", "gap"): "outlines 0.14 m apart at the last frame",
    ("accident", "seen", "ego_vehicle"): "the ego alone 1.4 s",
    ("accident", "seen", "infrastructure"): "infrastructure saw both 3.7 s before",
    ("accident", "braking"): "Braking",
    ("accident", "braking", "deceleration"): "6 m/s²",
    ("accident", "braking", "avoidable"): "would have avoided",
    ("accident", "braking", "slack"): "1.1 s",
    ("accident", "braking", "by"): "by the ego",
}
NORMAL_CLAUSES = {
    ("collision",): "nobody collides",
    ("duration",): "9.9 s",
    ("nearest",): "come nearest",
    ("nearest", "pair", 0, "agent"): "The other vehicle",
    ("nearest", "pair", 1, "category"): "cyclist",
    ("nearest", "min_ttc"): "0.8 s",
    ("nearest", "min_gap"): "2.3 m",
}


def remove_value(facts: dict[str, Any], path: tuple[Any, ...]) -> dict[str, Any]:
    changed_facts = copy.deepcopy(facts)
    parent = functools.reduce(operator.getitem, path[:-1], changed_facts)
    parent[path[-1]] = None
    return changed_facts


@pytest.mark.parametrize(
    ("facts", "path", "clause"),
    [
        *((ACCIDENT, path, clause) for path, clause in CLAUSES.items()),
        *((NORMAL | {"duration": 9.9}, path, clause) for path, clause in NORMAL_CLAUSES.items()),
    ],
)
def test_a_clause_goes_with_its_value(
    facts: dict[str, Any], path: tuple[Any, ...], clause: str
) -> None:
    assert clause in story_text(facts)
    text = story_text(remove_value(facts, path))
    assert contained_parts(text, clause, "None") == []
    assert text.endswith(".")


@pytest.mark.parametrize(
    ("sides", "braking", "words"),
    [
        (("front", "front"), {}, "head-on"),
        (("front", "rear"), {}, "hit from behind by the ego"),
        (("left", "rear"), {}, "left side to rear side"),
        (("left", "rear"), {"avoidable": False, "slack": None}, "would not have avoided"),
    ],
)
def test_ends_in_words(sides: tuple[str, str], braking: dict[str, Any], words: str) -> None:
    facts = copy.deepcopy(ACCIDENT)
    for road_user, side in zip(facts["accident"]["pair"], sides, strict=True):
        road_user["side"] = side
    facts["accident"]["braking"] |= braking
    assert words in story_text(facts)


def test_a_pair_that_is_apart_is_not_told_as_hit() -> None:
    accident = ACCIDENT["accident"] | {"apart": True, "gap": 1.3}
    text = story_text(ACCIDENT | {"accident": accident})
    assert "1.3 m apart" in text
    assert contained_parts(text, "is hit", "Braking", "delta-v") == []


def test_stories_of_a_release(da_motion: DeepAccident) -> None:
    (accident,) = da_motion.find(collision=True)
    story = da_motion.describe(accident)
    contact = da_motion.collision(accident)
    pair = story.facts["accident"]["pair"]
    assert [road_user["actor_id"] for road_user in pair] == list(contact.actor_ids)
    speeds = [road_user["speed"] for road_user in pair]
    assert speeds == pytest.approx(contact.speeds, abs=0.01)
    ego_lead = lead_times(da_motion, accident).leads[0]
    assert story.facts["accident"]["seen"]["ego_vehicle"] == pytest.approx(ego_lead, abs=1e-6)
    assert f"{speeds[0]:.1f} m/s" in str(story)
    assert json.loads(story.to_json())["text"] == story.text

    (normal,) = da_motion.find(collision=False)
    assert "nobody collides in 3.4 s" in da_motion.describe(normal).text
    expected = [da_motion.describe(scenario) for scenario in da_motion.scenario]
    assert list(stories(da_motion, workers=1)) == expected
    assert_raises(
        (lambda: da_motion.describe("type1/nowhere"), TokenError, ("no scenario", "type1/nowhere"))
    )


def test_the_command(da_motion: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "stories.jsonl"
    root = str(da_motion.dataroot)
    result = CliRunner().invoke(safety, ["describe", root, "--workers", "1", "--out", str(out)])
    assert result.exit_code == 0
    records = [json.loads(line) for line in out.read_text().splitlines()]
    tokens = [scenario["token"] for scenario in da_motion.scenario]
    assert [record["scenario"] for record in records] == tokens
    assert missing_parts(result.output, *(record["text"] for record in records)) == []

    result = CliRunner().invoke(safety, ["describe", root, tokens[0], "--json"])
    assert json.loads(result.output) == records[0]


def test_what_a_release_lacks_is_said(tmp_path: Path) -> None:
    root = write_small_release(tmp_path, SmallRelease(channels=()))
    da = DeepAccident("v1", root, verbose=False)
    story = da.describe(da.find(weather=None)[0])
    assert "it is not known whether anybody collides" in story.text
    assert not missing_parts(" ".join(story.facts["unknown"]), "no meta file", "no labels")
