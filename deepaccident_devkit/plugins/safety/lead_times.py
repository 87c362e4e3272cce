"""Lead times: how long before the impact a set of agents first observes both colliders.

`lead_times` measures one accident, including what each partner adds; `lead_time_ledger` measures
all accidents of a release.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from itertools import compress
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.collisions.recorded import (
    Skipped,
    accident_of,
    counted_text,
    map_scenarios,
    reasons_text,
    select_results,
    skipped_rows,
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
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    json_numbers,
)
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import columns_text, counted
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import AGENTS, AgentName, short_name

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

_EGO = AGENTS[0]
PARTNERS: Final = AGENTS[1:]
"""The agents that can be added to `ego_vehicle`."""
CAVEAT: Final = "Lead time is an upper bound: seeing both is not yet predicting."
# Number of bootstrap resamples.
_RESAMPLES = 2000
# Nominal coverage of the intervals.
_CONFIDENCE = 0.95
# Fewest accidents for which an interval is computed.
_MIN_ACCIDENTS = 6
_ACCIDENT_COLUMNS = (
    "scenario",
    "actor_ids",
    "categories",
    "colliding_agents",
    "ego_collides",
    "missing",
    "num_frames",
    "touching",
)


_MEMBERS = coalition_members(len(PARTNERS))
COALITIONS: Final[tuple[tuple[AgentName, ...], ...]] = tuple(
    (_EGO, *compress(PARTNERS, is_member)) for is_member in _MEMBERS.tolist()
)
"""The 16 sets of agents that include the ego; bit i of the index is set if partner i belongs."""
# Name of each set in `COALITIONS`.
_COALITION_NAMES = tuple(map("+".join, COALITIONS))
# Bit of each partner; it is also the index of the set that consists of the ego and this partner.
_PARTNER_BITS = [1 << partner for partner in range(len(PARTNERS))]
# Columns of the CSV file.
_CSV_HEADING = (
    *_ACCIDENT_COLUMNS,
    *(f"lead_{name}" for name in _COALITION_NAMES),
    *(f"first_frame_{name}" for name in _COALITION_NAMES),
    *(f"shapley_{name}" for name in PARTNERS),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeadTimes(FrozenArrays):
    """When each set of agents first observes both colliders; arrays are read-only.

    A lead time is an upper bound for how early a warning can be. It is not a prediction: an agent
    that sees both actors may not foresee their collision.

    Attributes:
        scenario: Token of the scenario.
        rule: Rule for when an actor counts as observed.
        actor_ids: CARLA ids of the colliders, in the meta file's order.
        categories: Classes of the colliders.
        colliding_agents: Names of the colliders as agents; None for a collider that is no agent.
        missing: Agents without labels in this release.
        num_frames: Number of frames in the recording; the last one is taken as the impact.
        touching: Seconds from the first frame in which the outlines touch to the last frame; None
            if they never touch.
        first_frames: Number (from 1) of the first frame in which each of `COALITIONS` observes
            both, shape (16,), int64; 0 for a set that never does, or that has a missing agent.
        leads: Seconds from that frame to the last one, shape (16,); 0 for a set that never observes
            both, NaN for a set with a missing agent.
        shapley: Shapley value of each of `PARTNERS` in seconds, shape (4,): its share of the lead
            time that all partners with labels add to the ego's; NaN for a missing partner.
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
        """Lead time of the ego without partners, in seconds."""
        return float(self.leads[0])

    @property
    def together(self) -> float:
        """Lead time of all agents with labels together, in seconds."""
        return float(self.leads[self._full_coalition])

    @property
    def never_alone(self) -> bool:
        """Whether the ego without partners never observes both colliders in the same frame."""
        return not self.first_frames[0]

    @property
    def never_together(self) -> bool:
        """Whether all agents with labels together never observe both in the same frame."""
        return not self.first_frames[self._full_coalition]

    @property
    def from_the_start(self) -> bool:
        """Whether all agents with labels together already observe both in the first frame.

        If so, the true lead time may be longer than the recorded one.
        """
        first_frame = int(self.first_frames[self._full_coalition])
        return first_frame == 1

    @property
    def gains(self) -> FloatArray:
        """Seconds that each of `PARTNERS` adds to the ego's lead time, (4,); NaN if missing."""
        leads_in_pairs = self.leads[_PARTNER_BITS]
        return np.asarray(leads_in_pairs - self.leads[0])

    @property
    def losses(self) -> FloatArray:
        """Seconds by which all agents' lead time falls without each of `PARTNERS`, shape (4,).

        Values are NaN for missing partners.
        """
        smaller_sets = [self._full_coalition & ~bit for bit in _PARTNER_BITS]
        losses = self.together - self.leads[smaller_sets]
        return np.where(np.isnan(self.gains), np.nan, losses)

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON.

        Unknown values are None, and so is the first frame of a set that never observes both.
        """
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
            "lead_seconds": _by_name(_COALITION_NAMES, json_numbers(self.leads)),
            "first_frames": _by_name(_COALITION_NAMES, frames),
            "gain_seconds": _by_name(PARTNERS, json_numbers(self.gains)),
            "loss_seconds": _by_name(PARTNERS, json_numbers(self.losses)),
            "shapley_seconds": _by_name(PARTNERS, json_numbers(self.shapley)),
        }

    @property
    def _full_coalition(self) -> int:
        """Index in `COALITIONS` of the set of all agents with labels."""
        bits = zip(_PARTNER_BITS, PARTNERS, strict=True)
        return sum(bit for bit, name in bits if name not in self.missing)


def lead_times(
    dataset: Dataset, scenario: RowArgument, rule: ObservationRule | None = None
) -> LeadTimes | None:
    """Measure when each set of agents that includes `ego_vehicle` first observes both colliders.

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.
        rule: Rule for when an actor counts as observed; None for `ObservationRule()`.

    Returns:
        The lead times; None if the meta file names no collision.

    Raises:
        TokenError: If the release has no such scenario.
        NotAvailableError: If `accident_of` raises it, or if `ego_vehicle` has no labels in this
            release.
    """
    accident = accident_of(dataset, scenario)
    if accident is None:
        return None
    rule = rule or ObservationRule()
    present, observed = observed_actors(dataset, accident.scenario, accident.actor_ids, rule)
    if _EGO not in present:
        raise NotAvailableError(
            f"{accident.scenario}: has no labels of {_EGO}, which its lead time needs; unpack them"
        )
    first_frames, leads, shapley = _measure_coalitions(observed, present[1:])
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


def _measure_coalitions(
    observed: BoolArray, partners: tuple[AgentName, ...]
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Compute `first_frames`, `leads` and `shapley` of `LeadTimes`.

    Args:
        observed: Whether each agent with labels observes each collider in each frame.
        partners: The partners that have labels.
    """
    indices = np.array([PARTNERS.index(name) for name in partners], dtype=np.int64)
    numbers = coalition_members(len(partners)) @ (1 << indices)
    first_index = first_together(observed)
    known_leads = leads_from(first_index, observed.shape[-1])
    first_frames = np.zeros(len(COALITIONS), dtype=np.int64)
    first_frames[numbers] = first_index + 1
    leads = np.full(len(COALITIONS), np.nan)
    leads[numbers] = known_leads
    shapley = np.full(len(PARTNERS), np.nan)
    shapley[indices] = shapley_values(known_leads)
    return first_frames, leads, shapley


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanTime:
    """A mean over accidents.

    Attributes:
        mean: Mean in seconds; None without accidents.
        low: Lower end of the 95 % interval from a bootstrap over accidents; None for fewer than
            six accidents.
        high: Upper end of the interval; None if there is no lower end.
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
        interval = ""
        if self.low is not None:
            interval = f" [{self.low:.2f}, {self.high:.2f}]"
        return f"{self.mean:.2f}{interval}"


@dataclass(frozen=True, kw_only=True)
class LeadTimeLedger(Report):
    """The lead times of the accidents of a release, or of some of its scenarios.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        rule: Rule for when an actor counts as observed.
        accidents: Lead times of each accident, in the order of the release.
        skipped: Scenarios whose lead times are unknown, and the reasons.
        without_accident: Number of scenarios whose meta file names no collision.
    """

    dataroot: str
    version: str
    rule: ObservationRule
    accidents: tuple[LeadTimes, ...]
    skipped: tuple[Skipped, ...]
    without_accident: int

    @cached_property
    def mean_leads(self) -> tuple[MeanTime, ...]:
        """Mean lead time of each of `COALITIONS`, over accidents in which all its agents exist."""
        return self._column_means("leads", len(COALITIONS))

    @cached_property
    def mean_gains(self) -> tuple[MeanTime, ...]:
        """Mean lead time that each of `PARTNERS` adds to the ego's."""
        return self._column_means("gains", len(PARTNERS))

    @cached_property
    def mean_losses(self) -> tuple[MeanTime, ...]:
        """Mean lead time that all agents lose without each of `PARTNERS`."""
        return self._column_means("losses", len(PARTNERS))

    @cached_property
    def mean_shapley(self) -> tuple[MeanTime, ...]:
        """Mean Shapley value of each of `PARTNERS`."""
        return self._column_means("shapley", len(PARTNERS))

    @property
    def mean_together(self) -> MeanTime:
        """Mean lead time of all agents with labels together."""
        return self._column_means("together", 1)[0]

    @property
    def share_never_alone(self) -> float | None:
        """Share of the accidents in which the ego by itself never observes both colliders at once.

        None without accidents.
        """
        return self._share("never_alone")

    @property
    def share_never_together(self) -> float | None:
        """Share of the accidents that all agents together never observe; None if there are none."""
        return self._share("never_together")

    @property
    def share_from_the_start(self) -> float | None:
        """Share of the accidents that all agents together already observe in the first frame.

        Their true lead times may be longer than the recorded ones. None without accidents.
        """
        return self._share("from_the_start")

    def _column_means(self, name: str, columns: int) -> tuple[MeanTime, ...]:
        """Average each column of a field of `LeadTimes` over the accidents."""
        values = [getattr(times, name) for times in self.accidents]
        return mean_times(np.array(values).reshape(-1, columns))

    def _share(self, name: str) -> float | None:
        """Return the share of accidents where a property of `LeadTimes` holds; None without any."""
        if not self.accidents:
            return None
        count = sum(getattr(times, name) for times in self.accidents)
        return float(count / len(self.accidents))

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON; None for unknown values."""
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
                "lead_seconds": _by_name(_COALITION_NAMES, map(asdict, self.mean_leads)),
                "gain_seconds": _by_name(PARTNERS, map(asdict, self.mean_gains)),
                "loss_seconds": _by_name(PARTNERS, map(asdict, self.mean_losses)),
                "shapley_seconds": _by_name(PARTNERS, map(asdict, self.mean_shapley)),
            },
            "accidents": [times.to_dict() for times in self.accidents],
            "skipped": [asdict(skipped) for skipped in self.skipped],
        }

    def named_tables(self) -> dict[str, Iterable[Row]]:
        """Return the tables `lead_times` (one row per accident) and `skipped`."""
        return {
            "lead_times": [_CSV_HEADING, *map(_csv_row, self.accidents)],
            "skipped": skipped_rows(self.skipped),
        }

    def to_text(self) -> str:
        """Return the accidents and their means as tables for a terminal."""
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
        """Return a table with one row per accident, and an explanation of its columns."""
        partner_heads = (f"+ {short_name(name)}" for name in PARTNERS)
        rows = [("seconds before the impact", "ego alone", *partner_heads, "all")]
        for times in self.accidents:
            gains = map(_gain_text, times.gains.tolist(), times.shapley.tolist())
            alone = _lead_text(times.alone, never=times.never_alone)
            together = _lead_text(times.together, never=times.never_together)
            if times.missing:
                together += "*"
            rows.append((times.scenario, alone, *gains, together))
        notes = [
            "+ PARTNER: what this partner adds to ego; in brackets its Shapley value",
            "never: no frame shows both colliders",
        ]
        if any(times.missing for times in self.accidents):
            notes.append(
                "*: some agents are missing (shown as –); the numbers count the other agents"
            )
        return "\n".join([columns_text(rows), *notes])

    def _means_text(self) -> str:
        """Return a table with one row per partner, then lines with lead times and shares."""
        heading = ("partner", "adds to the ego", "marginal loss without it", "Shapley value")
        rows = [heading, *partner_rows(self)]
        alone = self.mean_leads[0].text
        together = self.mean_together.text
        never_alone = _percent(self.share_never_alone)
        never_together = _percent(self.share_never_together)
        from_the_start = _percent(self.share_from_the_start)
        return (
            "means in seconds [95 % confidence interval, bootstrapped over accidents]\n"
            f"{columns_text(rows)}\n"
            f"lead time: ego alone {alone}, all agents {together}\n"
            f"accidents in which both colliders are never observed together: {never_alone} by ego "
            f"alone, {never_together} by all agents\n"
            "accidents observed from the first frame on, so that the lead time may be longer: "
            f"{from_the_start}"
        )


def partner_rows(ledger: LeadTimeLedger) -> list[tuple[str, ...]]:
    """Return the name, mean gain, mean loss and mean Shapley value of each partner as text."""
    means = zip(PARTNERS, ledger.mean_gains, ledger.mean_losses, ledger.mean_shapley, strict=True)
    return [
        (short_name(name), gain.text, loss.text, shapley.text)
        for name, gain, loss, shapley in means
    ]


def mean_times(values: FloatArray) -> tuple[MeanTime, ...]:
    """Average each column over the accidents, with a bootstrap interval.

    All columns share the same `_RESAMPLES` resamples of the accidents. The random seed is fixed.

    Args:
        values: Seconds by accident and column, shape (N, K); NaN for unknown values.
    """
    count, columns = values.shape
    is_known = np.isfinite(values)
    resampled_means = np.zeros((0, columns))
    if count:
        generator = np.random.default_rng(0)
        draws = generator.multinomial(count, np.full(count, 1 / count), size=_RESAMPLES)
        times = draws.astype(np.float64)
        with np.errstate(invalid="ignore"):
            resampled_means = times @ np.where(is_known, values, 0) / (times @ is_known)
    means = []
    for column in range(columns):
        known_values = values[is_known[:, column], column]
        means.append(_mean_time(known_values, resampled_means[:, column]))
    return tuple(means)


def _mean_time(values: FloatArray, resampled_means: FloatArray) -> MeanTime:
    """Average the known values; the interval is taken from the resampled means."""
    if not len(values):
        return MeanTime(mean=None, low=None, high=None, accidents=0)
    low = None
    high = None
    if len(values) >= _MIN_ACCIDENTS:
        tail = (1 - _CONFIDENCE) / 2
        low, high = np.nanquantile(resampled_means, (tail, 1 - tail)).tolist()
    mean = math.fsum(values.tolist()) / len(values)
    return MeanTime(mean=mean, low=low, high=high, accidents=len(values))


def _csv_row(times: LeadTimes) -> list[Any]:
    """Return an accident's cells in the CSV file, in the order of `_CSV_HEADING`."""
    cells = times.to_dict()
    for name in ("actor_ids", "categories", "colliding_agents", "missing"):
        texts = ["none" if value is None else str(value) for value in cells[name]]
        cells[name] = " ".join(texts)
    return [
        *map(cells.get, _ACCIDENT_COLUMNS),
        *cells["lead_seconds"].values(),
        *cells["first_frames"].values(),
        *cells["shapley_seconds"].values(),
    ]


