"""Queries over the scenario table."""

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from support.expected_errors import assert_raises
from support.tiny_release import META_TEXT, SCENARIO_TYPE, label_lines, write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, DeepAccidentError, FieldError
from deepaccident_devkit.evaluation.breakdowns import ATTRIBUTES
from deepaccident_devkit.interactions import scenario as interactions_module
from deepaccident_devkit.selection import Filter, parse_where
from deepaccident_devkit.selection.fields import FIELDS, group_texts
from deepaccident_devkit.tables.records import CollisionRecord, ScenarioRecord

QUIET_META = "ClearNight -1 -1 -1 -1 -1 -1 -1 15\n"
NORMAL_TYPE = "type1_subtype2_normal"


def name_scenario(town: str, number: int) -> str:
    return f"{town}_type001_subtype0001_scenario{number:05d}"


@pytest.fixture(scope="module")
def da(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """A release of five scenarios.

    They are an accident, a quiet one, one without a meta, an accident with a third vehicle, and a
    quiet one in another town.
    """
    root = tmp_path_factory.mktemp("selection")
    third_vehicle_meta = META_TEXT.replace("1223 car 1212", "1223 car 1300").replace(
        "ego other", "ego none"
    )
    scenarios = [
        (SCENARIO_TYPE, name_scenario("Town03", 1), META_TEXT, 4),
        (NORMAL_TYPE, name_scenario("Town03", 2), QUIET_META, 5),
        (SCENARIO_TYPE, name_scenario("Town03", 3), None, 6),
        (
            SCENARIO_TYPE,
            name_scenario("Town05", 4),
            third_vehicle_meta.replace("HardRain", "Wet"),
            7,
        ),
        (NORMAL_TYPE, name_scenario("Town10HD", 5), QUIET_META, 8),
    ]
    for kind, name, meta, frames in scenarios:
        write_tiny_release(
            root, scenario_type=kind, name=name, meta=meta, frames=frames, agents=("ego_vehicle",)
        )
    (root / "train.txt").write_text(f"{SCENARIO_TYPE} {name_scenario('Town03', 1)}\n")
    return DeepAccident(dataroot=root, verbose=False)


def find_numbers(da: DeepAccident, *where: str, **filters) -> list[int]:
    """Return the numbers at the end of the names of the scenarios that match, ascending."""
    scenarios = da.find(*where, **filters)
    return sorted(int(scenario["name"][-5:]) for scenario in scenarios)


@pytest.mark.parametrize(
    ("where", "filters", "numbers"),
    [
        ((), {}, [1, 2, 3, 4, 5]),
        (("town=Town03",), {"town": "Town03"}, [1, 2, 3]),
        (("town=Town05, Town10HD",), {"town": {"Town05", "Town10HD"}}, [4, 5]),
        (("type=type1_subtype2_normal",), {"scenario_type": NORMAL_TYPE}, [2, 5]),
        (("weather=Wet,Clear",), {"weather": ["Wet", "Clear"]}, [2, 4, 5]),
        (("weather=unknown",), {"weather": None}, [3]),
        (("weather=Wet,unknown",), {"weather": ("Wet", None)}, [3, 4]),
        (("time_of_day=Night",), {"time_of_day": "Night"}, [2, 5]),
        (("collision=true",), {"collision": True}, [1, 4]),
        (("collision=No",), {"collision": False}, [2, 5]),
        (("collision=none",), {"collision": None}, [3]),
        (("designed_accident=true",), {"designed_accident": True}, [1, 3, 4]),
        (("signalized=false",), {"signalized": False}, [2, 5]),
        (("split=train",), {"split": "train"}, [1]),
        (("split=unknown",), {"split": None}, [2, 3, 4, 5]),
        (("accident_type=1",), {"accident_type": 1}, [1]),
        (("accident_type=none",), {"accident_type": None}, [2, 3, 4, 5]),
        (("road_type=four-way junction",), {"road_type": "four-way junction"}, [1, 4]),
        (
            ("spawn_side=left", "ego_direction=straight"),
            {"spawn_side": "left", "other_direction": "straight"},
            [1, 4],
        ),
        (("num_frames=5..7",), {"length": "5..7"}, [2, 3, 4]),
        (("length=..5,8",), {"num_frames": ["..5", 8]}, [1, 2, 5]),
        (("length=7..",), {"length": range(7, 9)}, [4, 5]),
        (("length >= 7",), {"length": ">=7"}, [4, 5]),
        (("length>7",), {"length": ">7"}, [5]),
        (("length<5",), {"length": "<5"}, [1]),
        (("length<=5",), {"length": "<=5"}, [1, 2]),
        (("accident_type>=1",), {"accident_type": "1..12"}, [1]),
        (("town=Town03", "collision=true"), {"town": "Town03", "collision": True}, [1]),
        (("town=Town07",), {"town": "Town07"}, []),
        (("town=Town03", "town=Town05"), {"town": []}, []),
        ((f"name={name_scenario('Town05', 4)}",), {"name": name_scenario("Town05", 4)}, [4]),
        (("TOWN=town05",), {"Town": "TOWN05"}, [4]),
        (("weather=hard_rain",), {"weather": "hardrain"}, [1]),
        (("road_type=Four_Way_Junction",), {"road_type": "four way junction"}, [1, 4]),
        (("weather_group=Clear,Rainy",), {"weather_group": ["clear", "RAINY"]}, [1, 2, 5]),
        (("weather_group=Wet",), {"weather_group": "Wet"}, [4]),
        (("time_of_day_group=Daytime",), {"time_of_day_group": "Daytime"}, [1, 4]),
        (
            ("collision_status=collides_between_vehicles",),
            {"collision_status": "collides_between_vehicles"},
            [1, 4],
        ),
        (("collision_status=unknown",), {"collision_status": None}, [3]),
        (("trajectory_type=straight_straight",), {"trajectory_type": "straight_straight"}, [1, 4]),
        (("contact_side=front_side",), {"contact_side": "Front Side"}, [1, 4]),
        (("contact_side=front",), {"contact_side": "rear_side"}, []),
        (("contact_side!=unknown",), {"spawn_relation": "same"}, [1, 4]),
        (("collision_ids=1300",), {"collision_ids": {1300, 5}}, [4]),
        (("collision_ids>1250",), {"collision_ids": "1251.."}, [4]),
        (
            ("collision_agents=ego_vehicle", "length<5"),
            {"collision_agents": "ego_vehicle", "length": 4},
            [1],
        ),
        (("collision_classes!=car",), {"collision_classes": None}, [2, 3, 5]),
        (("impact>6790.1", "impact<6790.2"), {"impact": "6790.1..6790.2"}, [1, 4]),
        (("impact>=6790.168605131015",), {"impact": 6790.168605131015}, [1, 4]),
        (("impact>6790.168605131015",), {"impact": "<6790.168605131015"}, []),
        (
            ("closing_speed=unknown", "length>4"),
            {"closing_speed": None, "length": "5.."},
            [2, 3, 5],
        ),
        (("velocity_frame=unknown",), {"velocity_frame": None}, [1, 2, 3, 4, 5]),
    ],
)
def test_texts_and_keywords_find_the_same(
    da: DeepAccident, where, filters, numbers: list[int]
) -> None:
    assert find_numbers(da, *where) == numbers
    assert find_numbers(da, **filters) == numbers


def test_closing_speed_is_the_contacts(da_motion: DeepAccident) -> None:
    (accident,) = da_motion.find(collision=True)
    speed = da_motion.collision(accident).closing_speed
    assert speed > 1
    assert da_motion.find(closing_speed=speed) == [accident]
    assert da_motion.find(f"closing_speed>{speed - 0.01:.4f}") == [accident]
    assert da_motion.find(f"closing_speed>{speed + 0.01:.4f}") == []
    assert accident not in da_motion.find(closing_speed=None)


def test_every_column_is_a_field_and_every_group_of_a_breakdown_of_scenarios_too(
    da: DeepAccident,
) -> None:
    collision_fields = CollisionRecord.__annotations__.keys() - {"ids", "classes", "agents"}
    sample_attributes = {
        "all",
        "agent",
        "accident_visibility",
        "time_to_impact",
        "impact_step",
        "time_to_end",
    }
    scenario_attributes = set(ATTRIBUTES) - sample_attributes
    assert {*ScenarioRecord.__annotations__, *collision_fields, *scenario_attributes} <= set(FIELDS)

    groups_by_token = {scenario["token"]: group_texts(da, scenario) for scenario in da.scenario}
    for name in scenario_attributes:
        for value in {groups[name] for groups in groups_by_token.values()}:
            tokens = {token for token, groups in groups_by_token.items() if groups[name] == value}
            scenarios = da.find(f"{name}={value or 'unknown'}")
            assert {scenario["token"] for scenario in scenarios} == tokens


PEDESTRIAN = {"classes": ["car", "pedestrian"]}
META_FIELDS = ("weather", "time_of_day", "collision", "road_type")


@pytest.mark.parametrize(
    ("changes", "expected_groups"),
    [
        (
            {},
            {
                "weather_group": "Rainy",
                "time_of_day_group": "Daytime",
                "collision": "true",
                "collision_status": "collides_between_vehicles",
                "trajectory_type": "straight_straight",
                "accident_type": "1",
            },
        ),
        ({"weather": "WetCloudy"}, {"weather_group": "Cloudy"}),
        ({"weather": "Wet"}, {"weather_group": "Wet"}),
        ({"time_of_day": "Sunset"}, {"time_of_day_group": "Daytime"}),
        ({"time_of_day": "Night"}, {"time_of_day_group": "Night"}),
        ({"collision": None}, {"collision_status": "no_collision"}),
        ({"collision": PEDESTRIAN}, {"collision_status": "collides_with_pedestrian"}),
        ({"road_type": "three-way junction"}, {"trajectory_type": "one_of_the_agents_turning"}),
        ({"other_direction": "left"}, {"trajectory_type": "one_of_the_agents_turning"}),
        ({"other_direction": None}, {"trajectory_type": None}),
        (
            dict.fromkeys(META_FIELDS),
            dict.fromkeys(
                (
                    *META_FIELDS[2:],
                    "weather_group",
                    "time_of_day_group",
                    "collision_status",
                    "trajectory_type",
                )
            ),
        ),
    ],
)
def test_the_released_evaluations_groups(
    da: DeepAccident, changes, expected_groups: dict[str, str | None]
) -> None:
    (accident,) = da.find(length=4)
    if changes.get("collision"):
        changes = {"collision": accident["collision"] | changes["collision"]}
    assert group_texts(da, accident | changes).items() >= expected_groups.items()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "field", ["weather=Wet", "length=5..7", "collision=true", "accident_type=1", "town=Town07"]
)
def test_not_equal_finds_all_that_equal_leaves_out(da: DeepAccident, field: str) -> None:
    equal_numbers = find_numbers(da, field)
    unequal_numbers = find_numbers(da, field.replace("=", "!="))
    assert sorted(equal_numbers + unequal_numbers) == [1, 2, 3, 4, 5]


