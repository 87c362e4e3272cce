import os
from pathlib import Path

import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import MissingFileError, SplitFileError
from deepaccident_devkit.release import read_split_file, write_split_file

TYPE, NAME = "type1_subtype1_accident", "Town03_type001_subtype0001_scenario00024"
TWIN = "type1_subtype1_normal"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "train.txt"


@pytest.mark.parametrize(
    "text",
    [
        f"{TYPE} {NAME}\n{TWIN} {NAME}\n",
        f"{TYPE} {NAME}\n{TWIN} {NAME}",
        f"{TYPE} {NAME}\r\n{TWIN} {NAME}\r\n",
        f"\n {TYPE}  {NAME} \n\n{TWIN}\t{NAME}  \n \n",
        f"{TYPE} {NAME}\n{TWIN} {NAME}\n{TYPE} {NAME}\n",
        f"\ufeff{TYPE} {NAME}\n{TWIN} {NAME}\n",
    ],
    ids=["plain", "no-final-newline", "crlf", "blanks", "repeated", "mark"],
)
def test_tokens_in_the_files_order_each_once(path: Path, text: str) -> None:
    path.write_bytes(text.encode())
    assert read_split_file(path) == [f"{TYPE}/{NAME}", f"{TWIN}/{NAME}"]


@pytest.mark.parametrize("count", [0, 2])
def test_raw_keeps_repeated_lines_and_an_empty_file_names_no_scenario(
    path: Path, count: int
) -> None:
    path.write_text(f"{TYPE} {NAME}\n\n" * count + "\n \n")
    assert read_split_file(path, raw=True) == [f"{TYPE}/{NAME}"] * count
    assert read_split_file(path) == [f"{TYPE}/{NAME}"] * min(count, 1)


@pytest.mark.parametrize("line", [NAME, f"{TYPE} {NAME} 3"])
@pytest.mark.parametrize("raw", [False, True])
def test_a_malformed_line_is_named_by_its_number_in_the_file(
    path: Path, line: str, raw: bool
) -> None:
    path.write_text(f"{TYPE} {NAME}\n\n{line}\n")
    message = (
        rf"^{path}:3: expected '<scenario_type> <scenario>', found '{line}'; "
        rf"mend or remove the line$"
    )
    assert_refused((lambda: read_split_file(path, raw=raw), SplitFileError, message))


def test_binary_garbage_and_a_missing_file(path: Path) -> None:
    binary = path.with_name("binary.txt")
    binary.write_bytes(b"\xff\xfe\x00\x80")
    assert_refused(
        (lambda: read_split_file(path), MissingFileError, r"train\.txt: no such file"),
        (
            lambda: read_split_file(binary),
            SplitFileError,
            ("binary.txt: not a text file", "restore it from the release"),
        ),
    )


def test_a_name_that_is_no_utf8_hides_no_other(path: Path) -> None:
    path.write_bytes(f"{TYPE} {NAME}\n".encode() + b"type1_subtype1_accident \xff\xfe\n")
    assert read_split_file(path) == [
        f"{TYPE}/{NAME}",
        f"type1_subtype1_accident/{os.fsdecode(bytes([255, 254]))}",
    ]


@pytest.mark.parametrize(
    ("tokens", "text"),
    [([f"{TYPE}/{NAME}", f"{TWIN}/{NAME}"], f"{TYPE} {NAME}\n{TWIN} {NAME}\n"), ([], "")],
)
def test_written_text(path: Path, tokens: list[str], text: str) -> None:
    write_split_file(path, tokens)
    assert path.read_text() == text


@pytest.mark.parametrize("raw", [False, True])
def test_unique_names_both_lines(path: Path, raw: bool) -> None:
    path.write_text(f"{TYPE} {NAME}\n\n{TWIN} {NAME}\n{TYPE}  {NAME}\n")
    named = ("train.txt:4: ", f"'{TYPE} {NAME}' stands in line 1 already", "remove one")
    assert_refused((lambda: read_split_file(path, raw=raw, unique=True), SplitFileError, named))
    path.write_text(f"{TYPE} {NAME}\n{TWIN} {NAME}\n")
    assert read_split_file(path, raw=raw, unique=True) == [f"{TYPE}/{NAME}", f"{TWIN}/{NAME}"]
