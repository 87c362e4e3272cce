"""What braking would have changed in the accidents of a release.

Has the shares of outcomes (`outcome_shares`), and `avoidability_report`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.collisions.outcomes import (
    MOST_MARGIN,
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
    each_scenario,
    reasons_text,
    those_of,
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
from deepaccident_devkit.support.text import columns_text
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine
    from deepaccident_devkit.tables.records import ScenarioRecord


# Kinds of accidents that are counted separately: with a pedestrian, which does not brake as a
# vehicle does; of vehicles that meet head-on, where it matters most how the other goes on if one of
# them brakes; and all others.
ACCIDENT_GROUPS: Final = ("vehicles", "head-on", "pedestrians")
# The drivers that are warned and brake; `ego` counts only the accidents of the ego.
WARNED: Final = (*BRAKERS, "ego")
# Shares of accidents for which the text states the seconds of warning that they need.
_TEXT_SHARES: Final = (0.5, 0.9)
# Columns of the table of last moments.
_LAST_MOMENT_COLUMNS: Final = (
    "brakers",
    "deceleration",
    "avoidable",
    "last_moment",
    "slack",
    "switches",
    "extrapolated",
)
# Columns of the table of contacts with other actors.
_SECONDARY_COLUMNS: Final = ("actor_id", "other_id", "category", "time", "extrapolated")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutcomeShares(FrozenArrays):
    """Shares of outcomes over a group of accidents, for L leads of the warning and K ways to brake.

    Accidents with a recording shorter than a lead do not count at it. Arrays are read-only; NaN
    where no accident counts.

    Attributes:
        group: One of `ACCIDENT_GROUPS`.
        warned: One of `WARNED`.
        brakings: The K ways to brake.
        leads: Seconds from the warning to the end of the recording, shape (L,): 0, 0.1, …
        accidents: Number of accidents that count, shape (L,).
        shares: Share of each of `OUTCOMES`, shape (L, K, 5).
        extrapolated: Share in which they touch only after the end of the recording, shape (L, K).
        relative_speed: Mean speed in m/s between the two at the contact over all of these
            accidents, shape (L, K); 0 if avoided.
        delta_v: Mean of the larger delta-v of the two in m/s, shape (L, K, 3): with the assumed
            masses, and the smallest and the largest with masses that are wrong by up to
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
    """Return the one of `ACCIDENT_GROUPS` that an accident is counted in."""
    if accident.pedestrian:
        return "pedestrians"
    if accident.head_on:
        return "head-on"
    return "vehicles"


def outcomes_if_warned(accident: Avoidability, warned: str) -> Outcomes | None:
    """Return what warnings change, for one of `WARNED`; None for an ego that is not of the pair."""
    if warned != "ego":
        return accident.outcomes[BRAKERS.index(warned)]
    agents = accident.accident.agents
    if "ego_vehicle" in agents:
        return accident.outcomes[agents.index("ego_vehicle")]
    return None


def outcome_shares(accidents: Sequence[Avoidability]) -> list[OutcomeShares]:
    """Return the shares of outcomes by group of accidents and by warned drivers.

    Groups without any accident are left out.

    Args:
        accidents: Accidents computed for the same ways to brake.
    """
    shares = []
    for group, warned in product(ACCIDENT_GROUPS, WARNED):
        members = []
        for accident in accidents:
            if group_of(accident) == group:
                outcomes = outcomes_if_warned(accident, warned)
                if outcomes is not None:
                    members.append((accident, outcomes))
        if members:
            shares.append(_group_shares(group, warned, members))
    return shares


