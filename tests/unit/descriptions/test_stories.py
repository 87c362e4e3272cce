import copy
import functools
import json
import operator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from refusals import assert_refused
from wording import holding, lacking

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
OF_NORMAL = {
    ("collision",): "nobody collides",
    ("duration",): "9.9 s",
    ("nearest",): "come nearest",
    ("nearest", "pair", 0, "agent"): "The other vehicle",
    ("nearest", "pair", 1, "category"): "cyclist",
    ("nearest", "min_ttc"): "0.8 s",
    ("nearest", "min_gap"): "2.3 m",
}


def without(facts: dict[str, Any], path: tuple[Any, ...]) -> dict[str, Any]:
    result = copy.deepcopy(facts)
    functools.reduce(operator.getitem, path[:-1], result)[path[-1]] = None
    return result


@pytest.mark.parametrize(
    ("facts", "path", "clause"),
    [
        *((ACCIDENT, path, clause) for path, clause in CLAUSES.items()),
        *((NORMAL | {"duration": 9.9}, path, clause) for path, clause in OF_NORMAL.items()),
    ],
)
def test_a_clause_goes_with_its_value(
    facts: dict[str, Any], path: tuple[Any, ...], clause: str
) -> None:
    text = story_text(without(facts, path))
    assert clause in story_text(facts)
    assert (holding(text, clause, "None"), text[-1]) == ([], ".")


@pytest.mark.parametrize(
    ("sides", "braking", "said"),
    [
        (("front", "front"), {}, "head-on"),
        (("front", "rear"), {}, "hit from behind by the ego"),
        (("left", "rear"), {}, "left side to rear side"),
        (("left", "rear"), {"avoidable": False, "slack": None}, "would not have avoided"),
    ],
)
def test_ends_in_words(sides: tuple[str, str], braking: dict[str, Any], said: str) -> None:
    facts = copy.deepcopy(ACCIDENT)
    for road_user, side in zip(facts["accident"]["pair"], sides, strict=True):
        road_user["side"] = side
    facts["accident"]["braking"] |= braking
    assert said in story_text(facts)


def test_a_pair_that_is_apart_is_not_told_as_hit() -> None:
    text = story_text(ACCIDENT | {"accident": ACCIDENT["accident"] | {"apart": True, "gap": 1.3}})
    assert "1.3 m apart" in text
    assert holding(text, "is hit", "Braking", "delta-v") == []


def test_stories_of_a_release(da_motion: DeepAccident) -> None:
    (accident,), (normal,) = (da_motion.find(collision=ends) for ends in (True, False))
    story, contact = da_motion.describe(accident), da_motion.collision(accident)
    pair, seen = story.facts["accident"]["pair"], story.facts["accident"]["seen"]
    assert [each["actor_id"] for each in pair] == list(contact.actor_ids)
    assert [each["speed"] for each in pair] == pytest.approx(contact.speeds, abs=0.01)
    assert seen["ego_vehicle"] == pytest.approx(lead_times(da_motion, accident).leads[0], abs=1e-6)
    assert f"{pair[0]['speed']:.1f} m/s" in str(story)
    assert json.loads(story.to_json())["text"] == story.text
    assert "nobody collides in 3.4 s" in da_motion.describe(normal).text
    assert list(stories(da_motion, workers=1)) == [
        da_motion.describe(each) for each in da_motion.scenario
    ]
    assert_refused(
        (lambda: da_motion.describe("type1/nowhere"), TokenError, ("no scenario", "type1/nowhere"))
    )


def test_the_command(da_motion: DeepAccident, tmp_path: Path) -> None:
    out, root = tmp_path / "stories.jsonl", str(da_motion.dataroot)
    every = CliRunner().invoke(safety, ["describe", root, "--workers", "1", "--out", str(out)])
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert [each["scenario"] for each in lines] == [each["token"] for each in da_motion.scenario]
    assert (every.exit_code, lacking(every.output, *(each["text"] for each in lines))) == (0, [])
    one = CliRunner().invoke(safety, ["describe", root, lines[0]["scenario"], "--json"])
    assert json.loads(one.output) == lines[0]


def test_what_a_release_lacks_is_said(tmp_path: Path) -> None:
    da = DeepAccident("v1", write_small_release(tmp_path, SmallRelease(channels=())), verbose=False)
    story = da.describe(next(each for each in da.scenario if each["weather"] is None))
    assert "it is not known whether anybody collides" in story.text
    assert not lacking(" ".join(story.facts["unknown"]), "no meta file", "no labels")
