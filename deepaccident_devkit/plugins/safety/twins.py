"""How an accident and its twin part.

Compares which actors act differently and since when, and how near the colliders come in the twin.
"""

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

_TWIN_COLUMNS: Final = (
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
_ACTOR_COLUMNS: Final = (
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
# Largest number of actors that a line names.
_MAX_NAMED_ACTORS: Final = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Parting:
    """The differences above which an actor counts as acting differently in the twin.

    Checked when constructed; raises ConfigError.

    Attributes:
        distance: Metres between its positions at the same moment, seen from above. A label may be
            wrong by 0.3 m, and the two clocks by half a frame: 0.7 m at 14 m/s.
        heading: Radians between its headings.
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
    """The smallest gap of two actors.

    Attributes:
        frame: Its number in the recording, from 1.
        gap: Metres between their outlines seen from above; 0 if they overlap.
    """

    frame: int
    gap: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwinDiff(FrozenArrays):
    """N actors of an accident and of its twin over F frames, numbered as the accident's.

    World, right-handed, metres, radians; NaN where nobody annotated an actor, and before and after
    a recording. Actors of both recordings come first, then actors found only in the accident, then
    actors found only in the twin, each by their ids. Arrays are read-only.

    Attributes:
        accident: Token of the accident.
        twin: Token of its twin.
        parting: Differences above which an actor counts as acting differently.
        actor_ids: CARLA ids in the accident and in the twin, shape (N, 2), int64; −1 in a recording
            without the actor.
        categories: N classes.
        agents: Agents that the actors are; None for an actor that records nothing.
        matched_by: What the two ids were matched by (`agent`, `id`, `start`); None for an actor of
            one recording only.
        num_frames: Frames of the two recordings; the accident's last one is the impact.
        shift: How much higher a frame's number is in the twin's own recording.
        poses: x, y, yaw in the accident and in the twin, shape (2, N, F, 3).
        speeds: Speeds over the ground by the labels in m/s, shape (2, N, F).
        sizes: Length, width, height, shape (2, N, 3).
        pair: Rows of the colliders, in the meta file's order.
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
        """Metres between an actor's positions in the two recordings at the same frame, (N, F)."""
        offset = self.poses[1, ..., :2] - self.poses[0, ..., :2]
        return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))

    @property
    def heading_differences(self) -> FloatArray:
        """How far an actor is turned to the left in the twin, radians in (−π, π], shape (N, F)."""
        angle = self.poses[1, ..., 2] - self.poses[0, ..., 2]
        return np.asarray(np.arctan2(np.sin(angle), np.cos(angle)))

    @property
    def speed_differences(self) -> FloatArray:
        """How much faster an actor is in the twin, m/s, shape (N, F)."""
        return np.asarray(self.speeds[1] - self.speeds[0])

    @property
    def in_both(self) -> BoolArray:
        """Whether an actor is in both recordings, shape (N,)."""
        return np.asarray((self.actor_ids != UNTRACKED_ID).all(axis=1))

    @property
    def parting_frames(self) -> IntArray:
        """First frame with another position or heading of an actor, shape (N,); 0 for never."""
        has_turned = np.abs(self.heading_differences) > self.parting.heading
        has_parted = has_turned | (self.distances > self.parting.distance)
        return np.where(has_parted.any(axis=1), has_parted.argmax(axis=1) + 1, 0)

    @property
    def order(self) -> IntArray:
        """Rows by when actors part, shape (N,).

        First the actors that part, then the actors that do not, then the actors of one recording
        only.
        """
        frames = self.parting_frames
        return np.lexsort((frames, frames == 0, ~self.in_both))

    @property
    def parting_frame(self) -> int | None:
        """First frame at which any actor of both recordings acts differently; None if none does."""
        frames = self.parting_frames
        if frames.any():
            return int(frames[frames > 0].min())
        return None

    @property
    def begins_together(self) -> bool:
        """Whether most agents begin where they are in the twin.

        This is checked at the first moment that both recordings show. If it is false, the
        recordings begin at different moments (or the twin is another scene), and the parting frame
        is unknown.
        """
        agent_rows = [row for row, name in enumerate(self.agents) if name is not None]
        distances = self.distances[agent_rows]
        frames = np.flatnonzero(~np.isnan(distances).all(axis=0))
        if not len(frames):
            return True
        return bool(np.nanmedian(distances[:, frames[0]]) <= self.parting.distance)

    @property
    def gaps(self) -> FloatArray:
        """Metres between the colliders' outlines seen from above, shape (2, F).

        The first row is the accident, the second one its twin.
        """
        positions, headings = self.poses[..., :2], self.poses[..., 2:]
        sizes = np.broadcast_to(self.sizes[:, :, None, :2], (*self.poses.shape[:3], 2))
        footprints = np.concatenate([positions, sizes, headings], axis=-1)
        row, other_row = self.pair
        return gaps_of_pairs(footprints[:, row], footprints[:, other_row])

    @property
    def nearest_in_twin(self) -> Nearest | None:
        """The smallest gap of the colliders in the twin; None if it never shows both at once."""
        gaps = self.gaps[1]
        if np.isnan(gaps).all():
            return None
        frame = int(np.nanargmin(gaps))
        return Nearest(frame=frame + 1 + self.shift, gap=float(gaps[frame]))

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON, without the values over time; None for unknown values."""
        frame, nearest = self.parting_frame, self.nearest_in_twin
        parting_time, time_to_impact = None, None
        if frame is not None:
            parting_time = frame_timestamp(frame)
            time_to_impact = (self.num_frames[0] - frame) * FRAME_PERIOD
        return {
            "accident": self.accident,
            "twin": self.twin,
            "num_frames": list(self.num_frames),
            "shift": self.shift,
            "begins_together": self.begins_together,
            "parting_distance": self.parting.distance,
            "parting_heading": self.parting.heading,
            "parting_frame": frame,
            "parting_time": parting_time,
            "time_to_impact": time_to_impact,
            "pair": [int(self.actor_ids[row, 0]) for row in self.pair],
            "gap_at_impact": known(self.gaps[0, self.num_frames[0] - 1]),
            "nearest_gap_in_twin": None if nearest is None else nearest.gap,
            "nearest_frame_in_twin": None if nearest is None else nearest.frame,
            "actors": [self._actor(row) for row in self.order.tolist()],
        }

    def _actor(self, row: int) -> dict[str, Any]:
        actor_id, twin_id = self.actor_ids[row].tolist()
        frame = int(self.parting_frames[row])
        positions = self.poses[:, row, frame - 1, :2] if frame else np.full((2, 2), np.nan)
        return {
            "actor_id": None if actor_id == UNTRACKED_ID else actor_id,
            "twin_id": None if twin_id == UNTRACKED_ID else twin_id,
            "category": self.categories[row],
            "agent": self.agents[row],
            "collides": row in self.pair,
            "matched_by": self.matched_by[row],
            "parting_frame": frame or None,
            "position_at_parting": known(positions[0]),
            "twin_position_at_parting": known(positions[1]),
            "largest_distance": _largest(self.distances[row]),
            "largest_heading_difference": _largest(self.heading_differences[row]),
            "largest_speed_difference": _largest(self.speed_differences[row]),
        }


def _largest(values: FloatArray) -> float | None:
    """Return the value farthest from 0; None if all are unknown."""
    known_values = values[~np.isnan(values)]
    if not len(known_values):
        return None
    return float(known_values[np.argmax(np.abs(known_values))])


def twin_diff(dataset: Dataset, scenario: RowArgument, parting: Parting | None = None) -> TwinDiff:
    """Compare an accident with its twin, frame by frame.

    `safety.twin_matching` matches the moments (`shift_of`) and the actors (`matched_rows`).

    Args:
        dataset: The release.
        scenario: Token or record of the accident or of its twin.
        parting: Differences above which an actor counts as acting differently; None for
            `Parting()`.

    Raises:
        TokenError: There is no such scenario.
        NotAvailableError: The release has no twin of it, neither of the two ends in an accident,
            one has no labels, or `accident_of` raises it.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    twin = twin_of(dataset, record)
    if twin is None:
        raise NotAvailableError(
            f"{record['token']}: this release has no twin of it, with the same name and subtype"
        )
    if record["collision"] is None and twin["collision"] is not None:
        record, twin = twin, record
    accident = accident_of(dataset, record)
    if accident is None:
        raise NotAvailableError(f"{record['token']}: neither it nor its twin ends in an accident")
    recording = twin_recording(dataset, record["token"])
    unshifted_twin = twin_recording(dataset, twin["token"])
    shift = shift_of(recording, unshifted_twin)
    recordings = recording, shifted_recording(unshifted_twin, shift)
    matches = matched_rows(*recordings)
    rows = _rows_in_both(recordings, matches)
    ids = np.stack(_taken_values(recordings, "actor_id", rows, UNTRACKED_ID), axis=1)
    codes, twin_codes = _taken_values(recordings, "category", rows, -1)
    categories = np.where(codes < 0, twin_codes, codes).tolist()
    names = {actor: name for name, actor in recordings[0].agents.items()}
    twin_names = {actor: name for name, actor in recordings[1].agents.items()}
    matched_by = [matches[key][1] if key in matches else None for key in rows[:, 0].tolist()]
    row, other_row = (int(np.flatnonzero(ids[:, 0] == actor)[0]) for actor in accident.actor_ids)
    return TwinDiff(
        accident=record["token"],
        twin=twin["token"],
        parting=parting or Parting(),
        actor_ids=ids,
        categories=tuple(CATEGORIES[code] for code in categories),
        agents=tuple(names.get(actor) or twin_names.get(other) for actor, other in ids.tolist()),
        matched_by=tuple(matched_by),
        num_frames=(record["num_frames"], twin["num_frames"]),
        shift=shift,
        poses=_stacked(recordings, "poses", rows),
        speeds=_stacked(recordings, "speeds", rows),
        sizes=np.stack(_taken_values(recordings, "size", rows)),
        pair=(row, other_row),
    )


