"""Pickles for old readers: which names they ask for, and that their bytes follow from the values
alone.
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
"""Of WORDS and NUMBERS, joined; numpy 1.26 and 2 give the same bytes."""


def joined(*pieces: list[Any], **beside: Any) -> bytes:
    file = io.BytesIO()
    write_joined(file, "infos", map(pickled_items, pieces), beside)
    return file.getvalue()


@pytest.mark.parametrize(
    "content", [pickled({"infos": [WORDS, NUMBERS]}), joined([WORDS, NUMBERS])]
)
def test_a_pickle_asks_for_the_names_of_numpy_1_in_an_old_protocol(content: bytes) -> None:
    found = list(pickletools.genops(content))
    names = {argument for opcode, argument, _ in found if opcode.name == "GLOBAL"}
    assert names == {"numpy.core.multiarray _reconstruct", "numpy ndarray", "numpy dtype"}
    assert max(opcode.proto for opcode, _, _ in found) <= 3
    pickletools.dis(content, out=io.StringIO())  # raises for a stack or a memo in disorder
    assert_equal(pickle.loads(content), {"infos": [WORDS, NUMBERS]})


def test_pieces_follow_each_other() -> None:
    content = joined([NUMBERS, NUMBERS], [], [{"n": 1}], metadata={"version": "v1"})
    assert_equal(
        load_arrays(content), {"infos": [NUMBERS, NUMBERS, {"n": 1}], "metadata": {"version": "v1"}}
    )
    assert load_arrays(joined()) == {"infos": []}


def test_the_same_values_are_the_same_bytes() -> None:
    again = {
        name: np.array(value) if isinstance(value, np.ndarray) else value
        for name, value in NUMBERS.items()
    }
    shared = np.eye(2)
    assert joined([again]) == joined([NUMBERS])
    assert joined([[shared, shared]]) == joined([[np.eye(2), np.eye(2)]])
    assert hashlib.sha256(joined([WORDS, NUMBERS])).hexdigest() == DIGEST
