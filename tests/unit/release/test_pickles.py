"""Check pickles for old readers: which names they ask for, and that their bytes follow only from
the values.
"""

import hashlib
import io
import pickle
import pickletools
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_equal

from deepaccident_devkit.release.pickles import load_arrays, pickled, pickled_items, write_joined

NUMBERS = {
    "turned": np.arange(6.0).reshape(2, 3).T,
    "none": np.zeros((0, 7)),
    "one": np.array(3),
    "n": -5,
    "x": 2.5,
}
WORDS = {"names": np.array(["car", "truck"]), "word": "Straße", "list": [1, None, True, 2**40]}
DIGEST = "c48e7659814dd927284843d627bbc18c8fa234c5e89cdc07bcd8c86c649fed3a"
"""SHA-256 of WORDS and NUMBERS, joined; numpy 1.26 and 2 give the same bytes."""


def join_pieces(*pieces: list[Any], **entries: Any) -> bytes:
    """Write a pickle of a dict: the pieces' joined items as `infos`, and more entries."""
    file = io.BytesIO()
    write_joined(file, "infos", map(pickled_items, pieces), entries)
    return file.getvalue()


@pytest.mark.parametrize(
    "content", [pickled({"infos": [WORDS, NUMBERS]}), join_pieces([WORDS, NUMBERS])]
)
def test_a_pickle_asks_for_the_names_of_numpy_1_in_an_old_protocol(content: bytes) -> None:
    names = set()
    for opcode, argument, _ in pickletools.genops(content):
        assert opcode.proto <= 3
        if opcode.name == "GLOBAL":
            names.add(argument)

    assert names == {"numpy.core.multiarray _reconstruct", "numpy ndarray", "numpy dtype"}
    pickletools.dis(content, out=io.StringIO())  # raises for a stack or a memo in disorder
    assert_equal(pickle.loads(content), {"infos": [WORDS, NUMBERS]})


def test_pieces_follow_each_other() -> None:
    content = join_pieces([NUMBERS, NUMBERS], [], [{"n": 1}], metadata={"version": "v1"})
    expected = {"infos": [NUMBERS, NUMBERS, {"n": 1}], "metadata": {"version": "v1"}}
    assert_equal(load_arrays(content), expected)
    assert load_arrays(join_pieces()) == {"infos": []}


def test_the_same_values_are_the_same_bytes() -> None:
    copies = {
        name: np.array(value) if isinstance(value, np.ndarray) else value
        for name, value in NUMBERS.items()
    }
    assert join_pieces([copies]) == join_pieces([NUMBERS])

    shared = np.eye(2)
    assert join_pieces([[shared, shared]]) == join_pieces([[np.eye(2), np.eye(2)]])

    content = join_pieces([WORDS, NUMBERS])
    assert hashlib.sha256(content).hexdigest() == DIGEST
