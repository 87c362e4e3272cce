"""Label files that are no label files any more."""

from collections.abc import Callable

import numpy as np

from fault_injection.kinds import Group, cut, garbage
from fault_injection.place import FIELD, Place

GROUP = Group("label, form")
_NUMBERS = ("x", "y", "z", "l", "w", "h", "yaw")


def _edit_a_line(place: Place, rng: np.random.Generator, edit: Callable[[list[str]], None]) -> str:
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    rows = place.rows(agent, frame)
    row = place.any_row(rng, rows)
    edit(row)
    place.write_rows(agent, frame, rows)
    return f"{agent} {frame}: {' '.join(row)[:60]}"


def _replace_file(place: Place, rng: np.random.Generator, change: Callable[[bytes], bytes]) -> str:
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    path = place.file(agent, "label", frame)
    content = path.read_bytes()
    place.write(path, change(content))
    return f"{agent} {frame}: {len(content)} to {path.stat().st_size} bytes"


GROUP.add(
    {
        "label_cut": (
            "A label file ends at a random byte.",
            lambda place, rng: _replace_file(place, rng, lambda content: cut(content, rng)),
        ),
        "label_cut_between_lines": (
            "A label file ends after one of the box lines; the remaining lines are sound.",
            lambda place, rng: _cut_after(place, rng, letters=0),
        ),
        "label_cut_in_a_class": (
            "A label file ends within a line's first word; readers skip lines of one word.",
            lambda place, rng: _cut_after(place, rng, letters=2),
        ),
    },
)


def _cut_after(place: Place, rng: np.random.Generator, *, letters: int) -> str:
    def change(content: bytes) -> bytes:
        lines = content.splitlines(keepends=True)
        whole = int(rng.integers(2, len(lines) // 2))
        return b"".join(lines[:whole]) + lines[whole][:letters]

    return _replace_file(place, rng, change)


GROUP.add(
    {
        "label_emptied": ("A label file is empty.", lambda place, rng: _replace_file(place, rng, lambda _: b"")),
        "label_garbage": (
            "A label file holds random bytes.",
            lambda place, rng: _replace_file(place, rng, lambda content: garbage(rng, len(content))),
        ),
        "label_zeros": (
            "A label file's second half is zero bytes, as after a write to a full disk.",
            lambda place, rng: _replace_file(
                place, rng, lambda content: content[: len(content) // 2] + bytes(len(content) - len(content) // 2)
            ),
        ),
        "label_field_dropped": (
            "A line lacks a field.",
            lambda place, rng: _edit_a_line(place, rng, lambda row: row.pop(int(rng.integers(len(row)))) and None),
        ),
        "label_field_added": (
            "A line has one field too many.",
            lambda place, rng: _edit_a_line(place, rng, lambda row: row.insert(int(rng.integers(1, len(row))), "0.5")),
        ),
        "label_nan": (
            "A position, size or yaw is NaN.",
            lambda place, rng: _edit_a_line(
                place, rng, lambda row: row.__setitem__(FIELD[str(rng.choice(_NUMBERS))], "nan")
            ),
        ),
    },
)


@GROUP.kind()
def label_infinite(place: Place, rng: np.random.Generator) -> str:
    """A position is infinite."""
    word = str(rng.choice(["inf", "-inf"]))
    return _edit_a_line(place, rng, lambda row: row.__setitem__(FIELD[str(rng.choice(_NUMBERS[:3]))], word))


@GROUP.kind()
def label_number_garbled(place: Place, rng: np.random.Generator) -> str:
    """A number has a second decimal point."""

    def garble(row: list[str]) -> None:
        field = FIELD[str(rng.choice(_NUMBERS))]
        row[field] += ".5"

    return _edit_a_line(place, rng, garble)


GROUP.add(
    {
        "label_class_unknown": (
            "A line names a class that does not exist.",
            lambda place, rng: _edit_a_line(
                place, rng, lambda row: row.__setitem__(0, str(rng.choice(["bus", "Car", "0"])))
            ),
        ),
        "label_header_removed": (
            "A label file lacks its first line.",
            lambda place, rng: _replace_file(place, rng, lambda content: content.split(b"\n", 1)[1]),
        ),
    },
)
