"""What braking would have changed in the accidents of a release: shares of outcomes, and `avoidability_report`."""

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


# Kinds of accidents that are counted apart: with a pedestrian, who does not brake as a vehicle does; of vehicles that
# meet head-on, where it matters most how the other goes on if one of them brakes; and all others.
ACCIDENT_GROUPS: Final = ("vehicles", "head-on", "pedestrians")
# Who is warned and brakes; `ego` alone counts only the accidents of the ego.
WARNED: Final = (*BRAKERS, "ego")
# Shares of accidents for which the text gives the seconds of warning that they need.
_SHARES: Final = (0.5, 0.9)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutcomeShares(FrozenArrays):
    """Shares of outcomes over a group of accidents, for L leads of the warning and K ways to brake.

    Accidents whose recording is shorter than a lead do not count at it. Arrays are read-only; NaN where none counts.

    Attributes:
        group: one of `ACCIDENT_GROUPS`.
        warned: one of `WARNED`.
        brakings: the K ways to brake.
        leads: (L,) seconds from the warning to the end of the recording: 0, 0.1, …
        accidents: (L,) how many count.
        shares: (L, K, 5) of `OUTCOMES`.
        extrapolated: (L, K) share in which they touch only after the end of the recording.
        relative_speed: (L, K) mean over all of these of the speed between the two at the contact, m/s; 0 if avoided.
        delta_v: (L, K, 3) the same of the larger delta-v of the two: with the assumed masses; the least and the most
            with masses that are wrong by up to `MASS_UNCERTAINTY`.
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
    """The one of `ACCIDENT_GROUPS` that an accident is counted in."""
    if accident.pedestrian:
        return "pedestrians"
    return "head-on" if accident.head_on else "vehicles"


def outcomes_if_warned(accident: Avoidability, warned: str) -> Outcomes | None:
    """What warnings of the one of `WARNED` change; None if the ego is to be warned and is not of the pair."""
    if warned != "ego":
        return accident.outcomes[BRAKERS.index(warned)]
    agents = accident.accident.agents
    return accident.outcomes[agents.index("ego_vehicle")] if "ego_vehicle" in agents else None


def outcome_shares(accidents: Sequence[Avoidability]) -> list[OutcomeShares]:
    """The shares of outcomes of each group of accidents and for each who is warned; groups without any are left out.

    Args:
        accidents: computed for the same ways to brake.
    """
    told = {
        (group, warned): [
            (each, found)
            for each in accidents
            if group_of(each) == group and (found := outcomes_if_warned(each, warned)) is not None
        ]
        for group, warned in product(ACCIDENT_GROUPS, WARNED)
    }
    return [_shares(group, warned, those) for (group, warned), those in told.items() if those]


def _shares(
    group: str, warned: str, told: Sequence[tuple[Avoidability, Outcomes]]
) -> OutcomeShares:
    brakings = told[0][0].brakings
    longest = max(len(outcomes.outcome) for _, outcomes in told)
    sums = np.zeros((longest, len(brakings), len(OUTCOMES) + 5))
    accidents = np.zeros(longest, dtype=np.int64)
    for accident, outcomes in told:
        rows = slice(0, len(outcomes.outcome))
        accidents[rows] += 1
        sums[rows] += _figures(accident, outcomes)
    means = sums / accidents[:, None, None]
    shares, extrapolated, relative, delta_v = np.split(
        means, np.cumsum([len(OUTCOMES), 1, 1]), axis=2
    )
    return OutcomeShares(
        group=group,
        warned=warned,
        brakings=brakings,
        leads=as_floats(np.arange(longest) * FRAME_PERIOD),
        accidents=accidents,
        shares=shares,
        extrapolated=extrapolated[..., 0],
        relative_speed=relative[..., 0],
        delta_v=delta_v,
    )


def _figures(accident: Avoidability, outcomes: Outcomes) -> FloatArray:
    """(L, K, 10) of one accident: each outcome 0 or 1, extrapolated 0 or 1, relative speed, delta-v, least, most."""
    relative = outcomes.delta_v.sum(axis=-1)  # the shares of the two add up to 1
    ranges = delta_v_ranges(accident.accident.masses, relative).max(axis=-2)
    classes = outcomes.outcome[..., None] == np.arange(len(OUTCOMES))
    return np.dstack(
        [classes, outcomes.extrapolated, relative, outcomes.delta_v.max(axis=-1), ranges]
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class AvoidabilityReport(Report):
    """When accidents could have been avoided by braking.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        accidents: those whose recording shows them, in the release's order.
        dropped: those whose recording does not: the two are too far apart at the end.
        skipped: scenarios of which meta or labels are missing.
        margins: scenario → metres between the two at the last frame, for all accidents, dropped ones too.
    """

    dataroot: str
    version: str
    accidents: tuple[Avoidability, ...]
    dropped: tuple[Skipped, ...]
    skipped: tuple[Skipped, ...]
    margins: Mapping[str, float]

    @property
    def shares(self) -> list[OutcomeShares]:
        """Shares of outcomes by the seconds of warning, for each group of accidents and for each who is warned."""
        return outcome_shares(self.accidents)

    def to_dict(self) -> dict[str, Any]:
        """Values for JSON: counts, what is left out and why, and the last moments of each accident."""
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "dropped": {each.scenario: each.reason for each in self.dropped},
            "skipped": {each.scenario: each.reason for each in self.skipped},
            "margins": dict(self.margins),
            "accidents": [
                {"group": group_of(each), **each.to_dict(warnings=False)} for each in self.accidents
            ],
        }

    def named_tables(self) -> dict[str, Iterable[Row]]:
        """Last moments, contacts with others, shares of outcomes, the self-check, and what is left out."""
        return {
            "avoidability_last_moments": self._last_moment_rows(),
            "avoidability_secondary_contacts": self._secondary_rows(),
            "avoidability_outcome_shares": self._share_rows(),
            "avoidability_self_check": self._check_rows(),
            "avoidability_left_out": self._left_out_rows(),
        }

    def to_text(self) -> str:
        """Some aligned blocks for a terminal."""
        left_out = {
            "dropped, as the two are too far apart at the end": self.dropped,
            "skipped": self.skipped,
        }
        counts = [
            f"{len(self.accidents)} accidents",
            *(f"{len(each)} {word}" for word, each in left_out.items() if each),
        ]
        blocks = [f"DeepAccident {self.version} at {self.dataroot}\n{'; '.join(counts)}"]
        if self.accidents:
            blocks[0] += f"\n{counted_text([each.accident.touching for each in self.accidents])}"
        blocks += [self._group_text(group) for group in ACCIDENT_GROUPS if self.members(group)]
        if self.margins:
            blocks.append(self._margins_text())
        blocks += [reasons_text(word, which) for word, which in left_out.items() if which]
        return "\n\n".join(blocks)

    @property
    def margin_counts(self) -> dict[str, int]:
        """Size in words → how many of the `margins` are of that size."""
        bounds = [0, 0.01, 0.1, 0.5, MOST_MARGIN]
        counts = np.histogram(list(self.margins.values()), bins=[*bounds, np.inf])[0].tolist()
        names = [f"below {bound:g} m" for bound in bounds[1:]] + [f"{MOST_MARGIN:g} m or more"]
        return dict(zip(names, counts, strict=True))

    def members(self, group: str) -> list[Avoidability]:
        """The accidents of one of `ACCIDENT_GROUPS`."""
        return [each for each in self.accidents if group_of(each) == group]

    def _group_text(self, group: str) -> str:
        """A line for each who brakes and how hard: how many are avoidable, and how much warning they need."""
        members = self.members(group)
        reactions = sorted({braking.reaction for braking in members[0].brakings})
        heading = ["brakes", "m/s²", "avoidable", "hit only after the end"]
        rows = [heading + [f"reaction {each:g} s" for each in reactions]]
        slack = np.stack([each.slack for each in members])
        extrapolated = np.stack([each.last_moments.extrapolated for each in members]).reshape(
            slack.shape
        )
        for row, brakers in enumerate(BRAKERS):
            for column, deceleration in enumerate(members[0].decelerations.tolist()):
                needed = np.sort(slack[:, row, column])  # those that nothing avoids are last
                places = [int(np.ceil(share * len(needed))) - 1 for share in _SHARES]
                counts = (np.isfinite(needed).sum(), extrapolated[:, row, column].sum())
                cells = [
                    " / ".join(_seconds_text(needed[place] + each) for place in places)
                    for each in reactions
                ]
                rows.append(
                    [brakers, f"{deceleration:g}", *(str(count) for count in counts), *cells]
                )
        meant = " and ".join(f"{share:.0%}" for share in _SHARES)
        return (
            f"{group}: {len(members)} accidents; seconds of warning that {meant} of them need\n{columns_text(rows)}\n"
            f"{_secondary_text(members)}"
        )

    def _margins_text(self) -> str:
        """How many margins of the self-check there are of each size; the largest by name."""
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
        names = (
            "brakers",
            "deceleration",
            "avoidable",
            "last_moment",
            "slack",
            "switches",
            "extrapolated",
        )
        yield ("scenario", "group", "first_id", "first", "second_id", "second", *names, "secondary")
        for each in self.accidents:
            accident = each.accident
            who = [
                value
                for pair in zip(accident.actor_ids, accident.categories, strict=True)
                for value in pair
            ]
            for row in each.last_moment_rows():
                yield (
                    accident.scenario,
                    group_of(each),
                    *who,
                    *map(row.get, names),
                    len(row["secondary"]),
                )

    def _secondary_rows(self) -> Iterator[Row]:
        names = ("actor_id", "other_id", "category", "time", "extrapolated")
        yield ("scenario", "brakers", "deceleration", *names)
        for each in self.accidents:
            for row in each.last_moment_rows():
                for contact in row["secondary"]:
                    yield (
                        each.accident.scenario,
                        row["brakers"],
                        row["deceleration"],
                        *map(contact.get, names),
                    )

    def _share_rows(self) -> Iterator[Row]:
        yield (
            *("group", "warned", "reaction", "deceleration", "lead", "accidents", *OUTCOMES),
            *("extrapolated", "relative_speed", "delta_v", "delta_v_least", "delta_v_most"),
        )
        for each in self.shares:
            for column, braking in enumerate(each.brakings):
                for row, lead in enumerate(each.leads.tolist()):
                    values = (
                        *(*each.shares[row, column], each.extrapolated[row, column]),
                        *(each.relative_speed[row, column], *each.delta_v[row, column]),
                    )
                    key = (
                        each.group,
                        each.warned,
                        braking.reaction,
                        braking.deceleration,
                        round(lead, 1),
                    )
                    yield (
                        *key,
                        int(each.accidents[row]),
                        *(round(float(value), 6) for value in values),
                    )

    def _check_rows(self) -> Iterator[Row]:
        sides = ("first", "second")
        yield (
            *("scenario", "margin", "time", "end", *(f"speed_{side}" for side in sides)),
            *(f"delta_v_{side}{end}" for side in sides for end in ("", "_least", "_most")),
        )
        for each in self.accidents:
            told = each.to_dict(warnings=False)["recorded"]
            changes = zip(told["delta_v"], told["delta_v_ranges"], strict=True)
            delta_v = [value for change, both in changes for value in (change, *both)]
            key = (
                each.accident.scenario,
                told["margin"],
                told["time"],
                round(each.accident.duration, 1),
            )
            yield (*key, *told["speeds"], *delta_v)

    def _left_out_rows(self) -> Iterator[Row]:
        yield ("scenario", "why", "reason", "margin")
        for word, which in (("dropped", self.dropped), ("skipped", self.skipped)):
            for each in which:
                yield (each.scenario, word, each.reason, self.margins.get(each.scenario))


@dataclass(frozen=True, slots=True)
class Dropped:
    """An accident that its recording does not show.

    Attributes:
        why: in words.
        margin: metres between the two at the last frame.
    """

    why: Skipped
    margin: float


def looked_into(dataset: Dataset, scenario: ScenarioRecord) -> Avoidability | Dropped | None:
    """When a scenario's accident could have been avoided; None if it has no collision. Raises NotAvailableError."""
    accident = accident_of(dataset, scenario)
    if accident is None:
        return None
    check = undisturbed(accident)
    if not check.usable:
        return Dropped(
            Skipped(scenario=accident.scenario, reason=unusable(accident, check)), check.margin
        )
    return avoidability_of(accident, scenario_tracks(dataset, scenario))


