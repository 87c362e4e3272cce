"""How long before an accident's impact sets of agents first observe both colliders.

`lead_times` measures one accident, with what each partner adds; `lead_time_ledger` measures all
accidents of a release.
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
# Smallest number of accidents for which a mean has an interval.
_MIN_ACCIDENTS: Final = 6
_ACCIDENT_COLUMNS: Final = (
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
"""The sixteen sets of agents with the ego; set number n has partner i if bit i of n is set."""
# Bit of each partner, which is also the number of the set of the ego and this partner.
_PARTNER_BITS: Final = [1 << partner for partner in range(len(PARTNERS))]
# Columns of the CSV file.
_CSV_HEADING: Final = (
    *_ACCIDENT_COLUMNS,
    *(f"lead_{'+'.join(members)}" for members in COALITIONS),
    *(f"first_frame_{'+'.join(members)}" for members in COALITIONS),
    *(f"shapley_{name}" for name in PARTNERS),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeadTimes(FrozenArrays):
    """When sets of agents first observe both colliders of an accident; arrays are read-only.

    Observation bounds a warning from above. It is no prediction: an agent that sees both actors
    need not foresee that they will collide.

    Attributes:
        scenario: Token of the scenario.
        rule: When an actor counts as observed.
        actor_ids: CARLA ids of the colliders, in the meta file's order.
        categories: Classes of the colliders.
        colliding_agents: Agents that the colliders are; None for a collider that records nothing.
        missing: Agents without labels in this release.
        num_frames: Number of frames of the recording; the last one counts as the impact.
        touching: Seconds from the frame at which the outlines begin to touch to the last one; None
            if they never do.
        first_frames: Number (from 1) of the first frame at which each of `COALITIONS` observes
            both, shape (16,), int64; 0 for a set that never does, and for a set with a missing
            agent.
        leads: Seconds from that frame to the last one, shape (16,); 0 for a set that never observes
            both, NaN with a missing agent.
        shapley: Shapley value of each of `PARTNERS`, shape (4,): seconds of the gain over the ego
            without partners, shared among the partners with labels; NaN for a missing one.
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
        """Seconds of the ego without partners."""
        return float(self.leads[0])

    @property
    def together(self) -> float:
        """Seconds of all agents with labels."""
        return float(self.leads[self._full_coalition])

    @property
    def never_alone(self) -> bool:
        """Whether the ego without partners never observes both at the same frame."""
        return not self.first_frames[0]

    @property
    def never_together(self) -> bool:
        """Whether all agents with labels never observe both at the same frame."""
        return not self.first_frames[self._full_coalition]

    @property
    def from_the_start(self) -> bool:
        """Whether all agents with labels observe both from the first frame on.

        The recording may then cut the lead time.
        """
        return int(self.first_frames[self._full_coalition]) == 1

    @property
    def gains(self) -> FloatArray:
        """Seconds that each of `PARTNERS` adds to the ego, shape (4,); NaN for a missing one."""
        return np.asarray(self.leads[_PARTNER_BITS] - self.leads[0])

    @property
    def losses(self) -> FloatArray:
        """Seconds that all agents lose without each of `PARTNERS`, shape (4,); NaN if missing."""
        smaller_sets = [self._full_coalition & ~bit for bit in _PARTNER_BITS]
        return np.where(np.isnan(self.gains), np.nan, self.together - self.leads[smaller_sets])

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON.

        None for unknown values, and for the first frame of a set that never observes both.
        """
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
    def _full_coalition(self) -> int:
        """Number of the set of all agents with labels."""
        bits = zip(_PARTNER_BITS, PARTNERS, strict=True)
        return sum(bit for bit, name in bits if name not in self.missing)


def lead_times(
    dataset: Dataset, scenario: RowArgument, rule: ObservationRule | None = None
) -> LeadTimes | None:
    """Return when each set of agents with `ego_vehicle` first observes both colliders.

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.
        rule: When an actor counts as observed; None for `ObservationRule()`.

    Returns:
        None if the meta file names no collision.

    Raises:
        TokenError: There is no such scenario.
        NotAvailableError: `accident_of` raises it, or `ego_vehicle` has no labels in this release.
    """
    accident = accident_of(dataset, scenario)
    if accident is None:
        return None
    rule = rule or ObservationRule()
    present, observed = observed_actors(dataset, accident.scenario, accident.actor_ids, rule)
    if _EGO not in present:
        raise NotAvailableError(
            f"{accident.scenario}: has no labels of {_EGO}, whose lead time is asked; unpack them"
        )
    first_frames, leads, shapley = _coalition_values(observed, present[1:])
    return LeadTimes(
        scenario=accident.scenario,
        rule=rule,
        actor_ids=accident.actor_ids,
        categories=accident.categories,
        colliding_agents=accident.agents,
        missing=tuple(name for name in AGENTS if name not in present),
        num_frames=accident.num_frames,
        touching=accident.touching,
        first_frames=first_frames,
        leads=leads,
        shapley=shapley,
    )


def _coalition_values(
    observed: BoolArray, partners: tuple[AgentName, ...]
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return first frames (16,), leads (16,) and Shapley values (4,) of all sets and partners.

    Values of sets with a missing partner are unknown, as are Shapley values of missing partners.
    """
    indices = np.array([PARTNERS.index(name) for name in partners], dtype=np.int64)
    numbers = coalition_members(len(partners)) @ (1 << indices)
    first_index = first_together(observed)
    known_leads = leads_from(first_index, observed.shape[-1])
    first_frames = np.zeros(len(COALITIONS), dtype=np.int64)
    leads = np.full(len(COALITIONS), np.nan)
    first_frames[numbers], leads[numbers] = first_index + 1, known_leads
    shapley = np.full(len(PARTNERS), np.nan)
    shapley[indices] = shapley_values(known_leads)
    return first_frames, leads, shapley


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanTime:
    """A mean over accidents.

    Attributes:
        mean: Mean in seconds; None without accidents.
        low: Lower end of the interval of 95 % by the bootstrap over accidents; None for fewer than
            six.
        high: Upper end of the interval.
        accidents: Number of accidents.
    """

    mean: float | None
    low: float | None
    high: float | None
    accidents: int

    @property
    def text(self) -> str:
        """The mean and its interval, such as `1.52 [1.20, 1.86]`."""
        if self.mean is None:
            return "–"
        interval = "" if self.low is None else f" [{self.low:.2f}, {self.high:.2f}]"
        return f"{self.mean:.2f}{interval}"


