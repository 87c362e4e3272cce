"""Answers to questions, read back as accidents, which `evaluate accident` and `evaluate warning` take."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, ShortRepr, checked_number
from deepaccident_devkit.errors import ConfigError, ResultsError
from deepaccident_devkit.evaluation import Accident
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.files import path_of
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.reading import fault_text, read_bytes, shortened
from deepaccident_devkit.tables.tokens import sample_token

_REQUIRED: Final = ("id", "accident", "who", "where")
_OPTIONAL: Final = ("when", "why")
_OF_TRUTH: Final = ("id", "sample", "last_frame", "accident", "actors")
_REMEDY: Final = "mend that line; README.md beside the questions says what an answer is"
_FARTHEST: Final = 1e6
"""Metres and seconds: larger numbers are mistakes."""
_SURE: Final = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers(ShortRepr):
    """The alarms that answers raise.

    Attributes:
        accidents: token of each sample that was asked about → its alarms, at most one. The last frame of each recording
            is there too, without an alarm: nothing is asked there, and evaluations of warnings have it.
        answered: questions with an answer.
        missing: ids of the questions without an answer, which raise no alarm.
    """

    accidents: Mapping[str, Sequence[Accident]]
    answered: int
    missing: tuple[str, ...]

    @property
    def alarms(self) -> int:
        """How many there are."""
        return sum(map(len, self.accidents.values()))


def read_answers(
    answers: str | os.PathLike[str], truth: str | os.PathLike[str], *, threshold: float = _SURE
) -> Answers:
    """Read answers, a line of JSON each, against the truth file of their questions.

    An answer raises an alarm if it gives at least one second a probability of at least `threshold`, and above 0; true
    is 1. The alarm is for the likeliest second, of several the earliest: its score is the probability, its time `when`
    if that is in this second, else the middle of the second.

    Args:
        answers: the file of the answers; README.md beside the questions says what an answer is.
        truth: `truth.jsonl` of the export.
        threshold: from 0 to 1; 0 keeps all alarms, for curves over the score.

    Raises:
        ResultsError: a file cannot be read, a line is no answer, a question is answered twice, or there is no question
            of an id; the message names file and line.
        ConfigError: the threshold is not from 0 to 1.
    """
    if not 0 <= checked_number("threshold", threshold, "a number from 0 to 1", ConfigError) <= 1:
        raise ConfigError(f"threshold: expected a number from 0 to 1, found {threshold!r}")
    asked = _asked(path_of(truth))
    accidents: dict[str, list[Accident]] = {each["sample"]: [] for each in asked.values()}
    for each in asked.values():
        recording = each["sample"].rpartition("/")[0]
        scenario, _, agent = recording.rpartition("/")
        accidents.setdefault(sample_token(scenario, agent, each["last_frame"]), [])
    lines: dict[str, int] = {}
    for number, answer in _lines(path_of(answers)):
        where = f"{answers}:{number}"
        question = _question(where, answer, asked)
        if (first := lines.setdefault(answer["id"], number)) != number:
            raise ResultsError(
                f"{where}: id: {answer['id']} is answered in line {first} already; leave one of them out"
            )
        accidents[question["sample"]] += _alarms(where, answer, question, threshold)
    return Answers(accidents=accidents, answered=len(lines), missing=tuple(key for key in asked if key not in lines))


def results_of_answers(
    answers: str | os.PathLike[str],
    truth: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    threshold: float = _SURE,
    meta: Mapping[str, Any] | None = None,
) -> Answers:
    """Write a results file of what answers say, for `evaluate accident` and `evaluate warning`.

    Args:
        answers: as of `read_answers`.
        truth: likewise.
        out: the results file, which must not be there.
        threshold: as of `read_answers`.
        meta: what readers should know, such as the name of the model.

    Returns:
        What was read.

    Raises:
        ResultsError: as of `read_answers`; or something stands at `out`, or it cannot be written.
        ConfigError: as of `read_answers`.
    """
    ResultsWriter(out, "accident")  # refuses a path that is taken
    read = read_answers(answers, truth, threshold=threshold)
    said = {"questions": len(read.missing) + read.answered, "answered": read.answered, "threshold": threshold}
    with ResultsWriter(out, "accident", meta={**said, **(meta or {})}) as writer:
        for token, accidents in read.accidents.items():
            writer.add(token, list(accidents))
    return read


def _asked(path: Path) -> dict[str, Mapping[str, Any]]:
    """Id → the line of the truth file, in the order of the samples."""
    found = {}
    for number, line in _lines(path):
        if not all(name in line for name in _OF_TRUTH):
            raise ResultsError(
                f"{path}:{number}: is no line of a truth file; give truth.jsonl of the export of the questions"
            )
        found[line["id"]] = line
    if not found:
        raise ResultsError(f"{path}: holds no question; give truth.jsonl of the export of the questions")
    return dict(sorted(found.items(), key=lambda each: str(each[1]["sample"])))


def _lines(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """The objects of a file of JSON lines with their numbers, from 1; blank lines are passed over."""
    try:
        content = read_bytes(path, "results")
    except OSError as error:
        raise ResultsError(f"{path}: {fault_text(error)}; give a file of JSON lines that can be read") from error
    for number, line in enumerate(content.split(b"\n"), start=1):
        if not line.strip():
            continue
        try:
            value = parsed_json(line)
        except ValueError as error:
            raise ResultsError(f"{path}:{number}: {error}; {_REMEDY}") from error
        if not isinstance(value, dict):
            raise ResultsError(f"{path}:{number}: expected a JSON object, found {_shown(value)}; {_REMEDY}")
        yield number, value


def _question(where: str, answer: Mapping[str, Any], asked: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any]:
    """The question that a line answers; checks which fields there are."""
    for name in _REQUIRED:
        if name not in answer:
            raise ResultsError(f"{where}: {name}: is missing; {_REMEDY}")
    for name in answer:
        if name not in (*_REQUIRED, *_OPTIONAL):
            raise ResultsError(f"{where}: {shortened(name)}: is no field of an answer; {_REMEDY}")
    key = answer["id"]
    if not isinstance(key, str) or key not in asked:
        raise ResultsError(
            f"{where}: id: {_shown(key)} is no question of the truth file; give the truth of these questions, or leave "
            "the line out"
        )
    return asked[key]


def _alarms(where: str, answer: Mapping[str, Any], question: Mapping[str, Any], threshold: float) -> list[Accident]:
    """The alarm of an answer, if it raises one; all of its fields are checked in either case."""
    scores = _scores(where, answer["accident"], len(question["accident"]))
    ids, positions = _who(where, answer["who"], question["actors"]), _where(where, answer["where"])
    when = answer.get("when")
    if when is not None and not _is_number(when, 0):
        raise ResultsError(f"{where}: when: expected seconds from 0, or null, found {_shown(when)}; {_REMEDY}")
    best = int(np.argmax(scores))
    if scores[best] == 0 or scores[best] < threshold:
        return []
    if positions is None:
        raise ResultsError(f"{where}: where: is null, but an accident needs a place; {_REMEDY}")
    time = when if when is not None and best < when <= best + 1 else best + 0.5
    return [Accident(positions=positions, time=float(time), score=scores[best], ids=ids)]


def _scores(where: str, given: object, seconds: int) -> list[float]:
    scores = given if isinstance(given, list) else []
    if len(scores) != seconds or not all(isinstance(each, bool) or _is_number(each, 0, 1) for each in scores):
        raise ResultsError(
            f"{where}: accident: expected {seconds} times true, false or a probability from 0 to 1, found "
            f"{_shown(given)}; {_REMEDY}"
        )
    return [float(each) for each in scores]


def _who(where: str, given: object, actors: Mapping[str, int]) -> tuple[int, int] | None:
    """The actor ids of two names; None if one of them is not known."""
    if given is None:
        return None
    if not isinstance(given, list) or len(given) != 2:
        raise ResultsError(f"{where}: who: expected two names, or null, found {_shown(given)}; {_REMEDY}")
    for name in given:
        if name is not None and (not isinstance(name, str) or name not in actors):
            raise ResultsError(
                f"{where}: who: {_shown(name)} is nobody in the question; write null for one that it does not show"
            )
    first, second = (None if name is None else actors[name] for name in given)
    if first is not None and first == second:
        raise ResultsError(f"{where}: who: {_shown(given[0])} stands there twice; {_REMEDY}")
    return None if first is None or second is None else (first, second)


def _where(where: str, given: object) -> FloatArray | None:
    """Two points (2, 2), metres, also of a single one; None for no place."""
    if given is None:
        return None
    points = [given, given] if isinstance(given, list) and not any(isinstance(each, list) for each in given) else given
    good = isinstance(points, list) and len(points) == 2 and all(_is_point(each) for each in points)
    if not good:
        raise ResultsError(
            f"{where}: where: expected [x, y], or [[x, y], [x, y]], of metres up to {_FARTHEST:,.0f}, or null, found "
            f"{_shown(given)}; {_REMEDY}"
        )
    return np.array(points, dtype=np.float64)


def _is_point(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(_is_number(each, -_FARTHEST) for each in value)


def _is_number(value: object, least: float, most: float = _FARTHEST) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most


def _shown(value: object) -> str:
    return shortened(repr(value))
