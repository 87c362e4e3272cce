"""Answers to questions: a description for whoever answers, and the conversion to accidents.

`evaluate` can evaluate these accidents.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from deepaccident_devkit.errors import ConfigError, ResultsError, shortened
from deepaccident_devkit.evaluation import Accident
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.support.arrays import FloatArray, ShortRepr, checked_number
from deepaccident_devkit.support.json_text import Record, parsed_record
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import PathType, path_of
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables.tokens import sample_token

_README_TEMPLATE = """\
# Questions on accidents

Made by `deepaccident export questions` of the DeepAccident devkit {devkit}. Each line of \
`questions.jsonl` is a
separate question; answer it only from this line{pictures}. The order of the lines is random. \
Windows of
one recording may overlap, so do not use one line to answer another.

Some agents (the `ego`, and vehicles or infrastructure that share what they see with it) have \
observed traffic at an
intersection at the times in `moments`, in seconds; 0 is the present.

| field | what |
|---|---|
| `id` | id of the question |
| `seconds` | how many seconds the question looks ahead |
| `moments` | times of the observations, up to {observe:g} s before the present |
| `conditions` | weather, time of day, kind of road |
| `observers` | the agents, the ego first, with an entry for each moment in `position`, `heading` \
and `speed` |
| `actors` | other road users that were seen, with an entry in `time` for each moment at which \
at least one agent saw the actor |
| `seen_by` | the agents that saw the actor at this moment |
{images}
Positions at all moments are x forward, y left of the ego's present position, in metres. \
Headings are
counter-clockwise from forward, in radians. Speeds are over the ground, in m/s. Sizes are length, \
width and height.
An unknown value is null. An actor counts as seen
{rule}.

## What is asked

Will two road users collide after more than n − 1 seconds and within n seconds, for n from 1 to \
{seconds}? Which two,
where, and why? At most one accident happens.

    {example}

| field | what |
|---|---|
| `id` | id of the question |
| `accident` | for each second, true or false, or a probability from 0 to 1 |
| `who` | names of the two, from `observers` and `actors`; null for an actor that the question \
does not show, or for both |
| `where` | positions of the two centres at the impact, in the order of `who`, or one point; \
null for no accident |
| `when` | seconds from the present to the impact; optional |
| `why` | text; optional |

Write one such line per question, in any order; `answer.schema.json` is the schema of a \
line. A question without
an answer counts as no accident.
"""
_RULES = {
    "released": "by an agent whose camera sees it and whose LiDAR hits it, or nearby if one of "
    "these does",
    "camera": "by an agent whose camera sees it",
    "annotated": "by each agent that is near enough to annotate it, even if something hides it",
}
_IMAGES_ROW = "| `images` | pictures, with their time, observer, camera and path |\n"
_REMEDY = "correct that line; the README.md next to the questions describes an answer"
_DEFAULT_THRESHOLD = 0.5
# Larger numbers are treated as mistakes, as with seconds.
_Metres = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
_PAIR_LENGTH = msgspec.Meta(min_length=2, max_length=2)


def format_questions_readme(*, seconds: int, observe: float, seen: str, pictures: bool) -> bytes:
    """Return the README.md for the people or models that answer the questions.

    Args:
        seconds: Number of seconds ahead that the questions ask about.
        observe: Length in seconds of the part of a window before its current frame.
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


def make_answer_schema(seconds: int) -> NamedValues:
    """Return the JSON Schema of an answer about this number of seconds."""
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
    """One line of a file of answers."""

    id: str
    accident: list[bool | Annotated[float, msgspec.Meta(ge=0, le=1)]]
    who: tuple[str | None, str | None] | None
    where: Annotated[list[_Metres | Annotated[list[_Metres], _PAIR_LENGTH]], _PAIR_LENGTH] | None
    when: Annotated[float, msgspec.Meta(ge=0, le=1e6)] | None = None
    why: Any = None


