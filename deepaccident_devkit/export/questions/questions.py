"""The export of questions: its settings, and one question with its truth for each window."""

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
from deepaccident_devkit.export.frames import FrameFiles, sensor_files
from deepaccident_devkit.export.questions.answers import format_questions_readme, make_answer_schema
from deepaccident_devkit.export.questions.observed import (
    RATE,
    Facts,
    Observations,
    QuestionWindow,
    SeenRule,
    WindowRules,
    choose_names,
    compute_digest,
    describe_window,
)
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import (
    AnyText,
    choice,
    choices,
    match_spelling,
    settle_choices,
)
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, FRAME_PERIOD, VEHICLE_AGENTS
from deepaccident_devkit.v2x.agents import AGENT_SETS, agents_of, cooperating_agents
from deepaccident_devkit.v2x.collisions import collision, labelled_pair
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.export.bulk import Output
    from deepaccident_devkit.export.questions.observed import Names

QUESTIONS: Final = "questions.jsonl"
TRUTH: Final = "truth.jsonl"
# Position of the id in a line, as indices of characters.
_ID_SLICE = slice(len('{"id": "'), len('{"id": "') + 16)
# Kinds of data that are left out.
_ABSENT_AGENTS = "agents of scenarios that are not in this release"
_INCOMPLETE_RECORDINGS = "recordings whose observers are not all in this release"
_SHORT_RECORDINGS = "recordings that are too short for a window"
_UNLABELLED_WINDOWS = "windows with a moment at which an observer has no label"
_MISSING_PICTURES = "pictures that are not in this release"
# Folder of the export that holds everything that may be handed out.
_PUBLIC_FOLDER = "questions"
# A question and its truth.
_QuestionPair: TypeAlias = tuple[Facts, Facts]
_FRAMES_PER_SECOND = round(1 / FRAME_PERIOD)
_DESIGN_FIELDS = (
    "accident_type",
    "signalized",
    "spawn_side",
    "ego_direction",
    "other_direction",
)
_CONTACT_FIELDS = ("sides", "speeds", "closing_speed", "impact_angle", "gap")
Seconds = list[bool | None]
"""Whether an accident happens in each second ahead; None if the recording does not show it."""


