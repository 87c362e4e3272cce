"""What braking would have changed in the accidents of a release.

`outcome_shares` returns how often each outcome occurs; `avoidability_report` returns the full
report.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.collisions.outcomes import (
    MAX_END_GAP_M,
    OUTCOMES,
    Braking,
    Outcomes,
    delta_v_ranges,
    undisturbed,
)
from deepaccident_devkit.collisions.recorded import (
    Skipped,
    accident_of,
    counted_text,
    map_scenarios,
    reasons_text,
    select_results,
)
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.descriptions.avoidability import (
    BRAKERS,
    Avoidability,
    avoidability_of,
    unusable,
)
from deepaccident_devkit.support.arrays import FloatArray, FrozenArrays, IntArray, as_floats
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import columns_text, counted
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine
    from deepaccident_devkit.tables.records import ScenarioRecord


# Groups of accidents that are counted separately: accidents with a pedestrian, who does not brake
# like a vehicle; head-on collisions of vehicles, where the result depends most on how the other
# vehicle continues when one brakes; and all other accidents between vehicles.
ACCIDENT_GROUPS: Final = ("vehicles", "head-on", "pedestrians")
# Drivers who are warned and brake; `ego` only counts accidents in which the ego collides.
WARNED: Final = (*BRAKERS, "ego")
# Fractions of the accidents; for each, the text states how many seconds of warning it takes.
_TEXT_SHARES = (0.5, 0.9)
# Columns of the table with the last moment to brake for each accident.
_LAST_MOMENT_COLUMNS = (
    "brakers",
    "deceleration",
    "avoidable",
    "last_moment",
    "slack",
    "switches",
    "extrapolated",
)
# Columns of the table of the self-check.
_CHECK_COLUMNS = (
    "scenario",
    "margin",
    "time",
    "end",
    "speed_first",
    "speed_second",
    "delta_v_first",
    "delta_v_first_least",
    "delta_v_first_most",
    "delta_v_second",
    "delta_v_second_least",
    "delta_v_second_most",
)
# Columns of the table of contacts with other actors.
_SECONDARY_COLUMNS = ("actor_id", "other_id", "category", "time", "extrapolated")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutcomeShares(FrozenArrays):
    """How often each outcome occurs in a group of accidents, for L leads and K ways to brake.

    A lead is the time from the warning to the end of the recording.

    At a given lead, only accidents whose recordings are at least that long are counted. Arrays are
    read-only; values are NaN where no accident is counted.

    Attributes:
        group: One of `ACCIDENT_GROUPS`.
        warned: One of `WARNED`.
        brakings: The K ways to brake.
        leads: Seconds from the warning to the end of the recording, shape (L,): 0, 0.1, …
        accidents: Number of accidents counted at each lead, shape (L,).
        shares: Fraction of the accidents with each of `OUTCOMES`, shape (L, K, 5).
        extrapolated: Fraction of the accidents with contact only after the end of the recording,
            shape (L, K).
        relative_speed: Mean relative speed of the two colliders at contact in m/s, shape (L, K);
            avoided accidents count as 0.
        delta_v: Mean of the larger of the two delta-v in m/s, shape (L, K, 3): for the assumed
            masses, then the smallest and the largest value for masses that are off by up to
            `MASS_UNCERTAINTY`.
    """

    group: str
    warned: str
    brakings: tuple[Braking, ...]
    leads: FloatArray
    accidents: IntArray
    shares: FloatArray
    extrapolated: FloatArray
    relative_speed: FloatArray
    delta_v: FloatArray


def group_of(accident: Avoidability) -> str:
    """Return which of `ACCIDENT_GROUPS` an accident belongs to."""
    if accident.pedestrian:
        return "pedestrians"
    if accident.head_on:
        return "head-on"
    return "vehicles"


def outcomes_if_warned(accident: Avoidability, warned: str) -> Outcomes | None:
    """Return the outcomes if the `warned` driver brakes; None for an ego that does not collide."""
    if warned != "ego":
        return accident.outcomes[BRAKERS.index(warned)]
    agents = accident.accident.agents
    if "ego_vehicle" in agents:
        return accident.outcomes[agents.index("ego_vehicle")]
    return None


def outcome_shares(accidents: Sequence[Avoidability]) -> list[OutcomeShares]:
    """Compute how often each outcome occurs, for each group of accidents and each of `WARNED`.

    Groups without accidents are left out.

    Args:
        accidents: Replayed accidents; all must use the same ways to brake.
    """
    shares = []
    for group, warned in product(ACCIDENT_GROUPS, WARNED):
        members = []
        for accident in accidents:
            outcomes = outcomes_if_warned(accident, warned)
            if outcomes is not None and group_of(accident) == group:
                members.append((accident, outcomes))
        if members:
            shares.append(_average_outcomes(group, warned, members))
    return shares


def _average_outcomes(
    group: str, warned: str, members: Sequence[tuple[Avoidability, Outcomes]]
) -> OutcomeShares:
    """Average the outcomes of a group's accidents; `members` pairs each accident with its own."""
    brakings = members[0][0].brakings
    num_leads = max(len(outcomes.outcome) for _, outcomes in members)
    sums = np.zeros((num_leads, len(brakings), len(OUTCOMES) + 5))
    accidents = np.zeros(num_leads, dtype=np.int64)
    for accident, outcomes in members:
        num_recorded = len(outcomes.outcome)
        accidents[:num_recorded] += 1
        sums[:num_recorded] += _accident_figures(accident, outcomes)
    means = sums / accidents[:, None, None]
    shares, extrapolated, relative_speed, delta_v = np.split(
        means, np.cumsum([len(OUTCOMES), 1, 1]), axis=2
    )
    return OutcomeShares(
        group=group,
        warned=warned,
        brakings=brakings,
        leads=as_floats(np.arange(num_leads) * FRAME_PERIOD),
        accidents=accidents,
        shares=shares,
        extrapolated=extrapolated[..., 0],
        relative_speed=relative_speed[..., 0],
        delta_v=delta_v,
    )