def _group_shares(
    group: str, warned: str, members: Sequence[tuple[Avoidability, Outcomes]]
) -> OutcomeShares:
    brakings = members[0][0].brakings
    num_leads = max(len(outcomes.outcome) for _, outcomes in members)
    sums = np.zeros((num_leads, len(brakings), len(OUTCOMES) + 5))
    accidents = np.zeros(num_leads, dtype=np.int64)
    for accident, outcomes in members:
        rows = slice(0, len(outcomes.outcome))
        accidents[rows] += 1
        sums[rows] += _accident_figures(accident, outcomes)
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

    They are 0 or 1 for each outcome, 0 or 1 for extrapolated, the relative speed, and the delta-v
    with its smallest and its largest value.
    """
    # The shares of the two add up to 1, so their sum is the relative speed.
    relative_speed = outcomes.delta_v.sum(axis=-1)
    ranges = delta_v_ranges(accident.accident.masses, relative_speed).max(axis=-2)
    is_outcome = outcomes.outcome[..., None] == np.arange(len(OUTCOMES))
    delta_v = outcomes.delta_v.max(axis=-1)
    return np.dstack([is_outcome, outcomes.extrapolated, relative_speed, delta_v, ranges])


@dataclass(frozen=True, slots=True, kw_only=True)
class AvoidabilityReport(Report):
    """When accidents could have been avoided by braking.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        accidents: Accidents that their recordings show, in the release's order.
        dropped: Accidents that their recordings do not show: the two are too far apart at the end.
        skipped: Scenarios without meta or labels.
        margins: Scenario → metres between the two at the last frame, for all accidents, dropped
            ones too.
    """

    dataroot: str
    version: str
    accidents: tuple[Avoidability, ...]
    dropped: tuple[Skipped, ...]
    skipped: tuple[Skipped, ...]
    margins: Mapping[str, float]

    @property
    def shares(self) -> list[OutcomeShares]:
        """Shares of outcomes by the seconds of warning, for each group and all warned drivers."""
        return outcome_shares(self.accidents)

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON: counts, omissions with reasons, and the last moments."""
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
        """Return last moments, other contacts, outcome shares, the self-check, and omissions."""
        return {
            "avoidability_last_moments": self._last_moment_rows(),
            "avoidability_secondary_contacts": self._secondary_rows(),
            "avoidability_outcome_shares": self._share_rows(),
            "avoidability_self_check": self._check_rows(),
            "avoidability_left_out": self._left_out_rows(),
        }

    def to_text(self) -> str:
        """Return some aligned blocks for a terminal."""
        left_out = {
            "dropped, as the two are too far apart at the end": self.dropped,
            "skipped": self.skipped,
        }
        counts = [f"{len(self.accidents)} accidents"]
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
        """Size in words → number of `margins` of that size."""
        bounds = [0, 0.01, 0.1, 0.5, MOST_MARGIN]
        counts = np.histogram(list(self.margins.values()), bins=[*bounds, np.inf])[0].tolist()
        names = [f"below {bound:g} m" for bound in bounds[1:]] + [f"{MOST_MARGIN:g} m or more"]
        return dict(zip(names, counts, strict=True))

    def members(self, group: str) -> list[Avoidability]:
        """Return the accidents of one of `ACCIDENT_GROUPS`."""
        return [accident for accident in self.accidents if group_of(accident) == group]

    def _group_text(self, group: str) -> str:
        """Return how many accidents braking avoids, and how much warning they need.

        There is a line for each way to choose the braking drivers and the deceleration.
        """
        members = self.members(group)
        reactions = sorted({braking.reaction for braking in members[0].brakings})
        heading = ["brakes", "m/s²", "avoidable", "hit only after the end"]
        rows = [heading + [f"reaction {reaction:g} s" for reaction in reactions]]
        slack = np.stack([accident.slack for accident in members])
        extrapolated = np.stack([accident.last_moments.extrapolated for accident in members])
        extrapolated = extrapolated.reshape(slack.shape)
        for row, brakers in enumerate(BRAKERS):
            for column, deceleration in enumerate(members[0].decelerations.tolist()):
                seconds = np.sort(slack[:, row, column])  # accidents that nothing avoids come last
                ranks = [int(np.ceil(share * len(seconds))) - 1 for share in _TEXT_SHARES]
                avoidable = np.isfinite(seconds).sum()
                later = extrapolated[:, row, column].sum()
                cells = [brakers, f"{deceleration:g}", str(avoidable), str(later)]
                for reaction in reactions:
                    texts = [_seconds_text(seconds[rank] + reaction) for rank in ranks]
                    cells.append(" / ".join(texts))
                rows.append(cells)
        share_text = " and ".join(f"{share:.0%}" for share in _TEXT_SHARES)
        return (
            f"{group}: {len(members)} accidents; seconds of warning that {share_text} of them "
            f"need\n{columns_text(rows)}\n"
            f"{_secondary_text(members)}"
        )

    def _margins_text(self) -> str:
        """Return the number of margins of the self-check by size, and the largest one by name."""
        lines = [f"  {name}: {count}" for name, count in self.margin_counts.items() if count]
        largest = max(self.margins, key=lambda name: self.margins[name])
        return "\n".join(
            [
                "gaps at the last frame, which count as contact:",
                *lines,
                f"  the largest: {self.margins[largest]:.3f} m, {largest}",
            ]
        )

    def _last_moment_rows(self) -> Iterator[Row]:
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
        yield ("scenario", "brakers", "deceleration", *_SECONDARY_COLUMNS)
        for accident in self.accidents:
            for row in accident.last_moment_rows():
                key = (accident.accident.scenario, row["brakers"], row["deceleration"])
                for contact in row["secondary"]:
                    yield (*key, *map(contact.get, _SECONDARY_COLUMNS))

    def _share_rows(self) -> Iterator[Row]:
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
        sides = ("first", "second")
        yield (
            *("scenario", "margin", "time", "end", *(f"speed_{side}" for side in sides)),
            *(f"delta_v_{side}{end}" for side in sides for end in ("", "_least", "_most")),
        )
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
        yield ("scenario", "why", "reason", "margin")
        for title, omissions in (("dropped", self.dropped), ("skipped", self.skipped)):
            for skipped in omissions:
                margin = self.margins.get(skipped.scenario)
                yield (skipped.scenario, title, skipped.reason, margin)


