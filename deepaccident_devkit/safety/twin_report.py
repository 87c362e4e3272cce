"""`TwinReport`: the accidents of a release beside their twins, and the twins that its split tears apart."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.safety.accidents import Skipped
from deepaccident_devkit.safety.scenarios import each_scenario
from deepaccident_devkit.safety.tables import number_text, short_agent, write_csv
from deepaccident_devkit.safety.twin_comparison import twin_diff
from deepaccident_devkit.safety.twin_diff import Parting, TwinDiff
from deepaccident_devkit.safety.twins import TornTwins, torn_twins
from deepaccident_devkit.taxonomy import frame_timestamp
from deepaccident_devkit.text import columns_text

if TYPE_CHECKING:
    from concurrent.futures import Executor

_OF_TWINS: Final = (
    "accident",
    "twin",
    "shift",
    "begins_together",
    "parting_frame",
    "parting_time",
    "time_to_impact",
    "gap_at_impact",
    "nearest_gap_in_twin",
    "nearest_frame_in_twin",
)
_OF_ACTORS: Final = (
    "actor_id",
    "twin_id",
    "category",
    "agent",
    "collides",
    "matched_by",
    "parting_frame",
    "largest_distance",
    "largest_heading_difference",
    "largest_speed_difference",
)


_NAMED: Final = 2
"""Actors that a line names at most."""
_APART: Final = "the recordings do not begin together, so that it is not known when they part"


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinReport(ShortRepr):
    """Accidents and their twins.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        diffs: an accident each, in the order of the release.
        skipped: accidents without a twin in the release, or without labels.
        torn: twins that are in different splits.
    """

    dataroot: str
    version: str
    diffs: tuple[TwinDiff, ...]
    skipped: tuple[Skipped, ...]
    torn: tuple[TornTwins, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "twins": [each.to_dict() for each in self.diffs],
            "skipped": [asdict(each) for each in self.skipped],
            "torn": [asdict(each) for each in self.torn],
        }

    def to_json(self) -> str:
        """One JSON object."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False)

    def to_csv(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write `twins.csv`, `twin_actors.csv`, `torn_twins.csv` and `skipped.csv`, over those that are there.

        Metres, seconds, m/s, radians; a cell is empty where nothing is known.

        Raises:
            ConfigError: `folder` cannot be written to, or is not one.
        """
        folder, told = writable_folder(folder), [each.to_dict() for each in self.diffs]
        skipped = [(each.scenario, each.reason) for each in self.skipped]
        actors = [(each["accident"], *map(actor.get, _OF_ACTORS)) for each in told for actor in each["actors"]]
        torn = [(*each.scenarios, *each.splits) for each in self.torn]
        return [
            write_csv(folder / "twins.csv", [_OF_TWINS, *([each[name] for name in _OF_TWINS] for each in told)]),
            write_csv(folder / "twin_actors.csv", [("accident", *_OF_ACTORS), *actors]),
            write_csv(folder / "torn_twins.csv", [("scenario", "twin", "split", "split of the twin"), *torn]),
            write_csv(folder / "skipped.csv", [("scenario", "reason"), *skipped]),
        ]

    def to_text(self) -> str:
        """A line for each accident; of a single one, one for each actor."""
        blocks = [f"Twins: DeepAccident {self.version} at {self.dataroot}"]
        if len(self.diffs) == 1:
            blocks.append(diff_text(self.diffs[0]))
        elif self.diffs:
            heading = ("accident", "parts at", "to impact", "first", "acting differently", "in one alone", "nearest")
            rows = [heading, *map(_line, self.diffs)]
            notes = "seconds from the first frame, and to the impact; nearest: the colliders' least gap in the twin (m)"
            apart = sum(not each.begins_together for each in self.diffs)
            blocks.append(f"{columns_text(rows)}\n{notes}" + (f"\n{apart} of them: {_APART}" if apart else ""))
        else:
            blocks.append("no accident has a twin here")
        if self.torn:
            lines = [
                f"  {each.scenarios[0]} ({each.splits[0]}), {each.scenarios[1]} ({each.splits[1]})"
                for each in self.torn
            ]
            blocks.append("\n".join([f"twins that the split tears apart: {len(lines)}", *lines]))
        if self.skipped:
            blocks.append("\n".join(["skipped:", *(f"  {each.reason}" for each in self.skipped)]))
        return "\n\n".join(blocks)


def twin_report(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    parting: Parting | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> TwinReport:
    """Compare every accident with its twin, and list the twins that the release's split tears apart.

    Args:
        dataset: the release.
        scenarios: tokens or records of the accidents, or of their twins; None for all.
        parting: from which difference on an actor acts differently; None for `Parting()`.
        workers: processes; None chooses by the amount of work.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        TokenError: no such scenario.
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    found = each_scenario(
        partial(diff_of_accident, parting=parting or Parting()),
        dataset,
        scenarios,
        label="twins",
        workers=workers,
        executor=executor,
        progress=progress,
    )
    splits = {record["token"]: record["split"] for record in dataset.scenario}
    return TwinReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        diffs=found.results,
        skipped=found.skipped,
        torn=torn_twins(splits),
    )