def _accident_figures(accident: Avoidability, outcomes: Outcomes) -> FloatArray:
    """Return the figures of one accident, shape (L, K, 10).

    The columns are: 1 for its outcome and 0 for the other four, whether the contact is
    extrapolated, the relative speed, and the delta-v (assumed masses, smallest, largest).
    """
    # The relative speed splits into the delta-v of the two.
    relative_speed = outcomes.delta_v.sum(axis=-1)
    ranges = delta_v_ranges(accident.accident.masses, relative_speed).max(axis=-2)
    is_outcome = outcomes.outcome[..., None] == np.arange(len(OUTCOMES))
    delta_v = outcomes.delta_v.max(axis=-1)
    return np.dstack([is_outcome, outcomes.extrapolated, relative_speed, delta_v, ranges])


@dataclass(frozen=True, slots=True, kw_only=True)
class AvoidabilityReport(Report):
    """Report on how late braking could still have avoided each accident.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        accidents: Replayed accidents, in the release's order.
        dropped: Accidents that cannot be replayed because the two are too far apart at the end.
        skipped: Scenarios without meta or labels.
        margins: Scenario → metres between the two in the last frame; also contains the dropped
            accidents.
    """

    dataroot: str
    version: str
    accidents: tuple[Avoidability, ...]
    dropped: tuple[Skipped, ...]
    skipped: tuple[Skipped, ...]
    margins: Mapping[str, float]

    @property
    def shares(self) -> list[OutcomeShares]:
        """How often each outcome occurs by warning time, for each group and choice of drivers."""
        return outcome_shares(self.accidents)

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON: counts, left-out scenarios with reasons, and last moments."""
        accidents = [
            {"group": group_of(accident), **accident.to_dict(warnings=False)}
            for accident in self.accidents
        ]
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "dropped": {dropped.scenario: dropped.reason for dropped in self.dropped},
            "skipped": {skipped.scenario: skipped.reason for skipped in self.skipped},
            "margins": dict(self.margins),
            "accidents": accidents,
        }

    def named_tables(self) -> dict[str, Iterable[Row]]:
        """Return the tables of last moments, other contacts, shares, self-check and omissions."""
        return {
            "avoidability_last_moments": self._last_moment_rows(),
            "avoidability_secondary_contacts": self._secondary_rows(),
            "avoidability_outcome_shares": self._share_rows(),
            "avoidability_self_check": self._check_rows(),
            "avoidability_left_out": self._left_out_rows(),
        }

    def to_text(self) -> str:
        """Return the report as blocks of aligned lines."""
        left_out = {
            "excluded, as the two are too far apart at the end": self.dropped,
            "skipped": self.skipped,
        }
        counts = [counted(len(self.accidents), "accident")]
        for title, omissions in left_out.items():
            if omissions:
                counts.append(f"{len(omissions)} {title}")
        head = f"DeepAccident {self.version} at {self.dataroot}\n{'; '.join(counts)}"
        if self.accidents:
            touching = [accident.accident.touching for accident in self.accidents]
            head += f"\n{counted_text(touching)}"
        blocks = [head]
        blocks += [self._group_text(group) for group in ACCIDENT_GROUPS if self.members(group)]
        if self.margins:
            blocks.append(self._margins_text())
        for title, omissions in left_out.items():
            if omissions:
                blocks.append(reasons_text(title, omissions))
        return "\n\n".join(blocks)

    @property
    def margin_counts(self) -> dict[str, int]:
        """Number of accidents in each size class of `margins`; the keys describe the class."""
        bounds = [0.01, 0.1, 0.5, MAX_END_GAP_M]
        counts, _ = np.histogram(list(self.margins.values()), bins=[0, *bounds, np.inf])
        names = [f"below {bound:g} m" for bound in bounds]
        names.append(f"{MAX_END_GAP_M:g} m or more")
        return dict(zip(names, counts.tolist(), strict=True))

    def members(self, group: str) -> list[Avoidability]:
        """Return the accidents of one of `ACCIDENT_GROUPS`."""
        return [accident for accident in self.accidents if group_of(accident) == group]

    def _group_text(self, group: str) -> str:
        """Return a table of how many accidents braking avoids, and how much warning that takes.

        It has one row for each combination of braking drivers and deceleration.
        """
        members = self.members(group)
        reactions = sorted({braking.reaction for braking in members[0].brakings})
        heading = ["brakes", "m/s²", "avoidable", "hit only after the end"]
        rows = [heading + [f"reaction {reaction:g} s" for reaction in reactions]]
        slack = np.stack([accident.slack for accident in members])
        extrapolated = np.stack([accident.last_moments.extrapolated for accident in members])
        extrapolated = extrapolated.reshape(slack.shape)
        ranks = [int(np.ceil(share * len(members))) - 1 for share in _TEXT_SHARES]
        for row, brakers in enumerate(BRAKERS):
            for column, deceleration in enumerate(members[0].decelerations.tolist()):
                seconds = np.sort(slack[:, row, column])  # unavoidable accidents come last
                avoidable_count = np.isfinite(seconds).sum()
                later_count = extrapolated[:, row, column].sum()
                cells = [brakers, f"{deceleration:g}", str(avoidable_count), str(later_count)]
                for reaction in reactions:
                    texts = map(_seconds_text, seconds[ranks] + reaction)
                    cells.append(" / ".join(texts))
                rows.append(cells)
        share_text = " and ".join(f"{100 * share:.0f} %" for share in _TEXT_SHARES)
        return (
            f"{group}: {counted(len(members), 'accident')}; seconds of warning that {share_text} "
            f"of them need\n{columns_text(rows)}\n"
            f"{_secondary_text(members)}"
        )

    def _margins_text(self) -> str:
        """Return how many accidents are in each margin class, and the largest margin."""
        lines = ["gaps at the last frame, which count as contact:"]
        for name, count in self.margin_counts.items():
            if count:
                lines.append(f"  {name}: {count}")
        largest = max(self.margins, key=lambda name: self.margins[name])
        lines.append(f"  the largest: {self.margins[largest]:.3f} m, {largest}")
        return "\n".join(lines)

    def _last_moment_rows(self) -> Iterator[Row]:
        """Yield the rows of the table of last moments, one per accident and way to brake."""
        pair_columns = ("first_id", "first", "second_id", "second")
        yield ("scenario", "group", *pair_columns, *_LAST_MOMENT_COLUMNS, "secondary")
        for avoidability in self.accidents:
            accident = avoidability.accident
            colliders: list[Any] = []
            for actor_id, category in zip(accident.actor_ids, accident.categories, strict=True):
                colliders += [actor_id, category]
            for row in avoidability.last_moment_rows():
                yield (
                    accident.scenario,
                    group_of(avoidability),
                    *colliders,
                    *map(row.get, _LAST_MOMENT_COLUMNS),
                    len(row["secondary"]),
                )

    def _secondary_rows(self) -> Iterator[Row]:
        """Yield the rows of the table of contacts with third actors in replays of last moments."""
        yield ("scenario", "brakers", "deceleration", *_SECONDARY_COLUMNS)
        for accident in self.accidents:
            for row in accident.last_moment_rows():
                key = (accident.accident.scenario, row["brakers"], row["deceleration"])
                for contact in row["secondary"]:
                    yield (*key, *map(contact.get, _SECONDARY_COLUMNS))

    def _share_rows(self) -> Iterator[Row]:
        """Yield the rows of the table of outcome shares (units: s, m/s², m/s)."""
        yield (
            *("group", "warned", "reaction", "deceleration", "lead", "accidents", *OUTCOMES),
            *("extrapolated", "relative_speed", "delta_v", "delta_v_least", "delta_v_most"),
        )
        for shares in self.shares:
            for column, braking in enumerate(shares.brakings):
                for row, lead in enumerate(shares.leads.tolist()):
                    values = (
                        *shares.shares[row, column],
                        shares.extrapolated[row, column],
                        shares.relative_speed[row, column],
                        *shares.delta_v[row, column],
                    )
                    yield (
                        shares.group,
                        shares.warned,
                        braking.reaction,
                        braking.deceleration,
                        round(lead, 1),
                        int(shares.accidents[row]),
                        *(round(float(value), 6) for value in values),
                    )

    def _check_rows(self) -> Iterator[Row]:
        """Yield the rows of the self-check, which describe each accident's recorded impact."""
        yield _CHECK_COLUMNS
        for accident in self.accidents:
            recorded = accident.to_dict(warnings=False)["recorded"]
            delta_v: list[Any] = []
            for change, bounds in zip(recorded["delta_v"], recorded["delta_v_ranges"], strict=True):
                delta_v += [change, *bounds]
            yield (
                accident.accident.scenario,
                recorded["margin"],
                recorded["time"],
                round(accident.accident.duration, 1),
                *recorded["speeds"],
                *delta_v,
            )

    def _left_out_rows(self) -> Iterator[Row]:
        """Yield the rows of the table of accidents and scenarios that are left out."""
        yield ("scenario", "why", "reason", "margin")
        for title, omissions in (("dropped", self.dropped), ("skipped", self.skipped)):
            for skipped in omissions:
                margin = self.margins.get(skipped.scenario)
                yield (skipped.scenario, title, skipped.reason, margin)


