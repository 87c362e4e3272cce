"""What lies beside the questions, for those who answer them: a README.md, and the JSON Schema of an answer."""

from __future__ import annotations

import json
from typing import Any, Final

from deepaccident_devkit._version import __version__

_README: Final = """\
# Questions on accidents

Made by `deepaccident export questions` of the DeepAccident devkit {devkit}. Each line of `questions.jsonl` is a
question on its own, and is answered from this line{pictures} alone. Lines stand in an order that was drawn. Windows of
one recording may overlap, so nothing of one line may be used for another.

Some agents (vehicles, or the infrastructure: the `ego`, and those that share what they see) have observed traffic at an
intersection at the times in `moments`, in seconds; 0 is the present.

| field | what |
|---|---|
| `id` | of the question |
| `seconds` | how many seconds ahead it asks about |
| `moments` | times of the observations, up to {observe:g} s before the present |
| `conditions` | weather, time of day, kind of road |
| `observers` | the agents, the ego first, with an entry a moment in `position`, `heading` and `speed` |
| `actors` | the others that were seen, with an entry for each moment in `time` at which at least one agent saw it |
| `seen_by` | which agents saw it then |
{images}
Positions are x forward, y left of where the ego is at the present, in metres, for all moments. Headings are
counter-clockwise from forward, in radians. Speeds are over the ground, in m/s. Sizes are length, width and height.
A value that is not known is null. An actor counts as seen
{rule}.

## What is asked

Will two road users collide after more than n − 1 seconds and within n seconds, for n from 1 to {seconds}? Which two,
where, and why? At most one accident happens.

    {example}

| field | what |
|---|---|
| `id` | of the question |
| `accident` | for each second true or false, or a probability from 0 to 1 |
| `who` | names of the two, from `observers` and `actors`; null for one that is not shown, or for both |
| `where` | where the centres of the two are at the impact, in the order of `who`, or one point; null for no accident |
| `when` | seconds from the present to the impact; may be left out |
| `why` | a text; may be left out |

Answers are such lines, one a question, in any order; `answer.schema.json` is the schema of a line. A question without
an answer counts as answered with no accident.
"""
_RULES: Final = {
    "released": "by an agent whose camera sees it and whose LiDAR hits it, or nearby if one of these does",
    "camera": "by an agent whose camera sees it",
    "annotated": "by each agent that is near enough to annotate it, even if something hides it",
}
_IMAGES: Final = "| `images` | pictures, with their time, observer, camera and path |\n"


def readme(*, seconds: int, observe: float, seen: str, pictures: bool) -> bytes:
    """The README.md for those who answer.

    Args:
        seconds: that are asked about.
        observe: seconds of a window.
        seen: what counts as seen.
        pictures: whether there are pictures.
    """
    sure = 2 if seconds > 1 else 1
    example = {
        "id": "0123456789abcdef",
        "accident": [second == sure for second in range(1, seconds + 1)],
        "who": ["ego", "a1"],
        "where": [[8.2, 0.1], [9.9, 2.4]],
        "when": sure - 0.4,
        "why": "a1 crosses without slowing down",
    }
    return _README.format(
        devkit=__version__,
        seconds=seconds,
        observe=observe,
        rule=_RULES[seen],
        pictures=" and its pictures" if pictures else "",
        images=_IMAGES if pictures else "",
        example=json.dumps(example),
    ).encode()


def answer_schema(seconds: int) -> dict[str, Any]:
    """The JSON Schema of an answer about so many seconds."""
    point = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
    name = {"type": ["string", "null"]}
    likely = {"anyOf": [{"type": "boolean"}, {"type": "number", "minimum": 0, "maximum": 1}]}
    pair = {"minItems": 2, "maxItems": 2}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "An answer",
        "type": "object",
        "properties": {
            "id": {"type": "string"},
            "accident": {"type": "array", "items": likely, "minItems": seconds, "maxItems": seconds},
            "who": {"anyOf": [{"type": "array", "items": name, **pair}, {"type": "null"}]},
            "where": {"anyOf": [point, {"type": "array", "items": point, **pair}, {"type": "null"}]},
            "when": {"anyOf": [{"type": "number", "minimum": 0}, {"type": "null"}]},
            "why": {"type": ["string", "null"]},
        },
        "required": ["id", "accident", "who", "where"],
        "additionalProperties": False,
    }
