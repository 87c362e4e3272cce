"""`Subject`: one scenario's small files in memory, with the arrays that all content checks need."""

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

# Distance within which a label can count as complete.
_MAX_REACH_M = 35.0
# Share of the farthest box's distance within which a label counts as complete.
_REACH_SHARE = 0.8
_COORDINATE_LIMIT_M = 1e7
MAX_LABEL_BOXES = 500
"""Boxes in a label; real ones have less than a hundred."""
# Boxes in one cell at one moment that are compared pair by pair.
_MAX_CELL_BOXES = 32
# Distance of an untracked row from where the actor should be.
_UNTRACKED_RADIUS_M = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """One scenario of A agents, F frames, S = A·F samples agent by agent, and N boxes.

    All coordinates are in the world frame, right-handed.

    Attributes:
        files: Contents of the files.
        boxes: Boxes, and where each was recorded.
        centers: Box centres, shape (N, 3), metres.
    """

    files: ScenarioFiles
    boxes: ScenarioBoxes
    centers: FloatArray

    @property
    def token(self) -> str:
        """Token of the scenario."""
        return self.files.scenario.token

    @property
    def agents(self) -> Sequence[AgentName]:
        """The A agents that the scenario has."""
        return self.files.scan.agents

    @property
    def num_frames(self) -> int:
        """Number of frames, F."""
        return self.files.scan.num_frames

    @property
    def label_id(self) -> IntArray:
        """Actor ids of the labels, shape (N,)."""
        return self.boxes.labels.actor_id

    @cached_property
    def tracked(self) -> BoolArray:
        """Mask of tracked boxes of other actors, shape (N,)."""
        is_other = self.label_id != OWN_ACTOR_ID
        return np.asarray(is_other & (self.label_id != UNTRACKED_ID))

    @cached_property
    def own(self) -> BoolArray:
        """Mask of the recording agents' own rows, shape (N,)."""
        return np.asarray(self.label_id == OWN_ACTOR_ID)

    @cached_property
    def in_collision(self) -> BoolArray:
        """Mask of the boxes of meta's pair, shape (N,); of all boxes, without meta."""
        meta = self.files.meta
        if meta is None:
            return np.ones(len(self.boxes), dtype=bool)
        return np.isin(self.boxes.actor, meta.collision.ids if meta.collision else ())

    @cached_property
    def yaw(self) -> FloatArray:
        """Heading of each box in world, shape (N,), radians."""
        return quaternions.yaw_of(box_rules.world_rotations(self.boxes))

    @cached_property
    def reach(self) -> FloatArray:
        """Distance around each agent within which its labels are complete, shape (A,), metres.

        It is 0 where nothing shows that. Labels that hold an actor unseen by its agent's LiDAR and
        cameras leave no hidden actor out, and all labels of a scenario are written by one rule; the
        boxes of each agent show how far it reaches.
        """
        labels = self.boxes.labels
        agent = self.boxes.agent
        distance = np.linalg.norm(labels.center[:, :2], axis=1)
        unseen = (labels.num_lidar_pts == 0) & ~labels.camera_visible
        hidden = self.tracked & unseen & (distance < _MAX_REACH_M)
        max_distance = np.zeros(len(self.agents))
        np.maximum.at(max_distance, agent, distance)
        reach = np.minimum(_MAX_REACH_M, _REACH_SHARE * max_distance)
        return np.asarray(reach * hidden.any())

    def has_untracked(self, agent: int, frames: IntArray, positions: FloatArray) -> BoolArray:
        """Return a mask (M,) of the positions with an untracked row (id −1) of an agent.

        Args:
            agent: Index of the agent.
            frames: Frame numbers, shape (M,).
            positions: Positions at these frames, shape (M, 3), world, metres.
        """
        rows = np.flatnonzero((self.label_id == UNTRACKED_ID) & (self.boxes.agent == agent))
        if not len(rows) or not len(frames):
            return np.zeros(len(frames), dtype=bool)
        from scipy.spatial import cKDTree

        points = tree_points(self.centers[rows], self.boxes.frame[rows], _UNTRACKED_RADIUS_M)
        tree = cKDTree(np.unique(points, axis=0))
        queries = tree_points(positions, frames, _UNTRACKED_RADIUS_M)
        distance, _ = tree.query(queries, distance_upper_bound=_UNTRACKED_RADIUS_M)
        return np.asarray(np.isfinite(distance))

    @cached_property
    def lidar_boxes(self) -> Boxes:
        """All N boxes, each in the LiDAR frame of its sample."""
        return self.boxes.labels.boxes()

    @cached_property
    def velocity(self) -> FloatArray:
        """Velocities from displacements, shape (N, 3), m/s; NaN where unknown."""
        return displacement_velocities(
            self.centers, self.boxes.agent, self.label_id, self.boxes.frame
        )

    @cached_property
    def positions(self) -> FloatArray:
        """Positions of the agents, shape (A, F, 3), metres."""
        positions = self.files.calibs.world_from_ego[:, :3, 3]
        return positions.reshape(len(self.agents), self.num_frames, 3)

    def is_pole(self, agent: int) -> bool:
        """Return whether the agent of this index stands at the roadside."""
        return self.agents[agent] == INFRASTRUCTURE

    def finding(self, code: str, location: str, message: str) -> Finding:
        """Return a finding about this scenario; `CODES` has its severity and remedy."""
        return make_finding(code, self.token, location, message)

    def label_folder(self, agent: int) -> str:
        """Return the folder of an agent's labels."""
        name = self.agents[agent]
        return str(self.files.scenario.kind_folder(name, "label"))

    def calib_folder(self, agent: int) -> str:
        """Return the folder of an agent's calib files."""
        name = self.agents[agent]
        return str(self.files.scenario.kind_folder(name, "calib"))

    def rows_by_agent(self, mask: BoolArray) -> Iterable[tuple[int, IntArray]]:
        """Yield each agent with boxes in a mask (N,), and the rows (M,) of these boxes."""
        for agent in range(len(self.agents)):
            rows = np.flatnonzero(mask & (self.boxes.agent == agent))
            if len(rows):
                yield agent, rows

    def mask(self, rows: AnyArray) -> BoolArray:
        """Return a mask (N,) that is true for rows (M,)."""
        mask = np.zeros(len(self.boxes), dtype=bool)
        mask[rows] = True
        return mask

    def label_findings(self, code: str, mask: BoolArray, message: str) -> Iterable[Finding]:
        """Yield one finding an agent for the boxes in a mask (N,), with actors and frames."""
        for agent, rows in self.rows_by_agent(mask):
            frames = frames_text(self.boxes.frame[rows])
            actors = actors_text(self.label_id[rows])
            yield self.finding(code, self.label_folder(agent), f"{message}: {actors}, {frames}")


