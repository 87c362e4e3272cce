"""How long before an accident's impact sets of agents first observe both colliders, and what each partner adds.

First of an accident, then of all accidents of a release.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.collisions.recorded import (
    Skipped,
    accident_of,
    counted_text,
    each_scenario,
    reasons_text,
    skipped_rows,
    those_of,
)
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.descriptions.observation import (
    ObservationRule,
    coalition_members,
    first_together,
    leads_from,
    observed_actors,
    shapley_values,
)
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays, IntArray, known
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import columns_text, counted
from deepaccident_devkit.taxonomy import AGENTS, AgentName, short_name

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

_EGO: Final = AGENTS[0]
PARTNERS: Final = AGENTS[1:]
"""The agents that can join `ego_vehicle`."""
CAVEAT: Final = "Observation bounds warning from above; it is no prediction."
_RESAMPLES: Final = 2000
_CONFIDENCE: Final = 0.95
# Accidents of which a mean has an interval.
_FEWEST: Final = 6
_OF_ACCIDENT: Final = (
    "scenario",
    "actor_ids",
    "categories",
    "colliding_agents",
    "ego_collides",
    "missing",
    "num_frames",
    "touching",
)


_MEMBERS: Final = coalition_members(len(PARTNERS))
COALITIONS: Final[tuple[tuple[AgentName, ...], ...]] = tuple(
    (_EGO, *(name for name, joins in zip(PARTNERS, row, strict=True) if joins))
    for row in _MEMBERS.tolist()
)
"""The sixteen sets of agents with the ego; partner i belongs to those whose number has bit i."""
# Numbers of the sets of the ego and one partner.
_ALONE: Final = [1 << partner for partner in range(len(PARTNERS))]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeadTimes(FrozenArrays):
    """When sets of agents first observe both colliders of an accident; arrays are read-only.

    What is seen bounds a warning from above. It is no prediction: who sees both need not see that they will collide.

    Attributes:
        scenario: token.
        rule: when an actor counts as observed.
        actor_ids: CARLA ids of the colliders, in the meta file's order.
        categories: their classes.
        colliding_agents: the agents that they are; None for one that records nothing.
        missing: agents without labels in this release.
        num_frames: of the recording; the last one counts as the impact.
        touching: seconds from the frame at which the outlines begin to touch to the last one; None if they never do.
        first_frames: (16,) int64 for each of `COALITIONS`, the number (from 1) of the first frame at which it observes
            both; 0 for one that never does, and for one with a missing agent.
        leads: (16,) seconds from that frame to the last one; 0 for one that never does, NaN with a missing agent.
        shapley: (4,) seconds: of each of `PARTNERS` its Shapley value of the gain over the ego alone, among the
            partners that are there; NaN for a missing one.
    """

    scenario: str
    rule: ObservationRule
    actor_ids: tuple[int, int]
    categories: tuple[str, str]
    colliding_agents: tuple[AgentName | None, AgentName | None]
    missing: tuple[AgentName, ...]
    num_frames: int
    touching: float | None
    first_frames: IntArray
    leads: FloatArray
    shapley: FloatArray

    @property
    def ego_collides(self) -> bool:
        """Whether the ego is one of the colliders."""
        return _EGO in self.colliding_agents

    @property
    def alone(self) -> float:
        """Seconds of the ego alone."""
        return float(self.leads[0])

    @property
    def together(self) -> float:
        """Seconds of all agents that are there."""
        return float(self.leads[self._everyone])

    @property
    def never_alone(self) -> bool:
        """Whether the ego alone never observes both at the same frame."""
        return not self.first_frames[0]

    @property
    def never_together(self) -> bool:
        """Whether all agents that are there never observe both at the same frame."""
        return not self.first_frames[self._everyone]

    @property
    def from_the_start(self) -> bool:
        """Whether all agents that are there observe both from the first frame on: the recording may cut it."""
        return int(self.first_frames[self._everyone]) == 1

    @property
    def gains(self) -> FloatArray:
        """(4,) seconds that each of `PARTNERS` adds to the ego alone; NaN for a missing one."""
        return np.asarray(self.leads[_ALONE] - self.leads[0])

    @property
    def losses(self) -> FloatArray:
        """(4,) seconds that all agents lose without each of `PARTNERS`; NaN for a missing one."""
        without = [self._everyone & ~bit for bit in _ALONE]
        return np.where(np.isnan(self.gains), np.nan, self.together - self.leads[without])

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known, and for the first frame of a set that never observes both."""
        names = ["+".join(members) for members in COALITIONS]
        frames = [number or None for number in self.first_frames.tolist()]
        return {
            "scenario": self.scenario,
            "actor_ids": list(self.actor_ids),
            "categories": list(self.categories),
            "colliding_agents": list(self.colliding_agents),
            "ego_collides": self.ego_collides,
            "missing": list(self.missing),
            "num_frames": self.num_frames,
            "touching": self.touching,
            "lead_seconds": dict(zip(names, known(self.leads), strict=True)),
            "first_frames": dict(zip(names, frames, strict=True)),
            "gain_seconds": dict(zip(PARTNERS, known(self.gains), strict=True)),
            "loss_seconds": dict(zip(PARTNERS, known(self.losses), strict=True)),
            "shapley_seconds": dict(zip(PARTNERS, known(self.shapley), strict=True)),
        }

    @property
    def _everyone(self) -> int:
        return sum(
            bit for bit, name in zip(_ALONE, PARTNERS, strict=True) if name not in self.missing
        )


