import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.safety import lead_times, stories, story_text
from deepaccident_devkit.safety.cli import safety
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
        "gap": 0.1,
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
UNTOLD = {
    *(("accident", "pair", which, "actor_id") for which in range(2)),
    *(("nearest", "pair", which, "actor_id") for which in range(2)),
    ("accident", "time"),
    ("accident", "gap"),
    ("accident", "impact_angle"),
    ("scenario",),
    *((name,) for name in ("collision", "duration")),  # of an accident
    ("nearest", "pair", 0, "category"),  # of an agent
    ("accident", "pair", 1, "side"),  # of the one that hits
}
"""Facts for programs, which no clause tells."""


def without(facts: dict[str, Any], path: tuple[Any, ...]) -> dict[str, Any]:
    result = copy.deepcopy(facts)
    place: Any = result
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = None
    return result


def leaves(facts: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(facts, dict):
        for name, value in facts.items():
            yield from leaves(value, (*path, name))
    elif isinstance(facts, list) and facts and isinstance(facts[0], dict):
        for number, value in enumerate(facts):
            yield from leaves(value, (*path, number))
    elif facts is not None and facts != []:
        yield path


@pytest.mark.parametrize(
    ("facts", "path", "clause"),
    [
        *((ACCIDENT, path, clause) for path, clause in CLAUSES.items()),
        *((NORMAL | {"duration": 9.9}, path, clause) for path, clause in OF_NORMAL.items()),
    ],
)
def test_a_clause_goes_with_its_value(facts: dict[str, Any], path: tuple[Any, ...], clause: str) -> None:
    assert clause in story_text(facts)
    text = story_text(without(facts, path))
    assert clause not in text
    assert "None" not in text
    assert text.endswith(".")


@pytest.mark.parametrize("facts", [ACCIDENT, NORMAL])
def test_each_fact_is_told_or_named_as_untold(facts: dict[str, Any]) -> None:
    told = {path for path in leaves(facts) if story_text(without(facts, path)) != story_text(facts)}
    rest = set(leaves(facts)) - told
    assert rest <= UNTOLD


def test_ends_in_words() -> None:
    facts = copy.deepcopy(ACCIDENT)
    accident = facts["accident"]
    accident["pair"][0]["side"] = "front"
    assert "the ego, a car going straight at 12.1 m/s, collides head-on with a truck" in story_text(facts)
    accident["pair"][1]["side"] = "rear"
    assert "A truck, turning left at 8.4 m/s, is hit from behind by the ego" in story_text(
        facts | dict.fromkeys(("town", "road_type", "signalized", "weather", "time_of_day"))
    )
    accident["seen"] = {"ego_vehicle": 0.0, "infrastructure": 2.0}
    assert "the ego alone never did" in story_text(facts)
    accident["seen"] = {"ego_vehicle": 2.0, "infrastructure": 2.0}
    assert "The ego saw both 2.0 s before." in story_text(facts)
    accident["seen"] = {"ego_vehicle": 0.0, "infrastructure": 0.0}
    assert "No agent alone saw both" in story_text(facts)
    accident["braking"] |= {"avoidable": False, "slack": None, "by": ["ego_vehicle", None]}
    assert "by the ego and the other road user would not have avoided it" in story_text(facts)


def test_stories_of_a_release(da_motion: DeepAccident) -> None:
    accident = da_motion.find(collision=True)[0]
    story = da_motion.describe(accident)
    pair, contact = story.facts["accident"]["pair"], da_motion.collision(accident)
    assert [each["actor_id"] for each in pair] == list(contact.actor_ids)
    assert [each["speed"] for each in pair] == pytest.approx(contact.speeds, abs=0.01)
    assert story.facts["accident"]["seen"]["ego_vehicle"] == pytest.approx(
        lead_times(da_motion, accident).leads[0], abs=1e-6
    )
    assert f"{pair[0]['speed']:.1f} m/s" in str(story)
    assert json.loads(story.to_json())["text"] == story.text
    normal = da_motion.describe(da_motion.find(collision=False)[0])
    assert "nobody collides in 3.4 s" in normal.text
    assert [each.text for each in stories(da_motion, workers=1)] == [
        da_motion.describe(each).text for each in da_motion.scenario
    ]
    with pytest.raises(TokenError, match="no scenario"):
        da_motion.describe("type1_subtype1_accident/nowhere")


def test_what_a_release_lacks_is_said(tmp_path: Path) -> None:
    root = write_small_release(tmp_path, SmallRelease(channels=()))
    da = DeepAccident("v1", root, verbose=False)
    (unlabelled,) = (each for each in da.scenario if each["weather"] is None)
    story = da.describe(unlabelled)
    assert "it is not known whether anybody collides" in story.text
    assert len(story.facts["unknown"]) == 2
    assert "no meta file" in story.facts["unknown"][0]
    assert "no labels" in story.facts["unknown"][1]


def test_the_command(da_motion: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "stories.jsonl"
    arguments = ["describe", str(da_motion.dataroot), "--workers", "1", "--out", str(out)]
    result = CliRunner().invoke(safety, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert [each["scenario"] for each in lines] == [each["token"] for each in da_motion.scenario]
    assert all(each["text"] in result.output for each in lines)
    one = CliRunner().invoke(safety, [*arguments[:2], lines[0]["scenario"], "--json"], catch_exceptions=False)
    assert json.loads(one.output) == lines[0]
