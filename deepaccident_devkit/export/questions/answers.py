"""Answers to questions: their description for readers, and their conversion to accidents.

`evaluate` takes these accidents.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import numpy as np

from deepaccident_devkit.errors import ConfigError, ResultsError, shortened
from deepaccident_devkit.evaluation import Accident
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.support.arrays import FloatArray, ShortRepr, checked_number
from deepaccident_devkit.support.json_text import Record, parsed_record
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables.tokens import sample_token

_README_TEMPLATE: Final = """\
# Questions on accidents

Made by `deepaccident export questions` of the DeepAccident devkit {devkit}. Each line of \
`questions.jsonl` is a
question on its own, and is answered from this line{pictures} alone. Lines stand in an order that \
was drawn. Windows of
one recording may overlap, so nothing of one line may be used for another.

Some agents (vehicles, or the infrastructure: the `ego`, and those that share what they see) have \
observed traffic at an
intersection at the times in `moments`, in seconds; 0 is the present.

| field | what |
|---|---|
| `id` | of the question |
| `seconds` | how many seconds ahead it asks about |
| `moments` | times of the observations, up to {observe:g} s before the present |
| `conditions` | weather, time of day, kind of road |
| `observers` | the agents, the ego first, with an entry a moment in `position`, `heading` and \
`speed` |
| `actors` | the others that were seen, with an entry for each moment in `time` at which at least \
one agent saw it |
| `seen_by` | which agents saw it then |
{images}
Positions are x forward, y left of where the ego is at the present, in metres, for all moments. \
Headings are
counter-clockwise from forward, in radians. Speeds are over the ground, in m/s. Sizes are length, \
width and height.
A value that is not known is null. An actor counts as seen
{rule}.

## What is asked

Will two road users collide after more than n − 1 seconds and within n seconds, for n from 1 to \
{seconds}? Which two,
where, and why? At most one accident happens.

    {example}

| field | what |
|---|---|
| `id` | of the question |
| `accident` | for each second true or false, or a probability from 0 to 1 |
| `who` | names of the two, from `observers` and `actors`; null for one that is not shown, or for \
both |
| `where` | where the centres of the two are at the impact, in the order of `who`, or one point; \
null for no accident |
| `when` | seconds from the present to the impact; may be left out |
| `why` | a text; may be left out |

