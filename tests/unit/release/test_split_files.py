from pathlib import Path

import pytest

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


def test_raw_keeps_repeated_lines(path: Path) -> None:
    path.write_text(f"{TYPE} {NAME}\n\n{TYPE} {NAME}\n")
    assert read_split_file(path, raw=True) == [f"{TYPE}/{NAME}"] * 2


def test_an_empty_file_names_no_scenario(path: Path) -> None:
    path.write_text("\n \n")
    assert read_split_file(path) == read_split_file(path, raw=True) == []


@pytest.mark.parametrize("line", [NAME, f"{TYPE} {NAME} 3"])
@pytest.mark.parametrize("raw", [False, True])
def test_a_malformed_line_is_named_by_its_number_in_the_file(path: Path, line: str, raw: bool) -> None:
    path.write_text(f"{TYPE} {NAME}\n\n{line}\n")
    message = rf"^{path}:3: expected '<scenario_type> <scenario>', found '{line}'; mend or remove the line$"
    with pytest.raises(SplitFileError, match=message):
        read_split_file(path, raw=raw)


def test_binary_garbage_and_a_missing_file(path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"train\.txt: no such file"):
        read_split_file(path)
    path.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(SplitFileError, match=r"train\.txt: not a text file .*; restore it from the release"):
        read_split_file(path)


def test_written_text(path: Path) -> None:
    write_split_file(path, [f"{TYPE}/{NAME}", f"{TWIN}/{NAME}"])
    assert path.read_text() == f"{TYPE} {NAME}\n{TWIN} {NAME}\n"
    write_split_file(path, [])
    assert path.read_bytes() == b""


def test_unique_names_both_lines(path: Path) -> None:
    path.write_text(f"{TYPE} {NAME}\n\n{TWIN} {NAME}\n{TYPE}  {NAME}\n")
    for raw in (False, True):
        with pytest.raises(
            SplitFileError, match=rf"train\.txt:4: '{TYPE} {NAME}' stands in line 1 already; remove one"
        ):
            read_split_file(path, raw=raw, unique=True)
    path.write_text(f"{TYPE} {NAME}\n{TWIN} {NAME}\n")
    assert read_split_file(path, unique=True) == [f"{TYPE}/{NAME}", f"{TWIN}/{NAME}"]


def test_a_message_quotes_little(path: Path) -> None:
    path.write_text("word " * 100_000)
    with pytest.raises(SplitFileError, match=r":1: expected '<scenario_type> <scenario>', found 'word word") as raised:
        read_split_file(path)
    assert len(str(raised.value)) < len(str(path)) + 250
