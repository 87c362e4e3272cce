"""The export of questions: its settings, the recordings that can be asked about, question and truth of each window."""

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
# Where the id stands in a line.
_ID: Final = slice(len('{"id": "'), len('{"id": "') + 16)
_ABSENT: Final = "agents of scenarios that are not in this release"
_ALONE: Final = "recordings whose observers are not all in this release"
_SHORT: Final = "recordings that are too short for a window"
_UNLABELLED: Final = "windows with a moment at which an observer has no label"
# Of what may be handed out, in the export's folder.
_FOLDER: Final = "questions"
_MISSING: Final = "pictures that are not in this release"
# A question and its truth.
_QuestionPair: TypeAlias = tuple[dict[str, Any], dict[str, Any]]
_SECOND: Final = round(1 / FRAME_PERIOD)
_DESIGN: Final = ("accident_type", "signalized", "spawn_side", "ego_direction", "other_direction")
_CONTACT: Final = ("sides", "speeds", "closing_speed", "impact_angle", "gap")
Seconds = list[bool | None]
"""Whether there is an accident in each second ahead; None where the recording does not say."""


@dataclass(frozen=True, kw_only=True)
class Questions(ShortRepr, Format):
    """Questions on what happens next, about what some agents observed, for language models.

    `questions/` holds all that may be handed out: `questions.jsonl`, README.md, `answer.schema.json` and pictures.
    `truth.jsonl` beside it holds the answers, and whom the neutral names mean. docs/exports.md says what a question
    shows, and what not.

    Attributes:
        agents: the agents that ask, each with questions of its own: the egos.
        observers: who observes together with each ego: names, or one of `v2x.AGENT_SETS` as seen from the ego; the ego
            is always one of them.
        seen: what counts as seen by an agent: `released`, by the released rule (docs/released_code.md, Visibility and
            attributes), `camera`, by its cameras alone, or `annotated`, all tracked actors in its label.
        window: which windows there are.
        cameras: whose pictures go with the questions, of all observers at all moments; empty for none.
        link: how pictures are put there: `hard` links, or copies where these cannot be; or `copy`. A symbolic link
            would show the name of the scenario.
        seed: a text from which ids and order of the questions are drawn. Keep one of your own from those who answer:
            with it and the release, ids tell which sample a question is about.

    Raises:
        ChoiceError: no such split, agent, rule, camera or way.
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
        "no question can be asked: scenarios lack labels, meta or an observer; unpack them, or choose other scenarios "
        "or agents"
    )

    def __post_init__(self) -> None:
        """Check the choices too."""
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
                "link: a symbolic link shows the name of the scenario, which may tell the answer; choose hard or copy"
            )

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """The pictures that go with questions; who observes depends on the ego."""
        return tuple(product(AGENTS, self.cameras))

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """The scenarios, one each.

        Raises:
            NotAvailableError: all of them are too short for a window.
        """
        lengths = {token: dataset.scenario.get(token)["num_frames"] for token in scenarios}
        if not any(self.window.windows(length) for length in lengths.values()):
            raise NotAvailableError(
                f"no recording is long enough for a window of {self.window.observe:g} s: the longest has "
                f"{max(lengths.values()) * FRAME_PERIOD:.1f} s; observe less (--observe)"
            )
        return super().units(dataset, scenarios)

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Keep the questions of a scenario and their truth, a line each, and put its pictures there."""
        lines = questions_of(dataset, unit.scenarios[0], self, output)
        output.tally.samples += len(lines)
        for number, name in enumerate((QUESTIONS, TRUTH)):
            content = "".join(f"{json.dumps(pair[number], allow_nan=False)}\n" for pair in lines)
            write_bytes(output.parts / name, content.encode())

    def finish(
        self,
        dataset: Dataset,  # noqa: ARG002
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],
    ) -> None:
        """Join the questions of all scenarios, and their truth, in the order of the ids, which were drawn."""
        folders, rules = [parts(unit) for unit in units], self.window
        for name, path in ((QUESTIONS, f"{_FOLDER}/{QUESTIONS}"), (TRUTH, TRUTH)):
            lines = _by_id([folder / name for folder in folders])
            with output.file(path) as temporary, temporary.open("wb") as file:
                file.writelines(lines)
        text = questions_readme(
            seconds=rules.ahead, observe=rules.observe, seen=self.seen, pictures=bool(self.cameras)
        )
        output.write(f"{_FOLDER}/README.md", text)
        schema = json.dumps(answer_schema(rules.ahead), indent=1)
        output.write(f"{_FOLDER}/answer.schema.json", f"{schema}\n".encode())


