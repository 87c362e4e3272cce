"""When it was too late: the last moment to brake, and what a warning at each earlier moment would have changed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.accidents.contact import Pair, SecondaryContact, contact_made, pair_of, secondary_contacts
from deepaccident_devkit.accidents.outcomes import (
    BRAKINGS,
    MOST_MARGIN,
    OUTCOMES,
    Braking,
    Outcomes,
    ReplayCheck,
    delta_v_ranges,
    outcomes_of,
    undisturbed,
)
from deepaccident_devkit.accidents.recorded import Accident, Skipped, accident_of, each_scenario, reasons_text, those_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.reports import Report, Row
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays, IntArray, as_floats, checked, known
from deepaccident_devkit.support.text import columns_text
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine
    from deepaccident_devkit.tables.records import ScenarioRecord


BRAKERS: Final = ("first", "second", "both")
"""Who of the pair brakes; the pair is in the meta file's order."""
MASKS: Final = ((True, False), (False, True), (True, True))
"""The same as `outcomes_of` takes it."""
_SCAN_STEP: Final = 0.01
"""Seconds between the starts of braking that are tried."""
_HEAD_ON: Final = 3 * math.pi / 4
"""Least angle between the headings at the end, radians."""
GROUPS: Final = ("vehicles", "head-on", "pedestrians")
"""Kinds of accidents that are counted apart: with a pedestrian, who does not brake as a vehicle does; of vehicles that
meet head-on, where it matters most how the other goes on if one of them brakes; and all others."""
WARNED: Final = (*BRAKERS, "ego")
"""Who is warned and brakes; `ego` alone counts only the accidents of the ego."""
_SHARES: Final = (0.5, 0.9)
"""Shares of accidents for which the text gives the seconds of warning that they need."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LastMoments(FrozenArrays):
    """The last moments to brake of N ways to brake; arrays are read-only.

    Attributes:
        time: (N,) seconds from the first frame: the latest start of a braking that avoids the accident; NaN if none
            does.
        switches: (N,) how often the answer changes from one tried start to the next. More than once: braking a little
            earlier than the last moment can be worse than it, as when one passes behind the other.
        extrapolated: (N,) whether no start avoids the accident, but some start does until the recording ends: the
            contact is one of the continuation, in which the other goes straight on.
    """

    time: FloatArray
    switches: IntArray
    extrapolated: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Avoidability(FrozenArrays):
    """When an accident could have been avoided by braking, and what warnings would have changed. Arrays are read-only.

    Attributes:
        accident: the recorded motion.
        check: the replay in which nobody brakes.
        brakings: the K ways to brake after a warning.
        decelerations: (D,) m/s², those of `brakings`, ascending.
        last_moments: one value for each of `BRAKERS` and each deceleration, row by row (3 · D).
        leads: (L,) seconds from a warning to the end of the recording: 0, 0.1, …
        outcomes: for each of `BRAKERS` what the L warnings make of the accident in K ways.
        secondary: contacts with others in the replays in which the braking begins at the last moment; their `replay`
            is the position in `last_moments`.
    """

    accident: Accident
    check: ReplayCheck
    brakings: tuple[Braking, ...]
    decelerations: FloatArray
    last_moments: LastMoments
    leads: FloatArray
    outcomes: tuple[Outcomes, Outcomes, Outcomes]
    secondary: tuple[SecondaryContact, ...]

    @property
    def slack(self) -> FloatArray:
        """(3, D) seconds from the last moment to brake to the end of the recording; NaN if nothing avoids it."""
        slack: FloatArray = self.accident.duration - self.last_moments.time
        return slack.reshape(len(BRAKERS), -1)

    @property
    def head_on(self) -> bool:
        """Whether they meet head-on, where one who brakes alone depends on how the other goes on."""
        first, second = self.accident.paths[:, -1, 2]
        return abs(math.remainder(float(first - second), 2 * math.pi)) >= _HEAD_ON

    @property
    def pedestrian(self) -> bool:
        """Whether one of them walks: braking is no answer that a pedestrian gives."""
        return "pedestrian" in self.accident.categories

    def to_dict(self, *, warnings: bool = True) -> dict[str, Any]:
        """Values for JSON; None for what does not exist.

        Args:
            warnings: whether to give what each warning changes, some thousand values.
        """
        accident = self.accident
        actors = zip(accident.actor_ids, accident.categories, accident.agents, accident.masses.tolist(), strict=True)
        result: dict[str, Any] = {
            "scenario": accident.scenario,
            "actors": [dict(zip(("actor_id", "category", "agent", "mass"), each, strict=True)) for each in actors],
            "duration": round(accident.duration, 1),
            "head_on": self.head_on,
            "pedestrian": self.pedestrian,
            "recorded": self._recorded(),
            "last_moments": list(self.last_moment_rows()),
        }
        if warnings:
            result["leads"] = [round(lead, 1) for lead in self.leads.tolist()]
            result["warnings"] = list(self._warning_rows())
        return result

    def last_moment_rows(self) -> Iterator[dict[str, Any]]:
        """For each of `BRAKERS` and each deceleration the last moment to brake, and what comes with it."""
        moments = self.last_moments
        for row, (brakers, deceleration) in enumerate(product(BRAKERS, self.decelerations.tolist())):
            yield {
                "brakers": brakers,
                "deceleration": deceleration,
                "avoidable": bool(np.isfinite(moments.time[row])),
                "last_moment": known(moments.time[row], 2),
                "slack": known(self.slack.flat[row], 2),
                "switches": int(moments.switches[row]),
                "extrapolated": bool(moments.extrapolated[row]),
                "secondary": [
                    {
                        "actor_id": each.actor_id,
                        "other_id": each.other_id,
                        "category": each.category,
                        "time": round(each.time, 3),
                        "extrapolated": each.extrapolated,
                    }
                    for each in self.secondary
                    if each.replay == row
                ],
            }

    def _recorded(self) -> dict[str, Any]:
        ranges = delta_v_ranges(self.accident.masses, self.relative_speed)
        return {
            "margin": self.check.margin,
            "time": round(self.check.time, 6),
            "speeds": known(self.check.speeds, 3),
            "delta_v": known(self.check.delta_v, 3),
            "delta_v_ranges": known(ranges, 3),
        }

    @property
    def relative_speed(self) -> float:
        """m/s between the two at the recorded contact."""
        return float(self.check.delta_v.sum())  # the shares of the two add up to 1

    def _warning_rows(self) -> Iterator[dict[str, Any]]:
        for brakers, outcomes in zip(BRAKERS, self.outcomes, strict=True):
            for column, braking in enumerate(self.brakings):
                yield {
                    "brakers": brakers,
                    "reaction": braking.reaction,
                    "deceleration": braking.deceleration,
                    "outcome": [OUTCOMES[code] for code in outcomes.outcome[:, column]],
                    "extrapolated": outcomes.extrapolated[:, column].tolist(),
                    "speeds": known(outcomes.speeds[:, column], 3),
                    "delta_v": known(outcomes.delta_v[:, column], 3),
                    "reduction": known(outcomes.reduction[:, column], 3),
                }


def last_moments(pair: Pair, brakers: tuple[bool, bool], decelerations: ArrayLike) -> LastMoments:
    """The last moments to brake: each hundredth of a second is tried, since the answer may change more than once.

    Args:
        pair: the recorded motions.
        brakers: which of the two brake.
        decelerations: (N,) m/s².

    Raises:
        GeometryError: the decelerations have another shape.
    """
    hard = checked("decelerations", decelerations, (None,))
    tried = np.arange(round(pair.duration / _SCAN_STEP) + 1) * _SCAN_STEP
    starts = np.where(brakers, np.tile(tried, len(hard))[:, None], np.inf)
    each = np.repeat(hard, len(tried))
    avoids = ~contact_made(pair, starts, each).reshape(len(hard), -1)
    possible = avoids.any(axis=1)
    last = len(tried) - 1 - np.argmax(avoids[:, ::-1], axis=1)
    extrapolated = np.zeros(len(hard), dtype=bool)
    rows = np.flatnonzero(np.repeat(~possible, len(tried)))
    until_the_end = contact_made(pair, starts[rows], each[rows], window=(0.0, pair.duration))
    extrapolated[~possible] = (~until_the_end).reshape(-1, len(tried)).any(axis=1)
    return LastMoments(
        time=np.where(possible, tried[last], np.nan),
        switches=np.count_nonzero(np.diff(avoids, axis=1), axis=1).astype(np.int64),
        extrapolated=extrapolated,
    )


def unusable(accident: Accident, check: ReplayCheck) -> str:
    """Why an accident whose check fails cannot be replayed, in words."""
    first, second = accident.actor_ids
    return (
        f"{accident.scenario}: the outlines of {first} and {second} are {check.margin:.2f} m apart at their last "
        f"frame, more than {MOST_MARGIN:g} m: the recording does not show the accident"
    )


def avoidability_of(
    accident: Accident, tracks: ScenarioTracks | None = None, *, brakings: Sequence[Braking] = BRAKINGS
) -> Avoidability:
    """When an accident could have been avoided by braking.

    Args:
        accident: the recorded motion.
        tracks: of all actors of its scenario, for contacts with others than the pair; None leaves these out.
        brakings: the ways to brake after a warning.

    Raises:
        NotAvailableError: the gap between the two at the last frame is so large that the recording does not show the
            accident.
    """
    check = undisturbed(accident)
    if not check.usable:
        raise NotAvailableError(unusable(accident, check))
    pair = pair_of(accident.paths, accident.sizes)
    decelerations = np.unique([each.deceleration for each in brakings])
    scans = [last_moments(pair, brakers, decelerations) for brakers in MASKS]
    moments = LastMoments(
        **{name: np.concatenate([getattr(each, name) for each in scans]) for name in LastMoments.__slots__}
    )
    leads = as_floats(np.arange(accident.paths.shape[1]) * FRAME_PERIOD)
    first, second, both = (
        outcomes_of(accident, brakers, accident.duration - leads, brakings=brakings) for brakers in MASKS
    )
    return Avoidability(
        accident=accident,
        check=check,
        brakings=tuple(brakings),
        decelerations=decelerations,
        last_moments=moments,
        leads=leads,
        outcomes=(first, second, both),
        secondary=() if tracks is None else _secondary(accident, tracks, moments, decelerations),
    )


def avoidability(
    dataset: Dataset, scenario: RowArgument, *, brakings: Sequence[Braking] = BRAKINGS
) -> Avoidability | None:
    """When a scenario's accident could have been avoided by braking; None if the meta file names no collision.

    Args:
        dataset: the release.
        scenario: token or record.
        brakings: the ways to brake after a warning.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: the scenario lacks labels or meta, or its labels do not show the accident.
    """
    accident = accident_of(dataset, scenario)
    if accident is None:
        return None
    return avoidability_of(accident, scenario_tracks(dataset, scenario), brakings=brakings)


def _secondary(
    accident: Accident, tracks: ScenarioTracks, moments: LastMoments, decelerations: FloatArray
) -> tuple[SecondaryContact, ...]:
    """Contacts with others in the replays that avoid the accident at the last moment."""
    brakes = np.repeat(np.array(MASKS), len(decelerations), axis=0)
    starts = np.where(brakes & np.isfinite(moments.time)[:, None], moments.time[:, None], np.inf)
    return tuple(secondary_contacts(accident, tracks, starts, np.tile(decelerations, len(MASKS))))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutcomeShares(FrozenArrays):
    """Shares of outcomes over a group of accidents, for L leads of the warning and K ways to brake.

    Accidents whose recording is shorter than a lead do not count at it. Arrays are read-only; NaN where none counts.

    Attributes:
        group: one of `GROUPS`.
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
    """The one of `GROUPS` that an accident is counted in."""
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
    result = []
    for group in GROUPS:
        members = [each for each in accidents if group_of(each) == group]
        for warned in WARNED:
            told = [(each, found) for each in members if (found := outcomes_if_warned(each, warned)) is not None]
            if told:
                result.append(_shares(group, warned, told))
    return result