@dataclass(frozen=True, slots=True)
class Dropped:
    """An accident that its recording does not show.

    Attributes:
        why: Reason in words.
        margin: Metres between the two at the last frame.
    """

    why: Skipped
    margin: float


def replay_accident(dataset: Dataset, scenario: ScenarioRecord) -> Avoidability | Dropped | None:
    """Return when a scenario's accident could have been avoided; None if it has no collision.

    Raises NotAvailableError.
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
    """Return when accidents could have been avoided by braking, in the nine ways of `BRAKINGS`.

    Args:
        dataset: The release.
        scenarios: Tokens or records of scenarios; None for all. Scenarios with a meta file that
            names no collision do not count.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: There is no such scenario.
    """
    work: Callable[[Dataset, Any], Avoidability | Dropped | None] = replay_accident
    return report_of(
        dataset, each_scenario(work, dataset, scenarios, label="replaying", at_once=1, **engine)
    )


def report_of(
    dataset: Dataset, replays: Sequence[Avoidability | Dropped | Skipped | None]
) -> AvoidabilityReport:
    """Return the report of the results of `replay_accident` for scenarios, in their order."""
    accidents, dropped = those_of(Avoidability, replays), those_of(Dropped, replays)
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
        skipped=those_of(Skipped, replays),
        margins=margins,
    )


def _secondary_text(accidents: Sequence[Avoidability]) -> str:
    """Return in how many replays of braking at the last moment another actor is touched."""
    num_touched = num_before_end = num_replays = 0
    for accident in accidents:
        contacts = accident.secondary
        num_touched += len({contact.replay for contact in contacts})
        num_before_end += len({contact.replay for contact in contacts if not contact.extrapolated})
        num_replays += int(np.isfinite(accident.last_moments.time).sum())
    return (
        f"other road users, who do not react, are touched in {num_before_end} of {num_replays} "
        f"replays of the last moment before the recording ends, in {num_touched} if all go "
        "straight on for 3 s"
    )


def _seconds_text(seconds: float) -> str:
    if np.isfinite(seconds):
        return f"{seconds:.2f}"
    return "–"
