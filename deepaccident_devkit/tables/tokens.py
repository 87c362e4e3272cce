"""Tokens: readable, stable, and made of the names on disk, so that no dictionary of them is needed."""

from collections.abc import Sequence
from typing import NamedTuple

from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.taxonomy import CHANNELS

ACTOR = "actor"
FORMS = {
    "scenario": "<scenario_type>/<name>",
    "agent": "<scenario>/<agent>",
    "frame": "<scenario>/<NNN>",
    "sample": "<scenario>/<agent>/<NNN>",
    "sample_data": "<scenario>/<agent>/<NNN>/<channel>",
    "sensor": "<channel>",
    "calibrated_sensor": "<scenario>/<agent>/<channel>[/<n>]",
    "ego_pose": "<scenario>/<agent>/<NNN>",
    "instance": "<scenario>/actor/<actor_id>",
    "annotation": "<scenario>/<agent>/<NNN>/<row>",
    "track": "<scenario>/<NNN>/actor/<actor_id>",
    "category": "<name>",
}
"""Table → the form of its tokens; `<scenario>` stands for `<scenario_type>/<name>`."""


class Parts(NamedTuple):
    """A token cut up: its scenario (two words) and the words that follow."""

    scenario: str
    rest: list[str]


def split(table: str, token: str) -> Parts:
    """Cut a token of a scenario's table; raises TokenError if it is not of the table's form."""
    words = token.split("/")
    wanted = {FORMS[table].count("/") + (1 if "<scenario>" in FORMS[table] else 0) + 1}
    if table == "calibrated_sensor":
        wanted = {4, 5}
    if len(words) not in wanted:
        raise unknown_token(table, token, f"expected the form {FORMS[table]}{_remedy(table, words)}")
    return Parts(f"{words[0]}/{words[1]}", words[2:])


def _remedy(table: str, words: Sequence[str]) -> str:
    """What to do where a sensor file's token was given as a sample's, or a sample's as a sensor file's."""
    if table == "sample" and len(words) == 5 and words[-1] in CHANNELS:
        return f"; it names a sensor file: leave out '/{words[-1]}'"
    if table == "sample_data" and len(words) == 4 and parse_number(words[-1], 3) is not None:
        return f"; it names a sample: add a channel, such as '/{CHANNELS[0]}'"
    return ""


def unknown_token(table: str, token: str, why: str) -> TokenError:
    """The error for a token that names no row."""
    return TokenError(f"table '{table}' has no token '{token}': {why}")


def agent_token(scenario: str, agent: str) -> str:
    """Token of an agent."""
    return f"{scenario}/{agent}"


def frame_token(scenario: str, index: int) -> str:
    """Token of a frame."""
    return f"{scenario}/{index:03d}"


def sample_token(scenario: str, agent: str, index: int) -> str:
    """Token of a sample, and of its ego pose."""
    return f"{scenario}/{agent}/{index:03d}"


def sample_data_token(sample: str, channel: str) -> str:
    """Token of a sensor file."""
    return f"{sample}/{channel}"


def calibrated_sensor_token(agent: str, channel: str, number: int) -> str:
    """Token of a calibrated sensor: the first value has no number."""
    return f"{agent}/{channel}" if number == 1 else f"{agent}/{channel}/{number}"


def instance_token(scenario: str, actor_id: int) -> str:
    """Token of an actor."""
    return f"{scenario}/{ACTOR}/{actor_id}"


def annotation_token(sample: str, row: int) -> str:
    """Token of a box: its row in the label."""
    return f"{sample}/{row}"


def track_token(frame: str, actor_id: int) -> str:
    """Token of an actor at a moment."""
    return f"{frame}/{ACTOR}/{actor_id}"


def parse_number(word: str, width: int = 1) -> int | None:
    """The number a word writes the way tokens do (no sign but −, no superfluous zeros), else None."""
    digits = word.removeprefix("-")
    if not (digits.isascii() and digits.isdigit()):
        return None
    number = int(word)
    return number if f"{number:0{width}d}" == word else None