@dataclass(frozen=True, kw_only=True)
class Questions(ShortRepr, Format):
    """Questions for language models on what happens next, given the observations of some agents.

    `questions/` holds everything that may be handed out: `questions.jsonl`, README.md,
    `answer.schema.json` and pictures. `truth.jsonl` beside it holds the answers and the meaning of
    the neutral names. docs/exports.md describes what a question shows, and what it does not.

    Attributes:
        agents: Agents that ask, each with its own questions: the egos.
        observers: Agents that observe together with each ego: names, or one of `v2x.AGENT_SETS` as
            seen from the ego; the ego always observes.
        seen: Rule that decides what an agent sees: `released`, the released rule
            (docs/released_code.md, Visibility and attributes), `camera`, only what its cameras see,
            or `annotated`, all tracked actors in its label.
        window: Rules that select the windows of a recording.
        cameras: Cameras that a question has pictures of, from all observers at all moments; empty
            for none.
        link: Way to include pictures: `hard` links, or copies where these are impossible; or
            `copy`. A symbolic link would show the name of the scenario.
        seed: Text from which the ids and the order of the questions are drawn. Do not show yours to
            the people who answer: with it and the release, ids reveal the sample of a question.

    Raises:
        ChoiceError: If there is no such split, agent, rule, camera or kind of link.
        ConfigError: If `window` is not a `WindowRules`, or `seed` is not a text.
    """

    agents: tuple[str, ...] = VEHICLE_AGENTS[:1]
    observers: str | tuple[str, ...] = "single"
    seen: SeenRule = "released"
    window: WindowRules = field(default_factory=WindowRules)
    cameras: tuple[str, ...] = ()
    seed: str = "0"

    name: ClassVar[str] = "questions"
    empty_reason: ClassVar[str] = (
        "no question can be asked: scenarios lack labels, meta or an observer; unpack them, or "
        "choose other scenarios or agents"
    )

    def __post_init__(self) -> None:
        """Check all choices."""
        super().__post_init__()
        observers = self.observers
        if isinstance(observers, str) and match_spelling(observers, AGENTS) not in AGENTS:
            observers = choice("observers", observers, AGENT_SETS)
        else:
            observers = _check_names("observers", observers, AGENTS)
        object.__setattr__(self, "observers", observers)
        settle_choices(self, {"seen": get_args(SeenRule)})
        object.__setattr__(self, "cameras", _check_names("cameras", self.cameras, CAMERAS))
        if not isinstance(self.window, WindowRules):
            raise ConfigError(f"window: expected WindowRules, found {type(self.window).__name__}")
        if not isinstance(self.seed, str):
            raise ConfigError(f"seed: expected text, found {self.seed!r}")
        if self.link == "symbolic":
            raise ChoiceError(
                "link: a symbolic link shows the name of the scenario, which may give the "
                "answer away; choose hard or copy"
            )

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """Return the cameras with pictures, for all agents, since observers depend on the ego."""
        return tuple(product(AGENTS, self.cameras))

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """Return the scenarios as units of one scenario each.

        Raises:
            NotAvailableError: If all scenarios are too short for a window.
        """
        lengths = [dataset.scenario.get(token)["num_frames"] for token in scenarios]
        if not any(map(self.window.windows, lengths)):
            raise NotAvailableError(
                f"no recording is long enough for a window of {self.window.observe:g} s: the "
                f"longest has {max(lengths) * FRAME_PERIOD:.1f} s; choose a shorter window "
                "(--observe)"
            )
        return super().units(dataset, scenarios)

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the questions of a scenario and their truth, one on each line, and the pictures."""
        pairs = make_questions(dataset, unit.scenarios[0], self, output)
        output.tally.samples += len(pairs)
        questions = [question for question, _ in pairs]
        truths = [truth for _, truth in pairs]
        _write_lines(output.parts / QUESTIONS, questions)
        _write_lines(output.parts / TRUTH, truths)

    def finish(
        self,
        dataset: Dataset,  # noqa: ARG002
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],
    ) -> None:
        """Join the questions of all scenarios, and their truth, in the random order of the ids."""
        folders = list(map(parts, units))
        rules = self.window
        paths = {QUESTIONS: f"{_PUBLIC_FOLDER}/{QUESTIONS}", TRUTH: TRUTH}
        for name, path in paths.items():
            lines = _sort_lines([folder / name for folder in folders])
            with output.file(path) as temporary, temporary.open("wb") as file:
                file.writelines(lines)
        text = format_questions_readme(
            seconds=rules.ahead, observe=rules.observe, seen=self.seen, pictures=bool(self.cameras)
        )
        output.write(f"{_PUBLIC_FOLDER}/README.md", text)
        schema = json.dumps(make_answer_schema(rules.ahead), indent=1)
        output.write(f"{_PUBLIC_FOLDER}/answer.schema.json", f"{schema}\n".encode())


def _write_lines(path: Path, records: Sequence[ReadOnlyValues]) -> None:
    """Write records as JSON, one on each line."""
    lines = []
    for record in records:
        lines.append(f"{json.dumps(record, allow_nan=False)}\n")
    write_bytes(path, "".join(lines).encode())


def _sort_lines(paths: Sequence[Path]) -> Iterator[bytes]:
    """Yield the lines of files in the order of their ids; only their positions are in memory."""
    positions = []
    for number, path in enumerate(paths):
        start = 0
        for line in read_bytes(path, "results").splitlines(keepends=True):
            positions.append((line[_ID_SLICE], number, start, len(line)))
            start += len(line)
    for _, number, start, length in sorted(positions):
        with paths[number].open("rb") as file:
            file.seek(start)
            yield file.read(length)


def _check_names(
    argument: str, requested: str | Sequence[str], words: Sequence[AnyText]
) -> tuple[AnyText, ...]:
    """Return the requested names once each, in their usual order; raise ChoiceError if unknown."""
    names = choices(argument, requested, words, empty=True)
    return tuple(name for name in words if name in names)


def make_questions(
    dataset: Dataset, scenario: str, form: Questions, output: Output
) -> list[_QuestionPair]:
    """Make a scenario's questions with their truth, and write the questions' pictures.

    Args:
        dataset: The release.
        scenario: Token of the scenario.
        form: Settings of the export.
        output: Where the pictures are written, and what is left out is counted.
    """
    record = dataset.scenario.get(scenario)
    reason = explain_omission(dataset, record)
    if reason:
        output.leave_out(reason)
        return []
    recording_agents = agents_of(dataset, scenario)
    absent = [agent for agent in form.agents if agent not in recording_agents]
    output.leave_out(_ABSENT_AGENTS, len(absent))
    windows = form.window.windows(record["num_frames"])
    all_observations = []
    for ego in recording_agents:
        if ego not in form.agents:
            continue
        observers = form.observers if isinstance(form.observers, str) else (ego, *form.observers)
        try:
            agents = cooperating_agents(dataset, sample_token(scenario, ego, 1), observers)
        except NotAvailableError:
            output.leave_out(_INCOMPLETE_RECORDINGS)
            continue
        if windows:
            all_observations.append(Observations(dataset, scenario, agents, form.seen))
        else:
            output.leave_out(_SHORT_RECORDINGS)
    if not all_observations:
        return []
    accident = describe_accident(dataset, record)
    pairs: list[_QuestionPair] = []
    for observations in all_observations:
        pairs += _make_pairs(observations, windows, form, accident, output)
    return pairs


def _make_pairs(
    observations: Observations,
    windows: Sequence[QuestionWindow],
    form: Questions,
    accident: ReadOnlyValues | None,
    output: Output,
) -> Iterator[_QuestionPair]:
    """Yield the question and the truth of each window of a recording."""
    dataset = observations.dataset
    rules = form.window
    scenario = dataset.scenario.get(observations.scenario)
    files: dict[tuple[str, str], FrameFiles] = {
        (agent, camera): sensor_files(dataset, observations.scenario, agent, camera)
        for agent, camera in product(observations.agents, form.cameras)
    }
    for window in windows:
        if not observations.is_labelled(window):
            output.leave_out(_UNLABELLED_WINDOWS)
            continue
        sample = sample_token(observations.scenario, observations.agents[0], window.present)
        rows = observations.collect_seen_rows(window)
        paths = observations.collect_paths(window)
        names = choose_names(rows, paths, observations.own_ids, window.times)
        # Questions about the same sample, observers and moments have the same id.
        words = (sample, *observations.agents, f"{rules.observe:g}", str(RATE), form.seen)
        key = compute_digest(form.seed, "question", *words)
        question = {
            "id": key,
            "seconds": rules.ahead,
            **describe_window(rows, paths, names, window, scenario),
        }
        if form.cameras:
            question["images"] = _write_pictures(files, form.cameras, window, names, key, output)
        truth = describe_truth(dataset, sample, names, rules.ahead, accident)
        yield question, {"id": key, **truth}


def _write_pictures(
    files: Mapping[tuple[str, str], FrameFiles],
    cameras: Sequence[str],
    window: QuestionWindow,
    names: Names,
    question: str,
    output: Output,
) -> list[Facts]:
    """Write the pictures of a window, and list them by time, observer and camera.

    A picture has a different name in each question that shows it, so that names do not reveal which
    questions are about the same recording.

    Args:
        files: Path and bytes of each image, by agent and camera, then by frame.
        cameras: Cameras with pictures in the question.
        window: Moments of the question.
        names: Names of the observers.
        question: Id of the question.
        output: Output that gets the pictures.
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


