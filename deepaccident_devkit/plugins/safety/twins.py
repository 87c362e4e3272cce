"""Comparison of an accident with its twin.

It shows which actors act differently in the twin, from when on, and how near the colliders come to
each other in the twin.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from deepaccident_devkit.collisions.recorded import (
    Skipped,
    map_scenarios,
    reasons_text,
    select_results,
    skipped_rows,
)
from deepaccident_devkit.collisions.twin_matching import (
    MatchedBy,
    TwinRecording,
    matched_rows,
    shift_of,
    shifted_recording,
    twin_recordings,
)
from deepaccident_devkit.collisions.twins import TornTwins, torn_twins
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked_number,
    json_numbers,
)
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import columns_text, number_text
from deepaccident_devkit.support.values import NamedValues
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

# An accident; and its twin with the frame numbers of the accident.
_Recordings = tuple[TwinRecording, TwinRecording]
_TWIN_COLUMNS = (
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
_ACTOR_COLUMNS = (
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
# Largest number of actors that a line of text names.
_MAX_NAMED_ACTORS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Parting:
    """The differences above which an actor counts as acting differently in the twin.

    ConfigError is raised if a value is not finite and positive.

    Attributes:
        distance: Metres between the actor's positions at the same time, seen from above. Labels
            may be off by 0.3 m, and the two clocks by half a frame (0.7 m at 14 m/s).
        heading: Radians between the actor's headings at the same time.
    """

    distance: float = 1.0
    heading: float = math.radians(10)

    def __post_init__(self) -> None:
        """Raise a ConfigError if a value is not allowed."""
        for name in ("distance", "heading"):
            value = checked_number(name, getattr(self, name), error=ConfigError)
            if not 0 < value < math.inf:
                raise ConfigError(f"{name}: expected a number above 0, found {value!r}")
            object.__setattr__(self, name, value)


class Nearest(NamedTuple):
    """The smallest gap between two actors.

    Attributes:
        frame: Number, from 1, of the frame in which the gap is smallest.
        gap: Metres between their outlines seen from above; 0 if they overlap.
    """

    frame: int
    gap: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwinDiff(FrozenArrays):
    """N actors of an accident and its twin over F frames, with the accident's frame numbers.

    Poses are in the world frame (right-handed), in metres and radians. They are NaN in frames in
    which no agent annotated the actor, or which the recording does not contain. Actors that are in
    both recordings come first, then actors only in the accident, then actors only in the twin; each
    of these is sorted by id. Arrays are read-only.

    Attributes:
        accident: Token of the accident.
        twin: Token of its twin.
        parting: Differences above which an actor counts as acting differently.
        actor_ids: CARLA ids in the accident and in the twin, shape (N, 2), int64; −1 if the actor
            is not in that recording.
        categories: Classes of the N actors.
        agents: Agent that each actor is; None for an actor that is not an agent.
        matched_by: How the actor was matched (`agent`, `id`, `start`); None for an actor that is
            only in one recording.
        num_frames: Numbers of frames of the two recordings; the accident's last one is the impact.
        shift: Frame number in the twin minus frame number in the accident.
        poses: x, y, yaw in the accident and in the twin, shape (2, N, F, 3).
        speeds: Speeds over the ground in m/s, from the labels, shape (2, N, F).
        sizes: Length, width and height in metres, shape (2, N, 3).
        pair: Indices of the colliders, in the meta file's order.
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
        """Metres between an actor's positions in the two recordings in the same frame, (N, F)."""
        poses, twin_poses = self.poses
        x = twin_poses[..., 0] - poses[..., 0]
        y = twin_poses[..., 1] - poses[..., 1]
        return np.asarray(np.hypot(x, y))

    @property
    def heading_differences(self) -> FloatArray:
        """Angles by which actors are rotated to the left in the twin, in (−π, π], shape (N, F)."""
        poses, twin_poses = self.poses
        angle = twin_poses[..., 2] - poses[..., 2]
        wrapped_angle = np.arctan2(np.sin(angle), np.cos(angle))
        return np.asarray(wrapped_angle)

    @property
    def speed_differences(self) -> FloatArray:
        """Speed in the twin minus speed in the accident, in m/s, shape (N, F)."""
        speed, twin_speed = self.speeds
        return np.asarray(twin_speed - speed)

    @property
    def in_both(self) -> BoolArray:
        """Whether an actor is in both recordings, shape (N,)."""
        has_id = self.actor_ids != UNTRACKED_ID
        return np.asarray(has_id.all(axis=1))

    @property
    def parting_frames(self) -> IntArray:
        """First frame in which each actor acts differently in the twin, shape (N,); 0 if never."""
        has_turned = np.abs(self.heading_differences) > self.parting.heading
        has_parted = has_turned | (self.distances > self.parting.distance)
        first_frames = has_parted.argmax(axis=1) + 1
        return np.where(has_parted.any(axis=1), first_frames, 0)

    @property
    def order(self) -> IntArray:
        """Indices of the actors, sorted by when they begin to act differently, shape (N,).

        They are followed by the actors that never do, and then by the ones in only one recording.
        """
        frames = self.parting_frames
        return np.lexsort((frames, frames == 0, ~self.in_both))

    @property
    def parting_frame(self) -> int | None:
        """First frame in which any actor acts differently in the twin; None if none does."""
        frames = self.parting_frames
        if not frames.any():
            return None
        return int(frames[frames > 0].min())

    @property
    def begins_together(self) -> bool:
        """Whether most agents are at the same positions in the first frame shown by both.

        If not, the recordings start at different times (or the twin shows another scene), and the
        parting frame is unknown.
        """
        is_agent = [name is not None for name in self.agents]
        distances = self.distances[np.array(is_agent, dtype=bool)]
        frames = np.flatnonzero(~np.isnan(distances).all(axis=0))
        if not len(frames):
            return True
        first_distances = distances[:, frames[0]]
        return bool(np.nanmedian(first_distances) <= self.parting.distance)

    @property
    def gaps(self) -> FloatArray:
        """Metres between the colliders' outlines seen from above, shape (2, F).

        The first row is the accident, the second one the twin.
        """
        positions = self.poses[..., :2]
        headings = self.poses[..., 2:]
        sizes = np.broadcast_to(self.sizes[:, :, None, :2], (*self.poses.shape[:3], 2))
        footprints = np.concatenate([positions, sizes, headings], axis=-1)
        row, other_row = self.pair
        return gaps_of_pairs(footprints[:, row], footprints[:, other_row])

    @property
    def nearest_in_twin(self) -> Nearest | None:
        """Smallest gap between the colliders in the twin; None if no frame of it shows both."""
        gaps = self.gaps[1]
        if np.isnan(gaps).all():
            return None
        frame = int(np.nanargmin(gaps))
        return Nearest(frame=frame + 1 + self.shift, gap=float(gaps[frame]))

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON, without per-frame values; None for unknown values."""
        frame = self.parting_frame
        parting_time = None
        time_to_impact = None
        if frame is not None:
            parting_time = frame_timestamp(frame)
            time_to_impact = (self.num_frames[0] - frame) * FRAME_PERIOD
        nearest_frame = None
        nearest_gap = None
        nearest = self.nearest_in_twin
        if nearest is not None:
            nearest_frame, nearest_gap = nearest
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
            "gap_at_impact": json_numbers(self.gaps[0, self.num_frames[0] - 1]),
            "nearest_gap_in_twin": nearest_gap,
            "nearest_frame_in_twin": nearest_frame,
            "actors": [self._actor_values(row) for row in self.order.tolist()],
        }

    def _actor_values(self, row: int) -> NamedValues:
        """Return the values of an actor for JSON; None for unknown values."""
        actor_id, twin_id = self.actor_ids[row].tolist()
        frame = int(self.parting_frames[row])
        positions = np.full((2, 2), np.nan)
        if frame:
            positions = self.poses[:, row, frame - 1, :2]
        return {
            "actor_id": None if actor_id == UNTRACKED_ID else actor_id,
            "twin_id": None if twin_id == UNTRACKED_ID else twin_id,
            "category": self.categories[row],
            "agent": self.agents[row],
            "collides": row in self.pair,
            "matched_by": self.matched_by[row],
            "parting_frame": frame or None,
            "position_at_parting": json_numbers(positions[0]),
            "twin_position_at_parting": json_numbers(positions[1]),
            "largest_distance": _largest(self.distances[row]),
            "largest_heading_difference": _largest(self.heading_differences[row]),
            "largest_speed_difference": _largest(self.speed_differences[row]),
        }


def _largest(values: FloatArray) -> float | None:
    """Return the value with the largest magnitude; None if all are unknown."""
    known_values = values[~np.isnan(values)]
    if not len(known_values):
        return None
    return float(known_values[np.argmax(np.abs(known_values))])


def twin_diff(dataset: Dataset, scenario: RowArgument, parting: Parting | None = None) -> TwinDiff:
    """Compare an accident with its twin, frame by frame.

    `collisions.twin_matching` matches the frames (`shift_of`) and the actors (`matched_rows`).

    Args:
        dataset: The release.
        scenario: Token or record of the accident or of its twin.
        parting: Differences above which an actor counts as acting differently; None for
            `Parting()`.

    Raises:
        DeepAccidentError: As `collisions.twin_matching.twin_recordings` does.
    """
    accident, recording, unshifted_twin = twin_recordings(dataset, scenario)
    shift = shift_of(recording, unshifted_twin)
    recordings = (recording, shifted_recording(unshifted_twin, shift))
    matches = matched_rows(*recordings)
    rows = _list_rows(recordings, matches)
    ids = np.stack(_take_values(recordings, "actor_id", rows, UNTRACKED_ID), axis=1)
    codes, twin_codes = _take_values(recordings, "category", rows, -1)
    categories = np.where(codes < 0, twin_codes, codes).tolist()
    names = {actor: name for name, actor in recording.agents.items()}
    twin_names = {actor: name for name, actor in unshifted_twin.agents.items()}
    agents = [names.get(actor) or twin_names.get(twin_id) for actor, twin_id in ids.tolist()]
    matched_by = [how for _, (_, how) in sorted(matches.items())]
    unmatched: list[MatchedBy | None] = [None] * (len(rows) - len(matches))
    actor_ids = ids[:, 0].tolist()
    first_id, second_id = accident.actor_ids
    return TwinDiff(
        accident=recording.scenario,
        twin=unshifted_twin.scenario,
        parting=parting or Parting(),
        actor_ids=ids,
        categories=tuple(CATEGORIES[code] for code in categories),
        agents=tuple(agents),
        matched_by=(*matched_by, *unmatched),
        num_frames=(recording.poses.shape[1], unshifted_twin.poses.shape[1]),
        shift=shift,
        poses=_stack_values(recordings, "poses", rows),
        speeds=_stack_values(recordings, "speeds", rows),
        sizes=np.stack(_take_values(recordings, "size", rows)),
        pair=(actor_ids.index(first_id), actor_ids.index(second_id)),
    )


def _list_rows(recordings: _Recordings, matches: Mapping[int, tuple[int, MatchedBy]]) -> IntArray:
    """Return each actor's index in the two recordings, shape (N, 2), matched actors first.

    The index is −1 if the actor is not in that recording.
    """
    pairs = [(row, twin_row) for row, (twin_row, _) in sorted(matches.items())]
    matched_rows, matched_twin_rows = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    recording, twin = recordings
    rows = np.setdiff1d(np.arange(len(recording.actor_id)), matched_rows)
    twin_rows = np.setdiff1d(np.arange(len(twin.actor_id)), matched_twin_rows)
    all_rows = [*matched_rows, *rows, *np.full(len(twin_rows), -1)]
    all_twin_rows = [*matched_twin_rows, *np.full(len(rows), -1), *twin_rows]
    return np.array([all_rows, all_twin_rows], dtype=np.int64).T


def _stack_values(recordings: _Recordings, name: str, rows: IntArray) -> FloatArray:
    """Stack a field of both recordings, shape (2, N, F, …), padded with NaN to equal length."""
    arrays = _take_values(recordings, name, rows)
    num_frames = max(values.shape[1] for values in arrays)
    stacked = np.full((2, len(rows), num_frames, *arrays[0].shape[2:]), np.nan)
    for index, values in enumerate(arrays):
        stacked[index, :, : values.shape[1]] = values
    return stacked


def _take_values(
    recordings: _Recordings, name: str, rows: IntArray, missing: float = np.nan
) -> list[Any]:
    """Select the values of a field by the actors' indices in each recording.

    Args:
        recordings: The two recordings.
        name: Name of the field.
        rows: Indices in the two recordings, shape (N, 2); −1 for an actor that is not there.
        missing: Value for −1.
    """
    arrays = []
    for recording, recording_rows in zip(recordings, rows.T, strict=True):
        values = getattr(recording, name)[recording_rows].copy()
        values[recording_rows < 0] = missing
        arrays.append(values)
    return arrays


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinReport(Report):
    """Comparison of a release's accidents with their twins.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        fingerprint: Fingerprint of the recordings, because different recordings can have the
            same names.
        diffs: One comparison per accident, in the order of the release.
        skipped: Accidents without labels, or whose twin is not in the release.
        torn: Pairs of twins that are in different splits.
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
        """Return the tables of twins, actors, torn twins and omissions (units: m, s, m/s, rad)."""
        twin_rows: list[Row] = [_TWIN_COLUMNS]
        actor_rows: list[Row] = [("accident", *_ACTOR_COLUMNS)]
        for diff in self.diffs:
            payload = diff.to_dict()
            twin_rows.append([*map(payload.get, _TWIN_COLUMNS)])
            for actor in payload["actors"]:
                actor_rows.append((diff.accident, *map(actor.get, _ACTOR_COLUMNS)))
        torn_rows = [(*twins.scenarios, *twins.splits) for twins in self.torn]
        return {
            "twins": twin_rows,
            "twin_actors": actor_rows,
            "torn_twins": [("scenario", "twin", "split", "split of the twin"), *torn_rows],
            "skipped": skipped_rows(self.skipped),
        }

    def to_text(self) -> str:
        """Return one line per accident, and the twins and scenarios that are left out."""
        blocks = [f"Twins: DeepAccident {self.version} at {self.dataroot} ({self.fingerprint})"]
        blocks.append(self._diffs_text() if self.diffs else "no accident has a twin here")
        if self.torn:
            lines = [f"twins in different splits: {len(self.torn)}"]
            for twins in self.torn:
                scenario, twin = twins.scenarios
                lines.append(f"  {scenario} ({twins.splits[0]}), {twin} ({twins.splits[1]})")
            blocks.append("\n".join(lines))
        if self.skipped:
            blocks.append(reasons_text("skipped", self.skipped))
        return "\n\n".join(blocks)

    def _diffs_text(self) -> str:
        """Return a table with one row per accident, and an explanation of its columns."""
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
        apart_count = sum(not diff.begins_together for diff in self.diffs)
        if not apart_count:
            return f"{table}\n{notes}"
        return (
            f"{table}\n{notes}\n{apart_count} of them: the two recordings do not begin in the "
            "same way, so it is unknown when they begin to differ"
        )


