"""The samples of a model that a reader chose: of a group or a scenario, the worst first, in an address."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal, get_args
from urllib.parse import urlencode

from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.evaluation.breakdowns import SampleAttributes, attribute_name, sample_attributes
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.explore.background import Job
from deepaccident_devkit.explore.choices import MOST_WORD
from deepaccident_devkit.explore.models import standings_job
from deepaccident_devkit.explore.scenarios import UNKNOWN
from deepaccident_devkit.support.text import natural_order

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.explore.explorer import Explorer
    from deepaccident_devkit.explore.models import Model

Order = Literal["worst", "best", "time"]
ORDERS: Final[Mapping[Order, str]] = {"worst": "worst first", "best": "best first", "time": "in time"}
"""Order → its name for readers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleChoices:
    """What a reader chose of a model's samples.

    Attributes:
        by: an attribute; empty for all samples.
        value: of the attribute, `unknown` where it is not known.
        scenario: token; empty for all.
        order: None for the usual one: the worst first, or in time where samples have no numbers.
    """

    by: str = ""
    value: str = ""
    scenario: str = ""
    order: Order | None = None

    @classmethod
    def of(cls, given: Mapping[str, str]) -> SampleChoices:
        """Those of the parameters of an address. Raises ChoiceError: there is no such attribute."""
        by: str = given.get("by", "")
        order: Any = given.get("order")
        return cls(
            by=attribute_name(by) if by else "",
            value=given.get("value", "")[:MOST_WORD] if by else "",
            scenario=given.get("scenario", "")[:MOST_WORD],
            order=order if order in get_args(Order) else None,
        )

    def address(self, *, ahead: int = 0, **changed: Any) -> str:
        """The parameters of the address with these choices, some changed: `?by=agent&value=ego_vehicle`.

        Args:
            ahead: the frame of a sample that is shown; 0 for the present.
            **changed: choices to change.
        """
        chosen = replace(self, **changed)
        pairs = [("by", chosen.by), ("value", chosen.value)] if chosen.by else []
        pairs += [("scenario", chosen.scenario)] * bool(chosen.scenario)
        pairs += [("order", str(chosen.order))] * (chosen.order is not None)
        pairs += [("ahead", str(ahead))] * (ahead > 0)
        return f"?{urlencode(pairs)}" if pairs else ""

    def words(self) -> str:
        """In words: `time to impact 1 s`; empty for all samples."""
        group = [f"{self.by.replace('_', ' ')} {self.value}"] if self.by else []
        return ", ".join([*group, *[self.scenario] * bool(self.scenario)])


@dataclass(frozen=True, slots=True, kw_only=True)
class Listed:
    """The samples that choices come to.

    Attributes:
        tokens: in order.
        order: in which they are.
        ranked: whether they can be in another order than in time.
        groups: value → how many samples, of the attribute of choice; empty without one, and until they are known.
        unknown: samples that are not in this release, so that nothing is known of their group.
        waits: titles of the work that is waited for.
        faults: sentences on what cannot be told.
    """

    tokens: tuple[str, ...]
    order: Order
    ranked: bool
    groups: Mapping[str, int]
    unknown: int
    waits: tuple[str, ...]
    faults: tuple[str, ...]


def listed(explorer: Explorer, model: Model, choices: SampleChoices) -> Listed:
    """The samples of a model that choices come to."""
    tokens = list(model.tokens)
    known = attributes_job(explorer, model) if choices.by else None
    ranks = standings_job(explorer.jobs, model) if model.bundle is not None else None
    jobs = [job for job in (known, ranks) if job is not None]
    waiting = [job for job in jobs if not job.is_done]  # before their results are read: what comes later is not missed
    groups: dict[str, int] = {}
    unknown = 0
    if known is not None:
        found: Mapping[str, SampleAttributes] | None = known.result
        values = {token: each.value(choices.by) or UNKNOWN for token, each in (found or {}).items()}
        groups = dict(sorted(Counter(values.values()).items(), key=lambda item: natural_order(item[0])))
        unknown = 0 if found is None else len(tokens) - len(values)
        tokens = [token for token in tokens if values.get(token) == choices.value]
    if choices.scenario:
        tokens = [token for token in tokens if scenario_of(token) == choices.scenario]
    # warnings are judged over recordings: single samples have no numbers
    ranked = ranks is not None and (ranks.result is None or any(each is not None for each in ranks.result.values()))
    order: Order = choices.order or "worst" if ranked else "time"
    return Listed(
        tokens=tuple(_ordered(tokens, order, ranks.result or {} if ranks is not None else {})),
        order=order,
        ranked=ranked,
        groups=groups,
        unknown=unknown,
        waits=tuple(job.title for job in waiting if job is known or order != "time"),
        faults=tuple(f"{job.title}: {job.error}" for job in jobs if job.state == "failed"),
    )


def _ordered(tokens: Iterable[str], order: Order, standings: Mapping[str, float | None]) -> list[str]:
    """By the main number, samples without one last; in time as long as they are not known."""
    in_time = sorted(tokens)
    chosen = set() if order == "time" else set(in_time)
    ranked = [token for token, value in standings.items() if value is not None and token in chosen]
    others = set(ranked)
    return [*(ranked if order == "worst" else ranked[::-1]), *(token for token in in_time if token not in others)]


def attributes_job(explorer: Explorer, model: Model) -> Job:
    """The work that gives the attributes of a model's samples, as far as they are in the release."""
    dataset = explorer.dataset
    return explorer.jobs.ask(
        f"attributes {model.name}",
        f"attributes of the samples of {model.name}",
        lambda: sample_attributes(dataset, [token for token in model.tokens if is_sample(dataset, token)]),
    )


def is_sample(dataset: Dataset, token: str) -> bool:
    """Whether the release has a sample."""
    try:
        dataset.getind("sample", token)
    except TokenError:
        return False
    return True
