"""Label files that are no label files any more."""

from collections.abc import Callable

import numpy as np

from fault_injection.kinds import Apply, Group, cut, emptied, garbage, in_file
from fault_injection.place import FIELD

GROUP = Group("label, form")
_NUMBERS = ("x", "y", "z", "l", "w", "h", "yaw")


def _in_line(edit: Callable[[list[str], np.random.Generator], object]) -> Apply:
    """Edit the words of a box line of a label."""
    return lambda place, rng: place.edit_any_row(rng, lambda row: edit(row, rng))


def _set(names: tuple[str, ...], word: str) -> Apply:
    """Replace one of these fields."""
    return _in_line(lambda row, rng: row.__setitem__(FIELD[str(rng.choice(names))], word))


def _cut_after_lines(letters: int) -> Apply:
    def change(content: bytes, rng: np.random.Generator) -> bytes:
        lines = content.splitlines(keepends=True)
        whole = int(rng.integers(2, len(lines) // 2))
        return b"".join(lines[:whole]) + lines[whole][:letters]

    return in_file("label", change)


def _garble(row: list[str], rng: np.random.Generator) -> None:
    row[FIELD[str(rng.choice(_NUMBERS))]] += ".5"


def _half_zeros(content: bytes, _: np.random.Generator) -> bytes:
    return content[: len(content) // 2] + bytes(len(content) - len(content) // 2)


GROUP.add(
    {
        "label_cut": ("A label file ends at a random byte.", in_file("label", cut)),
        "label_cut_between_lines": (
            "A label file ends after one of the box lines; the remaining lines are sound.",
            _cut_after_lines(letters=0),
        ),
        "label_cut_in_a_class": (
            "A label file ends within a line's first word; readers skip lines of one word.",
            _cut_after_lines(letters=2),
        ),
        "label_emptied": ("A label file is empty.", in_file("label", emptied)),
        "label_garbage": ("A label file holds random bytes.", in_file("label", garbage)),
        "label_zeros": (
            "A label file's second half is zero bytes, as after a write to a full disk.",
            in_file("label", _half_zeros),
        ),
        "label_field_dropped": (
            "A line lacks a field.",
            _in_line(lambda row, rng: row.pop(int(rng.integers(len(row))))),
        ),
        "label_field_added": (
            "A line has one field too many.",
            _in_line(lambda row, rng: row.insert(int(rng.integers(1, len(row))), "0.5")),
        ),
        "label_nan": ("A position, size or yaw is NaN.", _set(_NUMBERS, "nan")),
        "label_infinite": (
            "A position is infinite.",
            lambda place, rng: _set(_NUMBERS[:3], str(rng.choice(["inf", "-inf"])))(place, rng),
        ),
        "label_number_garbled": ("A number has a second decimal point.", _in_line(_garble)),
        "label_class_unknown": (
            "A line names a class that does not exist.",
            _in_line(lambda row, rng: row.__setitem__(0, str(rng.choice(["bus", "Car", "0"])))),
        ),
        "label_header_removed": (
            "A label file lacks its first line.",
            in_file("label", lambda content, _: content.split(b"\n", 1)[1]),
        ),
    },
)