def test_a_mix_of_texts_and_keywords_and_the_callers_own_records(da: DeepAccident) -> None:
    (scenario,) = da.find("town!=Town03", weather="Wet")
    scenario["town"] = "changed"
    assert da.find(weather="Wet")[0]["town"] == "Town05"
    expected = [scenario["token"] for scenario in da.scenario if scenario["town"] == "Town03"]
    assert [scenario["token"] for scenario in da.find(town="Town03")] == expected


@pytest.mark.parametrize(
    ("text", "parsed"),
    [
        ("town=Town03", Filter("town", ("Town03",))),
        (" town != Town03 , Town05 ", Filter("town", ("Town03", "Town05"), negated=True)),
        ("length>=50", Filter("length", (">=50",))),
        ("length < 50", Filter("length", ("<50",))),
        ("length=40..60", Filter("length", ("40..60",))),
        ("road_type=four-way junction", Filter("road_type", ("four-way junction",))),
    ],
)
def test_parsed_texts(text: str, parsed: Filter) -> None:
    assert parse_where(text) == parsed


@pytest.mark.parametrize(
    "text", ["", "town", "=Town03", "town=", "town=Town03,", "length>", "to wn=Town03"]
)
def test_texts_that_are_no_filter(text: str) -> None:
    assert_raises((lambda: parse_where(text), ChoiceError, "expected field=value"))