@dataclass(frozen=True, slots=True)
class Dropped:
    """An accident that cannot be replayed because its recording does not show the impact.

    Attributes:
        why: The scenario, and the reason in words.
        margin: Metres between the two colliders in the last frame.
    """

    why: Skipped
    margin: float


def replay_accident(dataset: Dataset, scenario: ScenarioRecord) -> Avoidability | Dropped | None:
    """Replay the accident of a scenario, and find out how braking could have avoided it.

    Return None if no collision is recorded. Raise NotAvailableError if meta or labels are missing.
    """
    accident = accident_of(dataset, scenario)
    if accident is None:
        return None
    check = undisturbed(accident)
    if not check.usable:
        why = Skipped(scenario=accident.scenario, reason=unusable(accident, check))
        return Dropped(why, check.margin)
    return avoidability_of(accident, scenario_tracks(dataset, scenario))


def avoidability_report(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    **engine: Unpack[Engine],
) -> AvoidabilityReport:
    """Report how late braking could still have avoided each accident, for all nine `BRAKINGS`.

    Args:
        dataset: The release.
        scenarios: Tokens or records of scenarios; None for all. Scenarios whose meta file names no
            collision are ignored.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: If the release has no such scenario.
    """
    work: Callable[[Dataset, Any], Avoidability | Dropped | None] = replay_accident
    return report_of(
        dataset,
        map_scenarios(work, dataset, scenarios, label="Replaying accidents", at_once=1, **engine),
    )


