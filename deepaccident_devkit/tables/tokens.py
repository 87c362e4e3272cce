"""Tokens: readable, stable, and made of the names on disk, so that no dictionary of them is needed."""

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
