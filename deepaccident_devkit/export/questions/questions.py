"""The export of questions: its settings, and question and truth of each window of a recording."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeAlias, get_args

import numpy as np

from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.evaluation.accident import box_truth
from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.frames import sensor_files
from deepaccident_devkit.export.questions.answers import answer_schema, questions_readme
from deepaccident_devkit.export.questions.observed import (
    RATE,
    Observations,
    QuestionWindow,
    SeenRule,
    WindowRules,
    digest,
    names_of,
    question_facts,
)
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import AnyText, choice, choices, settle_choices, spelled
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, FRAME_PERIOD, VEHICLE_AGENTS, AgentName
from deepaccident_devkit.v2x.agents import AGENT_SETS, agents_of, cooperating_agents
from deepaccident_devkit.v2x.collisions import collision, labelled_pair
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.export.bulk import Output
    from deepaccident_devkit.export.questions.observed import Names
    from deepaccident_devkit.release.store import ReleasePath

QUESTIONS: Final = "questions.jsonl"
TRUTH: Final = "truth.jsonl"
# Characters of a line that hold the id.
_ID_SLICE: Final = slice(len('{"id": "'), len('{"id": "') + 16)
# Kinds of data that are left out.
_ABSENT_AGENTS: Final = "agents of scenarios that are not in this release"
_INCOMPLETE_RECORDINGS: Final = "recordings whose observers are not all in this release"
_SHORT_RECORDINGS: Final = "recordings that are too short for a window"
_UNLABELLED_WINDOWS: Final = "windows with a moment at which an observer has no label"
_MISSING_PICTURES: Final = "pictures that are not in this release"
# Folder in the export of everything that may be handed out.
_PUBLIC_FOLDER: Final = "questions"
# A question and its truth.
_QuestionPair: TypeAlias = tuple[dict[str, Any], dict[str, Any]]
_FRAMES_PER_SECOND: Final = round(1 / FRAME_PERIOD)
_DESIGN_FIELDS: Final = (
    "accident_type",
    "signalized",
    "spawn_side",
    "ego_direction",
    "other_direction",
)
_CONTACT_FIELDS: Final = ("sides", "speeds", "closing_speed", "impact_angle", "gap")
Seconds = list[bool | None]
"""Whether there is an accident in each second ahead; None where the recording cannot show it."""


@dataclass(frozen=True, kw_only=True)
class Questions(ShortRepr, Format):
    """Questions for language models on what happens next, given the observations of some agents.

    `questions/` holds everything that may be handed out: `questions.jsonl`, README.md,
    `answer.schema.json` and pictures. `truth.jsonl` beside it holds the answers, and the meaning of
    the neutral names. docs/exports.md describes what a question shows, and what it does not.

    Attributes:
        agents: The agents that ask, each with its own questions: the egos.
        observers: Agents that observe together with each ego: names, or one of `v2x.AGENT_SETS` as
            seen from the ego; the ego always observes.
        seen: Rule that decides what an agent sees: `released`, the released rule
            (docs/released_code.md, Visibility and attributes), `camera`, only by its cameras, or
            `annotated`, all tracked actors in its label.
        window: The windows of a recording.
        cameras: Cameras with pictures in the questions, of all observers at all moments; empty for
            none.
        link: How pictures are included: `hard` links, or copies where these are impossible; or
            `copy`. A symbolic link would show the name of the scenario.
        seed: A text from which ids and order of the questions are drawn. Do not show yours to the
            people who answer: with it and the release, ids reveal the sample of a question.

    Raises:
        ChoiceError: no such split, agent, rule, camera or kind of link.
        ConfigError: `window` is no WindowRules, or `seed` no text.
    """

    agents: tuple[str, ...] = VEHICLE_AGENTS[:1]
    observers: str | tuple[str, ...] = "single"
    seen: SeenRule = "released"
    window: WindowRules = field(default_factory=WindowRules)
    cameras: tuple[str, ...] = ()
    seed: str = "0"

    name: ClassVar[str] = "questions"
    nothing: ClassVar[str] = (
        "no question can be asked: scenarios lack labels, meta or an observer; unpack them, or "
        "choose other scenarios or agents"
    )

    def __post_init__(self) -> None:
        """Check all choices."""
        super().__post_init__()
        object.__setattr__(self, "observers", _observers(self.observers))
        settle_choices(self, {"seen": get_args(SeenRule)})
        object.__setattr__(self, "cameras", _names("cameras", self.cameras, CAMERAS))
        if not isinstance(self.window, WindowRules):
            raise ConfigError(f"window: expected WindowRules, found {type(self.window).__name__}")
        if not isinstance(self.seed, str):
            raise ConfigError(f"seed: expected a text, found {self.seed!r}")
        if self.link == "symbolic":
            raise ChoiceError(
                "link: a symbolic link shows the name of the scenario, which may tell the answer; "
                "choose hard or copy"
            )

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """Return the pictures of questions; all agents, since the observers depend on the ego."""
        return tuple(product(AGENTS, self.cameras))

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """Return the scenarios as units, one each.

        Raises:
            NotAvailableError: all of them are too short for a window.
        """
        lengths = [dataset.scenario.get(token)["num_frames"] for token in scenarios]
        if not any(map(self.window.windows, lengths)):
            raise NotAvailableError(
                f"no recording is long enough for a window of {self.window.observe:g} s: the "
                f"longest has {max(lengths) * FRAME_PERIOD:.1f} s; observe less "
                "(--observe)"
            )
        return super().units(dataset, scenarios)

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the questions of a scenario and their truth, a line each, and its pictures."""
        pairs = questions_of(dataset, unit.scenarios[0], self, output)
        output.tally.samples += len(pairs)
        _write_lines(output.parts / QUESTIONS, [question for question, _ in pairs])
        _write_lines(output.parts / TRUTH, [truth for _, truth in pairs])

    def finish(
        self,
        dataset: Dataset,  # noqa: ARG002
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],
    ) -> None:
        """Join the questions of all scenarios, and their truth, in the random order of the ids."""
        folders, rules = list(map(parts, units)), self.window
        for name, path in ((QUESTIONS, f"{_PUBLIC_FOLDER}/{QUESTIONS}"), (TRUTH, TRUTH)):
            lines = _by_id([folder / name for folder in folders])
            with output.file(path) as temporary, temporary.open("wb") as file:
                file.writelines(lines)
        text = questions_readme(
            seconds=rules.ahead, observe=rules.observe, seen=self.seen, pictures=bool(self.cameras)
        )
        output.write(f"{_PUBLIC_FOLDER}/README.md", text)
        schema = json.dumps(answer_schema(rules.ahead), indent=1)
        output.write(f"{_PUBLIC_FOLDER}/answer.schema.json", f"{schema}\n".encode())


