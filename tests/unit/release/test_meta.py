from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.expected_errors import assert_raises
from support.strategies import mutations

from deepaccident_devkit.errors import MetaError, MissingFileError
from deepaccident_devkit.release import Collision, Meta, read_meta, write_meta
from deepaccident_devkit.taxonomy import META_AGENTS

# real files, as in docs/format.md, Meta
ACCIDENT = """\
HardRainNoon 1236 car 1237 car 6790.168605131015 same front_side 78
 colliding agents: ego_behind other_behind
 agents id: 1223 1236 1212 1237
 road_type: four-way junction
 another_vehicle_spawn_side: left
 ego_vehicle_direction: straight
 other_vehicle_direction: straight
"""
NO_COLLISION = "ClearNoon -1 -1 -1 -1 -1 -1 -1 110"
REMEDY = "; restore the file from its archive"


@pytest.fixture
def write(tmp_path: Path):
    def write_file(content: str | bytes) -> Path:
        path = tmp_path / "meta.txt"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write_file


ACCIDENT_META = Meta(
    weather="HardRain",
    time_of_day="Noon",
    collision=Collision(
        ids=(1236, 1237),
        classes=("car", "car"),
        impact=6790.168605131015,
        spawn_relation="same",
        contact_side="front_side",
        agents=("ego_vehicle_behind", "other_vehicle_behind"),
    ),
    simulated_frames=78,
    agent_ids=(1223, 1236, 1212, 1237),
    road_type="four-way junction",
    spawn_side="left",
    ego_direction="straight",
    other_direction="straight",
)


QUIET_META = Meta(weather="Clear", time_of_day="Noon", collision=None, simulated_frames=110)


@pytest.mark.parametrize(("text", "meta"), [(ACCIDENT, ACCIDENT_META), (NO_COLLISION, QUIET_META)])
def test_the_real_files(write, text: str, meta: Meta) -> None:
    assert read_meta(write(text)) == meta


@pytest.mark.parametrize(
    "text",
    [
        ACCIDENT.replace("\n", "\r\n"),
        ACCIDENT.rstrip("\n"),
        ACCIDENT.replace("\n", "  \n"),
        ACCIDENT.replace("\n", "\n\n"),
        "\n" + ACCIDENT,
        ACCIDENT.replace("\n ", "\n"),
        ACCIDENT.replace(": ", ":"),
        "\ufeff" + ACCIDENT,
    ],
    ids=[
        "crlf",
        "no-final-newline",
        "blanks",
        "blank-lines",
        "blank-first",
        "no-indent",
        "no-blank-after-colon",
        "mark",
    ],
)
def test_tolerated_forms(write, text: str) -> None:
    assert read_meta(write(text)) == ACCIDENT_META


@pytest.mark.parametrize(
    ("line", "field"),
    [
        (2, "agent_ids"),
        (3, "road_type"),
        (4, "spawn_side"),
        (5, "ego_direction"),
        (6, "other_direction"),
    ],
)
def test_a_missing_or_empty_line_is_none(write, line: int, field: str) -> None:
    lines = ACCIDENT.splitlines()
    without_line = lines[:line] + lines[line + 1 :]
    meta = read_meta(write("\n".join(without_line)))
    assert meta == replace(ACCIDENT_META, **{field: None})

    if line > 2:
        key, _, _ = lines[line].partition(":")
        lines[line] = f"{key}:"
        meta = read_meta(write("\n".join(lines)))
        assert getattr(meta, field) is None


@pytest.mark.parametrize(
    ("line", "agents"), [("", None), (" colliding agents: ego none\n", ("ego_vehicle", None))]
)
def test_colliding_agents_may_be_missing_or_third_road_users(
    write, line: str, agents: tuple | None
) -> None:
    text = ACCIDENT.replace(" colliding agents: ego_behind other_behind\n", line)
    meta = read_meta(write(text))
    assert meta.collision == replace(ACCIDENT_META.collision, agents=agents)


@pytest.mark.parametrize(
    ("word", "weather", "time_of_day"),
    [
        ("WetCloudySunset", "WetCloudy", "Sunset"),
        ("SoftRainNight", "SoftRain", "Night"),
        ("WetNoon", "Wet", "Noon"),
        ("Foggy", "Foggy", None),
        ("Night", "Night", None),
    ],
)
def test_weather_and_time_of_day(write, word: str, weather: str, time_of_day: str | None) -> None:
    text = NO_COLLISION.replace("ClearNoon", word)
    meta = read_meta(write(text))
    assert meta.weather == weather
    assert meta.time_of_day == time_of_day


