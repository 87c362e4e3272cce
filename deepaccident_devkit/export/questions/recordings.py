"""The recordings that can be asked about, and the question and the truth of each of their windows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.export.questions.observed import Observations, Seen
from deepaccident_devkit.export.questions.pictures import Pictures
from deepaccident_devkit.export.questions.question import names_of, question_facts
from deepaccident_devkit.export.questions.truth import truth_facts, unanswerable
from deepaccident_devkit.export.questions.windows import Window, WindowRules, digest
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AgentName
from deepaccident_devkit.v2x.configurations import agents_of, cooperating_agents

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.export.bulk import Output

_ABSENT: Final = "agents of scenarios that are not in this release"
_ALONE: Final = "recordings whose observers are not all in this release"
_SHORT: Final = "recordings that are too short for a window"
_UNLABELLED: Final = "windows with a moment at which an observer has no label"


@dataclass(frozen=True, slots=True, kw_only=True)
class AskRules:
    """What is asked, and of whom; `Questions` says what the values are.

    Attributes:
        egos: the agents that ask.
        observers: who observes together with each of them.
        seen: what counts as seen.
        window: which windows there are.
        cameras: whose pictures go with the questions.
        seed: from which ids are drawn.
    """

    egos: tuple[str, ...]
    observers: str | tuple[str, ...]
    seen: Seen
    window: WindowRules
    cameras: tuple[str, ...]
    seed: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """A recording that is asked about.

    Attributes:
        observations: of its observers, the ego first.
        windows: in the order of time.
        rules: of the questions.
    """

    observations: Observations
    windows: Sequence[Window]
    rules: AskRules

    def sample(self, window: Window) -> str:
        """The token of a window's present."""
        return sample_token(self.observations.scenario, self.observations.agents[0], window.present)

    def questions(
        self, why: Mapping[str, Any] | None, output: Output
    ) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
        """Question and truth of each window; puts the pictures there, and counts what is left out.

        Args:
            why: of the truth (`truth.why_facts`).
            output: where pictures and counts go.
        """
        observed, pictures = self.observations, Pictures(self.observations, self.rules.cameras)
        scenario = observed.dataset.scenario.get(observed.scenario)
        for window in self.windows:
            if not observed.is_labelled(window):
                output.leave_out(_UNLABELLED)
                continue
            seen, paths = observed.seen(window), observed.paths(window)
            names = names_of(seen, paths, observed.own_ids, window.times)
            key, ahead = self._id(window), self.rules.window.ahead
            question = {
                "id": key,
                "seconds": ahead,
                **question_facts(seen, paths, names, window, scenario),
                **({"images": pictures.put(window, names, key, output)} if self.rules.cameras else {}),
            }
            yield question, {"id": key, **truth_facts(observed.dataset, self.sample(window), names, ahead, why)}

    def _id(self, window: Window) -> str:
        """The same for the same sample, observers and moments."""
        rules, agents = self.rules.window, self.observations.agents
        what = (self.sample(window), *agents, f"{rules.observe:g}", str(rules.rate), self.rules.seen)
        return digest(self.rules.seed, "question", *what)


def recordings(dataset: Dataset, scenario: str, rules: AskRules, left_out: Counter[str]) -> Iterator[Asked]:
    """The recordings of a scenario, given by its token, that can be asked about; the others are counted."""
    record = dataset.scenario.get(scenario)
    reason = unanswerable(dataset, record)
    if reason is not None:
        left_out[reason] += 1
        return
    here = agents_of(dataset, scenario)
    left_out[_ABSENT] += sum(agent not in here for agent in rules.egos)
    for ego in (agent for agent in here if agent in rules.egos):
        agents = _observers(dataset, scenario, ego, rules.observers)
        windows = rules.window.windows(record["num_frames"], f"{scenario}/{ego}", rules.seed)
        left_out[_ALONE] += not agents
        left_out[_SHORT] += bool(agents) and not windows
        if agents and windows:
            observations = Observations(dataset, scenario, agents, rules.seen)
            yield Asked(observations=observations, windows=windows, rules=rules)


def _observers(dataset: Dataset, scenario: str, ego: AgentName, wanted: str | tuple[str, ...]) -> tuple[AgentName, ...]:
    """The agents that observe with an ego; none if one of them is not in this (partial) release."""
    named = wanted if isinstance(wanted, str) else [ego, *wanted]
    try:
        return cooperating_agents(dataset, sample_token(scenario, ego, 1), named)
    except NotAvailableError:
        return ()