def _shares(group: str, warned: str, told: Sequence[tuple[Avoidability, Outcomes]]) -> OutcomeShares:
    brakings = told[0][0].brakings
    longest = max(len(outcomes.outcome) for _, outcomes in told)
    sums = np.zeros((longest, len(brakings), len(OUTCOMES) + 5))
    accidents = np.zeros(longest, dtype=np.int64)
    for accident, outcomes in told:
        rows = slice(0, len(outcomes.outcome))
        accidents[rows] += 1
        sums[rows] += _figures(accident, outcomes)
    means = sums / accidents[:, None, None]
    shares, extrapolated, relative, delta_v = np.split(means, np.cumsum([len(OUTCOMES), 1, 1]), axis=2)
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
    return np.dstack([classes, outcomes.extrapolated, relative, outcomes.delta_v.max(axis=-1), ranges])


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
            "accidents": [{"group": group_of(each), **each.to_dict(warnings=False)} for each in self.accidents],
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
        counts = f"{len(self.accidents)} accidents"
        left_out = {"dropped, as the two are too far apart at the end": self.dropped, "skipped": self.skipped}
        for word, which in left_out.items():
            counts += f"; {len(which)} {word}" if which else ""
        blocks = [f"DeepAccident {self.version} at {self.dataroot}\n{counts}"]
        blocks += [
            self._group_text(group) for group in GROUPS if any(group_of(each) == group for each in self.accidents)
        ]
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
        """The accidents of one of `GROUPS`."""
        return [each for each in self.accidents if group_of(each) == group]

    def _group_text(self, group: str) -> str:
        """A line for each who brakes and how hard: how many are avoidable, and how much warning they need."""
        members = self.members(group)
        reactions = sorted({braking.reaction for braking in members[0].brakings})
        heading = ["brakes", "m/s²", "avoidable", "hit only after the end"]
        rows = [heading + [f"reaction {each:g} s" for each in reactions]]
        slack = np.stack([each.slack for each in members])
        extrapolated = np.stack([each.last_moments.extrapolated for each in members]).reshape(slack.shape)
        for row, brakers in enumerate(BRAKERS):
            for column, deceleration in enumerate(members[0].decelerations.tolist()):
                needed = np.sort(slack[:, row, column])  # those that nothing avoids are last
                places = [int(np.ceil(share * len(needed))) - 1 for share in _SHARES]
                counts = (np.isfinite(needed).sum(), extrapolated[:, row, column].sum())
                cells = [" / ".join(_seconds_text(needed[place] + each) for place in places) for each in reactions]
                rows.append([brakers, f"{deceleration:g}", *(str(count) for count in counts), *cells])
        meant = " and ".join(f"{share:.0%}" for share in _SHARES)
        return (
            f"{group}: {len(members)} accidents; seconds of warning that {meant} of them need\n{columns_text(rows)}\n"
            f"{_secondary_text(members)}"
        )

    def _margins_text(self) -> str:
        """How many margins of the self-check there are of each size; the largest by name."""
        lines = [f"  {name}: {count}" for name, count in self.margin_counts.items() if count]
        largest = max(self.margins, key=lambda name: self.margins[name])
        lines.append(f"  the largest: {self.margins[largest]:.3f} m, {largest}")
        return "\n".join(["gaps at the last frame, which count as contact:", *lines])

    def _last_moment_rows(self) -> Iterator[Row]:
        names = ("brakers", "deceleration", "avoidable", "last_moment", "slack", "switches", "extrapolated")
        yield ("scenario", "group", "first_id", "first", "second_id", "second", *names, "secondary")
        for each in self.accidents:
            accident = each.accident
            who = [value for pair in zip(accident.actor_ids, accident.categories, strict=True) for value in pair]
            for row in each.last_moment_rows():
                values = (row[name] for name in names)
                yield (accident.scenario, group_of(each), *who, *values, len(row["secondary"]))

    def _secondary_rows(self) -> Iterator[Row]:
        names = ("actor_id", "other_id", "category", "time", "extrapolated")
        yield ("scenario", "brakers", "deceleration", *names)
        for each in self.accidents:
            for row in each.last_moment_rows():
                for contact in row["secondary"]:
                    values = (contact[name] for name in names)
                    yield (each.accident.scenario, row["brakers"], row["deceleration"], *values)

    def _share_rows(self) -> Iterator[Row]:
        yield (
            *("group", "warned", "reaction", "deceleration", "lead", "accidents", *OUTCOMES),
            *("extrapolated", "relative_speed", "delta_v", "delta_v_least", "delta_v_most"),
        )
        for each in self.shares:
            for column, braking in enumerate(each.brakings):
                for row, lead in enumerate(each.leads.tolist()):
                    values = [*each.shares[row, column], each.extrapolated[row, column]]
                    values += [each.relative_speed[row, column], *each.delta_v[row, column]]
                    key = (each.group, each.warned, braking.reaction, braking.deceleration, round(lead, 1))
                    yield (*key, int(each.accidents[row]), *(round(float(value), 6) for value in values))

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
            key = (each.accident.scenario, told["margin"], told["time"], round(each.accident.duration, 1))
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
        return Dropped(Skipped(scenario=accident.scenario, reason=unusable(accident, check)), check.margin)
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
    return report_of(dataset, each_scenario(work, dataset, scenarios, label="replaying", at_once=1, **how))