def twin_report(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    parting: Parting | None = None,
    **engine: Unpack[Engine],
) -> TwinReport:
    """Compare each accident with its twin, and list twins that the release's split separates.

    Args:
        dataset: The release.
        scenarios: Tokens or records of the accidents, or of their twins; None for all.
        parting: Differences above which an actor counts as acting differently; None for
            `Parting()`.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: If the release has no such scenario.
    """
    work = partial(diff_of_accident, parting=parting or Parting())
    return twins_of(
        dataset, map_scenarios(work, dataset, scenarios, label="Comparing twins", **engine)
    )


def twins_of(dataset: Dataset, results: Sequence[TwinDiff | Skipped | None]) -> TwinReport:
    """Build the report from the results of `diff_of_accident`, one per scenario."""
    return TwinReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        fingerprint=digest_of(dataset.recordings(record["token"] for record in dataset.scenario)),
        diffs=select_results(TwinDiff, results),
        skipped=select_results(Skipped, results),
        torn=torn_twins({record["token"]: record["split"] for record in dataset.scenario}),
    )


def diff_of_accident(dataset: Dataset, scenario: Any, parting: Parting) -> TwinDiff | None:
    """Compare a scenario with its twin; return None if the meta file names no collision."""
    if scenario["collision"] is None:
        return None
    return twin_diff(dataset, scenario, parting)


