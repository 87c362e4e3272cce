"""Label files that cannot be read, or contain what is impossible."""

from pathlib import Path

from deepaccident_devkit.errors import BrokenReleaseError, LabelError
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from deepaccident_devkit.testing.breakages.kinds import Group, Victim
from deepaccident_devkit.testing.editing import FIELD

FORM = Group("label", opening=BrokenReleaseError, reading=LabelError)
MEANING = Group("label")


def _set_field(victim: Victim, name: str, word: str) -> Path:
    """Change one word of the last box line."""
    rows = victim.editor.rows(victim.agent, victim.frame)
    rows[-1][FIELD[name]] = word
    victim.editor.write_rows(victim.agent, victim.frame, rows)
    return victim.file("label")


@FORM.enter("label-unreadable")
def label_empty(victim: Victim) -> Path:
    """A label file has no bytes."""
    return victim.replace("label", lambda _: b"")


@FORM.enter("label-unreadable")
def label_garbage(victim: Victim) -> Path:
    """A label file contains a picture's bytes."""
    return victim.replace("label", lambda _: b"\xff\xd8\xff\xe0\x00\x10JFIF\x00\x01" * 20)


@FORM.enter("label-unreadable")
def label_cut(victim: Victim) -> Path:
    """A label file ends within a line."""
    return victim.replace("label", lambda content: content[:-25])


@FORM.enter("label-unreadable")
def label_zeros(victim: Victim) -> Path:
    """The second half of a label file is zero bytes, as after a write to a full disk."""
    return victim.replace("label", lambda content: content[: len(content) // 2] + bytes(len(content) // 2))


@FORM.enter("label-unreadable")
def label_no_header(victim: Victim) -> Path:
    """A label file lacks its first line, the agent's velocity."""
    return victim.replace("label", lambda content: content.split(b"\n", 1)[1])


@FORM.enter("label-unreadable")
def label_field_missing(victim: Victim) -> Path:
    """A box line has 12 fields instead of 13."""
    rows = victim.editor.rows(victim.agent, victim.frame)
    del rows[-1][FIELD["num_lidar_pts"]]
    victim.editor.write_rows(victim.agent, victim.frame, rows)
    return victim.file("label")


@FORM.enter("label-unreadable")
def label_class_unknown(victim: Victim) -> Path:
    """A box line names a class that does not exist."""
    return _set_field(victim, "class", "lorry")


@FORM.enter("label-unreadable")
def label_number_garbled(victim: Victim) -> Path:
    """A coordinate has two decimal points."""
    return _set_field(victim, "x", "1.2.3")


@FORM.enter("label-unreadable")
def label_nan(victim: Victim) -> Path:
    """A position is NaN."""
    return _set_field(victim, "y", "nan")


@MEANING.enter("own-row-missing")
def label_own_row_missing(victim: Victim) -> Path:
    """A vehicle's label lacks the row of the vehicle itself (id −100)."""
    rows = victim.editor.rows(victim.agent, victim.frame)
    others = [row for row in rows[1:] if int(row[FIELD["id"]]) != OWN_ACTOR_ID]
    victim.editor.write_rows(victim.agent, victim.frame, [rows[0], *others])
    return victim.file("label")


@MEANING.enter("duplicate-box", "duplicate-id")
def label_line_twice(victim: Victim) -> Path:
    """The box line of a tracked actor is there twice."""
    rows = victim.editor.rows(victim.agent, victim.frame)
    victim.editor.write_rows(victim.agent, victim.frame, [*rows, rows[2]])
    return victim.file("label")


@MEANING.enter("headings-differ", "own-velocity", "positions-differ", "velocity-off")
def label_right_handed(victim: Victim) -> Path:
    """One agent's labels have the other handedness: y, yaw and vy with the wrong sign."""

    def flip(row: list[str]) -> None:
        for name in ("y", "yaw", "vy"):
            row[FIELD[name]] = repr(-float(row[FIELD[name]]))

    victim.editor.edit_rows(victim.agent, victim.editor.frames, flip)
    return victim.editor.folder(victim.agent, "label")


@MEANING.enter("meta-pair", "positions-differ", "sizes-differ")
def labels_of_two_agents_swapped(victim: Victim) -> Path:
    """Two vehicles' labels are swapped at all frames."""
    for frame in victim.editor.frames:
        files = (victim.editor.file(agent, "label", frame) for agent in (victim.agent, victim.other))
        victim.editor.exchange(*files)
    return victim.editor.folder(victim.agent, "label")
