import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises
from support.strategies import mutations

from deepaccident_devkit.errors import LabelError, MissingFileError
from deepaccident_devkit.release import Labels, read_label, read_labels, write_label
from deepaccident_devkit.release.labels import read_lone_words
from deepaccident_devkit.support.reading import LIMITS_VARIABLE

# lines of real labels; docs/format.md, Label, says what each value is
HEADER = "0.0034441 -5.6166797"
PARKED = "car -38.698 -19.789 -0.882 4.181 1.994 1.381 -0.000518 0.0 0.0 20001 0 True"
OWN = "car -0.0026 -1.4e-05 -1.2216 4.674 1.812 1.442 0.0 0.00344 -5.6167 -100 1394 False"
WALKER = "pedestrian 21.8 -1.46 -0.84 0.375 0.375 1.86 2.19 0.0 0.0 -1 0 True"
CAR_BEHIND = (
    "car -13.459459497478285 -0.0037344838527602064 -1.2119891287962656 "
    "4.791779518127441 2.163450002670288 "
    "1.4876600503921509 0.00033209590742323136 -4.587319957896956 "
    "-0.016017722274652455 5481 197 True"
)
REAL = "\n".join([HEADER, PARKED, OWN, WALKER, CAR_BEHIND, ""])
REMEDY = "; restore the file from its archive, or leave the scenario out with on_error='skip'"


@pytest.fixture
def write(tmp_path: Path):
    def write_file(text: str | bytes, name: str = "label.txt") -> Path:
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write_file


def stack_numbers(labels: Labels) -> np.ndarray:
    columns = [labels.center, labels.size, labels.yaw, labels.velocity]
    return np.column_stack(columns)


def parse_numbers(text: str) -> np.ndarray:
    """Read the nine floating-point numbers of each box with Python's own parser."""
    rows = []
    for line in text.splitlines()[1:]:
        words = line.split()[1:10]
        rows.append([float(word) for word in words])
    return np.array(rows)


def test_the_real_lines_to_the_bit(write) -> None:
    labels = read_label(write(REAL), raw=True)
    assert labels.raw
    assert_array_equal(stack_numbers(labels), parse_numbers(REAL))
    assert labels.num_boxes.tolist() == [4]
    assert labels.agent_velocity.tolist() == [[0.0034441, -5.6166797]]
    assert labels.category.tolist() == [0, 0, 5, 0]
    assert labels.actor_id.tolist() == [20001, -100, -1, 5481]
    assert labels.num_lidar_pts.tolist() == [0, 1394, 0, 197]
    assert labels.camera_visible.tolist() == [True, False, True, True]


def test_right_handed_means_y_yaw_and_vy_change_their_signs(write) -> None:
    signs = [1, -1, 1, 1, 1, 1, -1, 1, -1]
    labels = read_label(write(REAL))
    assert not labels.raw
    assert_array_equal(labels.agent_velocity, [[0.0034441, 5.6166797]])
    assert_array_equal(stack_numbers(labels), parse_numbers(REAL) * signs)


@pytest.mark.parametrize("raw", [False, True])
def test_boxes_are_right_handed_whatever_raw_was(write, raw: bool) -> None:
    boxes = read_label(write(REAL), raw=raw).boxes()
    assert boxes.frame == "lidar"
    assert boxes.category_names == ["car", "car", "pedestrian", "car"]
    assert_array_equal(
        boxes.center[3], [-13.459459497478285, 0.0037344838527602064, -1.2119891287962656]
    )
    assert_array_equal(boxes.velocity[3], [-4.587319957896956, 0.016017722274652455, 0])
    assert_allclose(boxes.yaw, [0.000518, 0, -2.19, -0.00033209590742323136], atol=1e-15)
    assert_array_equal(boxes.row, [0, 1, 2, 3])
    assert_array_equal(boxes.actor_id, [20001, -100, -1, 5481])


