"""`TwinDiff`: an accident and its normal twin in step: where they part, and who acts differently."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, FrozenArrays, IntArray, checked_number
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import path_of
from deepaccident_devkit.geometry.footprints import gaps_of_pairs
from deepaccident_devkit.safety.tables import write_csv
from deepaccident_devkit.safety.twin_matching import MatchedBy
from deepaccident_devkit.taxonomy import FRAME_PERIOD, UNTRACKED_ID, AgentName, frame_timestamp

_NEVER: Final = 10**6
_OVER_TIME: Final = (
    "actor_id",
    "twin_id",
    "frame",
    *("x", "y", "yaw"),
    *("twin_x", "twin_y", "twin_yaw"),
    "speed",
    "twin_speed",
    "distance",
    "heading_difference",
)


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
        differences: FloatArray = self.speeds[1] - self.speeds[0]
        return differences

    @property
    def in_both(self) -> BoolArray:
        """(N,) whether an actor is in both recordings."""
        return np.asarray((self.actor_ids != UNTRACKED_ID).all(axis=1))

    @property
    def parting_frames(self) -> IntArray:
        """(N,) the first frame at which an actor is elsewhere or turned otherwise; 0 for one that never is."""
        turned = np.abs(self.heading_differences) > self.parting.heading
        parted = turned | (self.distances > self.parting.distance)
        return np.where(parted.any(axis=1), parted.argmax(axis=1) + 1, 0)

    @property
    def order(self) -> IntArray:
        """(N,) rows by when actors part: first those that do, then those that do not, then those in one alone."""
        frames = self.parting_frames
        return np.lexsort((np.where(frames > 0, frames, _NEVER), ~self.in_both))

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
        agents = [row for row, name in enumerate(self.agents) if name is not None]
        apart = self.distances[agents]
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
            "time_to_impact": None if parting is None else (self.num_frames[0] - parting) * FRAME_PERIOD,
            "pair": [int(self.actor_ids[row, 0]) for row in self.pair],
            "gap_at_impact": _known(self.gaps[0, self.num_frames[0] - 1]),
            "nearest_gap_in_twin": None if nearest is None else nearest.gap,
            "nearest_frame_in_twin": None if nearest is None else nearest.frame,
            "actors": [self._actor(row) for row in self.order.tolist()],
        }

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write a row for each actor and frame at which either recording has it, over a file that is there.

        Metres, m/s and radians, with all their digits; a cell is empty where nothing is known. Returns the path.
        """
        there = ~np.isnan(self.poses[..., 0]).all(axis=0)
        rows, frames = np.nonzero(there)
        columns = [*self.actor_ids[rows].T.tolist(), (frames + 1).tolist()]
        values = [*self.poses[:, rows, frames].transpose(0, 2, 1).reshape(6, -1), *self.speeds[:, rows, frames]]
        values += [self.distances[rows, frames], self.heading_differences[rows, frames]]
        columns += [[_known(value) for value in each] for each in values]
        return write_csv(path_of(path), [_OVER_TIME, *zip(*columns, strict=True)])

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
            "position_at_parting": [_known(value) for value in at[0]],
            "twin_position_at_parting": [_known(value) for value in at[1]],
            "largest_distance": _largest(self.distances[row]),
            "largest_heading_difference": _largest(self.heading_differences[row]),
            "largest_speed_difference": _largest(self.speed_differences[row]),
        }


def _known(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _largest(values: FloatArray) -> float | None:
    """The value farthest from 0; None if none is known."""
    known = values[~np.isnan(values)]
    return float(known[np.argmax(np.abs(known))]) if len(known) else None
