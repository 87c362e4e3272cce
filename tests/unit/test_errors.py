"""The devkit's errors: their messages are short, fit for a terminal, and the same on the far side
of a process.
"""

import io
import pickle
from collections.abc import Callable
from importlib import import_module

import pytest

from deepaccident_devkit import errors
from deepaccident_devkit.errors import (
    MOST_SAID,
    ArgumentError,
    BrokenReleaseError,
    DeepAccidentError,
    FileError,
    SomeFailedError,
    UnavailableError,
)

KINDS = [
    each
    for each in vars(errors).values()
    if isinstance(each, type) and issubclass(each, DeepAccidentError)
]
HOSTILE = "a.txt: \x1b[2J\x07\r\x9b\x7f\u202eevil\u2066\ud800\udcff, expected a number"


def dumped_by_dask(error: object) -> bytes:
    """As tblib, which dask brings, pickles exceptions."""
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer)
    pickler.dispatch_table = {type(error): import_module("tblib.pickling_support").pickle_exception}
    pickler.dump(error)
    return buffer.getvalue()


@pytest.mark.parametrize("kind", KINDS)
def test_a_message_is_bounded_and_moves_no_cursor(kind: type[DeepAccidentError]) -> None:
    escaped = (
        r"a.txt: \u001b[2J\u0007\u000d\u009b\u007f\u202eevil\u2066\ud800\udcff, expected a number"
    )
    for given, shown in (
        (HOSTILE, escaped),
        *((each, each) for each in ("one\ntwo\tthree é 車 😀", "")),
    ):
        assert str(kind(given)) == shown
    for middle in ("x" * 5_000_000, "\x1b" * 100_000):
        long = str(kind(f"file.json: found {middle}; restore it"))
        assert (len(long) <= MOST_SAID, long[:16], long[-11:]) == (
            True,
            "file.json: found",
            " restore it",
        )
    assert str(kind()) == ""


@pytest.mark.parametrize("kind", KINDS[1:])
def test_every_error_is_of_one_of_three_kinds(kind: type[DeepAccidentError]) -> None:
    assert [issubclass(kind, one) for one in (ArgumentError, FileError, UnavailableError)].count(
        True
    ) == 1


@pytest.mark.parametrize("dumps", [pickle.dumps, dumped_by_dask])
@pytest.mark.parametrize("kind", KINDS)
def test_a_message_survives_pickling(
    kind: type[DeepAccidentError], dumps: Callable[[object], bytes]
) -> None:
    error = kind(HOSTILE + "x" * 9_000)
    again = pickle.loads(dumps(error))
    assert (type(again), str(again), again.args) == (kind, str(error), (str(error),))


@pytest.mark.parametrize("kind", [BrokenReleaseError, SomeFailedError])
def test_a_list_is_whole_and_each_of_its_lines_is_bounded(kind: type[DeepAccidentError]) -> None:
    lines = [f"scenario {number}: {'x' * 40}" for number in range(700)]
    assert str(kind("\n".join(lines))) == "\n".join(lines)
    assert [len(line) <= MOST_SAID for line in str(kind(f"a\n{'x' * 9_000}\nb")).split("\n")] == [
        True
    ] * 3