@pytest.mark.parametrize(
    "text",
    [
        REAL.rstrip("\n"),
        REAL.replace("\n", "\r\n"),
        REAL.replace("\n", "\r"),
        REAL.replace("\n", "  \n"),
        REAL.replace("\n", " \r\n"),
        REAL.replace("\n", "\n\n"),
        "\n" + REAL,
        REAL.replace("\n", "\nhidden\n"),
        REAL + "car",
        REAL + "\n \n",
        REAL.replace(" ", "  "),
        REAL.replace(" ", "\t"),
        " " + REAL.replace("\n", "\n "),
    ],
    ids=[
        "no-final-newline",
        "crlf",
        "cr",
        "blanks",
        "blanks-crlf",
        "blank-lines",
        "blank-first",
        "one-token-lines",
        "cut-to-one-token",
        "blanks-at-end",
        "double-blanks",
        "tabs",
        "leading-blanks",
    ],
)
def test_tolerated_forms_read_as_the_clean_file(write, text: str) -> None:
    clean = read_label(write(REAL, "clean.txt"))
    path = write(text)

    single = read_label(path)
    # among others, where it spoils the fast way for its neighbours
    several = read_labels([write(HEADER, "empty.txt"), path, write(HEADER, "other.txt")])

    for labels in (single, several):
        assert_array_equal(stack_numbers(labels), stack_numbers(clean))
        assert_array_equal(labels.actor_id, clean.actor_id)
        assert_array_equal(labels.camera_visible, clean.camera_visible)
        assert labels.num_boxes.sum() == 4
    assert_array_equal(single.agent_velocity, clean.agent_velocity)


@pytest.mark.parametrize("text", [HEADER, HEADER + "\n", HEADER + "\r\n\r\n", HEADER + "\ncar\n"])
def test_a_label_of_only_line_one_is_valid(write, text: str) -> None:
    labels = read_label(write(text))
    assert len(labels) == 0
    assert len(labels.boxes()) == 0
    assert labels.num_boxes.tolist() == [0]
    assert_array_equal(labels.agent_velocity, [[0.0034441, 5.6166797]])


def test_several_files_keep_their_order_and_their_counts(write) -> None:
    paths = [
        write(REAL, "1"),
        write("1 2", "2"),
        write(f"3 4\n{WALKER}", "3"),
        write("5 6\n\n", "4"),
    ]

    labels = read_labels(paths)

    assert_array_equal(labels.num_boxes, [4, 0, 1, 0])
    assert_array_equal(labels.agent_velocity, [[0.0034441, 5.6166797], [1, -2], [3, -4], [5, -6]])
    assert_array_equal(labels.boxes().row, [0, 1, 2, 3, 0])

    empty = read_labels([])
    assert len(empty) == 0
    assert len(empty.num_boxes) == 0
    assert empty.agent_velocity.shape == (0, 2)
    assert len(empty.boxes()) == 0


def test_the_first_faulty_one_of_many_files_is_named(write) -> None:
    good = write(REAL, "good.txt")
    first = write("1 x", "first.txt")
    second = write("1 y", "second.txt")
    missing = good.with_name("gone.txt")
    paths = [good] * 300 + [first] + [good] * 2500 + [second] + [good] * 10
    assert_raises(
        (lambda: read_labels(paths), LabelError, rf"^{first}:1: 'x' is not a number"),
        (
            lambda: read_labels([*paths[:300], missing, *paths]),
            MissingFileError,
            r"gone\.txt",
        ),
    )


WORDS = st.one_of(
    st.floats(-1e9, 1e9).flatmap(
        lambda x: st.sampled_from([repr(x), f"{x:.17g}", f"{x:.25e}", f"{x:E}", f"{x:.3e}"])
    ),
    st.from_regex(r"-?[0-9]{1,25}(\.[0-9]{0,25})?([eE][+-]?[0-9]{1,2})?", fullmatch=True),
    st.from_regex(r"-?\.[0-9]{1,25}", fullmatch=True),
    st.floats(-2.3e-308, 2.3e-308).map(repr),
    # halfway between two doubles and just beside it; the ends of the range; zeros; blanks of other
    # kinds
    st.sampled_from(
        [
            "-0.0",
            "-0",
            "0e5",
            "5e-324",
            "2.4703282292062327208e-324",
            "2.2250738585072011e-308",
            "900719925.47409930",
            "900719925.4740992999999999999999",
            "1000000000",
            "00012.50",
            "0.1000000000000000055511151231257827021181583404541015625",
            "1e-23",
            "8.5e-22",
            "7.2057594037927933e-16",
        ]
    ),
).filter(lambda word: abs(float(word)) <= 1e9)