NUMBER_MESSAGE = "length: expected a number, a range such as 40..60"


@pytest.mark.parametrize(
    ("query", "error", "message"),
    [
        (
            {"wether": "Clear"},
            FieldError,
            ("no field 'wether' to find scenarios by; the fields are weather, ",),
        ),
        ("frame=1", FieldError, ("no field 'frame' to find scenarios by",)),
        (
            {"weather": "heavyrain"},
            ChoiceError,
            (
                "weather: expected one of Clear, ",
                "WetCloudy; found 'heavyrain'; did you mean 'HardRain'?",
            ),
        ),
        (
            {"town": "town3"},
            ChoiceError,
            ("expected one of Town01, Town02, Town03", "; did you mean 'Town03'?"),
        ),
        (
            {"time_of_day": "night_time"},
            ChoiceError,
            ("Noon, Sunset, Night; found 'night_time'; did you mean 'Night'?",),
        ),
        (
            "town==",
            ChoiceError,
            ("town: expected one of Town01", "found '='"),
        ),
        (
            {"type": "normal"},
            ChoiceError,
            ("type: expected one of ", "type1_subtype2_normal"),
        ),
        (
            {"accident_visibility": "seen"},
            ChoiceError,
            ("expected one of visible, partial, invisible; found 'seen'",),
        ),
        (
            "collision=maybe",
            ChoiceError,
            ("collision: expected true, false or unknown, found 'maybe'",),
        ),
        ({"signalized": 1}, ChoiceError, ("signalized: expected true, false or unknown, found 1",)),
        ({"length": "long"}, ChoiceError, (NUMBER_MESSAGE, "found 'long'")),
        ({"length": True}, ChoiceError, (NUMBER_MESSAGE, "found True")),
        ({"length": 4.5}, ChoiceError, (NUMBER_MESSAGE, "found 4.5")),
        (
            {"accident_type": 13},
            ChoiceError,
            ("accident_type: expected one of 1, 2, ", "12; found 13"),
        ),
        ("length=60..40", ChoiceError, ("length: '60..40': 60 is greater than 40; swap them",)),
        (
            "town>=3",
            ChoiceError,
            ("town: only numbers have ranges, found '>=3'",),
        ),
        ("length>3,4", ChoiceError, ("'length>3,4': > takes one number, found 2",)),
        (
            {"length": np.array([5, 7])},
            ChoiceError,
            ("found array([5, 7]); give an array as a list: array.tolist()",),
        ),
    ],
)
def test_what_is_impossible_is_named_with_what_is_possible(
    da: DeepAccident, query, error, message
) -> None:
    if isinstance(query, str):
        assert_raises((lambda: da.find(query), error, message))
    else:
        assert_raises((lambda: da.find(**query), error, message))