def explain_omission(dataset: Dataset, scenario: ReadOnlyValues) -> str | None:
    """Name the kind of scenario, if it is one without questions; None for all others."""
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
    """Return whether there is an accident in each second from 1 to `ahead`.

    Second n begins after n − 1 seconds and ends after n seconds, counted in recorded frames. What
    happens after an impact or after the recording is unknown, so these seconds are None.
    """
    numbers = range(1, ahead + 1)
    if frames_to_impact is None:
        num_recorded = frames_to_end // _FRAMES_PER_SECOND
        return [False if number <= num_recorded else None for number in numbers]
    impact_second = math.ceil(frames_to_impact / _FRAMES_PER_SECOND)
    seconds = []
    for number in numbers:
        seconds.append(number == impact_second if number <= impact_second else None)
    return seconds


def describe_truth(
    dataset: Dataset, sample: str, names: Names, ahead: int, contact: ReadOnlyValues | None
) -> Facts:
    """Return what is known about the answer to a question.

    The fields are `sample`, `last_frame`, the names, and `accident` for each second. If there is an
    accident in one of the seconds, there are also `when`, `who` (names; None for an actor that the
    question does not show), `actor_ids`, `where` (2, 2) in the ego frame at t = 0, `last_seen` of
    each actor, and `why`; otherwise these are None.

    Args:
        dataset: The release.
        sample: Token of the sample.
        names: Names in the question.
        ahead: Number of seconds.
        contact: Description of the accident, see `describe_accident`.

    Raises:
        NotAvailableError: As in `box_truth`.
    """
    record = dataset.sample.get(sample)
    scenario = dataset.scenario.get(record["scenario_token"])
    frames_to_end = round(record["time_to_end"] / FRAME_PERIOD)
    frames_to_impact = None
    if record["time_to_impact"] is not None:
        frames_to_impact = round(record["time_to_impact"] / FRAME_PERIOD)
    seconds = seconds_ahead(frames_to_impact, frames_to_end, ahead)
    facts: Facts = dict.fromkeys(("when", "who", "actor_ids", "where", "last_seen", "why"))
    if True in seconds:
        impact = box_truth(dataset, sample, float(ahead)).accident
        if impact is not None and impact.ids is not None:
            name_by_actor = {actor: name for name, actor in names.actors.items()}
            facts = {
                "when": round(impact.time, 1),
                "who": list(map(name_by_actor.get, impact.ids)),
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


def describe_accident(dataset: Dataset, scenario: ReadOnlyValues) -> Facts | None:
    """Describe an accident's design and how its actors collide; None without a collision.

    Values are in metres, seconds and radians.
    """
    if scenario["collision"] is None:
        return None
    facts = {name: scenario[name] for name in _DESIGN_FIELDS}
    try:
        contact = collision(dataset, scenario["token"])
    except NotAvailableError:  # No label shows both actors.
        contact = None
    for name in _CONTACT_FIELDS:
        facts[name] = None if contact is None else _to_json_value(getattr(contact, name))
    return facts


def _to_json_value(value: Any) -> Any:
    """Convert a value for JSON: numbers get two decimals, and NaN becomes None."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return list(map(_to_json_value, value))
    if isinstance(value, float):
        if math.isnan(value):
            return None
        return round(value, 2) + 0.0
    return value