class _Question(msgspec.Struct):
    """The fields of a line in the truth file that are needed here."""

    id: str
    sample: Annotated[str, msgspec.Meta(max_length=1000, pattern=r"^([^/\s]+/){3}[0-9]{3}\Z")]
    last_frame: Annotated[int, msgspec.Meta(ge=1, le=999)]
    accident: Annotated[list[bool | None], msgspec.Meta(min_length=1)]
    actors: dict[str, Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 31)]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers(ShortRepr):
    """Accidents that answers predict, as alarms.

    Attributes:
        accidents: Alarms (at most one) for each sample with a question, by token. The last frame of
            each recording is included without an alarm: there is no question about it, but
            evaluations of warnings need it.
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
    answers: PathType,
    truth: PathType,
    *,
    threshold: float = _DEFAULT_THRESHOLD,
) -> Answers:
    """Read answers, one line of JSON each, and the truth file of their questions.

    An answer raises an alarm if the probability of at least one second is above 0 and at least
    `threshold`; `true` counts as 1. The alarm is for the most likely second (ties: the earliest).
    Its score is that probability. Its time is `when` if that lies in this second, otherwise the
    middle of the second.

    Args:
        answers: File of the answers; the README.md next to the questions describes its format.
        truth: File `truth.jsonl` of the export.
        threshold: Threshold from 0 to 1; 0 retains all alarms, for curves over the score.

    Raises:
        ResultsError: If a file cannot be read, a line is not an answer, a question is answered
            twice, or an id belongs to no question; the message names the file and the line.
        ConfigError: If the threshold is not from 0 to 1.
    """
    if not 0 <= checked_number("threshold", threshold, "a number from 0 to 1", ConfigError) <= 1:
        raise ConfigError(f"threshold: expected a number from 0 to 1, found {threshold!r}")
    questions = _read_questions(path_of(truth))
    accidents: dict[str, list[Accident]]
    accidents = {question.sample: [] for question in questions.values()}
    for question in questions.values():
        recording = question.sample.rpartition("/")[0]
        scenario, _, agent = recording.rpartition("/")
        accidents.setdefault(sample_token(scenario, agent, question.last_frame), [])
    line_numbers: dict[str, int] = {}
    for number, answer in _read_lines(path_of(answers), _Answer, _REMEDY):
        location = f"{answers}:{number}"
        if answer.id not in questions:
            raise ResultsError(
                f"{location}: id: {_quote(answer.id)} is not in the truth file; give the "
                "truth of these questions, or remove the line"
            )
        if answer.id in line_numbers:
            raise ResultsError(
                f"{location}: id: {shortened(answer.id)} already has an answer in line "
                f"{line_numbers[answer.id]}; remove one of the two"
            )
        line_numbers[answer.id] = number
        question = questions[answer.id]
        accidents[question.sample] += _make_alarms(location, answer, question, threshold)
    return Answers(
        accidents=accidents,
        answered=len(line_numbers),
        missing=tuple(key for key in questions if key not in line_numbers),
    )


def results_of_answers(
    answers: PathType,
    truth: PathType,
    out: PathType,
    *,
    threshold: float = _DEFAULT_THRESHOLD,
    meta: ReadOnlyValues | None = None,
) -> Answers:
    """Write answers as a results file, for `evaluate accident` and `evaluate warning`.

    Args:
        answers: File of the answers, see `read_answers`.
        truth: File `truth.jsonl` of the export.
        out: Path of the results file, which must not exist.
        threshold: Threshold from 0 to 1, see `read_answers`.
        meta: Notes for readers, such as the name of the model.

    Returns:
        The answers.

    Raises:
        ResultsError: As in `read_answers`, or if `out` exists already or cannot be written.
        ConfigError: As in `read_answers`.
    """
    ResultsWriter(out, "accident")  # This raises an error if the path exists.
    converted = read_answers(answers, truth, threshold=threshold)
    facts = {
        "questions": len(converted.missing) + converted.answered,
        "answered": converted.answered,
        "threshold": threshold,
    }
    with ResultsWriter(out, "accident", meta={**facts, **(meta or {})}) as writer:
        for token, accidents in converted.accidents.items():
            writer.add(token, list(accidents))
    return converted


def _read_questions(path: Path) -> dict[str, _Question]:
    """Read the truth file; return its records by question id, in the order of the samples."""
    remedy = "give truth.jsonl of the export of the questions"
    line_remedy = f"this is not a line of a truth file; {remedy}"
    questions = [question for _, question in _read_lines(path, _Question, line_remedy)]
    if not questions:
        raise ResultsError(f"{path}: contains no question; {remedy}")
    by_id = {question.id: question for question in questions}
    return dict(sorted(by_id.items(), key=lambda item: item[1].sample))


def _read_lines(path: Path, record_type: type[Record], remedy: str) -> Iterator[tuple[int, Record]]:
    """Yield (line number from 1, record) for each line of JSON that is not blank."""
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


def _make_alarms(
    location: str, answer: _Answer, question: _Question, threshold: float
) -> list[Accident]:
    """Return a list with the answer's alarm, or an empty list if it raises none.

    All fields of the answer are checked in either case.
    """
    seconds = len(question.accident)
    scores = list(map(float, answer.accident))
    if len(scores) != seconds:
        raise ResultsError(
            f"{location}: accident: expected {seconds} times true, false or a probability from 0 "
            f"to 1, found {_quote(answer.accident)}; {_REMEDY}"
        )
    ids = _find_actor_ids(location, answer.who, question.actors)
    positions = _read_positions(location, answer.where)
    start = int(np.argmax(scores))
    score = scores[start]
    if score == 0 or score < threshold:
        return []
    if positions is None:
        raise ResultsError(f"{location}: where: is null, but an accident needs a place; {_REMEDY}")
    time = start + 0.5
    if answer.when is not None and start < answer.when <= start + 1:
        time = answer.when
    return [Accident(positions=positions, time=time, score=score, ids=ids)]


def _find_actor_ids(
    location: str, names: tuple[str | None, str | None] | None, actors: Mapping[str, int]
) -> tuple[int, int] | None:
    """Return the actor ids of two names; None if one of them is null."""
    if names is None:
        return None
    for name in names:
        if name is not None and name not in actors:
            raise ResultsError(
                f"{location}: who: {_quote(name)} is not in the question; write null for an "
                "actor that is not in the question"
            )
    first_name, second_name = names
    if first_name is None or second_name is None:
        return None
    if actors[first_name] == actors[second_name]:
        raise ResultsError(f"{location}: who: {_quote(first_name)} appears twice; {_REMEDY}")
    return actors[first_name], actors[second_name]


def _read_positions(location: str, points: list[Any] | None) -> FloatArray | None:
    """Return two positions (2, 2) in metres; one point counts twice, and no place gives None."""
    if points is None:
        return None
    if isinstance(points[0], list) != isinstance(points[1], list):
        raise ResultsError(
            f"{location}: where: expected [x, y], or [[x, y], [x, y]], found {_quote(points)}; "
            f"{_REMEDY}"
        )
    return np.broadcast_to(np.array(points, dtype=np.float64), (2, 2)).copy()


def _quote(value: object) -> str:
    return shortened(repr(value))
