"""Meta files that cannot be read, or do not agree with the scenario."""

from pathlib import Path

from deepaccident_devkit.errors import BrokenReleaseError, MetaError
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.testing.breakages.kinds import Group, Victim

FORM = Group("meta", opening=BrokenReleaseError, reading=MetaError)
MEANING = Group("meta")


def _edit_first_line(victim: Victim, word: int, new: str) -> Path:
    first, *rest = victim.editor.meta_lines()
    words = first.split()
    words[word] = new
    victim.editor.write_meta_lines([" ".join(words), *rest])
    return real_path(victim.editor.scenario.meta_path)


@FORM.enter("meta-unreadable")
def meta_empty(victim: Victim) -> Path:
    """A meta file has no bytes."""
    victim.editor.write_meta_lines([])
    return real_path(victim.editor.scenario.meta_path)


@FORM.enter("meta-unreadable")
def meta_cut(victim: Victim) -> Path:
    """A meta file ends within its first line."""
    victim.editor.write_meta_lines([victim.editor.meta_lines()[0][:20]])
    return real_path(victim.editor.scenario.meta_path)


@FORM.enter("meta-unreadable")
def meta_id_no_number(victim: Victim) -> Path:
    """A colliding actor's id is a word."""
    return _edit_first_line(victim, 1, "ego")


@MEANING.enter("meta-missing")
def meta_missing(victim: Victim) -> Path:
    """A labelled scenario has no meta file."""
    victim.editor.remove(real_path(victim.editor.scenario.meta_path))
    return real_path(victim.editor.scenario.meta_path)


@MEANING.enter("meta-frames")
def meta_frames_wrong(victim: Victim) -> Path:
    """The number of frames in meta is not that of the recorded frames."""
    return _edit_first_line(victim, 8, "99")


@MEANING.enter("meta-pair", "pair-not-seen")
def meta_pair_wrong(victim: Victim) -> Path:
    """Meta names a colliding actor that is in no label."""
    return _edit_first_line(victim, 1, "7777")