Answers are such lines, one a question, in any order; `answer.schema.json` is the schema of a \
line. A question without
an answer counts as answered with no accident.
"""
_RULES: Final = {
    "released": "by an agent whose camera sees it and whose LiDAR hits it, or nearby if one of "
    "these does",
    "camera": "by an agent whose camera sees it",
    "annotated": "by each agent that is near enough to annotate it, even if something hides it",
}
_IMAGES_ROW: Final = "| `images` | pictures, with their time, observer, camera and path |\n"
_REMEDY: Final = "mend that line; README.md beside the questions says what an answer is"
_DEFAULT_THRESHOLD: Final = 0.5
# Larger numbers are mistakes, as with seconds.
_Metres = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
_PAIR_LENGTH: Final = msgspec.Meta(min_length=2, max_length=2)


def questions_readme(*, seconds: int, observe: float, seen: str, pictures: bool) -> bytes:
    """Return the README.md for the people or models that answer.

    Args:
        seconds: Number of seconds that are asked about.
        observe: Seconds of a window before the present.
        seen: Rule that decides what an agent sees.
        pictures: Whether the questions have pictures.
    """
    accident_second = 2 if seconds > 1 else 1
    example = {
        "id": "0123456789abcdef",
        "accident": [second == accident_second for second in range(1, seconds + 1)],
        "who": ["ego", "a1"],
        "where": [[8.2, 0.1], [9.9, 2.4]],
        "when": accident_second - 0.4,
        "why": "a1 crosses without slowing down",
    }
    return _README_TEMPLATE.format(
        devkit=__version__,
        seconds=seconds,
        observe=observe,
        rule=_RULES[seen],
        pictures=" and its pictures" if pictures else "",
        images=_IMAGES_ROW if pictures else "",
        example=json.dumps(example),
    ).encode()


def answer_schema(seconds: int) -> dict[str, Any]:
    """Return the JSON Schema of an answer about a number of seconds."""
    point = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
    name = {"type": ["string", "null"]}
    probability = {"anyOf": [{"type": "boolean"}, {"type": "number", "minimum": 0, "maximum": 1}]}
    pair = {"minItems": 2, "maxItems": 2}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "An answer",
        "type": "object",
        "properties": {
            "id": {"type": "string"},
            "accident": {
                "type": "array",
                "items": probability,
                "minItems": seconds,
                "maxItems": seconds,
            },
            "who": {"anyOf": [{"type": "array", "items": name, **pair}, {"type": "null"}]},
            "where": {
                "anyOf": [point, {"type": "array", "items": point, **pair}, {"type": "null"}]
            },
            "when": {"anyOf": [{"type": "number", "minimum": 0}, {"type": "null"}]},
            "why": {"type": ["string", "null"]},
        },
        "required": ["id", "accident", "who", "where"],
        "additionalProperties": False,
    }


class _Answer(msgspec.Struct, forbid_unknown_fields=True):
    """A line of the answers."""

    id: str
    accident: list[bool | Annotated[float, msgspec.Meta(ge=0, le=1)]]
    who: tuple[str | None, str | None] | None
    where: Annotated[list[_Metres | Annotated[list[_Metres], _PAIR_LENGTH]], _PAIR_LENGTH] | None
    when: Annotated[float, msgspec.Meta(ge=0, le=1e6)] | None = None
    why: Any = None


class _Question(msgspec.Struct):
    """The used fields of a line of the truth."""

    id: str
    sample: Annotated[str, msgspec.Meta(max_length=1000, pattern=r"^([^/\s]+/){3}[0-9]{3}\Z")]
    last_frame: Annotated[int, msgspec.Meta(ge=1, le=999)]
    accident: Annotated[list[bool | None], msgspec.Meta(min_length=1)]
    actors: dict[str, Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 31)]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers(ShortRepr):
    """The alarms of answers.

    Attributes:
        accidents: Token of each sample of a question → its alarms, at most one. The last frame of
            each recording is included without an alarm: nothing is asked there, but evaluations of
            warnings need it.
        answered: Number of questions with an answer.
        missing: Ids of the questions without an answer, which raise no alarm.
    """

    accidents: Mapping[str, Sequence[Accident]]
    answered: int
    missing: tuple[str, ...]

    @property
    def alarms(self) -> int:
        """Number of alarms."""
        return sum(map(len, self.accidents.values()))


def read_answers(
    answers: str | os.PathLike[str],
    truth: str | os.PathLike[str],
    *,
    threshold: float = _DEFAULT_THRESHOLD,
) -> Answers:
    """Read answers, a line of JSON each, and the truth file of their questions.

    An answer raises an alarm if it gives at least one second a probability of at least `threshold`,
    and above 0; true is 1. The alarm is for the likeliest second, or the earliest of several: its
    score is the probability, its time `when` if that is in this second, otherwise the middle of the
    second.

    Args:
        answers: File of the answers; README.md beside the questions describes them.
        truth: `truth.jsonl` of the export.
        threshold: Threshold from 0 to 1; 0 retains all alarms, for curves over the score.

    Raises:
        ResultsError: a file cannot be read, a line is no answer, a question is answered twice, or
            there is no question of an id; the message names file and line.
        ConfigError: the threshold is not from 0 to 1.
    """
    if not 0 <= checked_number("threshold", threshold, "a number from 0 to 1", ConfigError) <= 1:
        raise ConfigError(f"threshold: expected a number from 0 to 1, found {threshold!r}")
    questions = _read_questions(path_of(truth))
    accidents: dict[str, list[Accident]] = {}
    for question in questions.values():
        accidents[question.sample] = []
    for question in questions.values():
        recording = question.sample.rpartition("/")[0]
        scenario, _, agent = recording.rpartition("/")
        accidents.setdefault(sample_token(scenario, agent, question.last_frame), [])
    line_numbers: dict[str, int] = {}
    for number, answer in _lines(path_of(answers), _Answer, _REMEDY):
        location = f"{answers}:{number}"
        if answer.id not in questions:
            raise ResultsError(
                f"{location}: id: {_excerpt(answer.id)} is no question of the truth file; give the "
                "truth of these questions, or leave the line out"
            )
        if answer.id in line_numbers:
            raise ResultsError(
                f"{location}: id: {shortened(answer.id)} is answered in line "
                f"{line_numbers[answer.id]} already; leave one of them out"
            )
        line_numbers[answer.id] = number
        question = questions[answer.id]
        accidents[question.sample] += _alarms(location, answer, question, threshold)
    return Answers(
        accidents=accidents,
        answered=len(line_numbers),
        missing=tuple(key for key in questions if key not in line_numbers),
    )


def results_of_answers(
    answers: str | os.PathLike[str],
    truth: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    threshold: float = _DEFAULT_THRESHOLD,
    meta: Mapping[str, Any] | None = None,
) -> Answers:
    """Write answers as a results file, for `evaluate accident` and `evaluate warning`.

    Args:
        answers: See `read_answers`.
        truth: See `read_answers`.
        out: The results file, which must not exist.
        threshold: See `read_answers`.
        meta: Notes for readers, such as the name of the model.

    Returns:
        The answers.

    Raises:
        ResultsError: as in `read_answers`; or something exists at `out`, or it cannot be written.
        ConfigError: as in `read_answers`.
    """
    ResultsWriter(out, "accident")  # raises if the path exists
    read = read_answers(answers, truth, threshold=threshold)
    facts = {
        "questions": len(read.missing) + read.answered,
        "answered": read.answered,
        "threshold": threshold,
    }
    with ResultsWriter(out, "accident", meta={**facts, **(meta or {})}) as writer:
        for token, accidents in read.accidents.items():
            writer.add(token, list(accidents))
    return read


def _read_questions(path: Path) -> dict[str, _Question]:
    """Return id → line of the truth file, in the order of the samples."""
    remedy = "give truth.jsonl of the export of the questions"
    line_remedy = f"this is no line of a truth file; {remedy}"
    questions = [question for _, question in _lines(path, _Question, line_remedy)]
    if not questions:
        raise ResultsError(f"{path}: holds no question; {remedy}")
    by_id = {question.id: question for question in questions}
    return dict(sorted(by_id.items(), key=lambda item: item[1].sample))


def _lines(path: Path, record_type: type[Record], remedy: str) -> Iterator[tuple[int, Record]]:
    """Yield the records of a file of JSON lines with their numbers, from 1, without blank lines."""
    try:
        content = read_bytes(path, "results")
    except OSError as error:
        raise ResultsError(
            f"{path}: {fault_text(error)}; give a file of JSON lines that can be read"
        ) from error
    for number, line in enumerate(content.split(b"\n"), start=1):
        if not line.strip():
            continue
        try:
            record = parsed_record(line, record_type)
        except ValueError as error:
            raise ResultsError(f"{path}:{number}: {error}; {remedy}") from error
        yield number, record


def _alarms(
    location: str, answer: _Answer, question: _Question, threshold: float
) -> list[Accident]:
    """Return the alarm of an answer, if it raises one; all its fields are checked in any case."""
    seconds, scores = len(question.accident), list(map(float, answer.accident))
    if len(scores) != seconds:
        raise ResultsError(
            f"{location}: accident: expected {seconds} times true, false or a probability from 0 "
            f"to 1, found {_excerpt(answer.accident)}; {_REMEDY}"
        )
    ids = _actor_ids(location, answer.who, question.actors)
    positions = _positions(location, answer.where)
    best = int(np.argmax(scores))
    if scores[best] == 0 or scores[best] < threshold:
        return []
    if positions is None:
        raise ResultsError(f"{location}: where: is null, but an accident needs a place; {_REMEDY}")
    time = best + 0.5
    if answer.when is not None and best < answer.when <= best + 1:
        time = answer.when
    return [Accident(positions=positions, time=time, score=scores[best], ids=ids)]


def _actor_ids(
    location: str, names: tuple[str | None, str | None] | None, actors: Mapping[str, int]
) -> tuple[int, int] | None:
    """Return the actor ids of two names; None if one of them is not known."""
    if names is None:
        return None
    for name in names:
        if name is not None and name not in actors:
            raise ResultsError(
                f"{location}: who: {_excerpt(name)} is nobody in the question; write null for one "
                "that it does not show"
            )
    first, second = (None if name is None else actors[name] for name in names)
    if first is not None and first == second:
        raise ResultsError(f"{location}: who: {_excerpt(names[0])} stands there twice; {_REMEDY}")
    if first is None or second is None:
        return None
    return first, second


def _positions(location: str, points: list[Any] | None) -> FloatArray | None:
    """Return two points (2, 2) in metres, also from a single one; None for no place."""
    if points is None:
        return None
    if isinstance(points[0], list) != isinstance(points[1], list):
        raise ResultsError(
            f"{location}: where: expected [x, y], or [[x, y], [x, y]], found {_excerpt(points)}; "
            f"{_REMEDY}"
        )
    return np.broadcast_to(np.array(points, dtype=np.float64), (2, 2)).copy()


def _excerpt(value: object) -> str:
    return shortened(repr(value))
