"""How an accident and its twin part: who acts differently from when on, and how near the colliders come in the twin."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from deepaccident_devkit.collisions.recorded import (
    Skipped,
    accident_of,
    each_scenario,
    reasons_text,
    skipped_rows,
    those_of,
)
from deepaccident_devkit.collisions.twins import TornTwins, torn_twins, twin_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.plugins.safety.twin_matching import (
    MatchedBy,
    TwinRecording,
    matched_rows,
    shift_of,
    shifted_recording,
    twin_recording,
)
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked_number,
    known,
)
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import columns_text, number_text
from deepaccident_devkit.taxonomy import (
    CATEGORIES,
    FRAME_PERIOD,
    UNTRACKED_ID,
    AgentName,
    frame_timestamp,
    short_name,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

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
# Actors that a line names at most.
_NAMED: Final = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Parting:
    """From which difference on an actor acts differently in the twin. Checked when made; raises ConfigError.

    Attributes:
        distance: metres between its places at the same moment, seen from above. A label may be wrong by 0.3, and the
            two clocks by half a frame: 0.7 at 14 m/s.
        heading: radians between its headings.
    """

    distance: float = 1.0
    heading: float = math.radians(10)

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("distance", "heading"):
            value = checked_number(name, getattr(self, name), error=ConfigError)
            if not 0 < value < math.inf:
                raise ConfigError(f"{name}: expected a number above 0, found {value!r}")
            object.__setattr__(self, name, value)


class Nearest(NamedTuple):
    """The least gap of two actors.

    Attributes:
        frame: its number in the recording, from 1.
        gap: metres between their outlines seen from above; 0 if they overlap.
    """

    frame: int
    gap: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwinDiff(FrozenArrays):
    """N actors of an accident and of its twin over F frames, numbered as the accident's; arrays are read-only.

    World, right-handed, metres, radians; NaN where nobody annotated an actor, and before and after a recording. Actors
    of both come first, then those of the accident alone, then those of the twin alone, each by their ids.

    Attributes:
        accident: token.
        twin: token.
        parting: from which difference on an actor acts differently.
        actor_ids: (N, 2) int64, CARLA ids in the accident and in the twin; −1 where it is in the other alone.
        categories: N classes.
        agents: the agents that they are; None for one that records nothing.
        matched_by: by what the two ids were found to be of one actor (`agent`, `id`, `start`); None in one alone.
        num_frames: of the two recordings; the accident's last one is the impact.
        shift: by how much a frame's number is higher in the twin's own recording.
        poses: (2, N, F, 3) x, y, yaw in the accident and in the twin.
        speeds: (2, N, F) m/s over the ground, by the labels.
        sizes: (2, N, 3) length, width, height.
        pair: rows of the colliders, in the meta file's order.
    """

    accident: str
    twin: str
    parting: Parting
    actor_ids: IntArray
    categories: tuple[str, ...]
    agents: tuple[AgentName | None, ...]
    matched_by: tuple[MatchedBy | None, ...]
    num_frames: tuple[int, int]
    shift: int
    poses: FloatArray
    speeds: FloatArray
    sizes: FloatArray
    pair: tuple[int, int]

    @property
    def distances(self) -> FloatArray:
        """(N, F) metres between an actor's places in the two recordings at the same frame."""
        apart = self.poses[1, ..., :2] - self.poses[0, ..., :2]
        return np.asarray(np.hypot(apart[..., 0], apart[..., 1]))

    @property
    def heading_differences(self) -> FloatArray:
        """(N, F) by how much an actor is turned to the left in the twin, radians in (−π, π]."""
        turned = self.poses[1, ..., 2] - self.poses[0, ..., 2]
        return np.asarray(np.arctan2(np.sin(turned), np.cos(turned)))

    @property
    def speed_differences(self) -> FloatArray:
        """(N, F) by how much an actor is faster in the twin, m/s."""
        return np.asarray(self.speeds[1] - self.speeds[0])

    @property
    def in_both(self) -> BoolArray:
        """(N,) whether an actor is in both recordings."""
        return np.asarray((self.actor_ids != UNTRACKED_ID).all(axis=1))

    @property
    def parting_frames(self) -> IntArray:
        """(N,) the first frame at which an actor is elsewhere or turned otherwise; 0 for one that never is."""
        parted = (np.abs(self.heading_differences) > self.parting.heading) | (
            self.distances > self.parting.distance
        )
        return np.where(parted.any(axis=1), parted.argmax(axis=1) + 1, 0)

    @property
    def order(self) -> IntArray:
        """(N,) rows by when actors part: first those that do, then those that do not, then those in one alone."""
        frames = self.parting_frames
        return np.lexsort((frames, frames == 0, ~self.in_both))

    @property
    def parting_frame(self) -> int | None:
        """The first frame at which any actor of both acts differently; None if none ever does."""
        frames = self.parting_frames
        return int(frames[frames > 0].min()) if frames.any() else None

    @property
    def begins_together(self) -> bool:
        """Whether most agents are where they are in the twin at the first moment that both recordings show.

        Where they are not, the recordings begin at different moments (or the twin is another scene), and it is not
        known when they part.
        """
        apart = self.distances[[row for row, name in enumerate(self.agents) if name is not None]]
        moments = np.flatnonzero(~np.isnan(apart).all(axis=0))
        return not len(moments) or bool(np.nanmedian(apart[:, moments[0]]) <= self.parting.distance)

    @property
    def gaps(self) -> FloatArray:
        """(2, F) metres between the colliders' outlines seen from above, in the accident and in the twin."""
        feet = np.concatenate(
            [
                self.poses[..., :2],
                np.broadcast_to(self.sizes[:, :, None, :2], (*self.poses.shape[:3], 2)),
                self.poses[..., 2:],
            ],
            axis=-1,
        )
        first, second = self.pair
        return gaps_of_pairs(feet[:, first], feet[:, second])

    @property
    def nearest_in_twin(self) -> Nearest | None:
        """How near the colliders come to each other in the twin; None if it never shows both at once."""
        gaps = self.gaps[1]
        if np.isnan(gaps).all():
            return None
        frame = int(np.nanargmin(gaps))
        return Nearest(frame=frame + 1 + self.shift, gap=float(gaps[frame]))

    def to_dict(self) -> dict[str, Any]:
        """For JSON, without the values over time; None for what is not known."""
        parting, nearest = self.parting_frame, self.nearest_in_twin
        return {
            "accident": self.accident,
            "twin": self.twin,
            "num_frames": list(self.num_frames),
            "shift": self.shift,
            "begins_together": self.begins_together,
            "parting_distance": self.parting.distance,
            "parting_heading": self.parting.heading,
            "parting_frame": parting,
            "parting_time": None if parting is None else frame_timestamp(parting),
            "time_to_impact": None
            if parting is None
            else (self.num_frames[0] - parting) * FRAME_PERIOD,
            "pair": [int(self.actor_ids[row, 0]) for row in self.pair],
            "gap_at_impact": known(self.gaps[0, self.num_frames[0] - 1]),
            "nearest_gap_in_twin": None if nearest is None else nearest.gap,
            "nearest_frame_in_twin": None if nearest is None else nearest.frame,
            "actors": [self._actor(row) for row in self.order.tolist()],
        }

    def _actor(self, row: int) -> dict[str, Any]:
        ids: list[int] = self.actor_ids[row].tolist()
        frame = int(self.parting_frames[row])
        at = self.poses[:, row, frame - 1, :2] if frame else np.full((2, 2), np.nan)
        return {
            "actor_id": None if ids[0] == UNTRACKED_ID else ids[0],
            "twin_id": None if ids[1] == UNTRACKED_ID else ids[1],
            "category": self.categories[row],
            "agent": self.agents[row],
            "collides": row in self.pair,
            "matched_by": self.matched_by[row],
            "parting_frame": frame or None,
            "position_at_parting": known(at[0]),
            "twin_position_at_parting": known(at[1]),
            "largest_distance": _largest(self.distances[row]),
            "largest_heading_difference": _largest(self.heading_differences[row]),
            "largest_speed_difference": _largest(self.speed_differences[row]),
        }


