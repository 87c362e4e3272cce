"""The messages of the devkit's errors are short, safe for a terminal, and survive pickling."""

import io
import pickle
from collections.abc import Callable
from importlib import import_module

import pytest

from deepaccident_devkit import errors
from deepaccident_devkit.errors import (
    MAX_MESSAGE_LENGTH,
    ArgumentError,
    BrokenReleaseError,
    DeepAccidentError,
    FileError,
    SomeFailedError,
    UnavailableError,
)

KINDS = [
    value
    for value in vars(errors).values()
    if isinstance(value, type) and issubclass(value, DeepAccidentError)
]
HOSTILE = "a.txt: \x1b[2J\x07\r\x9b\x7f\u202eevil\u2066\ud800\udcff, expected a number"


def pickle_like_dask(error: object) -> bytes:
    """Pickle an exception as tblib does, which dask brings."""
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
    assert str(kind(HOSTILE)) == escaped
    for text in ("one\ntwo\tthree é 車 😀", ""):
        assert str(kind(text)) == text
    for long_part in ("x" * 5_000_000, "\x1b" * 100_000):
        message = str(kind(f"file.json: found {long_part}; restore it"))
        assert len(message) <= MAX_MESSAGE_LENGTH
        assert message.startswith("file.json: found")
        assert message.endswith(" restore it")
    assert str(kind()) == ""


@pytest.mark.parametrize("kind", KINDS[1:])
def test_every_error_is_of_one_of_three_kinds(kind: type[DeepAccidentError]) -> None:
    bases = (ArgumentError, FileError, UnavailableError)
    assert sum(issubclass(kind, base) for base in bases) == 1


@pytest.mark.parametrize("dumps", [pickle.dumps, pickle_like_dask])
@pytest.mark.parametrize("kind", KINDS)
def test_a_message_survives_pickling(
    kind: type[DeepAccidentError], dumps: Callable[[object], bytes]
) -> None:
    error = kind(HOSTILE + "x" * 9_000)
    loaded = pickle.loads(dumps(error))
    assert (type(loaded), str(loaded), loaded.args) == (kind, str(error), (str(error),))


@pytest.mark.parametrize("kind", [BrokenReleaseError, SomeFailedError])
def test_a_list_is_whole_and_each_of_its_lines_is_bounded(kind: type[DeepAccidentError]) -> None:
    lines = [f"scenario {number}: {'x' * 40}" for number in range(700)]
    assert str(kind("\n".join(lines))) == "\n".join(lines)
    bounded_lines = str(kind(f"a\n{'x' * 9_000}\nb")).split("\n")
    assert len(bounded_lines) == 3
    assert max(map(len, bounded_lines)) <= MAX_MESSAGE_LENGTH