def lead_times(
    dataset: Dataset, scenario: RowArgument, rule: ObservationRule | None = None
) -> LeadTimes | None:
    """When each set of agents with `ego_vehicle` first observes both colliders of an accident.

    Args:
        dataset: the release.
        scenario: token or record.
        rule: when an actor counts as observed; None for `ObservationRule()`.

    Returns:
        None if the meta file names no collision.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: as of `accident_of`, or `ego_vehicle` has no labels in this release.
    """
    accident = accident_of(dataset, scenario)
    if accident is None:
        return None
    rule = rule or ObservationRule()
    there, observed = observed_actors(dataset, accident.scenario, accident.actor_ids, rule)
    if _EGO not in there:
        raise NotAvailableError(
            f"{accident.scenario}: has no labels of {_EGO}, whose lead time is asked; unpack them"
        )
    first, leads, shapley = _whole_ledger(observed, there[1:])
    return LeadTimes(
        scenario=accident.scenario,
        rule=rule,
        actor_ids=accident.actor_ids,
        categories=accident.categories,
        colliding_agents=accident.agents,
        missing=tuple(name for name in AGENTS if name not in there),
        num_frames=accident.num_frames,
        touching=accident.touching,
        first_frames=first,
        leads=leads,
        shapley=shapley,
    )


def _whole_ledger(
    observed: BoolArray, partners: tuple[AgentName, ...]
) -> tuple[IntArray, FloatArray, FloatArray]:
    """First frames (16,), leads (16,) and Shapley values (4,), of which those of missing partners are not known."""
    places = np.array([PARTNERS.index(name) for name in partners], dtype=np.int64)
    numbers = coalition_members(len(partners)) @ (1 << places)
    first = first_together(observed)
    leads = leads_from(first, observed.shape[-1])
    every_frame, every_lead = (
        np.zeros(len(COALITIONS), dtype=np.int64),
        np.full(len(COALITIONS), np.nan),
    )
    every_frame[numbers], every_lead[numbers] = first + 1, leads
    shapley = np.full(len(PARTNERS), np.nan)
    shapley[places] = shapley_values(leads)
    return every_frame, every_lead, shapley


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanTime:
    """A mean over accidents.

    Attributes:
        mean: seconds; None of no accident.
        low: end of the interval of 95 % by the bootstrap over accidents; None of fewer than six.
        high: its other end.
        accidents: of how many.
    """

    mean: float | None
    low: float | None
    high: float | None
    accidents: int

    @property
    def text(self) -> str:
        """Such as `1.52 [1.20, 1.86]`."""
        if self.mean is None:
            return "–"
        return f"{self.mean:.2f}" + (
            "" if self.low is None else f" [{self.low:.2f}, {self.high:.2f}]"
        )