def report_of(dataset: Dataset, found: Sequence[Avoidability | Dropped | Skipped | None]) -> AvoidabilityReport:
    """The report of what `looked_into` gave for scenarios, in their order."""
    accidents, dropped = those_of(Avoidability, found), those_of(Dropped, found)
    margins = {each.accident.scenario: each.check.margin for each in accidents}
    return AvoidabilityReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        accidents=accidents,
        dropped=tuple(each.why for each in dropped),
        skipped=those_of(Skipped, found),
        margins={**margins, **{each.why.scenario: each.margin for each in dropped}},
    )


def _secondary_text(accidents: Sequence[Avoidability]) -> str:
    """In how many replays of braking at the last moment another actor is touched."""
    touched = [{each.replay for each in accident.secondary} for accident in accidents]
    before = [{each.replay for each in accident.secondary if not each.extrapolated} for accident in accidents]
    replays = sum(int(np.isfinite(accident.last_moments.time).sum()) for accident in accidents)
    return (
        f"other road users, who do not react, are touched in {sum(map(len, before))} of {replays} replays of the last "
        f"moment before the recording ends, in {sum(map(len, touched))} if all go straight on for 3 s"
    )


def _seconds_text(seconds: float) -> str:
    return f"{seconds:.2f}" if np.isfinite(seconds) else "–"