@dataclass(frozen=True, kw_only=True)
class LeadTimeLedger(Report):
    """The lead times of the accidents of a release, or of some of its scenarios.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        rule: When an actor counts as observed.
        accidents: Lead times, in the order of the release.
        skipped: Scenarios with unknown lead times, and why.
        without_accident: Number of scenarios with a meta file that names no collision.
    """

    dataroot: str
    version: str
    rule: ObservationRule
    accidents: tuple[LeadTimes, ...]
    skipped: tuple[Skipped, ...]
    without_accident: int

    @cached_property
    def mean_leads(self) -> tuple[MeanTime, ...]:
        """Mean lead time of each of `COALITIONS`.

        Accidents without one of its agents do not count.
        """
        return _column_means([times.leads for times in self.accidents], len(COALITIONS))

    @cached_property
    def mean_gains(self) -> tuple[MeanTime, ...]:
        """Mean of what each of `PARTNERS` adds to the ego."""
        return _column_means([times.gains for times in self.accidents], len(PARTNERS))

    @cached_property
    def mean_losses(self) -> tuple[MeanTime, ...]:
        """Mean of what all agents lose without each of `PARTNERS`."""
        return _column_means([times.losses for times in self.accidents], len(PARTNERS))

    @cached_property
    def mean_shapley(self) -> tuple[MeanTime, ...]:
        """Mean Shapley value of each of `PARTNERS`."""
        return _column_means([times.shapley for times in self.accidents], len(PARTNERS))

    @property
    def mean_together(self) -> MeanTime:
        """Mean lead time of all agents that each accident has."""
        return _column_means([times.together for times in self.accidents], 1)[0]

    @property
    def share_never_alone(self) -> float | None:
        """Share of the accidents that the ego without partners never observes; None for none.

        To observe an accident is to observe both colliders at the same frame.
        """
        return _share([times.never_alone for times in self.accidents])

    @property
    def share_never_together(self) -> float | None:
        """Share of the accidents that all agents together never observe; None for none."""
        return _share([times.never_together for times in self.accidents])

    @property
    def share_from_the_start(self) -> float | None:
        """Share of the accidents that all agents observe from the first frame on; None for none.

        In these accidents the beginning of the recording may have cut the lead time.
        """
        return _share([times.from_the_start for times in self.accidents])

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON; None for unknown values."""
        names = ["+".join(members) for members in COALITIONS]
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "rule": asdict(self.rule),
            "caveat": CAVEAT,
            "summary": {
                "accidents": len(self.accidents),
                "ego_collides": sum(times.ego_collides for times in self.accidents),
                "with_missing_agents": sum(bool(times.missing) for times in self.accidents),
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
            "accidents": [times.to_dict() for times in self.accidents],
            "skipped": [asdict(skipped) for skipped in self.skipped],
        }

    def named_tables(self) -> dict[str, Iterable[Row]]:
        """Return `lead_times`, a row for each accident with unrounded seconds, and `skipped`."""
        return {
            "lead_times": [_CSV_HEADING, *map(_csv_row, self.accidents)],
            "skipped": skipped_rows(self.skipped),
        }

    def to_text(self) -> str:
        """Return a table of the accidents and of their means, for a terminal."""
        with_ego = sum(times.ego_collides for times in self.accidents)
        counts = (
            f"{counted(len(self.accidents), 'accident')}, {with_ego} of them with {_EGO} among the "
            f"colliders; {counted(self.without_accident, 'scenario')} without an accident; "
            f"{len(self.skipped)} skipped"
        )
        title = f"Lead times: DeepAccident {self.version} at {self.dataroot}"
        blocks = [f"{title}\nobserved: {self.rule.text}\n{counts}\n{CAVEAT}"]
        if self.accidents:
            blocks[0] += f"\n{counted_text([times.touching for times in self.accidents])}"
            blocks += [self._accidents_text(), self._means_text()]
        if self.skipped:
            blocks.append(reasons_text("skipped", self.skipped))
        return "\n\n".join(blocks)

    def _accidents_text(self) -> str:
        partner_heads = (f"+ {short_name(name)}" for name in PARTNERS)
        rows = [("seconds before the impact", "ego alone", *partner_heads, "all")]
        for times in self.accidents:
            partners = zip(times.gains.tolist(), times.shapley.tolist(), strict=True)
            together = _lead_text(times.together, never=times.never_together)
            rows.append(
                (
                    times.scenario,
                    _lead_text(times.alone, never=times.never_alone),
                    *(_gain_text(gain, shapley) for gain, shapley in partners),
                    together + "*" * bool(times.missing),
                )
            )
        notes = [
            "+: what the partner alone adds to the ego, and in brackets its Shapley value",
            "never: the colliders are not observed at the same frame",
        ]
        if any(times.missing for times in self.accidents):
            notes.append("*: of the agents that are there; – for the missing ones")
        return "\n".join([columns_text(rows), *notes])

    def _means_text(self) -> str:
        means = zip(PARTNERS, self.mean_gains, self.mean_losses, self.mean_shapley, strict=True)
        heading = ("partner", "adds to the ego", "all lose without", "Shapley value")
        rows = [
            (short_name(name), gain.text, loss.text, shapley.text)
            for name, gain, loss, shapley in means
        ]
        alone, together = self.mean_leads[0].text, self.mean_together.text
        start = (
            "observed by all agents from the first frame on, so that the lead may be longer than "
            "the recording: "
        )
        never = (
            f"never observed together: by the ego alone {_percent(self.share_never_alone)}, by all "
            "agents "
        )
        lines = [
            "means in seconds [interval of 95 %, bootstrap over accidents]",
            columns_text([heading, *rows]),
            f"lead time: the ego alone {alone}, all agents {together}",
            f"{never}{_percent(self.share_never_together)} of the accidents",
            f"{start}{_percent(self.share_from_the_start)}",
        ]
        return "\n".join(lines)


def mean_times(values: FloatArray) -> tuple[MeanTime, ...]:
    """Return the mean of each column of seconds over accidents, with its bootstrap interval.

    All columns use the same `_RESAMPLES` resamples of the accidents, always from the same random
    numbers.

    Args:
        values: Seconds, shape (N, K); NaN for unknown ones.
    """
    count, columns = values.shape
    known = np.isfinite(values)
    if not count:
        return tuple(MeanTime(mean=None, low=None, high=None, accidents=0) for _ in range(columns))
    generator = np.random.default_rng(0)
    draws = generator.multinomial(count, np.full(count, 1 / count), size=_RESAMPLES)
    times = draws.astype(np.float64)
    with np.errstate(invalid="ignore"):
        means = times @ np.where(known, values, 0) / (times @ known)
    return tuple(
        _mean_time(values[known[:, column], column], means[:, column]) for column in range(columns)
    )


def _column_means(rows: Sequence[FloatArray | float], columns: int) -> tuple[MeanTime, ...]:
    return mean_times(np.array(rows).reshape(-1, columns))


def _mean_time(values: FloatArray, resampled_means: FloatArray) -> MeanTime:
    ends: Sequence[float | None] = (None, None)
    if len(values) >= _MIN_ACCIDENTS:
        tail = (1 - _CONFIDENCE) / 2
        ends = np.nanquantile(resampled_means, (tail, 1 - tail)).tolist()
    mean = math.fsum(values.tolist()) / len(values) if len(values) else None
    return MeanTime(mean=mean, low=ends[0], high=ends[1], accidents=len(values))


def _csv_row(times: LeadTimes) -> list[Any]:
    payload = times.to_dict()
    cells = dict(payload)
    for name in ("actor_ids", "categories", "colliding_agents", "missing"):
        cells[name] = " ".join("none" if value is None else str(value) for value in payload[name])
    return [
        *(cells[name] for name in _ACCIDENT_COLUMNS),
        *payload["lead_seconds"].values(),
        *payload["first_frames"].values(),
        *payload["shapley_seconds"].values(),
    ]


def _by_name(names: Sequence[str], means: Sequence[MeanTime]) -> dict[str, Any]:
    return {name: asdict(mean) for name, mean in zip(names, means, strict=True)}


def _share(truths: Sequence[bool]) -> float | None:
    if truths:
        return sum(truths) / len(truths)
    return None


def _percent(share: float | None) -> str:
    if share is None:
        return "–"
    return f"{round(100 * share)} %"


def _gain_text(gain: float, shapley: float) -> str:
    if math.isnan(gain):
        return "–"
    return f"{gain:.1f} ({shapley:.2f})"


def _lead_text(lead: float, *, never: bool) -> str:
    if never:
        return "never"
    return f"{lead:.1f}"


def lead_time_ledger(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    rule: ObservationRule | None = None,
    **engine: Unpack[Engine],
) -> LeadTimeLedger:
    """Return the lead times of every accident, and the scenarios with unknown lead times.

    Args:
        dataset: The release.
        scenarios: Tokens or records of scenarios, such as `find` returns; None for all.
        rule: When an actor counts as observed; None for `ObservationRule()`.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: There is no such scenario.
    """
    rule = rule or ObservationRule()
    work = partial(lead_times, rule=rule)
    results = each_scenario(work, dataset, scenarios, label="lead times", **engine)
    return ledger_of(dataset, results, rule)


def ledger_of(
    dataset: Dataset, results: Sequence[LeadTimes | Skipped | None], rule: ObservationRule
) -> LeadTimeLedger:
    """Return the ledger of the results of `lead_times` for scenarios."""
    return LeadTimeLedger(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        rule=rule,
        accidents=those_of(LeadTimes, results),
        skipped=those_of(Skipped, results),
        without_accident=results.count(None),
    )