def _by_id(paths: Sequence[Path]) -> Iterator[bytes]:
    """The lines of files in the order of their ids; in memory are their places alone."""
    places: list[tuple[bytes, int, int, int]] = []
    for number, path in enumerate(paths):
        first = 0
        for line in read_bytes(path, "results").splitlines(keepends=True):
            places.append((line[_ID], number, first, len(line)))
            first += len(line)
    for _, number, first, length in sorted(places):
        with paths[number].open("rb") as file:
            file.seek(first)
            yield file.read(length)


def _observers(given: str | Sequence[str]) -> str | tuple[str, ...]:
    """The name of a set, or agents' names as `Format.agents` has them; raises ChoiceError."""
    if isinstance(given, str) and spelled(given, AGENTS) not in AGENTS:
        return choice("observers", given, AGENT_SETS)
    return _names("observers", given, AGENTS)


def _names(
    argument: str, given: str | Sequence[str], words: Sequence[AnyText]
) -> tuple[AnyText, ...]:
    """A name or several, each once, in their usual order; raises ChoiceError."""
    named = choices(argument, given, words, empty=True)
    return tuple(name for name in words if name in named)


def questions_of(
    dataset: Dataset, scenario: str, form: Questions, output: Output
) -> list[_QuestionPair]:
    """The questions of a scenario, given by its token; puts the pictures there, and counts what is left out."""
    record = dataset.scenario.get(scenario)
    if reason := unanswerable(dataset, record):
        output.leave_out(reason)
        return []
    here, asked = agents_of(dataset, scenario), []
    output.leave_out(_ABSENT, sum(agent not in here for agent in form.agents))
    for ego in (agent for agent in here if agent in form.agents):
        agents = _agents_of(dataset, scenario, ego, form.observers)
        windows = form.window.windows(record["num_frames"])
        output.leave_out(_ALONE, not agents)
        output.leave_out(_SHORT, bool(agents) and not windows)
        if agents and windows:
            asked.append((Observations(dataset, scenario, agents, form.seen), windows))
    why = why_facts(dataset, record) if asked else None
    return [
        pair for observed, windows in asked for pair in _pairs(observed, windows, form, why, output)
    ]


def _pairs(
    observed: Observations,
    windows: Sequence[QuestionWindow],
    form: Questions,
    why: Mapping[str, Any] | None,
    output: Output,
) -> Iterator[_QuestionPair]:
    """Question and truth of each window of a recording that is asked about."""
    scenario, ahead, rules = (
        observed.dataset.scenario.get(observed.scenario),
        form.window.ahead,
        form.window,
    )
    files: dict[tuple[str, str], dict[int, tuple[ReleasePath, int]]] = {
        (agent, camera): sensor_files(observed.dataset, observed.scenario, agent, camera)
        for agent, camera in product(observed.agents, form.cameras)
    }
    for window in windows:
        if not observed.is_labelled(window):
            output.leave_out(_UNLABELLED)
            continue
        sample = sample_token(observed.scenario, observed.agents[0], window.present)
        seen, paths = observed.seen(window), observed.paths(window)
        names = names_of(seen, paths, observed.own_ids, window.times)
        what = (sample, *observed.agents, f"{rules.observe:g}", str(RATE), form.seen)
        key = digest(
            form.seed, "question", *what
        )  # the same for the same sample, observers and moments
        question = {
            "id": key,
            "seconds": ahead,
            **question_facts(seen, paths, names, window, scenario),
            **(
                {"images": _pictures(files, form.cameras, window, names, key, output)}
                if form.cameras
                else {}
            ),
        }
        yield question, {"id": key, **truth_facts(observed.dataset, sample, names, ahead, why)}


