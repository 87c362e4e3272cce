import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.spec.reading import parse_yaml


def test_every_value_knows_the_line_of_its_key_or_item():
    root = parse_yaml("a: 1\nb:\n  c: [x,\n    2.5]\n", "f.yaml")
    assert root.value["a"].where == "f.yaml:1"
    assert root.value["b"].where == "f.yaml:2"

    inner = root.value["b"].value["c"]

    assert [(item.value, item.where) for item in inner.value] == [
        ("x", "f.yaml:3"),
        (2.5, "f.yaml:4"),
    ]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "f.yaml: is empty; write at least the actors"),
        ("# nothing\n", "f.yaml: is empty"),
        (
            "a: 1\nb: [x\nc: 2",
            (
                r"f.yaml:3: is not valid YAML: .*; check .* indentation \(no tabs\) of that line, "
                r"or line 2, where the faulty part begins"
            ),
        ),
        (
            "a: 1\n\tb: 2",
            r"f.yaml:2: is not valid YAML: .*; check .* indentation \(no tabs\) of that line",
        ),
        ("a: 1\nb: c: 2", "f.yaml:2: is not valid YAML: mapping values are not allowed here"),
        ("--- 1\n--- 2", "f.yaml:2: is not valid YAML: but found another document"),
        (
            "a: &x 1\nb: [2, *x]",
            r"f.yaml:1: b\[1\]: aliases \(\*name\) are not supported; write the value out",
        ),
        ("a: &x [*x]", r"f.yaml:1: a\[0\]: aliases"),
        ("a: !!python/object/apply:os.getcwd []", "f.yaml:1: a: tags"),
        ("a: !!python/name:os.getcwd x", "f.yaml:1: a: tags"),
        ("a:\n  b: !!bool x", r"f.yaml:2: a.b: 'x' cannot be read"),
        ("a: !!timestamp x", "f.yaml:1: a: 'x' cannot be read"),
        (
            "a: 010",
            (
                "f.yaml:1: a: '010' is not a plain decimal number; write one, or put it "
                "in quotes if it is a word"
            ),
        ),
        ("a: 1:30", "f.yaml:1: a: '1:30' is not a plain decimal number"),
        ("a: 1" + ":59" * 300 + ".5", "f.yaml:1: a: '1:59:59.*cannot be read"),
        ("a: " + "1" * 5000, r"f.yaml:1: a: '1{40}' cannot be read"),
        ("a: 1_0", "f.yaml:1: a: '1_0' is not a plain decimal number"),
        ("a: 0x1F", "f.yaml:1: a: '0x1F' is not a plain decimal number"),
        (
            "a: 2020-13-40",
            r"f.yaml:1: a: '2020-13-40' cannot be read \(.*\); put it in quotes if it is a word",
        ),
        ("? [a]\n: 1", "f.yaml:1: expected a word as a key"),
        ("a: 1\na: 2", "f.yaml:2: a: appears twice; keep one of them"),
        (
            "\x00",
            (
                "f.yaml: is not valid YAML: unacceptable character #x0000: special characters are "
                "not allowed; save it again"
            ),
        ),
        ("- " * 5000, "f.yaml: is not valid YAML: maximum recursion depth exceeded"),
    ],
)
def test_what_is_no_plain_yaml_is_refused_with_its_line(text, sentence):
    assert_raises(
        (lambda: parse_yaml(text, "f.yaml"), ConfigError, sentence),
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("-0.5", -0.5),
        (".5", 0.5),
        ("5.", 5.0),
        ("1.5e+2", 150.0),
        ("+.inf", float("inf")),
        ("0", 0),
        ("0.0", 0.0),
    ],
)
def test_decimal_numbers_are_read(text, value):
    root = parse_yaml(f"a: {text}", "f.yaml")
    assert root.value["a"].value == value
