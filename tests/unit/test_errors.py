"""The devkit's errors: their messages are short, fit for a terminal, and the same on the far side of a process."""

import pickle

import pytest

from deepaccident_devkit import errors
from deepaccident_devkit.errors import MOST_SAID, BrokenReleaseError, DeepAccidentError, SomeFailedError

KINDS = [each for each in vars(errors).values() if isinstance(each, type) and issubclass(each, DeepAccidentError)]
HOSTILE = "a.txt: \x1b[2J\x07\r\x9b\x7f\u202eevil\u2066\ud800\udcff, expected a number"


@pytest.mark.parametrize("kind", KINDS)
def test_a_message_is_bounded_and_moves_no_cursor(kind: type[DeepAccidentError]) -> None:
    hostile = str(kind(HOSTILE))
    assert hostile == r"a.txt: \u001b[2J\u0007\u000d\u009b\u007f\u202eevil\u2066\ud800\udcff, expected a number"
    assert str(kind("one\ntwo\tthree é 車 😀")) == "one\ntwo\tthree é 車 😀"
    for middle in ("x" * 5_000_000, "\x1b" * 100_000):
        long = str(kind(f"file.json: found {middle}; restore it"))
        assert len(long) <= MOST_SAID
        assert (long[:16], long[-11:]) == ("file.json: found", " restore it")
    assert str(kind()) == ""


@pytest.mark.parametrize("kind", KINDS)
def test_a_message_survives_pickling(kind: type[DeepAccidentError]) -> None:
    error = kind(HOSTILE + "x" * 9_000)
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), again.args) == (kind, str(error), (str(error),))


@pytest.mark.parametrize("kind", [BrokenReleaseError, SomeFailedError])
def test_a_list_is_whole_and_each_of_its_lines_is_bounded(kind: type[DeepAccidentError]) -> None:
    lines = [f"scenario {number}: {'x' * 40}" for number in range(700)]
    assert str(kind("\n".join(lines))) == "\n".join(lines)
    assert [len(line) <= MOST_SAID for line in str(kind(f"a\n{'x' * 9_000}\nb")).split("\n")] == [True] * 3