def _largest(values: FloatArray) -> float | None:
    """The value farthest from 0; None if none is known."""
    there = values[~np.isnan(values)]
    return float(there[np.argmax(np.abs(there))]) if len(there) else None


def twin_diff(dataset: Dataset, scenario: RowArgument, parting: Parting | None = None) -> TwinDiff:
    """Compare an accident with its twin, frame by frame.

    `safety.twin_matching` says which moments (`shift_of`) and actors (`matched_rows`) are taken for the same.

    Args:
        dataset: the release.
        scenario: token or record of the accident or of its twin.
        parting: from which difference on an actor acts differently; None for `Parting()`.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: the release has no twin of it, neither of the two ends in an accident, one has no labels, or
            as of `accident_of`.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    other = twin_of(dataset, record)
    if other is None:
        raise NotAvailableError(
            f"{record['token']}: this release has no twin of it, with the same name and subtype"
        )
    if record["collision"] is None and other["collision"] is not None:
        record, other = other, record
    accident = accident_of(dataset, record)
    if accident is None:
        raise NotAvailableError(f"{record['token']}: neither it nor its twin ends in an accident")
    mine, theirs = (twin_recording(dataset, each["token"]) for each in (record, other))
    shift = shift_of(mine, theirs)
    recordings = mine, shifted_recording(theirs, shift)
    matched = matched_rows(*recordings)
    rows = _rows_of_both(recordings, matched)
    ids = np.column_stack(
        [_taken(each.actor_id, rows[:, at], UNTRACKED_ID) for at, each in enumerate(recordings)]
    )
    codes = [_taken(each.category, rows[:, at], -1) for at, each in enumerate(recordings)]
    names = [{actor: name for name, actor in each.agents.items()} for each in recordings]
    first, second = (int(np.flatnonzero(ids[:, 0] == actor)[0]) for actor in accident.actor_ids)
    return TwinDiff(
        accident=record["token"],
        twin=other["token"],
        parting=parting or Parting(),
        actor_ids=ids,
        categories=tuple(
            CATEGORIES[code] for code in np.where(codes[0] < 0, codes[1], codes[0]).tolist()
        ),
        agents=tuple(names[0].get(one) or names[1].get(two) for one, two in ids.tolist()),
        matched_by=tuple(
            matched[row][1] if row in matched else None for row in rows[:, 0].tolist()
        ),
        num_frames=(record["num_frames"], other["num_frames"]),
        shift=shift,
        poses=_stacked(recordings, "poses", rows),
        speeds=_stacked(recordings, "speeds", rows),
        sizes=np.stack([_taken(each.size, rows[:, at]) for at, each in enumerate(recordings)]),
        pair=(first, second),
    )


def _rows_of_both(
    recordings: tuple[TwinRecording, TwinRecording], matched: Mapping[int, tuple[int, MatchedBy]]
) -> IntArray:
    """(N, 2) rows of each actor in the two recordings, −1 for none: those of both first."""
    both = np.array([(row, matched[row][0]) for row in sorted(matched)], dtype=np.int64).reshape(
        -1, 2
    )
    alone, alone_there = (
        np.setdiff1d(np.arange(len(each.actor_id)), both[:, at])
        for at, each in enumerate(recordings)
    )
    return np.concatenate(
        [
            both,
            np.column_stack([alone, np.full(len(alone), -1)]),
            np.column_stack([np.full(len(alone_there), -1), alone_there]),
        ]
    )


def _stacked(
    recordings: tuple[TwinRecording, TwinRecording], name: str, rows: IntArray
) -> FloatArray:
    """(2, N, F, …) a field of both recordings, as long as the longer one."""
    parts = [_taken(getattr(each, name), rows[:, at]) for at, each in enumerate(recordings)]
    result = np.full(
        (2, len(rows), max(part.shape[1] for part in parts), *parts[0].shape[2:]), np.nan
    )
    for at, part in enumerate(parts):
        result[at, :, : part.shape[1]] = part
    return result


def _taken(values: Any, rows: IntArray, missing: float = np.nan) -> Any:
    """Rows of an array; where a row is −1, the missing value."""
    result = values[rows].copy()
    result[rows < 0] = missing
    return result


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinReport(Report):
    """Accidents and their twins.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        fingerprint: of the recordings: scenarios of the same names can be other recordings.
        diffs: an accident each, in the order of the release.
        skipped: accidents without a twin in the release, or without labels.
        torn: twins that are in different splits.
    """

    dataroot: str
    version: str
    fingerprint: str
    diffs: tuple[TwinDiff, ...]
    skipped: tuple[Skipped, ...]
    torn: tuple[TornTwins, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known."""
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "fingerprint": self.fingerprint,
            "twins": [each.to_dict() for each in self.diffs],
            "skipped": [asdict(each) for each in self.skipped],
            "torn": [asdict(each) for each in self.torn],
        }

    def named_tables(self) -> dict[str, Iterable[Row]]:
        """`twins`, `twin_actors`, `torn_twins` and `skipped`; metres, seconds, m/s, radians."""
        told = [each.to_dict() for each in self.diffs]
        actors = (
            (each["accident"], *map(actor.get, _OF_ACTORS))
            for each in told
            for actor in each["actors"]
        )
        return {
            "twins": [_OF_TWINS, *([each[name] for name in _OF_TWINS] for each in told)],
            "twin_actors": [("accident", *_OF_ACTORS), *actors],
            "torn_twins": [
                ("scenario", "twin", "split", "split of the twin"),
                *((*each.scenarios, *each.splits) for each in self.torn),
            ],
            "skipped": skipped_rows(self.skipped),
        }

    def to_text(self) -> str:
        """A line for each accident."""
        blocks = [f"Twins: DeepAccident {self.version} at {self.dataroot} ({self.fingerprint})"]
        if self.diffs:
            heading = (
                "accident",
                "parts at",
                "to impact",
                "first",
                "acting differently",
                "in one alone",
                "nearest",
            )
            rows = [heading, *map(_line, self.diffs)]
            notes = "seconds from the first frame, and to the impact; nearest: the colliders' least gap in the twin (m)"
            apart = sum(not each.begins_together for each in self.diffs)
            more = f"\n{apart} of them: the recordings do not begin together, so that it is not known when they part"
            blocks.append(f"{columns_text(rows)}\n{notes}{more if apart else ''}")
        else:
            blocks.append("no accident has a twin here")
        if self.torn:
            lines = [
                f"  {each.scenarios[0]} ({each.splits[0]}), {each.scenarios[1]} ({each.splits[1]})"
                for each in self.torn
            ]
            blocks.append("\n".join([f"twins that the split tears apart: {len(lines)}", *lines]))
        if self.skipped:
            blocks.append(reasons_text("skipped", self.skipped))
        return "\n\n".join(blocks)