@dataclass(frozen=True, kw_only=True)
class LeadTimeLedger(Report):
    """The lead times of the accidents of a release, or of some of its scenarios.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        rule: when an actor counts as observed.
        accidents: in the order of the release.
        skipped: scenarios of which the lead times cannot be told, and why.
        without_accident: scenarios whose meta file names no collision.
    """

    dataroot: str
    version: str
    rule: ObservationRule
    accidents: tuple[LeadTimes, ...]
    skipped: tuple[Skipped, ...]
    without_accident: int

    @cached_property
    def mean_leads(self) -> tuple[MeanTime, ...]:
        """Of each of `COALITIONS`, the mean lead time; accidents without one of its agents do not count."""
        return mean_times(
            np.array([each.leads for each in self.accidents]).reshape(-1, len(COALITIONS))
        )

    @cached_property
    def mean_gains(self) -> tuple[MeanTime, ...]:
        """Of each of `PARTNERS`, the mean of what it adds to the ego alone."""
        return mean_times(
            np.array([each.gains for each in self.accidents]).reshape(-1, len(PARTNERS))
        )

    @cached_property
    def mean_losses(self) -> tuple[MeanTime, ...]:
        """Of each of `PARTNERS`, the mean of what all agents lose without it."""
        return mean_times(
            np.array([each.losses for each in self.accidents]).reshape(-1, len(PARTNERS))
        )

    @cached_property
    def mean_shapley(self) -> tuple[MeanTime, ...]:
        """Of each of `PARTNERS`, its mean Shapley value."""
        return mean_times(
            np.array([each.shapley for each in self.accidents]).reshape(-1, len(PARTNERS))
        )

    @property
    def mean_together(self) -> MeanTime:
        """Of all agents that each accident has."""
        return mean_times(np.array([each.together for each in self.accidents]).reshape(-1, 1))[0]

    @property
    def share_never_alone(self) -> float | None:
        """Share of the accidents whose colliders the ego alone never observes at the same frame; None of none."""
        return _share([each.never_alone for each in self.accidents])

    @property
    def share_never_together(self) -> float | None:
        """The same of all agents together."""
        return _share([each.never_together for each in self.accidents])

    @property
    def share_from_the_start(self) -> float | None:
        """Share of the accidents that all agents observe from the first frame on, so that more may have been cut."""
        return _share([each.from_the_start for each in self.accidents])

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        names = ["+".join(members) for members in COALITIONS]
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "rule": asdict(self.rule),
            "caveat": CAVEAT,
            "summary": {
                "accidents": len(self.accidents),
                "ego_collides": sum(each.ego_collides for each in self.accidents),
                "with_missing_agents": sum(bool(each.missing) for each in self.accidents),
                "skipped": len(self.skipped),
                "without_accident": self.without_accident,
                "share_never_alone": self.share_never_alone,
                "share_never_together": self.share_never_together,
                "share_from_the_start": self.share_from_the_start,
                "together": asdict(self.mean_together),
                "lead_seconds": _by_name(names, self.mean_leads),
                "gain_seconds": _by_name(PARTNERS, self.mean_gains),
                "loss_seconds": _by_name(PARTNERS, self.mean_losses),
                "shapley_seconds": _by_name(PARTNERS, self.mean_shapley),
            },
            "accidents": [each.to_dict() for each in self.accidents],
            "skipped": [asdict(each) for each in self.skipped],
        }

    def named_tables(self) -> dict[str, Iterable[Row]]:
        """`lead_times`, a row an accident, seconds with all their digits; and `skipped`."""
        return {
            "lead_times": [_CSV_HEADING, *map(_csv_row, self.accidents)],
            "skipped": skipped_rows(self.skipped),
        }

    def to_text(self) -> str:
        """A table of the accidents and of their means, for a terminal."""
        with_ego = sum(each.ego_collides for each in self.accidents)
        counts = (
            f"{counted(len(self.accidents), 'accident')}, {with_ego} of them with {_EGO} among the colliders; "
            f"{counted(self.without_accident, 'scenario')} without an accident; {len(self.skipped)} skipped"
        )
        head = f"Lead times: DeepAccident {self.version} at {self.dataroot}\nobserved: {self.rule.text}\n{counts}"
        blocks = [f"{head}\n{CAVEAT}"]
        if self.accidents:
            blocks[0] += f"\n{counted_text([each.touching for each in self.accidents])}"
            blocks += [self._accidents_text(), self._means_text()]
        if self.skipped:
            blocks.append(reasons_text("skipped", self.skipped))
        return "\n\n".join(blocks)

    def _accidents_text(self) -> str:
        heading = (
            "seconds before the impact",
            "ego alone",
            *(f"+ {short_name(name)}" for name in PARTNERS),
            "all",
        )
        rows = [
            (
                each.scenario,
                _lead_text(each.alone, never=each.never_alone),
                *(
                    _gain_text(*pair)
                    for pair in zip(each.gains.tolist(), each.shapley.tolist(), strict=True)
                ),
                _lead_text(each.together, never=each.never_together) + "*" * bool(each.missing),
            )
            for each in self.accidents
        ]
        notes = [
            "+: what the partner alone adds to the ego, and in brackets its Shapley value",
            "never: the colliders are not observed at the same frame",
        ]
        if any(each.missing for each in self.accidents):
            notes.append("*: of the agents that are there; – for the missing ones")
        return "\n".join([columns_text([heading, *rows]), *notes])

    def _means_text(self) -> str:
        means = zip(PARTNERS, self.mean_gains, self.mean_losses, self.mean_shapley, strict=True)
        rows = [(short_name(name), *(mean.text for mean in each)) for name, *each in means]
        alone, together = self.mean_leads[0].text, self.mean_together.text
        start = "observed by all agents from the first frame on, so that the lead may be longer than the recording: "
        never = f"never observed together: by the ego alone {_percent(self.share_never_alone)}, by all agents "
        return "\n".join(
            [
                "means in seconds [interval of 95 %, bootstrap over accidents]",
                columns_text(
                    [("partner", "adds to the ego", "all lose without", "Shapley value"), *rows]
                ),
                f"lead time: the ego alone {alone}, all agents {together}",
                f"{never}{_percent(self.share_never_together)} of the accidents",
                f"{start}{_percent(self.share_from_the_start)}",
            ]
        )


