"""Label files that break the format."""

from collections.abc import Callable

import numpy as np

from fault_injection.editor import FIELD
from fault_injection.kinds import Apply, Group, cut, edit_file, empty, garbage

GROUP = Group("label, form")
_NUMERIC_FIELDS = ("x", "y", "z", "l", "w", "h", "yaw")


def _edit_row(edit: Callable[[list[str], np.random.Generator], object]) -> Apply:
    """Edit the words of a box line of a label."""
    return lambda editor, rng: editor.edit_any_row(rng, lambda row: edit(row, rng))


def _set_field(names: tuple[str, ...], word: str) -> Apply:
    """Replace one of the fields by a word."""

    def edit(row: list[str], rng: np.random.Generator) -> None:
        row[FIELD[str(rng.choice(names))]] = word

    return _edit_row(edit)


def _cut_after_lines(letters: int) -> Apply:
    def change(content: bytes, rng: np.random.Generator) -> bytes:
        lines = content.splitlines(keepends=True)
        num_whole_lines = int(rng.integers(2, len(lines) // 2))
        return b"".join(lines[:num_whole_lines]) + lines[num_whole_lines][:letters]

    return edit_file("label", change)


def _garble_number(row: list[str], rng: np.random.Generator) -> None:
    row[FIELD[str(rng.choice(_NUMERIC_FIELDS))]] += ".5"


def _zero_second_half(content: bytes, _: np.random.Generator) -> bytes:
    first_half = content[: len(content) // 2]
    return first_half.ljust(len(content), b"\0")


GROUP.add(
    {
        "label_cut": ("A label file ends at a random byte.", edit_file("label", cut)),
        "label_cut_between_lines": (
            "A label file ends after one of the box lines; the remaining lines are sound.",
            _cut_after_lines(letters=0),
        ),
        "label_cut_in_a_class": (
            "A label file ends within a line's first word; readers skip lines of one word.",
            _cut_after_lines(letters=2),
        ),
        "label_emptied": ("A label file is empty.", edit_file("label", empty)),
        "label_garbage": ("A label file holds random bytes.", edit_file("label", garbage)),
        "label_zeros": (
            "A label file's second half is zero bytes, as after a write to a full disk.",
            edit_file("label", _zero_second_half),
        ),
        "label_field_dropped": (
            "A line lacks a field.",
            _edit_row(lambda row, rng: row.pop(int(rng.integers(len(row))))),
        ),
        "label_field_added": (
            "A line has one field too many.",
            _edit_row(lambda row, rng: row.insert(int(rng.integers(1, len(row))), "0.5")),
        ),
        "label_nan": ("A position, size or yaw is NaN.", _set_field(_NUMERIC_FIELDS, "nan")),
        "label_infinite": (
            "A position is infinite.",
            lambda editor, rng: _set_field(_NUMERIC_FIELDS[:3], str(rng.choice(["inf", "-inf"])))(
                editor, rng
            ),
        ),
        "label_number_garbled": ("A number has a second decimal point.", _edit_row(_garble_number)),
        "label_class_unknown": (
            "A line names a class that does not exist.",
            _edit_row(lambda row, rng: row.__setitem__(0, str(rng.choice(["bus", "Car", "0"])))),
        ),
        "label_header_removed": (
            "A label file lacks its first line.",
            edit_file("label", lambda content, _: content.split(b"\n", 1)[1]),
        ),
    },
)