def twin_report(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    parting: Parting | None = None,
    **how: Unpack[Engine],
) -> TwinReport:
    """Compare every accident with its twin, and list the twins that the release's split tears apart.

    Args:
        dataset: the release.
        scenarios: tokens or records of the accidents, or of their twins; None for all.
        parting: from which difference on an actor acts differently; None for `Parting()`.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        TokenError: no such scenario.
    """
    return twins_of(
        dataset,
        each_scenario(
            partial(diff_of_accident, parting=parting or Parting()),
            dataset,
            scenarios,
            label="twins",
            **how,
        ),
    )


def twins_of(dataset: Dataset, found: Sequence[TwinDiff | Skipped | None]) -> TwinReport:
    """The report of what `diff_of_accident` found in scenarios."""
    return TwinReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        fingerprint=digest_of(dataset.recordings(record["token"] for record in dataset.scenario)),
        diffs=those_of(TwinDiff, found),
        skipped=those_of(Skipped, found),
        torn=torn_twins({record["token"]: record["split"] for record in dataset.scenario}),
    )


def diff_of_accident(dataset: Dataset, scenario: Any, parting: Parting) -> TwinDiff | None:
    """`twin_diff` of a scenario's record; None if the meta file names no collision."""
    return None if scenario["collision"] is None else twin_diff(dataset, scenario, parting)


def _first_to_part(diff: TwinDiff) -> str:
    """The actors that part first: two by name, agents before others."""
    rows = np.flatnonzero(diff.parting_frames == (diff.parting_frame or -1)).tolist()
    rows.sort(key=lambda row: diff.agents[row] is None)
    names = [
        _who(diff.categories[row], diff.agents[row], diff.actor_ids[row, 0])
        for row in rows[:_NAMED]
    ]
    more = f" and {len(rows) - _NAMED} more" if len(rows) > _NAMED else ""
    return f"{', '.join(names)}{more}"


def _who(category: str, agent: str | None, actor_id: int) -> str:
    return f"{category} {actor_id}" if agent is None else short_name(agent)


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