@pytest.mark.parametrize(
    "field", ["town", "num_frames", "accident_type", "collision", "accident_visibility"]
)
@pytest.mark.parametrize(
    "value",
    [
        "9" * 5000,
        "-" + "9" * 5000,
        f"{'9' * 5000}..",
        f"..{'9' * 5000}",
        f">={'9' * 5000}",
        -(10**5000),
        np.array([5, 7]),
        np.array(5),
        np.array(["Town03"]),
        np.array([[True]]),
        [np.array([5, 7])],
        [["Town03"]],
        [{}],
        {"Town03": 1},
        b"Town03",
        np.float64(4.5),
        np.datetime64("2024-01-01"),
        float("nan"),
        object(),
    ],
    ids=lambda value: repr(value)[:20] if not isinstance(value, int) else "long number",
)
def test_values_that_no_field_has_are_our_error(da: DeepAccident, field: str, value) -> None:
    if field == "num_frames" and isinstance(value, int):
        assert find_numbers(da, num_frames=value) == []  # it is a number, but of no recording
        return
    with pytest.raises(ChoiceError, match=f"^{field}: ") as error:
        da.find(**{field: value})
    message = str(error.value)
    assert len(message) < 400
    assert any(remedy in message for remedy in ("expected", "only numbers have"))


@pytest.mark.parametrize(
    "text", [None, 5, ["town=Town03"], {"town": "Town03"}, np.array(["town=Town03"])]
)
def test_a_text_that_is_none_is_our_error(da: DeepAccident, text) -> None:
    assert_raises(
        (
            lambda: da.find(text),
            DeepAccidentError,
            r"expected a text such as town=Town03,Town05, found .*as keywords",
        )
    )


def collider_line(*, is_visible: bool) -> str:
    num_points = 9 if is_visible else 0
    return f"car 30 0 0 4.5 1.9 1.5 0 0 0 1212 {num_points} {is_visible}"