@settings(max_examples=20)
@given(st.lists(st.lists(WORDS, min_size=9, max_size=9), min_size=1, max_size=8))
def test_numbers_are_pythons_floats_to_the_bit(
    tmp_path_factory: pytest.TempPathFactory, rows: list
) -> None:
    path = tmp_path_factory.getbasetemp() / "numbers.txt"
    lines = [" ".join(["van", *row, "7", "0", "True"]) for row in rows]
    text = "\n".join(["0 0", *lines])
    path.write_text(text)

    numbers = stack_numbers(read_label(path, raw=True))

    assert_array_equal(numbers.view(np.int64), parse_numbers(text).view(np.int64))


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize(
    "word", ["nan", "NaN", "NAN", "-nan", "inf", "-inf", "Infinity", "1e999", "-1e300", "1e39"]
)
def test_a_velocity_that_is_no_number_is_unknown(write, word: str, raw: bool) -> None:
    sign_of_y = 1 if raw else -1
    for velocity, expected in (
        (f"{word} 2.5", [np.nan, 2.5 * sign_of_y]),
        (f"2.5 {word}", [2.5, np.nan]),
    ):
        line = PARKED.replace("0.0 0.0", velocity)
        labels = read_label(write(f"{HEADER}\n{line}"), raw=raw)
        assert_array_equal(labels.velocity, [expected])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            f"{HEADER}\n{PARKED}\n{WALKER[:30]}",
            r":3: expected 13 fields, found 5: 'pedestrian 21.8",
        ),
        (f"{HEADER}\n{PARKED[: -len(' True')]}\n", r":2: expected 13 fields, found 12: 'car -38"),
        (f"{HEADER}\n{PARKED} 1\n", r":2: expected 13 fields, found more than 13: 'car"),
        (
            f"{HEADER}\n\n{OWN}\nx\n{PARKED[:-2]}",
            r":5: camera_visible is 'Tr', expected True or False",
        ),
        (
            f"{HEADER}\n{PARKED.replace('True', 'true')}",
            r":2: camera_visible is 'true', expected True or False",
        ),
        (
            f"{HEADER}\n{PARKED.replace('-38.698', 'nan')}",
            r":2: x is 'nan', expected a finite number",
        ),
        (
            f"{HEADER}\n{PARKED.replace('-0.000518', 'inf')}",
            r":2: yaw is 'inf', expected a finite number",
        ),
        (
            f"{HEADER}\n{PARKED.replace('1.381', '-Infinity')}",
            r":2: h is '-Infinity', expected a finite number",
        ),
        (
            f"{HEADER}\n{PARKED.replace('-19.789', '1e400')}",
            r":2: y is '1e400', expected a finite number",
        ),
        (
            f"{HEADER}\n{PARKED.replace('-19.789', '-1e300')}",
            r":2: y is '-1e300', expected a finite number up to 1e",
        ),
        (
            f"{HEADER}\n{PARKED.replace('1.381', '1e39')}",
            r":2: h is '1e39', expected a finite number up to 1e",
        ),
        (f"{HEADER}\n{PARKED.replace('-0.882', 'low')}", r":2: z is 'low', expected a number"),
        (f"{HEADER}\n{PARKED.replace('-0.882', '1_0')}", r":2: z is '1_0', expected a number"),
        (f"{HEADER}\n{PARKED.replace('0.0 0.0', '0.0 ?')}", r":2: vy is '\?', expected a number"),
        (
            f"{HEADER}\n{OWN}\n{PARKED.replace('car', 'bus')}",
            r":3: class is 'bus', expected one of car, truck",
        ),
        (f"{HEADER}\n{PARKED.replace('car', 'Car')}", r":2: class is 'Car'"),
        (
            f"{HEADER}\n{PARKED.replace('car', chr(34) + 'car' + chr(34))}",
            r":2: class is '\"car\"'",
        ),
        (
            f"{HEADER}\n{PARKED.replace('20001', '20001.0')}",
            r":2: id is '20001.0', expected an integer",
        ),
        (
            f"{HEADER}\n{PARKED.replace('20001', '+20001')}",
            r":2: id is '\+20001', expected an integer",
        ),
        (f"{HEADER}\n{PARKED}\u00a0", r":2: camera_visible is 'True\\xa0', expected True or False"),
        (f"{HEADER}\n{PARKED.replace('20001', '0x10')}", r":2: id is '0x10', expected an integer"),
        (
            f"{HEADER}\n{PARKED.replace('20001', str(2**63))}",
            r":2: id is '9223372036854775808', expected an integer",
        ),
        (
            f"{HEADER}\n{PARKED.replace(' 0 True', ' 0xA True')}",
            r":2: num_lidar_pts is '0xA', expected an integer",
        ),
        (
            f"{HEADER}\n{PARKED.replace(' 0 True', ' many True')}",
            r":2: num_lidar_pts is 'many', expected an integer",
        ),
        (PARKED, r":1: expected '<speed_x> <speed_y>', found 13 fields: 'car"),
        ("1 2 3\n", r":1: expected '<speed_x> <speed_y>', found 3 fields: '1 2 3'"),
        ("fast 2\n", r":1: 'fast' is not a number"),
        ("", r":1: expected '<speed_x> <speed_y>', found an empty file"),
        ("\n \n", r":1: expected '<speed_x> <speed_y>', found an empty file"),
        (f"{HEADER}\n{OWN}\npedestr" + "\0" * 50, ":3: contains zero bytes"),
        (f"{HEADER}\n{OWN}\n\0\0\n", ":3: contains zero bytes"),
        (f"\0{HEADER}\n{OWN}", ":1: contains zero bytes"),
    ],
)
def test_faults_name_file_line_and_remedy(write, text: str, message: str) -> None:
    good = write(REAL, "good.txt")
    bad = write(text, "bad.txt")
    pattern = rf"^{bad}{message}.*{REMEDY}$"
    assert_raises(
        (lambda: read_labels([bad]), LabelError, pattern),
        (lambda: read_labels([good, bad, good]), LabelError, pattern),
    )


