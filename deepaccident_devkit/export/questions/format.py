"""The export of questions: its settings, the files that questions and truth stand in, and what lies beside them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, get_args

from deepaccident_devkit._version import __version__
from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.questions.observed import Seen, WindowRules
from deepaccident_devkit.export.questions.recordings import FOLDER, questions_of
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.reading import read_bytes
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, FRAME_PERIOD, VEHICLE_AGENTS
from deepaccident_devkit.text import Word, choice, spelled
from deepaccident_devkit.v2x.configurations import AGENT_SETS

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

QUESTIONS: Final = "questions.jsonl"
TRUTH: Final = "truth.jsonl"
_ID: Final = slice(len('{"id": "'), len('{"id": "') + 16)
"""Where the id stands in a line."""


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
    seen: Seen = "released"
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
        object.__setattr__(self, "seen", choice("seen", self.seen, get_args(Seen)))
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
        if not any(self.window.windows(length, token, self.seed) for token, length in lengths.items()):
            raise NotAvailableError(
                f"no recording is long enough for a window of {self.window.observe:g} s: the longest has "
                f"{max(lengths.values()) * FRAME_PERIOD:.1f} s; observe less (--observe), or let windows begin before "
                "the recording (--partial-past)"
            )
        return super().units(dataset, scenarios)

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Keep the questions of a scenario and their truth, a line each, and put its pictures there."""
        lines = questions_of(dataset, unit.scenarios[0], self, output)
        output.tally.samples += len(lines)
        for number, name in enumerate((QUESTIONS, TRUTH)):
            content = "".join(f"{json.dumps(pair[number], allow_nan=False)}\n" for pair in lines)
            write_bytes(output.parts / name, content.encode())

    def finish(self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]) -> None:  # noqa: ARG002 - others need the release
        """Join the questions of all scenarios, and their truth, in the order of the ids, which were drawn."""
        folders, rules = [parts(unit) for unit in units], self.window
        for name, path in ((QUESTIONS, f"{FOLDER}/{QUESTIONS}"), (TRUTH, TRUTH)):
            lines = _by_id([folder / name for folder in folders])
            with output.file(path) as temporary, temporary.open("wb") as file:
                file.writelines(lines)
        text = readme(seconds=rules.ahead, observe=rules.observe, seen=self.seen, pictures=bool(self.cameras))
        output.write(f"{FOLDER}/README.md", text)
        schema = json.dumps(answer_schema(rules.ahead), indent=1)
        output.write(f"{FOLDER}/answer.schema.json", f"{schema}\n".encode())


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


def _names(argument: str, given: str | Sequence[str], words: Sequence[Word]) -> tuple[Word, ...]:
    """A name or several, each once, in their usual order; raises ChoiceError."""
    named = {choice(argument, name, words) for name in ([given] if isinstance(given, str) else given)}
    return tuple(name for name in words if name in named)


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