def _rows_in_both(
    recordings: tuple[TwinRecording, TwinRecording], matches: Mapping[int, tuple[int, MatchedBy]]
) -> IntArray:
    """Return the rows of each actor in the two recordings, shape (N, 2), matched actors first.

    −1 for an actor that a recording lacks.
    """
    pairs = [(row, matches[row][0]) for row in sorted(matches)]
    matched = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    recording, twin = recordings
    unmatched = np.setdiff1d(np.arange(len(recording.actor_id)), matched[:, 0])
    twin_unmatched = np.setdiff1d(np.arange(len(twin.actor_id)), matched[:, 1])
    return np.concatenate(
        [
            matched,
            np.column_stack([unmatched, np.full(len(unmatched), -1)]),
            np.column_stack([np.full(len(twin_unmatched), -1), twin_unmatched]),
        ]
    )


def _stacked(
    recordings: tuple[TwinRecording, TwinRecording], name: str, rows: IntArray
) -> FloatArray:
    """Return a field of both recordings, shape (2, N, F, …), as long as the longer one."""
    parts = _taken_values(recordings, name, rows)
    num_frames = max(part.shape[1] for part in parts)
    result = np.full((2, len(rows), num_frames, *parts[0].shape[2:]), np.nan)
    for index, part in enumerate(parts):
        result[index, :, : part.shape[1]] = part
    return result