def _by_name(names: Sequence[str], values: Iterable[Any]) -> NamedValues:
    """Return a dictionary from names to values for JSON."""
    return dict(zip(names, values, strict=True))


def _percent(share: float | None) -> str:
    """Format a share in percent; a dash for None."""
    if share is None:
        return "–"
    return f"{round(100 * share)} %"


def _gain_text(gain: float, shapley: float) -> str:
    """Format what a partner adds, with its Shapley value in brackets; a dash if unknown."""
    if math.isnan(gain):
        return "–"
    return f"{gain:.1f} ({shapley:.2f})"


def _lead_text(lead: float, *, never: bool) -> str:
    """Format a lead time with one decimal; `never` if both are never observed."""
    if never:
        return "never"
    return f"{lead:.1f}"


def lead_time_ledger(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    rule: ObservationRule | None = None,
    **engine: Unpack[Engine],
) -> LeadTimeLedger:
    """Measure the lead times of all accidents, and list the scenarios where they are unknown.

    Args:
        dataset: The release.
        scenarios: Tokens or records of scenarios, such as `find` returns; None for all.
        rule: Rule for when an actor counts as observed; None for `ObservationRule()`.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: If the release has no such scenario.
    """
    rule = rule or ObservationRule()
    work = partial(lead_times, rule=rule)
    results = map_scenarios(work, dataset, scenarios, label="Measuring lead times", **engine)
    return ledger_of(dataset, results, rule)


def ledger_of(
    dataset: Dataset, results: Sequence[LeadTimes | Skipped | None], rule: ObservationRule
) -> LeadTimeLedger:
    """Build the ledger from the results of `lead_times`, one per scenario."""
    return LeadTimeLedger(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        rule=rule,
        accidents=select_results(LeadTimes, results),
        skipped=select_results(Skipped, results),
        without_accident=results.count(None),
    )
