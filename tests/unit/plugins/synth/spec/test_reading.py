import os

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.spec import parse_spec, read_spec

FIELDS = "name, design, road, view, exchange, actors, meet, background, weather, time_of_day"


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        (
            "turn: lef",
            (
                r"f.yaml:4: actors\[1\].turn: expected one of straight, left, right, "
                r"found 'lef'; did you mean 'left'\?$"
            ),
        ),
        ("turn: back", r"actors\[1\].turn: expected one of straight, left, right, found 'back'$"),
        (
            "trun: left",
            (
                r"f.yaml:4: actors\[1\].trun: no such field; possible: role, .*; "
                r"did you mean 'turn'\?$"
            ),
        ),
        (
            "colour: red",
            r"f.yaml:4: actors\[1\].colour: no such field; possible: role, category, from, ",
        ),
        (
            "max_speed: fast",
            r"actors\[1\].max_speed: expected a number, 0.5 to 20 m/s, found 'fast'",
        ),
        ("max_speed: true", "expected a number, 0.5 to 20 m/s, found True"),
        ("max_speed: .nan", "expected a number, 0.5 to 20 m/s, found nan"),
        ("max_speed: 20.1", "expected a number, 0.5 to 20 m/s, found 20.1"),
        ("max_speed: [1, 2, 3]", r"expected a number, .*, or \[low, high\], found \[1, 2, 3\]"),
        ("max_speed: [5, 40]", r"max_speed\[1\]: expected a number, 0.5 to 20 m/s, found 40"),
        ("max_speed: [9, 3]", r"expected \[low, high\], found \[9, 3\]; swap the two"),
        (
            "max_speed: '8'",
            (
                "expected a number, 0.5 to 20 m/s, found '8'; write a decimal "
                "number, without quotes and"
            ),
        ),
        ("max_speed: 100", "found 100$"),
        ("start_distance: 130", "expected a number, 0 to 120 m, found 130$"),
        ("max_speed: 1e1", "found '1e1'; write a decimal number, without quotes and without e$"),
        (f"max_speed: {'9' * 400}", "expected a number, 0.5 to 20 m/s, found 9{79}…$"),
        (f"turn: {'x' * 5000}", "found 'x{78}…$"),
        ("lane: null", r"lane: expected a whole number, 0 to 1, found nothing"),
        ("lane: 0.5", "lane: expected a whole number, 0 to 1, found 0.5"),
        ("ignores: signal", r"ignores: expected a list, as \[signal, priority\], found 'signal'"),
        (
            "ignores: [signals]",
            (
                r"ignores\[0\]: expected one of signal, priority, found 'signals'; "
                r"did you mean 'signal'\?$"
            ),
        ),
        ("turn: []", r"turn: expected one of straight, left, right, found \[\]"),
        ("turn: [left, [right]]", r"turn\[1\]: expected one of .*, found \['right'\]"),
        ("turn: {left: 1}", "turn: expected one of .*, found the keys left"),
    ],
)
def test_a_wrong_value_is_refused_with_line_and_field(with_other, entries, sentence):
    assert_raises(
        (lambda: parse_spec(with_other(entries), "f.yaml"), ConfigError, sentence),
    )


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        (
            "actor: []",
            rf"f.yaml:7: actor: no such field; possible: {FIELDS}.*; did you mean 'actors'\?$",
        ),
        ("design: 13", "design: expected a whole number, 1 to 12, found 13"),
        ("exchange: [true, false]", "exchange: expected true or false, one value, not several"),
        ("background: none", "f.yaml:7: background: expected keys and values, found 'none'"),
        (
            f"road: {{hump: {{height: {'9' * 400}}}}}",
            "road.hump.height: expected a number, found 9",
        ),
        (
            "exchange: 'true'",
            "exchange: expected true or false, found 'true'; remove the quotes",
        ),
        ("view: 3", "view: expected one of open, hidden, found 3"),
        ("road: {signalized: 1}", "road.signalized: expected true or false, found 1"),
    ],
)
def test_a_wrong_line_is_refused(small, line, sentence):
    assert_raises(
        (lambda: parse_spec(f"{small}\n{line}", "f.yaml"), ConfigError, sentence),
    )


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[1, 2]", r"scenario:1: the file: expected keys and values, found \[1, 2\]"),
        ("name: 3\nactors: []", "scenario:1: name: expected a text, found 3; put it in quotes"),
        ("name: no\nactors: []", "name: expected a text, found False; put it in quotes"),
        ("name: x", "scenario:1: actors: is missing; add it"),
        ("actors: {}", "actors: expected a list, found nothing"),
        ("actors: [{from: west}]", r"actors\[0\].role: is missing; add it"),
    ],
)
def test_a_file_that_is_no_scenario_is_refused(text, sentence):
    assert_raises(
        (lambda: parse_spec(text), ConfigError, sentence),
    )


def test_a_file_is_read_in_utf8_and_named_in_its_errors(tmp_path, small):
    path = tmp_path / "mein.yaml"
    path.write_text(small.replace("small", "Straße"), encoding="utf-8")
    assert read_spec(path).name == "Straße"

    path.write_text(small + "\nview: x", encoding="utf-8")
    assert_raises(
        (lambda: read_spec(path), ConfigError, r"mein.yaml:7: view: expected one of open, hidden")
    )

    path.write_bytes(b"\xff")
    assert_raises(
        (
            lambda: read_spec(path),
            ConfigError,
            r"mein.yaml: cannot be read .*; give a YAML file in UTF-8",
        ),
        (
            lambda: read_spec(tmp_path / "other.yaml"),
            ConfigError,
            r"other.yaml: no such file; give the path of a scenario file",
        ),
    )


def test_what_is_no_regular_file_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    with (tmp_path / "giant.yaml").open("wb") as file:
        file.truncate(3 << 30)

    for name, words in {
        "pipe": "a named pipe",
        "loop": "symbolic links",
        "giant": "has 3,221,225,472 bytes",
    }.items():
        with pytest.raises(ConfigError, match=rf"{name}.yaml: .*{words}"):
            read_spec(tmp_path / f"{name}.yaml")


@pytest.mark.parametrize(
    "text", ["x" * 190_000 + ": 1", "actors: {" + "y" * 190_000 + ": 1}", "name: *" + "z" * 190_000]
)
def test_long_words_are_cut_in_messages(tmp_path, text):
    path = tmp_path / "long.yaml"
    path.write_text(text, encoding="utf-8")

    with pytest.raises(ConfigError, match=r"long.yaml:1: ") as raised:
        read_spec(path)

    assert len(str(raised.value)) < 1000


def test_what_is_too_large_for_a_scenario_is_not_parsed(tmp_path, small):
    path = tmp_path / "big.yaml"
    path.write_text(small + "# comment\n" * 20_000, encoding="utf-8")
    assert_raises(
        (
            lambda: read_spec(path),
            ConfigError,
            r"big.yaml: has more than 200000 characters; give a scenario file",
        )
    )