def mean_times(values: FloatArray) -> tuple[MeanTime, ...]:
    """The mean of each column of (N, K) seconds over accidents, NaN for unknown, with its bootstrap interval.

    The same accidents are taken for all columns, `_RESAMPLES` times, always by the same random numbers.
    """
    count = len(values)
    known = np.isfinite(values)
    if not count:
        return tuple(
            MeanTime(mean=None, low=None, high=None, accidents=0) for _ in range(values.shape[1])
        )
    times = (
        np.random.default_rng(0)
        .multinomial(count, np.full(count, 1 / count), size=_RESAMPLES)
        .astype(np.float64)
    )
    with np.errstate(invalid="ignore"):
        drawn = times @ np.where(known, values, 0) / (times @ known)
    return tuple(
        _mean_time(values[known[:, at], at], drawn[:, at]) for at in range(values.shape[1])
    )


def _mean_time(values: FloatArray, drawn: FloatArray) -> MeanTime:
    ends: Sequence[float | None] = (None, None)
    if len(values) >= _FEWEST:
        tail = (1 - _CONFIDENCE) / 2
        ends = np.nanquantile(drawn, (tail, 1 - tail)).tolist()
    mean = math.fsum(values.tolist()) / len(values) if len(values) else None
    return MeanTime(mean=mean, low=ends[0], high=ends[1], accidents=len(values))


_CSV_HEADING: Final = (
    *_OF_ACCIDENT,
    *(f"lead_{'+'.join(members)}" for members in COALITIONS),
    *(f"first_frame_{'+'.join(members)}" for members in COALITIONS),
    *(f"shapley_{name}" for name in PARTNERS),
)


def _csv_row(times: LeadTimes) -> list[Any]:
    told = times.to_dict()
    lists = ("actor_ids", "categories", "colliding_agents", "missing")
    words = {
        name: " ".join("none" if each is None else str(each) for each in told[name])
        for name in lists
    }
    return [
        *({**told, **words}[name] for name in _OF_ACCIDENT),
        *told["lead_seconds"].values(),
        *told["first_frames"].values(),
        *told["shapley_seconds"].values(),
    ]


def _by_name(names: Sequence[str], means: Sequence[MeanTime]) -> dict[str, Any]:
    return {name: asdict(mean) for name, mean in zip(names, means, strict=True)}


def _share(truths: Sequence[bool]) -> float | None:
    return sum(truths) / len(truths) if truths else None


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{round(100 * share)} %"


def _gain_text(gain: float, shapley: float) -> str:
    return "–" if math.isnan(gain) else f"{gain:.1f} ({shapley:.2f})"


def _lead_text(lead: float, *, never: bool) -> str:
    return "never" if never else f"{lead:.1f}"


def lead_time_ledger(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    rule: ObservationRule | None = None,
    **how: Unpack[Engine],
) -> LeadTimeLedger:
    """The lead times of every accident, and the scenarios of which they cannot be told.

    Args:
        dataset: the release.
        scenarios: tokens or records of those to look at, such as `find` gives; None for all.
        rule: when an actor counts as observed; None for `ObservationRule()`.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        TokenError: no such scenario.
    """
    rule = rule or ObservationRule()
    found = each_scenario(
        partial(lead_times, rule=rule), dataset, scenarios, label="lead times", **how
    )
    return ledger_of(dataset, found, rule)


def ledger_of(
    dataset: Dataset, found: Sequence[LeadTimes | Skipped | None], rule: ObservationRule
) -> LeadTimeLedger:
    """The ledger of what `lead_times` found in scenarios."""
    return LeadTimeLedger(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        rule=rule,
        accidents=those_of(LeadTimes, found),
        skipped=those_of(Skipped, found),
        without_accident=found.count(None),
    )
