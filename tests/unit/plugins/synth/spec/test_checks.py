import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.spec import parse_spec


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        ("gap: 3", r"f.yaml:4: actors\[1\].gap: is not possible for the role other; remove it"),
        (
            "category: cyclist",
            (
                "category: the role other cannot be a cyclist; choose car, .*cle; a "
                "cyclist has the role background"
            ),
        ),
        (
            "category: [car, pedestrian]",
            "the role other cannot be a pedestrian; .*, a pedestrian the role pedestrian$",
        ),
        (
            "start_distance: 30",
            (
                r"f.yaml:4: actors\[1\].start_distance: is computed from meet \(f.yaml:5\) "
                r"for the timed role other; remove it"
            ),
        ),
        ("start_distance: 0", "start_distance: is computed from meet"),
        (
            "lane: 1",
            (
                "there is no lane 1 where the road has one lane in each direction; "
                "choose 0, or give the road two"
            ),
        ),
        ("lane: [0, 1]", "there is no lane 1"),
        (
            "lane_change: 50",
            ("there is no other lane where the road has one lane in each direction; remove it, or"),
        ),
    ],
)
def test_an_impossible_entry_is_refused(with_other, entries, sentence):
    assert_raises(
        (lambda: parse_spec(with_other(entries), "f.yaml"), ConfigError, sentence),
    )


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (
            "road: {kind: three-way}",
            r"f.yaml:4: actors\[1\].from: a three-way junction has no north arm; choose west or",
        ),
        ("road: {kind: [four-way, three-way]}", "a three-way junction has no north arm"),
        ("road: {lanes: 3}", r"f.yaml:7: road.lanes: expected 1 or 2 in each direction, found 3"),
        ("road:\n  hump: {distance: 20}", "f.yaml:8: road.hump"),
        (
            "road:\n  hump: [null, {arm: west,\n    height: [1, 9]}]",
            "f.yaml:8: road.hump.*: .*grade",
        ),
        ("road:\n  kind: [four-way]\n  hump: {length: 300}", "f.yaml:9: road.hump: .*do not fit"),
    ],
)
def test_an_impossible_road_is_refused(small, more, sentence):
    assert_raises(
        (lambda: parse_spec(f"{small}\n{more}", "f.yaml"), ConfigError, sentence),
    )


def write_scenario(*actors: str, more: str = "") -> str:
    lines = [f"  - {{{actor}}}\n" for actor in actors]
    return "actors:\n" + "".join(lines) + more


EGO, OTHER = "role: ego, from: west", "role: other, from: south"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            write_scenario(EGO, OTHER, *["role: background, from: west"] * 99),
            "f.yaml:1: actors: there are 101, but a road has room for only 100; keep 100",
        ),
        (write_scenario(EGO), "f.yaml:1: actors: there is no actor with role other; add one"),
        (
            write_scenario(
                EGO, OTHER + ", turn: left, lane_change: [40, 50]", more="road: {lanes: 2}"
            ),
            (
                "lane_change: is possible only with the turn straight; remove it, or use the turn "
                "straight"
            ),
        ),
        (
            write_scenario(EGO, OTHER, EGO),
            r"f.yaml:4: actors\[2\].role: there are 2 actors with role ego; keep one",
        ),
        (
            write_scenario("role: ego", OTHER),
            r"actors\[0\].from: is missing; the role ego needs it; add one of west, ",
        ),
        (
            write_scenario(EGO, OTHER, "role: ego_behind, from: west"),
            "from: is not possible for the role ego_behind",
        ),
        (
            write_scenario(EGO, OTHER, "role: pedestrian, category: car, from: east"),
            "the role pedestrian cannot be a car",
        ),
        (
            write_scenario(EGO, OTHER, "role: parked, category: cyclist, from: east"),
            "choose car, truck, van, motorcycle; ",
        ),
        (
            write_scenario(EGO, OTHER, "role: pedestrian, from: east, max_speed: [2, 3.5]"),
            (
                r"actors\[2\].max_speed: expected 0.5 to 3 m/s for a pedestrian, found "
                r"3.5; walking is 1 to 2 m/s"
            ),
        ),
        (
            write_scenario(EGO, OTHER, "role: parked, from: east, turn: left"),
            "turn: is not possible for the role parked",
        ),
        (
            write_scenario(EGO, OTHER, more="road: {kind: three-way}"),
            (
                r"f.yaml:3: actors\[1\].turn: the turn straight is impossible from the south arm "
                r"of a three-way junction; choose"
            ),
        ),
        (
            write_scenario(EGO, "role: other, from: west", more="meet: {actors: [ego, other]}"),
            (
                "do not cross; in one lane they follow each other; let one of them start "
                "in the other lane, with a"
            ),
        ),
        (
            write_scenario(EGO, OTHER, more="meet: {actors: [ego, ego]}"),
            "f.yaml:4: meet.actors: ego cannot meet itself",
        ),
        (
            write_scenario(EGO, OTHER, more="meet: {actors: [ego]}"),
            r"meet.actors: expected a list of 2, found \['ego'\]",
        ),
        (
            write_scenario(EGO, OTHER, more="meet: {actors: [ego, ego_behind]}"),
            "ego_behind cannot be timed",
        ),
        (
            write_scenario(EGO, OTHER, more="meet: {actors: [ego, pedestrian]}"),
            "there are 0 actors with role pedestrian",
        ),
        (
            write_scenario(EGO, "role: other, from: [south, east]", more="meet: {}"),
            (
                r"meet.actors: the paths of ego \(west straight 0\) and other \(east "
                r"straight 0\) do not cross"
            ),
        ),
        (
            write_scenario(EGO, "role: other, from: [south, east]", more="view: hidden"),
            (
                "f.yaml:4: view: no house can stand between ego from the west and other "
                "from the east; choose open, or"
            ),
        ),
    ],
)
def test_an_impossible_scenario_is_refused(text, sentence):
    assert_raises(
        (lambda: parse_spec(text, "f.yaml"), ConfigError, sentence),
    )


def test_actors_that_record_nothing_may_be_several():
    pedestrian = "role: pedestrian, from: east"
    texts = [
        write_scenario(
            EGO,
            OTHER,
            "role: parked, from: south",
            pedestrian,
            "role: pedestrian, from: west",
            "role: background, from: north",
        ),
        write_scenario(EGO, OTHER, pedestrian, more="meet: {actors: [ego, pedestrian]}"),
        write_scenario(EGO, OTHER, more="view: [open, hidden]"),
    ]
    for text in texts:
        parse_spec(text)


def test_a_start_may_be_given_where_it_counts():
    """A pedestrian's start is its place on the arm; with `null` among the values of `meet`, some
    draws time nobody.
    """
    other = OTHER + ", start_distance: 30"
    pedestrian = "role: pedestrian, from: west, start_distance: 20"
    texts = [
        write_scenario(EGO, other, pedestrian, more="meet: {actors: [ego, pedestrian]}"),
        write_scenario(EGO, other, more="meet: [null, {actors: [ego, other]}]"),
        write_scenario(EGO, OTHER + ", start_distance: null", more="meet: {}"),
    ]
    for text in texts:
        parse_spec(text)