def _name_first_actors(diff: TwinDiff) -> str:
    """Return the names of the actors that first act differently; agents come first."""
    rows = np.flatnonzero(diff.parting_frames == diff.parting_frame).tolist()
    rows.sort(key=lambda row: diff.agents[row] is None)
    names = [_actor_name(diff, row) for row in rows[:_MAX_NAMED_ACTORS]]
    text = ", ".join(names)
    unnamed_count = len(rows) - _MAX_NAMED_ACTORS
    if unnamed_count > 0:
        text += f" and {unnamed_count} more"
    return text


def _actor_name(diff: TwinDiff, row: int) -> str:
    """Name an actor: an agent by its name, any other actor by its class and id."""
    agent = diff.agents[row]
    if agent is None:
        return f"{diff.categories[row]} {diff.actor_ids[row, 0]}"
    return short_name(agent)


def _diff_cells(diff: TwinDiff) -> tuple[str, ...]:
    """Return the cells of an accident in the report's text."""
    frame = diff.parting_frame
    parting_text = "never"
    impact_text = "–"
    first_actors = "–"
    if frame is not None:
        parting_text = f"{frame_timestamp(frame):.1f}"
        impact_text = f"{(diff.num_frames[0] - frame) / 10:.1f}"
        first_actors = _name_first_actors(diff)
    nearest_gap = None
    if diff.nearest_in_twin is not None:
        nearest_gap = diff.nearest_in_twin.gap
    return (
        diff.accident,
        parting_text,
        impact_text,
        first_actors,
        str(np.count_nonzero(diff.parting_frames)),
        str(np.count_nonzero(~diff.in_both)),
        number_text(nearest_gap, 2),
    )