def avoidability_report(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    **how: Unpack[Engine],
) -> AvoidabilityReport:
    """When the accidents of scenarios could have been avoided by braking, in the nine ways of `BRAKINGS`.

    Args:
        dataset: the release.
        scenarios: tokens or records; None for all. Those whose meta file names no collision do not count.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        TokenError: no such scenario.
    """
    work: Callable[[Dataset, Any], Avoidability | Dropped | None] = looked_into
    return report_of(
        dataset, each_scenario(work, dataset, scenarios, label="replaying", at_once=1, **how)
    )


def report_of(
    dataset: Dataset, found: Sequence[Avoidability | Dropped | Skipped | None]
) -> AvoidabilityReport:
    """The report of what `looked_into` gave for scenarios, in their order."""
    accidents, dropped = those_of(Avoidability, found), those_of(Dropped, found)
    return AvoidabilityReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        accidents=accidents,
        dropped=tuple(each.why for each in dropped),
        skipped=those_of(Skipped, found),
        margins={
            **{each.accident.scenario: each.check.margin for each in accidents},
            **{each.why.scenario: each.margin for each in dropped},
        },
    )


def _secondary_text(accidents: Sequence[Avoidability]) -> str:
    """In how many replays of braking at the last moment another actor is touched."""
    touched = [{each.replay for each in accident.secondary} for accident in accidents]
    before = [
        {each.replay for each in accident.secondary if not each.extrapolated}
        for accident in accidents
    ]
    replays = sum(int(np.isfinite(accident.last_moments.time).sum()) for accident in accidents)
    return (
        f"other road users, who do not react, are touched in {sum(map(len, before))} of {replays} replays of the last "
        f"moment before the recording ends, in {sum(map(len, touched))} if all go straight on for 3 s"
    )


def _seconds_text(seconds: float) -> str:
    return f"{seconds:.2f}" if np.isfinite(seconds) else "–"