def subject_of(files: ScenarioFiles) -> Subject:
    """Return the subject of all checks."""
    boxes = scenario_boxes(files)
    return Subject(files=files, boxes=boxes, centers=box_rules.world_centers(boxes))


def near_pairs(
    positions: FloatArray, moments: AnyArray, radius: float
) -> tuple[IntArray, BoolArray]:
    """Return pairs of positions of the same moment within a radius, without crowds.

    The pairs of a crowd, many positions in one cell, would have no end.

    Args:
        positions: Positions, shape (M, 3), metres.
        moments: Moment of each, shape (M,).
        radius: Maximum distance of a pair, metres.

    Returns:
        Pairs of rows, shape (P, 2), and a mask (M,) of positions in crowds, which are in no pair.
    """
    from scipy.spatial import cKDTree

    points = tree_points(positions, moments, radius)
    cells = np.floor(points / radius)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    crowded: BoolArray = count[cell.reshape(-1)] > _MAX_CELL_BOXES
    rows = np.flatnonzero(~crowded)
    tree_pairs = cKDTree(points[rows]).query_pairs(radius, output_type="ndarray")
    pairs: IntArray = rows[tree_pairs].reshape(-1, 2)
    return pairs, crowded


def tree_points(positions: FloatArray, moments: AnyArray, radius: float) -> FloatArray:
    """Return points (M, 4) for a tree; absurd positions are clipped, since they would overflow."""
    clipped = np.clip(positions, -_COORDINATE_LIMIT_M, _COORDINATE_LIMIT_M)
    return np.column_stack([clipped, moments * (10 * radius)])


def make_finding(code: str, scenario: str | None, location: str, message: str) -> Finding:
    """Return a finding of a kind in `CODES`."""
    kind = CODES[code]
    return Finding(
        code=code,
        severity=kind.severity,
        scenario=scenario,
        where=location,
        what=message,
        remedy=kind.remedy,
        known=bool(kind.known),
    )


def frames_text(frames: Iterable[int]) -> str:
    """Return `frame 7`, or `frames 3–5, 9`."""
    numbers = sorted({int(frame) for frame in frames})
    noun = "frame" if len(numbers) == 1 else "frames"
    return f"{noun} {frame_ranges(numbers)}"


def actors_text(ids: Iterable[int], max_listed: int = 4) -> str:
    """Return `actor 1236`, or `actors 12, 17, 20, 31 and 5 more`."""
    numbers = sorted({int(actor) for actor in ids})
    listed = ", ".join(map(str, numbers[:max_listed]))
    if len(numbers) > max_listed:
        listed += f" and {len(numbers) - max_listed} more"
    noun = "actor" if len(numbers) == 1 else "actors"
    return f"{noun} {listed}"
