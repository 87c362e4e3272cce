"""Queries over the scenario table."""

from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused
from tiny import META, TYPE, label_lines, write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, DeepAccidentError, FieldError
from deepaccident_devkit.evaluation.breakdowns import ATTRIBUTES
from deepaccident_devkit.interactions import scenario as interactions_module
from deepaccident_devkit.selection import Filter, parse_where
from deepaccident_devkit.selection.fields import FIELDS, group_texts
from deepaccident_devkit.tables.records import CollisionRecord, ScenarioRecord

QUIET = "ClearNight -1 -1 -1 -1 -1 -1 -1 15\n"
NORMAL = "type1_subtype2_normal"


def named(town: str, number: int) -> str:
    return f"{town}_type001_subtype0001_scenario{number:05d}"


@pytest.fixture(scope="module")
def da(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Five scenarios: an accident, a quiet one, one without a meta, one with a third vehicle, one
    in another town.
    """
    root = tmp_path_factory.mktemp("selection")
    third = META.replace("1223 car 1212", "1223 car 1300").replace("ego other", "ego none")
    scenarios = [
        (TYPE, named("Town03", 1), META, 4),
        (NORMAL, named("Town03", 2), QUIET, 5),
        (TYPE, named("Town03", 3), None, 6),
        (TYPE, named("Town05", 4), third.replace("HardRain", "Wet"), 7),
        (NORMAL, named("Town10HD", 5), QUIET, 8),
    ]
    for kind, name, meta, frames in scenarios:
        write_tiny_release(
            root, scenario_type=kind, name=name, meta=meta, frames=frames, agents=("ego_vehicle",)
        )
    (root / "train.txt").write_text(f"{TYPE} {named('Town03', 1)}\n")
    return DeepAccident(dataroot=root, verbose=False)


def numbers(da: DeepAccident, *where: str, **filters) -> list[int]:
    """The scenarios found, by the last number of their names, ascending."""
    return sorted(int(scenario["name"][-5:]) for scenario in da.find(*where, **filters))


@pytest.mark.parametrize(
    ("where", "filters", "found"),
    [
        ((), {}, [1, 2, 3, 4, 5]),
        (("town=Town03",), {"town": "Town03"}, [1, 2, 3]),
        (("town=Town05, Town10HD",), {"town": {"Town05", "Town10HD"}}, [4, 5]),
        (("type=type1_subtype2_normal",), {"scenario_type": NORMAL}, [2, 5]),
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
        ((f"name={named('Town05', 4)}",), {"name": named("Town05", 4)}, [4]),
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
    da: DeepAccident, where, filters, found: list[int]
) -> None:
    assert numbers(da, *where) == numbers(da, **filters) == found


def test_closing_speed_is_the_contacts(da_motion: DeepAccident) -> None:
    (accident,) = (one for one in da_motion.scenario if one["collision"])
    speed = da_motion.collision(accident).closing_speed
    assert speed > 1
    assert (
        da_motion.find(closing_speed=speed)
        == da_motion.find(f"closing_speed>{speed - 0.01:.4f}")
        == [accident]
    )
    assert da_motion.find(f"closing_speed>{speed + 0.01:.4f}") == []
    assert accident not in da_motion.find(closing_speed=None)


def test_every_column_is_a_field_and_every_group_of_a_breakdown_of_scenarios_too(
    da: DeepAccident,
) -> None:
    of_collisions = CollisionRecord.__annotations__.keys() - {"ids", "classes", "agents"}
    of_samples = {
        "all",
        "agent",
        "accident_visibility",
        "time_to_impact",
        "impact_step",
        "time_to_end",
    }
    assert {*ScenarioRecord.__annotations__, *of_collisions, *set(ATTRIBUTES) - of_samples} <= set(
        FIELDS
    )
    stories = {one["token"]: group_texts(da, one) for one in da.scenario}
    for name in set(ATTRIBUTES) - of_samples:
        for value in {story[name] for story in stories.values()}:
            found = {one["token"] for one in da.find(f"{name}={value or 'unknown'}")}
            assert found == {token for token, story in stories.items() if story[name] == value}


PEDESTRIAN = {"classes": ["car", "pedestrian"]}
NOTHING = ("weather", "time_of_day", "collision", "road_type")


@pytest.mark.parametrize(
    ("changes", "told"),
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
            dict.fromkeys(NOTHING),
            dict.fromkeys(
                (
                    *NOTHING[2:],
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
    da: DeepAccident, changes, told: dict[str, str | None]
) -> None:
    (accident,) = da.find(length=4)
    if changes.get("collision"):
        changes = {"collision": accident["collision"] | changes["collision"]}
    assert group_texts(da, accident | changes).items() >= told.items()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "field", ["weather=Wet", "length=5..7", "collision=true", "accident_type=1", "town=Town07"]
)
def test_not_equal_finds_all_that_equal_leaves_out(da: DeepAccident, field: str) -> None:
    assert sorted(numbers(da, field) + numbers(da, field.replace("=", "!="))) == [1, 2, 3, 4, 5]


def test_a_mix_of_texts_and_keywords_and_the_callers_own_records(da: DeepAccident) -> None:
    (scenario,) = da.find("town!=Town03", weather="Wet")
    scenario["town"] = "changed"
    assert da.find(weather="Wet")[0]["town"] == "Town05"
    assert [one["token"] for one in da.find(town="Town03")] == [
        one["token"] for one in da.scenario if one["town"] == "Town03"
    ]


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
    assert_refused((lambda: parse_where(text), ChoiceError, "expected field=value"))


NUMBER = "num_frames: expected a number, a range such as 40..60"


@pytest.mark.parametrize(
    ("asked", "error", "names"),
    [
        (
            {"wether": "Clear"},
            FieldError,
            ("cannot be found by 'wether'; the fields are weather, ",),
        ),
        ("frame=1", FieldError, ("cannot be found by 'frame'",)),
        (
            {"weather": "heavyrain"},
            ChoiceError,
            (
                "weather: found 'heavyrain'; possible are Clear, ",
                "WetCloudy; did you mean 'HardRain'?",
            ),
        ),
        (
            {"town": "town3"},
            ChoiceError,
            ("possible are Town01, Town02, Town03", "; did you mean 'Town03'?"),
        ),
        (
            {"time_of_day": "night_time"},
            ChoiceError,
            ("Noon, Sunset, Night; did you mean 'Night'?",),
        ),
        ("town==", ChoiceError, ("town: found '='; possible are Town01",)),
        (
            {"type": "normal"},
            ChoiceError,
            ("scenario_type: found 'normal'; possible are ", "type1_subtype2_normal"),
        ),
        (
            {"accident_visibility": "seen"},
            ChoiceError,
            ("'seen'; possible are visible, partial, invisible",),
        ),
        (
            "collision=maybe",
            ChoiceError,
            ("collision: expected true, false or unknown, found 'maybe'",),
        ),
        ({"signalized": 1}, ChoiceError, ("signalized: expected true, false or unknown, found 1",)),
        ({"length": "long"}, ChoiceError, (NUMBER, "found 'long'")),
        ({"length": True}, ChoiceError, (NUMBER, "found True")),
        ({"length": 4.5}, ChoiceError, (NUMBER, "found 4.5")),
        (
            {"accident_type": 13},
            ChoiceError,
            ("accident_type: found 13; possible are 1, 2, ", "12"),
        ),
        ("length=60..40", ChoiceError, ("num_frames: '60..40': 60 is more than 40",)),
        ("town>=3", ChoiceError, ("town: '>=3' is a range, which only numbers have",)),
        ("length>3,4", ChoiceError, ("'length>3,4': > takes one number, found 2",)),
        (
            {"length": np.array([5, 7])},
            ChoiceError,
            ("found array([5, 7]); give an array as a list: array.tolist()",),
        ),
    ],
)
def test_what_is_impossible_is_named_with_what_is_possible(
    da: DeepAccident, asked, error, names
) -> None:
    assert_refused(
        (lambda: da.find(asked) if isinstance(asked, str) else da.find(**asked), error, names)
    )


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
        assert numbers(da, num_frames=value) == []  # a number, if not of a recording
        return
    with pytest.raises(ChoiceError, match=f"^{field}: ") as caught:
        da.find(**{field: value})
    assert len(str(caught.value)) < 400
    assert any(
        remedy in str(caught.value) for remedy in ("possible are", "expected", "only numbers have")
    )


@pytest.mark.parametrize(
    "text", [None, 5, ["town=Town03"], {"town": "Town03"}, np.array(["town=Town03"])]
)
def test_a_text_that_is_none_is_our_error(da: DeepAccident, text) -> None:
    assert_refused(
        (
            lambda: da.find(text),
            DeepAccidentError,
            r"expected a text such as town=Town03,Town05, found .*as keywords",
        )
    )


@pytest.mark.parametrize(
    ("seen_at", "expected"),
    [
        (range(41), "visible"),
        ((), "invisible"),
        ((35,), "partial"),
    ],  # evaluated are 20, 25, 30 and 35
)
def test_scenarios_are_found_by_how_well_their_accident_is_seen(
    tmp_path: Path, seen_at, expected: str
) -> None:
    """The rule itself is in tests/unit/v2x/test_accident_visibility.py."""

    def lines(agent: str, frame: int) -> list[str]:
        seen = frame in seen_at
        return [*label_lines(agent, frame), f"car 30 0 0 4.5 1.9 1.5 0 0 0 1212 {9 * seen} {seen}"]

    write_tiny_release(tmp_path, frames=40, agents=("ego_vehicle",), lines_of=lines)
    da = DeepAccident(dataroot=tmp_path, verbose=False)
    assert len(da.find(accident_visibility=expected)) == 1
    assert da.find(f"accident_visibility!={expected}") == da.find(accident_visibility=None) == []


@pytest.mark.parametrize("hidden", [True, False])
def test_a_hidden_collider_is_one_of_the_accident_and_of_its_twin(
    tmp_path: Path, hidden: bool
) -> None:
    """The rule itself is in tests/unit/v2x/test_agents.py. Without an accident it is not known."""

    def lines(agent: str, frame: int) -> list[str]:
        return [
            *label_lines(agent, frame),
            f"car 30 0 0 4.5 1.9 1.5 0 0 0 1212 {9 * (not hidden)} {not hidden}",
        ]

    accident, alone, first = (
        named("Town03", 1),
        named("Town03", 2),
        TYPE.replace("accident", "normal"),
    )
    for kind, name, meta in (
        (TYPE, accident, META),
        (first, accident, QUIET),
        (first, alone, QUIET),
    ):
        write_tiny_release(
            tmp_path,
            scenario_type=kind,
            name=name,
            meta=meta,
            frames=20,
            agents=("ego_vehicle",),
            lines_of=lines,
        )
    da = DeepAccident(dataroot=tmp_path, verbose=False)
    pair, rest = [f"{TYPE}/{accident}", f"{first}/{accident}"], [f"{first}/{alone}"]
    assert [one["token"] for one in da.find(hidden_collider=hidden)] == pair
    assert [one["token"] for one in da.find(hidden_collider=None)] == rest


def test_the_most_critical_moving_pair(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    accident, normal = (da_motion.find(collision=collided)[0] for collided in (True, False))
    pairs = da_motion.interactions(accident).pairs
    assert {
        name: FIELDS[name].read(da_motion, accident)
        for name in ("min_ttc", "min_pet", "min_gap", "max_drac")
    } == {
        "min_ttc": pairs.min_ttc[pairs.moving].min(),
        "min_pet": np.abs(pairs.pet[pairs.moving]).min(),
        "min_gap": pairs.min_gap[pairs.moving].min(),
        "max_drac": pairs.max_drac[pairs.moving].max(),
    }
    near = (
        da_motion.find(min_ttc="..0.3"),
        da_motion.find("min_ttc<=0.3"),
        da_motion.find("max_drac>20"),
    )
    assert near == ([accident],) * 3
    assert da_motion.find("min_ttc>0.3") == [normal]
    asked: list[str] = []
    computed = interactions_module.interactions_of

    def noted(dataset: DeepAccident, scenarios, **how):
        asked.extend(scenario["token"] for scenario in scenarios)
        return computed(dataset, scenarios, **how)

    monkeypatch.setattr(interactions_module, "interactions_of", noted)
    assert da_motion.find(min_ttc="..100", collision=False) == [normal]
    assert asked == [normal["token"]], "costly fields come last"


def test_without_pairs_nothing_is_near_and_without_labels_nothing_is_known(
    da: DeepAccident, tmp_path: Path
) -> None:
    far = {"min_ttc": np.inf, "min_pet": np.inf, "min_gap": np.inf, "max_drac": 0.0}
    assert {name: {FIELDS[name].read(da, one) for one in da.scenario} for name in far} == {
        name: {value} for name, value in far.items()
    }
    bare = DeepAccident(dataroot=write_tiny_release(tmp_path, labelled=False), verbose=False)
    assert bare.find(min_ttc=None) == bare.scenario[:]
    assert bare.find(min_ttc="0..") == []