def diff_text(diff: TwinDiff) -> str:
    """Where an accident and its twin part, and what each actor does, for a terminal."""
    parting, nearest = diff.parting_frame, diff.nearest_in_twin
    when = "they never part"
    if parting is not None:
        ahead = (diff.num_frames[0] - parting) / 10
        when = f"they part at frame {parting}, {frame_timestamp(parting):.1f} s after the start, {ahead:.1f} s before"
        when += f" the impact: {_first_to_part(diff)}"
    if not diff.begins_together:
        when += f"\n{_APART}"
    gap = "the twin never shows the colliders at once"
    if nearest is not None:
        gap = f"the colliders' least gap in the twin: {nearest.gap:.2f} m at frame {nearest.frame}"
    limits = f"{diff.parting.distance:g} m or {np.degrees(diff.parting.heading):.0f}°"
    heading = ("actor", "in twin", "who", "matched by", "parts at", "distance", "turn", "faster")
    told = {(each["actor_id"], each["twin_id"]): each for each in diff.to_dict()["actors"]}
    rows = [heading, *(_actor_line(each) for each in told.values())]
    notes = (
        f"an actor parts from {limits} on; the largest distance (m), turn to the left (°) and speed more in the twin"
    )
    step = "" if not diff.shift else f"\nthe same moment has a number that is {diff.shift:+d} in the twin"
    return f"{diff.accident}\n{diff.twin}{step}\n{when}\n{gap}\n\n{columns_text(rows, left=4)}\n{notes}"


def diff_of_accident(dataset: Dataset, scenario: Any, parting: Parting) -> TwinDiff | None:
    """`twin_diff` of a scenario's record; None if the meta file names no collision."""
    return None if scenario["collision"] is None else twin_diff(dataset, scenario, parting)


def _first_to_part(diff: TwinDiff) -> str:
    """The actors that part first: two by name, agents before others."""
    rows = np.flatnonzero(diff.parting_frames == (diff.parting_frame or -1)).tolist()
    rows.sort(key=lambda row: diff.agents[row] is None)
    names = [_who(diff.categories[row], diff.agents[row], diff.actor_ids[row, 0]) for row in rows[:_NAMED]]
    more = f" and {len(rows) - _NAMED} more" if len(rows) > _NAMED else ""
    return f"{', '.join(names)}{more}"


def _who(category: str, agent: str | None, actor_id: int) -> str:
    return f"{category} {actor_id}" if agent is None else short_agent(agent)


def _line(diff: TwinDiff) -> tuple[str, ...]:
    frame, nearest = diff.parting_frame, diff.nearest_in_twin
    return (
        diff.accident,
        "never" if frame is None else f"{frame_timestamp(frame):.1f}",
        "–" if frame is None else f"{(diff.num_frames[0] - frame) / 10:.1f}",
        _first_to_part(diff) or "–",
        str(np.count_nonzero(diff.parting_frames)),
        str(np.count_nonzero(~diff.in_both)),
        number_text(None if nearest is None else nearest.gap, 2),
    )


def _actor_line(actor: dict[str, Any]) -> tuple[str, ...]:
    turn, frame = actor["largest_heading_difference"], actor["parting_frame"]
    who = actor["category"] if actor["agent"] is None else short_agent(actor["agent"])
    return (
        *("–" if actor[name] is None else str(actor[name]) for name in ("actor_id", "twin_id")),
        f"{who}, collides" if actor["collides"] else who,
        actor["matched_by"] or "–",
        "–" if frame is None else f"{frame_timestamp(frame):.1f}",
        number_text(actor["largest_distance"], 2),
        number_text(None if turn is None else float(np.degrees(turn)), 0),
        number_text(actor["largest_speed_difference"], 1),
    )