@pytest.mark.parametrize(
    "content",
    [
        bytes(range(256)) * 4,
        b"\x80\x04\x95" + bytes(50),
        b"PK\x03\x04 \xff\xfe" * 20,
        HEADER.encode() + b"\n\xff\xfe x",
    ],
)
def test_binary_garbage_is_a_label_error(write, content: bytes) -> None:
    assert_raises(
        (lambda: read_label(write(content)), LabelError, r"label\.txt:\d+: .*restore the file")
    )


@pytest.mark.parametrize("marks", [1, 2])
@pytest.mark.parametrize("position", [0, len(HEADER) + 1])
def test_a_byte_order_mark_means_the_same_in_one_file_and_among_others(
    write, outcome, position: int, marks: int
) -> None:
    """Arrow drops a mark at the start of its input, which is only the first file's."""
    content = f"{HEADER}\n{PARKED}\n".encode()
    mark = b"\xef\xbb\xbf" * marks
    path = write(content[:position] + mark + content[position:], "marked.txt")

    single, single_message = outcome(LabelError, read_labels, [path])
    several, several_message = outcome(LabelError, read_labels, [write(REAL), path])

    assert single_message == several_message
    if single is None:
        assert several is None
    else:
        assert single.actor_id[-1] == several.actor_id[-1]


@pytest.mark.parametrize("raw", [False, True])
def test_written_text_is_as_the_release_has_it(write, tmp_path: Path, raw: bool) -> None:
    out = tmp_path / "new folder" / "out.txt"
    write_label(out, read_label(write(REAL), raw=raw))
    assert out.read_text() == REAL.removesuffix("\n")