def _pictures(
    files: Mapping[tuple[str, str], Mapping[int, tuple[ReleasePath, int]]],
    cameras: Sequence[str],
    window: QuestionWindow,
    names: Names,
    question: str,
    output: Output,
) -> list[dict[str, Any]]:
    """Put the pictures of a window there, and list them by time, observer and camera; `question` is its id.

    A picture has a name in each question that shows it, so that questions cannot be told to be of one recording by it.
    """
    listed = []
    moments = enumerate(zip(window.frames, window.times, strict=True))
    for (number, (frame, time)), name, camera in product(moments, names.observers, cameras):
        found = files[names.observers[name], camera].get(frame)
        if found is None:
            output.leave_out(_MISSING)
            continue
        path = f"images/{question}/{number:02d}_{name}_{camera}.jpg"
        output.link(found[0], f"{_FOLDER}/{path}", symbolic=False)
        listed.append({"time": time, "observer": name, "camera": camera, "path": path})
    return listed


def _agents_of(
    dataset: Dataset, scenario: str, ego: AgentName, wanted: str | tuple[str, ...]
) -> tuple[AgentName, ...]:
    """The agents that observe with an ego; none if one of them is not in this (partial) release."""
    named = wanted if isinstance(wanted, str) else [ego, *wanted]
    try:
        return cooperating_agents(dataset, sample_token(scenario, ego, 1), named)
    except NotAvailableError:
        return ()


def unanswerable(dataset: Dataset, scenario: Mapping[str, Any]) -> str | None:
    """Why nothing can be asked about a scenario, as a plural that is counted; None if it can."""
    if scenario["weather"] is None:
        return "scenarios without meta, which says whether there is an accident"
    actors = scenario_tracks(dataset, scenario["token"]).actor_id
    if not len(actors):
        return "scenarios without labels"
    told = scenario["collision"]
    if told is not None and labelled_pair(told, actors) is None:
        return "scenarios with an actor in the accident that no label shows"
    return None


def seconds_ahead(frames_to_impact: int | None, frames_to_end: int, ahead: int) -> Seconds:
    """Whether there is an accident in each second: after n − 1 seconds, and up to n seconds, for n from 1 to `ahead`.

    Counted in recorded frames. Nobody knows what comes after an impact, or after the recording: these seconds are None.
    """
    if frames_to_impact is None:
        return [
            False if second * _SECOND <= frames_to_end else None for second in range(1, ahead + 1)
        ]
    there = math.ceil(frames_to_impact / _SECOND)
    return [second == there if second <= there else None for second in range(1, ahead + 1)]


def truth_facts(
    dataset: Dataset, sample: str, names: Names, ahead: int, contact: Mapping[str, Any] | None
) -> dict[str, Any]:
    """What is known of a question's answer; `contact` is why, as `why_facts` gives it. Raises NotAvailableError.

    `sample`, `last_frame`, the names, `accident` for each second, and for an accident in one of them `when`, `who`
    (names, None for one that the question does not show), `actor_ids`, `where` (2, 2) in the present ego frame,
    `last_seen` of each, and `why`; None where there is none.
    """
    record = dataset.sample.get(sample)
    to_impact, to_end = record["time_to_impact"], record["time_to_end"]
    scenario = dataset.scenario.get(record["scenario_token"])
    seconds = seconds_ahead(_frames(to_impact), round(to_end / FRAME_PERIOD), ahead)
    found: dict[str, Any] = dict.fromkeys(("when", "who", "actor_ids", "where", "last_seen", "why"))
    if True in seconds:
        impact = box_truth(dataset, sample, float(ahead)).accident
        if impact is not None and impact.ids is not None:
            found = {
                "when": round(impact.time, 1),
                "who": [names.of_actor(actor) for actor in impact.ids],
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
        **found,
    }


def why_facts(dataset: Dataset, scenario: Mapping[str, Any]) -> dict[str, Any] | None:
    """The design of an accident and how the two met: metres, seconds, radians; None without a collision."""
    if scenario["collision"] is None:
        return None
    design = {name: scenario[name] for name in _DESIGN}
    try:
        contact = collision(dataset, scenario["token"])
    except NotAvailableError:  # the two are never labelled together
        contact = None
    return {
        **design,
        **{name: None if contact is None else _plain(getattr(contact, name)) for name in _CONTACT},
    }


def _plain(value: Any) -> Any:
    """A value as JSON holds it: numbers with two decimals, None in place of NaN."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, 2) + 0.0
    return value


def _frames(seconds: float | None) -> int | None:
    return None if seconds is None else round(seconds / FRAME_PERIOD)
