"""`Subject`: one scenario's small files in memory, with the data that every check of their meaning needs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables import Finding, displacement_velocities
from deepaccident_devkit.tables import boxes as box_rules
from deepaccident_devkit.tables.boxes import ScenarioBoxes
from deepaccident_devkit.tables.build import scenario_boxes
from deepaccident_devkit.tables.scan import ScenarioFiles, frame_ranges
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, OWN_ACTOR_ID, UNTRACKED_ID, AgentName
from deepaccident_devkit.validation.codes import CODES

# Metres at the most within which a label is taken to be complete.
_SURE_REACH = 35.0
_SHARE_OF_FURTHEST = 0.8
_FURTHEST = 1e7
MOST_BOXES = 500
"""Boxes in a label, of which real ones have less than a hundred."""
# Boxes at one place and moment that are compared pair by pair.
_MOST_TOGETHER = 32
# Metres between an untracked row and where the actor should be.
_UNTRACKED_PLACE = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """One scenario; A agents, F frames, S = A·F samples agent by agent, N boxes. All in world, right-handed.

    Attributes:
        files: what was read.
        boxes: the boxes and where each was recorded.
        centers: (N, 3) box centres, metres.
    """

    files: ScenarioFiles
    boxes: ScenarioBoxes
    centers: FloatArray

    @property
    def token(self) -> str:
        """The scenario's."""
        return self.files.scenario.token

    @property
    def agents(self) -> Sequence[AgentName]:
        """The agents that are there, A."""
        return self.files.scan.agents

    @property
    def num_frames(self) -> int:
        """F."""
        return self.files.scan.num_frames

    @property
    def label_id(self) -> IntArray:
        """(N,) ids as the labels say."""
        return self.boxes.labels.actor_id

    @cached_property
    def seen(self) -> BoolArray:
        """(N,) tracked boxes of others: neither the recording agent itself nor untracked."""
        return np.asarray((self.label_id != OWN_ACTOR_ID) & (self.label_id != UNTRACKED_ID))

    @cached_property
    def own(self) -> BoolArray:
        """(N,) the recording agents' own rows."""
        return np.asarray(self.label_id == OWN_ACTOR_ID)

    @cached_property
    def in_collision(self) -> BoolArray:
        """(N,) boxes of meta's pair; all, where meta does not say."""
        meta = self.files.meta
        if meta is None:
            return np.ones(len(self.boxes), dtype=bool)
        return np.isin(self.boxes.actor, meta.collision.ids if meta.collision else ())

    @cached_property
    def yaw(self) -> FloatArray:
        """(N,) heading of each box in world, radians."""
        return quaternions.yaw_of(box_rules.world_rotations(self.boxes))

    @cached_property
    def reach(self) -> FloatArray:
        """(A,) metres around each agent within which its labels leave nobody out; 0 where nothing shows that.

        Labels that hold what neither its agent's LiDAR nor its cameras saw leave nobody out for being hidden, and all
        labels of a scenario are written by one rule; the boxes of each agent show how far that reaches.
        """
        labels, agent = self.boxes.labels, self.boxes.agent
        distance = np.linalg.norm(labels.center[:, :2], axis=1)
        hidden = (
            self.seen
            & (labels.num_lidar_pts == 0)
            & ~labels.camera_visible
            & (distance < _SURE_REACH)
        )
        furthest = np.zeros(len(self.agents))
        np.maximum.at(furthest, agent, distance)
        return np.asarray(np.minimum(_SURE_REACH, _SHARE_OF_FURTHEST * furthest) * hidden.any())

    def has_untracked(self, agent: int, frames: IntArray, places: FloatArray) -> BoolArray:
        """Which places (M, 3) of the world an agent annotated as untracked (id −1) at the frames (M,)."""
        rows = np.flatnonzero((self.label_id == UNTRACKED_ID) & (self.boxes.agent == agent))
        if not len(rows) or not len(frames):
            return np.zeros(len(frames), dtype=bool)
        from scipy.spatial import cKDTree

        tree = cKDTree(
            np.unique(
                tree_points(self.centers[rows], self.boxes.frame[rows], _UNTRACKED_PLACE), axis=0
            )
        )
        distance, _ = tree.query(
            tree_points(places, frames, _UNTRACKED_PLACE), distance_upper_bound=_UNTRACKED_PLACE
        )
        return np.asarray(np.isfinite(distance))

    @cached_property
    def lidar_boxes(self) -> Boxes:
        """All N boxes, each in the LiDAR frame it was recorded in."""
        return self.boxes.labels.boxes()

    @cached_property
    def velocity(self) -> FloatArray:
        """(N, 3) m/s from displacements, NaN where unknown."""
        return displacement_velocities(
            self.centers, self.boxes.agent, self.label_id, self.boxes.frame
        )

    @cached_property
    def positions(self) -> FloatArray:
        """(A, F, 3) of the agents, metres."""
        return self.files.calibs.world_from_ego[:, :3, 3].reshape(
            len(self.agents), self.num_frames, 3
        )

    def is_pole(self, agent: int) -> bool:
        """Whether the agent of this row stands at the roadside."""
        return self.agents[agent] == INFRASTRUCTURE

    def finding(self, code: str, where: str, what: str) -> Finding:
        """A finding about this scenario; how bad it is and what to do stand in `CODES`."""
        return make_finding(code, self.token, where, what)

    def label_where(self, agent: int) -> str:
        """The folder of an agent's labels."""
        return str(self.files.scenario.kind_folder(self.agents[agent], "label"))

    def calib_where(self, agent: int) -> str:
        """The folder of an agent's calib files."""
        return str(self.files.scenario.kind_folder(self.agents[agent], "calib"))

    def rows_by_agent(self, rows: BoolArray) -> Iterable[tuple[int, IntArray]]:
        """Agent → the rows (M,) of its boxes that a mask (N,) picks, for agents that have any."""
        for agent in range(len(self.agents)):
            picked = np.flatnonzero(rows & (self.boxes.agent == agent))
            if len(picked):
                yield agent, picked

    def mask(self, rows: AnyArray) -> BoolArray:
        """(N,) true for some rows (M,)."""
        mask = np.zeros(len(self.boxes), dtype=bool)
        mask[rows] = True
        return mask

    def label_findings(self, code: str, rows: BoolArray, what: str) -> Iterable[Finding]:
        """One finding an agent for the boxes that a mask (N,) picks: `what`, the actors, and in which frames."""
        for agent, picked in self.rows_by_agent(rows):
            frames = frames_text(self.boxes.frame[picked])
            actors = actors_text(self.label_id[picked])
            yield self.finding(code, self.label_where(agent), f"{what}: {actors}, {frames}")