def report_of(
    dataset: Dataset, replays: Sequence[Avoidability | Dropped | Skipped | None]
) -> AvoidabilityReport:
    """Build the report from the result of `replay_accident` for each scenario, in order."""
    accidents = select_results(Avoidability, replays)
    dropped = select_results(Dropped, replays)
    margins = {}
    for accident in accidents:
        margins[accident.accident.scenario] = accident.check.margin
    for unusable_accident in dropped:
        margins[unusable_accident.why.scenario] = unusable_accident.margin
    return AvoidabilityReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        accidents=accidents,
        dropped=tuple(unusable_accident.why for unusable_accident in dropped),
        skipped=select_results(Skipped, replays),
        margins=margins,
    )


def _secondary_text(accidents: Sequence[Avoidability]) -> str:
    """Return a sentence on how often third actors are hit when the last moments are replayed."""
    num_touched = 0
    num_before_end = 0
    num_replays = 0
    for accident in accidents:
        contacts = accident.secondary
        recorded = [contact for contact in contacts if not contact.extrapolated]
        num_touched += len({contact.replay for contact in contacts})
        num_before_end += len({contact.replay for contact in recorded})
        num_replays += int(np.isfinite(accident.last_moments.time).sum())
    return (
        f"other road users, who do not react, are touched in {num_before_end} of {num_replays} "
        f"replays of the last moment before the recording ends, in {num_touched} if all go "
        "straight on for 3 s"
    )


def _seconds_text(seconds: float) -> str:
    """Format seconds with two decimals; a dash if they are infinite."""
    if np.isfinite(seconds):
        return f"{seconds:.2f}"
    return "–"