def _taken_values(
    recordings: tuple[TwinRecording, TwinRecording],
    name: str,
    rows: IntArray,
    missing: float = np.nan,
) -> list[Any]:
    """Return the rows of a field of both recordings; the missing value where a row is −1."""
    parts = []
    for recording, recording_rows in zip(recordings, rows.T, strict=True):
        values = getattr(recording, name)[recording_rows].copy()
        values[recording_rows < 0] = missing
        parts.append(values)
    return parts


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinReport(Report):
    """Accidents and their twins.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        fingerprint: Fingerprint of the recordings, since scenarios of the same names can be other
            recordings.
        diffs: One comparison for each accident, in the order of the release.
        skipped: Accidents without a twin in the release, or without labels.
        torn: Twins that are in different splits.
    """

    dataroot: str
    version: str
    fingerprint: str
    diffs: tuple[TwinDiff, ...]
    skipped: tuple[Skipped, ...]
    torn: tuple[TornTwins, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON; None for unknown values."""
        return {
            "dataroot": self.dataroot,
            "version": self.version,
            "fingerprint": self.fingerprint,
            "twins": [diff.to_dict() for diff in self.diffs],
            "skipped": [asdict(skipped) for skipped in self.skipped],
            "torn": [asdict(twins) for twins in self.torn],
        }

    def named_tables(self) -> dict[str, Iterable[Row]]:
        """Return `twins`, `twin_actors`, `torn_twins`, `skipped`; metres, seconds, m/s, rad."""
        payloads = [diff.to_dict() for diff in self.diffs]
        twin_rows = [[payload[name] for name in _TWIN_COLUMNS] for payload in payloads]
        actor_rows = (
            (payload["accident"], *map(actor.get, _ACTOR_COLUMNS))
            for payload in payloads
            for actor in payload["actors"]
        )
        torn_rows = [(*twins.scenarios, *twins.splits) for twins in self.torn]
        return {
            "twins": [_TWIN_COLUMNS, *twin_rows],
            "twin_actors": [("accident", *_ACTOR_COLUMNS), *actor_rows],
            "torn_twins": [("scenario", "twin", "split", "split of the twin"), *torn_rows],
            "skipped": skipped_rows(self.skipped),
        }

    def to_text(self) -> str:
        """Return a line for each accident."""
        blocks = [f"Twins: DeepAccident {self.version} at {self.dataroot} ({self.fingerprint})"]
        blocks.append(self._diffs_text() if self.diffs else "no accident has a twin here")
        if self.torn:
            lines = [f"twins that the split tears apart: {len(self.torn)}"]
            for twins in self.torn:
                scenario, twin = twins.scenarios
                lines.append(f"  {scenario} ({twins.splits[0]}), {twin} ({twins.splits[1]})")
            blocks.append("\n".join(lines))
        if self.skipped:
            blocks.append(reasons_text("skipped", self.skipped))
        return "\n\n".join(blocks)

    def _diffs_text(self) -> str:
        heading = (
            "accident",
            "parts at",
            "to impact",
            "first",
            "acting differently",
            "in one alone",
            "nearest",
        )
        table = columns_text([heading, *map(_diff_cells, self.diffs)])
        notes = (
            "seconds from the first frame, and to the impact; nearest: the colliders' least gap in "
            "the twin (m)"
        )
        apart = sum(not diff.begins_together for diff in self.diffs)
        if not apart:
            return f"{table}\n{notes}"
        return (
            f"{table}\n{notes}\n{apart} of them: the recordings do not begin together, so that it "
            "is not known when they part"
        )


def twin_report(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    parting: Parting | None = None,
    **engine: Unpack[Engine],
) -> TwinReport:
    """Compare every accident with its twin, and list the twins that the release's split separates.

    Args:
        dataset: The release.
        scenarios: Tokens or records of the accidents, or of their twins; None for all.
        parting: Differences above which an actor counts as acting differently; None for
            `Parting()`.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: There is no such scenario.
    """
    work = partial(diff_of_accident, parting=parting or Parting())
    return twins_of(dataset, each_scenario(work, dataset, scenarios, label="twins", **engine))


def twins_of(dataset: Dataset, results: Sequence[TwinDiff | Skipped | None]) -> TwinReport:
    """Return the report of the results of `diff_of_accident` for scenarios."""
    return TwinReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        fingerprint=digest_of(dataset.recordings(record["token"] for record in dataset.scenario)),
        diffs=those_of(TwinDiff, results),
        skipped=those_of(Skipped, results),
        torn=torn_twins({record["token"]: record["split"] for record in dataset.scenario}),
    )


def diff_of_accident(dataset: Dataset, scenario: Any, parting: Parting) -> TwinDiff | None:
    """Return `twin_diff` of a scenario's record; None if the meta file names no collision."""
    if scenario["collision"] is None:
        return None
    return twin_diff(dataset, scenario, parting)


def _actors_that_part_first(diff: TwinDiff) -> str:
    """Return the actors that part first: two by name, agents before others."""
    rows = np.flatnonzero(diff.parting_frames == (diff.parting_frame or -1)).tolist()
    rows.sort(key=lambda row: diff.agents[row] is None)
    names = [
        _actor_name(diff.categories[row], diff.agents[row], diff.actor_ids[row, 0])
        for row in rows[:_MAX_NAMED_ACTORS]
    ]
    unnamed = len(rows) - _MAX_NAMED_ACTORS
    more = f" and {unnamed} more" if unnamed > 0 else ""
    return f"{', '.join(names)}{more}"


def _actor_name(category: str, agent: str | None, actor_id: int) -> str:
    if agent is None:
        return f"{category} {actor_id}"
    return short_name(agent)


def _diff_cells(diff: TwinDiff) -> tuple[str, ...]:
    frame, nearest = diff.parting_frame, diff.nearest_in_twin
    parting_text, impact_text = "never", "–"
    if frame is not None:
        parting_text = f"{frame_timestamp(frame):.1f}"
        impact_text = f"{(diff.num_frames[0] - frame) / 10:.1f}"
    return (
        diff.accident,
        parting_text,
        impact_text,
        _actors_that_part_first(diff) or "–",
        str(np.count_nonzero(diff.parting_frames)),
        str(np.count_nonzero(~diff.in_both)),
        number_text(None if nearest is None else nearest.gap, 2),
    )