def subject_of(files: ScenarioFiles) -> Subject:
    """What the checks start from."""
    boxes = scenario_boxes(files)
    return Subject(files=files, boxes=boxes, centers=box_rules.world_centers(boxes))


def near_pairs(places: FloatArray, moments: AnyArray, radius: float) -> tuple[IntArray, BoolArray]:
    """Pairs (P, 2) of places (M, 3) of a moment (M,) within `radius`; and (M,) which are in crowds, and in no pair.

    Pairs of many at one place would have no end.
    """
    from scipy.spatial import cKDTree

    points = tree_points(places, moments, radius)
    _, cell, count = np.unique(
        np.floor(points / radius), axis=0, return_inverse=True, return_counts=True
    )
    crowded: BoolArray = count[cell.reshape(-1)] > _MOST_TOGETHER
    rows = np.flatnonzero(~crowded)
    pairs: IntArray = rows[
        cKDTree(points[rows]).query_pairs(radius, output_type="ndarray")
    ].reshape(-1, 2)
    return pairs, crowded


def tree_points(places: FloatArray, moments: AnyArray, radius: float) -> FloatArray:
    """(M, 4) points for a tree; absurd places are cut off, which would overflow."""
    return np.column_stack([np.clip(places, -_FURTHEST, _FURTHEST), moments * (10 * radius)])


def make_finding(code: str, scenario: str | None, where: str, what: str) -> Finding:
    """A finding of a kind in `CODES`."""
    kind = CODES[code]
    return Finding(
        code=code,
        severity=kind.severity,
        scenario=scenario,
        where=where,
        what=what,
        remedy=kind.remedy,
        known=bool(kind.known),
    )


def frames_text(frames: Iterable[int]) -> str:
    """`frame 7`, `frames 3–5, 9`."""
    numbers = sorted({int(frame) for frame in frames})
    return f"{'frame' if len(numbers) == 1 else 'frames'} {frame_ranges(numbers)}"


def actors_text(ids: Iterable[int], most: int = 4) -> str:
    """`actor 1236`, `actors 12, 17, 20, 31 and 5 more`."""
    numbers = sorted({int(actor) for actor in ids})
    shown = ", ".join(map(str, numbers[:most]))
    more = f" and {len(numbers) - most} more" if len(numbers) > most else ""
    return f"{'actor' if len(numbers) == 1 else 'actors'} {shown}{more}"