@pytest.mark.parametrize(
    ("visible_frames", "visibility"),
    # frames 20, 25, 30 and 35 are evaluated
    [(range(41), "visible"), ((), "invisible"), ((35,), "partial")],
)
def test_scenarios_are_found_by_how_well_their_accident_is_seen(
    tmp_path: Path, visible_frames, visibility: str
) -> None:
    """The rule itself is in tests/unit/v2x/test_accident_visibility.py."""

    def make_lines(agent: str, frame: int) -> list[str]:
        return [*label_lines(agent, frame), collider_line(is_visible=frame in visible_frames)]

    write_tiny_release(tmp_path, frames=40, agents=("ego_vehicle",), lines_of=make_lines)
    da = DeepAccident(dataroot=tmp_path, verbose=False)
    assert len(da.find(accident_visibility=visibility)) == 1
    assert da.find(f"accident_visibility!={visibility}") == []
    assert da.find(accident_visibility=None) == []


@pytest.mark.parametrize("hidden", [True, False])
def test_a_hidden_collider_is_one_of_the_accident_and_of_its_twin(
    tmp_path: Path, hidden: bool
) -> None:
    """The rule itself is in tests/unit/v2x/test_agents.py. Without an accident it is unknown."""

    def make_lines(agent: str, frame: int) -> list[str]:
        return [*label_lines(agent, frame), collider_line(is_visible=not hidden)]

    pair_name = name_scenario("Town03", 1)
    single_name = name_scenario("Town03", 2)
    normal_type = SCENARIO_TYPE.replace("accident", "normal")
    for kind, name, meta in (
        (SCENARIO_TYPE, pair_name, META_TEXT),
        (normal_type, pair_name, QUIET_META),
        (normal_type, single_name, QUIET_META),
    ):
        write_tiny_release(
            tmp_path,
            scenario_type=kind,
            name=name,
            meta=meta,
            frames=20,
            agents=("ego_vehicle",),
            lines_of=make_lines,
        )

    da = DeepAccident(dataroot=tmp_path, verbose=False)
    tokens = [scenario["token"] for scenario in da.find(hidden_collider=hidden)]
    assert tokens == [f"{SCENARIO_TYPE}/{pair_name}", f"{normal_type}/{pair_name}"]
    tokens = [scenario["token"] for scenario in da.find(hidden_collider=None)]
    assert tokens == [f"{normal_type}/{single_name}"]


def test_the_most_critical_moving_pair(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    (accident,) = da_motion.find(collision=True)
    normal = da_motion.find(collision=False)[0]
    pairs = da_motion.interactions(accident).pairs
    expected_values = {
        "min_ttc": pairs.min_ttc[pairs.moving].min(),
        "min_pet": np.abs(pairs.pet[pairs.moving]).min(),
        "min_gap": pairs.min_gap[pairs.moving].min(),
        "max_drac": pairs.max_drac[pairs.moving].max(),
    }
    for name, value in expected_values.items():
        assert FIELDS[name].read(da_motion, accident) == value
    assert da_motion.find(min_ttc="..0.3") == [accident]
    assert da_motion.find("min_ttc<=0.3") == [accident]
    assert da_motion.find("max_drac>20") == [accident]
    assert da_motion.find("min_ttc>0.3") == [normal]

    interactions_of = Mock(wraps=interactions_module.interactions_of)
    monkeypatch.setattr(interactions_module, "interactions_of", interactions_of)
    assert da_motion.find(min_ttc="..100", collision=False) == [normal]
    ((_, scenarios),) = [call.args for call in interactions_of.call_args_list]
    assert [scenario["token"] for scenario in scenarios] == [normal["token"]], (
        "costly fields come last"
    )


def test_without_pairs_nothing_is_near_and_without_labels_nothing_is_known(
    da: DeepAccident, tmp_path: Path
) -> None:
    values_without_pairs = {
        "min_ttc": np.inf,
        "min_pet": np.inf,
        "min_gap": np.inf,
        "max_drac": 0.0,
    }
    for name, value in values_without_pairs.items():
        assert {FIELDS[name].read(da, scenario) for scenario in da.scenario} == {value}

    root = write_tiny_release(tmp_path, labelled=False)
    unlabelled = DeepAccident(dataroot=root, verbose=False)
    assert unlabelled.find(min_ttc=None) == unlabelled.scenario[:]
    assert unlabelled.find(min_ttc="0..") == []
