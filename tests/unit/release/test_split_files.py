import os
from pathlib import Path

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import MissingFileError, SplitFileError
from deepaccident_devkit.release import read_split_file, write_split_file

NAME = "Town03_type001_subtype0001_scenario00024"
LINE = f"type1_subtype1_accident {NAME}"
TOKEN = f"type1_subtype1_accident/{NAME}"
TWIN_LINE = f"type1_subtype1_normal {NAME}"
TWIN_TOKEN = f"type1_subtype1_normal/{NAME}"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "train.txt"


@pytest.mark.parametrize(
    "text",
    [
        f"{LINE}\n{TWIN_LINE}\n",
        f"{LINE}\n{TWIN_LINE}",
        f"{LINE}\r\n{TWIN_LINE}\r\n",
        f"\n type1_subtype1_accident  {NAME} \n\ntype1_subtype1_normal\t{NAME}  \n \n",
        f"{LINE}\n{TWIN_LINE}\n{LINE}\n",
        f"\ufeff{LINE}\n{TWIN_LINE}\n",
    ],
    ids=["plain", "no-final-newline", "crlf", "blanks", "repeated", "mark"],
)
def test_tokens_in_the_files_order_each_once(path: Path, text: str) -> None:
    path.write_bytes(text.encode())
    assert read_split_file(path) == [TOKEN, TWIN_TOKEN]


@pytest.mark.parametrize("count", [0, 2])
def test_raw_keeps_repeated_lines_and_an_empty_file_names_no_scenario(
    path: Path, count: int
) -> None:
    path.write_text(f"{LINE}\n\n" * count + "\n \n")
    assert read_split_file(path, raw=True) == [TOKEN] * count
    assert read_split_file(path) == [TOKEN] * min(count, 1)


@pytest.mark.parametrize("line", [NAME, f"{LINE} 3"])
@pytest.mark.parametrize("raw", [False, True])
def test_a_malformed_line_is_named_by_its_number_in_the_file(
    path: Path, line: str, raw: bool
) -> None:
    path.write_text(f"{LINE}\n\n{line}\n")
    message = (
        rf"^{path}:3: expected '<scenario_type> <scenario>', found '{line}'; "
        rf"correct or remove the line$"
    )
    assert_raises((lambda: read_split_file(path, raw=raw), SplitFileError, message))


def test_binary_garbage_and_a_missing_file(path: Path) -> None:
    binary = path.with_name("binary.txt")
    binary.write_bytes(b"\xff\xfe\x00\x80")
    assert_raises(
        (lambda: read_split_file(path), MissingFileError, r"train\.txt: no such file"),
        (
            lambda: read_split_file(binary),
            SplitFileError,
            ("binary.txt: not a text file", "restore it from the release"),
        ),
    )


def test_a_name_that_is_no_utf8_hides_no_other(path: Path) -> None:
    path.write_bytes(f"{LINE}\n".encode() + b"type1_subtype1_accident \xff\xfe\n")
    odd_name = os.fsdecode(b"\xff\xfe")
    assert read_split_file(path) == [TOKEN, f"type1_subtype1_accident/{odd_name}"]


@pytest.mark.parametrize(
    ("tokens", "text"),
    [([TOKEN, TWIN_TOKEN], f"{LINE}\n{TWIN_LINE}\n"), ([], "")],
)
def test_written_text(path: Path, tokens: list[str], text: str) -> None:
    write_split_file(path, tokens)
    assert path.read_text() == text


@pytest.mark.parametrize("raw", [False, True])
def test_unique_names_both_lines(path: Path, raw: bool) -> None:
    path.write_text(f"{LINE}\n\n{TWIN_LINE}\ntype1_subtype1_accident  {NAME}\n")
    words = ("train.txt:4: ", f"'{LINE}' is already in line 1", "remove one")
    assert_raises(
        (lambda: read_split_file(path, raw=raw, unique=True), SplitFileError, words),
    )

    path.write_text(f"{LINE}\n{TWIN_LINE}\n")
    assert read_split_file(path, raw=raw, unique=True) == [TOKEN, TWIN_TOKEN]