def _write_lines(path: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Write records as JSON, a line each."""
    lines = [f"{json.dumps(record, allow_nan=False)}\n" for record in records]
    write_bytes(path, "".join(lines).encode())


def _by_id(paths: Sequence[Path]) -> Iterator[bytes]:
    """Yield the lines of files in the order of their ids; only their positions are in memory."""
    positions: list[tuple[bytes, int, int, int]] = []
    for number, path in enumerate(paths):
        start = 0
        for line in read_bytes(path, "results").splitlines(keepends=True):
            positions.append((line[_ID_SLICE], number, start, len(line)))
            start += len(line)
    for _, number, start, length in sorted(positions):
        with paths[number].open("rb") as file:
            file.seek(start)
            yield file.read(length)


def _observers(observers: str | Sequence[str]) -> str | tuple[str, ...]:
    """Return the name of a set, or agents' names in usual order; raises ChoiceError."""
    if isinstance(observers, str) and spelled(observers, AGENTS) not in AGENTS:
        return choice("observers", observers, AGENT_SETS)
    return _names("observers", observers, AGENTS)


def _names(
    argument: str, requested: str | Sequence[str], words: Sequence[AnyText]
) -> tuple[AnyText, ...]:
    """Return the requested names, each once, in their usual order; raises ChoiceError."""
    names = choices(argument, requested, words, empty=True)
    return tuple(name for name in words if name in names)


def questions_of(
    dataset: Dataset, scenario: str, form: Questions, output: Output
) -> list[_QuestionPair]:
    """Return the questions of a scenario, write their pictures, and count what is left out.

    Args:
        dataset: The release.
        scenario: Token of the scenario.
        form: The export.
        output: Output of the pictures.
    """
    record = dataset.scenario.get(scenario)
    reason = unanswerable(dataset, record)
    if reason:
        output.leave_out(reason)
        return []
    recording_agents = agents_of(dataset, scenario)
    absent = [agent for agent in form.agents if agent not in recording_agents]
    output.leave_out(_ABSENT_AGENTS, len(absent))
    jobs = []
    for ego in recording_agents:
        if ego not in form.agents:
            continue
        agents = _agents_of(dataset, scenario, ego, form.observers)
        windows = form.window.windows(record["num_frames"])
        output.leave_out(_INCOMPLETE_RECORDINGS, not agents)
        output.leave_out(_SHORT_RECORDINGS, bool(agents) and not windows)
        if agents and windows:
            jobs.append((Observations(dataset, scenario, agents, form.seen), windows))
    why = why_facts(dataset, record) if jobs else None
    pairs: list[_QuestionPair] = []
    for observations, windows in jobs:
        pairs += _pairs(observations, windows, form, why, output)
    return pairs


def _pairs(
    observations: Observations,
    windows: Sequence[QuestionWindow],
    form: Questions,
    why: Mapping[str, Any] | None,
    output: Output,
) -> Iterator[_QuestionPair]:
    """Yield question and truth of each window of a recording."""
    dataset, rules = observations.dataset, form.window
    scenario = dataset.scenario.get(observations.scenario)
    files: dict[tuple[str, str], dict[int, tuple[ReleasePath, int]]] = {
        (agent, camera): sensor_files(dataset, observations.scenario, agent, camera)
        for agent, camera in product(observations.agents, form.cameras)
    }
    for window in windows:
        if not observations.is_labelled(window):
            output.leave_out(_UNLABELLED_WINDOWS)
            continue
        sample = sample_token(observations.scenario, observations.agents[0], window.present)
        rows, paths = observations.seen_rows(window), observations.paths(window)
        names = names_of(rows, paths, observations.own_ids, window.times)
        # the same id for the same sample, observers and moments
        words = (sample, *observations.agents, f"{rules.observe:g}", str(RATE), form.seen)
        key = digest(form.seed, "question", *words)
        question = {
            "id": key,
            "seconds": rules.ahead,
            **question_facts(rows, paths, names, window, scenario),
        }
        if form.cameras:
            question["images"] = _pictures(files, form.cameras, window, names, key, output)
        yield question, {"id": key, **truth_facts(dataset, sample, names, rules.ahead, why)}


def _pictures(
    files: Mapping[tuple[str, str], Mapping[int, tuple[ReleasePath, int]]],
    cameras: Sequence[str],
    window: QuestionWindow,
    names: Names,
    question: str,
    output: Output,
) -> list[dict[str, Any]]:
    """Write the pictures of a window, and list them by time, observer and camera.

    A picture has another name in each question that shows it, so that names do not reveal questions
    of the same recording.

    Args:
        files: Agent and camera → frame → path and bytes of the image.
        cameras: The cameras.
        window: The window.
        names: Names of the observers.
        question: Id of the question.
        output: Output of the pictures.
    """
    pictures = []
    moments = enumerate(zip(window.frames, window.times, strict=True))
    for (number, (frame, time)), name, camera in product(moments, names.observers, cameras):
        file = files[names.observers[name], camera].get(frame)
        if file is None:
            output.leave_out(_MISSING_PICTURES)
            continue
        source_path, _ = file
        path = f"images/{question}/{number:02d}_{name}_{camera}.jpg"
        output.link(source_path, f"{_PUBLIC_FOLDER}/{path}", symbolic=False)
        pictures.append({"time": time, "observer": name, "camera": camera, "path": path})
    return pictures


def _agents_of(
    dataset: Dataset, scenario: str, ego: AgentName, observers: str | tuple[str, ...]
) -> tuple[AgentName, ...]:
    """Return the agents that observe with an ego; none if one is not in this (partial) release."""
    names = observers if isinstance(observers, str) else [ego, *observers]
    try:
        return cooperating_agents(dataset, sample_token(scenario, ego, 1), names)
    except NotAvailableError:
        return ()


def unanswerable(dataset: Dataset, scenario: Mapping[str, Any]) -> str | None:
    """Return why nothing can be asked about a scenario, as a plural; None if it can."""
    if scenario["weather"] is None:
        return "scenarios without meta, which says whether there is an accident"
    actors = scenario_tracks(dataset, scenario["token"]).actor_id
    if not len(actors):
        return "scenarios without labels"
    accident = scenario["collision"]
    if accident is not None and labelled_pair(accident, actors) is None:
        return "scenarios with an actor in the accident that no label shows"
    return None


def seconds_ahead(frames_to_impact: int | None, frames_to_end: int, ahead: int) -> Seconds:
    """Return whether there is an accident in each second: after n − 1, and up to n seconds.

    n counts from 1 to `ahead`. Seconds are counted in recorded frames. Nobody knows what comes
    after an impact, or after the recording: these seconds are None.
    """
    seconds: Seconds = []
    for second in range(1, ahead + 1):
        if frames_to_impact is None:
            is_recorded = second * _FRAMES_PER_SECOND <= frames_to_end
            seconds.append(False if is_recorded else None)
        else:
            impact_second = math.ceil(frames_to_impact / _FRAMES_PER_SECOND)
            seconds.append(second == impact_second if second <= impact_second else None)
    return seconds


def truth_facts(
    dataset: Dataset, sample: str, names: Names, ahead: int, contact: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return the known facts on a question's answer; raises NotAvailableError.

    They are `sample`, `last_frame`, the names, and `accident` for each second. For an accident in
    one of the seconds they are also `when`, `who` (names, None for an actor that the question does
    not show), `actor_ids`, `where` (2, 2) in the present ego frame, `last_seen` of each, and `why`;
    otherwise these are None.

    Args:
        dataset: The release.
        sample: Token of the sample.
        names: Names in the question.
        ahead: Number of seconds.
        contact: Why the accident happens, see `why_facts`.
    """
    record = dataset.sample.get(sample)
    to_impact, to_end = record["time_to_impact"], record["time_to_end"]
    scenario = dataset.scenario.get(record["scenario_token"])
    seconds = seconds_ahead(_frames(to_impact), round(to_end / FRAME_PERIOD), ahead)
    facts: dict[str, Any] = dict.fromkeys(("when", "who", "actor_ids", "where", "last_seen", "why"))
    if True in seconds:
        impact = box_truth(dataset, sample, float(ahead)).accident
        if impact is not None and impact.ids is not None:
            facts = {
                "when": round(impact.time, 1),
                "who": list(map(names.of_actor, impact.ids)),
                "actor_ids": list(impact.ids),
                "where": (np.round(impact.positions, 2) + 0.0).tolist(),
                "last_seen": [names.last_seen.get(actor) for actor in impact.ids],
                "why": contact,
            }
    return {
        "sample": sample,
        "last_frame": scenario["num_frames"],
        "observers": dict(names.observers),
        "actors": dict(names.actors),
        "accident": seconds,
        **facts,
    }


def why_facts(dataset: Dataset, scenario: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the design of an accident and how its actors met; None without a collision.

    Values are in metres, seconds, radians.
    """
    if scenario["collision"] is None:
        return None
    facts = {name: scenario[name] for name in _DESIGN_FIELDS}
    try:
        contact = collision(dataset, scenario["token"])
    except NotAvailableError:  # the two are never labelled together
        return facts | dict.fromkeys(_CONTACT_FIELDS)
    for name in _CONTACT_FIELDS:
        facts[name] = None if contact is None else _plain(getattr(contact, name))
    return facts


def _plain(value: Any) -> Any:
    """Return a value in JSON form: numbers with two decimals, None for NaN."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return list(map(_plain, value))
    if isinstance(value, float):
        if math.isnan(value):
            return None
        return round(value, 2) + 0.0
    return value


def _frames(seconds: float | None) -> int | None:
    if seconds is None:
        return None
    return round(seconds / FRAME_PERIOD)
