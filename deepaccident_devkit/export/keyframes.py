"""The two moments a second that formats annotate: counted back from a recording's last frame, the impact."""

from typing import Final

KEY_STEP: Final = 5
"""Recorded frames from one keyframe to the next."""


def keyframes(last: int) -> range:
    """The numbers of a recording's keyframes; frames are counted from 1 to `last`."""
    return range((last - 1) % KEY_STEP + 1, last + 1, KEY_STEP)


def keyframe_after(number: int, last: int) -> int:
    """The keyframe that a frame leads to: itself, or the next one."""
    return number + (last - number) % KEY_STEP