@given(st.data())
def test_damage_raises_our_error_or_nothing(
    tmp_path_factory: pytest.TempPathFactory, outcome, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.txt"
    path.write_bytes(data.draw(mutations(REAL.encode())))
    labels, message = outcome(LabelError, read_label, path)
    if message is None:
        assert np.isfinite(labels.center).all()
        assert labels.num_boxes.sum() == len(labels)
    else:
        assert message.startswith(f"{path}:")
        assert message.endswith(REMEDY)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 " * 100_000, r":1: expected '<speed_x> <speed_y>', found more than 13 fields: '1 1 "),
        (f"{'9' * 5000}x 1", r":1: '9+ … 9+x' is not a number"),
        (f"{HEADER}\n" + "1 " * 100_000, r":2: expected 13 fields, found more than 13: '1 1 "),
        (
            f"{HEADER}\n{PARKED.replace('car', 'c' * 5000)}",
            r":2: class is 'c+ … c+', expected one of",
        ),
        (
            f"{HEADER}\n{PARKED.replace('-38.698', '9' * 5000)}",
            r":2: x is '9+ … 9+', expected a finite number",
        ),
        (
            f"{HEADER}\n{PARKED.replace('20001', '9' * 5000)}",
            r":2: id is '9+ … 9+', expected an integer",
        ),
        (
            f"{HEADER}\n{PARKED.replace('True', chr(27) + '[2J')}",
            r":2: camera_visible is '\\x1b\[2J', expected",
        ),
    ],
)
def test_a_message_quotes_little(write, text: str, message: str) -> None:
    path = write(text)
    with pytest.raises(LabelError, match=rf"^{path}{message}.*{REMEDY}$"):
        read_label(path)


@pytest.mark.parametrize("ends", ["\n", "\r"])
def test_a_file_of_too_many_lines_is_refused(
    write, monkeypatch: pytest.MonkeyPatch, ends: str
) -> None:
    path = write(HEADER + ends * 300_000)
    with pytest.raises(
        LabelError, match=r"has 300,00\d lines, more than 262,144; if the file is correct"
    ) as raised:
        read_label(path)

    _, _, remedy = str(raised.value).partition("set ")
    setting, _, _ = remedy.partition(";")
    monkeypatch.setenv(LIMITS_VARIABLE, setting.removeprefix(f"{LIMITS_VARIABLE}="))
    assert len(read_label(path)) == 0


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
@pytest.mark.parametrize("line", [2, 1000, 1001, 2500, 5001])
def test_the_first_fault_among_many_boxes_is_named(write, line: int, ends: str) -> None:
    lines = [HEADER, *[PARKED] * 4999, "van 1", "bus 2"]
    lines[line - 1] = "bus 1"
    path = write(ends.join(lines))
    assert_raises(
        (
            lambda: read_label(path),
            LabelError,
            rf"label\.txt:{line}: expected 13 fields, found 2: 'bus 1'",
        )
    )


READ = """
import sys
from pathlib import Path
from deepaccident_devkit.errors import LabelError
from deepaccident_devkit.release import read_label
for path in sys.argv[1:]:
    try:
        read_label(Path(path))
    except LabelError:
        print("refused")
"""


def test_lines_of_too_many_words_are_read_in_arrows_own_memory(write) -> None:
    """Arrow's reader of CSV, up to 19, writes beyond it (apache/arrow 45497)."""
    many_words = "1 " * 100_000
    paths = [
        write(many_words, "0.txt"),
        write(f"{HEADER}\n" + many_words, "1.txt"),
        write(f"{HEADER}\n" + f"{PARKED}\n" * 3000 + "1 " * 9000, "2.txt"),
    ]
    command = [sys.executable, "-c", READ, *map(str, paths)]
    environment = {**os.environ, "ARROW_DEBUG_MEMORY_POOL": "abort"}

    process = subprocess.run(command, env=environment, check=False, capture_output=True, text=True)

    assert process.returncode == 0
    assert process.stdout == "refused\n" * 3
    assert process.stderr == ""


@pytest.mark.parametrize(("end", "cut"), [("", True), (" ", True), ("\n", False)])
def test_lone_words_on_a_line_are_reported(write, end: str, cut: bool) -> None:
    assert read_lone_words(write(REAL)) == []

    path = write(f"one\n{HEADER}\n\n{PARKED}\n two \n{OWN}\ncar{end}")
    assert len(read_label(path)) == 2
    lone_words = read_lone_words(path)
    assert lone_words == [(1, "one", False), (5, "two", False), (7, "car", cut)]


def test_write_refuses_the_labels_of_several_files(write, tmp_path: Path) -> None:
    out = tmp_path / "out.txt"
    labels = read_labels([write(REAL), write(REAL)])
    assert_raises(
        (
            lambda: write_label(out, labels),
            LabelError,
            r"out\.txt: expected the labels of one file, found 2",
        )
    )
    assert not out.exists()
