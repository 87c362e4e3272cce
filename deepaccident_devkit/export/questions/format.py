"""The export itself: its settings, and the files that questions and truth stand in."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, get_args

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.export.bulk import Format, Output, Plan, Unit
from deepaccident_devkit.export.questions.observed import Seen
from deepaccident_devkit.export.questions.pictures import FOLDER, Pictures
from deepaccident_devkit.export.questions.recordings import AskRules, recordings
from deepaccident_devkit.export.questions.texts import answer_schema, readme
from deepaccident_devkit.export.questions.truth import why_facts
from deepaccident_devkit.export.questions.windows import WindowRules
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.reading import read_bytes
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, FRAME_PERIOD, VEHICLE_AGENTS
from deepaccident_devkit.text import Word, choice, spelled
from deepaccident_devkit.v2x.configurations import AGENT_SETS

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

QUESTIONS: Final = "questions.jsonl"
TRUTH: Final = "truth.jsonl"
_ROW_BYTES, _FACTS_BYTES = 70, 1500
"""Of an actor at a moment, and of all else in a question and its truth, about."""
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

    @property
    def _rules(self) -> AskRules:
        return AskRules(
            egos=self.agents,
            observers=self.observers,
            seen=self.seen,
            window=self.window,
            cameras=self.cameras,
            seed=self.seed,
        )

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
                "the recording (WindowRules(partial_past=True))"
            )
        return super().units(dataset, scenarios)

    def plan(self, dataset: Dataset, unit: Unit) -> Plan:
        """By the boxes in the label of each present, and the sizes of the pictures."""
        total = Plan()
        for asked in recordings(dataset, unit.scenarios[0], self._rules, Counter()):
            pictures = Pictures(asked.observations, self.cameras)
            for window in asked.windows:
                boxes, sizes = dataset.sample.get(asked.sample(window))["num_annotations"], pictures.sizes(window)
                total += Plan(
                    samples=1,
                    bytes=_FACTS_BYTES + boxes * len(window.frames) * _ROW_BYTES,
                    linked_files=len(sizes),
                    linked_bytes=sum(sizes),
                )
        return total

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Keep the questions of a scenario and their truth, a line each, and put its pictures there."""
        token, left_out, lines = unit.scenarios[0], Counter[str](), []
        asked = list(recordings(dataset, token, self._rules, left_out))
        if asked:
            why = why_facts(dataset, dataset.scenario.get(token))
            lines = [pair for each in asked for pair in each.questions(why, output)]
        for number, name in enumerate((QUESTIONS, TRUTH)):
            content = "".join(f"{json.dumps(pair[number], allow_nan=False)}\n" for pair in lines)
            write_bytes(output.parts / name, content.encode())
        for what, count in left_out.items():
            output.leave_out(what, count)

    def finish(self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]) -> None:  # noqa: ARG002 - others need the release
        """Join the questions of all scenarios, and their truth, in the order of the ids, which were drawn.

        Raises:
            NotAvailableError: there is no question at all.
        """
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
    """The lines of files in the order of their ids; in memory are their places alone.

    Raises:
        NotAvailableError: there is no line.
    """
    places: list[tuple[bytes, int, int, int]] = []
    for number, path in enumerate(paths):
        first = 0
        for line in read_bytes(path, "results").splitlines(keepends=True):
            places.append((line[_ID], number, first, len(line)))
            first += len(line)
    if not places:
        raise NotAvailableError(Questions.nothing)
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
