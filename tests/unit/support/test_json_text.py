"""JSON of strangers is parsed strictly and to a bounded depth, and errors are short."""

import json
from typing import Annotated, Any

import msgspec
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.support.json_text import MAX_LEVELS, parsed_json, parsed_record


@pytest.mark.parametrize(
    "value", [None, 1, "a", [], {}, {"a": [1.5, {"b": '[[[\\"{'}], "[": "\\"}, '\\"' * 3, "é😀"]
)
def test_json_is_read(value: Any) -> None:
    ascii_text = json.dumps(value)
    indented_text = json.dumps(value, ensure_ascii=False, indent=1)
    assert parsed_json(ascii_text.encode()) == value
    assert parsed_json(indented_text.encode()) == value


@pytest.mark.parametrize(
    "text", ["[" * 100, '"' + "{" * 100, "\\" * 99 + '"' + "[" * 100, "]" * 100]
)
def test_brackets_in_texts_are_no_levels(text: str) -> None:
    assert parsed_json(json.dumps({"a": text}).encode()) == {"a": text}
    nested = b'["\\\\", "\\"", ' + b"[" * MAX_LEVELS + b"]" * (MAX_LEVELS + 1)
    assert_raises(
        (
            lambda: parsed_json(nested),
            ValueError,
            (f"is nested more than {MAX_LEVELS} levels deep",),
        )
    )


@pytest.mark.parametrize("num_spaces", [0, 3 << 20])
def test_levels_are_counted_across_blocks(num_spaces: int) -> None:
    """The text is read in blocks, one after another."""
    deepest = b"[" + b" " * num_spaces + b"[" * (MAX_LEVELS - 1) + b"]" * MAX_LEVELS
    assert parsed_json(deepest)
    assert_raises(
        (lambda: parsed_json(b"[" + deepest + b"]"), ValueError, "nested more than"),
        (lambda: parsed_json(b'{"a":' * 1_000_000), ValueError, "nested more than"),
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"is not JSON \(line 1, column 1\)"),
        (b'{"a"', r"is not JSON \(line 1, column 5\)"),
        (b"[1,\n x", r"is not JSON \(line 2, column 2\)"),
        (b"\x1f\x8b", "is compressed with gzip"),
        (b"\x80\x04", "is a pickle"),
        (b"PK\x03\x04", "is a zip or npz archive"),
        (b'"\xff"', r"is not JSON \(not UTF-8, or a number with thousands of digits\)"),
        (b'{"a": [{"b": 1, "b": 2}]}', "a: entry 0: b: appears twice"),
        (b'{"a": {"b": NaN, "b": 1}, "a": 2}', "^a: appears twice$"),
        (b'{"a": NaN}', "a: expected a finite number, found NaN"),
        (b"[-Infinity]", "entry 0: expected a finite number, found Infinity"),
        (
            b'["\\ud800"]',
            r"entry 0: expected whole characters, found half of a surrogate pair: '\\ud800'",
        ),
        (b'{"\\udfff": 1}', "expected a name of whole characters"),
        (b'{"' + b"x" * 10_000 + b'": NaN}', "x … x"),
        (b'["' + b"y" * 10_000 + b'\\ud800"]', r"y \\u2026 y"),
        (b'{"' + b"z" * 10_000 + b'": 1, "' + b"z" * 10_000 + b'": 2}', "z … z"),
    ],
)
def test_text_that_is_no_json_is_refused_in_few_words(content: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parsed_json(content)


@pytest.mark.parametrize(
    "content", [b"9" * 5_000_000, b'"' * 5_000_000, b'{"a":[' * 20 + b"1," * 2_000_000]
)
def test_long_texts_are_refused_quickly(content: bytes) -> None:
    """A parser that takes more than linear time would need hours."""
    assert_raises((lambda: parsed_json(content), ValueError, ("is not JSON",)))


class Record(msgspec.Struct):
    sizes: list[Annotated[float, msgspec.Meta(le=10)]]
    kind: str = "car"


def test_a_record_is_read() -> None:
    assert parsed_record(b'{"sizes": [1, 2.5], "other": 3}', Record) == Record(sizes=[1.0, 2.5])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"sizes": [1, "2"]}', r"^expected `float`, got `str` - at `\$\.sizes\[1\]`$"),
        (b'{"sizes": [1, 11]}', r"^expected `float` <= 10\.0 - at `\$\.sizes\[1\]`$"),
        (b'{"sizes": [1e999]}', r"<= 10\.0 - at `\$\.sizes\[0\]`$"),
        (b"{}", "^object missing required field `sizes`$"),
        (b"3", "^expected `object`, got `int`$"),
        (b'{"sizes": [], "sizes": []}', "^sizes: appears twice$"),
        (b'{"sizes": [NaN]}', "expected a finite number, found NaN"),
        (b'{"sizes": ' + b"[" * 100_000, "is nested more than"),
    ],
)
def test_a_record_with_wrong_fields_is_refused(content: bytes, message: str) -> None:
    assert_raises((lambda: parsed_record(content, Record), ValueError, message))