def test_a_pair_with_an_untracked_id_is_no_collision(write) -> None:
    text = ACCIDENT.replace("1237 car", "-1 pedestrian")
    meta = read_meta(write(text))
    assert meta.collision is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ACCIDENT.replace(" same", ""), ":1: expected 9 words '<weather.*found 8: 'HardRainNoon"),
        (ACCIDENT.replace(" same", " same same"), ":1: expected 9 words .*found 10"),
        (ACCIDENT.replace("1236 car", "x36 car"), ":1: first id: expected an integer, found 'x36'"),
        (
            ACCIDENT.replace("1237 car", "12.5 car"),
            ":1: second id: expected an integer, found '12.5'",
        ),
        (
            ACCIDENT.replace("6790.168605131015", "hard"),
            ":1: impact: expected a finite number, found 'hard'",
        ),
        (
            ACCIDENT.replace("6790.168605131015", "1e300"),
            ":1: impact: expected a finite number, found '1e300'",
        ),
        (
            ACCIDENT.replace("6790.168605131015", "nan"),
            ":1: impact: expected a finite number, found 'nan'",
        ),
        (
            "\n\n" + ACCIDENT.replace("78", "many"),
            ":3: simulated frames: expected an integer, found 'many'",
        ),
        (
            ACCIDENT.replace("ego_behind other", "ego_behind"),
            ":2: expected two of ego, ego_behind, .*'ego_behind_b",
        ),
        (ACCIDENT.replace("ego_behind other_behind", "ego"), ":2: expected two of .*, found 'ego'"),
        (ACCIDENT.replace("1212", "twelve"), ":3: agent's id: expected an integer, found 'twelve'"),
        (ACCIDENT.replace(" 1212", ""), ":3: expected four agents' ids, found '1223 1236 1237'"),
        (
            ACCIDENT.replace("road_type:", "road_type"),
            ":4: expected '<key>: <value>', found 'road_type four-way",
        ),
        ("", ":1: expected '<weather.*found an empty file"),
        (" \n\n", ":1: expected '<weather.*found an empty file"),
    ],
)
def test_faults_name_file_line_and_remedy(write, text: str, message: str) -> None:
    path = write(text)
    pattern = f"^{path}{message}.*{REMEDY}$"
    assert_raises(
        (lambda: read_meta(path), MetaError, pattern),
    )


def test_binary_garbage_and_a_missing_file(write, tmp_path: Path) -> None:
    path = write(b"\x80\x04\x95\xff\xfe" * 10)
    assert_raises(
        (lambda: read_meta(path), MetaError, f"^{path}: not a text file .*{REMEDY}$"),
        (
            lambda: read_meta(tmp_path / "gone.txt"),
            MissingFileError,
            r"gone\.txt: no such file; unpack",
        ),
    )


@pytest.mark.parametrize(
    ("meta", "text"),
    [(ACCIDENT_META, ACCIDENT), (QUIET_META, f"{NO_COLLISION}\n colliding agents: none none\n")],
)
def test_written_text_is_as_the_release_has_it(tmp_path: Path, meta: Meta, text: str) -> None:
    path = tmp_path / "meta.txt"
    write_meta(path, meta)
    assert path.read_text() == text.removesuffix("\n")


@pytest.mark.parametrize("names", ["other other_behind", "ego none"])
def test_a_normal_scenario_names_the_agents_that_should_have_collided(
    write, tmp_path: Path, names: str
) -> None:
    text = f"{NO_COLLISION}\n colliding agents: {names}"
    meta = read_meta(write(text))
    assert meta.collision is None
    assert meta.planned_agents == tuple(META_AGENTS[name] for name in names.split())

    path = tmp_path / "meta.txt"
    write_meta(path, meta)
    assert path.read_text() == text


@given(st.data())
def test_damage_raises_our_error_or_nothing(
    tmp_path_factory: pytest.TempPathFactory, outcome, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged_meta.txt"
    path.write_bytes(data.draw(mutations(ACCIDENT.encode())))

    _, message = outcome(MetaError, read_meta, path)

    if message is not None:
        assert message.startswith(f"{path}:")
        assert message.endswith(REMEDY)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("four-way junction", "x" * 200_000, None),
        (" agents id: ", " " + "x" * 200_000, r"expected '<key>: <value>', found 'x+ … "),
        (
            " agents id: ",
            f" agents id: {'7 ' * 100_000}",
            r"expected four agents' ids, found '7 7 ",
        ),
        (
            " agents id: ",
            f" agents id: {'7' * 5000}",
            r"agent's id: expected an integer, found '7+ … 7+1223'",
        ),
        (" agents id: ", " agents id: ٧", r"agent's id: expected an integer, found '٧"),
        (" agents id: ", " agents id: 1_0", r"agent's id: expected an integer, found '1_0"),
        (" agents id: ", f" agents id: {2**63}", r"agent's id: expected an integer, found '9223"),
    ],
)
def test_a_message_quotes_little(write, old: str, new: str, message: str | None) -> None:
    assert old in ACCIDENT
    path = write(ACCIDENT.replace(old, new))
    if message is None:
        assert read_meta(path).road_type == new
    else:
        with pytest.raises(MetaError, match=message):
            read_meta(path)
